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
    columns = columns_of(projection, wanted, 3)
    free = columns[-2].stop - columns[-2].start
    places: list[Tensor] = []
    for motion in motions:
        places.append(transform(motion, places[-1].mT if places else point))
    slope, lens = _of_lens(projection, places[-1], camera, by, free)
    slopes = [slope]
    for motion in reversed(motions):
        slopes.append(_turned_back(motion, slopes[-1]))
    in_world, *slopes = slopes[::-1]

    H = slope.new_zeros((columns[-1].stop, columns[-1].stop, len(point)))
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
            add_block(H, turn, other, crossed(moved, s))
        turned_twice(place, s, H[turn, turn])
        inner += [(turn, turns(place)), (slice(turn.stop, own.stop), unit)]
    add_lens(projection, H, inner, lens, columns[-2], camera)
    return H


def columns_of(projection: Projection, wanted: Sequence[bool], last: int) -> list[slice]:
    """Where the steps of motions, of free numbers of cameras, and of what they show, which has `last`, are in H."""
    free = len(projection.free) if wanted[-2] else 0
    widths = [6 * w for w in wanted[:-2]] + [free, last * wanted[-1]]
    ends = torch.tensor(widths).cumsum(0).tolist()
    return [slice(end - width, end) for end, width in zip(ends, widths, strict=True)]


def add_block(H: Float[Tensor, "n n m"], first: slice, second: slice, block: Float[Tensor, "a b m"]) -> None:
    """Add a block to the upper triangle."""
    if first.start <= second.start:
        H[first, second] += block
    else:
        H[second, first] += block.transpose(0, 1)


def add_lens(
    projection: Projection,
    H: Float[Tensor, "n n m"],
    inner: Sequence[tuple[slice, Tensor]],
    lens: Float[Tensor, "c c m"],
    own: slice,
    camera: Float[Tensor, "m k"],
) -> None:
    """Add what the lens bends.

    Args:
        projection: From the camera's frame to pixels.
        H: What to add to, in the upper triangle.
        inner: The steps by which the three numbers of the camera's frame move, and how.
        lens: Second derivatives by these three, then by free numbers of the camera.
        own: The steps of the latter.
        camera: The cameras, whose switches count.
    """
    for other, moved in inner:
        bent = product(lens[:3, :3], moved)
        for some, also in inner:
            if some.start <= other.start:
                H[some, other] += product(also.transpose(0, 1), bent)
    free = own.stop - own.start
    if not free:
        return
    mixed, twice = lens[3:, :3], lens[3:, 3:]
    if projection.switched:
        switches = camera.mT[-free:]
        mixed, twice = mixed * switches[:, None], twice * switches * switches[:, None]
    H[own, own] += twice
    for other, moved in inner:
        add_block(H, own, other, product(mixed, moved))


def crossed(moved: Float[Tensor, "3 n m"], s: Float[Tensor, "3 m"]) -> Float[Tensor, "3 n m"]:
    """Each direction d cross the slopes s: what a turn w counts by `s . (w x d)`."""
    across = torch.empty_like(moved)
    turn_slopes(moved, s[None, :, None].expand(1, *moved.shape), across[None])
    return across


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


def turned_twice(place: Float[Tensor, "3 m"], s: Float[Tensor, "3 m"], H: Float[Tensor, "3 3 m"]) -> None:
    """Add the second derivatives of `s . exp(w) Y` by w."""
    half = s / 2
    H.addcmul_(half[:, None], place).addcmul_(place[:, None], half)
    H.diagonal().sub_((s * place).sum(0)[:, None])


def turns(place: Float[Tensor, "3 m"]) -> Float[Tensor, "3 3 m"]:
    """The derivatives of `w x Y`, a column for each coordinate of w."""
    x, y, z = place
    none = torch.zeros_like(x)
    return torch.stack((torch.stack((none, z, -y)), torch.stack((-z, none, x)), torch.stack((y, -x, none))))


def _turned_back(motion: Float[Tensor, "m 12"], s: Float[Tensor, "3 m"]) -> Float[Tensor, "3 m"]:
    """Slopes by directions before a motion, from those by directions behind it."""
    return (motion.mT[:9].reshape(3, 3, -1) * s[:, None]).sum(0)
