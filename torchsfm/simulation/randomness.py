"""Where random numbers are drawn: on the device of their generator, whatever the default device is."""

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from torchsfm.linalg.devices import CPU, made_on

P = ParamSpec("P")
T = TypeVar("T")


def where_drawn(function: Callable[P, T]) -> Callable[P, T]:
    """Let a function make everything on the device of its keyword `generator`, and on the CPU where none is given."""

    @wraps(function)
    def there(*args: P.args, **kwargs: P.kwargs) -> T:
        generator = kwargs.get("generator")
        with made_on(generator.device if isinstance(generator, torch.Generator) else CPU):
            return function(*args, **kwargs)

    return there


def drawn(draw: Callable[..., Tensor], shape: torch.Size, like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Random numbers for a tensor's dtype and device, drawn where the generator is: the same ones on every device.

    Args:
        draw: `torch.rand` or `torch.randn`.
        shape: How many.
        like: The tensor.
        generator: Source of randomness; torch's own on the tensor's device where none is given.
    """
    options: dict[str, Any] = {"dtype": like.dtype, "device": like.device if generator is None else generator.device}
    return draw(shape, generator=generator, **options).to(like.device)
