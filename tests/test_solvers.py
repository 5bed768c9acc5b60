"""The laws that every solver of every room obeys, on the scenes of the benchmark."""

import importlib
import inspect

import pytest
import torch
from chance import assert_share

from bench.cases import CASES, Case
from bench.cases.case import Sample, nearest
from torchsfm._types import Solutions

ROOMS = tuple(importlib.import_module(f"torchsfm.{name}") for name in ("motion", "resection"))
NAMES = {solver.__name__ for room in ROOMS for solver in room.SOLVERS}
F64 = torch.float64


def draw(case: Case, batch: int, generator: torch.Generator, family: str = "random") -> Sample:
    return tuple(x.clone() for x in case.scene(family, batch, generator, F64)[0])


ALL = [case for case in CASES if case.name in NAMES]
cases = pytest.mark.parametrize("case", ALL, ids=lambda case: case.name)
with_several_arguments = pytest.mark.parametrize(
    "case", [case for case in ALL if len(draw(case, 1, torch.Generator())) > 1], ids=lambda case: case.name
)


def close(a: Solutions[torch.Tensor], b: Solutions[torch.Tensor]) -> bool:
    """Alone or in any batch: the same up to rounding."""
    return torch.equal(a.valid, b.valid) and torch.allclose(a.model, b.model, rtol=1e-9, atol=1e-9)


def same(a: Solutions[torch.Tensor], b: Solutions[torch.Tensor]) -> bool:
    return torch.equal(a.valid, b.valid) and torch.equal(a.model, b.model)


def at(solutions: Solutions[torch.Tensor], index: object) -> Solutions[torch.Tensor]:
    return Solutions(solutions.model[index], solutions.valid[index])  # type: ignore[index]


@pytest.mark.parametrize("room", ROOMS, ids=lambda room: room.__name__)
def test_the_registry_is_complete(room: object) -> None:
    """What a room exports and returns `Solutions` is in its `SOLVERS`, and has scenes."""
    public = (getattr(room, name) for name in room.__all__)  # type: ignore[attr-defined]
    solvers = {f for f in public if inspect.isfunction(f) and "Solutions[" in str(inspect.signature(f).return_annotation)}
    assert solvers == set(room.SOLVERS)  # type: ignore[attr-defined]
    assert {solver.__name__ for solver in solvers} <= {case.name for case in CASES}


@cases
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_recall(case: Case, dtype: torch.dtype, generator: torch.Generator) -> None:
    sample, truth = case.scene("random", 1000, generator, dtype)
    solutions = case.solve(*sample)
    assert solutions.model.dtype == dtype
    assert solutions.valid.shape == (1000, case.slots)
    assert solutions.model.isfinite().all()
    assert_share(nearest(case, solutions, truth) < case.tolerances[dtype], 0.999 if dtype == F64 else 0.98)


@cases
def test_recall_on_hard_scenes(case: Case, generator: torch.Generator) -> None:
    for family in case.families:
        sample, truth = case.scene(family, 500, generator, F64)
        assert_share(nearest(case, case.solve(*sample), truth) < case.tolerances[F64], 0.98)


@cases
def test_valid_slots_differ(case: Case, generator: torch.Generator) -> None:
    solutions = case.solve(*draw(case, 1000, generator))
    flat = torch.nn.functional.normalize(solutions.model.flatten(2), dim=-1)
    gap = torch.minimum((flat[:, :, None] - flat[:, None]).norm(dim=-1), (flat[:, :, None] + flat[:, None]).norm(dim=-1))
    both = solutions.valid[:, :, None] & solutions.valid[:, None] & ~torch.eye(case.slots, dtype=torch.bool)
    assert_share(~((gap < 1e-9) & both).flatten(1).any(-1), 0.995)


@cases
@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,), (4, 0)])
def test_any_batch_is_its_elements(case: Case, shape: tuple[int, ...], generator: torch.Generator) -> None:
    sample = draw(case, 6, generator)
    count = torch.Size(shape).numel()
    found = case.solve(*(x[:count].reshape((*shape, *x.shape[1:])) for x in sample))
    assert found.valid.shape == (*shape, case.slots)
    whole = case.solve(*sample)
    flat = Solutions(found.model.reshape(count, *whole.model.shape[1:]), found.valid.reshape(count, case.slots))
    assert close(flat, at(whole, slice(count)))
    for i in range(count):
        assert close(case.solve(*(x[i] for x in sample)), at(whole, i))


@with_several_arguments
def test_batches_broadcast(case: Case, generator: torch.Generator) -> None:
    """Also where derivatives are wanted of an argument that has no batch, or is the only one that has."""
    first, *others = draw(case, 3, generator)
    wide = case.solve(first[:, None], *(x[None, :2] for x in others))
    assert wide.valid.shape == (3, 2, case.slots)
    assert close(at(wide, (1, 1)), case.solve(first[1], *(x[1] for x in others)))
    for inputs in ((first, *(x[0] for x in others)), (first[0], *others)):
        inputs = tuple(x.requires_grad_() for x in inputs)
        found = case.solve(*inputs)
        plain = case.solve(*(x.detach() for x in inputs))
        assert same(Solutions(found.model.detach(), found.valid), plain)
        slopes = torch.autograd.grad(found.model.sum(), inputs)
        assert all(slope.shape == x.shape and slope.isfinite().all() for slope, x in zip(slopes, inputs, strict=True))


