"""Cameras from curves alone: how far they are off, against the bound of what normal distances tell.

`python -m bench.curve_cameras` prints the tables: random bent rings in six images with noise, beside the alternation of
factorisation and foot points; and the analytic curves of synthcurves (Fabbri & Kimia, IJCV 2016) in the folder that
TORCHSFM_DATA names, with the focal length that they lead to. With `--exact 100` it is a hundred such rings without noise
instead, a thousand points each, and how many of them are found exactly; `--unknown` hides where image curves begin and which
way they run, `--seeds 3 8-11` does only those scenes. An error is how far true points in correspondence are from the nearest
that the cameras found could see, root mean square in pixels; the bound is that of Cramer and Rao for it.

The model of the bound: of each measured point the distance along the normal of the exact image curve is known up to noise, and
the points of all images are of the same samples of space curves; of a sample the two coordinates across its curve are unknown,
as are all cameras. Where along curves points are measured does not matter as long as they are dense. That space curves are
smooth helps most against what changes from one sample to the next, which is not what cameras do; what little else it tells is
how errors come below the bound. Normals are not known to an estimator, which costs some where points are few or noise is large
against their distances. From the true
cameras, samples of exact image curves moved by interpolated noise end at it if there are several for each measured point (where
there are as many, .2 to .6 above it), and so do splines through all measured points.
"""

import argparse
import math
import os
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchsfm import Status
from torchsfm.autocalibration import Assumption, autocalibrate_curves
from torchsfm.autocalibration.camera_information import camera_information
from torchsfm.geometry import (
    Curve,
    camera_from_krt,
    curve_from_samples,
    foot_points,
    from_homogeneous,
    intrinsics,
    project_points,
    rotation_from_rotvec,
    to_homogeneous,
)
from torchsfm.motion import factorize_curves, factorize_points
from torchsfm.triangulation import triangulate_points_dlt

F64 = torch.float64
ROUNDS = 20
"""Of the alternation."""
STEPS = 4
"""Of points to where they fit best."""
SHARP, RIGHT = 1e-6, 1e-3
"""Root mean square distance of samples that are found exactly, and the largest error of right cameras, in pixels."""


def rings(c: int, n: int, generator: torch.Generator) -> Tensor:
    """Bent rings of about one unit, (c, n, 3)."""
    t = torch.arange(n, dtype=F64) * (2 * math.pi / n)
    waves = torch.stack([w for k in (1, 2, 3) for w in ((k * t).cos() / k**2, (k * t).sin() / k**2)], -1)
    bends = torch.randn(c, 6, 3, generator=generator, dtype=F64)
    bends = 1.5 * bends / bends.square().sum((-2, -1), keepdim=True).sqrt()
    return waves @ bends + 0.7 * torch.randn(c, 1, 3, generator=generator, dtype=F64)


def cameras(v: int, arc: float, generator: torch.Generator) -> Tensor:
    """On an arc of so many degrees, ten units away, turned a little."""
    turn = torch.linspace(-0.5, 0.5, v, dtype=F64)[:, None] * math.radians(arc) * torch.tensor([0.0, 1.0, 0.0], dtype=F64)
    own = rotation_from_rotvec(0.15 * torch.randn(v, 3, generator=generator, dtype=F64))
    K = intrinsics(torch.tensor(800.0, dtype=F64), torch.tensor([320.0, 240.0], dtype=F64))
    t = torch.tensor([0.0, 0.0, 10.0], dtype=F64) + 0.3 * torch.randn(v, 3, generator=generator, dtype=F64)
    return camera_from_krt(K, own @ rotation_from_rotvec(turn), t)


def transfer(P: Tensor, x: Tensor) -> float:
    """How far points in correspondence (v, n, 2) are from the nearest that cameras could see, root mean square."""
    X = triangulate_points_dlt(x, P, homogeneous=True)
    for _ in range(STEPS):
        # Gauss-Newton steps: where algebraic distances are least, a few per cent more is left.
        y = from_homogeneous(X @ P.mT)[0]
        depth = (X @ P.mT)[..., 2, None, None]
        J = ((P[:, None, :2] - y[..., None] * P[:, None, 2:]) / depth).transpose(0, 1).flatten(1, 2)
        A = J.mT @ J
        A = A + torch.linalg.matrix_norm(A)[:, None, None] * X[..., None] * X[:, None]
        away = (y - x).transpose(0, 1).flatten(1)
        X = torch.nn.functional.normalize(X - torch.linalg.solve(A, J.mT @ away[..., None])[..., 0], dim=-1)
    return float((from_homogeneous(X @ P.mT)[0] - x).square().sum(-1).mean().sqrt())


