"""Similarities of local models: right ones from wrong edges, loops that close, statuses where there is nothing to say."""

import math
from dataclasses import dataclass

import pytest
import torch
from chance import assert_share, seeded
from torch import Tensor

from torchsfm import Status
from torchsfm.geometry import Similarity, random_rotation, rotation_from_rotvec, similarity_from_points
from torchsfm.motion import average_similarities
from torchsfm.motion.many_views.triplets import turn_angle


@dataclass(frozen=True)
class Windows:
    """Local models along a loop: where they are, and what those that share something say of each other."""

    world: Similarity
    edges: Tensor
    places: Tensor
    between: Similarity
    deviation: Tensor
    wrong: Tensor


def windows(count: int, loops: int, wrong: int, noise: float, generator: torch.Generator) -> Windows:
    """Each with the two next ones, the last with the first in `loops` ways, and some at random whose edges are wrong."""
    normal = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    angle = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    centre = torch.stack((angle.cos(), angle.sin(), 0 * angle), -1) * count / (2 * math.pi)
    R = random_rotation(count, generator=generator, dtype=torch.float64)
    world = Similarity((0.3 * normal(count)).exp(), R, centre)
    back = torch.arange(loops)
    edges = [torch.stack((torch.arange(count - k), torch.arange(k, count)), 1) for k in (1, 2)]
    edges += [
        torch.stack((back // 2, count - 1 - back % 2 - back // 2), 1),
        torch.randint(count // 2, (wrong, 2), generator=generator),
    ]
    edges[-1][:, 1] += count // 2
    i, j = (joined := torch.cat(edges)).unbind(-1)
    X = 0.5 * (centre[i] + centre[j])[:, None] + normal(len(joined), 10, 3)
    seen = [_part(world, k).inverse().transform(X) + noise * normal(*X.shape) / world.scale[k, None, None] for k in (i, j)]
    false = torch.arange(len(joined)) >= len(joined) - wrong
    seen[1] = torch.where(false[:, None, None], normal(*X.shape), seen[1])
    between = similarity_from_points(*seen)
    return Windows(world, joined, seen[0], between, max(noise, 1e-9) / world.scale[j], false)


def _part(S: Similarity, index: Tensor) -> Similarity:
    return Similarity(S.scale[index], S.R[index], S.t[index])


def answer(w: Windows) -> Similarity:
    """With the first model as the world."""
    s, R, t = w.world.scale, w.world.R, w.world.t
    return Similarity(s / s[0], R[0].mT @ R, ((t - t[0]) @ R[0]) / s[0])


def test_a_chain_which_all_edges_fit_has_a_minimum(generator: torch.Generator) -> None:
    """Nothing is left of the cost but rounding, that of places many deviations from each other."""
    w = windows(8, 0, 0, 1e-3, generator)
    row = (w.edges.diff(dim=1)[:, 0] == 1).nonzero()[:, 0]
    found = average_similarities(
        _part(w.between, row), w.edges[row], models=8, places=w.places[row], deviation=w.deviation[row]
    )
    assert (found.status == Status.OK).all()
    assert found.inliers.all()
    assert found.distance.max() < 1e-6


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_exact_edges_give_exact_similarities(dtype: torch.dtype, generator: torch.Generator) -> None:
    w = windows(20, 4, 3, 0.0, generator)
    between = Similarity(*(part.to(dtype) for part in (w.between.scale, w.between.R, w.between.t)))
    found = average_similarities(between, w.edges, models=20, places=w.places.to(dtype))
    wanted, tolerance = answer(w), 1e-6 if dtype == torch.float64 else 2e-3
    assert found.model.t.dtype == dtype
    assert bool((found.status == Status.OK).all())
    assert torch.equal(found.inliers, ~w.wrong)
    assert torch.allclose(found.model.scale.double(), wanted.scale, rtol=tolerance)
    assert float(turn_angle(found.model.R.double() @ wanted.R.mT).max()) < tolerance
    assert torch.allclose(found.model.t.double(), wanted.t, atol=10 * tolerance)


@pytest.mark.parametrize("stream", range(3))
def test_loops_close(stream: int) -> None:
    w = windows(100, 6, 4, 0.02, seeded(stream))
    options = {"models": 100, "places": w.places, "deviation": w.deviation}
    found = average_similarities(w.between, w.edges, **options)  # type: ignore[arg-type]
    chain = (w.edges[:, 1] - w.edges[:, 0]) <= 2
    alone = average_similarities(
        _part(w.between, chain), w.edges[chain], models=100, places=w.places[chain], deviation=w.deviation[chain]
    )
    assert bool((found.status == Status.OK).all())
    assert not bool(found.inliers[w.wrong].any())
    assert float(found.inliers[~w.wrong].double().mean()) > 0.98
    wanted = answer(w)

    def gap(s: Similarity) -> float:
        return float((s.t[-1] - wanted.t[-1]).norm())

    assert gap(found.model) < 0.5 * gap(alone.model) + 0.1


def test_the_unit_of_a_model_is_its_own(generator: torch.Generator) -> None:
    w = windows(15, 4, 0, 0.02, generator)
    i, j = w.edges.unbind(-1)
    unit = (0.5 * torch.randn(15, generator=generator, dtype=torch.float64)).exp()
    other = Similarity(w.between.scale * unit[j] / unit[i], w.between.R, w.between.t * unit[j, None])
    plain = average_similarities(w.between, w.edges, models=15, places=w.places, deviation=w.deviation)
    scaled = average_similarities(
        other, w.edges, models=15, places=w.places * unit[i, None, None], deviation=w.deviation * unit[j]
    )
    assert torch.allclose(scaled.model.scale * unit / unit[0], plain.model.scale, rtol=1e-2)
    assert torch.allclose(scaled.model.t, plain.model.t * unit[0], atol=0.05 * float(unit[0]))


def test_bad_edges_change_nothing(generator: torch.Generator) -> None:
    w = windows(10, 2, 0, 0.01, generator)
    plain = average_similarities(w.between, w.edges, models=12, places=w.places, deviation=w.deviation)
    first = torch.arange(6)
    scale, R, t = w.between.scale[first].clone(), w.between.R[first].clone(), w.between.t[first].clone()
    edges, places, deviation = w.edges[first].clone(), w.places[first].clone(), w.deviation[first].clone()
    scale[0], R[1, 0, 0], t[2, 0], edges[3], places[4] = -1.0, torch.nan, torch.inf, 11, 1.0
    deviation[5] = 0.0
    bad = Similarity(*(torch.cat(pair) for pair in ((scale, w.between.scale), (R, w.between.R), (t, w.between.t))))
    found = average_similarities(
        bad, torch.cat((edges, w.edges)), models=12, places=torch.cat((places, w.places)),
        deviation=torch.cat((deviation, w.deviation)),
    )  # fmt: skip
    assert torch.equal(found.model.t, plain.model.t)
    assert torch.equal(found.distance[6:], plain.distance)
    assert bool((found.distance[:6] == torch.inf).all())
    assert found.status.tolist() == [Status.OK] * 10 + [Status.TOO_FEW] * 2
    assert found.component.tolist() == [0] * 10 + [10, 11]


@pytest.mark.parametrize("models", [0, 1, 3])
def test_no_edges(models: int) -> None:
    none = Similarity(torch.zeros(0), torch.zeros(0, 3, 3), torch.zeros(0, 3))
    found = average_similarities(none, torch.zeros(0, 2, dtype=torch.long), models=models)
    assert found.status.tolist() == [Status.TOO_FEW] * models
    assert torch.equal(found.model.scale, torch.ones(models))
    assert found.component.tolist() == list(range(models))


def test_wrong_arguments_are_named(unchecked: None, generator: torch.Generator) -> None:
    w = windows(6, 2, 0, 0.0, generator)
    with pytest.raises(ValueError, match="edges"):
        average_similarities(w.between, w.edges, models=4)
    with pytest.raises(ValueError, match="places"):
        average_similarities(w.between, w.edges, models=6, places=w.places[:, :2])
    with pytest.raises(ValueError, match="deviation"):
        average_similarities(w.between, w.edges, models=6, deviation=w.deviation[:3])


def test_scales_beyond_all_numbers_are_told() -> None:
    R, t = torch.eye(3, dtype=torch.float64).expand(6, 3, 3), torch.zeros(6, 3, dtype=torch.float64)
    ratio = torch.tensor([1e-66, 1e223, 1e270, 1e-210, 1e-186, 1e-284], dtype=torch.float64)
    found = average_similarities(Similarity(ratio, R, t), torch.combinations(torch.arange(4)), models=4)
    good = found.status == Status.OK
    assert bool((found.model.scale[good].isfinite() & (found.model.scale[good] > 0)).all())
    assert not bool(good.all())


@pytest.mark.parametrize(("wrong", "noise"), [(0, 0.01), (1, 0.0), (8, 0.01)])
def test_one_loop_that_does_not_close_is_told(wrong: int, noise: float) -> None:
    g, told = seeded(wrong), []
    for _ in range(8):
        world = random_rotation(8, generator=g, dtype=torch.float64)
        i, j = torch.arange(8), torch.arange(1, 9) % 8
        R = world[j].mT @ world[i] @ rotation_from_rotvec(noise * torch.randn(8, 3, generator=g, dtype=torch.float64))
        R[:wrong] = random_rotation(wrong, generator=g, dtype=torch.float64)
        t = noise * torch.randn(8, 3, generator=g, dtype=torch.float64)
        found = average_similarities(Similarity(torch.ones_like(t[:, 0]), R, t), torch.stack((i, j), 1), models=8)
        told.append((found.status == (Status.NO_CONSENSUS if wrong else Status.OK)).all())
    # Nobody knows how large the noise is, but unrelated models would close a loop as well; few do so by chance.
    assert_share(torch.stack(told), 0.95)


def test_loops_that_close_say_nothing_of_others() -> None:
    """Two loops share a model, the first of all: what one says does not follow from the other."""
    g, right, wrong = seeded(5), [], []
    edges = torch.tensor([(k, (k + 1) % 8) for k in range(8)] + [(0, 8), *((k, k + 1) for k in range(8, 14)), (14, 0)])
    i, j = edges.unbind(1)
    for _ in range(10):
        world = Similarity(
            torch.ones(15, dtype=torch.float64),
            random_rotation(15, generator=g, dtype=torch.float64),
            torch.randn(15, 3, generator=g, dtype=torch.float64),
        )
        X = torch.randn(16, 10, 3, generator=g, dtype=torch.float64)
        seen = [_part(world, k).inverse().transform(X) for k in (i, j)]
        seen = [x + 0.01 * torch.randn(x.shape, generator=g, dtype=torch.float64) for x in seen]
        seen[1][8:] = torch.randn(8, 10, 3, generator=g, dtype=torch.float64)
        between, deviation = similarity_from_points(*seen), torch.full((16,), 0.01, dtype=torch.float64)
        found = average_similarities(between, edges, models=15, places=seen[0], deviation=deviation)
        right.append((found.status[:8] == Status.OK).all())
        wrong.append((found.status[8:] == Status.OK).any())
    assert_share(torch.stack(right), 0.9)
    assert_share(~torch.stack(wrong), 0.95)
