"""The pseudo-inverse of a symmetric positive semidefinite matrix whose null space is small beside it.

Normal equations are such: what no measurement tells, the gauge, has seven dimensions, whatever the number of cameras. Of small
matrices all eigenvalues are found; of large ones only those next to zero, by inverse iteration on a subspace (Golub & Van Loan
2013, 8.2), and the rest is inverted by a Cholesky factor, which takes less than half of the time.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.linalg.decompositions import eigh

Apply = Callable[[Tensor], Tensor]
SMALL = 256
"""Rows of the largest matrix of which all eigenvalues are found."""
WIDTH, ROUNDS = 16, 6
"""Vectors of the subspace, more than a gauge has dimensions, and how often it is iterated."""
SHIFT = 1e-13
"""Added to the eigenvalues, relative to the largest, so that there is a factor; next to those that count it is nothing."""


@dataclass(frozen=True)
class PseudoInverse:
    """The inverse on the range of a matrix, and zero on its null space."""

    inverse: Float[Tensor, "n n"]
    rank: int
    ok: Bool[Tensor, ""]
    """False where there is none: an entry is not finite."""
    _factor: Float[Tensor, "n m"]
    _null: Float[Tensor, "n k"] | None
    """Of a large matrix, whose factor is one of a matrix without null space."""

    def root(self) -> Float[Tensor, "n m"]:
        """A matrix whose product with its transpose is the inverse."""
        if self._null is None:
            return self._factor
        eye = torch.eye(len(self._factor), dtype=self._factor.dtype, device=self._factor.device)
        inverse: Tensor = torch.linalg.solve_triangular(self._factor.mT, eye, upper=True)
        return inverse - self._null @ (self._null.mT @ inverse)


def pseudo_inverse(A: Float[Tensor, "n n"], null: float) -> PseudoInverse:
    """Invert a symmetric positive semidefinite matrix on its range.

    Args:
        A: The matrix; its lower triangle counts.
        null: Eigenvalues below this part of the largest are taken for zero.

    Returns:
        The inverse; infinite where it is not OK.
    """
    if len(A) > SMALL and bool(A.isfinite().all()):
        found = _by_factor(A.tril() + A.tril(-1).mT, null)
        if found is not None:
            return found
    values, vectors, ok = eigh(A)
    seen = values > null * values[-1:]
    root = vectors[:, seen] * values[seen].rsqrt()
    return PseudoInverse(torch.where(ok, root @ root.mT, torch.inf), root.shape[1], ok, root, None)


def largest_value(apply: Apply, some: Float[Tensor, "n"]) -> Float[Tensor, ""]:
    """About the largest eigenvalue of a finite symmetric matrix, given its product with columns.

    Args:
        apply: The product.
        some: A row of it.
    """
    basis = torch.linalg.qr(_start(some))[0]
    for _ in range(ROUNDS):
        basis = torch.linalg.qr(apply(basis))[0]
    top: Tensor = torch.linalg.matrix_norm(apply(basis), 2)
    return top


def small_null_space(
    apply: Apply, solve: Apply, some: Float[Tensor, "n"], limit: Float[Tensor, ""]
) -> Float[Tensor, "n k"] | None:
    """An orthonormal basis of what a symmetric matrix takes to no more than a limit; None if that is not small.

    Args:
        apply: Its product with columns.
        solve: The product with the inverse of it, or of it and a little more than nothing.
        some: A row of it.
        limit: The largest eigenvalue that counts as zero.
    """
    basis = torch.linalg.qr(_start(some))[0]
    for _ in range(ROUNDS):
        basis = torch.linalg.qr(solve(basis))[0]
    values, vectors, _ = eigh(basis.mT @ apply(basis))
    least = values <= limit
    return None if bool(least.all()) else basis @ vectors[:, least]


def _start(some: Float[Tensor, "n"]) -> Float[Tensor, "n m"]:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(len(some), WIDTH, generator=generator, dtype=torch.float64, device="cpu").to(some)


def _by_factor(A: Float[Tensor, "n n"], null: float) -> PseudoInverse | None:
    """The inverse of a large matrix; None where it is not semidefinite or its null space is not small."""
    top = largest_value(lambda x: A @ x, A[0])
    shifted = A.clone()
    shifted.diagonal().add_(SHIFT * top)
    lower, info = torch.linalg.cholesky_ex(shifted)
    if bool(info):
        return None
    kernel = small_null_space(lambda x: A @ x, lambda x: torch.cholesky_solve(x, lower), A[0], null * top)
    if kernel is None:
        return None
    lower, info = torch.linalg.cholesky_ex(A + top * kernel @ kernel.mT)
    if bool(info):
        return None
    inverse = torch.cholesky_inverse(lower) - kernel @ kernel.mT / top
    return PseudoInverse(inverse, len(A) - kernel.shape[1], info == 0, lower, kernel)
