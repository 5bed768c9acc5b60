"""Where an ellipse that is fitted to the outline of a circle has its centre: in the picture of a plane, through any lens.

The middle of a circle is not seen in the middle of its outline, and through a lens the outline is no ellipse. The least-squares
ellipse of its points is, to first order, p_i = m + a cos + b sin of their own harmonics, moved along the normals n_i by what
these leave: its centre is a sum of K_i p_i with 2 x 2 matrices K_i, which add to the identity.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

POINTS = 16
"""On each outline; more change nothing that is smooth."""
_RIDGE = 1e-9
"""Of the one freedom that moves the points along the ellipse alone."""


def circle_points(X: Float[Tensor, "*batch n 2"], radius: float) -> Float[Tensor, "*batch m 2"]:
    """Points on the outlines of circles with the centres X, one circle after the other."""
    wave = _wave(X)
    around: Tensor = X[..., None, :] + radius * wave[1:].mT
    return around.flatten(-3, -2)


def centre_weights(p: Float[Tensor, "2 *n"]) -> Float[Tensor, "2 2 *n"]:
    """What the points of outlines, `POINTS` in a row, count for the centres of their ellipses: centre = sum of K_i p_i."""
    wave = _wave(p)
    with torch.no_grad():
        x = p.detach().reshape(*p.shape[:-1], -1, POINTS).movedim(0, -2)
        # Harmonics of the two coordinates, and the normals by which they turn.
        a, b = (x @ wave[k] * (2 / POINTS) for k in (1, 2))
        tangent = b[..., None] * wave[1] - a[..., None] * wave[2]
        length = torch.linalg.vector_norm(tangent, dim=-2, keepdim=True).clamp_min(1e-300)
        normal = torch.cat((tangent[..., 1:, :], -tangent[..., :1, :]), -2) / length
        # Centre and both harmonics, of both coordinates.
        G = (wave[:, None, :] * normal[..., None, :, :]).flatten(-3, -2)
        weighed = G * length
        N = weighed @ G.mT
        ridge = _RIDGE * N.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
        eye = torch.eye(6, dtype=p.dtype, device=p.device)
        W = torch.linalg.solve_ex(N + ridge * eye, weighed).result[..., :2, :]
        K = W[..., :, None, :] * normal[..., None, :, :]
        weights: Tensor = K.movedim((-3, -2), (0, 1)).flatten(-2)
    return weights


def outline_centres(K: Float[Tensor, "2 2 *#n m"], p: Float[Tensor, "2 *#n m"]) -> Float[Tensor, "2 *n _"]:
    """Sums of K_i p_i over each outline, of points or of their derivatives."""
    both = (K * p[None]).sum(1)
    centres: Tensor = both.reshape(*both.shape[:-1], -1, POINTS).sum(-1)
    return centres


def _wave(like: Tensor) -> Tensor:
    """1, cosine and sine around a circle."""
    at = torch.arange(POINTS, dtype=like.dtype, device=like.device) * (2 * math.pi / POINTS)
    return torch.stack((torch.ones_like(at), at.cos(), at.sin()))
