"""Poses from points and lines together: the data in a frame of their own, the equations, and Newton's method on them.

A point says that `R X + t` lies on its ray, a line through A along V that `l'R V = 0` and `l'(R A + t) = 0` with the normal l
of its plane of sight: two equations each, six for three of them.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Solutions, broadcast_shapes
from torchsfm.geometry.homogeneous import moderate_directions
from torchsfm.linalg import cross, usable
from torchsfm.optim import attach_implicit, for_slots, rotation_exponential, wants_derivative

_STEPS = 3
_MET = 1e-9
"""What may be left of an equation between unit vectors."""
_LEFT = 1e-6
"""What may be left of an equation over the size of what it is about."""
_ROUNDING = 1e-14
"""What is left of them at best."""
_TWICE = 1e-8
"""Distance of poses that are one."""
_FLAT = 1e-10
"""Sine of an angle, or length over the unit, below which it is 0."""
_CHUNK = 16384
"""Problems at a time."""


class Sample(NamedTuple):
    """Three points and lines of each problem, in double precision, points and lines about the origin and of size 1."""

    d: Float[Tensor, "n p 3"]
    """Unit rays."""
    X: Float[Tensor, "n p 3"]
    l: Float[Tensor, "n k 3"]  # noqa: E741
    """Unit normals of the planes of sight."""
    V: Float[Tensor, "n k 3"]
    """Unit directions."""
    A: Float[Tensor, "n k 3"]
    """The point of each line that is nearest to the origin."""
    origin: Float[Tensor, "n 3"]
    unit: Float[Tensor, " n"]
    sound: Bool[Tensor, " n"]
    """Finite, with directions."""


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


def solve_poses(
    candidates: Callable[[Sample], tuple[Tensor, Tensor]],
    slots: int,
    batch: torch.Size,
    d: Tensor,
    X: Tensor,
    l: Tensor,  # noqa: E741
    L: Tensor,
) -> Solutions[Tensor]:
    """The poses that a solver's candidates lead to: (n, slots, 3, 4) in the frame of the sample, and which of them are real."""
    dtype, data = L.dtype, [t.expand(*batch, *t.shape[-2:]) for t in (d, X, l, L)]
    with torch.no_grad():
        flat = [t.detach().double().reshape(batch.numel(), *t.shape[-2:]) for t in data]
        pieces = []
        for start in range(0, max(batch.numel(), 1), _CHUNK):
            sample = _prepare([t[start : start + _CHUNK] for t in flat], torch.finfo(dtype).eps)
            pieces.append(_finish(sample, *candidates(sample)))
        model, valid = (torch.cat(parts) for parts in zip(*pieces, strict=True))
        # What is small against far points need not be so against a near line.
        item, slot = valid.nonzero().unbind(-1)
        left = equations(model[item, slot], *(t[item] for t in flat)).abs().amax(-1)
        valid = valid.index_put((item, slot), left <= _LEFT)
        model = model.to(dtype)
        valid = valid & model.isfinite().flatten(-2).all(-1)
        model = torch.where(valid[..., None, None], model, torch.eye(3, 4, dtype=dtype, device=L.device))
        model, valid = model.reshape(*batch, slots, 3, 4), valid.reshape(*batch, slots)
    if wants_derivative(*data):
        model = attach_implicit(equations, model, *(for_slots(t, batch) for t in data), dims=2, valid=valid)
    return Solutions(model, valid)


def _prepare(data: list[Tensor], eps: float) -> Sample:
    """Lay the problems out; what is not sound gets harmless numbers."""
    sound = torch.stack([usable(t).flatten(-2).all(-1) for t in data]).all(0)
    d, X, l, L = (torch.where(sound[:, None, None], t, 1.0) for t in data)  # noqa: E741
    for t in (d, l, L[..., :3]):
        sound = sound & (t != 0).any(-1).all(-1)
    d, l = _unit(d), _unit(l)  # noqa: E741
    size = _length(L[..., :3])
    # Squares of what is smaller vanish.
    sound = sound & (size > 1e-150).flatten(1).all(-1)
    V, m = L[..., :3] / size, L[..., 3:] / size
    A = cross(V, m)
    if X.shape[-2]:
        origin = X[:, 0]
    else:
        # The point nearest to all lines, as far as they tell.
        across = torch.eye(3, dtype=V.dtype, device=V.device) - V[..., :, None] * V[..., None, :]
        middle = A.mean(1)
        away = (across @ (A - middle[:, None])[..., None]).sum(1)
        ridge = 1e-6 * torch.eye(3, dtype=V.dtype, device=V.device)
        origin = middle + torch.linalg.solve_ex(across.sum(1) + ridge, away)[0][..., 0]
    X = X - origin[:, None]
    A = A - origin[:, None]
    A = A - (A * V).sum(-1, keepdim=True) * V
    unit = torch.cat((X, A), 1).square().sum((-1, -2)).sqrt()
    unit = torch.where(unit > 0, unit, 1.0)
    # A moment that is not across the direction is none, but for rounding.
    off = (V * m).sum(-1).abs().amax(-1)
    sound = sound & (off <= eps**0.5 * (unit + torch.linalg.vector_norm(origin, dim=-1)))
    return Sample(d, X / unit[:, None, None], l, V, A / unit[:, None, None], origin, unit, sound)


