"""Decompositions that never raise: the one way to LAPACK for matrices that come from data.

A matrix that is not finite, or on which the iteration does not end, makes torch raise for its whole batch. Here every function
returns `ok` last, which is False for such an element; it then has zeros for values and solutions, axes for vectors, and its
neighbours have the very numbers that they have without it. Derivatives are those of `torch.linalg`, zero where `ok` is False
(of `solve` and `inverse` not finite there).
"""

import re
from collections.abc import Callable

import torch
from jaxtyping import Bool, Complex, Float
from torch import Tensor

from torchsfm.linalg.magnitude import all_below

_GaveUp: type[RuntimeError] = torch.linalg.LinAlgError  # type: ignore[attr-defined]
_BATCH_ELEMENT = re.compile(r"Batch element (\d+)")
_ROOM = 2.0**20
"""How far below the largest number entries have to stay: sums of products with unit vectors must not overflow."""


def eigh(
    A: Float[Tensor, "*batch n n"],
) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n n"], Bool[Tensor, "*batch"]]:
    """Eigenvalues, ascending, and eigenvectors, as columns, of symmetric matrices; the lower triangle counts.

    Args:
        A: Symmetric matrices.

    Example:
        >>> import torch, torchsfm.linalg
        >>> values, vectors, ok = torchsfm.linalg.eigh(torch.tensor([[2.0, 1.0], [1.0, 2.0]]))
        >>> values, bool(ok)
        (tensor([1.0000, 3.0000]), True)
    """
    safe, sound = _sound(A)
    values, vectors = _attempt(torch.linalg.eigh, safe)
    ok = sound & torch.isfinite(values).all(-1)
    return torch.where(ok[..., None], values, 0.0), _or_axes(vectors, ok), ok


def eigvalsh(A: Float[Tensor, "*batch n n"]) -> tuple[Float[Tensor, "*batch n"], Bool[Tensor, "*batch"]]:
    """Eigenvalues, ascending, of symmetric matrices; the lower triangle counts.

    Args:
        A: Symmetric matrices.

    Example:
        >>> import torch, torchsfm.linalg
        >>> A = torch.stack((torch.eye(2), torch.full((2, 2), torch.nan)))  # the second one spoils nothing
        >>> values, ok = torchsfm.linalg.eigvalsh(A)
        >>> values[0], ok
        (tensor([1., 1.]), tensor([ True, False]))
    """
    safe, sound = _sound(A)
    (values,) = _attempt(lambda a: (torch.linalg.eigvalsh(a),), safe)
    ok = sound & torch.isfinite(values).all(-1)
    return torch.where(ok[..., None], values, 0.0), ok


def eigvals(A: Float[Tensor, "*batch n n"]) -> tuple[Complex[Tensor, "*batch n"], Bool[Tensor, "*batch"]]:
    """Eigenvalues, in no order, of square matrices.

    Args:
        A: Any square matrices.

    Example:
        >>> import torch, torchsfm.linalg
        >>> values, ok = torchsfm.linalg.eigvals(torch.tensor([[0.0, -1.0], [1.0, 0.0]]))  # a quarter of a turn: +-i
        >>> values.imag.sort().values, bool(ok)
        (tensor([-1.,  1.]), True)
    """
    safe, sound = _sound(A)
    (values,) = _attempt(lambda a: (torch.linalg.eigvals(a),), safe)
    ok = sound & torch.isfinite(values).all(-1)
    return torch.where(ok[..., None], values, 0.0), ok


def svd(
    A: Float[Tensor, "*batch m n"], *, full_matrices: bool = True
) -> tuple[Float[Tensor, "*batch m p"], Float[Tensor, "*batch k"], Float[Tensor, "*batch q n"], Bool[Tensor, "*batch"]]:
    """`U`, the k = min(m, n) singular values, descending, and `V'`; all of the axes or the first k of them.

    Args:
        A: Any matrices.
        full_matrices: All of the axes, so that U and V are square.

    Example:
        >>> import torch, torchsfm.linalg
        >>> U, S, Vh, ok = torchsfm.linalg.svd(torch.diag(torch.tensor([1.0, 3.0, 2.0])))
        >>> S, bool(ok)
        (tensor([3., 2., 1.]), True)
    """
    safe, sound = _sound(A)
    U, s, Vh = _attempt(lambda a: torch.linalg.svd(a, full_matrices=full_matrices), safe)
    ok = sound & torch.isfinite(s).all(-1)
    return _or_axes(U, ok), torch.where(ok[..., None], s, 0.0), _or_axes(Vh, ok), ok


def svdvals(A: Float[Tensor, "*batch m n"]) -> tuple[Float[Tensor, "*batch k"], Bool[Tensor, "*batch"]]:
    """The k = min(m, n) singular values, descending.

    Args:
        A: Any matrices.

    Example:
        >>> import torch, torchsfm.linalg
        >>> torchsfm.linalg.svdvals(torch.tensor([[0.0, 4.0], [3.0, 0.0]]))
        (tensor([4.0000, 3.0000]), tensor(True))
    """
    safe, sound = _sound(A)
    (s,) = _attempt(lambda a: (torch.linalg.svdvals(a),), safe)
    ok = sound & torch.isfinite(s).all(-1)
    return torch.where(ok[..., None], s, 0.0), ok


