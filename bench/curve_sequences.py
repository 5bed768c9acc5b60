"""Cameras of a sequence by curves alone: smooth glazed objects with painted curves before a camera that goes around them.

    python -m bench.curve_sequences [--scenes 0,1,2] [--frames 20] [--points]
    TORCHSFM_DATA=/path/to/data python -m bench.curve_sequences --scenes "" --real temple pavilion

Rotations are compared with the truth up to a rotation of the world. `--points` adds what points give for the same frames.
Real are 18 photographs of the temple ring (templeR0013-0030), 7.7 degrees apart, and 25 frames of the Barcelona pavilion, 7 to
31 degrees apart. A line each model.
"""

import argparse
import math
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bench.doubt_scenes import TEXEL, Draw, _smooth_parts, _vector
from bench.real_data import SETS, data_folder
from torchsfm.geometry import Camera, Pose, intrinsics, krt_from_camera, rotation_angle
from torchsfm.geometry.distortion import Radial
from torchsfm.images import save_image
from torchsfm.linalg import nearest_rotation
from torchsfm.reconstruction import reconstruct
from torchsfm.simulation import look_at, render_sequence
from torchsfm.simulation.textured_scene import Textured, TexturedScene
from torchsfm.simulation.textures import mip_pyramid, paint

WIDTH, HEIGHT = 400, 300


@dataclass(frozen=True)
class Sequence:
    """Frames and the truth about them."""

    images: Tensor
    poses: Pose
    camera: Camera
    scene: TexturedScene


def smooth_sequence(number: int, frames: int, step: float = 3.0) -> Sequence:
    """A smooth object, the camera on an arc with so many degrees from a frame to the next, never quite even."""
    draw = Draw(5000 + number)
    things, fine = [], draw.uniform(2.0, 6.0)
    for part in _smooth_parts(draw):
        size = part.sheets()[0][0] * fine
        sheets = [mip_pyramid(paint("curves", size, size, texel=TEXEL * fine, generator=draw.generator)) for _ in range(6)]
        things.append(Textured(part, tuple(sheets), TEXEL))
    radius, start, height = draw.uniform(2.9, 3.3), draw.uniform(0, 2 * math.pi), draw.uniform(0.2, 1.0)
    rise, way = draw.uniform(-0.6, 0.8), 1 if draw.uniform(0, 1) < 0.5 else -1
    centres = []
    for i in range(frames):
        angle = start + way * math.radians(step) * i + math.radians(0.4 * step) * draw.uniform(-0.5, 0.5)
        r = radius * (1 + 0.03 * draw.uniform(-1, 1))
        z = height + rise * i / frames + 0.02 * draw.uniform(-1, 1)
        centres.append(_vector(r * math.cos(angle), r * math.sin(angle), z))
    poses = look_at(torch.stack(centres), 0.03 * torch.randn(frames, 3, generator=draw.generator, dtype=torch.float64))
    c = _vector((WIDTH - 1) / 2 + draw.uniform(-4, 4), (HEIGHT - 1) / 2 + draw.uniform(-4, 4))
    lens = Radial(_vector(draw.uniform(-0.08, 0.04))[0], _vector(0.0)[0])
    camera = Camera(intrinsics(_vector(draw.uniform(0.95, 1.35) * WIDTH)[0], c), lens)
    lamp = _vector(draw.uniform(-0.8, 0.8), draw.uniform(-1.2, -0.4), -1.0)
    scene = TexturedScene(tuple(things), lamp, gloss=draw.uniform(0.25, 0.6), polish=draw.uniform(15, 60), ambient=0.45)
    images = [
        render_sequence(
            replace(scene, sun=poses.R[i].mT @ lamp), poses=poses[i : i + 1], camera=camera, width=WIDTH, height=HEIGHT,
            noise=0.01, points=1, generator=draw.generator,
        ).images
        for i in range(frames)
    ]  # fmt: skip
    return Sequence(torch.cat(images), poses, camera, scene)


