"""Segments beside LSD: places on rendered squares, and how many are found again in photographs that a homography moves.

`python -m bench.segments`, with OpenCV's LSD and that of `pytlsd` where it is installed. The photographs are in the folder that
TORCHSFM_DATA names. Segments shorter than 20 pixels count nowhere.
"""

import argparse
import math
import os
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchsfm.images import detect_segments, hough_lines

F64 = torch.float64
PHOTOGRAPHS = (
    "vgg/model_house/images/house.000.pgm",
    "images/castle-P19/images/0000.jpg",
    "images/fountain-P11/images/0000.jpg",
    "images/sceaux_castle/100_7100.JPG",
)
WIDTH = 768
SHORTEST = 20.0
"""Pixels."""
SIDE, CONTRAST, BLUR = 52.0, 0.8, 0.6
"""Of rendered squares: their sides, and the standard deviation of the blur, in pixels."""
SHIFTS = {"OpenCV LSD": 0.125, "pytlsd": -0.625}
"""What takes their coordinates to ours, in which the centre of the first pixel is (0, 0): measured on the rendered squares. The
image that LSD looks at is smaller by a fifth."""


def ours(image: Tensor) -> Tensor:
    """Ours (n, 2, 2)."""
    found = detect_segments(image, 2000)
    return found.ends[found.valid]


def hough(image: Tensor) -> Tensor:
    """Ours by votes of edge points; for few long lines."""
    found = hough_lines(image, 8)
    return found.ends[found.valid]


def bytes_of(image: Tensor) -> NDArray[np.uint8]:
    """Grey values of an image (1, h, w)."""
    grey: NDArray[np.uint8] = (image[0] * 255).round().clamp(0, 255).to(torch.uint8).numpy()
    return grey


def peers() -> dict[str, Callable[[Tensor], Tensor]]:
    """What is installed of LSD."""
    lsd = cv2.createLineSegmentDetector()

    def opencv(image: Tensor) -> Tensor:
        found = lsd.detect(bytes_of(image))[0]
        return (
            torch.zeros(0, 2, 2, dtype=F64)
            if found is None
            else torch.tensor(found, dtype=F64).reshape(-1, 2, 2) + SHIFTS["OpenCV LSD"]
        )

    try:
        import pytlsd
    except ImportError:
        return {"OpenCV LSD": opencv}

    def original(image: Tensor) -> Tensor:
        found = pytlsd.lsd(bytes_of(image).astype(np.float64))
        return torch.tensor(found[:, :4], dtype=F64).reshape(-1, 2, 2) + SHIFTS["pytlsd"]

    return {"OpenCV LSD": opencv, "pytlsd": original}


def long(ends: Tensor) -> Tensor:
    """Segments that count."""
    return ends[(ends[:, 0] - ends[:, 1]).norm(dim=-1) >= SHORTEST]


def squares(count: int, generator: torch.Generator) -> None:
    """Worst and median angle and offset of the sides of rendered squares."""
    print("rendered squares  noise  angle deg: median  worst   offset px: median  worst   found")
    for noise in (0.0, 0.02):
        sides = [_square(generator) for _ in range(count)]
        images = [image + noise * torch.randn(image.shape, generator=generator, dtype=F64) for image, _ in sides]
        for name, detect in {"detect_segments": ours, "hough_lines": hough, **peers()}.items():
            errors, found = [], 0
            for image, (_, corners) in zip(images, sides, strict=True):
                best = _sides(detect(image), corners)
                errors += best
                found += len(best)
            angle, offset = (np.array(errors).T if errors else np.full((2, 1), np.nan)).tolist()
            print(
                f"{name:16}  {noise:5}  {np.median(angle):17.4f}  {max(angle):6.4f}  {np.median(offset):17.4f}  "
                f"{max(offset):6.4f}  {found}/{4 * count}"
            )

        if noise:
            angle, offset = _bounds(noise)
            # Of normal errors: the median, and what one of all is expected to exceed.
            middle, most = 0.6745, float(torch.special.ndtri(torch.tensor(1 - 1 / (8 * count), dtype=F64)))
            row = f"{middle * angle:17.4f}  {most * angle:6.4f}  {middle * offset:17.4f}  {most * offset:6.4f}"
            print(f"{'Cramer-Rao':16}  {noise:5}  {row}")


