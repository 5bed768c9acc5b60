"""From a rough start to cameras and samples at the least squares of normal distances: what is wrong is mended on the way.

A sample in a bend of an image curve may come to the wrong side of it, from which no small step leads back; one such sample
holds all others. So samples that are far worse than most, or out of order on an image curve, count little, and are put between
their neighbours again, in space and on the image curves, a few steps of the cameras at a time.
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.geometry.curve_places import CurvePlaces
from torchsfm.motion.many_views.curve_fit import CurveDistances, Scene, Sights, pinned
from torchsfm.motion.many_views.curve_refit import refit
from torchsfm.optim.descent import Descent, Options, descend

_ROUNDS = 6
"""Times that samples are mended."""
_STEPS = 5
"""Of cameras and samples after each."""
_TRUSTED = 3.0
"""Where the loss lets go, in medians of samples' distances."""
_WRONG = 6.0
"""Samples so many medians off are put between their neighbours,"""
_KEPT = 5.0
"""and left out in the end when they still are so many off"""
_FINE = 1e-5
"""and more than this part of the curves' extent, about what cubics between samples leave of smooth curves."""
_TOLERANCE = 1e-6
"""End when no more than this part of the cost is left to gain."""
_OWN = 6
"""Steps of a sample by itself after it was put anew."""
_MENDED = 0.1
"""Of all samples, that splines have put right: more may have held the cameras at a wrong place."""

_FINER = 0.5
"""Part of the distances that smoother image curves must take away where samples are exact; noise they enlarge."""


class Found(NamedTuple):
    """Where the search ended."""

    x: Scene
    seen: Sights
    weight: Float[Tensor, "p v c m"]
    """1 for what counts."""
    misfit: Float[Tensor, "p c m"]
    """Root mean square distance of each sample from the image curves that count; inf where fewer than three do."""
    measured: Bool[Tensor, "p c m"]
    end: Descent


def approach(images: CurvePlaces, shown: Float[Tensor, "p v c m"], x: Scene) -> Scene:
    """Cameras and samples near the least squares, from a rough start; `shown` is 1 where an image shows a curve."""
    for _ in range(_ROUNDS):
        plain, x = _mended(_inside(images, shown, x), x)
        e = plain.misfit(plain.sights(x)).sqrt()
        trust = (1 + (e / (_TRUSTED * _median(e, plain))).square()).reciprocal().square()
        weighed = replace(plain, weight=plain.weight * trust.reshape(plain.weight[:, :1].shape))
        x = descend(weighed, x, Options(_STEPS, 1e-10)).x
    return x


def finish(images: CurvePlaces, shown: Float[Tensor, "p v c m"], x: Scene, steps: int) -> tuple[CurvePlaces, Found]:
    """The least squares over the samples that are right; of all that was measured, where splines follow that.

    Where splines have led many samples out of wrong places these have another try: they may fit exactly now. Where splines are
    too stiff, what was measured may be so exact that image curves tell more of the way between their samples.
    """
    found = _by_samples(images, shown, x, steps)
    for again in (True, False):
        now = _by_splines(images, found, steps)
        if now is None:
            break
        mended = (now.measured & ~found.measured).sum((-2, -1))
        if not (again and bool((mended > _MENDED * now.measured.sum((-2, -1))).any())):
            return images, now
        found = _by_samples(images, shown, now.x, steps)
    finer = images.through_exact_samples()
    other = _by_samples(finer, shown, found.x, steps)
    if bool((other.end.cost < _FINER**2 * found.end.cost).all()):
        return finer, other
    return images, found


def _by_samples(images: CurvePlaces, shown: Tensor, x: Scene, steps: int) -> Found:
    plain, x = _mended(_inside(images, shown, x), x)
    _, measured = _judged(plain, plain.sights(x))
    end = descend(replace(plain, weight=plain.weight * measured[:, None]), x, Options(steps, _TOLERANCE))
    # Samples that did not count follow the cameras.
    x, seen = plain.settled(end.x, _OWN)
    misfit, right = _judged(plain, seen)
    return Found(x, seen, plain.weight, misfit, measured & right, end)


def _by_splines(images: CurvePlaces, found: Found, steps: int) -> Found | None:
    """What is found by all that was measured of the image curves, where splines follow that."""
    counts = found.weight * found.measured[:, None]
    free = 2 * found.measured.sum((-2, -1)) + 11 * (found.weight > 0).any(-1).any(-1).sum(-1) - 15
    total = (counts.flatten(2) * found.seen.r.square()).sum((1, 2))
    noise = (total / (counts.sum((1, 2, 3)) - free).clamp(min=1)).sqrt()
    other = refit(images, counts, found.x, noise, steps)
    if other is None:
        return None
    place = pinned(images, found.weight, other.x).sights(other.x).place
    x = other.x._replace(place=place)
    plain = pinned(images, found.weight, x)
    own, seen = plain.settled(x, _OWN)
    # Where noise draws a sample to the wrong side of a bend it stays on the spline.
    _, right = _judged(plain, seen)
    u = torch.where(right.flatten(1)[:, None], own.u, x.u)
    x = Scene(x.P, u, torch.where(right[:, None], own.place, x.place))
    seen = plain.sights(x)
    misfit, measured = _judged(plain, seen)
    here = replace(plain, weight=plain.weight * measured[:, None]).linearize(x)
    return Found(x, seen, plain.weight, misfit, measured, found.end._replace(end=here, status=other.status))


