"""Curves from photographs with known cameras: accuracy and completeness against the true edges of rendered scenes.

`python -m bench.curves` prints the tables, of the sets in the folder that TORCHSFM_DATA names: CAD objects of ABC-NEF by the
measures of EMAP (CVPR 2024), and the Barcelona pavilion (Usumezbas, Fabbri & Kimia, ECCV 2016) by precision against recall.
"""

import argparse
import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from torchsfm.formats import write_curves
from torchsfm.geometry import Camera, Pose, krt_from_camera
from torchsfm.images import ImageError, read_image
from torchsfm.reconstruction import Curves, reconstruct_curves

Array = NDArray[np.float64]
STEP, CELLS = 0.005, 256
"""EMAP samples what was found so far apart, and averages the samples of each of so many cells along [-1, 1]."""
LIMITS = (0.005, 0.01, 0.02)


def photographs(files: list[Path]) -> Iterator[Tensor | None]:
    """The images, None for one that is damaged."""
    for file in files:
        try:
            yield read_image(file).pixels
        except ImageError as error:
            print(f"left out: {error}")
            yield None


def samples(found: Curves, step: float) -> Array:
    """Points of the curves, so far apart."""
    points = [np.zeros((0, 3))]
    for x, closed in zip(found.X.split(found.number.tolist()), found.closed.tolist(), strict=True):
        line = x.numpy()
        line = np.concatenate((line, line[:1])) if closed else line
        s = np.concatenate(([0.0], np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum()))
        points.append(np.stack([np.interp(np.arange(0, s[-1], step), s, line[:, k]) for k in range(3)], -1))
    return np.concatenate(points)


def emap(found: Curves, truth: Array) -> list[float]:
    """Accuracy and completeness in thousandths, then precision, recall and F in per cent at each limit."""
    x = samples(found, STEP)
    _, cell = np.unique(np.floor((x + 1) / 2 * CELLS), axis=0, return_inverse=True)
    cell = cell.ravel()
    x = np.stack([np.bincount(cell, x[:, k]) / np.bincount(cell) for k in range(3)], -1)
    accuracy, completeness = cKDTree(truth).query(x)[0], cKDTree(x).query(truth)[0]
    values = [1000 * accuracy.mean(), 1000 * completeness.mean()]
    for limit in LIMITS:
        p, r = 100 * (accuracy < limit).mean(), 100 * (completeness < limit).mean()
        values += [p, r, 2 * p * r / max(p + r, 1e-9)]
    return values


def abc(folder: Path, out: Path | None) -> None:
    """The table of the CAD objects."""
    print("| object | curves | Acc | Comp | P5 R5 F5 | P10 R10 F10 | P20 R20 F20 | CPU seconds |\n|" + "---|" * 8)
    for place in sorted(path for path in folder.iterdir() if path.is_dir()):
        truth = np.load(place / "truth.npz")
        files = sorted((place / "images").iterdir())
        K, pose = torch.from_numpy(truth["K"]), Pose.from_matrix(torch.from_numpy(truth["cam_from_world"]))
        start = time.process_time()
        found = reconstruct_curves(photographs(files), Camera(K.expand(len(files), 3, 3)), pose)
        seconds = time.process_time() - start
        acc, comp, *shares = emap(found, truth["points"].astype(np.float64))
        columns = [" ".join(f"{v:.1f}" for v in shares[i : i + 3]) for i in (0, 3, 6)]
        print(
            f"| {place.name} | {len(found)} | {acc:.2f} | {comp:.2f} | {' | '.join(columns)} | {seconds:.0f} |",
            flush=True,
        )
        if out is not None:
            write_curves(found, out / f"{place.name}.ply")


def pavilion(folder: Path, out: Path | None) -> None:
    """Precision against recall, by how many images must have found a sample."""
    files = sorted((folder / "images").iterdir())
    P = torch.stack([torch.from_numpy(np.loadtxt(folder / "cameras" / f"{f.stem}.projmatrix")) for f in files])
    # Its pixels begin at their corners: true points lie beside their edges by half a pixel otherwise.
    P = torch.tensor([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]], dtype=P.dtype) @ P
    K, R, t = krt_from_camera(P)
    truth = np.loadtxt(folder / "gt-points.txt")
    low, high = truth.min(0), truth.max(0)
    print(f"\n{len(truth)} true points, of a scene of size {np.linalg.norm(high - low):.2f}; only curves within its box count")
    print(
        "| images | samples | median distance | "
        + " | ".join(f"P R at {limit}" for limit in (0.01, 0.02, 0.05))
        + " | CPU seconds |"
    )
    print("|" + "---|" * 7)
    for least in (2, 3, 5, 8):
        start = time.process_time()
        found = reconstruct_curves(photographs(files), Camera(K), Pose(R, t), least_images=least)
        seconds = time.process_time() - start
        x = samples(found, 0.01)
        x = x[((x > low - 0.02) & (x < high + 0.02)).all(-1)]
        accuracy, completeness = cKDTree(truth).query(x)[0], cKDTree(x).query(truth)[0]
        columns = [f"{100 * (accuracy < d).mean():.1f} {100 * (completeness < d).mean():.1f}" for d in (0.01, 0.02, 0.05)]
        print(f"| {least} | {len(x)} | {np.median(accuracy):.4f} | {' | '.join(columns)} | {seconds:.0f} |", flush=True)
        if out is not None:
            write_curves(found, out / f"pavilion-{least}.ply")


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=("abc", "pavilion"))
    parser.add_argument("--out", type=Path, help="folder for the curves, as PLY")
    options = parser.parse_args()
    torch.set_num_threads(1)
    folder = os.environ.get("TORCHSFM_DATA")
    if not folder:
        raise SystemExit("TORCHSFM_DATA names no folder")
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
    if options.only != "pavilion":
        abc(Path(folder) / "curves/abc", options.out)
    if options.only != "abc":
        pavilion(Path(folder) / "curves/pavilion", options.out)


if __name__ == "__main__":
    main()
