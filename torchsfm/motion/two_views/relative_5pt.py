"""Five rays in two calibrated cameras: the poses with the points in front of both (Nister 2004).

Every essential matrix stands for two rotations, each with two directions of the baseline t. The rays d1 and d2 of a point lie
in one plane with t: the right rotation turns all d1 to the side of t where the d2 are, and the direction of t is the one that
gives positive depths. So at most one pose of each E remains. All arithmetic has the batch in the last dimension.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Solutions, broadcast_shapes
from torchsfm.linalg.kernel import kernel
from torchsfm.linalg.portions import portions
from torchsfm.linalg.real_roots import number_among_equals
from torchsfm.linalg.rows import add_rows, combine_rows, take_columns
from torchsfm.motion.two_views.essential_manifold import combine, polish
from torchsfm.motion.two_views.five_points import (
    FivePointRoots,
    back_substitute,
    five_point_roots,
    gone_round,
    longest,
    normalised,
    products_of_minors,
)
from torchsfm.optim import attach_implicit, for_slots, wants_derivative

_CHUNK = 4096
"""Samples at a time: their matrices fit the cache."""
_BESIDE = 1e-6
"""How far starts may be on the wrong side of an epipolar plane in any case, as a sine."""
_NEAR = 1e-7
"""Distance from the manifold before a Newton step after which E is as good as any data."""
_MORE = 2
"""Newton steps for the others."""
_CONVERGED = 1e-4
"""Distance from the manifold before the last of these steps, of what is a solution."""


def equations(
    pose: Float[Tensor, "*#batch 3 4"], d1: Float[Tensor, "*#batch 5 3"], d2: Float[Tensor, "*#batch 5 3"]
) -> Float[Tensor, "*batch 15"]:
    """Fifteen equations of rank 12: d2' (t x R d1) = 0 for each ray, R'R = I, and |t|^2 = 1."""
    R, t = pose[..., :3], pose[..., 3]
    epipolar = (d2 * torch.linalg.cross(t[..., None, :].expand_as(d1 @ R.mT), d1 @ R.mT)).sum(-1)
    shape = epipolar.shape[:-1]
    orthogonal = (R.mT @ R - torch.eye(3, dtype=R.dtype, device=R.device)).flatten(-2)
    gauge = (t * t).sum(-1, keepdim=True) - 1
    return torch.cat((epipolar, orthogonal.expand(*shape, 9), gauge.expand(*shape, 1)), -1)


def relative_5pt(
    d1: Float[Tensor, "*#batch 5 3"], d2: Float[Tensor, "*#batch 5 3"], slack: Float[Tensor, "*#batch"]
) -> Solutions[Float[Tensor, "*batch 10 3 4"]]:
    """The poses [R | t], |t| = 1, for which five rays meet in front of both cameras; at most one of the four of each E.

    Meant for hypotheses: exact to about 1e-8, and of the rare samples whose polynomial loses most of its digits (some in a
    thousand, more where the baseline is small) solutions may be missing that `essential_5pt` has. Differentiable in the rays.

    Args:
        d1: Five rays of the first camera, of any length but 0.
        d2: The corresponding rays of the second camera.
        slack: By which angle rays may miss the front, in radians.

    Returns:
        Ten slots, the valid ones first. Computed in float64 whatever the dtype.
    """
    batch = broadcast_shapes(d1.shape[:-2], d2.shape[:-2], slack.shape)
    with torch.no_grad():
        rows1, rows2 = (d.detach().double().expand(*batch, 5, 3).reshape(-1, 5, 3).permute(2, 1, 0) for d in (d1, d2))
        angle = slack.detach().double().expand(batch).reshape(-1)
        size = angle.shape[0]
        pose = torch.tensor([1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 1], dtype=torch.float64, device=d1.device).repeat(size * 10, 1)
        valid = torch.zeros(size * 10, dtype=torch.bool, device=d1.device)
        for part in portions(size, _CHUNK, d1.device):
            item, found = _poses(rows1[..., part], rows2[..., part], angle[part])
            place = (item + part.start) * 10 + number_among_equals(item).clamp_max_(9)
            pose.index_copy_(0, place, found.mT)
            valid.index_fill_(0, place, True)
        pose, valid = pose.to(d1.dtype).reshape(*batch, 10, 3, 4), valid.reshape(*batch, 10)
    if wants_derivative(d1, d2):
        pose = attach_implicit(equations, pose, for_slots(d1, batch), for_slots(d2, batch), dims=2, valid=valid)
    return Solutions(pose, valid)


def _poses(d1: Float[Tensor, "3 5 batch"], d2: Float[Tensor, "3 5 batch"], slack: Tensor) -> tuple[Tensor, Tensor]:
    """The samples, in order, and the poses (12, poses) of those in front of both cameras."""
    roots = five_point_roots(d1, d2)
    u = back_substitute(take_columns(roots.rows, roots.item), roots.s, roots.t)
    # Of wrong data most solutions are behind a camera, which the start tells unless it is a poor one.
    keep = (~_on_wrong_sides(u, roots, slack)).nonzero()[:, 0]
    item, u = roots.item.index_select(0, keep), take_columns(u, keep)
    angle, basis = slack.index_select(0, item), take_columns(roots.basis, item)
    rays = take_columns(torch.cat((roots.d1, roots.d2)), item)
    u, pose, front, error = _polished(u, basis, rays, angle)
    rest = (~(error < _NEAR)).nonzero()[:, 0]
    if len(rest):
        u, basis = take_columns(u, rest), take_columns(basis, rest)
        for _ in range(_MORE):
            u, error = polish(u, basis)
        better, ahead = _in_front(combine(u, basis), take_columns(rays, rest), angle.index_select(0, rest))
        pose.index_copy_(1, rest, better)
        front.index_copy_(0, rest, ahead & (error < _CONVERGED))
    keep = front.nonzero()[:, 0]
    item, order = item.index_select(0, keep).sort(stable=True)
    return item, take_columns(pose, keep.index_select(0, order))


def _on_wrong_sides(
    u: Float[Tensor, "4 roots"], roots: FivePointRoots, slack: Float[Tensor, " batch"]
) -> Bool[Tensor, " roots"]:
    """Where a point cannot be in front of both cameras: it is on different sides of the two epipolar planes of the first.

    That is, a2' E d1 and d2' E a1 have the same sign, a1 and a2 being the rays of the first point (see `oriented_7pt`). Both
    are linear in the coordinates of E, and small beside an epipole, where the noise decides.
    """
    basis = roots.basis.view(4, 3, 3, -1)
    first, second = combine_rows(basis.unbind(1), roots.d2[:, 0]), combine_rows(basis.unbind(2), roots.d1[:, 0])
    lines = (first, roots.d1), (second, roots.d2)
    forms = torch.stack([combine_rows(line[:, :, None].unbind(1), rays[:, 1:]) for line, rays in lines], 1)
    side, other = combine_rows(take_columns(forms, roots.item), u)
    least = torch.maximum(torch.minimum(side, other), -torch.maximum(side, other)).amax(0)
    return least > (2 * slack).clamp(min=_BESIDE).index_select(0, roots.item)


@kernel(chunk=1 << 20)
def _polished(u: Tensor, basis: Tensor, rays: Tensor, slack: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A Newton step: coordinates, pose, whether it is in front, and the error before."""
    u, error = polish(u, basis)
    return u, *_in_front(combine(u, basis), rays, slack), error


