"""How far points of affine cameras may be stretched unnoticed, by the noise that their own misfit shows.

Where points are known, the rows of a camera have the noise of its image through the scatter of the points, and so have the
equations that make it metric. Together these say how well the metric of space is known: two orientations leave the depth open
(Koenderink & van Doorn, "Affine structure from motion", 1991), thin scenes and small turns nearly so.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.linalg import eigh, inverse, solve

_TINY, _OPEN = 1e-300, 1e30
"""The least denominator; the deviation of what nothing determines."""
_ROUNDING = 1e-12
"""Of the largest information, what is none."""
_STEPS = 3


class MetricEquations(NamedTuple):
    """What makes affine cameras metric, `rows . Q = right` for the upper triangle of a symmetric Q, of every view.

    Each equation is quadratic in the rows m and n of its camera; `by_rows` holds its derivatives at Q = I.
    """

    rows: Float[Tensor, "p v k 6"]
    right: Float[Tensor, "p v k"]
    by_rows: Float[Tensor, "p v k 2 3"]


def metric_equations(M: Float[Tensor, "p v 2 3"], t: Float[Tensor, "p v 2"], model: str) -> MetricEquations:
    """The equations of cameras of some kind, see `factorize_affine`."""
    m, n = M.unbind(-2)
    mm, nn, mn = _form(m, m), _form(n, n), _form(m, n)
    none = torch.zeros_like(m)
    if model == "orthographic":
        by_rows = [(2 * m, none), (none, 2 * n), (n, m)]
        rows, right = [mm, nn, mn], [1.0, 1.0, 0.0]
    else:
        a, b = (t[..., :1], t[..., 1:]) if model == "paraperspective" else (0 * t[..., :1], 0 * t[..., :1])
        A, B = 1 + a * a, 1 + b * b
        rows, right = [mm / A - nn / B, mn - a * b * (mm / A + nn / B) / 2], [0.0, 0.0]
        by_rows = [(2 * m / A, -2 * n / B), (n - a * b * m / A, m - a * b * n / B)]
    told = torch.stack([torch.stack(pair, -2) for pair in by_rows], -3)
    return MetricEquations(torch.stack(rows, -2), m.new_tensor(right).expand(*m.shape[:-1], len(right)), told)


def metric_information(
    equations: MetricEquations, X: Float[Tensor, "p n 3"], w: Float[Tensor, "p v n"], view: Bool[Tensor, "p v"]
) -> tuple[Float[Tensor, "p 6 6"], Float[Tensor, "p 6"], Float[Tensor, "p"]]:
    """Normal equations of a step of Q from I for noise 1 of the images, their right-hand side, and the misfit.

    Args:
        equations: Of cameras that are nearly metric.
        X: The points that go with them.
        w: Weights of the observations, inverse variances.
        view: Views that count.
    """
    of_rows, J = _row_covariance(X, w), equations.by_rows
    noise = torch.einsum("pvkri,pvij,pvlrj->pvkl", J, of_rows, J)
    weight = inverse(noise)[0] * view[..., None, None]
    one = torch.triu(torch.ones(3, 3, device=X.device)).nonzero()
    identity = (one[:, 0] == one[:, 1]).to(X.dtype)
    off = equations.right - equations.rows @ identity
    A = torch.einsum("pvki,pvkl,pvlj->pij", equations.rows, weight, equations.rows)
    g = torch.einsum("pvki,pvkl,pvl->pi", equations.rows, weight, off)
    return A, g, torch.einsum("pvk,pvkl,pvl->p", off, weight, off)


def sharpen_metric(
    M: Float[Tensor, "p v 2 3"],
    t: Float[Tensor, "p v 2"],
    X: Float[Tensor, "p n 3"],
    w: Float[Tensor, "p v n"],
    view: Bool[Tensor, "p v"],
    model: str,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cameras and points of the frame that the equations, weighed by their noise, say is metric.

    Returns:
        Cameras, points, the misfit of the equations, and the information on the stretch of space (p, 5, 5), for noise 1 of the
        images.
    """
    sized = model == "orthographic"
    A, g, misfit = metric_information(metric_equations(M, t, model), X, w, view)
    for _ in range(_STEPS):
        B = _stretches(M)[: 6 if sized else 5]
        step, fine = solve(B @ A @ B.mT, (B @ g[..., None]))
        Q = _square(torch.where(fine[..., None], step[..., 0], 0) @ B)
        values, vectors, _ = eigh(Q + torch.eye(3, dtype=M.dtype, device=M.device))
        fine = fine & (values[..., 0] > 0.1)
        values = torch.where(fine[..., None], values, 1).sqrt()
        vectors = torch.where(fine[..., None, None], vectors, torch.eye(3, dtype=M.dtype, device=M.device))
        grow, shrink = ((vectors * f[..., None, :]) @ vectors.mT for f in (values, 1 / values))
        new, moved = M @ grow[:, None], X @ shrink
        found = metric_information(metric_equations(new, t, model), moved, w, view)
        better = found[2] < misfit
        M, X, A, g, misfit = (
            torch.where(better.reshape(-1, *(1,) * (a.ndim - 1)), a, b)
            for a, b in zip((new, moved, *found), (M, X, A, g, misfit), strict=True)
        )
    B = _stretches(M)
    A = B @ A @ B.mT
    shape, both, size = A[..., :5, :5], A[..., :5, 5:], A[..., 5:, 5:]
    return M, X, misfit, shape - both @ both.mT / size.clamp_min(_TINY) if sized else shape


