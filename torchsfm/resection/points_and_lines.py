"""Poses from points and lines together: the data in a frame of their own, the equations, and Newton's method on them.

A point says that `R X + t` lies on its ray, a line through A along V that `l'R V = 0` and `l'(R A + t) = 0` with the normal l
of its plane of sight: two equations each, six for three of them.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions, broadcast_shapes
from torchsfm.geometry.homogeneous import moderate_directions
from torchsfm.linalg import cross, usable
from torchsfm.linalg.rows import add_rows, combine_rows, take_columns
from torchsfm.optim import attach_implicit, for_slots, rotation_exponential, wants_derivative
from torchsfm.resection.vector_rows import cross_rows, dot_rows, length_rows, norm_rows, turned, unit_rows

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
_RIDGE = 1e-6
"""How much the middle of all lines counts where they leave the point nearest to them open."""
_CHUNK = 16384
"""Problems at a time."""


class Sample(NamedTuple):
    """Points and lines of each problem, in double precision, about the origin and of size 1; problems in the last dimension."""

    d: Float[Tensor, "3 p n"]
    """Unit rays."""
    X: Float[Tensor, "3 p n"]
    l: Float[Tensor, "3 k n"]  # noqa: E741
    """Unit normals of the planes of sight."""
    V: Float[Tensor, "3 k n"]
    """Unit directions."""
    A: Float[Tensor, "3 k n"]
    """The point of each line that is nearest to the origin."""
    origin: Float[Tensor, "3 n"]
    unit: Float[Tensor, " n"]
    sound: Bool[Tensor, " n"]
    """Finite, with directions."""


class Candidates(NamedTuple):
    """Poses that may be solutions, one after the other, those of a problem together."""

    item: Int[Tensor, " m"]
    slot: Int[Tensor, " m"]
    R: Float[Tensor, "3 3 m"]
    t: Float[Tensor, "3 m"]

    @classmethod
    def of_slots(cls, R: Float[Tensor, "n slots 3 3"], t: Float[Tensor, "n slots 3"]) -> "Candidates":
        """Those that are finite."""
        item, slot = (R.isfinite().flatten(-2).all(-1) & t.isfinite().all(-1)).nonzero().unbind(-1)
        return cls(item, slot, R[item, slot].permute(1, 2, 0).contiguous(), t[item, slot].mT.contiguous())


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
    candidates: Callable[[Sample], Candidates],
    slots: int,
    batch: torch.Size,
    d: Tensor,
    X: Tensor,
    l: Tensor,  # noqa: E741
    L: Tensor,
) -> Solutions[Tensor]:
    """The poses that a solver's candidates lead to: (*batch, slots, 3, 4), and which of them are real."""
    dtype, number, data = L.dtype, batch.numel(), [t.expand(*batch, *t.shape[-2:]) for t in (d, X, l, L)]
    with torch.no_grad():
        flat = [t.detach().double().reshape(number, *t.shape[-2:]) for t in data]
        model = torch.eye(3, 4, dtype=dtype, device=L.device).flatten().repeat(number * slots, 1)
        valid = torch.zeros(number * slots, dtype=torch.bool, device=L.device)
        for start in range(0, number, _CHUNK):
            rows = [t[start : start + _CHUNK].permute(2, 1, 0).contiguous() for t in flat]
            sample = _prepare(rows, torch.finfo(dtype).eps)
            found = candidates(sample)
            item, slot, pose = _finish(sample, found, slots)
            pose, kept = _in_world(sample, rows, item, pose)
            pose = pose.to(dtype)
            kept &= pose.isfinite().all(0)
            (keep,) = kept.nonzero(as_tuple=True)
            place = ((start + item) * slots + slot)[keep]
            model.index_copy_(0, place, pose.mT[keep])
            valid[place] = True
        model, valid = model.reshape(*batch, slots, 3, 4), valid.reshape(*batch, slots)
    if wants_derivative(*data):
        model = attach_implicit(equations, model, *(for_slots(t, batch) for t in data), dims=2, valid=valid)
    return Solutions(model, valid)


