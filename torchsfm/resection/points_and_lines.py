"""Points and lines together: the data in a frame of their own, the equations of a pose, and how well poses satisfy them.

A point says that `R X + t` lies on its ray, a line through A along V that `l'R V = 0` and `l'(R A + t) = 0` with the normal l
of its plane of sight: two equations each, six for three of them.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import broadcast_shapes
from torchsfm.geometry.homogeneous import moderate_directions
from torchsfm.linalg import cross, usable
from torchsfm.linalg.rows import add_rows, take_columns
from torchsfm.linalg.vectors import across
from torchsfm.optim import rotation_exponential
from torchsfm.resection.vector_rows import cross_rows, dot_rows, length_rows, norm_rows, turned, unit_rows

ROUNDING = 1e-14
"""What is left of the equations at best."""
_LEFT = 1e-6
"""What may be left of an equation over the size of what it is about."""
_FLAT = 1e-10
"""Sine of an angle, or length over the unit, below which it is 0."""
_RIDGE = 1e-6
"""How much the middle of all lines counts where they leave the point nearest to them open."""


class Sample(NamedTuple):
    """Points and lines of each problem, in double precision, about the origin and of size 1; problems in the last dimension."""

    d: Float[Tensor, "3 p n"]
    """Unit rays."""
    X: Float[Tensor, "3 q n"]
    """The points but for the first, which is the origin."""
    l: Float[Tensor, "3 k n"]  # noqa: E741
    """Unit normals of the planes of sight."""
    V: Float[Tensor, "3 k n"]
    """Unit directions."""
    A: Float[Tensor, "3 k n"]
    """The point of each line that is nearest to the origin."""
    origin: Float[Tensor, "3 n"]
    unit: Float[Tensor, " n"]
    rounding: Float[Tensor, " n"]
    """Of places in the world, in units."""
    sound: Bool[Tensor, " n"]
    """Finite, with directions."""

    def of(self, item: Int[Tensor, " m"]) -> "Sample":
        """What the problems of a list show."""
        return self._replace(**{name: take_columns(v, item) for name, v in self._asdict().items() if v.ndim == 3})

    def times(self, slots: int) -> "Sample":
        """Every problem so many times, first each once."""
        return self._replace(**{name: v.repeat(1, 1, slots) for name, v in self._asdict().items() if v.ndim == 3})


class Fit(NamedTuple):
    """How well poses satisfy the equations: first those of points, then those of lines."""

    left: Float[Tensor, "e m"]
    """What is left of each, as absolute numbers: of points, then of the directions and of the places of lines."""
    reach: Float[Tensor, "r m"]
    """What it is about: the depths of points, the distances of lines."""


def equations(
    model: Float[Tensor, "*#batch 3 4"],
    d: Float[Tensor, "*#batch p 3"],
    X: Float[Tensor, "*#batch p 3"],
    l: Float[Tensor, "*#batch k 3"],  # noqa: E741
    L: Float[Tensor, "*#batch k 6"],
) -> Float[Tensor, "*batch _"]:
    """What `[R | t]` satisfies: `R'R = I`, `d x (R X + t) = 0` with unit d, and both conditions of each line, unit l and V.

    Six and three a point and two a line: of rank 12 for three points and lines together. Lengths are over the size that the
    structure has in the camera's frame.
    """
    R, t = model[..., :3], model[..., 3]
    gram = R.mT @ R - torch.eye(3, dtype=R.dtype, device=R.device)
    i, j = torch.triu_indices(3, 3, device=R.device)
    parts = [gram[..., i, j]]
    if X.shape[-2]:
        Y = X @ R.mT + t[..., None, :]
        parts.append((cross(_unit(d), Y) / _length(Y.detach())).flatten(-2))
    if L.shape[-2]:
        size = _length(L[..., :3])
        V, foot = L[..., :3] / size, cross(L[..., :3], L[..., 3:]) / size.square()
        Y = foot @ R.mT + t[..., None, :]
        normal = _unit(l)
        parts += [(normal * (V @ R.mT)).sum(-1), (normal * Y).sum(-1) / _length(Y.detach())[..., 0]]
    shape = broadcast_shapes(*(p.shape[:-1] for p in parts))
    return torch.cat([p.expand(*shape, p.shape[-1]) for p in parts], -1)


def prepare(data: list[Tensor], eps: float) -> Sample:
    """Lay the problems out; what is not sound gets harmless numbers."""
    largest = torch.stack([t.flatten(0, 1).abs().amax(0) for t in data if t.numel()]).amax(0)
    sound = usable(largest)
    d, X, l, L = data if sound.all() else (torch.where(sound, t, 1.0) for t in data)  # noqa: E741
    for t in (d, l):
        sound = sound & (t.abs().amax(0) > 0).all(0)
    d, l = unit_rows(d), unit_rows(l)  # noqa: E741
    size = length_rows(L[:3])
    # Squares of what is smaller vanish.
    sound = sound & (size > 1e-150).all(0)
    V, m = L[:3] / size, L[3:] / size
    A = cross_rows(V, m)
    origin = X[:, 0] if X.shape[1] else _nearest_to_all(V, A)
    far = torch.cat((X, A), 1).flatten(0, 1).abs().amax(0)
    X, A = X[:, 1:] - origin[:, None], A - origin[:, None]
    A = A - dot_rows(A, V) * V
    unit = add_rows(torch.cat((X, A), 1).flatten(0, 1).square()).sqrt()
    unit = torch.where(unit > 0, unit, 1.0)
    # A moment that is not across the direction is none, but for rounding.
    off = dot_rows(V, m).abs()
    sound = sound & (off <= eps**0.5 * (unit + length_rows(origin))).all(0)
    return Sample(d, X / unit, l, V, A / unit, origin, unit, ROUNDING * far / unit, sound)


def _nearest_to_all(V: Tensor, A: Tensor) -> Tensor:
    """The point nearest to all lines, as far as they tell: (M + ridge) x = sum of (I - VV') (A - middle), from the middle."""
    lines = V.shape[1]
    middle = add_rows(A.unbind(1)) / lines
    away = A - middle[:, None]
    x, y, z = add_rows((away - dot_rows(away, V) * V).unbind(1)).unbind(0)
    (xx, xy, xz), (yy, yz, zz) = (
        [add_rows((V[i] * V[j]).unbind(0)) for i, j in pairs] for pairs in (((0, 0), (0, 1), (0, 2)), ((1, 1), (1, 2), (2, 2)))
    )
    a, b, c = (lines + _RIDGE - v for v in (xx, yy, zz))
    # By the adjugate: the ridge bounds its condition.
    m11, m12, m13 = b * c - yz * yz, xz * yz + xy * c, xy * yz + xz * b
    m22, m23, m33 = a * c - xz * xz, a * yz + xy * xz, a * b - xy * xy
    det = a * m11 - xy * m12 - xz * m13
    return middle + torch.stack((m11 * x + m12 * y + m13 * z, m12 * x + m22 * y + m23 * z, m13 * x + m23 * y + m33 * z)) / det


def fit_of(s: Sample, R: Tensor, t: Tensor, normals: Tensor | None = None) -> Fit:
    """What is left of the equations, in the frame of the camera for points and that of the world for lines."""
    left: list[Tensor] = []
    reach: list[Tensor] = []
    if s.d.shape[1]:
        Y = t[:, None]
        if s.X.shape[1]:
            Y = torch.cat((Y, turned(R, s.X) + Y), 1)
        left.append(cross_rows(s.d, Y).flatten(0, 1))
        reach.append(dot_rows(s.d, Y))
    if s.V.shape[1]:
        back = R.transpose(0, 1)
        normals = turned(back, s.l) if normals is None else normals
        A = turned(back, t[:, None]) + s.A
        left += [dot_rows(normals, s.V), dot_rows(normals, A)]
        # From the camera to the whole of the line: a point far along it would say little of how it passes.
        reach.append(norm_rows(A.addcmul_(dot_rows(A, s.V), s.V, value=-1)))
    return Fit(torch.cat(left).abs_(), torch.cat(reach))


def sure(s: Sample, R: Tensor, fit: Fit, far: Tensor, rounding: Tensor) -> Tensor:
    """Which poses are rotations that satisfy the equations of each point and line, also in the world, with points in front.

    What is small against far points need not be so against a near line.
    """
    points, lines = s.d.shape[1], s.V.shape[1]
    gram = torch.empty_like(R.flatten(0, 1)[:6])
    gram[:3], gram[3:5], gram[5] = dot_rows(R, R).sub_(1), dot_rows(R[:, :2], R[:, 1:]), dot_rows(R[:, 0], R[:, 2])
    good = gram.abs_().amax(0) <= _LEFT
    bound = (_LEFT * fit.reach).sub_(rounding)
    if points:
        good &= (fit.left[: 3 * points].view(3, points, -1) <= bound[:points]).flatten(0, 1).all(0)
        good &= (fit.reach[:points] > rounding + _FLAT * far).all(0)
    if lines:
        left = fit.left[3 * points :].view(2, lines, -1)
        good &= (left[1] <= bound[points:]).all(0) & (left[0] <= _LEFT).all(0)
    return good


def newton_step(s: Sample, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Poses after a step of Newton's method."""
    J, r = _linearized(s, R, t)
    step = torch.linalg.solve_ex(J, r)[0][..., 0]
    step = torch.where(step.isfinite().all(-1, keepdim=True), step, 0.0)
    return (rotation_exponential(step[:, :3]) @ R.permute(2, 0, 1)).permute(1, 2, 0), t + step[:, 3:].mT


def _linearized(s: Sample, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives (m, 6, 6) of the equations along a turn from the left and a shift, and the equations' negatives (m, 6, 1)."""
    X, V, A = (turned(R, v) for v in (s.X, s.V, s.A))
    rows, slopes = [], []
    if s.d.shape[1]:
        X = torch.cat((torch.zeros_like(s.d[:, :1]), X), 1)
        sides = across(s.d)
        rows += [dot_rows(e, X + t[:, None]) for e in sides]
        slopes += [torch.cat((cross_rows(X, e), e)) for e in sides]
    if s.V.shape[1]:
        rows += [dot_rows(s.l, V), dot_rows(s.l, A + t[:, None])]
        slopes.append(torch.cat((cross_rows(V, s.l), torch.zeros_like(V))))
        slopes.append(torch.cat((cross_rows(A, s.l), s.l)))
    return torch.cat(slopes, 1).permute(2, 1, 0), -torch.cat(rows).mT[..., None]


def _length(v: Tensor) -> Tensor:
    length: Tensor = torch.linalg.vector_norm(v, dim=-1, keepdim=True).clamp_min(1e-300)
    return length


def _unit(v: Tensor) -> Tensor:
    v = moderate_directions(v)
    return v / _length(v)
