"""Shape checks and maps over tensors."""

import math
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from torchsfm._types import Solutions, broadcast_shapes, check_options, check_tensors, tensor_map

shapes = st.lists(st.lists(st.sampled_from([0, 1, 1, 2, 3]), max_size=3).map(tuple), max_size=4)


@given(shapes)
def test_shapes_broadcast_as_torch_has_it(many: list[tuple[int, ...]]) -> None:
    try:
        wanted = torch.broadcast_tensors(*(torch.empty(s) for s in many))[0].shape if many else torch.Size()
    except RuntimeError:
        with pytest.raises(ValueError, match="do not broadcast"):
            broadcast_shapes(*many)
    else:
        assert broadcast_shapes(*many) == wanted


def test_the_batch_shape_is_returned() -> None:
    x, y = torch.zeros(4, 1, 7, 2), torch.zeros(3, 5, 2)
    assert check_tensors(x=(x, "n>=5 2"), y=(y, "k 2"), z=(None, "?3")) == (4, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"x": (torch.zeros(6, 2), "7 2")}, r"x: wanted shape \(\*batch, 7, 2\), got \(6, 2\)"),
        ({"x": (torch.zeros(2), "n 2")}, "x: wanted shape"),
        ({"x": (torch.zeros(6, 2), "n>=7 2")}, "n >= 7"),
        ({"x": (torch.zeros(6, 2), "n 2"), "y": (torch.zeros(5, 2), "n 2")}, "y: wanted n = 6 as x has"),
        ({"x": (torch.zeros(6, 2), "n 2"), "y": (torch.zeros(6, 2).double(), "n 2")}, "y: wanted dtype torch.float32"),
        ({"x": (torch.zeros(6, 2).long(), "n 2")}, "x: wanted a float32 or float64 tensor"),
        ({"x": (torch.zeros(6, 2).half(), "n 2")}, "x: wanted a float32 or float64 tensor, got torch.float16"),
        ({"x": (None, "n 2")}, r"x: wanted a torch.Tensor of shape \(\*batch, n, 2\), got NoneType"),
        ({"m": (torch.zeros(6), "n: bool")}, "m: wanted a bool tensor"),
        ({"i": (torch.zeros(6, dtype=torch.bool), "n: int")}, "i: wanted a int tensor"),
        ({"x": (torch.zeros(6, device="meta"), "n"), "y": (torch.zeros(6), "n")}, "y: wanted device meta"),
        ({"x": (torch.zeros(3, 6), "n"), "y": (torch.zeros(4, 6), "n")}, "batch dimensions do not broadcast"),
        ({"x": ([1.0], "n")}, "x: wanted a torch.Tensor"),
    ],
)
def test_wrong_arguments_are_named(arguments: dict[str, tuple[Tensor, str]], message: str, unchecked: None) -> None:
    with pytest.raises(ValueError, match=message):
        check_tensors(**arguments)


@pytest.mark.parametrize(
    ("wanted", "good", "bad"),
    [
        ("int >= 1", (1, 10**6), (0, -1, 1.5, 1.0, True, "1", None, math.inf)),
        ("float > 0", (1e-300, 5, 1e300), (0, 0.0, -1.0, math.inf, math.nan, None, False, "2", [1.0], torch.ones(()))),
        ("0 <= float <= 1", (0, 0.5, 1), (-1e-9, 1.1, math.nan)),
        ("0 < float < 1", (1e-9, 0.5), (0, 1, math.nan)),
        ("0 <= float <= 0.1 radians", (0, 0.1), (1.0, -1)),
        ("2 float > 0 < 3.1416 radians", ((0.5, 1.0), [1, 2]), ((0.5, 60.0), (0.5,), 1.0)),
        ("?int >= 0", (None, 0, 3), (-1, 0.5, "none")),
        (("a", "b"), ("a", "b"), ("c", None, ["a"], torch.ones(3))),
        (bool, (True, False), (0, 1, None, "yes")),
        (str | None, ("", None), (1, b"")),
    ],
)
def test_options_are_what_is_wanted(wanted: Any, good: tuple[Any, ...], bad: tuple[Any, ...]) -> None:
    for value in good:
        check_options(option=(value, wanted))
    for value in bad:
        with pytest.raises(ValueError, match="option: wanted"):
            check_options(option=(value, wanted))


@dataclass(frozen=True)
class Nested:
    a: Tensor
    b: tuple[Tensor, int]
    c: dict[str, list[Tensor]]


def test_tensors_are_mapped_wherever_they_are() -> None:
    one = torch.ones(2)
    mapped = tensor_map(lambda t: t + 1, Nested(one, (one, 5), {"k": [one]}))
    assert mapped.a.tolist() == mapped.b[0].tolist() == mapped.c["k"][0].tolist() == [2, 2]
    assert mapped.b[1] == 5
    solutions = tensor_map(lambda t: t[0], Solutions(torch.ones(2, 3), torch.ones(2, 3, dtype=torch.bool)))
    assert solutions.model.shape == solutions.valid.shape == (3,)
