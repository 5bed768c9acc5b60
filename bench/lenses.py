"""Photographs by wide lenses, nothing known of them: is the lens recognised, and are the cameras right?

    python -m bench.lenses [--focals 400 500 600 800] [--views 10] [--no-colmap]

renders sequences of 960 x 720 pixels by fisheyes of these focal lengths (equidistant: the corners, 600 pixels off the middle,
are 600 / focal radians off the axis) and prints a markdown table: the lens and focal length found, the area under the curve of
pose errors at 1 degree and the largest error, and how many images are doubtful; beside the same with the lens that is the
default for others, and beside COLMAP, whose default is SIMPLE_RADIAL.
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from bench.real_data import PhotographSet
from bench.reconstruction import run_colmap
from torchsfm.geometry import Camera, Pose, intrinsics
from torchsfm.geometry.distortion import DISTORTION_MODELS
from torchsfm.reconstruction import reconstruct
from torchsfm.reconstruction.model.evaluation import pose_auc, pose_errors
from torchsfm.simulation import render_sequence

SIZE = (960, 720)


def fisheye(focal: float) -> Camera:
    """An equidistant fisheye."""
    centre = (torch.tensor(SIZE).double() - 1) / 2
    model = DISTORTION_MODELS["fisheye"]
    lens = model.from_parameters(torch.zeros(model.num_parameters, dtype=torch.float64))
    return Camera(intrinsics(torch.tensor(focal, dtype=torch.float64), centre), lens)


def ours(files: list[Path], camera: str | None) -> dict[str, Any]:
    """What this library makes of photographs."""
    result = reconstruct(files, camera=camera)
    if not result.models:
        return {}
    model = result.model
    doubtful = sum(bool(image.doubt) for image in result.report.images)
    lens = next(name for name, kind in DISTORTION_MODELS.items() if isinstance(model.cameras.distortion, kind))
    focal = float(model.cameras.K[:, 0, 0].median())
    return {"poses": model.poses, "registered": model.registered, "lens": lens, "focal": focal, "doubtful": str(doubtful)}


def colmap(files: list[Path]) -> dict[str, Any]:
    """What COLMAP makes of them in its default settings; nothing where it is not installed, or makes no model."""
    try:
        found = run_colmap(PhotographSet("fisheye", files), 1, 0)
    except (ImportError, RuntimeError):
        return {}
    matrix = torch.eye(3, 4, dtype=torch.float64).repeat(len(files), 1, 1)
    registered = torch.zeros(len(files), dtype=torch.bool)
    for i, path in enumerate(files):
        if path.name in found["poses"]:
            matrix[i], registered[i] = torch.tensor(found["poses"][path.name]), True
    poses = Pose.from_matrix(matrix)
    return {"poses": poses, "registered": registered, "lens": "SIMPLE_RADIAL", "focal": found["focal"], "doubtful": ""}


def rows(focal: float, views: int, with_colmap: bool) -> list[str]:
    """The lines of one lens."""
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        sequence = render_sequence(
            camera=fisheye(focal), views=views, width=SIZE[0], height=SIZE[1], supersample=2,
            generator=torch.Generator().manual_seed(1),
        )  # fmt: skip
        files = sequence.save(folder)
        programs = {"torchsfm": None, 'torchsfm, `camera="radial"`': "radial"} | ({"COLMAP": ""} if with_colmap else {})
        for program, camera in programs.items():
            start = time.process_time()
            found = colmap(files) if camera == "" else ours(files, camera)
            seconds = time.process_time() - start
            if not found:
                lines.append(f"| {focal:.0f} | {program} | 0/{views} | | | | | | {seconds:.0f} |")
                continue
            errors = pose_errors(found["poses"], sequence.poses, found["registered"]).pose
            good = errors[torch.isfinite(errors)]
            cells = [
                f"{focal:.0f}", program, f"{int(found['registered'].sum())}/{views}", found["lens"],
                f"{found['focal'] / focal:.4f}", f"{float(pose_auc(errors)[0]):.3f}", f"{float(good.max()):.2f}",
                found["doubtful"], f"{seconds:.0f}",
            ]  # fmt: skip
            lines.append("| " + " | ".join(cells) + " |")
    return lines


def main(arguments: list[str] | None = None) -> None:
    """Print the table, the lines of a lens as soon as they are known."""
    parser = argparse.ArgumentParser(prog="python -m bench.lenses", description="Photographs by wide lenses.")
    parser.add_argument("--focals", type=float, nargs="+", default=[400.0, 500.0, 600.0, 800.0], help="pixels")
    parser.add_argument("--views", type=int, default=10)
    parser.add_argument("--no-colmap", action="store_true")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    print("| focal length, px | program | registered | lens | focal / true | AUC 1° | largest error, ° | doubtful | CPU s |")
    print("|---|---|---|---|---|---|---|---|---|")
    for focal in options.focals:
        for line in rows(focal, options.views, not options.no_colmap):
            print(line, flush=True)


if __name__ == "__main__":
    main()
