"""Lines and poses from lines: accuracy against the bounds, recall against PoseLib.

`python -m bench.lines` prints the tables; one thread, seconds of the processor. Real lines are those of the Oxford sequences,
of the folder that TORCHSFM_DATA names.
"""

import argparse
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsfm import Solutions, Status
from torchsfm.formats import read_vgg
from torchsfm.geometry import (
    pluecker_from_points,
    point_line_distance,
    project_lines,
    project_points,
    random_rotation,
    rotvec_from_rotation,
)
from torchsfm.resection import camera_1p2l, camera_2p1l, camera_3l
from torchsfm.triangulation import triangulate_lines

F64 = torch.float64
SIGMA = 0.5
STORED = {"model_house": 0.565, "corridor": 0.309, "merton1": 0.627, "library": 0.697}
SOLVERS = {"camera_2p1l": (2, "p2p1ll"), "camera_1p2l": (1, "p1p2ll"), "camera_3l": (0, "p3ll")}


def steps(L: Tensor, M: Tensor) -> Tensor:
    """The step of `Line3D` from each L to M."""

    def frame(L: Tensor) -> tuple[Tensor, Tensor]:
        u1, u2 = (torch.nn.functional.normalize(v, dim=-1) for v in (L[..., 3:], L[..., :3]))
        angle = torch.atan2(L[..., :3].norm(dim=-1), L[..., 3:].norm(dim=-1))
        return torch.stack((u1, u2, torch.linalg.cross(u1, u2)), -1), angle

    (U, a), (V, b) = frame(L), frame(M)
    return torch.cat((rotvec_from_rotation(U.mT @ V), (b - a)[..., None]), -1)


def scene(views: int, lines: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Segments (views, lines, 2, 2) of at least 60 pixels, cameras and the segments' ends in space."""

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=F64)

    ahead = torch.tensor([0.0, 0.0, 6.0], dtype=F64)
    centre = normal(views, 3)
    z = torch.nn.functional.normalize(ahead + 0.3 * normal(views, 3) - centre, dim=-1)
    x = torch.nn.functional.normalize(torch.linalg.cross(normal(views, 3), z), dim=-1)
    R = torch.stack((x, torch.linalg.cross(z, x), z), -2)
    K = torch.tensor([[800.0, 0, 500], [0, 800, 400], [0, 0, 1]], dtype=F64)
    P = K @ torch.cat((R, -R @ centre[..., None]), -1)
    X = normal(40 * lines, 2, 3) + ahead
    ends = project_points(P[:, None], X)
    long = ((ends[:, :, 0] - ends[:, :, 1]).norm(dim=-1) > 60).all(0).nonzero()[:lines, 0]
    return ends[:, long], P, X[long]


def triangulation(generator: torch.Generator) -> None:
    """Squared errors over the Cramer-Rao bound, normalised errors (4 wanted), lines a second."""
    print(f"triangulate_lines, {SIGMA} px at each end\nviews  start/bound  refined/bound  normalised error  lines/s")
    for views in (3, 4, 6, 8):
        ends, P, X = scene(views, 20, generator)
        weights = torch.full(ends.shape[:2], SIGMA**-2, dtype=F64)
        noisy = ends + SIGMA * torch.randn((500, *ends.shape), generator=generator, dtype=F64)
        truth = triangulate_lines(ends, P, weights=weights)
        ratios = []
        for iterations in (0, 30):
            start = time.process_time()
            found = triangulate_lines(noisy, P, weights=weights, max_iterations=iterations)
            seconds = time.process_time() - start
            e = steps(truth.model.expand_as(found.model), found.model)
            square = (e * torch.linalg.solve(truth.covariance, e[..., None])[..., 0]).sum(-1)
            ratios.append(float(square.mean(0).median()) / 4)
        L = pluecker_from_points(X[:, 0], X[:, 1])
        L = L / L[:, :3].norm(dim=-1, keepdim=True)
        e = steps(found.model, L.expand_as(found.model))
        square = (e * torch.linalg.solve(found.covariance, e[..., None])[..., 0]).sum(-1)
        normalised = float(square.mean(0).median())
        print(f"{views:5}  {ratios[0]:11.3f}  {ratios[1]:13.3f}  {normalised:16.3f}  {found.status.numel() / seconds:7.0f}")


