"""The path through candidates: against all paths there are."""

import itertools

import torch
from torch import Tensor

from torchsfm.triangulation.curve_path import best_path

F64 = torch.float64


def rays(p: int, m: int) -> Tensor:
    """A fan, a hundredth apart."""
    angle = 0.01 * torch.arange(m, dtype=F64)
    return torch.stack((angle.sin(), torch.zeros_like(angle), angle.cos()), -1).expand(p, m, 3)


def test_no_path_has_more_votes(generator: torch.Generator) -> None:
    p, m, c = 20, 5, 3
    kind = {"generator": generator, "dtype": F64}
    depth, votes = 1 + torch.rand(p, m, c, **kind), torch.rand(p, m, c, **kind) + 0.1
    found = best_path(depth, votes, torch.zeros_like(depth), rays(p, m), c)
    stride = 2 * torch.tensor(0.005, dtype=F64).sin()
    for i in range(p):

        def total(d: Tensor, v: Tensor) -> float:
            leap = (d[1:] - d[:-1]).abs() / (10 * stride * d[:-1])
            return float(v.sum() - 0.3 * leap.clamp(max=1).sum())

        slots = [torch.tensor(s)[:, None] for s in itertools.product(range(c), repeat=m)]
        best = max(slots, key=lambda s: total(depth[i].gather(1, s)[:, 0], votes[i].gather(1, s)[:, 0]))
        assert torch.equal(found.depth[i], depth[i].gather(1, best)[:, 0])


def test_a_path_is_sure_where_it_is_well_ahead(generator: torch.Generator) -> None:
    m = 40
    true = 2 + 0.01 * torch.randn(m, dtype=F64, generator=generator).cumsum(0)
    depth = torch.stack((true, true + 1, torch.zeros_like(true)), -1)[None]
    for lead, sure in ((0.6, True), (0.01, False)):
        # The other path is behind by so much at each sample.
        votes = torch.tensor([2.0, 2.0 - lead, 0.0], dtype=F64).expand(1, m, 3).clone()
        found = best_path(depth, votes, torch.zeros_like(depth), rays(1, m), 3)
        assert torch.equal(found.sure, torch.full((1, m), sure))
    votes[..., 1] = 1.0
    # Here the true one is missing.
    votes[0, 20] = torch.tensor([0.0, 2.0, 0.0], dtype=F64)
    found = best_path(depth, votes, torch.zeros_like(depth), rays(1, m), 3)
    assert torch.equal(found.depth[0, found.sure[0]], true[found.sure[0]])
    assert found.sure.sum() == m - 1
    # Three samples in a row are no curve.
    votes[:] = 0
    votes[0, 10:13, 0], votes[0, 20:24, 0] = 2.0, 2.0
    found = best_path(depth, votes, torch.zeros_like(depth), rays(1, m), 3)
    assert found.sure[0].nonzero()[:, 0].tolist() == [20, 21, 22, 23]


def test_candidates_that_views_cannot_tell_apart_are_no_rivals(generator: torch.Generator) -> None:
    true = 2 + 0.001 * torch.randn(30, dtype=F64, generator=generator)
    depth = torch.stack((true, true + 0.2), -1)[None]
    votes = torch.ones_like(depth)
    for blur, sure in ((0.0, False), (0.3, True)):
        assert bool(best_path(depth, votes, torch.full_like(depth, blur), rays(1, 30), 2).sure.all()) == sure


def test_no_curves() -> None:
    none = torch.zeros(0, 12, 3, dtype=F64)
    assert best_path(none, none, none, torch.zeros(0, 12, 3, dtype=F64), 2).sure.shape == (0, 12)
