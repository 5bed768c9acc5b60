"""Bad values: numbers that are none or of no size that data have, and data that determine nothing."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor

T = TypeVar("T")

_NUMBERS = (
    torch.nan, torch.inf, -torch.inf, 0.0, 1e8, -1e8, 1e12, 1e25, -1e25, 1e38, 1e100, -1e100, 1e155, 1e200, -1e200, 1e300,
    1.7e308, 1e-8, 1e-25, 1e-45, 1e-100, 1e-160, 1e-200, 1e-300, 5e-324,
)  # fmt: skip
_SIZES = (1e8, 1e12, 1e30, 1e75, 1e100, 1e150, 1e160, 1e200, 1e290, 1e-8, 1e-20, 1e-75, 1e-100, 1e-160, 1e-200, 1e-300)

Element = dict[str, Tensor]
"""The arguments of one problem, by name, without batch dimensions."""


def poison(element: Element, generator: torch.Generator) -> Element:
    """One problem made bad in one of many ways; the tensors given stay as they are."""
    element = {name: value.clone() for name, value in element.items()}
    names = [name for name, value in element.items() if value.numel()]
    if names:
        _pick(_RECIPES, generator)(element, _pick(names, generator), generator)
    return element


def _pick(options: Sequence[T], generator: torch.Generator) -> T:
    return options[int(torch.randint(len(options), (), generator=generator))]


def _number(like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.tensor(_pick(_NUMBERS, generator), dtype=torch.float64).to(like.dtype)


def _one_number(element: Element, name: str, generator: torch.Generator) -> None:
    flat = element[name].view(-1)
    flat[int(torch.randint(len(flat), (), generator=generator))] = _number(flat, generator)


def _some_numbers(element: Element, name: str, generator: torch.Generator) -> None:
    value = element[name]
    share = float(torch.rand((), generator=generator))
    value[torch.rand(value.shape, generator=generator) < share] = _number(value, generator)


def _one_row(element: Element, name: str, generator: torch.Generator) -> None:
    value = element[name]
    rows = value.view(-1, value.shape[-1]) if value.ndim else value.view(1, 1)
    rows[int(torch.randint(len(rows), (), generator=generator))] = _number(value, generator)


def _everything(element: Element, name: str, generator: torch.Generator) -> None:
    element[name].fill_(_number(element[name], generator))


def _scaled(element: Element, name: str, generator: torch.Generator) -> None:
    if element[name].is_floating_point():
        element[name] *= _pick(_SIZES, generator)


def _all_scaled(element: Element, name: str, generator: torch.Generator) -> None:
    size = _pick(_SIZES, generator)
    for value in element.values():
        if value.is_floating_point():
            value *= size


def _random_sizes(element: Element, name: str, generator: torch.Generator) -> None:
    value = element[name]
    if value.is_floating_point():
        power = torch.rand(value.shape, generator=generator, dtype=torch.float64) * 600 - 300
        value *= (10.0**power).to(value.dtype)


def _repeated(element: Element, name: str, generator: torch.Generator) -> None:
    """All data the same, in this argument or in all."""
    everywhere = bool(torch.rand((), generator=generator) < 0.5)
    for other in list(element) if everywhere else [name]:
        value = element[other]
        if value.ndim > 1:
            element[other] = value[..., :1, :].expand_as(value).clone()


def _two_equal(element: Element, name: str, generator: torch.Generator) -> None:
    for value in element.values():
        if value.ndim > 1 and value.shape[-2] > 1:
            value[..., 1, :] = value[..., 0, :]


def _on_a_line(element: Element, name: str, generator: torch.Generator) -> None:
    everywhere = bool(torch.rand((), generator=generator) < 0.5)
    for other in list(element) if everywhere else [name]:
        value = element[other]
        if value.ndim > 1 and value.shape[-2] > 1 and value.is_floating_point():
            a, b = value[..., :1, :], value[..., 1:2, :]
            k = torch.rand(value.shape[-2], 1, generator=generator, dtype=torch.float64).to(value.dtype)
            element[other] = a + k * (b - a)


def _flat(element: Element, name: str, generator: torch.Generator) -> None:
    """Points in a plane; a matrix of less rank."""
    value = element[name]
    if value.ndim and value.shape[-1] > 1:
        value[..., -1] = value[..., 0]


def _same_as_another(element: Element, name: str, generator: torch.Generator) -> None:
    """Two views that are one."""
    value = element[name]
    others = [o for o in element if o != name and element[o].shape == value.shape and element[o].dtype == value.dtype]
    if others:
        element[name] = element[_pick(others, generator)].clone()
    elif value.ndim > 2:
        element[name] = value[:1].expand_as(value).clone()


def _unrelated(element: Element, name: str, generator: torch.Generator) -> None:
    value = element[name]
    if value.is_floating_point():
        size = value.abs().nan_to_num(1, 1, 1).amax().clamp(1e-3, 1e6)
        element[name] = (torch.randn(value.shape, generator=generator, dtype=torch.float64)).to(value.dtype) * size


def _negative(element: Element, name: str, generator: torch.Generator) -> None:
    if element[name].is_floating_point():
        element[name] = -element[name]


def _far_data(element: Element, name: str, generator: torch.Generator) -> None:
    """A few data very far away, in every argument."""
    size = _pick(_SIZES, generator)
    for value in element.values():
        if value.ndim > 1 and value.is_floating_point():
            value[torch.rand(value.shape[:-1], generator=generator) < 0.2] *= size


_RECIPES: tuple[Callable[[Element, str, torch.Generator], None], ...] = (
    _one_number, _one_number, _some_numbers, _one_row, _everything, _scaled, _all_scaled, _random_sizes, _repeated, _two_equal,
    _on_a_line, _flat, _same_as_another, _unrelated, _negative, _far_data,
)  # fmt: skip