def _finish(s: Sample, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Poses (n, slots, 3, 4) of the world from candidates R and t (not finite where there is none), and which are valid."""
    there = R.isfinite().flatten(-2).all(-1) & t.isfinite().all(-1) & s.sound[:, None]
    item, slot = there.nonzero().unbind(-1)
    one = Sample(*(v[item] for v in s))
    turn, shift, met = _polished(one, R[item, slot], t[item, slot])
    far = _length(shift)[:, 0].clamp_min(1.0)
    good = met <= _MET * far
    if s.X.shape[1]:
        Y = one.X @ turn.mT + shift[:, None]
        good = good & ((Y * one.d).sum(-1) > _FLAT * far[:, None]).all(-1)
    pose = torch.cat((turn, shift[..., None]), -1)
    model = torch.zeros(*there.shape, 3, 4, dtype=pose.dtype, device=pose.device)
    model[item, slot] = pose
    valid = there.index_put((item, slot), good)
    # Of two that are one the first; a slot that is not valid is none.
    gap = torch.cdist(model.flatten(2), model.flatten(2), p=torch.inf)
    for k in range(1, there.shape[1]):
        valid[:, k] &= ~((gap[:, k, :k] < _TWICE) & valid[:, :k]).any(-1)
    R, t = model[..., :3], model[..., 3]
    t = s.unit[:, None, None] * t - (R @ s.origin[:, None, :, None])[..., 0]
    return torch.cat((R, t[..., None]), -1), valid


def _polished(s: Sample, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Newton's method where rounding has left something: poses, and the largest equation of each."""
    left = _rows(s, R, t)[0].abs().amax(-1)
    for _ in range(_STEPS):
        rough = (left > _ROUNDING).nonzero()[:, 0]
        if not len(rough):
            break
        part = Sample(*(v[rough] for v in s))
        step = torch.linalg.solve_ex(*_linearized(part, R[rough], t[rough]))[0][..., 0]
        step = torch.where(step.isfinite().all(-1, keepdim=True), step, 0.0)
        new_R, new_t = rotation_exponential(step[:, :3]) @ R[rough], t[rough] + step[:, 3:]
        new_left = _rows(part, new_R, new_t)[0].abs().amax(-1)
        better = new_left < left[rough]
        rough = rough[better]
        R, t, left = (
            old.index_copy(0, rough, new[better]) for old, new in zip((R, t, left), (new_R, new_t, new_left), strict=True)
        )
    return R, t, left


def _rows(s: Sample, R: Tensor, t: Tensor) -> tuple[Tensor, tuple[Tensor, ...], tuple[Tensor, Tensor]]:
    """The six equations (n, 6), and what their derivatives are made of: X, two vectors across d; V, A; all turned."""
    X, V, A = (v @ R.mT for v in (s.X, s.V, s.A))
    rows, across, t = [], _across(s.d), t[:, None]
    if s.X.shape[1]:
        Y = X + t
        rows += [(e * Y).sum(-1) for e in across]
    if s.V.shape[1]:
        rows += [(s.l * V).sum(-1), (s.l * (A + t)).sum(-1)]
    return torch.cat(rows, -1), (X, *across), (V, A)


def _linearized(s: Sample, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives (n, 6, 6) of the equations along a turn from the left and a shift, and the equations' negatives (n, 6, 1)."""
    r, (X, *across), (V, A) = _rows(s, R, t)
    slopes = [torch.cat((cross(X, e), e), -1) for e in across] if s.X.shape[1] else []
    if s.V.shape[1]:
        slopes.append(torch.cat((cross(V, s.l), torch.zeros_like(V)), -1))
        slopes.append(torch.cat((cross(A, s.l), s.l), -1))
    return torch.cat(slopes, -2), -r[..., None]


def frame(a: Tensor, b: Tensor) -> Tensor:
    """Orthonormal columns: along a, across it in the plane of a and b, and their normal; not finite where there is none."""
    first = a / torch.linalg.vector_norm(a, dim=-1, keepdim=True)
    normal = cross(first, b)
    third = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    return torch.stack((first, cross(third, first), third), -1)


def _across(u: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors orthogonal to unit vectors and to each other."""
    axis = torch.nn.functional.one_hot(u.abs().argmin(-1), 3).to(u.dtype)
    first = _unit(cross(u, axis))
    return first, cross(u, first)


def _length(v: Tensor) -> Tensor:
    length: Tensor = torch.linalg.vector_norm(v, dim=-1, keepdim=True).clamp_min(1e-300)
    return length


def _unit(v: Tensor) -> Tensor:
    v = moderate_directions(v)
    return v / _length(v)