def stretch_deviation(information: Float[Tensor, "p 5 5"]) -> Float[Tensor, "p"]:
    """Standard deviation of the stretch of space that is known least, for noise 1 of the images."""
    values = eigh(information)[0]
    known = values[..., 0] > _ROUNDING * values[..., -1]
    # Points go with a root of Q, which changes by half as much.
    return torch.where(known, 0.5 * values[..., 0].clamp_min(_TINY).rsqrt(), _OPEN)


def turn_deviation(
    M: Float[Tensor, "p v 2 3"], X: Float[Tensor, "p n 3"], w: Float[Tensor, "p v n"], information: Float[Tensor, "p 5 5"]
) -> Float[Tensor, "p v"]:
    """Standard deviation of the rotation of each view against the others in radians, for noise 1 of the images.

    Args:
        M: Metric cameras.
        X: The points that go with them.
        w: Weights of the observations.
        information: On the stretch of space, as in `sharpen_metric`.
    """
    i, j = torch.nn.functional.normalize(M, dim=-1).unbind(-2)
    k = torch.nn.functional.normalize(torch.linalg.cross(i, j), dim=-1)
    # Rows of cameras turn with their own noise, and with the frame.
    own = _row_covariance(X, w)
    off, along = ((a * (own @ a[..., None])[..., 0]).sum(-1) for a in (k, i + j))
    square = M.square().sum((-2, -1)).clamp_min(_TINY) / 2
    tilt = 0.5 * torch.stack((_form(k, i), _form(k, j)), -2) @ _stretches(M)[:5].mT
    shared = torch.einsum("pvra,pab,pvrb->pv", tilt, inverse(information)[0], tilt).clamp_min(0)
    return ((2 * off + along / 4) / square + shared).sqrt()


def _row_covariance(X: Float[Tensor, "p n 3"], w: Float[Tensor, "p v n"]) -> Float[Tensor, "p v 3 3"]:
    """Of each row of the cameras, by the scatter of the points that they see, for noise 1 of the images."""
    number = w.sum(-1, keepdim=True).clamp_min(_TINY)
    middle = w @ X / number
    scatter = torch.einsum("pvn,pni,pnj->pvij", w, X, X) - number[..., None] * middle[..., :, None] * middle[..., None, :]
    size = scatter.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp_min(_TINY)
    eye = torch.eye(3, dtype=X.dtype, device=X.device)
    return inverse(scatter / size + 1e-14 * eye)[0] / size


def _stretches(like: Tensor) -> Float[Tensor, "6 6"]:
    """Symmetric matrices of norm 1, by their upper triangles; the last changes the size alone."""
    r, h, e = 0.5**0.5, 6**-0.5, 3**-0.5
    basis = [
        (r, 0.0, 0.0, -r, 0.0, 0.0),
        (h, 0.0, 0.0, h, 0.0, -2 * h),
        (0.0, r, 0.0, 0.0, 0.0, 0.0),
        (0.0, 0.0, r, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, 0.0, r, 0.0),
        (e, 0.0, 0.0, e, 0.0, e),
    ]
    return like.new_tensor(basis)


def _square(q: Float[Tensor, "p 6"]) -> Float[Tensor, "p 3 3"]:
    i, j = torch.triu_indices(3, 3, device=q.device)
    Q = q.new_zeros(*q.shape[:-1], 3, 3)
    Q[..., i, j] = q
    Q[..., j, i] = q
    return Q


def _form(a: Float[Tensor, "*b 3"], b: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 6"]:
    """`a' Q b` as a row over the upper triangle of Q."""
    i, j = torch.triu_indices(3, 3, device=a.device)
    return torch.where(i == j, a[..., i] * b[..., j], a[..., i] * b[..., j] + a[..., j] * b[..., i])
