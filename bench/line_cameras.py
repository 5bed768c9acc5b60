"""Poses of cameras from lines, and from points and lines, of which many are wrong, beside PoseLib on the same data.

`python -m bench.line_cameras` prints the tables; one thread, seconds of the processor. It needs the folder that TORCHSFM_DATA
names.
"""

import argparse
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsfm import Status
from torchsfm.formats import read_vgg
from torchsfm.geometry import (
    krt_from_camera,
    pluecker_from_points,
    point_depths,
    point_line_distance,
    project_lines,
    project_points,
    rotation_angle,
)
from torchsfm.resection import estimate_camera

F64 = torch.float64
THRESHOLD = 3.0
QUERIES = (1, 2)
BAD = (5.0, 0.1)
"""Degrees, and distances of the camera from the structure, beyond which a pose is called lost."""


@dataclass(frozen=True)
class View:
    """What one image shows of points and lines of the world."""

    x: Tensor
    X: Tensor
    l: Tensor  # noqa: E741
    ends: Tensor
    K: Tensor
    pose: Tensor


def oxford(folder: Path, name: str) -> Iterator[View]:
    """The views of a sequence, in a world that is in front of them."""
    data = read_vgg(folder / "vgg" / name)
    for i in range(len(data.P)):
        seen, lines = data.visible[i], data.segments_visible[i]
        P, X, L = data.P[i], data.X[seen], data.L[lines]
        if float(point_depths(P, L.flatten(0, 1)).median()) < 0:
            # A mirrored world, seen the right way round.
            P, X, L = P * P.new_tensor([1.0, 1, 1, -1]), -X, -L
        K, R, t = krt_from_camera(P)
        yield View(data.x[i, seen], X, data.segments[i, lines], L, K, torch.cat((R, t[:, None]), 1))


def spoiled(view: View, share: float, generator: torch.Generator) -> View:
    """With a share of the image points and of the segments exchanged among each other."""

    def mixed(x: Tensor) -> Tensor:
        chosen = torch.randperm(len(x), generator=generator)[: round(share * len(x))]
        x = x.clone()
        x[chosen] = x[chosen.roll(1)]
        return x

    return View(mixed(view.x), view.X, mixed(view.l), view.ends, view.K, view.pose)


def ours(view: View, points: bool, threshold: float) -> tuple[Tensor, bool]:
    """The pose, and whether it is called good."""
    n = len(view.x) if points else 0
    L = pluecker_from_points(view.ends[:, 0], view.ends[:, 1])
    found = estimate_camera(
        view.x[:n], view.X[:n], view.K, view.l, L, threshold=threshold, generator=torch.Generator().manual_seed(0)
    )  # fmt: skip
    return found.model, bool(found.status == Status.OK)


def poselib(view: View, points: bool, threshold: float) -> tuple[Tensor, bool]:
    """The same of PoseLib."""
    import poselib

    n = len(view.x) if points else 0
    (fx, _, cx), (_, fy, cy), _ = view.K.tolist()
    camera = {"model": "PINHOLE", "width": int(2 * cx), "height": int(2 * cy), "params": [fx, fy, cx, cy]}
    both = {"max_reproj_error": threshold, "max_epipolar_error": threshold}
    pose, report = poselib.estimate_absolute_pose_pnpl(
        view.x[:n].numpy(), view.X[:n].numpy(), *(view.l[:, j].numpy() for j in (0, 1)),
        *(view.ends[:, j].numpy() for j in (0, 1)), camera, both, {},
    )  # fmt: skip
    return torch.tensor(np.asarray(pose.Rt)), bool(report["num_inliers"] > 3)


PROGRAMS: dict[str, Any] = {"torchsfm": ours, "PoseLib": poselib}


def errors(pose: Tensor, view: View) -> tuple[float, float]:
    """Degrees, and the distance of the centres over that of the camera from the middle of the structure."""
    centre, truth = (-P[:, :3].mT @ P[:, 3] for P in (pose, view.pose))
    away = float((truth - view.ends.flatten(0, 1).median(0).values).norm())
    return float(torch.rad2deg(rotation_angle(pose[:, :3] @ view.pose[:, :3].mT))), float((centre - truth).norm()) / away


def sequences(folder: Path, repeats: int, generator: torch.Generator) -> None:
    """Median and 95 % quantile over views and repetitions, and the share of lost poses."""
    print(
        "\nOxford lines    wrong  with    program   rotation deg: median   95 %  centre/distance: median     95 %  lost    ms"
    )
    for name in ("model_house", "corridor", "merton1", "library"):
        views = list(oxford(folder, name))
        for share in (0.3, 0.5, 0.7):
            tried = [spoiled(view, share, generator) for view in views for _ in range(repeats)]
            for points in (False, True):
                for program, solve in PROGRAMS.items():
                    start = time.process_time()
                    found = [solve(view, points, THRESHOLD)[0] for view in tried]
                    seconds = (time.process_time() - start) / len(tried)
                    turn, shift = np.array([errors(P, view) for P, view in zip(found, tried, strict=True)]).T
                    lost = ((turn > BAD[0]) | (shift > BAD[1])).mean()
                    what = "both" if points else "lines"
                    (a, c), (b, d) = (np.quantile(v, (0.5, 0.95)) for v in (turn, shift))
                    print(
                        f"{name:14}  {share:5.0%}  {what:6}  {program:8}  {a:20.4f}  {c:6.3f}  {b:23.5f}  {d:7.4f}  "
                        f"{lost:5.1%}  {1e3 * seconds:5.1f}"
                    )


