"""Calibration from chessboards and from grids of circles: both on rendered photographs, and what real circles are like.

`python -m bench.calibration`; the real ones are in the folder that TORCHSFM_DATA names. There the board only gives the start:
cameras and circles are then adjusted to the measured ellipses alone, without saying that circles are round, of one size, in one
plane or on a grid.
"""

import argparse
import os
from pathlib import Path

import torch
from torch import Tensor

from torchsfm import BundleProblem, Camera, Ellipse, Pose, Radial, Status, bundle_adjust, calibrate_planes, detect_ellipses
from torchsfm._types import tensor_map
from torchsfm.bundle import BundleConics
from torchsfm.geometry import Ellipsoid, intrinsics, rotation_from_rotvec
from torchsfm.images import detect_chessboard, detect_circles_grid, read_image
from torchsfm.simulation import render_board

F64 = torch.float64
FOCAL = 480.0
CIRCLES = 4, 3, 0.09
"""Circles in a row and in a column of the real board, and metres from one to the next."""


def rendered(sets: int, views: int, generator: torch.Generator) -> None:
    """Errors of K over sets of photographs, in pixels, and over their standard deviations."""
    print("rendered boards of 7 x 5, 640 x 480, k1 = -0.1: rms error px (over its standard deviation) of f, cx, cy")
    K = intrinsics(torch.tensor(FOCAL, dtype=F64), torch.tensor([325.0, 236.0], dtype=F64))
    camera = Camera(K, Radial(*torch.tensor([-0.1, 0.02], dtype=F64)))
    columns, rows = 7, 5
    middle = torch.tensor([(columns - 1) / 2, (rows - 1) / 2, 0.0], dtype=F64)
    X = torch.stack(torch.meshgrid(torch.arange(columns), torch.arange(rows), indexing="xy"), -1).reshape(-1, 2).to(F64)
    for noise in (0.005, 0.02):
        found: dict[str, list[Tensor]] = {"chessboard": [], "circles, r = 0.25": [], "circles, r = 0.42": []}
        for _ in range(sets):
            turns = torch.cat(
                (1.2 * torch.rand(views, 2, generator=generator, dtype=F64) - 0.6,
                 torch.rand(views, 1, generator=generator, dtype=F64) - 0.5), 1
            )  # fmt: skip
            R = rotation_from_rotvec(turns)
            away = torch.rand(views, 3, generator=generator, dtype=F64) * torch.tensor([2.0, 1.5, 3.0], dtype=F64)
            t = away + torch.tensor([-1.0, -0.75, 8.0], dtype=F64) - R @ middle
            for name, radius in zip(found, (None, 0.25, 0.42), strict=True):
                images = render_board(Pose(R, t), camera, columns, rows, radius=radius, noise=noise, generator=generator)
                if radius is None:
                    board = detect_chessboard(images, columns, rows)
                    result = calibrate_planes(board.x, X, image_size=(640, 480), visible=seen(board.found, X))
                else:
                    board = detect_circles_grid(images, columns, rows)
                    assert board.outlines is not None
                    assert board.radius is not None
                    size = float(board.radius[board.found].median())
                    visible = seen(board.found, X)
                    result = calibrate_planes(board.outlines, X, image_size=(640, 480), visible=visible, radius=size)
                if int(result.status) != Status.OK:
                    continue
                sigma = result.covariance.diagonal().sqrt()
                places = [result.parameter_names.index(p) for p in ("fx", "cx", "cy")]
                error = torch.stack([result.camera.K[0, 0] - FOCAL, *(result.camera.K[:2, 2] - K[:2, 2])])
                found[name].append(torch.stack((error, error / sigma[places])))
        for name, errors in found.items():
            rms = torch.stack(errors).square().mean(0).sqrt()
            cells = "  ".join(f"{float(a):.3f} ({float(b):.2f})" for a, b in rms.mT)
            print(f"  noise {noise}  {name:18}  {cells}  {len(errors)} of {sets} OK", flush=True)


def seen(found: Tensor, X: Tensor) -> Tensor:
    """Which points are visible."""
    return found[:, None].expand(-1, len(X))


