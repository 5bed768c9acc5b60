"""Curves from photographs with known cameras: accuracy and completeness against the true edges of rendered scenes.

`python -m bench.curves` prints the tables, of the sets in the folder that TORCHSFM_DATA names: CAD objects of ABC-NEF by the
measures of EMAP (CVPR 2024), and the Barcelona pavilion (Usumezbas, Fabbri & Kimia, ECCV 2016) by precision against recall.
"""

import argparse
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
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
from torchsfm.reconstruction.curves.image_edges import ImageEdges

Array = NDArray[np.float64]
STEP, CELLS = 0.005, 256
"""EMAP samples what was found so far apart, and averages the samples of each of so many cells along [-1, 1]."""
LIMITS = (0.005, 0.01, 0.02)
NEAR, SHOWN = (0.01, 0.02, 0.05), (3, 5, 8)
"""Distances of the pavilion, and numbers of images by which marks of it are told apart."""
BESIDE, TURNED, RUN = 1.2, 0.25, 6.0
"""Pixels between a mark and an edge that shows it, the sine of the angle between them, and pixels of the shortest run of it."""
LEVEL = 0.02
"""Heights no farther apart are one level."""


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


@dataclass(frozen=True)
class Marks:
    """Samples of edges that were marked by hand: lines from one true point to the next, many of them long."""

    X: Array
    along: Array
    """Unit tangents."""
    length: Array
    """What each sample stands for."""
    line: NDArray[np.int64]

    @classmethod
    def read(cls, folder: Path, step: float) -> "Marks":
        """Samples so far apart, at most."""
        points = np.loadtxt(folder / "gt-points.txt")
        pairs = np.loadtxt(folder / "gt-edges.txt").astype(np.int64).reshape(-1, 2) - 1
        start, way = points[pairs[:, 0]], points[pairs[:, 1]] - points[pairs[:, 0]]
        long = np.linalg.norm(way, axis=1)
        number = np.maximum(1, np.ceil(long / step)).astype(np.int64)
        line = np.repeat(np.arange(len(pairs)), number)
        rank = np.arange(len(line)) - np.repeat(number.cumsum() - number, number)
        X = start[line] + ((rank + 0.5) / number[line])[:, None] * way[line]
        along = way / np.maximum(long, 1e-12)[:, None]
        return cls(X, along[line], (long / number)[line], line)

    def floor(self) -> float:
        """The height at which most of them are: what floors show besides has no mark."""
        height = np.round(self.X[:, 2] / LEVEL).astype(np.int64)
        values, place = np.unique(height, return_inverse=True)
        return float(LEVEL * values[np.bincount(place, self.length).argmax()])

    def shown(self, P: Array, images: list[Tensor | None]) -> NDArray[np.int64]:
        """How many images have an edge next to each sample that runs along it, as far as edges could tell it by chance.

        Marks are not only of what can be seen: undersides and what is behind things have them as well.
        """
        number = np.zeros(len(self.X), dtype=np.int64)
        for own, image in zip(P, images, strict=True):
            if image is None:
                continue
            edges = ImageEdges.of(image)
            x, normal = edges.x.double().numpy(), edges.normal.double().numpy()
            y, w = self.X @ own[:2, :3].T + own[:2, 3], self.X @ own[2, :3] + own[2, 3]
            y = y / np.where(w == 0, 1, w)[:, None]
            inside = (w * np.linalg.det(own[:, :3]) > 0) & (y >= 0).all(1) & (y < image.shape[:-3:-1]).all(1)
            way = self.along @ own[:2, :3].T - y * (self.along @ own[2, :3])[:, None]
            way /= np.maximum(np.linalg.norm(way, axis=1), 1e-300)[:, None]
            far, near = cKDTree(x).query(np.where(inside[:, None], y, -1e6))
            n = normal[near]
            good = inside & (far < 2 * BESIDE) & (np.abs(((x[near] - y) * n).sum(1)) < BESIDE)
            good &= np.abs((n * way).sum(1)) < TURNED
            # Runs of samples, in pixels.
            step = np.linalg.norm(np.diff(y, axis=0, prepend=y[:1]), axis=1)
            gap = np.linalg.norm(np.diff(self.X, axis=0, prepend=self.X[:1]), axis=1) > 3 * self.length.max()
            new = np.concatenate(([True], good[1:] != good[:-1])) | gap
            run = new.cumsum() - 1
            long = np.bincount(run, np.where(new, 0, np.minimum(step, 2 * RUN)))
            number += good & (long[run] >= RUN)
        return number


def pavilion(folder: Path, out: Path | None) -> None:
    """Precision against recall, by how many images must have found a sample."""
    files = sorted((folder / "images").iterdir())
    P = torch.stack([torch.from_numpy(np.loadtxt(folder / "cameras" / f"{f.stem}.projmatrix")) for f in files])
    # Its pixels begin at their corners: true points lie beside their edges by half a pixel otherwise.
    P = torch.tensor([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]], dtype=P.dtype) @ P
    K, R, t = krt_from_camera(P)
    images = list(photographs(files))
    marks = Marks.read(folder, STEP)
    shown, near, floor = marks.shown(P.numpy(), images), cKDTree(marks.X), marks.floor()
    low, high = marks.X.min(0), marks.X.max(0)
    told = ", ".join(f"{marks.length[shown >= k].sum():.0f} next to edges of {k} images" for k in SHOWN)
    print(f"\nmarks of length {marks.length.sum():.0f}, of a scene of size {np.linalg.norm(high - low):.2f}: {told}")
    print(
        "| images | samples | "
        + " | ".join(f"on marks, or on the floor at {floor:.2f}, within {d}" for d in NEAR)
        + " | "
        + " | ".join(f"found within {', '.join(map(str, NEAR))} of what {k} images show" for k in SHOWN)
        + " | CPU seconds |\n"
        + "|---" * 8
        + "|"
    )
    for least in (2, 3, 5, 8):
        start = time.process_time()
        found = reconstruct_curves(images, Camera(K), Pose(R, t), least_images=least)
        seconds = time.process_time() - start
        x = samples(found, 0.01)
        x = x[((x > low - 0.02) & (x < high + 0.02)).all(-1)]
        off, missed = near.query(x)[0], cKDTree(x).query(marks.X)[0]
        below = np.abs(x[:, 2] - floor)
        columns = [f"{100 * (off < d).mean():.1f}, {100 * ((off < d) | (below < d)).mean():.1f}" for d in NEAR]
        for k in SHOWN:
            length = np.where(shown >= k, marks.length, 0)
            columns.append(", ".join(f"{100 * length[missed < d].sum() / length.sum():.1f}" for d in NEAR))
        print(f"| {least} | {len(x)} | {' | '.join(columns)} | {seconds:.0f} |", flush=True)
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
