"""Points and lines of moderate size around 0, as the rows of a table of sights."""

import torch
from torch import Tensor

from torchsfm._types import broadcast_shapes
from torchsfm.linalg import cross
from torchsfm.resection.sights import LINE, POINT, SEGMENT
from torchsfm.robust.moderation import middle_and_size, moved_and_scaled, present

_OFF = 1e-4
"""How much of a moment along its line, over the size of the world, is rounding."""
_RIDGE = 1e-6
"""How much the middle of all feet counts where lines leave the point nearest to them open."""


def line_data(l: Tensor | None, L: Tensor | None, view: str = "") -> dict[str, tuple[Tensor | None, str]]:  # noqa: E741
    """Segments or image lines, of several views if so named, and lines of the world, with the shapes for `check_tensors`.

    Raises:
        ValueError: Only one of them is given.
    """
    if l is None or L is None:
        raise ValueError(f"l, L: wanted both or neither, got {'l' if L is None else 'L'} alone")
    segments = isinstance(l, Tensor) and l.ndim > 2 and l.shape[-2:] == (2, 2)
    return {"l": (l, view + ("k 2 2" if segments else "k 3")), "L": (L, "k 6")}


def moderate_structure(X: Tensor, L: Tensor, usable: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """The world's half of a table (*batch, n + k, 6), points before lines, and the middle and size taken from and out of it.

    NaN for lines that are none: without direction, or with a moment that is not across it.

    Args:
        X: Points (*batch, n, 3).
        L: Lines (*batch, k, 6).
        usable: Which of both exist (*batch, n + k); None for all.
    """
    n, k = X.shape[-2], L.shape[-2]
    batch = broadcast_shapes(X.shape[:-2], L.shape[:-2], () if usable is None else usable.shape[:-1])
    X, L = X.expand(*batch, n, 3), L.expand(*batch, k, 6)
    bad = ~(L.isfinite().all(-1, keepdim=True) & (L[..., :3] != 0).any(-1, keepdim=True))
    L = torch.where(bad, 1.0, L)
    length = torch.linalg.vector_norm(L[..., :3], dim=-1, keepdim=True)
    d, m = L[..., :3] / length, L[..., 3:] / length
    feet = cross(d, m)
    with torch.no_grad():
        every = torch.cat((X, torch.where(bad, torch.nan, feet)), -2)
        there = present(usable, every)
        start = _nearest(every, d, there)
        centre, size = middle_and_size(torch.cat((X, _foot(feet, d, start)), -2), there)
        reach = size + torch.linalg.vector_norm(centre, dim=-1)
        bad = bad | ((d * m).sum(-1, keepdim=True).abs() > _OFF * reach[..., None, None])
    points = moved_and_scaled(X, centre, size)
    foot = moved_and_scaled(_foot(feet, d, centre), centre, size)
    lines = torch.where(bad, torch.nan, torch.cat((d, cross(foot, d)), -1))
    return torch.cat((torch.nn.functional.pad(points, (0, 3)), lines), -2), centre, size


def image_rows(x: Tensor, l: Tensor, centre: Tensor, unit: Tensor) -> Tensor:  # noqa: E741
    """The image's half of a table, (*batch, n + k, 4), in units from a centre; NaN for lines and segments that are none.

    Of an image line, two points a unit to both sides of the one nearest to the centre.

    Args:
        x: Image points (*batch, n, 2).
        l: Segments (*batch, k, 2, 2) or homogeneous lines (*batch, k, 3).
        centre: The centre (*batch, 2).
        unit: The unit (*batch).
    """
    batch = broadcast_shapes(x.shape[:-2], l.shape[: -3 if is_segments(l) else -2], unit.shape)
    x = moved_and_scaled(x.expand(*batch, *x.shape[-2:]), centre, unit)
    ends = segment_ends(l, centre, unit)
    ends = ends.expand(*batch, *ends.shape[-3:])
    none = ((ends[..., 0, :] == ends[..., 1, :]).all(-1) | ~ends.isfinite().flatten(-2).all(-1))[..., None]
    ends = moved_and_scaled(ends.flatten(-3, -2), centre, unit).reshape(*ends.shape[:-2], 4)
    return torch.cat((torch.cat((x, x), -1), torch.where(none, torch.nan, ends)), -2)


def segment_ends(l: Tensor, centre: Tensor, unit: Tensor) -> Tensor:  # noqa: E741
    """Segments (*batch, k, 2, 2) as they are, or two points of homogeneous lines, a unit off the nearest to the centre.

    NaN for what is no line.
    """
    if is_segments(l):
        return l
    none = ~(l.isfinite().all(-1, keepdim=True) & (l[..., :2] != 0).any(-1, keepdim=True))
    l = torch.where(none, 1.0, l)  # noqa: E741
    offset = (l[..., :2] * centre[..., None, :]).sum(-1, keepdim=True) + l[..., 2:]
    length = torch.linalg.vector_norm(l[..., :2], dim=-1, keepdim=True)
    normal = l[..., :2] / length
    foot = centre[..., None, :] - normal * (offset / length)
    along = torch.stack((-normal[..., 1], normal[..., 0]), -1) * unit[..., None, None]
    return torch.where(none[..., None], torch.nan, torch.stack((foot - along, foot + along), -2))


def pixel_ends(l: Tensor, K: Tensor) -> Tensor:  # noqa: E741
    """Segments, or of lines two points a focal length to each side of the one nearest to the principal point."""
    K = K.detach()
    return segment_ends(l, K[..., :2, 2], (K[..., 0, 0] * K[..., 1, 1]).abs().sqrt())


def kinds(n: int, l: Tensor) -> Tensor:  # noqa: E741
    """What the rows of a table are, (n + k, 1)."""
    k = l.shape[-3 if is_segments(l) else -2]
    kind = torch.full((n + k, 1), float(SEGMENT if is_segments(l) else LINE), dtype=l.dtype, device=l.device)
    kind[:n] = POINT
    return kind


def is_segments(l: Tensor) -> bool:  # noqa: E741
    """Whether these are segments, not homogeneous lines."""
    return l.shape[-1] == 2


def _foot(feet: Tensor, d: Tensor, centre: Tensor) -> Tensor:
    """The points of lines nearest to a centre."""
    return feet + ((centre[..., None, :] - feet) * d).sum(-1, keepdim=True) * d


def _nearest(X: Tensor, d: Tensor, there: Tensor | None) -> Tensor:
    """The point nearest to all points and lines, of which the last have directions."""
    n = X.shape[-2] - d.shape[-2]
    used = X.isfinite().all(-1) & torch.nn.functional.pad(d.isfinite().all(-1), (n, 0), value=True)
    used = used if there is None else used & there
    w = used.to(X.dtype)[..., None]
    X, d = torch.where(used[..., None], X, 0.0), torch.where(used[..., n:, None], d, 0.0)
    total = w.sum(-2).clamp_min(1.0)
    mean = (w * X).sum(-2) / total
    away = w * (X - mean[..., None, :])
    lines = w[..., n:, :] * d
    eye = torch.eye(3, dtype=X.dtype, device=X.device)
    A = eye * (total[..., None] * (1 + _RIDGE)) - lines.mT @ d
    b = away.sum(-2) - (lines * (away[..., n:, :] * d).sum(-1, keepdim=True)).sum(-2)
    shift = torch.linalg.solve_ex(A, b[..., None])[0][..., 0]
    return mean + torch.where(shift.isfinite().all(-1, keepdim=True), shift, 0.0)
