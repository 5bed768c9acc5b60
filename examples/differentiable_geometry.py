"""Train a network through a solver: learn how far to trust each match so that the eight-point algorithm gets F right.

Half of the matches are wrong. Each comes with two numbers: how alike the two image patches looked, which is higher for right
matches but not by much, and one that means nothing. The network turns them into weights, `fundamental_8pt` turns the weighted
matches into F, and the loss is how well F fits points that took no part: its gradient reaches the network through the solver.
Each step takes image pairs never seen before, up to step 30 with more and more wrong matches, so the printed loss wavers.

    python examples/differentiable_geometry.py
"""

import torch
from torch import Tensor, nn

from torchsfm.geometry import Camera, intrinsics, sampson_distance
from torchsfm.motion import fundamental_8pt
from torchsfm.simulation import random_points, random_poses, simulate_images

SIZE = (1000, 750)


def problems(count: int, outliers: float, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Matches x1, x2 of many image pairs with two clues each, and exact matches y1, y2 of other points to learn from."""
    X = random_points(count, 220, generator=generator)
    poses = random_poses(count, 2, generator=generator)
    camera = Camera(intrinsics(torch.tensor(900.0).double(), torch.tensor(SIZE).double() / 2))
    images = simulate_images(X, poses, camera, image_size=SIZE, noise=0.5, outliers=outliers, generator=generator)
    right = images.visible.all(1) & ~images.outlier.any(1)
    alike = torch.randn(right.shape, generator=generator, dtype=torch.float64) + 2.5 * right
    nothing = torch.randn(right.shape, generator=generator, dtype=torch.float64)
    x1, x2 = images.x[:, 0, :200], images.x[:, 1, :200]
    y1, y2 = images.x_true[:, 0, 200:], images.x_true[:, 1, 200:]
    return x1, x2, torch.stack((alike, nothing), -1)[:, :200], y1, y2


def main(seed: int = 0) -> None:
    """Train for a few seconds, then compare on image pairs never seen."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    network = nn.Sequential(nn.Linear(2, 16), nn.Tanh(), nn.Linear(16, 1)).double()
    optimizer = torch.optim.Adam(network.parameters(), lr=0.05)
    for step in range(151):
        # Few wrong matches at first. Where half are wrong, trusting all alike is nearly the worst choice: trusting the wrong
        # ones a little more is better too, and leads to a plain where the derivative says nothing.
        x1, x2, clues, y1, y2 = problems(64, 0.05 + 0.25 * min(step / 30, 1), generator)
        logits = network(clues)[..., 0]
        # Where F is hardly determined its derivative is huge and says little. No pair is to outvote the others.
        logits.register_hook(lambda g: g / g.norm(dim=-1, keepdim=True).clamp_min(1e-12))
        F = fundamental_8pt(x1, x2, logits.softmax(-1))
        loss = torch.log1p(sampson_distance(F, y1, y2)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % 30 == 0:
            print(f"step {step:3d}: loss {loss.item():.3f}")
    x1, x2, clues, y1, y2 = problems(200, 0.3, generator)
    with torch.no_grad():
        for name, weights in {
            "all matches alike": torch.ones_like(x1[..., 0]),
            "weights of the network": network(clues)[..., 0].softmax(-1),
        }.items():
            error = sampson_distance(fundamental_8pt(x1, x2, weights), y1, y2).mean(-1)
            print(f"{name}: median error {error.median().item():.2f} px")


if __name__ == "__main__":
    main()
