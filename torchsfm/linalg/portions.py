"""How much to compute at a time: what stays in a CPU's cache; elsewhere more, as memory is wide and calls are dear."""

import torch

_WIDER = 64


def portion(number: int, device: torch.device) -> int:
    """How many things to take at a time, of which so many fit the cache of a CPU."""
    return number if device.type == "cpu" else _WIDER * number


def portions(total: int, number: int, device: torch.device) -> list[slice]:
    """Slices of so many things at a time; where there are none, none."""
    step = portion(number, device)
    return [slice(i, i + step) for i in range(0, total, step)]
