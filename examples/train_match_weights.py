"""Train a network through RANSAC: learn from descriptors which matches to draw samples from.

Two thirds of the matches are wrong. A match comes with what a matcher knows: the distance of the two descriptors, that to the
second-best candidate, and the score of the detector, which tells nothing. A small network turns them into logits, by which
`soft_ransac` draws samples; the loss is how badly the hypotheses it then chooses fit exact points that took no part. Its
expectation has a derivative although drawing and choosing have none. The trained logits then guide `soft_ransac` with few
hypotheses, and `ransac` as its `quality`.

    python examples/train_match_weights.py
"""

import torch
from torch import Tensor, nn

from torchsfm.geometry import Camera, intrinsics, sampson_distance
from torchsfm.motion import FundamentalEstimator, estimate_fundamental
from torchsfm.robust import soft_ransac
from torchsfm.simulation import random_points, random_poses, simulate_images

SIZE = (1000, 750)
MATCHES = 120
SCALE = 500.0
"""Points are handed over in units of half the image, about its centre; one pixel is 1 / SCALE."""


def problems(count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Matches x1, x2 of many image pairs with three clues each, and exact matches y1, y2 of other points to learn from."""
    X = random_points(count, MATCHES + 30, generator=generator)
    poses = random_poses(count, 2, generator=generator)
    camera = Camera(intrinsics(torch.tensor(900.0).double(), torch.tensor(SIZE).double() / 2))
    images = simulate_images(X, poses, camera, image_size=SIZE, noise=0.5, outliers=0.4, generator=generator)
    right = images.visible.all(1) & ~images.outlier.any(1)

    def normal() -> Tensor:
        return torch.randn(right.shape, generator=generator, dtype=torch.float64)

    nearest = 0.8 - 0.25 * right + 0.12 * normal()
    second = 1.0 + 0.12 * normal()
    clues = torch.stack((nearest, second, normal()), -1)[:, :MATCHES]
    x = (images.x - torch.tensor(SIZE).double() / 2) / SCALE
    y = (images.x_true - torch.tensor(SIZE).double() / 2) / SCALE
    return x[:, 0, :MATCHES], x[:, 1, :MATCHES], clues, y[:, 0, MATCHES:], y[:, 1, MATCHES:]


def error(model: Tensor, y1: Tensor, y2: Tensor) -> Tensor:
    """Mean distance in pixels of the exact points from their epipolar geometry."""
    return SCALE * sampson_distance(model[..., :3], y1, y2).mean(-1)


def main(steps: int = 60, seed: int = 0) -> None:
    """Train for half a minute, then compare on image pairs never seen."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    network = nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, 1)).double()
    optimizer = torch.optim.Adam(network.parameters(), lr=0.05)
    for step in range(steps + 1):
        x1, x2, clues, y1, y2 = problems(32, generator)
        logits = network(clues)[..., 0]
        # At first hardly one sample in two thousand is free of wrong matches: few hypotheses would find nothing to learn from.
        hypotheses = soft_ransac(
            FundamentalEstimator(), x1, x2, threshold=3 / SCALE, logits=logits, hypotheses=64, generator=generator
        )
        loss = torch.log1p(error(hypotheses.model, y1[:, None, None], y2[:, None, None]))
        expected = hypotheses.expectation(loss).mean()
        optimizer.zero_grad()
        expected.backward()
        optimizer.step()
        if step % 15 == 0:
            print(f"step {step:3d}: expected loss {expected.item():.3f}")

    x1, x2, clues, y1, y2 = problems(200, generator)
    with torch.no_grad():
        learned = network(clues)[..., 0]
    for name, logits in {"uniform samples": torch.zeros_like(learned), "learned samples": learned}.items():
        few = soft_ransac(
            FundamentalEstimator(), x1, x2, threshold=3 / SCALE, logits=logits, hypotheses=32,
            generator=torch.Generator().manual_seed(1),
        ).best()  # fmt: skip
        print(f"best of 32 hypotheses, {name}: median error {error(few, y1, y2).median().item():.2f} px")
    for name, scores in {"without scores": None, "with learned scores": learned}.items():
        result = estimate_fundamental(
            x1, x2, threshold=2 / SCALE, quality=scores, max_iterations=64, generator=torch.Generator().manual_seed(1)
        )
        print(f"ransac with 64 samples, {name}: median error {error(result.model, y1, y2).median().item():.2f} px")


if __name__ == "__main__":
    main()
