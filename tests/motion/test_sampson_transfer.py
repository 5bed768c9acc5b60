"""Sampson's distance to a homography."""

import torch
from chance import seeded

from torchsfm.motion import HomographyEstimator


def test_many_models_of_the_same_pairs_are_as_each_by_itself() -> None:
    g, kind = seeded(), {"dtype": torch.float64}
    H = torch.randn(5, 12, 3, 3, generator=g, **kind)
    x1, x2 = torch.randn(2, 5, 1, 40, 2, generator=g, **kind).unbind(0)
    estimator = HomographyEstimator()
    together = estimator.squared_residual(H, x1, x2)
    alone = torch.stack([estimator.squared_residual(h[:, None], x1, x2)[:, 0] for h in H.unbind(1)], 1)
    assert together.shape == (5, 12, 40)
    torch.testing.assert_close(together, alone, rtol=1e-6, atol=1e-6)
