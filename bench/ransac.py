"""Robust estimation against other programs: time and error on simulated pairs, and error on real ones.

`python -m bench.ransac` prints the grid: every model, number of points and share of inliers, for one pair and for batches, on
the same pairs for everybody. `--models H --points 1000 --inliers 0.5 --pairs 16 --single 4` is a short run; `--real FOLDER`
runs over real pairs instead. `pytest bench/ransac.py` times one case of each model.

With one thread times are CPU time, so that they mean something on a busy machine; with more they are the clock's. The peers are
asked for the same confidence; PL1 is PoseLib with `dyn_num_trials_mult=1` and `min_iterations=100`, MAGSAC is OpenCV's.
"""

import argparse
import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from bench.ransac_peers import CONFIDENCE, MOST, PEERS, answer, installed
from bench.ransac_real import report
from torchsfm.geometry import random_rotation, rotation_angle, rotation_from_rotvec
from torchsfm.motion import estimate_essential, estimate_fundamental, estimate_homography
from torchsfm.resection import estimate_camera
from torchsfm.tensors import essential_from_fundamental, pose_from_essential

FOCAL, SIZE = 800.0, 1000.0
CENTRE = SIZE / 2
K = torch.tensor([[FOCAL, 0, CENTRE], [0, FOCAL, CENTRE], [0, 0, 1]], dtype=torch.float64)
POINTS, NOISE = 1000, 1.0
THRESHOLD = {"F": 2.0, "E": 2.0, "H": 2.5, "P": 2.5}


@dataclass(frozen=True)
class Scene:
    """A batch of pairs (or of images and points): measurements, which of them are wrong, and the truth."""

    x1: Tensor
    x2: Tensor
    outlier: Tensor
    R: Tensor
    t: Tensor
    H: Tensor | None = None


def scenes(model: str, pairs: int, inliers: float, seed: int, points: int = POINTS) -> Scene:
    """Simulate pairs with 1 px of noise in each coordinate of each image, outliers spread over the second image."""
    g = torch.Generator().manual_seed(seed)
    kind = {"generator": g, "dtype": torch.float64}
    outlier = torch.rand(pairs, points, generator=g) > inliers
    wrong = torch.rand(pairs, points, 2, **kind) * SIZE
    X = torch.rand(pairs, points, 3, **kind) * 4 - 2
    if model == "P":
        R = random_rotation(pairs, **kind)
        t = torch.randn(pairs, 3, **kind) * 0.3 + torch.tensor([0.0, 0, 6], dtype=torch.float64)
        x1, H = X, None
    else:
        R = rotation_from_rotvec((torch.rand(pairs, 3, **kind) - 0.5) * 0.6)
        t = torch.nn.functional.normalize(torch.randn(pairs, 3, **kind), dim=-1)
        X = X + torch.tensor([0.0, 0, 6], dtype=torch.float64)
        n, H = torch.nn.functional.normalize(torch.randn(pairs, 3, **kind) * 0.3 + torch.tensor([0.0, 0, 1]), dim=-1), None
        if model == "H":
            X = X * (6 / (X @ n[..., None]))
            H = K @ (R + t[:, :, None] * n[:, None] / 6) @ K.inverse()
        x1 = pixels(X) + NOISE * torch.randn(pairs, points, 2, **kind)
    x2 = pixels(X @ R.mT + t[:, None]) + NOISE * torch.randn(pairs, points, 2, **kind)
    return Scene(x1, torch.where(outlier[..., None], wrong, x2), outlier, R, t, H)


def pixels(X: Tensor) -> Tensor:
    """Project points of the camera frame."""
    return X[..., :2] / X[..., 2:] * FOCAL + CENTRE


def rays(x: Tensor) -> Tensor:
    """Rays of image points."""
    return torch.cat(((x - CENTRE) / FOCAL, torch.ones_like(x[..., :1])), -1)


# ---- the candidates: each takes a scene and returns one model per pair -------------------------------------------------------


def ours(model: str, scene: Scene, seed: int = 0) -> Tensor:
    """All pairs in one call."""
    options: dict[str, Any] = {
        "generator": torch.Generator().manual_seed(seed), "confidence": CONFIDENCE, "max_iterations": MOST,
    }  # fmt: skip
    threshold = THRESHOLD[model]
    if model == "F":
        return estimate_fundamental(scene.x1, scene.x2, threshold=threshold, **options).model
    if model == "H":
        return estimate_homography(scene.x1, scene.x2, threshold=threshold, **options).model
    if model == "P":
        return estimate_camera(scene.x2, scene.x1, K, threshold=threshold, **options).model
    return estimate_essential(rays(scene.x1), rays(scene.x2), threshold=threshold / FOCAL, **options).model


def peer(name: str, model: str, scene: Scene) -> Tensor:
    """Another program, pair by pair."""
    found = [
        torch.from_numpy(answer(name, model, a, b, K.numpy(), THRESHOLD[model]))
        for a, b in zip(scene.x1.numpy(), scene.x2.numpy(), strict=True)
    ]
    return torch.stack(found)


