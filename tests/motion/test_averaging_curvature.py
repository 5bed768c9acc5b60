"""The second derivatives of edges and rays that are written out are those of the cost."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchsfm.geometry import random_rotation, rotation_from_rotvec
from torchsfm.motion.many_views.ray_sums import _ahead, _bend_ahead, _bend_sine, _linearize_ahead, _linearize_sine, _sine_scaled
from torchsfm.motion.many_views.rotation_residual import bend, linearize, residual
from torchsfm.optim import Block, Cauchy, GemanMcClure, Loss, Rotation, Term
from torchsfm.optim.curvature import curvature

F64 = torch.float64


def compare(term: Term, blocks: dict[str, Block], wanted: tuple[bool, bool], eliminated: str | None) -> None:
    own = torch.arange(len(term.index[0]))
    x = {name: block.x for name, block in blocks.items()}
    found, exact = (curvature(t, x, blocks, wanted, eliminated, (own, own)) for t in (term, replace(term, bend=None)))
    for mine, other in zip(found, exact, strict=True):
        assert mine.shape == other.shape
        if other.numel():
            torch.testing.assert_close(mine, other, rtol=1e-7, atol=1e-8 * float(other.abs().max()))


@pytest.mark.parametrize("wanted", [(True, True), (True, False), (False, True)])
@pytest.mark.parametrize("loss", [None, GemanMcClure(1.0)])
@pytest.mark.parametrize("size", [1e-8, 0.01, 0.035, 1.0, 3.0])
def test_edges(size: float, loss: Loss | None, wanted: tuple[bool, bool], generator: torch.Generator) -> None:
    """By how much edges are off reaches from nothing to nearly half a turn; series give way to closed forms at 0.03."""
    m = 20
    randn = lambda *shape: torch.randn(*shape, generator=generator, dtype=F64)  # noqa: E731
    rotations = random_rotation(2 * m, generator=generator, dtype=F64)
    a, b = rotations[:m], rotations[m:]
    off = size * torch.nn.functional.normalize(randn(m, 3), dim=-1)
    R = rotation_from_rotvec(off) @ b.mT @ a
    W = torch.linalg.cholesky(torch.eye(3, dtype=F64) + 0.3 * (A := randn(m, 3, 3)) @ A.mT)
    index = torch.arange(m), torch.arange(m, 2 * m)
    weights = 0.5 + torch.rand(m, generator=generator, dtype=F64)
    term = Term(residual, ("R", "R"), index, (R, W), loss, weights, linearize, bend)
    compare(term, {"R": Block(rotations.flatten(1).mT.contiguous().mT, Rotation())}, wanted, None)


@pytest.mark.parametrize("eliminated", ["X", None])
@pytest.mark.parametrize("wanted", [(True, True), (True, False), (False, True)])
@pytest.mark.parametrize("loss", [None, Cauchy(0.3)])
def test_rays(loss: Loss | None, wanted: tuple[bool, bool], eliminated: str | None, generator: torch.Generator) -> None:
    """Of points on both sides of where half rays begin, some behind the camera."""
    m = 40
    randn = lambda *shape: torch.randn(*shape, generator=generator, dtype=F64)  # noqa: E731
    blocks = {name: Block((2 * randn(m, 3)).mT.contiguous().mT) for name in ("c", "X")}
    D = blocks["X"].x - blocks["c"].x
    v = torch.nn.functional.normalize(randn(m, 3), dim=-1)
    index = torch.arange(m), torch.arange(m)
    far: Tensor = (v * D).sum(-1)
    assert bool((far > 1).any() and (far < 1).any() and (far < 0).any())
    for term in (
        Term(_ahead, ("c", "X"), index, (v,), loss, None, _linearize_ahead, _bend_ahead),
        Term(_sine_scaled, ("c", "X"), index, (20 * v, v), loss, None, _linearize_sine, _bend_sine),
    ):
        compare(term, blocks, wanted, eliminated)
