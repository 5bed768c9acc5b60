"""Cameras and samples of space curves at the least squares of normal distances from image curves, many problems at once.

A sample's image is compared with the nearest point of the image curve that is reached from the place where it was before: a
sample keeps to its stretch of the curve where another one passes nearer. The nearest point moves along the curve only, so that
the derivative of the distance is that of the image alone (variable projection). Where along its space curve a sample is changes
nothing: one image pins it, by the distance along the image curve from where it was. After each step of all together each sample
takes some of its own, with the cameras as they are.

Arrays are (problem, view, coordinate, sample), the samples of all curves one after another.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.geometry.curve_places import CurvePlaces
from torchsfm.geometry.homogeneous import divide_safely
from torchsfm.linalg import solve
from torchsfm.linalg.rows import combine_rows, inner
from torchsfm.motion.many_views.bilinear_fit import unit_frame
from torchsfm.motion.many_views.bilinear_steps import BilinearSystem, Linearisation
from torchsfm.optim.problem import Problem, Step
from torchsfm.optim.pytree import Places, pick

_OWN = 2
"""Steps of each sample after one of all."""
_BENDS = 1e-8
"""Distances that say nothing: where smooth curves go between samples, and rounding."""
_STILL = 1e-9
"""Damping of samples' own steps, relative to the trace of their normal matrix."""


class Scene(NamedTuple):
    """Cameras, samples, and where on the image curves these are."""

    P: Float[Tensor, "p v 3 r"]
    """With r = 4 coordinates in space; 3 in a plane."""
    u: Float[Tensor, "p r n"]
    place: Float[Tensor, "p v c m"]


class Sights(NamedTuple):
    """Images of samples, and how far they are from the image curves."""

    y: Float[Tensor, "p v 3 n"]
    r: Float[Tensor, "p v n"]
    """Signed, along the image curve's normal."""
    slope: Float[Tensor, "p v 3 n"]
    """The derivative of `r` by y."""
    along: Float[Tensor, "p v n"]
    """How far along the image curve from where it is pinned; 0 where it is not."""
    along_slope: Float[Tensor, "p v 3 n"]
    place: Float[Tensor, "p v c m"]


class Pins(NamedTuple):
    """Where samples are held along their curves."""

    at: Bool[Tensor, "p v c m"]
    """The one image that does it."""
    x: Float[Tensor, "p v c m 2"]
    tangent: Float[Tensor, "p v c m 2"]


class Near(NamedTuple):
    """The image curves next to images of samples."""

    points: Float[Tensor, "p v c m 2"]
    r: Float[Tensor, "p v n"]
    """Distances, signed, along the image curve's normal."""
    slope: Float[Tensor, "p v 3 n"]
    """The derivative of `r` by y."""
    place: Float[Tensor, "p v c m"]


def near_curves(images: CurvePlaces, place: Float[Tensor, "p v c m"], y: Float[Tensor, "p v 3 n"]) -> Near:
    """Distances of samples whose images are y from the nearest points of image curves that are reached from given places."""
    points = _points(y, place)
    place = images.nearest(place, points)
    foot, first, _ = images.rows(place)
    across, along = torch.nn.functional.normalize(first, dim=-2).unbind(-2)
    normal = torch.stack((-along, across), -2)
    r = combine_rows((points.mT - foot).unbind(-2), normal.unbind(-2))
    return Near(points, r.flatten(2), _by_image(normal.mT, points, y), place)


def _points(y: Tensor, place: Tensor) -> Float[Tensor, "p v c m 2"]:
    return divide_safely(y[:, :, :2].movedim(2, -1), y[:, :, 2]).reshape(*place.shape, 2)


def _by_image(way: Tensor, points: Tensor, y: Tensor) -> Float[Tensor, "p v 3 n"]:
    """The derivative by y of how far points are along unit vectors."""
    rows = torch.stack((*way.unbind(-1), -inner(way, points)), 2).flatten(3)
    return divide_safely(rows.mT, y[:, :, 2]).mT


