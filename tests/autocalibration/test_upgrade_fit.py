"""The second derivatives of the fit of intrinsics and plane, which are found without those of a decomposition."""

import pytest
import torch
from torch import Tensor

from torchsfm.autocalibration.intrinsics_model import CONSTANT, VARYING_FOCAL, Assumption
from torchsfm.autocalibration.upgrade_fit import _WeighedDepartures

F64 = torch.float64


@pytest.mark.parametrize("coupled", [True, False])
@pytest.mark.parametrize("assume", [CONSTANT, VARYING_FOCAL], ids=["constant", "varying"])
def test_local_cost_has_the_derivatives_of_the_cost(assume: Assumption, coupled: bool, generator: torch.Generator) -> None:
    kind, b, v = {"generator": generator, "dtype": F64}, 3, 5
    P = torch.randn(b, v, 3, 4, **kind)
    P[:, 0] = torch.eye(3, 4)
    root = 0.1 * torch.randn(b, 12 * v, 12 * v, **kind)
    covariance = (root @ root.mT + 1e-2 * torch.eye(12 * v)).unflatten(1, (v, 12)).unflatten(3, (v, 12))
    if not coupled:
        covariance = covariance.diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)
    present = torch.ones(b, v, dtype=F64)
    present[0, -1] = 0
    spread = assume.spread(v, P)
    q = spread.shape[-1]
    weighed = _WeighedDepartures(spread, coupled)
    base, mean, precision = 0.1 * torch.randn(b, v, 5, **kind), torch.zeros(b, q, dtype=F64), 1 + torch.rand(b, q, **kind)
    data = (P, covariance, base, present, mean, precision)
    x = 0.1 * torch.randn(b, q + 3, **kind)

    def total(x: Tensor) -> Tensor:
        return weighed.residual(x, *data).square().sum() / 2

    def total_local(x: Tensor) -> Tensor:
        return weighed.local_cost(x, *data).sum()

    # The floor under the covariance, 1e-10 of it, stays where it is in one of them.
    torch.testing.assert_close(total_local(x), total(x), rtol=1e-10, atol=0)
    for derivative in (torch.autograd.functional.jacobian, torch.autograd.functional.hessian):
        wanted, found = (derivative(f, x) for f in (total, total_local))
        torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-6 * float(wanted.abs().max()))
