"""Second derivatives of reprojection, for Newton steps: written out for motions and points, automatic for the lens alone.

A motion moves a point Y of its frame by `exp(w) Y + v`: to second order in w by `w x Y + (w (w . Y) - Y |w|^2) / 2`. So what
is left for the chain rule are sums of products of few numbers.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.bundle.projection import Projection, transform
from torchsfm.geometry.projection import turn_slopes
from torchsfm.optim.curvature import product, second_rows

_TINY = torch.finfo(torch.float64).tiny


def bend(projection: Projection, *rows: Tensor, by: Float[Tensor, "2 m"], wanted: Sequence[bool]) -> Float[Tensor, "n n m"]:
    """The second derivatives of `by . residual` by the steps of motions, free camera numbers and `RayPoint`.

    Args:
        projection: From the last frame to pixels.
        *rows: Motions from the world to the camera, the first of them first, (m, 12); cameras; points and where their rays
            begin, (m, 6); image points.
        by: What both pixel coordinates count.
        wanted: By the steps of which motions, then of camera and point.

    Returns:
        The upper triangle; below it is nothing of account.
    """
    *motions, camera, point, _ = rows
    free = len(projection.free) if wanted[-2] else 0
    widths = [6 * w for w in wanted[:-2]] + [free, 3 * wanted[-1]]
    ends = torch.tensor(widths).cumsum(0).tolist()
    columns = [slice(end - width, end) for end, width in zip(ends, widths, strict=True)]
    places: list[Tensor] = []
    for motion in motions:
        places.append(transform(motion, places[-1].mT if places else point))
    slope, lens = _of_lens(projection, places[-1], camera, by, free)
    slopes = [slope]
    for motion in reversed(motions):
        slopes.append(_turned_back(motion, slopes[-1]))
    in_world, *slopes = slopes[::-1]

    H = slope.new_zeros((ends[-1], ends[-1], len(point)))
    unit = torch.eye(3, dtype=H.dtype, device=H.device)[:, :, None].expand(3, 3, len(point))
    inner: list[tuple[slice, Tensor]] = []  # how the point in the frame reached moves with steps before it
    if wanted[-1]:
        inner.append((columns[-1], unit))
        _along_ray(point, in_world, H[columns[-1], columns[-1]])
    for motion, place, s, own, w in zip(motions, places, slopes, columns, wanted, strict=False):
        R = motion.mT[:9].reshape(3, 3, -1)
        inner = [(other, product(R, moved)) for other, moved in inner]
        if not w:
            continue
        turn = slice(own.start, own.start + 3)
        for other, moved in inner:
            across = torch.empty_like(moved)  # w x d counts d x s
            turn_slopes(moved, s[None, :, None].expand(1, *moved.shape), across[None])
            if other.start > own.start:
                H[turn, other] += across
            else:
                H[other, turn] += across.transpose(0, 1)
        _turned_twice(place, s, H[turn, turn])
        inner += [(turn, _turns(place)), (slice(turn.stop, own.stop), unit)]
    for other, moved in inner:
        bent = product(lens[:3, :3], moved)
        for some, also in inner:
            if some.start <= other.start:
                H[some, other] += product(also.transpose(0, 1), bent)
    if free:
        own, switches = columns[-2], camera.mT[-free:] if projection.switched else None
        mixed, twice = lens[3:, :3], lens[3:, 3:]
        if switches is not None:
            mixed, twice = mixed * switches[:, None], twice * switches * switches[:, None]
        H[own, own] += twice
        for other, moved in inner:
            crossed = product(mixed, moved)
            if other.start > own.start:
                H[own, other] += crossed
            else:
                H[other, own] += crossed.transpose(0, 1)
    return H


def _of_lens(
    projection: Projection, place: Float[Tensor, "3 m"], camera: Float[Tensor, "m k"], by: Float[Tensor, "2 m"], free: int
) -> tuple[Float[Tensor, "3 m"], Float[Tensor, "c c m"]]:
    """The first derivatives of `by . pixels` by points of the camera's frame; the second, also by free numbers of cameras."""
    row, leaf = camera.mT.detach(), place.detach().requires_grad_()
    with torch.enable_grad():
        leaves = [leaf]
        if free:
            picked = torch.tensor(projection.free, device=row.device)
            leaves.append(row[picked].requires_grad_())
            row = row.index_copy(0, picked, leaves[1])
        value = (projection.inside.pixels(leaf, row) * by).sum()
        (slope,) = torch.autograd.grad(value, leaf, retain_graph=True)
        rows = second_rows(value, leaves, leaves)
    return slope, torch.stack([torch.cat(row) for row in rows])


def _along_ray(point: Float[Tensor, "m 6"], s: Float[Tensor, "3 m"], H: Float[Tensor, "3 3 m"]) -> None:
    """Add the second derivatives of `s . X`: a step d along the ray a moves X by `d (a . d) / |a|^2` beyond d."""
    X, C = point.mT[:3], point.mT[3:]
    away = X - C
    unit = away / away.square().sum(0).clamp_min(_TINY)
    H.add_(s[:, None] * unit).add_(unit[:, None] * s)


def _turned_twice(place: Float[Tensor, "3 m"], s: Float[Tensor, "3 m"], H: Float[Tensor, "3 3 m"]) -> None:
    """Add the second derivatives of `s . exp(w) Y` by w."""
    half = s / 2
    H.addcmul_(half[:, None], place).addcmul_(place[:, None], half)
    H.diagonal().sub_((s * place).sum(0)[:, None])


def _turns(place: Float[Tensor, "3 m"]) -> Float[Tensor, "3 3 m"]:
    """The derivatives of `w x Y`, a column for each coordinate of w."""
    x, y, z = place
    none = torch.zeros_like(x)
    return torch.stack((torch.stack((none, z, -y)), torch.stack((-z, none, x)), torch.stack((y, -x, none))))


def _turned_back(motion: Float[Tensor, "m 12"], s: Float[Tensor, "3 m"]) -> Float[Tensor, "3 m"]:
    """Slopes by directions before a motion, from those by directions behind it."""
    return (motion.mT[:9].reshape(3, 3, -1) * s[:, None]).sum(0)