def bound(P: Tensor, X: Tensor, normal: Tensor, points: Tensor) -> float:
    """The least expected `transfer`, for unit noise of each normal distance of samples X (n, 3), normals (v, n, 2)."""
    P = P / torch.linalg.matrix_norm(P)[:, None, None]
    v = len(P)

    def information(Y: Tensor, across: Tensor | None) -> Tensor:
        ones = torch.ones(1, v, len(Y), dtype=F64)
        none = torch.zeros(1, v, len(Y), 2, 1, dtype=F64)
        return camera_information(P[None], to_homogeneous(Y)[None], ones, none, normal=across).matrix[0]

    values, vectors = torch.linalg.eigh(information(X, normal[None]))
    # Scales of cameras and the frame are free.
    vectors, values = vectors[:, v + 15 :], values[v + 15 :]
    lost = (vectors * (information(points, None) @ vectors)).sum(0) / values
    return float((lost.sum() / (v * len(points))).sqrt())


def alternation(curves: Curve, m: int) -> Tensor:
    """Cameras of factorised samples, which then go to the nearest points of the image curves, and so on."""
    c = curves.closed.shape[1]
    x = curves.resample(m).x
    for _ in range(ROUNDS):
        found = factorize_points(x.flatten(1, 2), max_iterations=10)
        seen = from_homogeneous(found.X @ found.P.mT)[0].unflatten(1, (c, m))
        x = foot_points(curves, seen).x
    return found.P


def random_scenes(count: int) -> None:
    """The table of rings."""
    print("| arc | noise | called OK | error over bound | alternation over bound | seconds each |\n|" + "---|" * 6)
    for arc in (20.0, 40.0, 60.0):
        for noise in (0.1, 0.3, 1.0):
            generator = torch.Generator().manual_seed(0)
            ratios, foil, seconds = [], [], 0.0
            for _ in range(count):
                X, P = rings(3, 400, generator), cameras(6, arc, generator)
                x = project_points(P[:, None], X)
                tangent = torch.nn.functional.normalize(x.roll(-1, 2) - x.roll(1, 2), dim=-1)[:, :, ::10].flatten(1, 2)
                normal = torch.stack((-tangent[..., 1], tangent[..., 0]), -1)
                least = noise * bound(P, X[:, ::10].flatten(0, 1), normal, X[:, ::20].flatten(0, 1))
                noisy = x[:, :, ::10] + noise * torch.randn(6, 3, 40, 2, generator=generator, dtype=F64)
                curves = curve_from_samples(noisy, closed=True)
                start = time.process_time()
                found = factorize_curves(curves, aligned=True)
                seconds += time.process_time() - start
                exact = x[:, :, ::20].flatten(1, 2)
                foil.append(transfer(alternation(curves, 40), exact) / least)
                if found.status == Status.OK:
                    ratios.append(transfer(found.P, exact) / least)
            ours, other = (float(np.median(r)) if r else math.nan for r in (ratios, foil))
            share = f"{len(ratios)} of {count}"
            print(f"| {arc:.0f} | {noise} | {share} | {ours:.2f} | {other:.1f} | {seconds / count:.1f} |", flush=True)


def hidden(x: Tensor, generator: torch.Generator) -> Tensor:
    """Closed curves (v, c, n, 2) that begin anywhere and run either way, each image for itself."""
    v, c, n, _ = x.shape
    slot, back = torch.arange(n), torch.rand(v, c, 1, generator=generator) < 0.5
    index = (torch.where(back, -slot, slot) + torch.randint(n, (v, c, 1), generator=generator)) % n
    return x.gather(2, index[..., None].expand_as(x))


