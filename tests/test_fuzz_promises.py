"""What a result promises to the neighbours of bad input."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bench.fuzz.promises import changed
from torchsfm import Solutions, Status

KEPT = torch.tensor([True, True, False])


@dataclass(frozen=True)
class Estimate:
    model: Tensor
    status: Tensor


REFERENCE = Estimate(
    torch.eye(3).double(), torch.tensor([int(Status.OK), int(Status.DEGENERATE), int(Status.OK)], dtype=torch.int8)
)


def _moved(element: int, by: float) -> Estimate:
    model = REFERENCE.model.clone()
    model[element, 0] += by
    return replace(REFERENCE, model=model)


def test_good_neighbours_change_by_rounding_only() -> None:
    assert not list(changed(_moved(0, 1e-9), REFERENCE, KEPT))
    assert list(changed(_moved(0, 1e-5), REFERENCE, KEPT))
    assert not list(changed(_moved(2, 1.0), REFERENCE, KEPT))  # the bad one itself


def test_of_what_is_not_good_the_status_stays_and_numbers_stay_finite() -> None:
    assert not list(changed(_moved(1, 1e-5), REFERENCE, KEPT))
    assert list(changed(_moved(1, torch.nan), REFERENCE, KEPT))
    status = REFERENCE.status.clone()
    status[1] = int(Status.OK)
    assert list(changed(replace(REFERENCE, status=status), REFERENCE, KEPT))


def test_solutions_stay_bit_for_bit() -> None:
    model = torch.eye(3).double()[:, None]
    reference = Solutions(model, torch.tensor([[True], [False], [True]]))
    moved = Solutions(model + torch.tensor([0, 1e-15, 0])[:, None, None], reference.valid)
    assert list(changed(moved, reference, KEPT))
    assert not list(changed(Solutions(model.clone(), reference.valid), reference, KEPT))


def test_only_homogeneous_models_may_turn_their_sign() -> None:
    turned = replace(REFERENCE, model=-REFERENCE.model)
    assert list(changed(turned, REFERENCE, KEPT))
    assert not list(changed(turned, REFERENCE, KEPT, homogeneous=True))
