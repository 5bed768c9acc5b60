"""The default device is the user's affair: what works on the CPU by its nature does so whatever it is."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import wraps
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
T = TypeVar("T")
CPU = torch.device("cpu")


def made_on(device: torch.device) -> AbstractContextManager[object]:
    """Where tensors made without `device=` lie on a device."""
    # The context costs every operation in it some microseconds.
    return nullcontext() if torch.get_default_device() == device else device


def drawn_on(generator: torch.Generator | None, device: torch.device | str | None) -> torch.device | str | None:
    """Where random numbers are made: on the device that is asked for, else on that of their generator."""
    return generator.device if device is None and generator is not None else device


def on_the_cpu(function: Callable[P, T]) -> Callable[P, T]:
    """Let a function of files, photographs or models work on the CPU."""

    @wraps(function)
    def there(*args: P.args, **kwargs: P.kwargs) -> T:
        with made_on(CPU):
            return function(*args, **kwargs)

    return there