def circles(folder: Path) -> None:
    """Radius, roundness, pitch and flatness of real circles from conics alone."""
    columns, rows, pitch = CIRCLES
    paths = sorted((folder / "calibration" / "circles").glob("*.jpg"))
    images = [read_image(path).pixels.double().mean(0, keepdim=True) for path in paths]
    boards = [detect_circles_grid(image, columns, rows) for image in images]
    assert all(bool(board.found) and board.outlines is not None and board.radius is not None for board in boards)
    X = pitch * torch.stack(torch.meshgrid(torch.arange(columns), torch.arange(rows), indexing="xy"), -1).reshape(-1, 2).to(F64)
    size = float(torch.stack([board.radius for board in boards if board.radius is not None]).median()) * pitch
    x = torch.stack([board.outlines for board in boards if board.outlines is not None])
    height, width = images[0].shape[-2:]
    start = calibrate_planes(x, X, image_size=(width, height), radius=size)
    K = start.camera.K
    focal = f"f {float(K[0, 0]):.2f}, {float(K[1, 1]):.2f}, rms {float(start.rms):.3f} px"
    print(f"\n{len(paths)} photographs of {columns} x {rows} circles: {focal}")
    ellipses, covariances, view, conic = [], [], [], []
    for i, image in enumerate(images):
        found = detect_ellipses(image)
        gap = torch.cdist(x[i], found.ellipse.centre)
        gap = torch.where(found.valid, gap, torch.inf)
        nearest = gap.argmin(1)
        for j in range(columns * rows):
            k = int(nearest[j])
            if float(gap[j, k]) < 3:
                ellipses.append(
                    torch.cat((found.ellipse.centre[k], found.ellipse.semi_axes[k], found.ellipse.angle[k : k + 1]))
                )
                covariances.append(found.covariance[k])
                view.append(i)
                conic.append(j)
    numbers = torch.stack(ellipses)
    n = columns * rows
    axes = size * torch.eye(3, dtype=F64)
    axes[2] = 0
    discs = Ellipsoid(torch.nn.functional.pad(X, (0, 1)), axes.expand(n, 3, 3).clone())
    seen_ellipses = Ellipse(numbers[:, :2], numbers[:, 2:4], numbers[:, 4])
    conics = BundleConics(discs, seen_ellipses, torch.tensor(view), torch.tensor(conic), torch.stack(covariances))
    nothing = torch.zeros(0, dtype=torch.int64)
    camera = tensor_map(lambda t: t[None], start.camera)
    none = torch.zeros(0, 3, dtype=F64)
    one = torch.zeros(len(paths), dtype=torch.int64)
    problem = BundleProblem(start.poses, camera, one, none, none[:, :2], nothing, nothing)
    result = bundle_adjust(problem, structure=[conics], tolerance=1e-10, max_iterations=200)
    (moved,) = result.structure
    assert isinstance(moved, BundleConics)
    centre, long = moved.model.centre, moved.model.axes.norm(dim=-1)[:, :2]
    grid = centre.reshape(rows, columns, 3)
    steps = torch.cat((grid.diff(dim=0).reshape(-1, 3), grid.diff(dim=1).reshape(-1, 3))).norm(dim=-1)
    scale = pitch / float(steps.mean())
    radius = scale * long
    flat = (centre - centre.mean(0)).svd().S[2] / n**0.5 * scale
    normal = torch.nn.functional.normalize(torch.linalg.cross(moved.model.axes[:, 0], moved.model.axes[:, 1]), dim=-1)
    common = torch.linalg.svd(normal).Vh[0]
    tilt = torch.rad2deg(torch.acos((normal @ common).abs().clamp_max(1)))
    spread = scale * float(steps.std())
    size_mm, round_ = 1e3 * radius, long[:, 0] / long[:, 1]
    print(
        f"  {len(view)} ellipses, {Status(int(result.status)).name}; where neighbours are {1e3 * pitch} mm apart in the mean:"
    )
    print(f"  radius {float(size_mm.mean()):.3f} mm, from {float(size_mm.min()):.3f} to {float(size_mm.max()):.3f}")
    print(f"  longer over shorter axis {float(round_.mean()):.5f}, at most {float(round_.max()):.5f}")
    print(
        f"  neighbours {1e3 * spread:.3f} mm rms off their mean distance, centres {1e3 * float(flat):.3f} mm rms off one plane"
    )
    print(
        f"  circles {float(tilt.square().mean().sqrt()):.3f} degrees rms off one plane, at most {float(tilt.max()):.3f}",
        flush=True,
    )


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=6)
    parser.add_argument("--views", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    folder = os.environ.get("TORCHSFM_DATA")
    if folder:
        circles(Path(folder))
    rendered(options.sets, options.views, torch.Generator().manual_seed(options.seed))


if __name__ == "__main__":
    main()