def _in_front(
    E: Float[Tensor, "9 batch"], rays: Float[Tensor, "6 5 batch"], slack: Float[Tensor, " batch"]
) -> tuple[Tensor, Tensor]:
    """The pose (12, batch) of a unit E, and whether it has five unit rays in front.

    With C the cofactors of E = [t]x R, the rotations are R = C + T and C - T with T = [t]x E (Horn 1990). For both of them
    t' R = t' C; d2' R d1 is the product of the cosines of the angles to t, plus or minus that of the sines.
    """
    round_ = gone_round(E.view(3, 3, -1))
    C = products_of_minors(round_)
    t = normalised(longest(add_rows((C * C).unbind(0)).unbind(0), C.unbind(1)))
    around = torch.cat((t, t[:2]))[:, None]
    T = (around[1:4] * round_[2:, :3]).addcmul_(around[2:], round_[1:4, :3], value=-1)
    C *= 2
    # Of both rays the cosine of the angle to t, and the product of the sines.
    d1, d2 = rays[:3], rays[3:]
    along1 = combine_rows(d1.unbind(0), combine_rows(C, t)[:, None])
    along2 = combine_rows(d2.unbind(0), t[:, None])
    across = combine_rows(combine_rows(d1[:, None], T[:, :, None].unbind(1)), d2)
    sign = torch.copysign(across.new_tensor(2**0.5), add_rows(across))
    cosine = torch.addcmul(along1 * along2, across, sign)
    # The depths along unit rays, times the squared sine of the angle between them, for one direction of t.
    depth1, depth2 = (cosine * along2).sub_(along1), torch.addcmul(along2, cosine, along1, value=-1)
    ahead = torch.minimum(depth1, depth2).amin(0) > -slack
    behind = torch.maximum(depth1, depth2).amax(0) < slack
    pose = E.new_empty(3, 4, E.shape[-1])
    torch.mul(T, sign, out=pose[:, :3]).add_(C)
    torch.mul(t, torch.where(ahead, 1.0, -1.0).to(t.dtype), out=pose[:, 3])
    return pose.view(12, -1), ahead | behind
