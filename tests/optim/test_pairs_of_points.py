"""Which residuals meet by the eliminated variable that they share."""

import pytest
import torch

from torchsfm.optim import schur_pairwise
from torchsfm.optim.schur_pairwise import pairs_of_points


@pytest.mark.parametrize("short", [2**31, 1])
@pytest.mark.parametrize(("points", "slots", "rows"), [(40, 9, 300), (5, 3, 60), (300, 4, 100), (1, 1, 1), (1, 1, 0)])
def test_all_pairs_of_a_point_are_there_once(
    points: int, slots: int, rows: int, short: int, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether numbers are short or long; a point may be in a slot twice."""
    monkeypatch.setattr(schur_pairwise, "SHORT", short)
    slot = torch.randint(slots, (rows,), generator=generator).sort().values
    point = torch.randint(points, (rows,), generator=generator)
    left, right, key = pairs_of_points(point, slot, slots)
    same = [(i, j) for i in range(rows) for j in range(i + 1, rows) if point[i] == point[j]]
    found = list(zip(left.tolist(), right.tolist(), strict=True))
    assert sorted(found) == same
    assert key.tolist() == [int(slot[i]) * slots + int(slot[j]) for i, j in found]