@cases
def test_inputs_stay_and_may_be_strided(case: Case, generator: torch.Generator) -> None:
    sample = draw(case, 12, generator)
    copies = [x.clone() for x in sample]
    reference = case.solve(*sample)
    assert same(case.solve(*(x.repeat_interleave(2, 0)[::2] for x in sample)), reference)
    assert all(torch.equal(x, copy) for x, copy in zip(sample, copies, strict=True))


@cases
@pytest.mark.parametrize("poison", [torch.nan, torch.inf, -torch.inf])
def test_bad_values_have_no_solution_and_spoil_none(case: Case, poison: float, generator: torch.Generator) -> None:
    sample = draw(case, 24, generator)
    good = case.solve(*sample)
    others = torch.arange(24) != 5
    for k in range(len(sample)):
        bad = [x.clone() for x in sample]
        bad[k].view(24, -1)[5, -1] = poison
        found = case.solve(*bad)
        assert not found.valid[5].any()
        assert found.model.isfinite().all()
        assert same(at(found, others), at(good, others))


@cases
def test_degenerate_samples_spoil_none(case: Case, generator: torch.Generator) -> None:
    sample = draw(case, 24, generator)
    good = case.solve(*sample)
    others = torch.arange(24) != 5
    for family in case.degenerate:
        mixed = [x.clone() for x in sample]
        for x, y in zip(mixed, draw(case, 1, generator, family), strict=True):
            x[5] = y[0]
        found = case.solve(*mixed)
        assert found.model.isfinite().all(), family
        assert same(at(found, others), at(good, others)), family
    for factor in (0.0, 1e-300, 1e300):
        found = case.solve(*(torch.where(others.reshape(-1, *[1] * (x.ndim - 1)), x, factor * x) for x in sample))
        assert found.model.isfinite().all(), factor
        assert same(at(found, others), at(good, others)), factor


@cases
def test_derivatives_are_finite_and_change_no_value(case: Case, generator: torch.Generator) -> None:
    sample = draw(case, 40, generator)
    sample[0][:3] = torch.nan
    sample[-1][3:6] = 0
    plain = case.solve(*sample)
    inputs = [x.clone().requires_grad_() for x in sample]
    found = case.solve(*inputs)
    assert same(Solutions(found.model.detach(), found.valid), plain)
    empty = torch.autograd.grad(found.model[~found.valid].sum(), inputs, retain_graph=True, materialize_grads=True)
    assert all((slope == 0).all() for slope in empty)
    assert all(slope.isfinite().all() for slope in torch.autograd.grad(found.model.sum(), inputs))


@cases
def test_derivatives_are_those_of_the_solutions(case: Case, generator: torch.Generator) -> None:
    """Along a random line through each argument, from the nearest slots on both sides of it."""
    step, rows = 1e-6, torch.arange(100)
    sample = draw(case, 100, generator)
    inputs = [x.clone().requires_grad_() for x in sample]
    found = case.solve(*inputs)
    slot = found.valid.long().argmax(-1)
    model = found.model[rows, slot].flatten(1)
    weights = torch.randn(model.shape, generator=generator, dtype=F64)
    slopes = torch.autograd.grad((model * weights).sum(), inputs)
    size = model.detach().norm(dim=-1)
    compared = 0
    for k, x in enumerate(sample):
        reach = x.abs().reshape(len(x), -1).amax(-1).reshape(-1, *[1] * (x.ndim - 1))
        along = reach * torch.randn(x.shape, generator=generator)
        ends, near = [], found.valid.any(-1)
        for sign in (-1, 1):
            side = case.solve(*sample[:k], x + sign * step * along, *sample[k + 1 :])
            gap = (side.model.flatten(2) - model.detach()[:, None]).norm(dim=-1).masked_fill(~side.valid, torch.inf)
            ends.append(side.model.flatten(2)[rows, gap.argmin(-1)])
            # Where solutions meet, or the line leaves what an argument can be, there is nothing to compare with.
            near = near & (gap.amin(-1) < 1e-3 * size)
        if near.double().mean() > 0.5:
            seen = ((ends[1] - ends[0]) * weights).sum(-1) / (2 * step)
            told = (slopes[k] * along).reshape(len(x), -1).sum(-1)
            assert_share(((told - seen).abs() <= 1e-3 * (seen.abs() + size))[near], 0.95)
            compared += 1
    assert compared > 0


@cases
@pytest.mark.usefixtures("unchecked")
def test_wrong_arguments(case: Case, generator: torch.Generator) -> None:
    first, *others = draw(case, 3, generator)
    with pytest.raises(ValueError, match="wanted shape"):
        case.solve(first[..., :-1], *others)
    if others:
        with pytest.raises(ValueError, match="wanted dtype"):
            case.solve(first, *others[:-1], others[-1].float())
        with pytest.raises(ValueError, match="do not broadcast"):
            case.solve(first[:2], *others)