def _prepare(data: list[Tensor], eps: float) -> Sample:
    """Lay the problems out; what is not sound gets harmless numbers."""
    sound = torch.cat([usable(t).flatten(0, 1) for t in data]).all(0)
    d, X, l, L = (torch.where(sound, t, 1.0) for t in data)  # noqa: E741
    for t in (d, l, L[:3]):
        sound = sound & (t != 0).any(0).all(0)
    d, l = unit_rows(d), unit_rows(l)  # noqa: E741
    size = length_rows(L[:3])
    # Squares of what is smaller vanish.
    sound = sound & (size > 1e-150).all(0)
    V, m = L[:3] / size, L[3:] / size
    A = cross_rows(V, m)
    origin = X[:, 0] if X.shape[1] else _nearest_to_all(V, A)
    X = X - origin[:, None]
    A = A - origin[:, None]
    A = A - dot_rows(A, V) * V
    unit = add_rows(torch.cat((X, A), 1).flatten(0, 1).square()).sqrt()
    unit = torch.where(unit > 0, unit, 1.0)
    # A moment that is not across the direction is none, but for rounding.
    off = dot_rows(V, m).abs()
    sound = sound & (off <= eps**0.5 * (unit + length_rows(origin))).all(0)
    return Sample(d, X / unit, l, V, A / unit, origin, unit, sound)


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


def _finish(s: Sample, found: Candidates, slots: int) -> tuple[Tensor, Tensor, Tensor]:
    """Of the candidates those that are solutions in the frame of the sample: item, slot and pose (12, m), row by row."""
    finite = torch.cat((found.R.flatten(0, 1), found.t)).isfinite().all(0)
    (keep,) = (finite & s.sound[found.item] & (found.slot < slots)).nonzero(as_tuple=True)
    item, slot = found.item[keep], found.slot[keep]
    one = _taken(s, item)
    R, t, met = _polished(one, take_columns(found.R, keep), take_columns(found.t, keep))
    far = length_rows(t).clamp_min(1.0)
    good = met <= _MET * far
    if s.X.shape[1]:
        good &= (dot_rows(turned(R, one.X) + t[:, None], one.d) > _FLAT * far).all(0)
    (keep,) = good.nonzero(as_tuple=True)
    item, slot = item[keep], slot[keep]
    pose = take_columns(torch.cat((R, t[:, None]), 1).flatten(0, 1), keep)
    keep = _first_of_equals(item, slot, pose, slots)
    return item[keep], slot[keep], take_columns(pose, keep)


def _taken(s: Sample, item: Tensor) -> Sample:
    """The problems of a list."""
    d, X, l, V, A, origin = (take_columns(v, item) for v in s[:6])  # noqa: E741
    return Sample(d, X, l, V, A, origin, s.unit[item], s.sound[item])


def _first_of_equals(item: Tensor, slot: Tensor, pose: Tensor, slots: int) -> Tensor:
    """Of poses of a problem that are one the first: numbers in the list."""
    # Equal poses have equal sums; few others do.
    total = combine_rows(pose.unbind(0), [pose.new_tensor(1 / (i + 1.5)) for i in range(len(pose))])
    pairs = [torch.zeros(2, 0, dtype=torch.long, device=item.device)]
    for apart in range(1, min(slots, len(item))):
        near = (item[apart:] == item[:-apart]) & ((total[apart:] - total[:-apart]).abs() < 4 * _TWICE)
        (first,) = near.nonzero(as_tuple=True)
        pairs.append(torch.stack((first, first + apart)))
    first, second = torch.cat(pairs, 1)
    same = (pose[:, first] - pose[:, second]).abs().amax(0) < _TWICE
    first, second = first[same], second[same]
    good = torch.ones_like(item, dtype=torch.bool)
    for k in range(1, slots if len(first) else 1):
        own = (slot[second] == k) & good[first]
        good[second[own]] = False
    return good.nonzero()[:, 0]


