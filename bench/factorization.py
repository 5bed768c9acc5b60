"""Projective factorisation: exact data, noise, missing data, wrong tracks, and real tracks; error and time.

`python -m bench.factorization` prints the tables. There is no peer among Python packages; what stands beside it is the optimum
itself: projective bundle adjustment started from the true cameras and points, against the same started from the factorisation.
Times are CPU time of one thread. Real tracks are read from the folder that `TORCHSFM_DATA` names.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from bench.real_data import data_folder
from torchsfm.bundle import bundle_adjust_projective
from torchsfm.formats import read_vgg
from torchsfm.geometry import Camera, to_homogeneous
from torchsfm.motion import Factorization, factorize_points
from torchsfm.simulation import random_intrinsics, random_points, random_poses, simulate_images

SIZE = (1000, 1000)


def scene(batch: int, views: int, n: int, noise: float, missing: float, seed: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Image points, which of them are seen, true cameras and true points."""
    g = torch.Generator().manual_seed(seed)
    X = random_points(batch, n, generator=g, dtype=torch.float64)
    poses = random_poses(batch, views, generator=g, dtype=torch.float64)
    cameras = Camera(random_intrinsics(batch, views, generator=g, dtype=torch.float64, image_size=SIZE))
    seen = simulate_images(X, poses, cameras, image_size=SIZE, noise=noise, generator=g)
    kept = torch.rand(batch, views, n, generator=g) >= missing
    return seen.x, seen.visible & kept, cameras.K @ poses.matrix(), X


def rms(found: Factorization) -> Tensor:
    """Of the distances of observed points from their reprojections."""
    seen = torch.isfinite(found.error)
    return (torch.where(seen, found.error, 0).square().sum((-2, -1)) / seen.sum((-2, -1)).clamp(min=1)).sqrt()


def after_bundle(P: Tensor, X: Tensor, x: Tensor, used: Tensor) -> float:
    """Root mean square error after projective bundle adjustment."""
    view, point = used.nonzero().unbind(-1)
    return float(bundle_adjust_projective(P, X, x[used], view, point, max_iterations=100).residuals.square().mean().sqrt())


def simulated(trials: int, bundles: int) -> None:
    """Print the table of simulated scenes."""
    print(
        "views points noise missing | solved within 2x of noise, median rms px | bundle from it / from truth: median, worst | s"
    )
    for views, n in ((2, 8), (2, 50), (3, 10), (5, 30), (10, 50), (20, 100), (40, 500)):
        for noise in (0.0, 0.1, 1.0, 2.0):
            for missing in (0.0, 0.3, 0.6) if views >= 5 else (0.0,):
                count = trials if views <= 10 else max(trials // 10, 1) if views <= 20 else 1
                x, visible, P, X = scene(count, views, n, noise, missing, seed=views)
                start = time.process_time()
                found = factorize_points(x, visible=visible)
                seconds = (time.process_time() - start) / count
                error, ratios = rms(found), []
                good = (found.status == 0) & (error < (2 * 2**0.5 * noise if noise else 1e-8))
                for i in range(min(bundles, count) if noise else 0):
                    used = visible[i] & found.used_view[i, :, None] & found.used_point[i]
                    from_truth = after_bundle(P[i], to_homogeneous(X[i]), x[i], used)
                    ratios.append(after_bundle(found.P[i], found.X[i], x[i], used) / max(from_truth, 1e-12))
                spread = f"{np.median(ratios):.4f} {max(ratios):.4f}" if ratios else "-"
                print(
                    f"{views:5d} {n:6d} {noise:5.1f} {missing:7.1f} | {good.double().mean().item():.3f} "
                    f"{error.median().item():9.2e} | {spread:>15s} | {seconds:.4f}",
                    flush=True,
                )


def wrong_tracks(trials: int) -> None:
    """Print how the robust variant bears wrong tracks."""
    print("wrong tracks, 8 views x 100 points, 1 px, 20 % missing: rms of the right ones, px: plain, robust")
    for share in (0.05, 0.1, 0.2, 0.3):
        x, visible, _, _ = scene(trials, 8, 100, 1.0, 0.2, seed=1)
        g = torch.Generator().manual_seed(2)
        wrong = torch.rand(trials, 1, 100, generator=g) < share
        x = torch.where(wrong[..., None], torch.rand(x.shape, generator=g, dtype=x.dtype) * SIZE[0], x)
        line = []
        for robust in (False, True):
            found = factorize_points(x, visible=visible, robust=robust)
            right = torch.isfinite(found.error) & ~wrong
            error = (torch.where(right, found.error, 0).square().sum((-2, -1)) / right.sum((-2, -1))).sqrt()
            line.append(f"median {error.median().item():.2f}, worst {error.max().item():.2f}")
        print(f"{share:.2f}: {'; '.join(line)}", flush=True)


def real(data: Path) -> None:
    """Print the table of real tracks."""
    print("real tracks: views, tracks | s | median, 90 %, 95 % error px | after bundle: the same, tracks within 0.5 px rms")
    sets: dict[str, Any] = {}
    table = torch.from_numpy(np.loadtxt(data / "vgg/dinosaur/viff.xy")).reshape(-1, 36, 2).transpose(0, 1)
    sets["dinosaur"] = table, (table >= 0).all(-1)
    for name in ("model_house", "corridor", "merton1", "library"):
        vgg = read_vgg(data / "vgg" / name)
        sets[name] = vgg.x, vgg.visible
    for name, (x, visible) in sets.items():
        long = visible.sum(0) >= min(3, len(x))
        x, visible = x[:, long].contiguous(), visible[:, long]
        start = time.process_time()
        found = factorize_points(x, visible=visible, robust=True)
        seconds = time.process_time() - start
        used = torch.isfinite(found.error)
        view, point = used.nonzero().unbind(-1)
        trusted = found.weights[used]
        best = bundle_adjust_projective(found.P, found.X, x[used], view, point, weights=trusted, max_iterations=100)
        square = torch.zeros(x.shape[1], dtype=x.dtype).index_add(0, point, best.residuals.square())
        track = (square / used.sum(0)).sqrt()[used.any(0)]
        print(
            f"{name:12s} {len(x):3d} {x.shape[1]:5d} {found.status.item()} | {seconds:6.1f} | {spread(found.error[used])} | "
            f"{spread(best.residuals)} | {(track <= 0.5).double().mean().item():.3f}",
            flush=True,
        )


def spread(error: Tensor) -> str:
    """Median, 90 % and 95 % quantile."""
    return " ".join(f"{q:.3f}" for q in error.quantile(torch.tensor([0.5, 0.9, 0.95], dtype=error.dtype)).tolist())


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--bundles", type=int, default=10, help="scenes of each kind to compare after bundle adjustment")
    parser.add_argument("--parts", nargs="+", default=["simulated", "wrong", "real"])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if "simulated" in arguments.parts:
        simulated(arguments.trials, arguments.bundles)
    if "wrong" in arguments.parts:
        wrong_tracks(max(arguments.trials // 10, 5))
    folder = data_folder()
    if "real" in arguments.parts and folder is not None:
        real(folder)


@pytest.mark.parametrize(("views", "n"), [(3, 20), (10, 50)])
def test_factorization(benchmark: Any, views: int, n: int) -> None:
    torch.set_num_threads(1)
    x, visible, _, _ = scene(20, views, n, 1.0, 0.1, seed=0)
    found = benchmark.pedantic(lambda: factorize_points(x, visible=visible), rounds=2, warmup_rounds=1)
    assert (rms(found) < 3).double().mean() > 0.9


if __name__ == "__main__":
    main()
