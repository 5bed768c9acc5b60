"""Robust estimation against PoseLib and OpenCV: time and error on simulated pairs.

`python -m bench.ransac` prints a table; `pytest bench/ransac.py` times one case of each model. Times are of one thread, as CPU
time, so that they mean something on a busy machine. The peers are asked for the same confidence; PoseLib runs with
`dyn_num_trials_mult=1` and `min_iterations=100`, else it would draw three times the samples.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchsfm.geometry import random_rotation, rotation_angle, rotation_from_rotvec
from torchsfm.motion import estimate_essential, estimate_fundamental, estimate_homography
from torchsfm.resection import estimate_camera
from torchsfm.tensors import essential_from_fundamental, pose_from_essential

FOCAL, SIZE = 800.0, 1000.0
CENTRE = SIZE / 2
K = torch.tensor([[FOCAL, 0, CENTRE], [0, FOCAL, CENTRE], [0, 0, 1]], dtype=torch.float64)
CONFIDENCE = 0.9999
POINTS, NOISE = 1000, 1.0
THRESHOLD = {"F": 2.0, "E": 2.0, "H": 2.5, "P": 2.5}
MOST = 100_000


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


def poselib(model: str, scene: Scene) -> Tensor:
    """PoseLib, pair by pair."""
    import poselib as pl

    threshold = THRESHOLD[model]
    options = {
        "max_epipolar_error": threshold, "max_reproj_error": threshold, "success_prob": CONFIDENCE, "max_iterations": MOST,
        "min_iterations": 100, "dyn_num_trials_mult": 1.0,
    }  # fmt: skip
    camera = {"model": "PINHOLE", "width": int(SIZE), "height": int(SIZE), "params": [FOCAL, FOCAL, CENTRE, CENTRE]}
    results = []
    for a, b in zip(scene.x1.numpy(), scene.x2.numpy(), strict=True):
        if model == "F":
            found = pl.estimate_fundamental(a, b, options, {})[0]
        elif model == "H":
            found = pl.estimate_homography(a, b, options, {})[0]
        elif model == "P":
            found = pl.estimate_absolute_pose(b, a, camera, options, {})[0].Rt
        else:
            pose = pl.estimate_relative_pose(a, b, camera, camera, options, {})[0]
            found = np.cross(np.eye(3), pose.t / np.linalg.norm(pose.t)).T @ pose.R
        results.append(torch.from_numpy(np.asarray(found)))
    return torch.stack(results)


def opencv(model: str, scene: Scene) -> Tensor:
    """OpenCV's USAC_MAGSAC, pair by pair; for P its RANSAC over AP3P."""
    import cv2

    cv2.setNumThreads(1)
    threshold, matrix, results = THRESHOLD[model], K.numpy(), []
    for a, b in zip(scene.x1.numpy(), scene.x2.numpy(), strict=True):
        if model == "F":
            found = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, threshold, CONFIDENCE, MOST)[0]
        elif model == "H":
            found = cv2.findHomography(a, b, cv2.USAC_MAGSAC, threshold, maxIters=MOST, confidence=CONFIDENCE)[0]
        elif model == "P":
            _, r, t, _ = cv2.solvePnPRansac(
                a,
                b,
                matrix,
                None,
                iterationsCount=MOST,
                reprojectionError=threshold,
                confidence=CONFIDENCE,
                flags=cv2.SOLVEPNP_AP3P,
            )
            found = np.concatenate((cv2.Rodrigues(r)[0], t), 1)
        else:
            found = cv2.findEssentialMat(a, b, matrix, cv2.USAC_MAGSAC, CONFIDENCE, threshold, MOST)[0]
        shape = (3, 4) if model == "P" else (3, 3)
        results.append(torch.zeros(shape, dtype=torch.float64) if found is None else torch.from_numpy(found[:3]))
    return torch.stack(results)


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
    """CPU seconds of one call, and what it returned."""
    start = time.process_time()
    found = run()
    return time.process_time() - start, found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", default="FHPE")
    parser.add_argument("--inliers", type=float, nargs="+", default=[0.3, 0.5, 0.8])
    parser.add_argument("--pairs", type=int, default=64)
    parser.add_argument("--single", type=int, default=8, help="how many pairs to run one by one")
    parser.add_argument("--points", type=int, default=POINTS)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--peers", default="PoseLib,OpenCV")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    peers = {"PoseLib": poselib, "OpenCV": opencv}
    print(f"{'model':5} {'inliers':>7} {'candidate':14} {'ms/pair':>8} {'median':>8} {'p95':>8}   (degrees; H: px)")
    for model in arguments.models:
        for ratio in arguments.inliers:
            scene = scenes(model, arguments.pairs, ratio, arguments.seed, arguments.points)
            rows: list[tuple[str, float, Tensor]] = []
            for name in filter(None, arguments.peers.split(",")):
                seconds, found = measure(lambda: peers[name](model, scene))  # noqa: B023
                rows.append((name, seconds / arguments.pairs, errors(model, scene, found)))
            ours(model, Scene(*(None if f is None else f[:2] for f in vars(scene).values())))
            if arguments.single:
                seconds, parts = 0.0, []
                for i in range(arguments.single):
                    one = Scene(*(None if f is None else f[i : i + 1] for f in vars(scene).values()))
                    spent, found = measure(lambda: ours(model, one))  # noqa: B023
                    seconds, parts = seconds + spent, [*parts, errors(model, one, found)]
                rows.append(("ours, single", seconds / arguments.single, torch.cat(parts)))
            seconds, found = measure(lambda: ours(model, scene))  # noqa: B023
            rows.append((f"ours, batch {arguments.pairs}", seconds / arguments.pairs, errors(model, scene, found)))
            for name, spent, error in rows:
                p95 = error.quantile(0.95).item()
                print(
                    f"{model:5} {ratio:7.2f} {name:14} {spent * 1e3:8.2f} {error.median().item():8.4f} {p95:8.4f}", flush=True
                )


@pytest.mark.parametrize("model", ["F", "H", "P", "E"])
def test_batch_of_32_pairs(benchmark: Any, model: str) -> None:
    torch.set_num_threads(1)
    scene = scenes(model, 32, 0.6, 0, 500)
    found = benchmark.pedantic(lambda: ours(model, scene), rounds=3, warmup_rounds=1)
    assert errors(model, scene, found).median() < 1.5


if __name__ == "__main__":
    main()