def typical_misfit(images: CurvePlaces, shown: Float[Tensor, "p v c m"], x: Scene) -> Float[Tensor, "p"]:
    """The median of samples' distances."""
    plain = _inside(images, shown, x)
    return _median(plain.misfit(plain.sights(x)).sqrt(), plain)[:, 0]


def agreement(images: CurvePlaces, shown: Float[Tensor, "p v c m"], x: Scene) -> Float[Tensor, "p"]:
    """Which part of the samples is right."""
    plain = _inside(images, shown, x)
    there = (shown.sum(1) > 0).sum((-2, -1)).clamp(min=1)
    return (_judged(plain, plain.sights(x))[1] & (shown.sum(1) > 0)).sum((-2, -1)) / there


def _judged(plain: CurveDistances, seen: Sights) -> tuple[Tensor, Tensor]:
    """Distances of samples, and which are as good as most and in order."""
    views = plain.weight.sum(1)
    e = plain.misfit(seen).sqrt()
    misfit = torch.where(views >= 3, e.reshape(views.shape) / views.clamp(min=1).sqrt(), torch.inf)
    typical = _median(e, plain)[..., None] / views.clamp(min=1).sqrt()
    right = (misfit <= (_KEPT * typical).clamp(min=_FINE)) & ~_out_of_order(plain, seen.place)
    return misfit, right


def _median(e: Float[Tensor, "p n"], plain: CurveDistances) -> Float[Tensor, "p 1"]:
    counts = (plain.weight > 0).sum(1).flatten(1) >= 3
    middle = torch.where(counts, e, torch.nan).nanmedian(-1, keepdim=True).values
    return middle.nan_to_num(1.0).clamp_min(1e-14)


def _inside(images: CurvePlaces, shown: Tensor, x: Scene) -> CurveDistances:
    """The distances that count now: beyond the end of an image curve none does."""
    place = pinned(images, shown, x).sights(x).place
    return pinned(images, shown * (images.beyond(place) == 0), x._replace(place=place))


def _out_of_order(plain: CurveDistances, place: Float[Tensor, "p v c m"]) -> Bool[Tensor, "p c m"]:
    """Samples that are not before the next one, or behind the one before, on an image curve."""
    number = plain.images.number[..., None]
    ahead = torch.cat((place[..., 1:], place[..., :1] + number), -1) - place
    ring = plain.images.closed[..., None] | (torch.arange(place.shape[-1], device=place.device) < place.shape[-1] - 1)
    wrong = ((ahead <= 0) & ring & (plain.weight > 0)).any(1)
    return wrong | wrong.roll(1, -1)


def _mended(plain: CurveDistances, x: Scene) -> tuple[CurveDistances, Scene]:
    """Wrong samples put between right ones, and let go from there; kept, and pinned there, where that is better."""
    x, seen = plain.settled(x, 0)
    misfit = plain.misfit(seen)
    e = misfit.sqrt().reshape(x.place[:, 0].shape)
    bad = (e > _WRONG * _median(misfit.sqrt(), plain)[..., None]) | _out_of_order(plain, seen.place)
    anew, possible = _between(plain, x, bad)
    if not bool(possible.any()):
        return pinned(plain.images, plain.weight, x), x
    other = pinned(plain.images, plain.weight, anew)
    anew, now = other.settled(anew, _OWN)
    taken = possible & (other.misfit(now) < misfit).reshape(e.shape)
    u = torch.where(taken.flatten(1)[:, None], anew.u, x.u)
    x = Scene(x.P, u, torch.where(taken[:, None], anew.place, x.place))
    return pinned(plain.images, plain.weight, x), x


def _between(plain: CurveDistances, x: Scene, bad: Bool[Tensor, "p c m"]) -> tuple[Scene, Bool[Tensor, "p c m"]]:
    """Bad samples between the good ones before and after, in space and on image curves, and which have both."""
    m = bad.shape[-1]
    slot = torch.arange(m, device=bad.device)
    around = plain.images.closed.any(1)[..., None]
    # Three times round, the middle one is looked at; an open curve has nothing before and after itself.
    ring = torch.cat((slot - m, slot, slot + m)).expand(*bad.shape[:-1], 3 * m)
    good = torch.cat((~bad & around, ~bad, ~bad & around), -1)
    before = torch.where(good, ring, -4 * m).cummax(-1).values[..., m : 2 * m]
    after = torch.where(good, ring, 4 * m).flip(-1).cummin(-1).values.flip(-1)[..., m : 2 * m]
    possible = bad & (before > -4 * m) & (after < 4 * m)
    before, after = torch.where(possible, before, slot), torch.where(possible, after, slot)
    share = torch.where(possible, (slot - before).to(x.u.dtype) / (after - before).clamp(min=1), 0)[:, None]

    def of(t: Tensor, index: Tensor) -> Tensor:
        return t.gather(-1, (index % m)[:, None].expand_as(t))

    turns = plain.images.number[..., None]
    ends = [of(x.place, i) + i.div(m, rounding_mode="floor")[:, None] * turns for i in (before, after)]
    place = torch.lerp(ends[0], ends[1], share)
    U = x.u.reshape(*x.u.shape[:2], *bad.shape[1:])
    a, b = of(U, before), of(U, after)
    b = b * torch.where((a * b).sum(1, keepdim=True) < 0, -1.0, 1.0)
    u = torch.nn.functional.normalize(torch.lerp(a, b, share), dim=1)
    here = possible[:, None]
    return Scene(x.P, torch.where(here, u, U).flatten(2), torch.where(here, place, x.place)), possible
