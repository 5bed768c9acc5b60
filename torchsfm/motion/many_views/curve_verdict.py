"""Is what a search for cameras and curves ended at the answer, and do the data determine one?"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry.curve_places import CurvePlaces
from torchsfm.geometry.homogeneous import divide_safely
from torchsfm.linalg import eigh, eigvalsh, solve
from torchsfm.motion.many_views.bilinear_fit import unit_frame
from torchsfm.motion.many_views.bilinear_steps import reduced
from torchsfm.motion.many_views.curve_anew import nearest_places
from torchsfm.motion.many_views.curve_fit import Scene, pinned
from torchsfm.motion.many_views.curve_search import Found
from torchsfm.optim.descent import Descent, Options, descend
from torchsfm.optim.pytree import pick

_RIGHT = 0.8
"""Of all samples that must be measured."""
_UNDETERMINED = 0.3
"""Standard deviation of a camera matrix of norm 1 beyond which it is taken for undetermined."""
_WHITE = 1.0
"""The mean square of the difference of neighbouring samples' distances over that of the distances: 2 for noise, 0 for what is
smooth along the curve."""
_EXACT = 1e-5
"""Distances below this part of the curves' extent are what cubics between samples leave, smooth or not."""
_BEYOND_TWO = 3
"""Views beyond the second of all curves together. Fewer have samples enough, but wrong cameras come as near to them as right
ones: of what was found for one curve in six views, or two in three, an eighth was wrong; for three in three, or two in four and
more, nothing of 150."""
_FLAT_STEPS = 30
"""Most steps of the homographies that are fitted for comparison: where they do not fit, their minimum does not matter."""
_ROUGHLY, _CLOSELY = 0.3, 1e-3
"""Part of their cost that may be left to gain, at first and where the answer is not clear then."""
_CLEAR = 10.0
"""Times more than the answer asks for, what is left roughly is clear: closely it was up to three times less."""


def enough_shown(shown: Float[Tensor, "p c m"], view: Bool[Tensor, "p v"]) -> Bool[Tensor, "p"]:
    """Whether cameras may follow from samples shown in so many views; more views never make it worse."""
    v = view.sum(-1)
    enough = (v >= 3) & ((shown - 2).clamp(min=0).sum((-2, -1)) >= 11 * v - 15)
    beyond = (shown.amax(-1) - 2).clamp(min=0)
    return enough & ((beyond > 0).sum(-1) >= 2) & (beyond.sum(-1) >= _BEYOND_TWO)


def judge(images: CurvePlaces, found: Found, view: Bool[Tensor, "p v"], threshold: Float[Tensor, "p"]) -> Tensor:
    """What became of each problem (p); `threshold` in the frame in which it was solved."""
    v = view.sum(-1)
    counts = found.weight * found.measured[:, None]
    views = counts.sum(1)
    observed, points = counts.sum((1, 2, 3)), found.measured.sum((-2, -1))
    shown = found.weight.sum(1)
    unknowns = 11 * v - 15
    redundancy = observed - 2 * points - unknowns
    total = (found.misfit.nan_to_num(0.0, 0.0, 0.0).square() * views).sum((-2, -1))
    rms = (total / observed.clamp(min=1)).sqrt()
    # The cameras' information, samples eliminated: fifteen directions of space are free, and absent views.
    values, _ = eigvalsh(reduced(found.end.end.linear, torch.zeros_like(rms), points=True)[0])
    first = (15 + 12 * (~view).sum(-1)).clamp(max=values.shape[-1] - 1)
    least = values.gather(-1, first[:, None])[:, 0]
    variance = total / redundancy.clamp(min=1)
    loose = (least <= 1e-11 * values[:, -1]) | (variance > _UNDETERMINED**2 * least) | ~torch.isfinite(least)
    loose = loose | _flat(images, found, v, redundancy)
    agreed = points >= _RIGHT * (shown > 0).sum((-2, -1))
    smooth = (_roughness(images, found, counts) < _WHITE) & (rms > _EXACT)
    wrong = ~agreed | smooth | (rms > threshold) | (redundancy < 0)
    status = torch.where(found.end.status == Status.OK, int(Status.OK), int(Status.NOT_CONVERGED))
    status = torch.where(wrong, int(Status.NO_CONSENSUS), status)
    # What is refused anyhow need not be looked at again.
    asked = (status == Status.OK) & ~loose
    if bool(asked.any()):
        loose = loose | (asked & _flat(images, found, v, redundancy, anew=True))
    status = torch.where(loose, int(Status.DEGENERATE), status)
    return torch.where(enough_shown(shown, view), status, int(Status.TOO_FEW))


