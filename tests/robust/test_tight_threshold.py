"""Thresholds that are tighter than the noise."""

import torch
from chance import seeded

from torchsfm import estimate_homography

F64 = torch.float64


def transfer(H: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    y = torch.cat((x, torch.ones_like(x[..., :1])), -1) @ H.mT
    return y[..., :2] / y[..., 2:]


def test_noise_beyond_the_threshold_is_found(generator: torch.Generator) -> None:
    """With a threshold a quarter of a fitting one, the error is nearly that with the fitting one."""
    kind = {"generator": generator, "dtype": F64}
    H = torch.eye(3, dtype=F64) + torch.tensor([[0.1, 0.1, 50], [0.1, 0.1, 50], [1e-4, 1e-4, 0]]) * torch.randn(
        24, 3, 3, **kind
    )
    exact = torch.rand(24, 500, 2, **kind) * 1000
    x1 = exact + torch.randn(24, 500, 2, **kind)
    x2 = transfer(H, exact) + torch.randn(24, 500, 2, **kind)
    x2[:, 250:] = torch.rand(24, 250, 2, **kind) * 1000

    def error(threshold: float) -> torch.Tensor:
        found = estimate_homography(x1, x2, threshold=threshold, generator=seeded())
        return (transfer(found.model, exact) - transfer(H, exact)).norm(dim=-1).mean(-1)

    assert error(0.6).median() < 1.3 * error(2.5).median()
