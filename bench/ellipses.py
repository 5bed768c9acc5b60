"""Detection of ellipses on rendered scenes whose ellipses are known, beside OpenCV's detectors where they are installed.

`python -m bench.ellipses [--scenes N]`. The peers, `cv2.ximgproc.findEllipses` and `EdgeDrawing.detectEllipses`, are in
opencv-contrib-python. A detection is right where its area and that of a true ellipse have 0.8 of their union in common; an
ellipse counts where a third of its outline is seen, and what is found of others is neither right nor wrong. Photographs of a
grid of circles are in the folder that TORCHSFM_DATA names: there the calibration from the grid says where the circles are; two
round things in the background are neither, and whatever else is found is wrong.
"""

import argparse
import math
import os
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import torch
from torch import Tensor

from torchsfm import Ellipse, calibrate_planes, detect_ellipses, fit_ellipse, render_shapes
from torchsfm.geometry import conic_from_ellipse
from torchsfm.images import detect_circles_grid, read_image

F64 = torch.float64
CIRCLES = 4, 3, 0.09, 0.035
"""Circles in a row and in a column of the real board, metres from one to the next, and their radius."""
ROUND = ((1273.0, 362.0, 16.0), (1153.0, 521.0, 8.0))
"""A knob and a disc of the room in which the camera stood: x, y and a radius they are within. They are ellipses, too."""
KINDS = {
    "apart": {"ellipses": 8, "rings": 0, "polygons": 0},
    "in front of each other": {"ellipses": 24, "rings": 0, "polygons": 6},
    "concentric": {"ellipses": 12, "rings": 6, "polygons": 4},
    "small": {"ellipses": 30, "rings": 0, "polygons": 10, "radius": (6.0, 20.0)},
    "large": {"ellipses": 12, "rings": 2, "polygons": 8, "radius": (30.0, 200.0)},
}


def ours(image: Tensor, min_coverage: float = 0.25) -> Ellipse:
    """Ours."""
    found = detect_ellipses(image, min_coverage=min_coverage)
    e = found.ellipse
    return Ellipse(e.centre[found.valid], e.semi_axes[found.valid], e.angle[found.valid])


def peers() -> dict[str, Callable[[Tensor], Ellipse]]:
    """OpenCV's detectors, with their default settings."""
    if not hasattr(cv2, "ximgproc"):
        return {}

    def grey(image: Tensor) -> object:
        return (image[0] * 255).round().clamp(0, 255).to(torch.uint8).numpy()

    def find_ellipses(image: Tensor) -> Ellipse:
        rows = cv2.ximgproc.findEllipses(
            grey(image), scoreThreshold=0.7, reliabilityThreshold=0.5, centerDistanceThreshold=0.05
        )
        rows = torch.zeros(0, 6, dtype=F64) if rows is None else torch.tensor(rows, dtype=F64).reshape(-1, 6)
        return ordered(rows[:, :2], rows[:, 2:4], rows[:, 4])

    drawing = cv2.ximgproc.createEdgeDrawing()

    def edge_drawing(image: Tensor) -> Ellipse:
        drawing.detectEdges(grey(image))
        rows = drawing.detectEllipses()
        rows = torch.zeros(0, 6, dtype=F64) if rows is None else torch.tensor(rows, dtype=F64).reshape(-1, 6)
        # A circle has a radius, an ellipse two semi-axes.
        return ordered(rows[:, :2], rows[:, 2:3] + rows[:, 3:5], rows[:, 5].deg2rad())

    return {"findEllipses": find_ellipses, "EdgeDrawing": edge_drawing}


def ordered(centre: Tensor, axes: Tensor, angle: Tensor) -> Ellipse:
    """With the longer axis first."""
    swap = axes[:, 0] < axes[:, 1]
    angle = torch.where(swap, angle + math.pi / 2, angle)
    return Ellipse(centre, axes.sort(-1, descending=True).values.clamp_min(1e-3), angle)


def overlap(found: Ellipse, true: Ellipse, samples: int = 120) -> Tensor:
    """Intersection over union of the areas (found, true)."""
    a, b = (e.semi_axes[:, 0] for e in (found, true))
    near = (found.centre[:, None] - true.centre).norm(dim=-1) < torch.minimum(a[:, None], b)
    near &= (a[:, None] < 2 * b) & (b < 2 * a[:, None])
    i, j = near.nonzero(as_tuple=True)
    along = torch.linspace(-1, 1, samples, dtype=F64)
    grid = torch.stack(torch.meshgrid(along, along, indexing="xy"), -1).reshape(-1, 2)
    reach = torch.maximum(a[i], b[j]) * 1.5
    x = true.centre[j][:, None] + reach[:, None, None] * grid
    h = torch.nn.functional.pad(x, (0, 1), value=1.0)
    inside = [
        ((h @ conic_from_ellipse(Ellipse(e.centre[k], e.semi_axes[k], e.angle[k]))) * h).sum(-1) < 0
        for e, k in ((found, i), (true, j))
    ]
    out = torch.zeros(near.shape, dtype=F64)
    both, any_ = (inside[0] & inside[1]).sum(-1), (inside[0] | inside[1]).sum(-1)
    out[i, j] = both.double() / any_.clamp_min(1)
    return out