def _flat(images: CurvePlaces, found: Found, v: Tensor, redundancy: Tensor, anew: bool = False) -> Bool[Tensor, "p"]:
    """Whether space explains no more than noise beyond a plane: curves in one, or views without baseline.

    Homographies are fitted too. Of what they leave, a fourth dimension always takes some: of noise, the largest singular value
    of a matrix of 3 v times n, more than the number of its parameters. Three times more must be gone.

    Args:
        images: The image curves.
        found: Where the search ended.
        v: The number of views.
        redundancy: Measurements less unknowns.
        anew: Whether to look for homographies by all curves but one, whichever that is, and to find this one's points by them:
            a fourth dimension may have been made of a curve of a plane whose points were put together wrongly.
    """
    end = found.end.end
    seen = found.measured.flatten(1)[:, None]
    n = seen.sum((-2, -1)).double()
    flat_redundancy = (redundancy + n + 3 * v - 7).clamp(min=1)
    redundancy = redundancy.clamp(min=0).double()
    beyond = ((3 * v).double().sqrt() + n.sqrt()).square() - (3 * v + n - 7)
    of_noise = redundancy * redundancy / (redundancy + beyond).clamp(min=1) / flat_redundancy
    left_by = _left_by_planes_anew if anew else _left_by_plane
    cost: Tensor = end.cost
    explained = of_noise / 3 * left_by(images, found, _ROUGHLY)
    unclear = (cost <= explained) & (_CLEAR * cost > explained)
    if bool(unclear.any()):
        explained = torch.where(unclear, of_noise / 3 * left_by(images, found, _CLOSELY), explained)
    return cost > explained


def _by_plane(images: CurvePlaces, x: Scene, counts: Float[Tensor, "p v c m"], tolerance: float) -> Descent:
    """Homographies and points of a plane at the least squares of the distances that count."""
    seen = (counts.sum(1) > 0).flatten(1)[:, None]
    plane = eigh((x.u * seen) @ x.u.mT)[1][..., 1:]
    P, u = unit_frame(x.P @ plane[:, None], plane.mT @ x.u)
    flat = Scene(P, u, x.place)
    return descend(pinned(images, counts, flat), flat, Options(_FLAT_STEPS, tolerance))


def _left_by_plane(images: CurvePlaces, found: Found, tolerance: float) -> Float[Tensor, "p"]:
    left: Tensor = _by_plane(images, found.end.end.x, found.weight * found.measured[:, None], tolerance).cost
    return left


def _left_by_planes_anew(images: CurvePlaces, found: Found, tolerance: float) -> Float[Tensor, "p"]:
    """The least that is left by homographies that begin with those of all curves but one."""
    p, v, c, m = found.weight.shape
    each = torch.arange(p, device=found.weight.device).repeat_interleave(c)
    k = torch.arange(c, device=each.device).repeat(p)
    images, x, counts = pick((each,), (images, found.end.end.x, found.weight * found.measured[:, None]))
    own = torch.nn.functional.one_hot(k, c)[:, None, :, None] > 0
    rest = _by_plane(images, x, torch.where(own, 0, counts), tolerance).x
    # The curve's points in the plane, by the view that sees most of it; and those of its images next to theirs.
    row = torch.arange(len(each), device=each.device)
    view = counts[row, :, k].sum(-1).argmax(-1)
    foot = images.at(x.place)[0][row, view, k]
    points = solve(rest.P[row, view], torch.nn.functional.pad(foot, (0, 1), value=1.0).mT)[0]
    points = torch.nn.functional.normalize(points, dim=1)
    u = torch.where(own[:, 0, :, 0].repeat_interleave(m, -1)[:, None], points.repeat(1, 1, c), rest.u)
    y = rest.P @ u[:, None]
    y = divide_safely(y[:, :, :2].movedim(2, -1), y[:, :, 2]).reshape(len(each), v, c, m, 2)
    place = torch.where(own, nearest_places(images, y), rest.place)
    flat = Scene(rest.P, u, place)
    left: Tensor = descend(pinned(images, counts, flat), flat, Options(_FLAT_STEPS, tolerance)).cost
    return left.view(p, c).amin(-1)


def _roughness(images: CurvePlaces, found: Found, counts: Tensor) -> Float[Tensor, "p"]:
    """The mean square of the difference of neighbouring samples' distances over that of the distances.

    Neighbours have a measured point between them, at least: what is drawn from one point to the next is smooth, noise or not.
    """
    r = found.seen.r.reshape(found.weight.shape)
    m = r.shape[-1]
    apart = (m / images.number.clamp(min=1)).ceil().long().clamp(min=1)[..., None]
    ahead = torch.arange(m, device=r.device) + apart
    there, ahead = ahead < m, ahead.clamp(max=m - 1)
    pair = counts * counts.gather(-1, ahead) * there
    other = r.gather(-1, ahead)
    step = (pair * (other - r).square()).sum((1, 2, 3))
    size = (pair * (other.square() + r.square())).sum((1, 2, 3)) / 2
    share: Tensor = step / size.clamp_min(1e-300)
    return share