def _bounds(noise: float) -> tuple[float, float]:
    """The Cramer-Rao bound of a whole side's angle, in degrees, and of the offset of its middle, in pixels.

    A pixel at distance d from an edge of contrast h tells h N(d) of its place, N the density of the blur of lens and pixel: per
    pixel of length that is h^2 / (2 sqrt(pi) blur noise^2).
    """
    blur = (BLUR**2 + 1 / 12) ** 0.5
    information = CONTRAST**2 / (2 * math.sqrt(math.pi) * blur * noise**2)
    return math.degrees((12 / (information * SIDE**3)) ** 0.5), (information * SIDE) ** -0.5


def repeated(folder: Path, count: int, generator: torch.Generator) -> None:
    """Share of the segments of a photograph and of it under a homography that are found in the other one, and how near."""
    print("\nphotographs moved by homographies: segments an image, found again within 5 and 1 px, distance px, s / image")
    methods = {"detect_segments": ours, **peers()}
    totals: dict[str, list[tuple[float, ...]]] = {name: [] for name in methods}
    for path in PHOTOGRAPHS:
        grey = cv2.imread(str(folder / path), cv2.IMREAD_GRAYSCALE)
        size = WIDTH, round(grey.shape[0] * WIDTH / grey.shape[1])
        first = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        corners = np.array([[0, 0], [size[0] - 1, 0], [size[0] - 1, size[1] - 1], [0, size[1] - 1]], dtype=np.float32)
        for _ in range(count):
            shift = 0.15 * size[1] * (2 * torch.rand(4, 2, generator=generator) - 1)
            H = cv2.getPerspectiveTransform(corners, corners + shift.numpy())
            second = cv2.warpPerspective(first, H, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
            images = [torch.from_numpy(image / 255.0)[None] for image in (first, second)]
            for name, detect in methods.items():
                start = time.process_time()
                found = [long(detect(image)) for image in images]
                seconds = (time.process_time() - start) / 2
                totals[name].append((*_again(found, torch.from_numpy(H), size), seconds))
    for name, rows in totals.items():
        segments, five, one, distance, seconds = torch.tensor(rows, dtype=F64).mean(0).tolist()
        print(f"{name:16}  {segments:7.0f}  {five:.3f}  {one:.3f}  {distance:.3f}  {seconds:.3f}")


def _again(found: list[Tensor], H: Tensor, size: tuple[int, int]) -> tuple[float, float, float, float]:
    """Segments an image, shares found again, both ways, and the mean distance of those within 5 px."""
    shares, distances, number = [], [], 0
    for a, b, M in ((found[0], found[1], H), (found[1], found[0], torch.linalg.inv(H))):
        moved, back = _moved(a, M), _moved(b, torch.linalg.inv(M))
        limit = torch.tensor(size, dtype=F64) - 1
        inside = ((moved >= 0) & (moved <= limit)).flatten(1).all(1)
        visible = ((back >= 0) & (back <= limit)).flatten(1).all(1)
        moved, other = moved[inside], b[visible]
        number += len(moved)
        away = _apart(moved, other).amin(1) if len(other) else torch.full((len(moved),), torch.inf)
        shares.append([float((away < 5).double().mean()), float((away < 1).double().mean())])
        distances.append(away[away < 5])
    five, one = np.mean(shares, 0)
    return number / 2, float(five), float(one), float(torch.cat(distances).mean())


def _moved(ends: Tensor, H: Tensor) -> Tensor:
    h = torch.nn.functional.pad(ends, (0, 1), value=1.0) @ H.mT
    return h[..., :2] / h[..., 2:]


def _apart(a: Tensor, b: Tensor) -> Tensor:
    """Mean distance of the ends of each from the other's line (n, m); infinite where less than half of one is common."""

    def halves(p: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
        """Distances of ends of p (n) from the lines of q (m), and the common part of q."""
        d = torch.nn.functional.normalize(q[:, 1] - q[:, 0], dim=-1)
        rest = p[:, None] - q[None, :, None, 0]
        away = (rest[..., 0] * d[:, None, 1] - rest[..., 1] * d[:, None, 0]).abs().mean(-1)
        along = (rest * d[:, None]).sum(-1)
        length = (q[:, 1] - q[:, 0]).norm(dim=-1)
        return away, (torch.minimum(along.amax(-1), length) - along.amin(-1).clamp_min(0)).clamp_min(0)

    one, common = halves(a, b)
    two, other = (t.mT for t in halves(b, a))
    shorter = torch.minimum((a[:, 0] - a[:, 1]).norm(dim=-1)[:, None], (b[:, 0] - b[:, 1]).norm(dim=-1))
    return torch.where(torch.minimum(common, other) >= 0.5 * shorter, (one + two) / 2, torch.inf)


def _square(generator: torch.Generator, size: int = 96, fine: int = 6) -> tuple[Tensor, Tensor]:
    """A turned bright square with blurred sides, and its corners."""
    angle, *shift = torch.rand(3, generator=generator, dtype=F64).tolist()
    middle = torch.tensor([(size - 1) / 2 + 4 * s - 2 for s in shift], dtype=F64)
    along = (torch.arange(size * fine, dtype=F64) + 0.5) / fine - 0.5
    y, x = torch.meshgrid(along, along, indexing="ij")
    c, s = math.cos(2 * math.pi * angle), math.sin(2 * math.pi * angle)
    u, v = c * (x - middle[0]) + s * (y - middle[1]), -s * (x - middle[0]) + c * (y - middle[1])

    def slab(w: Tensor) -> Tensor:
        return 0.5 * (torch.erf((w + SIDE / 2) / (BLUR * 2**0.5)) - torch.erf((w - SIDE / 2) / (BLUR * 2**0.5)))

    image = (slab(u) * slab(v)).reshape(size, fine, size, fine).mean((1, 3))[None]
    square = SIDE / 2 * torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]], dtype=F64)
    turn = torch.tensor([[c, s], [-s, c]], dtype=F64)
    return 0.1 + CONTRAST * image, middle + square @ turn


def _sides(found: Tensor, corners: Tensor) -> list[tuple[float, float]]:
    """Angle in degrees and offset of the middle of the longest segment on each side."""
    errors = []
    for p, q in zip(corners, corners.roll(-1, 0), strict=True):
        d = torch.nn.functional.normalize(q - p, dim=-1)
        normal = torch.stack((-d[1], d[0]))
        away = ((found - p) * normal).sum(-1)
        e = torch.nn.functional.normalize(found[:, 1] - found[:, 0], dim=-1)
        length = torch.where((away.abs() < 2).all(-1), (found[:, 1] - found[:, 0]).norm(dim=-1), 0.0)
        if len(length) and float(length.max()) > 20:
            i = int(length.argmax())
            angle = math.degrees(math.asin(min(1.0, abs(float((e[i] * normal).sum())))))
            errors.append((angle, abs(float(away[i].mean()))))
    return errors


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--squares", type=int, default=30)
    parser.add_argument("--homographies", type=int, default=5, help="of each photograph")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(options.seed)
    squares(options.squares, generator)
    folder = os.environ.get("TORCHSFM_DATA")
    if folder:
        repeated(Path(folder), options.homographies, generator)


if __name__ == "__main__":
    main()
