"""The command run in this process on small photographs, and what it leaves."""

import json
import math
from pathlib import Path
from shutil import copy

import numpy as np
import torch
from chance import seeded
from torch import Tensor
from typer.testing import CliRunner

from torchsfm.cli import app
from torchsfm.geometry import Camera, Pose, intrinsics
from torchsfm.images import save_image
from torchsfm.simulation import courtyard_scene, orbit_poses, render_sequence

WIDTH, HEIGHT, VIEWS = 400, 300, 5
FOCAL = 380.0


def torchsfm(*words: object) -> tuple[int, str, str]:
    """Run the command in this process; exit status, stdout, stderr."""
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout, result.stderr


def render(poses: Pose, seed: int) -> Tensor:
    generator = seeded(seed)
    scene = courtyard_scene(texel=0.015, generator=generator)
    K = intrinsics(torch.tensor(FOCAL).double(), torch.tensor([(WIDTH - 1) / 2, (HEIGHT - 1) / 2]).double())
    options = {"width": WIDTH, "height": HEIGHT, "points": 0, "supersample": 2}
    return render_sequence(scene, poses=poses, camera=Camera(K), generator=generator, **options).images


def arc(views: int, degrees: float) -> Pose:
    sweep, start = math.radians(degrees), math.radians(-75)
    return orbit_poses(views, radius=5.2, height=(0.6, 2.2), sweep=sweep, start=start, target=(0.0, 0.0, 0.7))


def photograph(folder: Path) -> Path:
    """Five photographs of one scene."""
    for i, image in enumerate(render(arc(VIEWS, 40), seed=0)):
        save_image(folder / f"view{i}.png", image)
    return folder


def copies(source: Path, target: Path, *names: str) -> Path:
    target.mkdir(exist_ok=True)
    for name in names:
        copy(source / name, target / name)
    return target


def report(out: Path) -> dict[str, dict[str, object]]:
    """Image reports by name."""
    return {image["name"]: image for image in json.loads((out / "report.json").read_text())["images"]}


def assert_one_line(stderr: str, *words: str) -> None:
    lines = stderr.strip().splitlines()
    assert len(lines) == 1, stderr
    assert lines[0].startswith("torchsfm: ")
    for word in words:
        assert word in lines[0]


def same_model(a: Path, b: Path) -> bool:
    with np.load(a) as first, np.load(b) as second:
        return set(first.files) == set(second.files) and all(np.array_equal(first[name], second[name]) for name in first.files)