def qr(
    A: Float[Tensor, "*batch m n"], *, complete: bool = False
) -> tuple[Float[Tensor, "*batch m p"], Float[Tensor, "*batch p n"], Bool[Tensor, "*batch"]]:
    """`Q`, all m columns or the first min(m, n), and the upper triangle `R`; `ok` says nothing of the rank.

    Args:
        A: Any matrices.
        complete: All m columns of Q, which then is square.

    Example:
        >>> import torch, torchsfm.linalg
        >>> A = torch.tensor([[3.0, 0.0], [4.0, 5.0]])
        >>> Q, R, ok = torchsfm.linalg.qr(A)
        >>> bool(ok), bool((Q @ R).allclose(A, atol=1e-5)), R.diagonal().abs()
        (True, True, tensor([5., 3.]))
    """
    safe, sound = _sound(A)
    Q, R = torch.linalg.qr(safe, mode="complete" if complete else "reduced")
    return _or_axes(Q, sound), torch.where(sound[..., None, None], R, 0.0), sound


def triangular_factor(A: Float[Tensor, "*batch m n"]) -> tuple[Float[Tensor, "*batch k n"], Bool[Tensor, "*batch"]]:
    """The upper triangle `R` of the QR decomposition alone, k = min(m, n).

    Args:
        A: Any matrices.

    Example:
        >>> import torch, torchsfm.linalg
        >>> R, ok = torchsfm.linalg.triangular_factor(torch.tensor([[3.0, 0.0], [4.0, 5.0]]))
        >>> R.diagonal().abs(), bool(ok)
        (tensor([5., 3.]), True)
    """
    safe, sound = _sound(A)
    R = torch.linalg.qr(safe, mode="r")[1]
    return torch.where(sound[..., None, None], R, 0.0), sound


def solve(
    A: Float[Tensor, "*#batch n n"], b: Float[Tensor, "*#batch n k"]
) -> tuple[Float[Tensor, "*batch n k"], Bool[Tensor, "*batch"]]:
    """Solve `A x = b`; `ok` is False where LU finds A singular, or A, b or x is not finite.

    Args:
        A: Square matrices.
        b: Right-hand sides as columns.

    Example:
        >>> import torch, torchsfm.linalg
        >>> A = torch.stack((2 * torch.eye(2), torch.zeros(2, 2)))  # the second one is singular
        >>> x, ok = torchsfm.linalg.solve(A, torch.ones(2, 1))
        >>> x[0, :, 0], ok
        (tensor([0.5000, 0.5000]), tensor([ True, False]))
    """
    if b.ndim < A.ndim:
        # One dimension less, and torch may take columns for a batch of vectors: a 4x4 matrix for four systems of four, say.
        b = b.expand(*A.shape[:-2], *b.shape[-2:])
    x, info = torch.linalg.solve_ex(A, b)
    ok = _is_sound(A) & (info == 0) & all_below(x, torch.inf, 2)
    return torch.where(ok[..., None, None], x, 0.0), ok


def inverse(A: Float[Tensor, "*batch n n"]) -> tuple[Float[Tensor, "*batch n n"], Bool[Tensor, "*batch"]]:
    """The inverse; `ok` is False where LU finds the matrix singular, or it or its inverse is not finite.

    Args:
        A: Any square matrices.

    Example:
        >>> import torch, torchsfm.linalg
        >>> A = torch.stack((2 * torch.eye(2), torch.zeros(2, 2)))
        >>> A_inv, ok = torchsfm.linalg.inverse(A)
        >>> A_inv[0].diagonal(), ok
        (tensor([0.5000, 0.5000]), tensor([ True, False]))
    """
    B, info = torch.linalg.inv_ex(A)
    ok = _is_sound(A) & (info == 0) & all_below(B, torch.inf, 2)
    return torch.where(ok[..., None, None], B, 0.0), ok


def _sound(A: Tensor) -> tuple[Tensor, Tensor]:
    """The matrices, those with numbers that cannot be worked with replaced by axes, and which were not."""
    sound = _is_sound(A)
    return _or_axes(A, sound), sound


def _is_sound(A: Tensor) -> Tensor:
    return all_below(A, torch.finfo(A.dtype).max / _ROOM, 2)


def _or_axes(A: Tensor, ok: Tensor) -> Tensor:
    return torch.where(ok[..., None, None], A, torch.eye(*A.shape[-2:], dtype=A.dtype, device=A.device))


def _attempt(decompose: Callable[[Tensor], tuple[Tensor, ...]], A: Tensor) -> tuple[Tensor, ...]:
    """The decomposition; NaN for matrices on which LAPACK gives up, whose entries are of wildly different sizes."""
    try:
        return decompose(A)
    except _GaveUp:
        # torch tells of the first alone, and rarely enough: one by one. Then all others once more, as rounding depends on the
        # place in memory.
        pieces = [_alone(decompose, matrix) for matrix in A.reshape(-1, *A.shape[-2:])]
        parts = tuple(torch.stack(part).reshape(*A.shape[:-2], *part[0].shape) for part in zip(*pieces, strict=True))
        kept = ~torch.isnan(parts[0]).flatten(A.ndim - 2).any(-1)
        while True:
            try:
                again = decompose(_or_axes(A, kept))
                return tuple(torch.where(kept.view(*kept.shape, *[1] * (p.ndim - kept.ndim)), p, torch.nan) for p in again)
            except _GaveUp as error:
                # On some it gives up in one place of memory only.
                named = _BATCH_ELEMENT.search(str(error))
                if named is None or not bool(kept.view(-1)[int(named[1])]):
                    return parts
                kept.view(-1)[int(named[1])] = False


def _alone(decompose: Callable[[Tensor], tuple[Tensor, ...]], matrix: Tensor) -> tuple[Tensor, ...]:
    try:
        return decompose(matrix)
    except _GaveUp:
        axes = torch.eye(*matrix.shape, dtype=matrix.dtype, device=matrix.device)
        return tuple(torch.full_like(part, torch.nan) for part in decompose(axes))