def rotation_errors(found: Pose, truth: Pose) -> Tensor:
    """Degrees, after the rotation of the world that fits all best."""
    turn = nearest_rotation((truth.R.mT @ found.R).mean(0))
    return rotation_angle(found.R @ (truth.R @ turn).mT).rad2deg()


def temple(data: Path) -> tuple[list[Path], Pose, float]:
    """Photographs, their poses, and the focal length."""
    ring = SETS["temple"](data)
    paths = [path for path in ring.paths if 13 <= int(path.stem[-4:]) <= 30]
    poses = Pose.from_matrix(torch.from_numpy(np.stack([ring.poses[path.name] for path in paths])))
    return paths, poses, float(ring.focal or math.nan)


def pavilion(data: Path) -> tuple[list[Path], Pose, float]:
    """Rendered frames of the Barcelona pavilion, their poses, and the focal length."""
    folder = data / "curves/pavilion"
    paths = sorted((folder / "images").iterdir())
    P = torch.stack([torch.from_numpy(np.loadtxt(folder / "cameras" / f"{path.stem}.projmatrix")) for path in paths])
    K, R, t = krt_from_camera(P)
    return paths, Pose(R, t), float(K[0, 0, 0])


REAL = {"temple": temple, "pavilion": pavilion}


def rows(name: str, folder: Path, poses: Pose, focal: float, method: str) -> Iterator[str]:
    """Lines of the table, for each model one."""
    start = time.process_time()
    found = reconstruct(folder, method=method, sequence=method != "curves")
    seconds, frames = time.process_time() - start, len(poses.R)
    if not found.models:
        yield f"| {name} | {method} | 0 of {frames} |  |  |  |  | {seconds:.0f} | {found.failure()} |"
    for number, model in enumerate(found.models):
        known = model.registered
        error = rotation_errors(model.poses[known], poses[known])
        doubtful = sum(bool(image.doubt) for image in found.report.images if image.model == number)
        yield (
            f"| {name} | {method} | {int(known.sum())} of {frames} | {doubtful} | {error.median():.2f} | {error.max():.2f} "
            f"| {float(model.cameras.K[0, 0, 0]) / focal:.3f} | {seconds:.0f} |  |"
        )


def main(arguments: list[str] | None = None) -> None:
    """Print the table, a line as soon as it is known."""
    parser = argparse.ArgumentParser(prog="python -m bench.curve_sequences", description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", default="0,1,2,3,4,5", help="numbers separated by commas")
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--points", action="store_true", help="also what points give")
    parser.add_argument("--real", nargs="+", choices=tuple(REAL), default=[])
    parser.add_argument("--data", type=Path, default=data_folder(), help="folder of the data sets (default: $TORCHSFM_DATA)")
    options = parser.parse_args(arguments)
    if options.real and options.data is None:
        parser.error("TORCHSFM_DATA does not name the folder of the data sets")
    methods = ("curves", "incremental") if options.points else ("curves",)
    print("| scene | by | placed | doubtful | rotation off, deg, median | largest | f / true f | CPU s | refused |")
    print("|---" * 9 + "|", flush=True)
    for number in (word for word in options.scenes.split(",") if word):
        scene = smooth_sequence(int(number), options.frames)
        with tempfile.TemporaryDirectory() as scratch:
            for i, image in enumerate(scene.images):
                save_image(Path(scratch) / f"{i:03d}.png", image)
            for method in methods:
                for line in rows(number, Path(scratch), scene.poses, float(scene.camera.K[0, 0]), method):
                    print(line, flush=True)
    for name in options.real:
        paths, poses, focal = REAL[name](options.data)
        with tempfile.TemporaryDirectory() as scratch:
            for path in paths:
                (Path(scratch) / path.name).symlink_to(path.resolve())
            for method in methods:
                for line in rows(name, Path(scratch), poses, focal, method):
                    print(line, flush=True)


if __name__ == "__main__":
    main()
