"""`torchsfm calibrate` on photographs as users have them: blurred, covered, turned, mirrored, mixed up, of another board.

`python -m bench.odd_photographs [--only zoom] [--pattern circles]`: folders of ten rendered photographs, 640 x 480, of a board
of 9 x 6 points, focal length 480 px, principal point 5.5 and 3.5 px off the middle. For each folder how it ended, how many
photographs were used, how far off fx and cx are in pixels and in their standard deviations, by how much the photographs
disagree, and what was said.
"""

import argparse
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typer.testing import CliRunner

from torchsfm import Camera, Pose, Radial
from torchsfm.cli import app
from torchsfm.geometry import intrinsics, rotation_from_rotvec
from torchsfm.simulation import render_board

F64 = torch.float64
WIDTH, HEIGHT, VIEWS = 640, 480, 10
FOCAL, CENTRE = 480.0, (325.0, 236.0)
COLUMNS, ROWS = 9, 6
Image = NDArray[np.uint8]
Odd = Callable[[list[Image], np.random.Generator], list[Image]]


def same(images: list[Image], random: np.random.Generator) -> list[Image]:
    """Nothing odd."""
    return images


def blurred(sigma: float, every: int = 1) -> Odd:
    """Out of focus, each or every so many."""
    return lambda images, _: [cv2.GaussianBlur(a, (0, 0), sigma) if i % every == 0 else a for i, a in enumerate(images)]


