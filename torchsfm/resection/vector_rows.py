"""Vectors with coordinates in the first and the batch in the last dimension: products, turns, frames."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor


def frame_rows(a: Float[Tensor, "3 *n"], b: Float[Tensor, "3 *n"]) -> tuple[Tensor, Tensor, Tensor]:
    """Along a, across it in the plane of a and b, and their normal; not finite where there is none."""
    first = a / norm_rows(a)
    normal = cross_rows(first, b)
    third = normal / norm_rows(normal)
    return first, cross_rows(third, first), third


def outer_rows(a: Sequence[Float[Tensor, "3 *k"]], b: Sequence[Float[Tensor, "3 *k"]]) -> Float[Tensor, "3 3 *k"]:
    """The sum of the products `a_i b_i'` of vectors: the turn from the frame of the b to that of the a."""
    (a1, a2, a3), (b1, b2, b3) = a, b
    out = a1[:, None] * b1
    return out.addcmul_(a2[:, None], b2).addcmul_(a3[:, None], b3)


def turned(R: Float[Tensor, "3 3 m"], v: Float[Tensor, "3 k m"]) -> Float[Tensor, "3 k m"]:
    """Vectors, turned."""
    out: Tensor = R[:, 0, None] * v[0]
    return out.addcmul_(R[:, 1, None], v[1]).addcmul_(R[:, 2, None], v[2])


def dot_rows(a: Float[Tensor, "3 *k"], b: Float[Tensor, "3 *k"]) -> Float[Tensor, "*k"]:
    """Scalar products."""
    return (a[0] * b[0]).addcmul_(a[1], b[1]).addcmul_(a[2], b[2])


def cross_rows(a: Float[Tensor, "3 *k"], b: Float[Tensor, "3 *k"]) -> Float[Tensor, "3 *k"]:
    """Vector products."""
    (a1, a2, a3), (b1, b2, b3) = a.unbind(0), b.unbind(0)
    pairs = ((a2, b3, a3, b2), (a3, b1, a1, b3), (a1, b2, a2, b1))
    return torch.stack([(p * q).addcmul_(r, s, value=-1) for p, q, r, s in pairs])


def norm_rows(v: Float[Tensor, "3 *k"]) -> Float[Tensor, "*k"]:
    """Lengths."""
    return dot_rows(v, v).sqrt()


def length_rows(v: Float[Tensor, "3 *k"]) -> Float[Tensor, "*k"]:
    """Lengths to divide by."""
    return norm_rows(v).clamp_min(1e-300)


def unit_rows(v: Float[Tensor, "3 *k"]) -> Float[Tensor, "3 *k"]:
    """Unit vectors along vectors of any size."""
    largest = v.abs().amax(0)
    v = v / torch.where(largest > 0, largest, 1.0)
    return v / length_rows(v)
