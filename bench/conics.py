"""Ellipses, conics in space and F from conics against their Cramer-Rao bounds; OpenCV's fits of ellipses on the same points.

`python -m bench.conics [--trials N]`. Errors are root mean squares in units of the bound, which comes from exact data.
"""

import argparse
import math

import cv2
import numpy as np
import torch
from torch import Tensor

from torchsfm import (
    Ellipse,
    Status,
    conic_from_ellipse,
    dual_quadric_from_ellipsoid,
    fit_ellipse,
    fundamental_from_cameras,
    fundamental_from_conics,
    simulate_conics,
    triangulate_conics,
    triangulate_quadrics,
)

F64 = torch.float64
SIGMA = 0.5
PEERS = {"cv2.fitEllipse": cv2.fitEllipse, "AMS": cv2.fitEllipseAMS, "Direct": cv2.fitEllipseDirect}


def fits(trials: int, generator: torch.Generator) -> None:
    """Semi-axes of ellipses of 100 by 50 pixels from 100 points on arcs."""
    print("ellipse fits: rmse / bound of a, b (bias / bound), share called OK")
    ellipse = Ellipse(*(torch.tensor(v, dtype=F64) for v in ([320.0, 240.0], [100.0, 50.0], 0.4)))
    for arc in (360, 180, 120):
        t = 0.7 + math.radians(arc) * (torch.arange(100, dtype=F64) / (100 if arc == 360 else 99) - 0.5)
        bound = SIGMA * fit_ellipse(ellipse.points(t)).covariance.diagonal().sqrt()[2:4]
        x = ellipse.points(t) + SIGMA * torch.randn(trials, 100, 2, generator=generator, dtype=F64)
        found = fit_ellipse(x)
        good = found.status == Status.OK
        rows = {"fit_ellipse": found.model.semi_axes[good]}
        for name, peer in PEERS.items():
            axes = [sorted(peer(p.astype(np.float32))[1], reverse=True) for p in x.numpy()]
            rows[name] = 0.5 * torch.tensor(axes, dtype=F64)
        for name, axes in rows.items():
            score = (axes - ellipse.semi_axes) / bound
            rmse, bias = score.square().mean(0).sqrt().tolist(), score.mean(0).tolist()
            share = f"  OK {float(good.double().mean()):.3f}" if name == "fit_ellipse" else ""
            print(f"  {arc:3d} {name:15s} {rmse[0]:5.2f} {rmse[1]:5.2f}  ({bias[0]:+.2f} {bias[1]:+.2f}){share}")


def space(trials: int, generator: torch.Generator) -> None:
    """Ellipses in space."""
    print("conics in space: exact (worst entry of Q*), then 0.5 px edge points: rmse / bound of the centre, right plane, OK")
    for views in (2, 3, 6):
        scene = simulate_conics((trials,), views=views, generator=generator)
        exact = (triangulate_conics(scene.C, scene.P).Q_dual - dual_quadric_from_ellipsoid(scene.model)).abs().amax()
        weights = torch.full(scene.x.shape[:-1], SIGMA**-2, dtype=F64)
        bound = triangulate_conics(scene.C, scene.P, x=scene.x, weights=weights).covariance[:, 0, :3, :3]
        x = scene.x + SIGMA * torch.randn(scene.x.shape, generator=generator, dtype=F64)
        found = triangulate_conics(conic_from_ellipse(fit_ellipse(x).model), scene.P, x=x, weights=weights)
        d = (found.model.centre - scene.model.centre)[:, 0]
        score = (d * torch.linalg.solve(bound, d[..., None])[..., 0]).sum(-1).mean().div(3).sqrt()
        right = ((found.model.plane[..., :3] * scene.model.plane[..., :3]).sum(-1).abs() > 0.95).double().mean()
        good = (found.status == Status.OK).double().mean()
        print(f"  {views} views  {float(exact):.1e}  {float(score):.3f}  {float(right):.4f}  {float(good):.4f}")
    scene = simulate_conics((trials,), views=4, flat=False, generator=generator)
    exact = (triangulate_quadrics(scene.C, scene.P).Q_dual - dual_quadric_from_ellipsoid(scene.model)).abs().amax()
    print(f"  ellipsoids, 4 views  {float(exact):.1e}")


def epipolar(trials: int, generator: torch.Generator) -> None:
    """F from conics."""
    print("F from conics: share right to 1e-6, called OK, wrong and called OK (exact); coplanar: share told, exact and 0.3 px")
    for conics in (4, 5, 6):
        scene = simulate_conics((trials,), conics=conics, views=2, generator=generator)
        found = fundamental_from_conics(scene.C[:, 0], scene.C[:, 1], generator=generator)
        F = fundamental_from_cameras(scene.P[:, 0], scene.P[:, 1])
        F = F / torch.linalg.matrix_norm(F, keepdim=True)
        off = torch.minimum(*(torch.linalg.matrix_norm(found.model - s * F) for s in (1, -1)))
        right, good = off < 1e-6, found.status == Status.OK
        print(f"  {conics}  {share(right)}  {share(good)}  {int((good & ~right).sum())}")
    for noise in (0.0, 0.3):
        scene = simulate_conics((trials,), conics=6, views=2, coplanar=True, noise=noise, generator=generator)
        C = conic_from_ellipse(fit_ellipse(scene.x).model) if noise else scene.C
        found = fundamental_from_conics(C[:, 0], C[:, 1], generator=generator)
        print(f"  coplanar, {noise} px  {share(found.status == Status.DEGENERATE)}")


def share(mask: Tensor) -> str:
    """As a number."""
    return f"{float(mask.double().mean()):.4f}"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=1000, help="ellipses, conics; a tenth of it for F")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(options.seed)
    fits(options.trials, generator)
    space(options.trials, generator)
    epipolar(max(1, options.trials // 10), generator)


if __name__ == "__main__":
    main()
