"""How many points are off every line or plane, at least, and how far they are from the best one."""

import pytest
import torch
from torch import Tensor

from torchsfm.geometry import least_number_off, line_and_plane_distances

F64 = torch.float64


def cloud(p: int, n: int, d: int, thickness: float, generator: torch.Generator) -> Tensor:
    """Points of a slab in a random direction."""
    X = torch.randn(p, n, d, generator=generator, dtype=F64)
    X[..., 0] = (torch.rand(p, n, generator=generator, dtype=F64) * 2 - 1) * thickness
    rotation = torch.linalg.qr(torch.randn(p, d, d, generator=generator, dtype=F64))[0]
    return X @ rotation + torch.randn(p, 1, d, generator=generator, dtype=F64)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("astray", [0, 1, 4, 15])
def test_it_is_never_more_than_what_some_hyperplane_misses(d: int, astray: int, generator: torch.Generator) -> None:
    X = cloud(200, 60, d, 0.01, generator)
    X[:, :astray] += 0.5 * torch.randn(200, astray, d, generator=generator, dtype=F64)
    X = X[:, torch.randperm(60, generator=generator)]
    everyone = torch.ones(200, 60, dtype=torch.bool)
    least = least_number_off(X, everyone, torch.full((200, 1), 0.011, dtype=F64))
    assert (least <= astray).all()
    # It comes near, where the points astray share few simplices.
    assert least.double().mean() > 0.4 * min(astray, 60 // (d + 1)) - 0.1


@pytest.mark.parametrize("d", [2, 3])
def test_points_everywhere_are_off_every_hyperplane(d: int, generator: torch.Generator) -> None:
    X = torch.rand(50, 120, d, generator=generator, dtype=F64)
    everyone = torch.ones(50, 120, dtype=torch.bool)
    number = 120 // (d + 1)
    assert (least_number_off(X, everyone, torch.full((50, 120), 1e-9, dtype=F64)) == number).all()
    assert (least_number_off(X, everyone, torch.full((50, 120), 0.01, dtype=F64)) > 0.6 * number).all()
    assert (least_number_off(X, everyone, torch.full((50, 120), 2.0, dtype=F64)) == 0).all()


@pytest.mark.parametrize("d", [2, 3])
def test_the_absent_the_few_and_the_repeated_prove_nothing(d: int, generator: torch.Generator) -> None:
    X = torch.rand(40, d, generator=generator, dtype=F64)
    present = torch.arange(40) % 4 == 1
    narrow = torch.full((40,), 1e-6, dtype=F64)
    wanted = least_number_off(X[present], torch.ones(10, dtype=torch.bool), narrow[:10])
    X[~present] = torch.nan
    assert least_number_off(X, present, narrow) == wanted == 10 // (d + 1)
    one = X[1].expand(40, d)
    for there in (torch.ones(40, dtype=torch.bool), present, torch.arange(40) < d, torch.zeros(40, dtype=torch.bool)):
        assert least_number_off(one, there, narrow) == 0
    assert least_number_off(X[:0], present[:0], narrow[:0]) == 0
    X = torch.rand(2, 3, 40, d, generator=generator, dtype=F64)
    there = torch.rand(2, 3, 40, generator=generator) < 0.6
    wide = 0.1 * torch.rand(2, 3, 40, generator=generator, dtype=F64)
    both = least_number_off(X, there, wide)
    assert [[int(least_number_off(X[i, j], there[i, j], wide[i, j])) for j in range(3)] for i in range(2)] == both.tolist()


def test_it_agrees_with_the_distances_to_the_best_line_and_plane(generator: torch.Generator) -> None:
    X = cloud(100, 60, 3, 0.3, generator)
    everyone = torch.ones(100, 60, dtype=torch.bool)
    _, distance = line_and_plane_distances(X, everyone)
    for tolerance in (0.003, 0.03, 0.1):
        least = least_number_off(X, everyone, torch.full((100, 1), tolerance, dtype=F64))
        assert (least <= (distance > tolerance).sum(-1)).all()
        assert (least > 0).any()
