"""Straight lines of whole images by voting (Hough), found again between the bins by least squares."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_options
from torchsfm.images.edges import Edges, detect_edges
from torchsfm.images.straight_runs import axis, moments

_TURN = 2
"""Degrees to each side of its own normal that an edge point votes for."""
_NEAR = 3
"""Bins to each side within which a peak is the only one."""
_INLIER = 1.5
"""Largest distance from a line, in pixels, of the edge points that it is fitted to."""
_SLANT = math.radians(6)
_ROUNDS = 3
_APART = (math.radians(0.5), 1.0)
"""Angle, and distance in pixels at the middle of the support, within which lines are one."""


@dataclass(frozen=True)
class HoughLines:
    """Straight lines of images in slots, those with most edge points first; zero in empty slots.

    Example:
        >>> import torch, torchsfm
        >>> image = torch.zeros(1, 60, 80)
        >>> image[:, 30:] = 1.0  # a step between the rows 29 and 30
        >>> found = torchsfm.images.hough_lines(image)
        >>> found.ends[found.valid][0].sort(0).values.round()[:, 1], bool(found.scatter[0] < 0.1), bool(found.count[0] > 60)
        (tensor([30., 30.]), True, True)
    """

    line: Float[Tensor, "*batch n 3"]
    """Lines with a normal of length 1."""
    ends: Float[Tensor, "*batch n 2 2"]
    """The longest stretch of the line without a gap."""
    count: Int[Tensor, "*batch n"]
    """Number of edge points on the line."""
    scatter: Float[Tensor, "*batch n"]
    """Their root-mean-square distance from it, in pixels."""
    valid: Bool[Tensor, "*batch n"]
    """Which slots hold a line."""


def hough_lines(
    image: Float[Tensor, "*#batch c h w"],
    max_lines: int = 30,
    *,
    min_count: int = 30,
    max_gap: float = 5.0,
    blur: float = 1.0,
    low: float = 0.01,
    high: float = 0.03,
    noise: float | None = None,
    mask: Bool[Tensor, "*#batch h w"] | None = None,
) -> HoughLines:
    """The straight lines of each image that most edge points lie on, however they are scattered along them.

    Edge points (`detect_edges`) vote for lines of about their own direction, in bins of a degree and a pixel. Peaks that are
    the largest for some bins around become lines by total least squares over the edge points near them, which the bins no
    longer limit. Opposite gradients vote for one line.

    Args:
        image: Grey (c = 1) or red, green, blue images.
        max_lines: The number of slots for each image.
        min_count: Fewest edge points on a line.
        max_gap: Longest gap in a stretch, in pixels.
        blur: As in `detect_edges`.
        low: As in `detect_edges`.
        high: As in `detect_edges`.
        noise: As in `detect_edges`.
        mask: Where edges may be.

    Returns:
        The lines. An image without any has none valid.

    Raises:
        ValueError: A shape or an option is wrong.

    Example:
        >>> import torch, torchsfm
        >>> image = torch.zeros(1, 60, 80)
        >>> image[:, 30:] = 1.0  # a step between the rows 29 and 30
        >>> found = torchsfm.images.hough_lines(image)
        >>> found.valid.sum(), found.line[0].abs()  # y = 29.5
        (tensor(1), tensor([ 0.0000,  1.0000, 29.5000]))
    """
    check_options(max_lines=(max_lines, "int >= 1"), min_count=(min_count, "int >= 3"), max_gap=(max_gap, "float > 0"))
    edges = detect_edges(image, blur=blur, low=low, high=high, noise=noise, mask=mask, straight=True)
    batch, n = edges.valid.shape[:-1], edges.valid.shape[-1]
    height, width = image.shape[-2:]
    flat = Edges(*(getattr(edges, name).reshape(batch.numel(), *getattr(edges, name).shape[len(batch) :]) for name in _FIELDS))
    middle = image.new_tensor([(width - 1) / 2, (height - 1) / 2], dtype=torch.float64)
    used = int(flat.valid.sum(-1).amax()) if flat.valid.numel() else 0
    n = max(1, min(n, used))
    x, gradient, valid = flat.x[:, :n].double() - middle, flat.gradient[:, :n].double(), flat.valid[:, :n]
    angle, offset, found = _peaks(x, gradient, valid, math.hypot(height, width) / 2, max_lines, min_count)
    line, count, scatter, ends = _refined(x, gradient, valid, angle, offset, max_gap)
    found = found & (count >= min_count) & ~_repeated(line, ends, count, found)
    order = torch.where(found, count, -1).argsort(dim=-1, descending=True, stable=True)
    found, count, scatter = (v.gather(-1, order) for v in (found, count, scatter))
    line = line.gather(-2, order[..., None].expand_as(line))
    ends = ends.gather(-3, order[..., None, None].expand_as(ends)) + middle
    line = torch.cat((line[..., :2], line[..., 2:] - (line[..., :2] * middle).sum(-1, keepdim=True)), -1)

    def lay(values: Tensor, dtype: torch.dtype) -> Tensor:
        mask = found.reshape(*found.shape, *(1,) * (values.ndim - 2))
        return torch.where(mask, values, torch.zeros_like(values)).to(dtype).reshape(*batch, *values.shape[1:])

    dtype, valid = image.dtype, found.reshape(*batch, max_lines)
    return HoughLines(lay(line, dtype), lay(ends, dtype), lay(count, torch.long), lay(scatter, dtype), valid)


_FIELDS = ("x", "gradient", "sigma", "width", "curvature", "chain", "closed", "valid", "noise", "left_out")


def _peaks(
    x: Tensor, gradient: Tensor, valid: Tensor, reach: float, slots: int, min_count: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Angles of normals in [0, pi) and offsets (images, slots) of the largest bins, and which slots hold one."""
    images, half = x.shape[0], math.ceil(reach) + 1
    bins = 2 * half + 1
    own = torch.rad2deg(torch.atan2(gradient[..., 1], gradient[..., 0]))
    votes = x.new_zeros(images, 180 * bins)
    for turn in range(-_TURN, _TURN + 1):
        degree = own.round().long() + turn
        normal = torch.deg2rad(degree.double())
        offset = x[..., 0] * normal.cos() + x[..., 1] * normal.sin()
        # A half turn changes the sign.
        wrapped = degree % 360
        offset = torch.where(wrapped >= 180, -offset, offset) + half
        low = offset.floor().long().clamp(0, bins - 2)
        share = (offset - low).clamp(0, 1)
        weight = torch.where(valid, 1 - (degree.double() - own).abs() / (_TURN + 1), 0.0)
        place = wrapped % 180 * bins + low
        votes = votes.scatter_add(1, place, weight * (1 - share)).scatter_add(1, place + 1, weight * share)
    votes = votes.reshape(images, 180, bins)
    # Beyond 180 degrees everything comes again, upside down.
    around = torch.cat((votes[:, -_NEAR:].flip(-1), votes, votes[:, :_NEAR].flip(-1)), 1)
    around = torch.nn.functional.pad(around, (_NEAR, _NEAR))
    largest = torch.nn.functional.max_pool2d(around[:, None], 2 * _NEAR + 1, stride=1)[:, 0]
    # An edge point gives a bin two of its three votes at most.
    peak = (votes == largest) & (votes >= 0.3 * min_count)
    value, place = torch.where(peak, votes, 0.0).flatten(1).topk(min(slots, 180 * bins))
    value, place = (torch.nn.functional.pad(v, (0, slots - v.shape[-1])) for v in (value, place))
    return torch.deg2rad((place // bins).double()), (place % bins - half).double(), value > 0


def _refined(
    x: Tensor, gradient: Tensor, valid: Tensor, angle: Tensor, offset: Tensor, max_gap: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Lines (images, slots, 3), numbers of edge points, scatter and ends of the longest stretches."""
    images, slots, n = *angle.shape, x.shape[1]
    row = torch.arange(images * slots, device=x.device).repeat_interleave(n)
    normal = torch.stack((angle.cos(), angle.sin()), -1)
    length = gradient.square().sum(-1).sqrt()
    points = x[:, None].expand(images, slots, n, 2)
    inlier = valid[:, None].expand(images, slots, n)
    direction, centre, square = normal, offset[..., None] * normal, offset
    for _ in range(_ROUNDS):
        away = (points * normal[..., None, :]).sum(-1) - offset[..., None]
        slope = (gradient[:, None] * normal[..., None, :]).sum(-1).abs()
        inlier = valid[:, None] & (away.abs() <= _INLIER) & (slope >= math.cos(_SLANT) * length[:, None])
        sums = moments(points.reshape(-1, 2), row, images * slots, inlier.reshape(-1))
        centre, direction, square = (v.reshape(images, slots, *v.shape[1:]) for v in axis(sums))
        some = inlier.sum(-1) > 2
        side = torch.stack((direction[..., 1], -direction[..., 0]), -1)
        side = torch.where((side * normal).sum(-1, keepdim=True) < 0, -side, side)
        normal = torch.where(some[..., None], side, normal)
        offset = torch.where(some, (normal * centre).sum(-1), offset)
    count = inlier.sum(-1)
    direction = torch.stack((-normal[..., 1], normal[..., 0]), -1)
    along = torch.where(inlier, (points * direction[..., None, :]).sum(-1), torch.inf).sort(-1).values
    there = along < torch.inf
    begins = there & (torch.nn.functional.pad(along, (1, 0), value=-torch.inf)[..., :-1] + max_gap < along)
    stretch = (begins.long().cumsum(-1) - 1).clamp_min(0)
    along = torch.where(there, along, 0.0)
    first = along.new_full(along.shape, torch.inf).scatter_reduce(-1, stretch, torch.where(there, along, torch.inf), "amin")
    last = along.new_full(along.shape, -torch.inf).scatter_reduce(-1, stretch, torch.where(there, along, -torch.inf), "amax")
    longest = (last - first).argmax(-1, keepdim=True)
    span = torch.cat((first.gather(-1, longest), last.gather(-1, longest)), -1)
    span = torch.where(span.isfinite(), span, 0.0)
    ends = (offset[..., None] * normal)[..., None, :] + span[..., None] * direction[..., None, :]
    return torch.cat((normal, -offset[..., None]), -1), count, (square / count.clamp_min(1)).sqrt(), ends


def _repeated(line: Tensor, ends: Tensor, count: Tensor, found: Tensor) -> Tensor:
    """Lines that are others with more edge points, or earlier ones with as many."""
    cosine = (line[:, :, None, :2] * line[:, None, :, :2]).sum(-1).abs()
    middle = ends.mean(-2)
    away = (middle[:, :, None] * line[:, None, :, :2]).sum(-1) + line[:, None, :, 2]
    same = (cosine > math.cos(_APART[0])) & (away.abs() < _APART[1])
    slots = line.shape[1]
    earlier = torch.ones(slots, slots, dtype=torch.bool, device=line.device).tril(-1)
    first = (count[:, None] > count[:, :, None]) | ((count[:, None] == count[:, :, None]) & earlier)
    return (same & first & found[:, None]).any(-1)
