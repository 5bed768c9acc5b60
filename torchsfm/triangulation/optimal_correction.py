"""Two views: the smallest displacement of two image points after which their rays meet."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors

Row = tuple[Tensor, ...]


def correct_matches(
    F: Float[Tensor, "*#batch 3 3"], x1: Float[Tensor, "*#batch n 2"], x2: Float[Tensor, "*#batch n 2"]
) -> tuple[Float[Tensor, "*batch n 2"], Float[Tensor, "*batch n 2"]]:
    """The nearest pairs of image points that satisfy the epipolar constraint, by sum of squared distances.

    Two iterations of Lindstrom ("Triangulation made easy", CVPR 2010, `niter2`); they meet the optimum of Hartley & Sturm to
    many digits more than pixels have. Computed in float64. A pair at both epipoles, and data that are not finite, stay
    as they are.

    Args:
        F: Fundamental matrices, `x2' F x1 = 0`, of any scale.
        x1: Points in the first image.
        x2: Points in the second image.

    Returns:
        The corrected points.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> F = torchsfm.geometry.cross_matrix(torch.tensor([1.0, 0.0, 0.0]))  # moved sideways: y2 = y1
        >>> torchsfm.triangulation.correct_matches(F, torch.tensor([[0.0, 1.0]]), torch.tensor([[7.0, 3.0]]))
        (tensor([[0., 2.]]), tensor([[7., 2.]]))
    """
    batch = check_tensors(F=(F, "3 3"), x1=(x1, "n 2"), x2=(x2, "n 2"))
    entries = F.double()[..., None]
    rows = tuple(tuple(entries[..., i, j, :] for j in range(3)) for i in range(3))
    u1, v1 = x1.double().unbind(-1)
    u2, v2 = x2.double().unbind(-1)
    corrected = torch.stack(lindstrom(rows, u1, v1, u2, v2), -1)
    corrected = corrected.expand(*batch, *corrected.shape[-2:])
    y1, y2 = corrected[..., :2], corrected[..., 2:]
    good = torch.isfinite(corrected).all(-1, keepdim=True)
    shape = y1.shape
    return torch.where(good, y1, x1.double().expand(shape)).to(x1.dtype), torch.where(good, y2, x2.double().expand(shape)).to(
        x1.dtype
    )


def lindstrom(F: tuple[Row, ...], u1: Tensor, v1: Tensor, u2: Tensor, v2: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The corrected coordinates, in the order of the arguments; F given by its entries."""
    size = torch.stack([e * e for row in F for e in row]).sum(0).clamp_min(1e-300).rsqrt()
    F = tuple(tuple(e * size for e in row) for row in F)
    (f00, f01, _), (f10, f11, _) = F[0], F[1]

    def lines(p: Tensor, q: Tensor, s: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Normals of the epipolar lines in the second and the first image."""
        return (
            f00 * p + f01 * q + F[0][2],
            f10 * p + f11 * q + F[1][2],
            f00 * s + f10 * t + F[2][0],
            f01 * s + f11 * t + F[2][1],
        )

    a2, b2, a1, b1 = lines(u1, v1, u2, v2)
    c = u2 * a2 + v2 * b2 + F[2][0] * u1 + F[2][1] * v1 + F[2][2]
    a = a2 * (f00 * a1 + f01 * b1) + b2 * (f10 * a1 + f11 * b1)
    b = 0.5 * (a1 * a1 + b1 * b1 + a2 * a2 + b2 * b2)
    d = (b * b - a * c).clamp_min(0).sqrt()
    k = c / (b + d).clamp_min(1e-300)
    n2, m2 = a2 - k * (f00 * a1 + f01 * b1), b2 - k * (f10 * a1 + f11 * b1)
    n1, m1 = a1 - k * (f00 * a2 + f10 * b2), b1 - k * (f01 * a2 + f11 * b2)
    k = k * 2 * d / (n1 * n1 + m1 * m1 + n2 * n2 + m2 * m2).clamp_min(1e-300)
    return u1 - k * n1, v1 - k * m1, u2 - k * n2, v2 - k * m2


def fundamental_rows(first: tuple[Row, ...], second: tuple[Row, ...]) -> tuple[Row, ...]:
    """The entries of F from those of two cameras (Hartley & Zisserman, 2nd edition, 17.3); finite centres are not needed."""
    one, two = _pencils(first), _pencils(second)
    signs = {(0, 1): 1, (0, 2): -1, (0, 3): 1, (1, 2): 1, (1, 3): -1, (2, 3): 1}
    rows = []
    for j in range(3):
        row = []
        for i in range(3):
            terms = [s * one[i][p, q] * two[j][tuple(k for k in range(4) if k not in (p, q))] for (p, q), s in signs.items()]
            row.append(torch.stack(terms).sum(0))
        rows.append(tuple(row))
    return tuple(rows)


def _pencils(P: tuple[Row, ...]) -> list[dict[tuple[int, ...], Tensor]]:
    """For each row of a camera the 2x2 minors of the other two, in cyclic order."""
    pairs = ((P[1], P[2]), (P[2], P[0]), (P[0], P[1]))
    return [{(p, q): a[p] * b[q] - a[q] * b[p] for p in range(4) for q in range(p + 1, 4)} for a, b in pairs]