def stairs(folder: Path, repeats: int) -> None:
    """Two queries of which three quarters of the matches are wrong: worst and median errors over shuffled data."""
    print("\nStairs   threshold  program   rotation deg: median  worst   centre cm: median  worst")
    for query in QUERIES:
        view = query_view(folder, query)
        truth = view.pose
        for threshold in (3.0, 6.0, 12.0):
            for program, solve in PROGRAMS.items():
                result = []
                for repeat in range(repeats):
                    every, _ = parted(view, 1.0, repeat)
                    pose, _ = solve(every, True, threshold)
                    turn = float(torch.rad2deg(rotation_angle(pose[:, :3] @ truth[:, :3].mT)))
                    centre, right = (-P[:, :3].mT @ P[:, 3] for P in (pose, truth))
                    result.append((turn, 100 * float((centre - right).norm())))
                (a, b), (c, d) = np.median(result, 0), np.max(result, 0)
                print(f"query {query}  {threshold:9}  {program:8}  {a:20.3f}  {c:5.3f}  {b:18.2f}  {d:5.2f}")


def held_out(folder: Path, repeats: int) -> None:
    """The same queries without their reference: poses from half of the data, judged by the other half.

    A program's figure is the logarithm of the likelihood of the other half, Gaussian noise among evenly spread outliers, over
    that of outliers alone; the share and the noise, of points and of lines, are the likeliest for each pose.
    """
    print("\nStairs   threshold  log-likelihood of the half held out: torchsfm  PoseLib  the reference  torchsfm over PoseLib")
    for query in QUERIES:
        view = query_view(folder, query)
        for threshold in (3.0, 6.0, 12.0):
            rows = []
            for repeat in range(repeats):
                own, other = parted(view, 0.5, repeat)
                poses = [solve(own, True, threshold)[0] for solve in PROGRAMS.values()]
                rows.append([likelihood(other, pose) for pose in (*poses, view.pose)])
            table = np.array(rows)
            gain, (a, b, c) = table[:, 0] - table[:, 1], np.median(table, 0)
            low, middle, high = np.quantile(gain, (0.25, 0.5, 0.75))
            print(
                f"query {query}  {threshold:9}  {a:46.1f}  {b:7.1f}  {c:13.1f}  {middle:6.1f} ({low:.1f} to {high:.1f}), "
                f"more in {(gain > 0).mean():.0%}",
                flush=True,
            )


def query_view(folder: Path, query: int) -> View:
    """A photograph of the stairs, and the pose that is its reference."""
    data = np.load(folder / "absolute_pose" / "stairs_points_lines" / f"localization_test_data_stairs_{query}.npz")
    x, X, l, K = (torch.tensor(data[k].astype(np.float64)) for k in ("p2ds", "p3ds", "l2ds", "K"))  # noqa: E741
    ends = torch.tensor(data["l3ds"].astype(np.float64))[torch.tensor(data["l3d_ids"].astype(np.int64))]
    pose = torch.cat((torch.tensor(data["R_gt"]).double(), torch.tensor(data["t_gt"]).double()[:, None]), 1)
    return View(x, X, l, ends, K, pose)


def parted(view: View, share: float, seed: int) -> tuple[View, View]:
    """A share of points and lines, and the others, in an order that follows from a seed."""
    g = torch.Generator().manual_seed(seed)
    i, j = (torch.randperm(len(t), generator=g) for t in (view.x, view.l))
    a, b = round(share * len(i)), round(share * len(j))
    first, rest = (
        View(view.x[p], view.X[p], view.l[q], view.ends[q], view.K, view.pose) for p, q in ((i[:a], j[:b]), (i[a:], j[b:]))
    )
    return first, rest


def likelihood(view: View, pose: Tensor) -> float:
    """The logarithm of the likelihood of what a view shows, over that of outliers alone."""
    P = view.K @ pose
    away = (project_points(P, view.X) - view.x).square().sum(-1)
    square = torch.where(point_depths(P, view.X) > 0, away, torch.inf)
    images = project_lines(P, pluecker_from_points(view.ends[:, 0], view.ends[:, 1]))
    of_lines = point_line_distance(view.l, images[:, None]).square().sum(-1)
    area = float(4 * view.K[0, 2] * view.K[1, 2])
    noise = torch.logspace(-0.3, 1.2, 16, dtype=F64)[:, None, None] ** 2
    share = torch.linspace(0.02, 0.7, 35, dtype=F64)[:, None]
    total = 0.0
    for s in (square, of_lines):
        density = area * torch.exp(-s / (2 * noise)) / (2 * torch.pi * noise)
        total += float(torch.log1p(share * (density - 1)).sum(-1).max())
    return total


