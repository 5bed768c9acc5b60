"""Where curves of the plane cross lines."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_options, check_tensors
from torchsfm.geometry.curves import Curve, segments_of


class Crossings(NamedTuple):
    """Where curves of the plane cross lines, along the curve, in slots of which the first are `valid`.

    Example:
        >>> import torch, torchsfm
        >>> x = torch.tensor([[0.0, -1.0], [2.0, 1.0], [3.0, 0.0], [4.0, 1.0]])  # up through the line y = 0, then down to it
        >>> curve = torchsfm.geometry.curve_from_samples(x)
        >>> found = torchsfm.geometry.curve_crossings(curve, torch.tensor([[0.0, 1.0, 0.0]]), most=4)
        >>> found.x[found.valid], found.sine[found.valid]  # both at 45 degrees
        (tensor([[1., 0.],
                [3., 0.]]), tensor([0.7071, 0.7071]))
    """

    x: Float[Tensor, "*batch m k 2"]
    """The crossings of each line, in the unit of the curve; zero in empty slots."""
    sine: Float[Tensor, "*batch m k"]
    """Of the angle between the curve and the line; 0 in empty slots."""
    valid: Bool[Tensor, "*batch m k"]
    """Which slots hold a crossing."""


def curve_crossings(curve: Curve, line: Float[Tensor, "*#batch m 3"], most: int) -> Crossings:
    """Where the polygons of plane curves cross lines.

    Args:
        curve: Curves of the plane.
        line: Homogeneous lines of any scale.
        most: Slots for each line; of more crossings the first along the curve are kept.

    Returns:
        The crossings and the angles.

    Raises:
        ValueError: Wrong shape, dtype, device or option.

    Example:
        >>> import torch, torchsfm
        >>> zigzag = torchsfm.geometry.curve_from_samples(torch.tensor([[0.0, -1.0], [1.0, 1.0], [2.0, -1.0]]))
        >>> found = torchsfm.geometry.curve_crossings(zigzag, torch.tensor([[0.0, 1.0, 0.0]]), most=3)  # the line y = 0
        >>> found.x[found.valid]
        tensor([[0.5000, 0.0000],
                [1.5000, 0.0000]])
    """
    check_tensors(line=(line, "m 3"), curve=(curve.x, "n 2"))
    check_options(most=(most, "int >= 1"))
    s = segments_of(curve)
    normal, far = line[..., None, :2], line[..., None, 2]
    start = (normal * s.start[..., None, :, :]).sum(-1) + far
    rise = (normal * s.chord[..., None, :, :]).sum(-1)
    end = start + rise
    # A segment has its start and not its end, so that a crossing at a sample is counted once.
    crossed = s.there[..., None, :] & (((start <= 0) & (end > 0)) | ((start >= 0) & (end < 0)))
    crossed = crossed & torch.isfinite(start) & torch.isfinite(rise)
    slots = torch.arange(crossed.shape[-1], device=crossed.device)
    order = torch.where(crossed, slots, crossed.shape[-1])
    k = min(most, crossed.shape[-1])
    index = order.topk(k, dim=-1, largest=False).values
    valid = index < crossed.shape[-1]
    index = torch.where(valid, index, 0)
    a, b = start.gather(-1, index), rise.gather(-1, index)
    t = torch.where(valid, -a / torch.where(valid & (b != 0), b, 1), 0)
    own = s.take(index.flatten(-2))
    x = (own.start + own.chord * t.flatten(-2)[..., None]).reshape(*index.shape, 2)
    width = torch.linalg.vector_norm(line[..., :2], dim=-1)[..., None] * own.length.reshape(index.shape)
    sine = torch.where(valid & (width > 0), b.abs() / torch.where(width > 0, width, 1), 0).clamp(max=1)
    x = torch.where(valid[..., None], x, 0)
    pad = (0, most - k)
    return Crossings(
        torch.nn.functional.pad(x, (0, 0, *pad)), torch.nn.functional.pad(sine, pad), torch.nn.functional.pad(valid, pad)
    )
