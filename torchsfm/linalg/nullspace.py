"""Null spaces and null vectors of batched matrices, with derivatives where they exist."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.linalg.decompositions import eigh, qr
from torchsfm.linalg.derivative import followed
from torchsfm.linalg.magnitude import all_below, unit_scale
from torchsfm.linalg.portions import portions
from torchsfm.linalg.rows import combine_rows

_CHUNK = 2048
"""Matrices at a time, on a CPU."""
_LIFT = 2e-15
"""What is added to the diagonal of A'A, over its trace, so that rounding leaves it positive."""
_SQUARINGS = 5
_SETTLED = 1e-12
"""What the last of two steps that shrink at a steady rate may leave."""
_INDEPENDENT = 1e-12
"""Smallest distance of a row from the span of those before it, the largest number being about 1, that is not taken for zero."""


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

    With one row less than columns it comes by reflections, else from powers of the inverse of A'A (formed in float64), and
    where the two smallest singular values are too near to each other or to rounding from the eigenvectors of A'A. Newton steps
    of `A'(A v) = s v` with the residual taken from A itself restore the accuracy that squaring loses. Such a step is
    differentiable in A, and its derivative is the derivative of v. Where the two smallest singular values coincide v is not
    unique: the value is one such vector, the derivative leaves out the directions in which it is not determined.

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
    flat = A.detach().reshape(-1, *A.shape[-2:])
    parts = [_least_vector(flat[some]) for some in portions(max(len(flat), 1), _CHUNK, A.device)]
    v, finite = (torch.cat(part) for part in zip(*parts, strict=True))
    v, finite = v.reshape(*A.shape[:-2], A.shape[-1]), finite.reshape(A.shape[:-2])
    if followed(A):
        # The value stays what it is without.
        same = _by_eigenvectors(_ready(A)[0])
        v = v + torch.sign((same.detach() * v).sum(-1, keepdim=True)) * (same - same.detach())
    first = torch.zeros_like(v)
    first[..., 0] = 1
    return torch.where(finite[..., None], v, first).to(A.dtype), finite


def _ready(A: Float[Tensor, "*batch m n"]) -> tuple[Float[Tensor, "*batch m n"], Bool[Tensor, "*batch"]]:
    """In float64, the largest number about 1, as squares of very large or small ones would not exist; and which are finite."""
    finite = all_below(A, torch.inf, 2)
    safe = torch.where(finite[..., None, None], A, 0).double()
    return safe * unit_scale(safe), finite


def _least_vector(A: Float[Tensor, "batch m n"]) -> tuple[Float[Tensor, "batch n"], Bool[Tensor, " batch"]]:
    """The vectors without derivative, and which matrices are finite."""
    safe, finite = _ready(A)
    v, settled = (_by_reflections if A.shape[1] == A.shape[2] - 1 else _by_inverse_powers)(safe)
    rest = (~settled).nonzero()[:, 0]
    if len(rest):
        v = v.index_copy(0, rest, _by_eigenvectors(safe.index_select(0, rest)))
    return v, finite


def _by_reflections(A: Float[Tensor, "batch m n"]) -> tuple[Float[Tensor, "batch n"], Bool[Tensor, " batch"]]:
    """The vectors orthogonal to n - 1 rows, and where these are independent."""
    basis, pivot = nullspace_columns(A.permute(2, 1, 0).contiguous())
    return basis[:, 0].mT, pivot > _INDEPENDENT


def _by_inverse_powers(A: Float[Tensor, "batch m n"]) -> tuple[Float[Tensor, "batch n"], Bool[Tensor, " batch"]]:
    """The least singular vectors, and where the last of two corrections left nothing to correct."""
    n = A.shape[-1]
    G = A.mT @ A
    diagonal = G.diagonal(dim1=-2, dim2=-1)
    diagonal.add_(_LIFT * diagonal.sum(-1, keepdim=True))
    L, failed = torch.linalg.cholesky_ex(G)
    root = torch.linalg.solve_triangular(L, torch.eye(n, dtype=A.dtype, device=A.device).expand_as(G), upper=False)
    inverse = power = root.mT @ root
    for _ in range(_SQUARINGS):
        power = power * power.diagonal(dim1=-2, dim2=-1).amax(-1).reciprocal()[:, None, None]
        power = power @ power
    # All columns are nearly along v, that with the largest number on the diagonal most of all.
    longest = power.diagonal(dim1=-2, dim2=-1).argmax(-1)
    v = _unit(power.gather(-2, longest[:, None, None].expand(-1, 1, n)).mT)
    sizes = []
    for _ in range(2):
        image = A @ v
        value = torch.linalg.vector_norm(image, dim=-2, keepdim=True).square()
        step = inverse @ (A.mT @ image).addcmul_(value, v, value=-1)
        step.addcmul_(v, v.mT @ step, value=-1)
        v = _unit(v - step)
        sizes.append(torch.linalg.vector_norm(step, dim=-2)[:, 0])
    before, last = sizes
    # False for what is not a number.
    return v[..., 0], (failed == 0) & (last * last <= _SETTLED * before)


def _unit(v: Float[Tensor, "batch n 1"]) -> Float[Tensor, "batch n 1"]:
    unit: Tensor = v * torch.linalg.vector_norm(v, dim=-2, keepdim=True).reciprocal()
    return unit


def _by_eigenvectors(A: Float[Tensor, "*batch m n"]) -> Float[Tensor, "*batch n"]:
    """The least singular vectors with their derivatives."""
    with torch.no_grad():
        base = A.detach()
        values, vectors, _ = eigh(base.mT @ base)
        v = vectors[..., :1]
        gaps = values[..., 1:] - values[..., :1]
        inverse = torch.where(gaps > 1e-14 * values[..., -1:], 1 / gaps, 0)[..., None]
        others = vectors[..., 1:]
        image = base @ v
        v = v - others @ (inverse * (others.mT @ (base.mT @ image - (image * image).sum((-2, -1), keepdim=True) * v)))
        image = base @ v
        value = (image * image).sum((-2, -1), keepdim=True)
    residual = A.mT @ (A @ v) - value * v
    corrected = (v - others @ (inverse * (others.mT @ residual)))[..., 0]
    unit: Tensor = corrected / corrected.norm(dim=-1, keepdim=True)
    return unit