def staircase(noise: float, wrong: float, generator: torch.Generator) -> View:
    """A drawn flight of 14 steps, seen from below, with points, edges of steps and joints of the risers.

    Of what is wrong half is matched to the same place of another step, the others to anything.
    """

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=F64)

    rise, tread, width, steps = 0.17, 0.28, 1.6, 14
    along = torch.tensor([0.0, rise, tread], dtype=F64)

    def on_steps(place: Tensor, number: Tensor) -> Tensor:
        return place + number[..., None].to(F64) * along

    n, k = 600, 120
    # Places on the riser or the tread of a step, edges along it, and joints of tiles up it.
    s, on_riser = uniform(n, 2), uniform(n, 1) < 0.5
    zero = torch.zeros(n, 1, dtype=F64)
    across = (s[:, :1] - 0.5) * width
    place = torch.where(
        on_riser, torch.cat((across, s[:, 1:] * rise, zero), 1), torch.cat((across, zero + rise, s[:, 1:] * tread), 1)
    )
    low = (uniform(k, 1) - 0.5) * width
    edge, zero = uniform(k, 1) < 0.6, zero[:k]
    height = torch.where(uniform(k, 1) < 0.5, 0.0, rise)
    first = torch.cat((low, torch.where(edge, height, zero), zero), 1)
    last = torch.cat(
        (torch.where(edge, (low + 0.7 * width).clamp(max=width / 2), low), torch.where(edge, height, zero + rise), zero), 1
    )
    points, lines = torch.randint(steps, (n,), generator=generator), torch.randint(steps, (k,), generator=generator)
    X, ends = on_steps(place, points), on_steps(torch.stack((first, last), 1), lines[:, None].expand(k, 2))
    # A camera before the flight that looks up it, x to the right and y down.
    centre = torch.tensor([0.0, 1.5, -2.5], dtype=F64) + 0.4 * (uniform(3) - 0.5)
    z = torch.nn.functional.normalize(6 * along + torch.tensor([0.0, 0.2, 0.0]).double() - centre, dim=0)
    x = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, -1, 0], dtype=F64) + 0.1 * uniform(3), z), dim=0)
    R = torch.stack((x, torch.linalg.cross(z, x), z))
    pose = torch.cat((R, -(R @ centre)[:, None]), 1)
    K = torch.tensor([[525.0, 0, 320], [0, 525, 240], [0, 0, 1]], dtype=F64)
    seen = project_points(K @ pose, X) + noise * torch.randn(n, 2, generator=generator, dtype=F64)
    l = project_points(K @ pose, ends) + noise * torch.randn(k, 2, 2, generator=generator, dtype=F64)  # noqa: E741

    def spoil(X: Tensor, number: Tensor) -> Tensor:
        chosen = torch.randperm(len(X), generator=generator)[: round(wrong * len(X))]
        half = len(chosen) // 2
        X = X.clone()
        other = (number[chosen[:half]] + torch.randint(1, steps, (half,), generator=generator)) % steps
        shift = (other - number[chosen[:half]]).to(F64)[:, None] * along
        X[chosen[:half]] += shift.reshape(half, *[1] * (X.ndim - 2), 3)
        X[chosen[half:]] = X[chosen[half:].roll(1)]
        return X

    return View(seen, spoil(X, points), l, spoil(ends, lines), K, pose)


def drawn_stairs(count: int, generator: torch.Generator) -> None:
    """Flights of stairs whose cameras are known: median and 95 % quantile of the errors."""
    print("\nDrawn stairs   wrong  threshold  program   rotation deg: median   95 %  centre/distance: median     95 %     ms")
    for wrong in (0.5, 0.75, 0.85):
        views = [staircase(1.0, wrong, generator) for _ in range(count)]
        for threshold in (3.0, 6.0, 12.0):
            for program, solve in PROGRAMS.items():
                start = time.process_time()
                found = [solve(view, True, threshold)[0] for view in views]
                ms = 1e3 * (time.process_time() - start) / count
                every = np.array([errors(P, view) for P, view in zip(found, views, strict=True)])
                (a, b), (c, d) = np.quantile(every, (0.5, 0.95), axis=0)
                print(
                    f"{wrong:19.0%}  {threshold:9}  {program:8}  {a:20.4f}  {c:6.3f}  {b:23.5f}  {d:7.5f}  {ms:5.1f}",
                    flush=True,
                )


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    folder = Path(os.environ["TORCHSFM_DATA"])
    drawn_stairs(20 * options.repeats, torch.Generator().manual_seed(options.seed))
    stairs(folder, options.repeats)
    held_out(folder, 4 * options.repeats)
    sequences(folder, options.repeats, torch.Generator().manual_seed(options.seed))


if __name__ == "__main__":
    main()
