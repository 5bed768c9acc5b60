"""Small linear systems: determinants, inverses and solutions that stay finite whatever comes in."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def cross(a: Float[Tensor, "*#batch 3"], b: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3"]:
    """The cross product along the last dimension, with broadcasting."""
    a, b = torch.broadcast_tensors(a, b)  # type: ignore[no-untyped-call]
    a0, a1, a2 = a.unbind(-1)
    b0, b1, b2 = b.unbind(-1)
    return torch.stack((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0), -1)


def determinant_3x3(A: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """The determinant as a triple product, whose derivatives of every order exist where it is zero."""
    return (A[..., 0, :] * cross(A[..., 1, :], A[..., 2, :])).sum(-1)


def adjugate_3x3(A: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The adjugate, `A adj(A) = det(A) I`; it exists where the inverse does not."""
    r0, r1, r2 = A.unbind(-2)
    return torch.stack((cross(r1, r2), cross(r2, r0), cross(r0, r1)), -1)


def solve(
    A: Float[Tensor, "*#batch n n"], b: Float[Tensor, "*#batch n k"]
) -> tuple[Float[Tensor, "*batch n k"], Bool[Tensor, "*batch"]]:
    """Solve `A x = b` for every element of the batch on its own.

    Args:
        A: Square matrices.
        b: Right-hand sides as columns.

    Returns:
        The solutions, zero where there is none, and the mask of elements that have one: a matrix that LU finds singular, or
        an input or result that is not finite, makes an element False and touches no other.
    """
    x, info = torch.linalg.solve_ex(A, b)
    good = (info == 0) & torch.isfinite(x).all(-1).all(-1)
    return torch.where(good[..., None, None], x, 0.0), good
