"""Ellipses, conics in space and F from conics against their Cramer-Rao bounds; OpenCV's fits of ellipses on the same points.

`python -m bench.conics [--trials N] [--epipolar N] [--noisy N]`. Errors are root mean squares in units of the bound, which
comes from exact data.
"""

import argparse
import math

import cv2
import numpy as np
import torch
from scipy.stats import beta
from torch import Tensor

from torchsfm import (
    Ellipse,
    SimulatedConics,
    Status,
    conic_from_ellipse,
    dual_conic,
    dual_quadric_from_ellipsoid,
    ellipse_from_conic,
    fit_ellipse,
    fundamental_from_cameras,
    fundamental_from_conics,
    project_quadric,
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
        least = SIGMA * fit_ellipse(ellipse.points(t)).covariance.diagonal().sqrt()[2:4]
        x = ellipse.points(t) + SIGMA * torch.randn(trials, 100, 2, generator=generator, dtype=F64)
        found = fit_ellipse(x)
        good = found.status == Status.OK
        rows = {"fit_ellipse": found.model.semi_axes[good]}
        for name, peer in PEERS.items():
            axes = [sorted(peer(p.astype(np.float32))[1], reverse=True) for p in x.numpy()]
            rows[name] = 0.5 * torch.tensor(axes, dtype=F64)
        for name, axes in rows.items():
            score = (axes - ellipse.semi_axes) / least
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
        least = triangulate_conics(scene.C, scene.P, x=scene.x, weights=weights).covariance[:, 0, :3, :3]
        x = scene.x + SIGMA * torch.randn(scene.x.shape, generator=generator, dtype=F64)
        found = triangulate_conics(conic_from_ellipse(fit_ellipse(x).model), scene.P, x=x, weights=weights)
        d = (found.model.centre - scene.model.centre)[:, 0]
        score = (d * torch.linalg.solve(least, d[..., None])[..., 0]).sum(-1).mean().div(3).sqrt()
        right = ((found.model.plane[..., :3] * scene.model.plane[..., :3]).sum(-1).abs() > 0.95).double().mean()
        good = (found.status == Status.OK).double().mean()
        print(f"  {views} views  {float(exact):.1e}  {float(score):.3f}  {float(right):.4f}  {float(good):.4f}")
    scene = simulate_conics((trials,), views=4, flat=False, generator=generator)
    exact = (triangulate_quadrics(scene.C, scene.P).Q_dual - dual_quadric_from_ellipsoid(scene.model)).abs().amax()
    print(f"  ellipsoids, 4 views  {float(exact):.1e}")


def epipolar(trials: int, generator: torch.Generator) -> None:
    """F from exact conics, and from coplanar ones, which do not determine it."""
    print("F from exact conics: right to 1e-6 and called OK, the share that is so at least (95 %), wrong and called OK")
    for conics in (4, 5, 6):
        right, wrong = 0, 0
        for number in batches(trials):
            scene = simulate_conics((number,), conics=conics, views=2, generator=generator)
            found = fundamental_from_conics(scene.C[:, 0], scene.C[:, 1], generator=generator)
            close, good = off(found.model, truth(scene)) < 1e-6, found.status == Status.OK
            right, wrong = right + int((close & good).sum()), wrong + int((good & ~close).sum())
        least = beta.ppf(0.05, right, trials - right + 1)
        print(f"  {conics}  {right} of {trials}  {least:.5f}  {wrong}", flush=True)
    print("coplanar conics: share told")
    for noise in (0.0, 0.3):
        told = 0
        for number in batches(trials // 10):
            scene = simulate_conics((number,), conics=6, views=2, coplanar=True, noise=noise, generator=generator)
            C = conic_from_ellipse(fit_ellipse(scene.x).model) if noise else scene.C
            found = fundamental_from_conics(C[:, 0], C[:, 1], generator=generator)
            told += int((found.status == Status.DEGENERATE).sum())
        print(f"  {noise} px  {told} of {trials // 10}", flush=True)


def noisy_epipolar(scenes: int, generator: torch.Generator, trials: int = 20) -> None:
    """F from conics of noisy edge points, in the coordinates of the bound."""
    print("F from noisy conics: rms error / bound over trials called OK, of all and of the median scene, and their share")
    t = torch.arange(60, dtype=F64) * (2 * math.pi / 60)
    for conics in (4, 5, 6):
        for sigma in (0.05, 0.1, 0.5):
            squares, shares = [], []
            for _ in range(scenes):
                scene = simulate_conics((), conics=conics, views=2, generator=generator)
                exact = ellipse_from_conic(scene.C)[0].points(t)
                least = sigma**2 * bound(scene, fit_ellipse(exact).covariance, to_pixels(exact))
                fits = fit_ellipse(exact + sigma * torch.randn(trials, *exact.shape, generator=generator, dtype=F64))
                C, S = conic_from_ellipse(fits.model), sigma**2 * fits.covariance
                found = fundamental_from_conics(C[:, 0], C[:, 1], covariance1=S[:, 0], covariance2=S[:, 1], generator=generator)
                good = found.status == Status.OK
                T = to_pixels(exact)
                F, true = (unit(T[1].mT @ F @ T[0]) for F in (found.model, truth(scene)))
                F = F * (F * true).sum((-2, -1), keepdim=True).sign()
                values, V = torch.linalg.eigh(least)
                score = (F - true).flatten(-2) @ V[:, 2:] / values[2:].sqrt()
                squares.append(score[good].square().mean(-1))
                shares.append(float(good.double().mean()))
            every = float(torch.cat(squares).mean().sqrt())
            middle = float(
                torch.stack([s.mean().sqrt() for s in squares if len(s) > trials // 2] or [torch.tensor(math.nan)]).median()
            )
            print(f"  {conics}  {sigma} px  {every:.3f}  {middle:.3f}  {np.mean(shares):.3f}", flush=True)


def bound(scene: SimulatedConics, covariance: Tensor, T: Tensor) -> Tensor:
    """The Cramer-Rao bound of the nine numbers of T2'F T1: of all second cameras and conics in space that the images allow."""

    def images(p: Tensor) -> Tensor:
        P = torch.stack((scene.P[0], p[:12].view(3, 4)))
        centre, axes = p[12:].view(-1, 3, 3).split((1, 2), 1)
        Q = axes.mT @ axes
        h = torch.nn.functional.pad(centre[:, 0], (0, 1), value=1.0)
        dual = torch.nn.functional.pad(Q, (0, 1, 0, 1)) - h[:, :, None] * h[:, None]
        e, _ = ellipse_from_conic(dual_conic(project_quadric(P[:, None], dual)))
        return torch.cat((e.centre, e.semi_axes, e.angle[..., None]), -1)

    m = scene.model
    p = torch.cat((scene.P[1].flatten(), torch.cat((m.centre[:, None], m.axes[:, :2]), 1).flatten()))
    J = torch.autograd.functional.jacobian(images, p)
    white = torch.linalg.inv(torch.linalg.cholesky(covariance))
    J = (white @ J.reshape(*covariance.shape[:-1], -1)).reshape(-1, len(p))

    def F(q: Tensor) -> Tensor:
        return unit(T[1].mT @ fundamental_from_cameras(scene.P[0], q[:12].view(3, 4)) @ T[0]).flatten()

    scale = J.norm(dim=0).clamp_min(1e-12)
    half = (torch.autograd.functional.jacobian(F, p) / scale) @ torch.linalg.pinv(J / scale, rtol=1e-9)
    return half @ half.T


def truth(scene: SimulatedConics) -> Tensor:
    """The fundamental matrices of two cameras, of unit norm."""
    return unit(fundamental_from_cameras(scene.P[..., 0, :, :], scene.P[..., 1, :, :]))


def to_pixels(x: Tensor) -> Tensor:
    """What takes points of size one about the origin of each image to points like x (2, m, n, 2): there F is well scaled."""
    middle = x.mean((1, 2))
    size = (x - middle[:, None, None]).square().mean((1, 2, 3)).sqrt()
    T = torch.diag_embed(torch.stack((size, size, torch.ones_like(size)), -1))
    T[:, :2, 2] = middle
    return T


def unit(F: Tensor) -> Tensor:
    """Of unit norm."""
    return F / torch.linalg.matrix_norm(F, keepdim=True)


def off(F: Tensor, wanted: Tensor) -> Tensor:
    """How far matrices of unit norm are from each other, whatever their signs."""
    return torch.minimum(torch.linalg.matrix_norm(F - wanted), torch.linalg.matrix_norm(F + wanted))


def batches(count: int, size: int = 100) -> list[int]:
    """The sizes of the batches that make up a number."""
    return [min(size, count - start) for start in range(0, count, size)]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=1000, help="ellipses, conics")
    parser.add_argument("--epipolar", type=int, default=1000, help="pairs of images with exact conics")
    parser.add_argument("--noisy", type=int, default=20, help="pairs of images with noisy conics, of twenty trials each")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(options.seed)
    fits(options.trials, generator)
    space(options.trials, generator)
    epipolar(options.epipolar, generator)
    noisy_epipolar(options.noisy, generator)


if __name__ == "__main__":
    main()