@dataclass(frozen=True)
class CurveDistances(Problem[BilinearSystem]):
    """The weighted mean of squared normal distances over cameras and samples."""

    images: CurvePlaces
    """(p, v, c)."""
    weight: Float[Tensor, "p v c m"]
    pins: Pins

    def pick(self, at: Places) -> "CurveDistances":
        """Some of the problems."""
        return CurveDistances(pick(at, self.images), pick(at, self.weight), pick(at, self.pins))

    def linearize(self, x: Scene) -> BilinearSystem:
        """The system of cameras and samples."""
        return self._system(x, self.sights(x))

    def advance(self, here: BilinearSystem, step: Step) -> BilinearSystem:
        """The system where a step leads and samples have taken their own."""
        P, u = unit_frame(here.x.P + step.delta[0], here.x.u + step.delta[1])
        return self._system(*self.settled(Scene(P, u, here.x.place), _OWN))

    def rounding(self, here: BilinearSystem) -> Tensor:
        """What bends of the second derivative between the curves' samples make of it, in image coordinates about 1."""
        return torch.full_like(here.cost, _BENDS**2)

    def sights(self, x: Scene) -> Sights:
        """Where samples are seen, and how far from the image curves."""
        y = x.P @ x.u[:, None]
        near, pins = near_curves(self.images, x.place, y), self.pins
        along = inner(near.points - pins.x, pins.tangent) * pins.at
        along_slope = _by_image(pins.tangent, near.points, y) * pins.at.flatten(2)[:, :, None]
        return Sights(y, near.r, near.slope, along.flatten(2), along_slope, near.place)

    def misfit(self, seen: Sights) -> Float[Tensor, "p n"]:
        """The weighted sum of each sample's squared distances."""
        return (self.weight.flatten(2) * seen.r.square()).sum(1)

    def settled(self, x: Scene, steps: int) -> tuple[Scene, Sights]:
        """The scene after some steps of each sample by itself, where they make it better."""
        seen = self.sights(x)
        for _ in range(steps):
            moved = x._replace(u=self._own_step(x, seen), place=seen.place)
            now = self.sights(moved)
            better = self._costs(now) <= self._costs(seen)
            x = x._replace(u=torch.where(better[:, None], moved.u, x.u))
            masks = (better[:, None, None], better[:, None], better[:, None, None], better[:, None], better[:, None, None])
            fields = [torch.where(b, a, o) for a, o, b in zip(now[:5], seen[:5], masks, strict=True)]
            place = torch.where(better.reshape(better.shape[0], 1, *x.place.shape[2:]), now.place, seen.place)
            seen = Sights(fields[0], fields[1], fields[2], fields[3], fields[4], place)
        return x._replace(place=seen.place), seen

    def _costs(self, seen: Sights) -> Float[Tensor, "p n"]:
        return (self.weight.flatten(2) * (seen.r.square() + seen.along.square())).sum(1)

    def _own_step(self, x: Scene, seen: Sights) -> Float[Tensor, "p r n"]:
        """Samples after a Gauss-Newton step, cameras held."""
        w = self.weight.flatten(2).repeat(1, 2, 1)
        J = (x.P.mT.repeat(1, 2, 1, 1) @ torch.cat((seen.slope, seen.along_slope), 1)).permute(0, 3, 1, 2)
        r = torch.cat((seen.r, seen.along), 1)
        A = J.mT @ (J * w.mT[..., None])
        size = A.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
        eye = torch.eye(x.u.shape[1], dtype=A.dtype, device=A.device)
        u = x.u.mT[..., None]
        A = A + size * (u @ u.mT + _STILL * eye) + torch.where(size > 0, 0, eye)
        move, _ = solve(A, J.mT @ (w * r).mT[..., None])
        return torch.nn.functional.normalize(x.u - move[..., 0].mT, dim=1)

    def _system(self, x: Scene, seen: Sights) -> BilinearSystem:
        w = self.weight.flatten(2)
        size = torch.linalg.vector_norm(seen.slope, dim=2, keepdim=True)
        # The Hessian g g' + h h' in axes along y, g and across both, by its eigenvalues: a I - a y y' - (a - b) e e'.
        ray = torch.nn.functional.normalize(seen.y, dim=2)
        first = seen.slope / size.clamp_min(1e-300)
        second = torch.linalg.cross(ray, first, dim=2)
        g = size.square()
        c, s = ((seen.along_slope * axis).sum(2, keepdim=True) for axis in (first, second))
        difference = g + c.square() - s.square()
        root = torch.hypot(difference, 2 * c * s)
        angle = 0.5 * torch.atan2(2 * c * s, difference)
        largest = (g + c.square() + s.square() + root) / 2
        least = angle.cos() * second - angle.sin() * first
        q = torch.stack((largest.sqrt() * ray, root.sqrt() * least), 2) * w.sqrt()[:, :, None, None]
        slope = w[:, :, None] * (seen.r[:, :, None] * seen.slope + seen.along[:, :, None] * seen.along_slope)
        linear = Linearisation(x.P, x.u, slope, w * largest[:, :, 0], q)
        total = w.sum((-2, -1)).clamp_min(1e-100)
        cost = self._costs(seen).sum(-1) / total
        cost = torch.where(cost.isfinite(), cost, torch.inf)
        return BilinearSystem(x._replace(place=seen.place), cost, linear, total)


def pinned(images: CurvePlaces, weight: Float[Tensor, "p v c m"], x: Scene) -> CurveDistances:
    """Distances of samples that are pinned where they are, each by the image in which its curve is seen least foreshortened."""
    points = _points(x.P @ x.u[:, None], x.place)
    step = (points - points.roll(1, -2)).square().sum(-1)
    step = torch.where(weight > 0, (step + step.roll(-1, -1)).nan_to_num(0.0, 0.0), -1.0)
    at = torch.zeros_like(weight, dtype=torch.bool).scatter(1, step.argmax(1, keepdim=True), True)
    foot, first, _ = images.at(x.place)
    return CurveDistances(images, weight, Pins(at, foot, torch.nn.functional.normalize(first, dim=-1)))
