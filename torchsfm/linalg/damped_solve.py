"""Normal equations that may be singular."""

import torch
from jaxtyping import Float
from torch import Tensor


def damped_solve(A: Float[Tensor, "*batch k k"], b: Float[Tensor, "*batch k r"]) -> Float[Tensor, "*batch k r"]:
    """Solve normal equations `A x = b`, damped as little as makes them definite; zero where even that fails.

    The damping is relative to the diagonal, so that the unknowns may be of different units. An unknown that nothing depends on
    is 0.

    Args:
        A: Symmetric matrices, positive semidefinite but for rounding.
        b: Right-hand sides as columns.

    Example:
        >>> import torch, torchsfm.linalg
        >>> A, b = torch.diag(torch.tensor([4.0, 0.0])).double(), torch.tensor([[8.0], [0.0]]).double()  # nothing says y
        >>> torchsfm.linalg.damped_solve(A, b)[:, 0]
        tensor([2., 0.], dtype=torch.float64)
    """
    A = A.clone()
    diagonal = A.diagonal(dim1=-2, dim2=-1)
    unknown = diagonal <= 1e-290
    # As much as 1e-10 on the diagonal of the matrix scaled to a unit one; the scaling itself changes nothing.
    diagonal.mul_(1 + 1e-10).add_(unknown)
    factor, info = torch.linalg.cholesky_ex(A)
    x = torch.cholesky_solve(b, factor).nan_to_num_(0, 0, 0)
    return x.masked_fill_(unknown.logical_or_(info[..., None])[..., None], 0)
