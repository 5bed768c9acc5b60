"""What one small problem costs is the number of its tensor operations: held here without a clock."""

from typing import Any

import pytest
import torch
from chance import stream_seed
from torch.utils._python_dispatch import TorchDispatchMode

from bench.ransac import ours, part, scenes
from torchsfm.motion import estimate_fundamental

MOST = {"F": 2720, "H": 1880, "P": 2540, "E": 4180}
"""Of 1,000 matches, four in five of which are right, for the pair of nine that takes the least: chance decides of some whether
the search and the refinement take more rounds."""


class _Count(TorchDispatchMode):
    number = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.number += 1
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("model", list(MOST))
def test_one_pair_takes_few_operations(model: str) -> None:
    some = scenes(model, 9, 0.8, stream_seed())
    numbers = []
    for i in range(9):
        with _Count() as count:
            ours(model, part(some, slice(i, i + 1)))
        numbers.append(count.number)
    assert min(numbers) <= MOST[model], numbers


def test_problems_that_go_on_keep_their_places() -> None:
    """Their numbers of samples differ, and with them the order in which they are looked at."""
    some = scenes("F", 32, 0.5, 0)

    def drawn(index: slice) -> torch.Tensor:
        few, g = part(some, index), torch.Generator().manual_seed(0)
        return estimate_fundamental(few.x1, few.x2, threshold=2.0, generator=g).iterations

    together = drawn(slice(0, 32))
    assert len(set(together.tolist())) > 3
    assert torch.equal(together, torch.cat([drawn(slice(i, i + 1)) for i in range(32)]))
