"""Samples of curves that lie on outlines of smooth objects, of which rendered frames are known.

    python -m bench.outlines [--scenes 16,17,25,26] [--frames 12] [--step 3] [--method curves] [--all]

An edge point is of an outline where the depth of what is seen changes by more than 3 % within one and a half pixels across it;
a sample is, where more than half of its edge points are. `--all` leaves in what is taken for outlines. AUC is of the pose
error. A line each model.
"""

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from bench.curve_sequences import Sequence, smooth_sequence
from torchsfm.images import save_image
from torchsfm.reconstruction import Reconstruction, reconstruct
from torchsfm.reconstruction.curves import from_edges, mapping
from torchsfm.reconstruction.model.curves import Curves
from torchsfm.reconstruction.model.evaluation import pose_auc, pose_errors
from torchsfm.simulation.ray_casting import cast

ACROSS = 1.5
"""Pixels to both sides of an edge."""
STEP = 1.03
"""Depth there over that on the other side."""


def on_outline(curves: Curves, truth: Sequence) -> Tensor:
    """Which share of the edge points of each sample is of an outline."""
    depths = []
    for share in (-1.0, -0.5, 0.0, 0.5, 1.0):
        d = truth.camera.unproject((curves.x + share * ACROSS * curves.normal).double())[0]
        R, c = truth.poses.R[curves.view], truth.poses.centre[curves.view]
        depths.append(cast(truth.scene, c.mT.contiguous(), (R.mT @ d[..., None])[..., 0].mT.contiguous())[0])
    depth = torch.stack(depths)
    outline = (depth.amax(0) > STEP * depth.amin(0)).double()
    number = torch.bincount(curves.sample, minlength=len(curves.X))
    return torch.zeros(len(curves.X), dtype=torch.float64).index_add(0, curves.sample, outline) / number.clamp(min=1)


def row(name: str, model: Reconstruction, truth: Sequence, seconds: float) -> str:
    """A line of the table."""
    curves = model.curves
    share = on_outline(curves, truth) if curves is not None else torch.zeros(0)
    auc = pose_auc(pose_errors(model.poses, truth.poses, model.registered).pose, (1.0, 2.0))
    return (
        f"| {name} | {int(model.registered.sum())} of {len(truth.poses.R)} | {len(share)} | {int((share > 0.5).sum())} "
        f"| {auc[0]:.3f} | {auc[1]:.3f} | {seconds:.0f} |"
    )


def rows(name: str, truth: Sequence, method: str) -> Iterator[str]:
    """Lines of a scene."""
    with tempfile.TemporaryDirectory() as scratch:
        for i, image in enumerate(truth.images):
            save_image(Path(scratch) / f"{i:03d}.png", image)
        start = time.process_time()
        found = reconstruct(scratch, method=method, curves=method != "curves")
        seconds = time.process_time() - start
    if not found.models:
        yield f"| {name} | none |  |  |  |  | {seconds:.0f} |"
    for model in found.models:
        yield row(name, model, truth, seconds)


def main(arguments: list[str] | None = None) -> None:
    """Print the table, a line as soon as it is known."""
    parser = argparse.ArgumentParser(prog="python -m bench.outlines", description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", default="16,17,25,26", help="numbers separated by commas")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--step", type=float, default=3.0, help="degrees from a frame to the next")
    parser.add_argument("--method", default="auto", help="as of `reconstruct`; curves after points where it is not curves")
    parser.add_argument("--all", action="store_true", help="leave in what is taken for outlines")
    options = parser.parse_args(arguments)
    if options.all:
        from_edges.on_outlines = mapping.on_outlines = lambda curves, *_: torch.zeros(len(curves.X), dtype=torch.bool)
    print("| scene | placed | samples | on outlines | AUC 1 deg | AUC 2 deg | CPU s |")
    print("|---" * 7 + "|", flush=True)
    for number in options.scenes.split(","):
        for line in rows(number, smooth_sequence(int(number), options.frames, options.step), options.method):
            print(line, flush=True)


if __name__ == "__main__":
    main()
