"""Second derivatives of distances from the images of lines, for Newton steps, written out.

The distances depend on the moment of the line in the camera's frame. A motion moves direction and moment there, d and m, to
`exp(w) d` and `exp(w) m + v x exp(w) d`; the line itself moves along the steps of `Line3D`.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.bundle.bending import add_block, add_lens, columns_of, crossed, turned_twice, turns
from torchsfm.bundle.line_images import Frame
from torchsfm.bundle.projection import Projection
from torchsfm.geometry.line_manifold import line_tangents
from torchsfm.optim.curvature import product

_TINY = 1e-300


def bend_line(
    projection: Projection,
    line: Float[Tensor, "k 10"],
    frames: Sequence[Frame],
    camera: Float[Tensor, "k c"],
    slope: Float[Tensor, "3 k"],
    lens: Float[Tensor, "p p k"],
    wanted: Sequence[bool],
) -> Float[Tensor, "n n k"]:
    """The second derivatives of a function of moments in the camera's frame and free numbers of the camera.

    Args:
        projection: From the last frame to pixels.
        line: Lines as `LocalLine` has them.
        frames: Of the motions from the world to the camera, see `into_frames`.
        camera: The cameras.
        slope: The first derivatives by the moment.
        lens: The second ones by the moment and the free numbers.
        wanted: By the steps of which motions, then of camera and line.

    Returns:
        The upper triangle; below it is nothing of account.
    """
    columns = columns_of(projection, wanted, 4)
    by_d, by_m = torch.zeros_like(slope), slope
    slopes = []
    for R, t, _, _ in reversed(frames):
        slopes.append((by_d, by_m))
        shifted = by_d + torch.linalg.cross(by_m, t, dim=0)
        by_d, by_m = ((R * v[:, None]).sum(0) for v in (shifted, by_m))

    H = slope.new_zeros((columns[-1].stop, columns[-1].stop, len(line)))
    inner: list[tuple[slice, Tensor, Tensor]] = []  # how direction and moment in the frame reached move with steps before it
    if wanted[-1]:
        origin, unit = line.mT[6:9], line.mT[9]
        _along_line(line, by_d + torch.linalg.cross(by_m, origin, dim=0), unit * by_m, H[columns[-1], columns[-1]])
        tangents = line_tangents(line[:, :6]).permute(1, 2, 0)
        d, m = tangents[:3], tangents[3:]
        inner.append((columns[-1], d, unit * m + _moved_by(origin, d)))
    for (R, t, d, m), (by_d, by_m), own, w in zip(frames, reversed(slopes), columns, wanted, strict=False):
        turned = [(other, product(R, a), product(R, b)) for other, a, b in inner]
        inner = [(other, a, b + _moved_by(t, a)) for other, a, b in turned]
        if not w:
            continue
        turn, shift = slice(own.start, own.start + 3), slice(own.start + 3, own.stop)
        for other, a, b in inner:
            add_block(H, turn, other, crossed(a, by_d) + crossed(b, by_m))
            add_block(H, shift, other, crossed(a, by_m))
        turned_twice(d, by_d, H[turn, turn])
        turned_twice(m, by_m, H[turn, turn])
        H[turn, shift] += by_m[:, None] * d
        H[turn, shift].diagonal().sub_((by_m * d).sum(0)[:, None])
        across = turns(d)
        inner += [(turn, across, turns(m)), (shift, torch.zeros_like(across), across)]
    add_lens(projection, H, [(other, b) for other, _, b in inner], lens, columns[-2], camera)
    return H


def _along_line(line: Float[Tensor, "k 10"], by_d: Float[Tensor, "3 k"], by_m: Float[Tensor, "3 k"], H: Tensor) -> None:
    """Add the second derivatives by the steps of `Line3D`, from slopes by direction and moment of the line itself.

    In the line's own frame, `exp(w)` moves unit vectors e_i, to second order, by `w x e_i + (w w_i - e_i |w|^2) / 2`.
    """
    d, m = line.mT[:3], line.mT[3:6]
    sin, cos = (v.square().sum(0).sqrt().clamp_min(_TINY) for v in (d, m))
    u1, u2 = m / cos, d / sin
    frame = torch.stack((u1, u2, torch.linalg.cross(u1, u2, dim=0)))
    a, b = (frame * by_d).sum(1), (frame * by_m).sum(1)
    for row, column, size, own in ((1, a, sin, a[1]), (0, b, cos, b[0])):
        H[row, :3] += size * column / 2
        H[:3, row] += size * column / 2
        H[:3, :3].diagonal().sub_((size * own)[:, None])
    # The last step changes the lengths of what the turn moves by w x e_i.
    H[0, 3] += cos * a[2]
    H[2, 3] += -cos * a[0] - sin * b[1]
    H[1, 3] += sin * b[2]
    H[3, 3] -= sin * a[1] + cos * b[0]


def _moved_by(t: Float[Tensor, "3 k"], d: Float[Tensor, "3 n k"]) -> Float[Tensor, "3 n k"]:
    """`t x d`, what a shift of the origin adds to moments."""
    moved: Tensor = torch.linalg.cross(t[:, None].expand_as(d), d, dim=0)
    return moved
