"""Minimal solvers against PoseLib, OpenCV and kornia: recall, error and speed on the same exact samples, one thread.

`python -m bench.solvers` prints the table; `pytest bench/solvers.py` times this library's solvers with pytest-benchmark.
Recall is the share of samples whose true model is found to 1e-6; errors are quantiles of the distance of the nearest solution
from the truth, as unit matrices. PoseLib and OpenCV solve one sample a call, kornia and this library a batch; calls alternate,
and the least CPU time counts. A call to a C++ solver from Python costs a few microseconds by itself.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from torchsfm.geometry import cross_matrix, rotation_from_rotvec
from torchsfm.motion import essential_5pt, fundamental_7pt, homography_4pt

F64 = torch.float64
K = torch.tensor([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]], dtype=F64)
Sample = tuple[Tensor, Tensor, Tensor]
Solver = Callable[[Tensor, Tensor], Any]
SIZES = {"essential_5pt": 5, "fundamental_7pt": 7, "homography_4pt": 4}
OURS = {"essential_5pt": essential_5pt, "fundamental_7pt": fundamental_7pt, "homography_4pt": homography_4pt}


def scene(name: str, family: str, count: int, seed: int = 0) -> Sample:
    """Exact samples (rays or pixels) and the model they come from."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=F64, generator=generator)

    n = SIZES[name]
    X = 4 * torch.rand(count, n, 3, dtype=F64, generator=generator) - 2
    X[..., 2] += 6
    t = torch.nn.functional.normalize(normal(count, 3), dim=-1)
    R = rotation_from_rotvec(0.3 * normal(count, 3))
    if family == "near planar":
        X[..., 2] = 6 + 0.3 * X[..., 0] + 0.01 * torch.rand(count, n, dtype=F64, generator=generator)
    elif family == "small baseline":
        t, R = 0.1 * t, rotation_from_rotvec(0.05 * normal(count, 3))
    elif family == "forward":
        t, R = torch.tensor([0.0, 0, 1], dtype=F64) + 0.01 * t, rotation_from_rotvec(0.02 * normal(count, 3))
    if name == "homography_4pt":
        X[..., 2] = 6 + 0.3 * X[..., 0] + 0.1 * X[..., 1]
        H = K @ (R + t[:, :, None] * (torch.tensor([-0.3, -0.1, 1], dtype=F64) / 6)) @ torch.linalg.inv(K)
    X2 = X @ R.mT + t[:, None]
    E = cross_matrix(t) @ R
    if name == "essential_5pt":
        return X / X[..., 2:], X2 / X2[..., 2:], E
    x1, x2 = ((Y @ K.mT)[..., :2] / Y[..., 2:] for Y in (X, X2))
    return x1, x2, H if name == "homography_4pt" else torch.linalg.inv(K).mT @ E @ torch.linalg.inv(K)


def ours(name: str) -> Solver:
    """One batched call; invalid slots as NaN."""

    def solve(x1: Tensor, x2: Tensor) -> Tensor:
        solutions = OURS[name](x1, x2)
        return torch.where(solutions.valid[..., None, None], solutions.model, torch.nan)

    return solve


def peers(name: str) -> dict[str, Solver]:
    """The peers that are installed and have this solver."""
    found: dict[str, Solver] = {}
    try:
        import poselib

        if name == "essential_5pt":
            found["PoseLib"] = one_by_one(poselib.essential_matrix_5pt, unit=True)
    except ImportError:
        pass
    try:
        import cv2

        cv2.setNumThreads(1)
        if name == "fundamental_7pt":
            found["OpenCV"] = one_by_one(lambda a, b: cv2.findFundamentalMat(a, b, cv2.FM_7POINT)[0])
        elif name == "homography_4pt":
            found["OpenCV"] = one_by_one(cv2.getPerspectiveTransform, single=True)
        else:
            eye = torch.eye(3, dtype=F64).numpy()
            found["OpenCV"] = one_by_one(
                lambda a, b: cv2.findEssentialMat(a[:, :2].copy(), b[:, :2].copy(), eye, cv2.RANSAC, 0.999, 1e-3)[0]
            )
    except ImportError:
        pass
    try:
        from kornia.geometry.epipolar import find_essential, find_fundamental
        from kornia.geometry.homography import find_homography_dlt

        found["kornia"] = {
            "essential_5pt": lambda a, b: find_essential(a[..., :2], b[..., :2]),
            "fundamental_7pt": lambda a, b: find_fundamental(a, b, method="7POINT"),
            "homography_4pt": find_homography_dlt,
        }[name]
    except ImportError:
        pass
    return found


