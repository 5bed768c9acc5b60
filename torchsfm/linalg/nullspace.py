"""Null spaces and null vectors of batched matrices, with derivatives where they exist."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.linalg.decompositions import eigh, qr
from torchsfm.linalg.magnitude import unit_scale
from torchsfm.linalg.rows import combine_rows


def orthonormal_nullspace(A: Float[Tensor, "*batch m n"]) -> Float[Tensor, "*batch n n-m"]:
    """An orthonormal basis of the null space of wide matrices of full row rank, as columns, by QR of the transpose.

    Args:
        A: Matrices with fewer rows than columns, the rows independent.

    Example:
        >>> import torch, torchsfm.linalg
        >>> torchsfm.linalg.orthonormal_nullspace(torch.tensor([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])).abs()
        tensor([[0.],
                [0.],
                [1.]])
    """
    m = A.shape[-2]
    Q, _, _ = qr(A.mT, complete=True)
    return Q[..., m:]


def nullspace_rows(a: Float[Tensor, "m n batch"]) -> tuple[Float[Tensor, "k n batch"], Float[Tensor, " batch"]]:
    """The same for a batch in the last dimension, by unrolled Householder reflections: many small matrices, few operations.

    Args:
        a: Matrices of m < n rows, the batch in the last dimension.

    Returns:
        An orthonormal basis as k = n - m rows, and the smallest pivot: the distance of a row from the span of those before it,
        which is 0 where the rows are dependent (the basis is then still orthonormal, or not finite).

    Example:
        >>> import torch, torchsfm.linalg
        >>> a = torch.tensor([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])[..., None].double()  # one matrix, the batch comes last
        >>> basis, pivot = torchsfm.linalg.nullspace_rows(a)
        >>> basis[..., 0].abs()
        tensor([[0., 0., 1.]], dtype=torch.float64)
    """
    basis, smallest = nullspace_columns(a.transpose(0, 1).contiguous())
    return basis.transpose(0, 1), smallest


def nullspace_columns(a: Float[Tensor, "n m batch"]) -> tuple[Float[Tensor, "n k batch"], Float[Tensor, " batch"]]:
    """`nullspace_rows` with the matrices and the basis transposed, which is faster; what is in `a` is lost."""
    n, m, batch = a.shape
    basis, pivots, reflections = a.new_zeros(n, n - m, batch), [], []
    for i in range(m):
        v, rest = torch.split(a, [1, m - i - 1], 1)
        rows = v.unbind(0)
        square, others = torch.split(combine_rows(a.unbind(0), rows), [1, m - i - 1])
        pivots.append(square.sqrt())
        signed = torch.copysign(pivots[-1], rows[0])
        rows[0].add_(signed)
        # By 1 / (signed v0) instead of 2 / (v'v), which is the same.
        beta = (signed * rows[0]).reciprocal_()
        reflections.append((rows, v, beta))
        if i + 1 < m:
            # The products were with v as it was.
            rest.addcmul_(v, others.addcmul_(signed, rest[0]).mul_(beta), value=-1)
            a = rest[1:]
    # The last reflection of the last rows of the identity; the other entries are still zero.
    rows, v, beta = reflections.pop()
    torch.mul(v, v[1:].mul(-beta).transpose(0, 1), out=basis[m - 1 :])
    basis[m:].diagonal(dim1=0, dim2=1).add_(1)
    entries = basis.unbind(0)
    for i in range(m - 2, -1, -1):
        rows, v, beta = reflections[i]
        basis[i:].addcmul_(v, combine_rows(entries[i + 1 :], rows[1:]).mul_(beta), value=-1)
    return basis, torch.cat(pivots).amin(0)


def null_vector(
    A: Float[Tensor, "*batch m n"],
) -> tuple[Float[Tensor, "*batch n"], Bool[Tensor, "*batch"]]:
    """The unit vector v that makes `|A v|` smallest, and its derivative.

    The eigenvector of A'A (formed and solved in float64) is corrected by Newton steps of `A'(A v) = s v` with the residual
    taken from A itself, which restores the accuracy that squaring loses. The last step is differentiable in A, and its
    derivative is the derivative of v. Where the two smallest singular values coincide v is not unique: the value is one such
    vector, the derivative leaves out the directions in which it is not determined.

    Args:
        A: Matrices with m >= n - 1 rows, any scale.

    Returns:
        Unit vectors, and the mask of elements with finite input; the others get the first basis vector.

    Example:
        >>> import torch, torchsfm.linalg
        >>> v, ok = torchsfm.linalg.null_vector(torch.tensor([[1.0, -1.0, 0.0], [0.0, 1.0, -1.0]]))
        >>> v / v[0], bool(ok)
        (tensor([1.0000, 1.0000, 1.0000]), True)
    """
    finite = torch.isfinite(A).all(-1).all(-1)
    safe = torch.where(finite[..., None, None], A, 0).double()
    # Squares of very large or small numbers would not exist.
    safe = safe * unit_scale(safe)
    with torch.no_grad():
        base = safe.detach()
        values, vectors, _ = eigh(base.mT @ base)
        v = vectors[..., :1]
        gaps = values[..., 1:] - values[..., :1]
        inverse = torch.where(gaps > 1e-14 * values[..., -1:], 1 / gaps, 0)[..., None]
        others = vectors[..., 1:]
        image = base @ v
        v = v - others @ (inverse * (others.mT @ (base.mT @ image - (image * image).sum((-2, -1), keepdim=True) * v)))
        image = base @ v
        value = (image * image).sum((-2, -1), keepdim=True)
    residual = safe.mT @ (safe @ v) - value * v
    corrected = (v - others @ (inverse * (others.mT @ residual)))[..., 0]
    unit = corrected / corrected.norm(dim=-1, keepdim=True)
    first = torch.zeros_like(unit)
    first[..., 0] = 1
    return torch.where(finite[..., None], unit, first).to(A.dtype), finite