def _in_world(s: Sample, data: list[Tensor], item: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Poses (12, m) of the world, and which of them satisfy the equations there.

    What is small against far points need not be so against a near line.
    """
    pose = pose.view(3, 4, -1)
    R, t = pose[:, :3], pose[:, 3]
    t = s.unit[item] * t - turned(R, take_columns(s.origin, item)[:, None])[:, 0]
    gram = [dot_rows(R[:, i], R[:, j]) - float(i == j) for i in range(3) for j in range(i + 1)]
    left = torch.stack(gram).abs().amax(0)
    _, X, _, L = (take_columns(v, item) for v in data)
    if X.shape[1]:
        Y = turned(R, X) + t[:, None]
        ray = take_columns(s.d, item)
        left = left.maximum((length_rows(cross_rows(ray, Y)) / length_rows(Y)).amax(0))
    if L.shape[1]:
        V, normal = take_columns(s.V, item), take_columns(s.l, item)
        foot = cross_rows(V, L[3:] / length_rows(L[:3]))
        Y = turned(R, foot) + t[:, None]
        left = left.maximum((dot_rows(normal, Y).abs() / length_rows(Y)).amax(0))
        left = left.maximum(dot_rows(normal, turned(R, V)).abs().amax(0))
    return torch.cat((R, t[:, None]), 1).flatten(0, 1), left <= _LEFT


def _polished(s: Sample, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Newton's method where rounding has left something: poses, and the largest equation of each."""
    left = _rows(s, R, t)[0].abs().amax(0)
    for _ in range(_STEPS):
        (rough,) = (left > _ROUNDING).nonzero(as_tuple=True)
        if not len(rough):
            break
        part, old_R, old_t = _taken(s, rough), take_columns(R, rough), take_columns(t, rough)
        J, r = _linearized(part, old_R, old_t)
        step = torch.linalg.solve_ex(J, r)[0][..., 0]
        step = torch.where(step.isfinite().all(-1, keepdim=True), step, 0.0)
        new_R = (rotation_exponential(step[:, :3]) @ old_R.permute(2, 0, 1)).permute(1, 2, 0)
        new_t = old_t + step[:, 3:].mT
        new_left = _rows(part, new_R, new_t)[0].abs().amax(0)
        better = new_left < left[rough]
        rough = rough[better]
        R[..., rough], t[..., rough], left[rough] = new_R[..., better], new_t[..., better], new_left[better]
    return R, t, left


def _rows(s: Sample, R: Tensor, t: Tensor) -> tuple[Tensor, tuple[Tensor, ...], tuple[Tensor, Tensor]]:
    """The six equations (6, m), and what their derivatives are made of: X, two vectors across d; V, A; all turned."""
    X, V, A = (turned(R, v) for v in (s.X, s.V, s.A))
    rows: list[Tensor] = []
    across: tuple[Tensor, ...] = ()
    if s.X.shape[1]:
        across = _across(s.d)
        rows += [dot_rows(e, X + t[:, None]) for e in across]
    if s.V.shape[1]:
        rows += [dot_rows(s.l, V), dot_rows(s.l, A + t[:, None])]
    return torch.cat(rows), (X, *across), (V, A)


def _linearized(s: Sample, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives (m, 6, 6) of the equations along a turn from the left and a shift, and the equations' negatives (m, 6, 1)."""
    r, (X, *across), (V, A) = _rows(s, R, t)
    slopes = [torch.cat((cross_rows(X, e), e)) for e in across]
    if s.V.shape[1]:
        slopes.append(torch.cat((cross_rows(V, s.l), torch.zeros_like(V))))
        slopes.append(torch.cat((cross_rows(A, s.l), s.l)))
    return torch.cat(slopes, 1).permute(2, 1, 0), -r.mT[..., None]


def frame(a: Tensor, b: Tensor) -> Tensor:
    """Orthonormal columns: along a, across it in the plane of a and b, and their normal; not finite where there is none."""
    first = a / torch.linalg.vector_norm(a, dim=-1, keepdim=True)
    normal = cross(first, b)
    third = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    return torch.stack((first, cross(third, first), third), -1)


def _across(u: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors orthogonal to unit vectors and to each other, coordinates first."""
    axis = torch.zeros_like(u).scatter_(0, u.abs().argmin(0, keepdim=True), 1.0)
    first = cross_rows(u, axis)
    first = first / norm_rows(first)
    return first, cross_rows(u, first)


def _length(v: Tensor) -> Tensor:
    length: Tensor = torch.linalg.vector_norm(v, dim=-1, keepdim=True).clamp_min(1e-300)
    return length


def _unit(v: Tensor) -> Tensor:
    v = moderate_directions(v)
    return v / _length(v)