def errors(model: str, scene: Scene, found: Tensor) -> Tensor:
    """Pose error in degrees (the larger of rotation and direction of translation), for H the rms transfer error in pixels."""
    if model == "H":
        side = torch.linspace(0, SIZE, 11, dtype=torch.float64)
        grid = torch.stack((*torch.meshgrid(side, side, indexing="ij"), torch.ones(11, 11)), -1).reshape(-1, 3)
        want, got = (grid @ H.mT for H in (scene.H, found))
        gap = want[..., :2] / want[..., 2:] - got[..., :2] / got[..., 2:]
        return (gap * gap).sum(-1).mean(-1).sqrt().nan_to_num(nan=torch.inf)
    if model == "P":
        return torch.rad2deg(rotation_angle(found[..., :3] @ scene.R.mT))
    E = essential_from_fundamental(found, K, K) if model == "F" else found
    d1, d2 = rays(scene.x1), rays(scene.x2)
    pose = pose_from_essential(E, d1, d2, (~scene.outlier).double()).model
    rotation = rotation_angle(pose[..., :3] @ scene.R.mT)
    cosine = torch.nn.functional.cosine_similarity(pose[..., 3], scene.t, dim=-1).clamp(-1, 1)
    return torch.rad2deg(torch.maximum(rotation, torch.arccos(cosine)))


def measure(run: Callable[[], Tensor]) -> tuple[float, Tensor]:
    """Seconds of one call, and what it returned."""
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    start = clock()
    found = run()
    return clock() - start, found


def part(scene: Scene, index: slice) -> Scene:
    """Some of the pairs."""
    return Scene(*(None if f is None else f[index] for f in vars(scene).values()))


def grid(arguments: argparse.Namespace) -> None:
    """Print the table of the simulated pairs."""
    print(
        f"{'model':5} {'points':>6} {'inliers':>7} {'candidate':14} {'ms/pair':>8} {'median':>8} {'p95':>8}   (degrees; H: px)"
    )
    most = max(arguments.pairs)
    for model in arguments.models:
        for points in arguments.points:
            for ratio in arguments.inliers:
                scene = scenes(model, most, ratio, arguments.seed, points)
                rows: list[tuple[str, float, Tensor]] = []
                for name in installed(arguments.peers):
                    if name == "kornia" and model not in "FH":
                        continue
                    few = part(scene, slice(arguments.peer_pairs))
                    # The first call may compile.
                    peer(name, model, part(scene, slice(1)))
                    seconds, found = measure(lambda: peer(name, model, few))  # noqa: B023
                    rows.append((name, seconds / len(found), errors(model, few, found)))
                ours(model, part(scene, slice(2)))
                if arguments.single:
                    seconds, parts = 0.0, []
                    for i in range(arguments.single):
                        one = part(scene, slice(i, i + 1))
                        spent, found = measure(lambda: ours(model, one))  # noqa: B023
                        seconds, parts = seconds + spent, [*parts, errors(model, one, found)]
                    rows.append(("ours, single", seconds / arguments.single, torch.cat(parts)))
                for pairs in arguments.pairs:
                    some = part(scene, slice(pairs))
                    seconds, found = measure(lambda: ours(model, some))  # noqa: B023
                    rows.append((f"ours, batch {pairs}", seconds / pairs, errors(model, some, found)))
                for name, spent, error in rows:
                    p95, median = error.quantile(0.95).item(), error.median().item()
                    print(
                        f"{model:5} {points:6} {ratio:7.2f} {name:14} {spent * 1e3:8.2f} {median:8.4f} {p95:8.4f}", flush=True
                    )


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", default="FHPE")
    parser.add_argument("--inliers", type=float, nargs="+", default=[0.3, 0.5, 0.8])
    parser.add_argument("--points", type=int, nargs="+", default=[200, 1000, 5000])
    parser.add_argument("--pairs", type=int, nargs="+", default=[64, 256], help="sizes of the batches")
    parser.add_argument("--single", type=int, default=8, help="how many pairs to run one by one")
    parser.add_argument("--peer-pairs", type=int, default=64, help="how many pairs the peers get")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--peers", default=",".join(PEERS), help=f"any of {', '.join(PEERS)}")
    parser.add_argument("--real", type=Path, help="folder of the real data sets")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    with contextlib.suppress(ImportError):
        import cv2

        cv2.setNumThreads(arguments.threads)
    if arguments.real:
        report(arguments.real, [name for name in installed(arguments.peers) if name != "kornia"])
    else:
        grid(arguments)


@pytest.mark.parametrize("model", ["F", "H", "P", "E"])
def test_batch_of_32_pairs(benchmark: Any, model: str) -> None:
    torch.set_num_threads(1)
    scene = scenes(model, 32, 0.6, 0, 500)
    found = benchmark.pedantic(lambda: ours(model, scene), rounds=3, warmup_rounds=1)
    assert errors(model, scene, found).median() < 1.5


if __name__ == "__main__":
    main()