def one_by_one(function: Callable[..., Any], unit: bool = False, single: bool = False) -> Solver:
    """A solver for one sample of numpy arrays, called in a loop."""

    def solve(x1: Tensor, x2: Tensor) -> list[Any]:
        if unit:
            x1, x2 = (torch.nn.functional.normalize(x, dim=-1) for x in (x1, x2))
        if single:
            x1, x2 = x1.float(), x2.float()
        a, b = x1.numpy(), x2.numpy()
        return [function(a[i], b[i]) for i in range(len(a))]

    return solve


def distances(models: Any, truth: Tensor) -> Tensor:
    """Of the nearest solution from the truth, 2 where there is none."""
    result = torch.full((len(models),), 2.0, dtype=F64)
    truth = truth / truth.norm(dim=(-2, -1), keepdim=True)
    for i, model in enumerate(models):
        if model is None or len(model) == 0:
            continue
        M = model if isinstance(model, Tensor) else torch.stack([torch.as_tensor(m, dtype=F64) for m in model])
        M = M.double().reshape(-1, 3, 3)
        M = M / M.norm(dim=(-2, -1), keepdim=True)
        gap = torch.minimum((M - truth[i]).norm(dim=(-2, -1)), (M + truth[i]).norm(dim=(-2, -1)))
        result[i] = gap.nan_to_num(2.0).min()
    return result


def least_times(solvers: dict[str, Solver], x1: Tensor, x2: Tensor, repeats: int) -> dict[str, float]:
    """Seconds of CPU time a sample, the least of alternating runs."""
    best = dict.fromkeys(solvers, float("inf"))
    for _ in range(repeats):
        for label, solver in solvers.items():
            start = time.process_time()
            solver(x1, x2)
            best[label] = min(best[label], (time.process_time() - start) / len(x1))
    return best


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=1000, help="samples for recall, per family")
    parser.add_argument("--batch", type=int, default=4096, help="samples for timing")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(
        f"{'solver':16s} {'program':10s} {'family':15s} {'recall':>7s} {'median':>9s} {'99 %':>9s} {'us':>8s} {'solves/s':>10s}"
    )
    for name in SIZES:
        solvers = {"torchsfm": ours(name), **peers(name)}
        x1, x2, _ = scene(name, "random", options.batch)
        batched = {label: s for label, s in solvers.items() if label in ("torchsfm", "kornia")}
        singles = {label: s for label, s in solvers.items() if label not in batched}
        times = least_times(batched, x1, x2, options.repeats) | least_times(singles, x1[:500], x2[:500], options.repeats)
        families = ("random",) if name == "homography_4pt" else ("random", "near planar", "small baseline", "forward")
        for family in families:
            x1, x2, truth = scene(name, family, options.samples, seed=1)
            for label, solver in solvers.items():
                error = distances(solver(x1, x2), truth)
                median, worst = error.quantile(torch.tensor([0.5, 0.99], dtype=F64)).tolist()
                cost = f"{1e6 * times[label]:8.2f} {1 / times[label]:10,.0f}" if family == "random" else ""
                recall = (error < 1e-6).double().mean().item()
                print(f"{name:16s} {label:10s} {family:15s} {recall:7.4f} {median:9.1e} {worst:9.1e} {cost}")


@pytest.mark.parametrize("batch", [256, 4096])
@pytest.mark.parametrize("name", SIZES)
def test_speed(benchmark: Any, name: str, batch: int) -> None:
    torch.set_num_threads(1)
    x1, x2, truth = scene(name, "random", batch)
    solutions = benchmark(OURS[name], x1, x2)
    models = torch.where(solutions.valid[..., None, None], solutions.model, torch.nan)
    assert (distances(models, truth) < 1e-6).double().mean() > 0.99


if __name__ == "__main__":
    main()