def shaken(length: int) -> Odd:
    """By a camera that moves."""

    def moved(a: Image, random: np.random.Generator) -> Image:
        turn = cv2.getRotationMatrix2D((length / 2 - 0.5, length / 2 - 0.5), float(random.uniform(0, 180)), 1.0)
        line = np.zeros((length, length), np.float32)
        line[length // 2] = 1.0
        line = cv2.warpAffine(line, turn, (length, length))
        return cv2.filter2D(a, -1, line / line.sum())

    return lambda images, random: [moved(a, random) for a in images]


def covered(size: int, grey: int = 110) -> Odd:
    """A hand before the middle of every second photograph."""

    def hand(a: Image, random: np.random.Generator) -> Image:
        x, y = int(random.integers(200, 440)), int(random.integers(150, 330))
        return cv2.circle(a.copy(), (x, y), size, grey, -1, cv2.LINE_AA)

    return lambda images, random: [hand(a, random) if i % 2 else a for i, a in enumerate(images)]


def turned(quarters: int, which: slice) -> Odd:
    """By quarters."""

    def odd(images: list[Image], _: np.random.Generator) -> list[Image]:
        chosen = set(range(len(images))[which])
        return [np.ascontiguousarray(np.rot90(a, quarters)) if i in chosen else a for i, a in enumerate(images)]

    return odd


def mirrored(which: slice) -> Odd:
    """Left for right."""

    def odd(images: list[Image], _: np.random.Generator) -> list[Image]:
        chosen = set(range(len(images))[which])
        return [np.ascontiguousarray(a[:, ::-1]) if i in chosen else a for i, a in enumerate(images)]

    return odd


def cropped(images: list[Image], random: np.random.Generator) -> list[Image]:
    """Every second one is cut to nine tenths, somewhere, and enlarged to its former size."""
    out = []
    for i, a in enumerate(images):
        if i % 2:
            left, top = int(random.integers(0, 64)), int(random.integers(0, 48))
            part = a[top : top + 432, left : left + 576]
            out.append(np.asarray(cv2.resize(part, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), np.uint8))
        else:
            out.append(a)
    return out


def halved(images: list[Image], random: np.random.Generator) -> list[Image]:
    """Every second one is half as large."""
    return [cv2.resize(a, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) if i % 2 else a for i, a in enumerate(images)]


def walls(images: list[Image], random: np.random.Generator) -> list[Image]:
    """No board."""
    blocks = [cv2.resize(random.integers(0, 255, (12, 16)).astype(np.uint8), (WIDTH, HEIGHT)) for _ in images]
    return [np.asarray(a) for a in blocks]


def bright(images: list[Image], random: np.random.Generator) -> list[Image]:
    """Twice as bright as can be written, every second one."""
    return [np.clip(a.astype(np.float32) * 2.2, 0, 255).astype(np.uint8) if i % 2 else a for i, a in enumerate(images)]


@dataclass(frozen=True)
class Folder:
    """What is odd about it."""

    name: str
    odd: Odd = same
    boards: tuple[tuple[int, int], ...] = ((COLUMNS, ROWS),)
    """Of the photographs, in turn."""
    stretched: tuple[float, ...] = (1.0,)
    """How much longer rows are, in turn."""
    focal: tuple[float, ...] = (FOCAL,)
    centre: tuple[tuple[float, float], ...] = (CENTRE,)
    said: str = f"{COLUMNS}x{ROWS}"
    views: int = VIEWS
    tilt: float = 0.5
    spin: float = 0.4
    lens: tuple[float, float] = (-0.1, 0.02)
    true: tuple[float, float] = field(default=(FOCAL, CENTRE[0]))
    words: tuple[str, ...] = ()


FIRST, HALF, ALL = slice(0, 1), slice(0, None, 2), slice(None)
FOLDERS = (
    Folder("as it should be"),
    Folder("blur of 3 px", blurred(3.0)),
    Folder("blur of 6 px", blurred(6.0)),
    Folder("blur of 6 px, every third", blurred(6.0, 3)),
    Folder("shaken by 9 px", shaken(9)),
    Folder("half of them overexposed", bright),
    Folder("covered by a hand, every second", covered(40)),
    Folder("a spot of 6 px, every second", covered(6, 20)),
    Folder("squares counted, not corners: 10x7 said", said="10x7"),
    Folder("rows for columns: 6x9 said", said="6x9"),
    Folder("one row less said: 9x5", said="9x5"),
    Folder("one column less said: 8x6", said="8x6"),
    Folder("two less said: 7x4", said="7x4"),
    Folder("two more said: 11x8", said="11x8"),
    Folder("boards of 9x6 and 7x5", boards=((9, 6), (7, 5))),
    Folder("boards of 9x6 and 10x7, 9x6 said", boards=((9, 6), (10, 7))),
    Folder("two boards, the rows of one 20 % longer", stretched=(1.0, 1.2)),
    Folder("rows 20 % longer than columns", stretched=(1.2,)),
    Folder("rows 3 % longer than columns", stretched=(1.03,)),
    Folder("one photograph", views=1),
    Folder("one photograph, --free focal", views=1, words=("--free", "focal")),
    Folder("two photographs", views=2),
    Folder("three photographs", views=3),
    Folder("all from one direction, spun", tilt=0.0, spin=3.0),
    Folder("all from one direction, not spun", tilt=0.0, spin=0.0),
    Folder("all nearly from one direction: 0.02", tilt=0.02, spin=3.0),
    Folder("all nearly from one direction: 0.08", tilt=0.08, spin=3.0),
    Folder("one tilt, moved about", tilt=-0.4, spin=0.0),
    Folder("two zooms, 480 and 494", focal=(480.0, 494.0)),
    Folder("two zooms, 480 and 624", focal=(480.0, 624.0)),
    Folder("one of ten by another zoom", focal=(480.0,) * 9 + (600.0,)),
    Folder("two cameras, one centre 20 px off", centre=(CENTRE, (345.0, 250.0))),
    Folder("one turned by a half", turned(2, FIRST)),
    Folder("half of them turned by a half", turned(2, HALF)),
    Folder("all turned by a half", turned(2, ALL), true=(FOCAL, WIDTH - 1 - CENTRE[0])),
    Folder("three turned by a quarter", turned(1, slice(0, 3))),
    Folder("all turned by a quarter", turned(1, ALL), true=(FOCAL, CENTRE[1])),
    Folder("one mirrored", mirrored(FIRST)),
    Folder("half of them mirrored", mirrored(HALF)),
    Folder("all mirrored", mirrored(ALL), true=(FOCAL, WIDTH - 1 - CENTRE[0])),
    Folder("cropped and enlarged, every second", cropped),
    Folder("half the size, every second", halved),
    Folder("no board", walls),
)


def photographs(folder: Folder, circles: bool, seed: int) -> list[Image]:
    """Ten, or as many as there are to be."""
    g, random = torch.Generator().manual_seed(seed), np.random.default_rng(seed)
    images: list[Image] = []
    for i in range(folder.views):
        columns, rows = folder.boards[i % len(folder.boards)]
        f, stretch = folder.focal[i % len(folder.focal)], folder.stretched[i % len(folder.stretched)]
        middle = torch.tensor([(columns - 1) / 2 * stretch, (rows - 1) / 2, 0.0], dtype=F64)
        ends = torch.tensor([[-1.0, -1.0], [columns, -1.0], [-1.0, rows], [columns, rows]], dtype=F64)
        corners = torch.nn.functional.pad(ends * torch.tensor([stretch, 1.0], dtype=F64), (0, 1))
        K = intrinsics(torch.tensor(f, dtype=F64), torch.tensor(folder.centre[i % len(folder.centre)], dtype=F64))
        camera = Camera(K, Radial(*torch.tensor(folder.lens, dtype=F64)))
        while True:
            turn = (2 * torch.rand(3, generator=g, dtype=F64) - 1) * torch.tensor([1.0, 1.0, folder.spin], dtype=F64)
            turn[:2] *= max(folder.tilt, 0.0)
            if folder.tilt < 0:
                turn[:2] = torch.tensor([-folder.tilt, -folder.tilt], dtype=F64)
            R = rotation_from_rotvec(turn)
            depth = 9.5 * f / FOCAL * (1 + 0.4 * torch.rand((), generator=g, dtype=F64))
            aside = 0.25 * (2 * torch.rand(2, generator=g, dtype=F64) - 1) * torch.tensor([WIDTH, HEIGHT], dtype=F64) / f
            t = torch.cat((depth * aside, depth[None])) - R @ middle
            x = camera.project(corners @ R.mT + t)
            if bool(((x > 3) & (x < torch.tensor([WIDTH - 4.0, HEIGHT - 4.0], dtype=F64))).all()):
                break
        A = R * torch.tensor([stretch, 1.0, 1.0], dtype=F64)
        images.append(_rendered(A, t, camera, columns, rows, circles, g))
    return [np.ascontiguousarray(a) for a in folder.odd(images, random)]


def _rendered(A: Tensor, t: Tensor, camera: Camera, columns: int, rows: int, circles: bool, g: torch.Generator) -> Image:
    """A board whose rows may be longer: the plane, not the camera, is what `A` stretches."""
    R = torch.nn.functional.normalize(A, dim=0)
    stretch = float(A[:, 0].norm())
    radius = 0.3 if circles else None
    if stretch == 1.0:
        image = render_board(Pose(R[None], t[None]), camera, columns, rows, radius=radius, fine=3, generator=g)[0, 0]
        return (image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    # Looked up in a large picture of the board seen from the front.
    scale, margin = 40, 2
    width, height = (columns - 1 + 2 * margin) * scale, (rows - 1 + 2 * margin) * scale
    depth = 10.0
    K = intrinsics(torch.tensor(scale * depth, dtype=F64), torch.tensor([margin * scale, margin * scale], dtype=F64))
    front = Pose(torch.eye(3, dtype=F64)[None], torch.tensor([[0.0, 0.0, depth]], dtype=F64))
    flat = render_board(front, Camera(K), columns, rows, radius=radius, width=width, height=height, noise=0.0, fine=2)[0, 0]
    y, x = torch.meshgrid(torch.arange(2 * HEIGHT, dtype=F64), torch.arange(2 * WIDTH, dtype=F64), indexing="ij")
    d, _ = camera.unproject((torch.stack((x, y), -1).reshape(-1, 2) - 0.5) / 2)
    H = torch.linalg.inv(torch.stack((A[:, 0], A[:, 1], t), -1))
    X = d @ H.mT
    X = scale * (X[:, :2] / X[:, 2:] + margin)
    where = X.reshape(2 * HEIGHT, 2 * WIDTH, 2).to(torch.float32).numpy()
    fine = cv2.remap(flat.to(torch.float32).numpy(), where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderValue=0.45)
    image = torch.from_numpy(cv2.resize(fine, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA))
    image = image + 0.005 * torch.randn(image.shape, generator=g)
    return (image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def calibrated(folder: Folder, circles: bool, seed: int) -> str:
    """One line on one folder."""
    with tempfile.TemporaryDirectory() as place:
        given, out = Path(place) / "photographs", Path(place) / "out"
        given.mkdir()
        for i, image in enumerate(photographs(folder, circles, seed)):
            cv2.imwrite(str(given / f"photo{i:02}.png"), image)
        pattern = "circles" if circles else "chessboard"
        words = ["calibrate", str(given), "--out", str(out), "--board", folder.said, "--pattern", pattern, "--previews", "0"]
        result = CliRunner().invoke(app, words + list(folder.words))
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            return f"CRASH {result.exception!r}"
        lines = [line for line in result.stderr.strip().splitlines() if line.startswith("torchsfm: ")]
        report = out / "calibration.json"
        if not report.exists():
            return f"exit {result.exit_code}: {' '.join(lines)}"
        record = json.loads(report.read_text())
    used = sum(p["used"] for p in record["photographs"])
    cells = [f"exit {result.exit_code}, {record['status']}, {used} used, {record['camera']}"]
    for name, true in zip(("fx", "cx"), folder.true, strict=True):
        entry = record["intrinsics"][name]
        off, sigma = entry["value"] - true, entry["sigma"]
        cells.append(f"{name} {off:+.2f}" + (f" ({off / sigma:+.1f})" if sigma else ""))
    problems = sorted({p["problem"] for p in record["photographs"] if p["problem"]})
    return " | ".join((*cells, f"{record['disagreement']:.1f}", " ".join(record["remarks"]), "; ".join(problems)))


def main() -> None:
    """Print all folders."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="")
    parser.add_argument("--pattern", choices=("chessboard", "circles"), default="chessboard")
    parser.add_argument("--seeds", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for folder in FOLDERS:
        if options.only in folder.name:
            for seed in range(options.seeds):
                print(folder.name, calibrated(folder, options.pattern == "circles", seed), sep=" | ", flush=True)


if __name__ == "__main__":
    main()
