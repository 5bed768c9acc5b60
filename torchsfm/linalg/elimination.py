"""Small linear systems by formulas: determinants, adjugates, least squares."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg.rows import combine_rows


def cross(a: Float[Tensor, "*#batch 3"], b: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3"]:
    """The cross product along the last dimension, with broadcasting.

    Args:
        a: The left factors.
        b: The right ones.

    Example:
        >>> import torch, torchsfm.linalg
        >>> torchsfm.linalg.cross(torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]))
        tensor([0., 0., 1.])
    """
    a, b = torch.broadcast_tensors(a, b)  # type: ignore[no-untyped-call]
    a0, a1, a2 = a.unbind(-1)
    b0, b1, b2 = b.unbind(-1)
    return torch.stack((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0), -1)


def determinant_3x3(A: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """The determinant as a triple product, whose derivatives of every order exist where it is zero.

    Args:
        A: Any matrices.

    Example:
        >>> import torch, torchsfm.linalg
        >>> torchsfm.linalg.determinant_3x3(torch.diag(torch.tensor([1.0, 2.0, 3.0])))
        tensor(6.)
    """
    return (A[..., 0, :] * cross(A[..., 1, :], A[..., 2, :])).sum(-1)


def adjugate_3x3(A: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The adjugate, `A adj(A) = det(A) I`; it exists where the inverse does not.

    Args:
        A: Any matrices.

    Example:
        >>> import torch, torchsfm.linalg
        >>> torchsfm.linalg.adjugate_3x3(torch.diag(torch.tensor([2.0, 3.0, 0.0]))).diagonal()
        tensor([0., 0., 6.])
    """
    r0, r1, r2 = A.unbind(-2)
    return torch.stack((cross(r1, r2), cross(r2, r0), cross(r0, r1)), -1)


def adjugate_4x4(A: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """The adjugate, `A adj(A) = det(A) I`; it exists where the inverse does not.

    Args:
        A: Any matrices.

    Example:
        >>> import torch, torchsfm.linalg
        >>> torchsfm.linalg.adjugate_4x4(torch.diag(torch.tensor([1.0, 2.0, 3.0, 0.0]))).diagonal()
        tensor([0., 0., 0., 6.])
    """
    rest = [[k for k in range(4) if k != i] for i in range(4)]
    rows = []
    for i in range(4):
        minors = [determinant_3x3(A[..., rest[j], :][..., :, rest[i]]) for j in range(4)]
        rows.append(torch.stack([m if (i + j) % 2 == 0 else -m for j, m in enumerate(minors)], -1))
    return torch.stack(rows, -2)


def least_squares_rows(J: Float[Tensor, "m k batch"], r: Float[Tensor, "m batch"]) -> Float[Tensor, "k batch"]:
    """The x with the smallest `|J x - r|`, for a batch in the last dimension, by the normal equations with a unit diagonal.

    Where the columns are dependent or not finite x is not finite or means nothing.
    """
    k = J.shape[1]
    scale = combine_rows(J, J).rsqrt()
    J = J * scale
    # The lower triangle of J'J and J'r as a last row; then Cholesky, column by column.
    columns = [*J.unbind(1), r]
    A = [torch.stack([*(combine_rows(c, columns[i]) for c in columns[i:])]) for i in range(k)]
    for i in range(k):
        A[i] = A[i] * A[i][0].rsqrt()
        for j in range(i + 1, k):
            A[j] = torch.addcmul(A[j], A[i][j - i :], A[i][j - i], value=-1)
    x: list[Tensor] = []
    for i in range(k - 1, -1, -1):
        total = A[i][-1]
        for value, entry in zip(x, A[i][1:-1], strict=True):
            total = torch.addcmul(total, value, entry, value=-1)
        x.insert(0, total / A[i][0])
    return torch.stack(x) * scale
