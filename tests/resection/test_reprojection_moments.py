"""The normal equations of cameras from moments of the data, against those from Jacobians."""

import pytest
import torch
from torch import Tensor

from torchsfm.geometry.projection import camera_slopes
from torchsfm.geometry.radial import flatten
from torchsfm.resection.reprojection_step import normal_equations, squared_reprojection

F64 = torch.float64


@pytest.mark.parametrize("shared", [False, True])
def test_moments_are_those_of_the_jacobian(shared: bool, generator: torch.Generator) -> None:
    """Several cameras of the same data, or each with its own; points behind have infinite distance, and weigh nothing."""
    n, k = 30, 3
    P = torch.randn(2, k, 3, 4, generator=generator, dtype=F64)
    own = 1 if shared else k
    x = torch.randn(2, own, n, 2, generator=generator, dtype=F64)
    X = torch.randn(2, own, n, 3, generator=generator, dtype=F64)
    w, c = torch.rand(2, 2, k, n, generator=generator, dtype=F64)

    def weigh(squares: Tensor) -> tuple[Tensor, Tensor]:
        ahead = squares.isfinite()
        return torch.where(ahead, w, 0.0), torch.where(ahead, c, 0.0)

    points = torch.cat((X, torch.ones_like(X[..., :1])), -1)
    y = (points @ P.mT).movedim(-1, 0)
    uv, inverse = flatten(y)
    J = camera_slopes(points.movedim(-1, 0).expand(4, 2, k, n), uv, inverse).flatten(1, 2)
    r = uv - x.movedim(-1, 0)
    squares = squared_reprojection(P, x, X)
    torch.testing.assert_close(squares, torch.where(y[2] > 0, (r * r).sum(0), torch.inf), rtol=1e-9, atol=1e-12)
    slope, curvature = weigh(squares)
    A = torch.einsum("cibkn,cjbkn->bkij", J * curvature, J)
    g = torch.einsum("cibkn,cbkn->bki", J * slope, r)
    S, batch = normal_equations(P, x, X, weigh)
    assert batch == (2, k)
    S = S.view(2, k, 12, 13)
    torch.testing.assert_close(S[..., :12], A, rtol=1e-8, atol=1e-8 * float(A.abs().max()))
    torch.testing.assert_close(S[..., 12], -g, rtol=1e-8, atol=1e-8 * float(g.abs().max()))
