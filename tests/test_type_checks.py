"""The checks of annotations refuse what they should, and only that."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import pytest
import torch
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Float
from torch import Tensor
from type_checks import checked

import torchsfm

broken = pytest.raises(BeartypeCallHintViolation)


@checked
def product(
    a: Float[Tensor, "*batch n m"], b: Float[Tensor, "*batch m k"], *, turn: bool = False
) -> Float[Tensor, "*batch n k"]:
    return (a @ b).mT if turn else a @ b


@checked
def scaled(factor: float) -> Callable[[Tensor], Tensor]:
    @checked
    def scale(x: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
        return factor * x

    return scale


@checked
@dataclass(frozen=True)
class Segment:
    start: Float[Tensor, "*batch 2"]
    end: Float[Tensor, "*batch 2"]

    @classmethod
    @checked
    def between(cls, start: Tensor, end: Tensor, /, *others: int, **options: float) -> "Segment":
        return cls(start, end) if not others else None  # type: ignore[return-value]


def test_names_of_axes_agree_in_a_call_and_mean_nothing_to_the_next() -> None:
    a, b = torch.ones(4, 2, 3), torch.ones(4, 3, 5)
    assert torch.equal(product(a, b=b), a @ b)
    assert product(a[0], b[0]).shape == (2, 5)
    for wrong in (b[:3], b[:, :2], b.long(), b[0], [[1.0]]):
        with broken:
            product(a, wrong)
    assert product(b.mT, a.mT).shape == (4, 5, 2)


def test_results_are_held_against_the_arguments() -> None:
    with broken:
        product(torch.ones(2, 3), torch.ones(3, 5), turn=True)
    assert product(torch.ones(2, 3), torch.ones(3, 2), turn=True).shape == (2, 2)
    with broken:
        product(torch.ones(2, 3), torch.ones(3, 5), turn="no")  # type: ignore[arg-type]


def test_functions_made_in_a_call_are_checked_and_keep_what_they_enclose() -> None:
    x = torch.ones(3, 2)
    double, triple = scaled(2.0), scaled(3.0)
    assert torch.equal(double(x) + triple(x), 5 * x)
    for scale in (double, triple):
        with broken:
            scale(x.mT)


def test_dataclasses_and_methods() -> None:
    start, end = torch.zeros(3, 2), torch.ones(3, 2)
    assert torch.equal(Segment.between(start, end, size=1.0).end, end)
    with broken:
        Segment(start, end[:2])
    with broken:
        Segment.between(start, end, 1)
    for arguments, options in (((start, end, "1"), {}), ((start, 1), {}), ((start, end), {"size": "1"})):
        with broken:
            Segment.between(*arguments, **options)  # type: ignore[arg-type]


@checked
def chosen(
    among: list[Float[Tensor, "n"]], by: dict[str, int], how: Literal["first", "last"], as_is: object = None
) -> Float[Tensor, "n"]:
    return among[by[how]] if as_is is None else as_is  # type: ignore[return-value]


def test_what_passed_lets_nothing_else_pass() -> None:
    x, by = torch.ones(3), {"first": 0, "last": -1}
    for _ in range(2):
        assert torch.equal(chosen([x, x], by, "last"), x)
        for among, what, how in (
            ([x[0], x[0]], by, "last"),
            ([1, 1], by, "last"),
            ((x, x), by, "last"),
            ([x, x], {"first": None, "last": None}, "last"),
            ([x, x], by, "middle"),
            ([x, x], by, 1),
            ([x, x], by, True),
        ):
            with broken:
                chosen(among, what, how)  # type: ignore[arg-type]
        for value in (x[:2], x.long(), x.numpy(), [x]):
            with broken:
                chosen([x], by, "first", value)


@pytest.mark.usefixtures("unchecked")
def test_switched_off() -> None:
    assert product(torch.ones(2, 3), torch.ones(3, 5), turn=True).shape == (5, 2)


def test_the_package_is_checked(request: pytest.FixtureRequest) -> None:
    if not request.config.option.jaxtyping_packages:
        pytest.skip("the checks are not asked for")
    with broken:
        torchsfm.geometry.rotation_from_rotvec(torch.zeros(4))


class Pair(NamedTuple):
    x: Tensor
    y: Tensor


@checked
def joined(pair: Pair, *more: int, both: tuple[Tensor, Tensor], kind: type = Tensor) -> Pair:
    return Pair(*both) if not more else both  # type: ignore[return-value]


def test_where_the_class_is_all_that_is_asked_for_others_do_not_pass() -> None:
    x = torch.ones(3)
    for _ in range(2):
        assert torch.equal(joined(Pair(x, x), both=(x, x)).y, x)
        assert torch.equal(joined(Pair(x[:2], x), both=Pair(x, x), kind=Pair).y, x)
        for pair, more, options in (
            ((x, x), (), {"both": (x, x)}),
            (Pair(x, x), ("1",), {"both": (x, x)}),
            (Pair(x, x), (1,), {"both": (x, x)}),
            (Pair(x, x), (), {"both": (x, 1)}),
            (Pair(x, x), (), {"both": Pair(x, None)}),  # type: ignore[arg-type]
            (Pair(x, x), (), {"both": (x, x), "kind": x}),
        ):
            with broken:
                joined(pair, *more, **options)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"joined\(\) missing 1 required keyword-only argument: 'both'"):
        joined(Pair(x, x))  # type: ignore[call-arg]
