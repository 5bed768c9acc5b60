"""Robust estimation as a batched operation: the motion between 64 image pairs, of different sizes, in one call.

Every pair has between 100 and 400 matches, of which nearly half are wrong. The matches of all pairs lie in one tensor, padded
to the longest, and `mask` says which of them exist. Each pair draws as many samples as it needs and then leaves the batch; its
result is what it would be alone: the same inliers, the same model up to rounding.

    python examples/batched_ransac.py
"""

import time

import torch

from torchsfm.geometry import Camera, intrinsics, sampson_distance
from torchsfm.motion import estimate_fundamental
from torchsfm.simulation import random_points, random_poses, simulate_images

SIZE = (1000, 750)


def main(pairs: int = 64) -> None:
    """Make the pairs, estimate all of them, then a few alone."""
    generator = torch.Generator().manual_seed(0)
    X = random_points(pairs, 400, generator=generator)
    poses = random_poses(pairs, 2, generator=generator)
    camera = Camera(intrinsics(torch.tensor(900.0).double(), torch.tensor(SIZE).double() / 2))
    images = simulate_images(X, poses, camera, image_size=SIZE, noise=1.0, outliers=0.25, generator=generator)
    count = torch.randint(100, 401, (pairs, 1), generator=generator)
    mask = images.visible.all(1) & (torch.arange(400) < count)
    x1, x2 = images.x.unbind(1)

    clock = time.perf_counter()
    result = estimate_fundamental(x1, x2, threshold=2.0, mask=mask, generator=torch.Generator().manual_seed(1))
    seconds = time.perf_counter() - clock

    wrong = images.outlier.any(1)
    error = sampson_distance(result.model, *images.x_true.unbind(1))
    right = mask & ~wrong
    error = torch.where(right, error, 0).sum(-1) / right.sum(-1)
    print(f"{pairs} pairs with {mask.sum(-1).min()} to {mask.sum(-1).max()} matches: {1000 * seconds / pairs:.1f} ms per pair")
    print(f"samples drawn: {result.iterations.min()} to {result.iterations.max()}")
    print(
        f"wrong matches in: {wrong[mask].double().mean():.0%}, among the inliers: {wrong[result.inliers].double().mean():.1%}"
    )
    print(f"distance of the exact points from F: median {error.median():.2f} px, largest {error.max():.2f} px")

    alone = estimate_fundamental(x1[:1], x2[:1], threshold=2.0, mask=mask[:1], generator=torch.Generator().manual_seed(1))
    same, gap = torch.equal(alone.inliers, result.inliers[:1]), (alone.model - result.model[:1]).abs().max()
    print(f"the first pair alone gives the same inliers: {same}, and F but for {gap:.0e}")


if __name__ == "__main__":
    main()