def exact_scenes(seeds: list[int], arcs: list[float], unknown: bool) -> None:
    """A row for each scene of rings without noise, and what became of all of them."""
    print("| scene | status | samples, px | cameras, px | seconds |\n|" + "---|" * 5)
    ok, sharp, wrong, seconds = 0, 0, 0, 0.0
    for seed in seeds:
        generator = torch.Generator().manual_seed(seed)
        X, P = rings(3, 1000, generator), cameras(6, arcs[seed % len(arcs)], generator)
        x = project_points(P[:, None], X)
        curves = curve_from_samples(hidden(x, generator) if unknown else x, closed=True)
        start = time.process_time()
        found = factorize_curves(curves, aligned=not unknown)
        own = time.process_time() - start
        away = found.error[torch.isfinite(found.error)].square().mean().sqrt()
        error, told = transfer(found.P, x[:, :, ::20].flatten(1, 2)), Status(int(found.status))
        seconds += own
        ok += told == Status.OK
        sharp += told == Status.OK and float(away) <= SHARP
        wrong += told == Status.OK and not error <= RIGHT
        print(f"| {seed} | {told.name} | {float(away):.1e} | {error:.1e} | {own:.1f} |", flush=True)
    print(f"\n{ok} of {len(seeds)} OK, {sharp} with samples within {SHARP} px, {wrong} OK and wrong; {seconds:.0f} CPU seconds")


def synthcurves(folder: Path) -> None:
    """The table of the analytic curves that are bent and long, seven of their twenty turntable views."""
    ids = np.loadtxt(folder / "crv-ids.txt").astype(int)
    K = torch.from_numpy(np.loadtxt(folder / "calib.intrinsic"))
    images = [torch.from_numpy(np.loadtxt(folder / f"frame_{i:04d}-pts-2D.txt")) for i in range(0, 20, 3)]
    names, closed = [24, 26, 27, 28, 30, 31, 32, 35, 36, 38], [26, 30, 35, 36, 38]
    parts = [torch.stack([x[torch.from_numpy(ids == k)] for x in images]) for k in names]
    n = max(part.shape[1] for part in parts)
    every = torch.stack([torch.nn.functional.pad(p, (0, 0, 0, n - p.shape[1]), value=math.nan) for p in parts], 1)
    around = torch.tensor([k in closed for k in names])
    generator = torch.Generator().manual_seed(0)
    print("\n| noise | status | error, px | focal length off, % | its own deviation, % |\n|" + "---|" * 5)
    for noise in (0.0, 0.1, 0.3):
        # Noisy samples are to be farther apart than the noise is large.
        apart = every if noise == 0 else every[:, :, ::6]
        noisy = apart + noise * torch.randn(apart.shape, generator=generator, dtype=F64)
        curves = curve_from_samples(noisy, closed=around)
        found = factorize_curves(curves, aligned=True)
        metric = autocalibrate_curves(
            found.P, found.X, curves, image_size=(500.0, 400.0), visible=torch.isfinite(found.error), K=K[None],
            assume=Assumption(free=("focal",)),
        )  # fmt: skip
        error = transfer(found.P, torch.stack([x[::10] for x in images]))
        off = 100 * (float(metric.K[0, 0, 0] / K[0, 0]) - 1)
        told = f"{Status(int(found.status)).name}, {Status(int(metric.status)).name}"
        print(f"| {noise} | {told} | {error:.4f} | {off:.3f} | {100 * float(metric.deviation[0, 0]):.3f} |", flush=True)


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=20, help="for each row")
    parser.add_argument("--exact", type=int, metavar="N", help="scenes 0 to N - 1 without noise instead of all tables")
    parser.add_argument("--seeds", nargs="+", metavar="A[-B]", help="these scenes without noise")
    parser.add_argument("--unknown", action="store_true", help="nothing known of where these begin and which way they run")
    parser.add_argument(
        "--arc", nargs="+", type=float, default=[40.0], help="degrees from the first to the last image of these, in turns"
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.exact or options.seeds:
        ends = [[int(end) for end in part.split("-")] for part in options.seeds or [f"0-{options.exact - 1}"]]
        exact_scenes([seed for part in ends for seed in range(part[0], part[-1] + 1)], options.arc, options.unknown)
        return
    folder = os.environ.get("TORCHSFM_DATA")
    if folder:
        synthcurves(Path(folder) / "curves/synthcurves")
    random_scenes(options.scenes)


if __name__ == "__main__":
    main()
