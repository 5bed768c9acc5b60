"""Three-vectors of rows: small formulas for thousands of problems, in as few passes over memory as possible."""

from collections.abc import Callable

import torch
from torch import Tensor

Rows = tuple[Tensor, ...]
Vector = Tensor | Rows
"""Three numbers per problem, as a tensor (3, ..., problem) or as three tensors (..., problem).

Eager mode wants few operations on stacked numbers, a compiler wants every number by itself; the formulas are the same for both.
"""


def vectors(block: Tensor) -> list[Vector]:
    """Three vectors out of (9, problem)."""
    if torch.compiler.is_compiling():
        rows = block.unbind(0)
        return [rows[:3], rows[3:6], rows[6:]]
    return list(block.reshape(3, 3, block.shape[-1]).unbind(0))


def vector(*rows: Tensor) -> Vector:
    """A vector of three rows."""
    return rows if torch.compiler.is_compiling() else torch.stack(rows)


def each(function: Callable[..., Tensor], *vectors: Vector) -> Vector:
    """A function of numbers, applied to each of the three of vectors."""
    if isinstance(vectors[0], Tensor):
        return function(*vectors)
    return tuple(function(*numbers) for numbers in zip(*vectors, strict=True))


def together(vectors: list[Vector]) -> list[Vector]:
    """Vectors to which the same is done, stacked into one (3, k, problem) if that helps."""
    stacked = [v for v in vectors if isinstance(v, Tensor)]
    return [torch.cat([v if v.ndim > 2 else v[:, None] for v in stacked], 1)] if stacked else vectors


def detached(v: Vector) -> Vector:
    """Without its graph."""
    return each(lambda x: x.detach(), v)


def fma(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """`a b + c`."""
    return torch.addcmul(c, a, b)


def fms(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """`c - a b`."""
    return torch.addcmul(c, a, b, value=-1)


def minus(a: Vector, b: Vector) -> Vector:
    """`a - b`."""
    return each(lambda x, y: x - y, a, b)


def scaled(a: Vector, k: Tensor) -> Vector:
    """`k a`."""
    return each(lambda x: x * k, a)


def combined(k: Tensor, a: Vector, m: Tensor, b: Vector) -> Vector:
    """`k a + m b`."""
    return each(lambda x, y: fma(k, x, m * y), a, b)


def chosen(mask: Tensor, a: Vector, b: Vector) -> Vector:
    """`a` where the mask says so, else `b`."""
    return each(lambda x, y: torch.where(mask, x, y), a, b)


def dot(a: Vector, b: Vector) -> Tensor:
    """`a'b`."""
    if isinstance(a, Tensor) and isinstance(b, Tensor):
        return (a * b).sum(0)
    return fma(a[0], b[0], fma(a[1], b[1], a[2] * b[2]))


def cross(a: Vector, b: Vector) -> Vector:
    """`a x b`."""
    a0, a1, a2 = a
    b0, b1, b2 = b
    return vector(fms(a2, b1, a1 * b2), fms(a0, b2, a2 * b0), fms(a1, b0, a0 * b1))


def ahead(v: Vector) -> tuple[Vector, Vector]:
    """`(v1, v2, v0)` and `(v2, v0, v1)`."""
    if isinstance(v, Tensor):
        twice = torch.cat((v, v[:2]))
        return twice[1:4], twice[2:]
    return (v[1], v[2], v[0]), (v[2], v[0], v[1])


def matrix(rows: list[list[Tensor]]) -> Tensor | list[Vector]:
    """Three vectors of numbers, as a tensor (3, 3, ..., problem) or a list."""
    if torch.compiler.is_compiling():
        return [vector(*row) for row in rows]
    return torch.stack([x for row in rows for x in row]).view(3, 3, *rows[0][0].shape)


def dots(rows: Tensor | list[Vector], v: Vector | None = None) -> Vector:
    """The products of the rows of a matrix with a vector, or with themselves."""
    if isinstance(rows, Tensor):
        other = rows if v is None else v
        assert isinstance(other, Tensor)
        return (rows * other).sum(1)
    return tuple(dot(row, row if v is None else v) for row in rows)


def total(v: Vector) -> Tensor:
    """The sum of the three."""
    return v.sum(0) if isinstance(v, Tensor) else v[0] + v[1] + v[2]


def greatest(v: Vector) -> Tensor:
    """The greatest of the three."""
    return v.amax(0) if isinstance(v, Tensor) else torch.maximum(torch.maximum(v[0], v[1]), v[2])


def least(v: Vector) -> Tensor:
    """The least of the three."""
    return v.amin(0) if isinstance(v, Tensor) else torch.minimum(torch.minimum(v[0], v[1]), v[2])


def largest(keys: Vector, rows: Tensor | list[Vector]) -> tuple[Tensor, Vector]:
    """The largest of three keys and the row of a matrix that belongs to it."""
    if isinstance(rows, Tensor) and isinstance(keys, Tensor):
        key, index = keys.max(0)
        return key, rows.gather(0, index.expand(1, *rows.shape[1:]))[0]
    second = keys[1] > keys[0]
    key = torch.maximum(keys[0], keys[1])
    value = chosen(second, rows[1], rows[0])
    return torch.maximum(key, keys[2]), chosen(keys[2] > key, rows[2], value)


def triad(a: Vector, b: Vector) -> tuple[Vector, Vector, Vector]:
    """The orthonormal frame of `a` and the normal of `a` and `b`."""
    normal = cross(a, b)
    first = scaled(a, dot(a, a).clamp_min(1e-300).rsqrt())
    third = scaled(normal, dot(normal, normal).clamp_min(1e-300).rsqrt())
    return first, cross(third, first), third


def across(u: Vector) -> tuple[Vector, Vector]:
    """Two unit vectors orthogonal to a unit vector and to each other (Duff et al. 2017)."""
    x, y, z = u
    s = torch.copysign(torch.ones_like(z), z)
    a = -1 / (s + z)
    b = x * y * a
    return vector(1 + s * x * x * a, s * b, -s * x), vector(b, s + y * y * a, -y)