def oxford(folder: Path) -> None:
    """Root-mean-square distances of measured ends, as published and refined."""
    print("\nOxford lines    stored px  ours px  found")
    for name in STORED:
        data = read_vgg(folder / "vgg" / name)
        found = triangulate_lines(data.segments, data.P, visible=data.segments_visible)

        def error(L: Tensor, data: Any = data) -> float:
            away = point_line_distance(data.segments, project_lines(data.P, L)[..., None, :])
            return float(away[data.segments_visible].square().mean().sqrt())

        stored = error(pluecker_from_points(data.L[:, 0], data.L[:, 1]))
        # The cameras of two of the sets have everything behind them.
        good = (found.status == Status.OK) | (found.status == Status.BEHIND)
        print(f"{name:14}  {stored:9.3f}  {error(found.model):7.3f}  {int(good.sum())}/{len(good)}")


def poses(count: int, generator: torch.Generator) -> None:
    """Recall at 1e-6, solutions and microseconds a problem, by family."""
    print("\nposes        family    recall  PoseLib  solutions  us     PoseLib us")
    for name, (points, peer) in SOLVERS.items():
        for family in ("general", "coplanar", "parallel"):
            d, X, l, L, P = _sample(count, points, family, generator)  # noqa: E741
            start = time.process_time()
            found = _solve(points, d, X, l, L)
            ours = (time.process_time() - start) / count
            gap = (found.model - P[:, None]).norm(dim=(-1, -2)) / P.norm(dim=(-1, -2))[:, None]
            hit = (torch.where(found.valid, gap, torch.inf).amin(-1) < 1e-6).double().mean()
            theirs = _poselib(peer, points, d, X, l, L, P)
            share, seconds = (f"{theirs[0]:.5f}", f"{1e6 * theirs[1]:.1f}") if theirs else ("", "")
            mean = found.valid.sum(-1).double().mean()
            print(f"{name:11}  {family:8}  {hit:.5f}  {share:7}  {mean:9.2f}  {1e6 * ours:5.1f}  {seconds}")


def _solve(points: int, d: Tensor, X: Tensor, l: Tensor, L: Tensor) -> Solutions[Tensor]:  # noqa: E741
    if points == 0:
        return camera_3l(l, L)
    return (camera_1p2l if points == 1 else camera_2p1l)(d, X, l, L)


def _sample(n: int, k: int, family: str, generator: torch.Generator) -> tuple[Tensor, ...]:
    """Rays, points, normals of planes of sight, lines and poses; of three parallel lines two, for three leave a shift open."""

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=F64)

    Y = torch.cat((0.6 * (2 * uniform(n, 6, 2) - 1), torch.ones(n, 6, 1, dtype=F64)), -1) * (1 + 9 * uniform(n, 6, 1))
    if family == "coplanar":
        normal = torch.cat((2 * uniform(n, 2, 1) - 1, torch.ones(n, 1, 1, dtype=F64)), 1)
        Y = Y * 5 / (Y @ normal).abs()
    a, b = Y[:, :3], Y[:, 3:]
    if family == "parallel":
        b = torch.cat((b[:, :1], a[:, 1:] + uniform(n, 1, 3) - 0.5), 1) if k == 0 else a + uniform(n, 1, 3) - 0.5
    R, t = random_rotation(n, generator=generator, dtype=F64), torch.randn(n, 3, generator=generator, dtype=F64)
    X, Z = ((v - t[:, None]) @ R for v in (a, b))
    L = pluecker_from_points(X, Z)
    return a[:, :k], X[:, :k], torch.linalg.cross(a, b)[:, k:], L[:, k:], torch.cat((R, t[..., None]), -1)


def _poselib(
    name: str,
    k: int,
    d: Tensor,
    X: Tensor,
    l: Tensor,  # noqa: E741
    L: Tensor,
    P: Tensor,
    most: int = 2000,
) -> tuple[float, float] | None:
    """Recall and seconds a problem, calls from Python included."""
    try:
        import poselib
    except ImportError:
        return None
    d, l, V = (torch.nn.functional.normalize(v, dim=-1) for v in (d, l, L[..., :3]))  # noqa: E741
    A = torch.linalg.cross(V, L[..., 3:] / L[..., :3].norm(dim=-1, keepdim=True))
    arrays = [v[:most].numpy() for v in ((d, X, l, A, V) if k else (l, A, V))]
    solve, hits, seconds = getattr(poselib, name), 0, 0.0
    for i in range(len(arrays[0])):
        start = time.process_time()
        found = solve(*(v[i] for v in arrays))
        seconds += time.process_time() - start
        truth = P[i].numpy()
        hits += any(np.linalg.norm(pose.Rt - truth) < 1e-6 * np.linalg.norm(truth) for pose in found)
    return hits / len(arrays[0]), seconds / len(arrays[0])


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(options.seed)
    triangulation(generator)
    folder = os.environ.get("TORCHSFM_DATA")
    if folder:
        oxford(Path(folder))
    poses(options.poses, generator)


if __name__ == "__main__":
    main()