def score(found: Ellipse, true: Ellipse, seen: Tensor) -> tuple[int, int, int, list[float]]:
    """Right, wrong and missed ones, and the errors of the semi-axes of the right ones."""
    common = overlap(found, true)
    right, errors = 0, []
    used = torch.zeros(len(found.angle), dtype=torch.bool)
    wanted = seen >= 1 / 3
    while common.numel() and float(common.max()) >= 0.8:
        i, j = divmod(int(common.argmax()), common.shape[1])
        common[i], common[:, j], used[i] = 0, 0, True
        if wanted[j]:
            right += 1
            errors += (found.semi_axes[i] - true.semi_axes[j]).abs().tolist()
    return right, int((~used).sum()), int(wanted.sum()) - right, errors


def photographs(folder: Path) -> list[tuple[Tensor, Ellipse]]:
    """Photographs of a grid of circles, and where the calibration from it has their images."""
    columns, rows, pitch, radius = CIRCLES
    images = [read_image(path).pixels.double().mean(0, keepdim=True) for path in sorted(folder.glob("*.jpg"))]
    boards = [detect_circles_grid(image, columns, rows) for image in images]
    X = pitch * torch.stack(torch.meshgrid(torch.arange(columns), torch.arange(rows), indexing="xy"), -1).reshape(-1, 2).to(F64)
    height, width = images[0].shape[-2:]
    outlines = torch.stack([board.outlines for board in boards if board.outlines is not None])
    start = calibrate_planes(outlines, X, image_size=(width, height), radius=radius)
    turn = torch.arange(120, dtype=F64) * (2 * math.pi / 120)
    rings = X[:, None] + radius * torch.stack((turn.cos(), turn.sin()), -1)
    points = torch.nn.functional.pad(rings, (0, 1)).flatten(0, 1)
    seen = start.camera.project(start.poses.transform(points)).reshape(len(images), columns * rows, 120, 2)
    return list(zip(images, (fit_ellipse(x).model for x in seen), strict=True))


def but_round(detect: Callable[[Tensor], Ellipse]) -> Callable[[Tensor], Ellipse]:
    """Without what is found of the round things in the background."""

    def rest(image: Tensor) -> Ellipse:
        found = detect(image)
        away = [(found.centre - found.centre.new_tensor(place)).norm(dim=-1) + found.semi_axes[:, 0] > r for *place, r in ROUND]
        kept = torch.stack(away).all(0)
        return Ellipse(found.centre[kept], found.semi_axes[kept], found.angle[kept])

    return rest


def compare(
    name: str, noise: str, scenes: list[tuple[Tensor, Ellipse, Tensor]], methods: dict[str, Callable[[Tensor], Ellipse]]
) -> None:
    """Rows of the table: images, what is in them, and which share of its outline is seen."""
    for method, detect in methods.items():
        right = wrong = missed = 0
        errors: list[float] = []
        seconds = 0.0
        for image, true, seen in scenes:
            start = time.process_time()
            found = detect(image)
            seconds += time.process_time() - start
            r, w, m, e = score(found, true, seen)
            right, wrong, missed, errors = right + r, wrong + w, missed + m, errors + e
        F = 2 * right / max(1, 2 * right + wrong + missed)
        q = torch.tensor(errors or [math.nan], dtype=F64).quantile(torch.tensor([0.5, 0.9], dtype=F64)).tolist()
        print(
            f"{name:24s} {noise:5}  {method:20s} {F:5.3f}  {right / max(1, right + wrong):8.3f} "
            f"{right / max(1, right + missed):7.3f}  {q[0]:21.3f} {q[1]:5.2f}  {seconds / len(scenes):9.3f}",
            flush=True,
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=20, help="of each kind and noise")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(options.seed)
    methods: dict[str, Callable[[Tensor], Ellipse]] = {"detect_ellipses": ours, **peers()}
    print(f"{'scenes':24s} noise  {'':20s}     F  precision recall  axis error px: median  90 %   s / image")
    folder = os.environ.get("TORCHSFM_DATA")
    if folder:
        real = photographs(Path(folder) / "calibration" / "circles")
        all_methods = methods | {"detect_ellipses, 0.9": lambda image: ours(image, 0.9)}
        scenes = [(image, e, torch.ones_like(e.angle)) for image, e in real]
        compare("photographs of circles", "", scenes, {name: but_round(detect) for name, detect in all_methods.items()})
    for name, kind in KINDS.items():
        for noise in (0.005, 0.03):
            drawn = [render_shapes((), noise=noise, generator=generator, **kind) for _ in range(options.scenes)]
            compare(name, f"{noise:5.3f}", [(d.images, d.ellipses, d.ellipses_seen) for d in drawn], methods)


if __name__ == "__main__":
    main()
