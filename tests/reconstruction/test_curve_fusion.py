"""Pieces become curves: neighbours against all distances, one curve from many pieces, links end to end."""

import math

import torch

from torchsfm.reconstruction.curves.fusion import count_different, fuse_pieces, near_pairs
from torchsfm.reconstruction.curves.pieces import Pieces

F64 = torch.float64


def test_pairs_are_those_of_all_distances(generator: torch.Generator) -> None:
    for n in (0, 1, 40, 300):
        X = torch.rand(n, 3, generator=generator, dtype=F64) * torch.tensor([3.0, 1.0, 0.2], dtype=F64)
        a, b = near_pairs(X, 0.15)
        near = (torch.cdist(X, X) <= 0.15) & ~torch.eye(n, dtype=torch.bool)
        found = torch.zeros(n, n, dtype=torch.bool)
        found[a, b] = True
        assert torch.equal(found, near)
        assert len(a) == near.sum()


def pieces(arcs: list[tuple[int, torch.Tensor]], noise: float, generator: torch.Generator) -> Pieces:
    """Of images and points, a hundredth apart."""
    X = torch.cat([x for _, x in arcs])
    X = X + noise * torch.randn(X.shape, generator=generator, dtype=F64)
    number = torch.tensor([len(x) for _, x in arcs])
    piece = torch.repeat_interleave(torch.arange(len(arcs)), number)
    image = torch.repeat_interleave(torch.tensor([i for i, _ in arcs]), number)
    one = torch.ones(len(X), dtype=F64)
    return Pieces(X, piece, image, torch.arange(len(X)), 0.004 * one, 0.004 * one)


def ring(first: float, last: float, step: float = 0.01) -> torch.Tensor:
    t = torch.arange(first, last, step, dtype=F64)
    return torch.stack((t.cos(), t.sin(), 0.2 * (2 * t).sin()), -1)


def test_overlapping_pieces_of_several_images_are_one_curve(generator: torch.Generator) -> None:
    arcs = []
    for image in range(5):
        # Of each image three arcs, either way, that end at different places.
        cuts = torch.rand(3, generator=generator).sort().values * 0.5 + torch.arange(3) * 2 * math.pi / 3
        for k, cut in enumerate(cuts.tolist()):
            last = cuts[(k + 1) % 3].item() + (2 * math.pi if k == 2 else 0)
            arc = ring(cut, last)
            arcs.append((image, arc.flip(0) if (image + k) % 2 else arc))
    # What one image alone has found.
    arcs.append((0, torch.tensor([3.0, 0, 0], dtype=F64) + ring(0, 1)))
    fused = fuse_pieces(pieces(arcs, 0.001, generator), least_images=3, shortest=4)
    assert fused.closed.tolist() == [True]
    assert fused.X.norm(dim=-1).max() < 1.5
    truth = ring(0, 2 * math.pi, 0.001)
    gap = torch.cdist(fused.X, truth).amin(-1)
    # The noise of five is averaged, in two directions: a single sample would leave 2e-6.
    assert gap.square().mean() < 1.2e-6
    assert torch.cdist(truth, fused.X).amin(-1).max() < 0.05
    assert (fused.images >= 3).all()
    step = (fused.X[1:] - fused.X[:-1]).norm(dim=-1)
    assert step.max() < 0.06


def test_pieces_end_to_end_are_linked_in_order(generator: torch.Generator) -> None:
    line = torch.zeros(60, 3, dtype=F64)
    line[:, 0] = 0.01 * torch.arange(60)
    parts = [line[:20], line[22:40].flip(0), line[42:]]
    arcs = [(image, parts[k]) for k in torch.randperm(3, generator=generator).tolist() for image in range(3)]
    # A curve that begins where this one ends, at a right angle, is another one.
    arcs += [(image, torch.stack((line[:, 1] + 0.6, line[:, 0] + 0.01, line[:, 2]), -1)) for image in range(3)]
    fused = fuse_pieces(pieces(arcs, 0.0, generator), least_images=3, shortest=4)
    assert sorted(torch.bincount(fused.curve).tolist()) == [56, 60]
    assert not fused.closed.any()
    for curve in range(2):
        x = fused.X[fused.curve == curve]
        step = x.diff(dim=0).sum(-1)
        assert (step > 0).all() or (step < 0).all()


def test_different_numbers_beside_each_are_counted(generator: torch.Generator) -> None:
    a, b = (torch.randint(6, (40,), generator=generator) for _ in range(2))
    wanted = [len(set(b[a == i].tolist())) for i in range(8)]
    assert count_different(a, b, 8).tolist() == wanted
    assert count_different(a[:0], b[:0], 3).tolist() == [0, 0, 0]
