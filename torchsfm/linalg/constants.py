"""Tables of numbers that formulas need, brought to each device once instead of at every call."""

import torch
from torch import Tensor


class Constant:
    """A tensor known when the program is written."""

    def __init__(self, value: Tensor) -> None:
        self._value = value
        self._copies = {(value.device, value.dtype): value}

    def on(self, device: torch.device, dtype: torch.dtype | None = None) -> Tensor:
        """The tensor on a device, of its own dtype if no other is given; not to be written to."""
        key = device, self._value.dtype if dtype is None else dtype
        found = self._copies.get(key)
        if found is None:
            # A copy made in inference mode could not take part in a derivative later.
            with torch.inference_mode(False):
                found = self._copies[key] = self._value.to(device=device, dtype=key[1])
        return found
