"""Thresholds that are tighter than the noise, and what is beyond a threshold and is none."""

import torch
from chance import seeded

from torchsfm import estimate_homography

F64 = torch.float64


def transfer(H: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    y = torch.cat((x, torch.ones_like(x[..., :1])), -1) @ H.mT
    return y[..., :2] / y[..., 2:]


def homographies(batch: int, generator: torch.Generator) -> torch.Tensor:
    scale = torch.tensor([[0.1, 0.1, 50], [0.1, 0.1, 50], [1e-4, 1e-4, 0]])
    return torch.eye(3, dtype=F64) + scale * torch.randn(batch, 3, 3, generator=generator, dtype=F64)


def test_noise_beyond_the_threshold_is_found(generator: torch.Generator) -> None:
    """With a threshold a quarter of a fitting one, the error is nearly that with the fitting one."""
    kind = {"generator": generator, "dtype": F64}
    H = homographies(24, generator)
    exact = torch.rand(24, 500, 2, **kind) * 1000
    x1 = exact + torch.randn(24, 500, 2, **kind)
    x2 = transfer(H, exact) + torch.randn(24, 500, 2, **kind)
    x2[:, 250:] = torch.rand(24, 250, 2, **kind) * 1000

    def error(threshold: float) -> torch.Tensor:
        found = estimate_homography(x1, x2, threshold=threshold, generator=seeded())
        return (transfer(found.model, exact) - transfer(H, exact)).norm(dim=-1).mean(-1)

    assert error(0.6).median() < 1.3 * error(2.5).median()


def test_a_crowd_beyond_the_threshold_is_no_noise(generator: torch.Generator) -> None:
    """Three of five are beside the right place, some thresholds off: the error is nearly that without them."""
    kind = {"generator": generator, "dtype": F64}
    H, x1 = homographies(24, generator), torch.rand(24, 400, 2, **kind) * 1000
    exact, wrong = transfer(H, x1), torch.rand(24, 400, **kind) < 0.6
    beside = 1.5 * torch.randn(24, 400, 2, **kind) + torch.tensor([4.0, 0.0])
    x2 = exact + torch.where(wrong[..., None], beside, 0.3 * torch.randn(24, 400, 2, **kind))

    def error(mask: torch.Tensor) -> torch.Tensor:
        found = estimate_homography(x1, x2, threshold=1.0, mask=mask, generator=seeded())
        return (transfer(found.model, x1) - exact).norm(dim=-1).mean()

    assert error(torch.ones_like(wrong)) < 1.3 * error(~wrong)
