"""Images of conics made ready: each of unit size, in a world in which the conic has about unit size too; and first guesses."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.geometry.conic_distance import square_root
from torchsfm.geometry.conics import ellipse_of_shape, shape_of_dual_conic
from torchsfm.geometry.quadrics import dual_of_shape, shape_of_dual_quadric
from torchsfm.linalg import adjugate_3x3, eigh, null_vector, unit_scale, usable
from torchsfm.triangulation.conics_2view import conics_2view, image_normalisation, in_front
from torchsfm.triangulation.outlines import Shape, Sights
from torchsfm.triangulation.triangulate_points_dlt import triangulate_points_dlt

_POINTS = 16
"""Points on a measured ellipse that stand for the edge points it was fitted to, where these are not given."""
_PAIRS = [(i, j) for i in range(4) for j in range(i, 4)]


@dataclass(frozen=True)
class ConicImages:
    """Conics in the batch, their views next. Lengths are `scale` times those of the ready world, whose origin is `origin`."""

    P: Float[Tensor, "*batch v 3 4"]
    dual: Float[Tensor, "*batch v 3 3"]
    seen: Bool[Tensor, "*batch v"]
    sights: Sights
    weights: Float[Tensor, "*batch k"]
    origin: Float[Tensor, "*batch 3"]
    scale: Float[Tensor, "*batch"]
    broken: Bool[Tensor, "*batch"]
    """Where something that is wanted is not finite."""
    ready: Bool[Tensor, "*batch"]
    """Where all images are ellipses, and their centres meet somewhere."""
    measured: bool
    """Whether edge points were given, or covariances: not only the ellipses."""


def prepare(
    C: Tensor, P: Tensor, seen: Tensor, x: Tensor | None, weights: Tensor | None, covariance: Tensor | None
) -> ConicImages:
    """Everything in float64, (*batch, v, ...)."""
    sound = usable(C).all(-1).all(-1) & usable(P).all(-1).all(-1)
    if x is not None:
        weights = torch.ones_like(x[..., 0]) if weights is None else weights
        absent = weights.detach() == 0
        fine = (x.detach().abs() < 1e12).all(-1) & (weights.detach() > 1e-30) & (weights.detach() < 1e30)
        sound = sound & (fine | absent).all(-1)
        weights = torch.where(fine, weights, 0.0)
        x = torch.where(fine[..., None], x, 0.0)
    if covariance is not None:
        sound = sound & usable(covariance).all(-1).all(-1)
    broken = (seen & ~sound).any(-1)
    seen = seen & ~broken[..., None]
    C = torch.where(seen[..., None, None], C, torch.diag(C.new_tensor([1.0, 1.0, -1.0])))
    P = torch.where(seen[..., None, None], P, torch.eye(3, 4, dtype=P.dtype, device=P.device))
    dual = adjugate_3x3(C * unit_scale(C))
    centre, D, ellipses = shape_of_dual_conic(dual)
    N = image_normalisation(dual)
    unit = 1 / N[..., 0, 0]
    with torch.no_grad():
        origin, scale, placed = _place(P, centre, D, seen)
        world = torch.diag_embed(torch.stack((scale, scale, scale, torch.ones_like(scale)), -1))
        world[..., :3, 3] = origin
    P = N @ P @ world[..., None, :, :]
    P = P * unit_scale(P)
    moved = N[..., :2, 2] + centre / unit[..., None]
    D = D / unit.square()[..., None, None]
    if covariance is not None:
        sights, counts = _touching(P, moved, D, unit, covariance)
        counts = torch.where(seen[..., None], counts, 0.0)
    else:
        if x is None or weights is None:
            t = torch.arange(_POINTS, dtype=P.dtype, device=P.device) * (2 * math.pi / _POINTS)
            y = moved[..., None, :] + torch.stack((t.cos(), t.sin()), -1) @ square_root(D)
            counts = torch.ones_like(y[..., 0])
        else:
            y, counts = x / unit[..., None, None] + N[..., None, :2, 2], weights
        counts = torch.where(seen[..., None], counts, 0.0)
        sights = Sights(P, torch.where((counts.detach() > 0)[..., None], y, 0.0), unit)
    ready = placed & (ellipses | ~seen).all(-1)
    return ConicImages(
        P, N @ dual @ N.mT, seen, sights, counts.flatten(-2), origin, scale, broken, ready,
        x is not None or covariance is not None,
    )  # fmt: skip


def _place(P: Tensor, centre: Tensor, D: Tensor, seen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """About where the conics are, from their centres, and about how large."""
    X = triangulate_points_dlt(centre[..., None, :], P, visible=seen[..., None])[..., 0, :]
    p = (P[..., :3] @ X[..., None, :, None])[..., 0] + P[..., 3]
    depth = p[..., 2:]
    image = p[..., :2] / torch.where(depth != 0, depth, 1.0)
    slope = (P[..., :2, :3] - image[..., None] * P[..., 2:, :3]) / torch.where(depth != 0, depth, 1.0)[..., None]
    size = D.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt() / torch.linalg.matrix_norm(slope).clamp_min(1e-300)
    some = seen & torch.isfinite(size) & (size > 0)
    size = torch.where(some, size.clamp(1e-100, 1e100).log(), 0.0).sum(-1) / some.sum(-1).clamp_min(1)
    size = size.exp()
    good = some.any(-1) & (X.abs() < 1e8 * size[..., None]).all(-1) & (size > 1e-30) & (size < 1e30)
    return torch.where(good[..., None], X, 0.0), torch.where(good, size, 1.0), good


def _touching(P: Tensor, centre: Tensor, D: Tensor, unit: Tensor, covariance: Tensor) -> tuple[Sights, Tensor]:
    """Five lines that touch each measured ellipse, which say as much as it does, whitened."""
    t = torch.arange(5, dtype=P.dtype, device=P.device) * (0.4 * math.pi)
    n = torch.stack((t.cos(), t.sin()), -1).expand(*D.shape[:-2], 5, 2)
    support = ((n @ D) * n).sum(-1).sqrt()
    with torch.no_grad():
        ellipse = ellipse_of_shape(centre, D)
        q = n @ square_root(D) / support[..., None]
        a, b = ellipse.semi_axes.unbind(-1)
        cos, sin = ellipse.angle.cos()[..., None], ellipse.angle.sin()[..., None]
        na, nb = n[..., 0] * cos + n[..., 1] * sin, n[..., 1] * cos - n[..., 0] * sin
        qa, qb = q[..., 0] * cos + q[..., 1] * sin, q[..., 1] * cos - q[..., 0] * sin
        turn = torch.maximum(a - b, 1e-9 * a)[..., None] * unit[..., None]
        G = torch.stack((n[..., 0], n[..., 1], na * qa, nb * qb, turn * (na * qb + nb * qa)), -1)
        factor, info = torch.linalg.cholesky_ex(G @ covariance @ G.mT)
        eye = torch.eye(5, dtype=P.dtype, device=P.device)
        good = (info == 0) & torch.isfinite(factor).all(-1).all(-1)
        white = torch.linalg.solve_triangular(
            torch.where(good[..., None, None], factor, eye), eye.expand_as(factor), upper=False
        )
        good = good & torch.isfinite(white).all(-1).all(-1)
        white = torch.where(good[..., None, None], white, eye) * unit[..., None, None]
    support = support + (n * centre[..., None, :]).sum(-1)
    return Sights(P, n, unit, white, support), good[..., None].to(P.dtype).expand(*good.shape, 5)


def first_guess(images: ConicImages, m: int) -> tuple[Shape, Tensor]:
    """The best of the linear solution and, for ellipses, those of two views; and where there is one at all."""
    P, seen = images.P, images.seen
    v = seen.shape[-1]
    several = seen.sum(-1) > 2
    Q, fine = _linear(P, images.dual, seen)
    candidates = [Q]
    allowed = [fine & several]
    if m == 2 and v > 1:
        first = seen.to(torch.int8).argmax(-1, keepdim=True)
        last = v - 1 - seen.flip(-1).to(torch.int8).argmax(-1, keepdim=True)
        P1, P2 = (P.gather(-3, i[..., None, None].expand(*i.shape, 3, 4))[..., 0, :, :] for i in (first, last))
        C1, C2 = (
            adjugate_3x3(images.dual.gather(-3, i[..., None, None].expand(*i.shape, 3, 3))[..., 0, :, :]) for i in (first, last)
        )
        pair = conics_2view(C1, C2, P1, P2)
        two = pair.valid & (first != last)
        for k in range(2):
            Q = pair.model[..., k, :, :]
            # Seen from one side; a third view knows better.
            candidates.append(Q)
            allowed.append(two[..., k] & (several | _same_side(Q, P1, P2)))
    shapes, costs = [], []
    for Q, good in zip(candidates, allowed, strict=True):
        shape, real = shape_of(Q, m)
        r, _ = images.sights.linearize(shape)
        w = images.weights
        cost = torch.where(w > 0, r[..., 0].square() * w, 0.0).sum(-1)
        dual = dual_of_shape(shape.centre, shape.axes() @ shape.axes().mT)
        hidden = torch.stack([seen[..., i] & ~in_front(P[..., i, :, :], dual) for i in range(v)], -1).any(-1)
        shapes.append(shape)
        costs.append(torch.where(good & real & torch.isfinite(cost), cost * torch.where(hidden, 1e30, 1.0), torch.inf))
    cost, index = torch.stack(costs, -1).min(-1)

    def chosen(name: str) -> Tensor:
        stack = torch.stack([getattr(shape, name) for shape in shapes], index.ndim)
        place = index.reshape(*index.shape, *[1] * (stack.ndim - index.ndim))
        return stack.gather(index.ndim, place.expand(*index.shape, 1, *stack.shape[index.ndim + 1 :])).squeeze(index.ndim)

    return Shape(chosen("centre"), chosen("frame"), chosen("root")), torch.isfinite(cost)


def _linear(P: Tensor, dual: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """The q that makes all `P Q* P'` as nearly parallel as can be to the measured dual conics, scales projected out."""
    columns = []
    for i, j in _PAIRS:
        M = P[..., :, i, None] * P[..., None, :, j]
        columns.append(M if i == j else (M + M.mT) * math.sqrt(0.5))
    rows = torch.stack([_six(M) for M in columns], -1)
    c = _six(dual)
    c = c / torch.linalg.vector_norm(c, dim=-1, keepdim=True).clamp_min(1e-300)
    rows = rows - c[..., :, None] * (c[..., None, :] @ rows)
    rows = torch.where(seen[..., None, None], rows, 0.0).flatten(-3, -2)
    if rows.shape[-2] < 10:
        rows = torch.nn.functional.pad(rows, (0, 0, 0, 10 - rows.shape[-2]))
    q, fine = null_vector(rows)
    Q = q.new_zeros(*q.shape[:-1], 4, 4)
    for k, (i, j) in enumerate(_PAIRS):
        Q[..., i, j] = Q[..., j, i] = q[..., k] if i == j else q[..., k] * math.sqrt(0.5)
    return Q, fine


def _six(M: Tensor) -> Tensor:
    """A symmetric 3x3 matrix as six numbers with the same norm."""
    off = math.sqrt(2.0)
    mixed = off * M[..., 0, 1], off * M[..., 0, 2], off * M[..., 1, 2]
    return torch.stack((M[..., 0, 0], M[..., 1, 1], M[..., 2, 2], *mixed), -1)


def shape_of(Q: Tensor, m: int) -> tuple[Shape, Tensor]:
    """The ellipse (m = 2) or ellipsoid (m = 3) of a dual quadric, and whether it is real; else the unit circle or sphere."""
    centre, D, fine = shape_of_dual_quadric(Q)
    values, vectors, ok = eigh(D)
    squares, V = values.flip(-1)[..., :m], vectors.flip(-1)[..., :m]
    real = fine & ok & (squares > 1e-12 * squares[..., :1]).all(-1) & (squares[..., 0] > 0) & (squares[..., 0] < 1e12)
    real = real & (centre.abs() < 1e6).all(-1)
    eye = torch.eye(3, m, dtype=Q.dtype, device=Q.device)
    lengths = torch.where(real[..., None], squares, 1.0).clamp_min(1e-300).sqrt()
    centre = torch.where(real[..., None], centre, 0.0)
    V = torch.where(real[..., None, None], V, eye)
    if m == 2:
        return Shape(centre, V, torch.diag_embed(lengths)), real
    return Shape(centre, eye.expand_as(V), V @ torch.diag_embed(lengths) @ V.mT), real


def _same_side(Q: Tensor, P1: Tensor, P2: Tensor) -> Tensor:
    """Whether two camera centres are on the same side of the plane of a conic."""
    plane, _ = null_vector(Q)
    sides = []
    for P in (P1, P2):
        c, _ = null_vector(P)
        sides.append((plane * c).sum(-1) * c[..., 3])
    return sides[0] * sides[1] > 0
