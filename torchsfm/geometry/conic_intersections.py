"""Common points and tangents: of conics with lines, with points and with each other."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.geometry.conics import dual_conic
from torchsfm.geometry.homogeneous import finite_or_zero, moderate_directions, to_homogeneous
from torchsfm.geometry.rotations import cross_matrix
from torchsfm.linalg import adjugate_3x3, cross, determinant_3x3, solve_cubic, unit_scale, usable

_STEPS = 3
"""Newton steps on a common point of two conics."""


def tangent_lines(
    C: Float[Tensor, "*#batch 3 3"], x: Float[Tensor, "*#batch n 2"]
) -> tuple[Float[Tensor, "*batch n 2 3"], Bool[Tensor, "*batch n"]]:
    """Both tangents from points to a conic.

    Args:
        C: Conics.
        x: Points.

    Returns:
        Two unit lines for each point, and whether they are real: the point lies outside, and the conic is not singular. A
        point on the conic has its tangent twice, if rounding leaves it outside.

    Example:
        >>> import torch, torchsfm
        >>> circle = torch.diag(torch.tensor([1.0, 1.0, -1.0]))
        >>> l, real = torchsfm.geometry.tangent_lines(circle, torch.tensor([[2.0, 0.0], [0.5, 0.0]]))
        >>> real, bool((l[0] @ torch.tensor([2.0, 0.0, 1.0])).abs().max() < 1e-6)
        (tensor([ True, False]), True)
    """
    check_tensors(C=(C, "3 3"), x=(x, "n 2"))
    return _conjugate_on(to_homogeneous(x), dual_conic(C)[..., None, :, :])


def intersect_line_conic(
    l: Float[Tensor, "*#batch n 3"],  # noqa: E741
    C: Float[Tensor, "*#batch 3 3"],
) -> tuple[Float[Tensor, "*batch n 2 3"], Bool[Tensor, "*batch n"]]:
    """Both points of lines on a conic.

    Args:
        l: Homogeneous lines.
        C: Conics.

    Returns:
        Two unit homogeneous points for each line, and whether they are real.

    Example:
        >>> import torch, torchsfm
        >>> circle = torch.diag(torch.tensor([1.0, 1.0, -1.0]))
        >>> l = torch.tensor([[0.0, 1.0, -0.6], [0.0, 1.0, -2.0]])  # y = 0.6 and y = 2
        >>> x, real = torchsfm.geometry.intersect_line_conic(l, circle)
        >>> (x[0, :, 0] / x[0, :, 2]).sort().values, real
        (tensor([-0.8000,  0.8000]), tensor([ True, False]))
    """
    check_tensors(l=(l, "n 3"), C=(C, "3 3"))
    return _conjugate_on(l, C[..., None, :, :])


def intersect_conics(
    C1: Float[Tensor, "*#batch 3 3"], C2: Float[Tensor, "*#batch 3 3"]
) -> Solutions[Float[Tensor, "*batch 4 3"]]:
    """The real common points of two conics.

    A pair of lines in the pencil `s C1 + t C2` (a root of its determinant) meets C1 where C2 does (HZ 2.2.3; Faugeras 1993). By
    duality, with dual conics: the common tangents.

    Args:
        C1: Conics.
        C2: Conics.

    Returns:
        Up to four points as unit homogeneous vectors, at infinity too; none where the conics are one. Points where the conics
        touch come twice, or not at all, as rounding has it. Computed in float64; differentiable (implicit function theorem).

    Example:
        >>> import torch, torchsfm
        >>> circle = torch.diag(torch.tensor([1.0, 1.0, -1.0]))
        >>> lying, standing = torch.diag(torch.tensor([0.25, 4.0, -1.0])), torch.diag(torch.tensor([1.0, 1.0, -9.0]))
        >>> torchsfm.geometry.intersect_conics(circle, lying).valid.sum()
        tensor(4)
        >>> torchsfm.geometry.intersect_conics(circle, standing).valid.sum()  # one inside the other
        tensor(0)
    """
    check_tensors(C1=(C1, "3 3"), C2=(C2, "3 3"))
    dtype = C1.dtype
    C1, C2 = torch.broadcast_tensors(C1.double(), C2.double())  # type: ignore[no-untyped-call]
    good = (usable(C1) & usable(C2)).all(-1).all(-1)
    eye = torch.eye(3, dtype=C1.dtype, device=C1.device)
    C1, C2 = (torch.where(good[..., None, None], C, eye) for C in (C1, C2))
    C1, C2 = (C * unit_scale(C) for C in (C1, C2))
    with torch.no_grad():
        # One conic, or none, has no common points to speak of.
        square, product = C2.square().sum((-2, -1), keepdim=True), (C1 * C2).sum((-2, -1), keepdim=True)
        rest = C1 * square - C2 * product
        good = good & (rest.abs().amax((-2, -1)) > 1e-12) & (C1.abs().amax((-2, -1)) > 0)
        y, valid = _common_points(C1.detach(), C2.detach())
        valid = valid & good[..., None]
    # A Newton step from the point leaves it where it is and carries the derivative.
    step = torch.where(valid[..., None], _step(y, C1, C2), 0.0)
    return Solutions((y + (step - step.detach())).to(dtype), valid)


def _step(y: Tensor, C1: Tensor, C2: Tensor) -> Tensor:
    """Newton's step towards a common point, along the sphere: n1.d = -f1, n2.d = -f2, y.d = 0 by Cramer's rule."""
    a, b = y @ C1, y @ C2
    f1, f2 = (0.5 * (v * y).sum(-1, keepdim=True) for v in (a, b))
    det = (cross(a, b) * y).sum(-1, keepdim=True)
    some = det.detach().abs() > 1e-12
    step = -(f1 * cross(b, y) + f2 * cross(y, a)) / torch.where(some, det, 1.0)
    return torch.where(some & (step.detach().abs().amax(-1, keepdim=True) < 0.1), step, 0.0)


def _common_points(C1: Tensor, C2: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vectors in four slots, and which are real common points."""
    # Two other members of the pencil, for none that is given may stand at infinity.
    A, B = 0.8 * C1 + 0.6 * C2, -0.6 * C1 + 0.8 * C2
    # det(A + t B) = det A + t <adj A', B> + t^2 <A, adj B'> + t^3 det B.
    c = [determinant_3x3(A), (adjugate_3x3(A).mT * B).sum((-2, -1)), (A * adjugate_3x3(B).mT).sum((-2, -1)), determinant_3x3(B)]
    t, real = solve_cubic(torch.stack(c, -1))
    size = (1 + t * t).rsqrt()[..., None, None]
    pairs = (A[..., None, :, :] + t[..., None, None] * B[..., None, :, :]) * size
    # A pair of real lines: minus the adjugate is the square of their common point.
    square = -adjugate_3x3(pairs)
    height, axis = square.diagonal(dim1=-2, dim2=-1).max(-1)
    norm = pairs.square().sum((-2, -1))
    best = torch.where(real & (norm > 1e-24), height / norm.clamp_min(1e-300), -1.0).argmax(-1, keepdim=True)

    def chosen(v: Tensor) -> Tensor:
        index = best.reshape(*best.shape, *[1] * (v.ndim - best.ndim)).expand(*best.shape, *v.shape[best.ndim :])
        return v.gather(best.ndim - 1, index).squeeze(best.ndim - 1)

    pair, square, height, axis, sure = (chosen(v) for v in (pairs, square, height, axis, real))
    norm = pair.square().sum((-2, -1))
    apart = (height > 0) & (norm > 1e-24) & sure
    p = square.gather(-1, axis[..., None, None].expand(*axis.shape, 3, 1))[..., 0]
    p = p / torch.where(apart, height, 1.0).sqrt()[..., None]
    product = pair + cross_matrix(p)  # of the two lines
    place = product.abs().flatten(-2).argmax(-1)
    row = product.gather(-2, (place // 3)[..., None, None].expand(*place.shape, 1, 3))[..., 0, :]
    column = product.gather(-1, (place % 3)[..., None, None].expand(*place.shape, 3, 1))[..., 0]
    lines = torch.stack((row, column), -2)
    y, real = _conjugate_on(lines, C1[..., None, :, :])
    y, valid = y.flatten(-3, -2), real.repeat_interleave(2, -1) & apart[..., None]
    for _ in range(_STEPS):
        y = y + _step(y, C1, C2)
        y = y / torch.linalg.vector_norm(y, dim=-1, keepdim=True)
    left = torch.stack([((y @ C) * y).sum(-1).abs() for C in (C1, C2)]).amax(0)
    valid = valid & (left < 1e-10)
    return torch.where(valid[..., None], y, _last_axis(y)), valid


def _last_axis(like: Tensor) -> Tensor:
    """The last axis, for slots without a solution."""
    last = torch.zeros_like(like)
    last[..., -1] = 1
    return last


def _conjugate_on(l: Tensor, C: Tensor) -> tuple[Tensor, Tensor]:  # noqa: E741
    """Both unit vectors y with l'y = 0 and y'Cy = 0, and whether they are real."""
    l = moderate_directions(finite_or_zero(l))  # noqa: E741
    l, C = torch.broadcast_tensors(l[..., None], C)[0][..., 0], C  # type: ignore[no-untyped-call]  # noqa: E741
    least = l.detach().abs().argmin(-1, keepdim=True)
    axis = torch.zeros_like(l).scatter(-1, least, 1.0)
    u = cross(l, axis)
    some = u.detach().square().sum(-1) > 0
    u = torch.where(some[..., None], u, axis)
    u = u / torch.linalg.vector_norm(u, dim=-1, keepdim=True)
    w = cross(u, l)
    w = torch.where(some[..., None], w, _last_axis(w))
    w = w / torch.linalg.vector_norm(w, dim=-1, keepdim=True)
    C = C * unit_scale(torch.where(usable(C), C, 0.0))
    Cu, Cw = ((C @ v[..., None])[..., 0] for v in (u, w))
    a, b, c = (u * Cu).sum(-1), (w * Cu).sum(-1), (w * Cw).sum(-1)
    # a s^2 + 2 b s t + c t^2 = 0: (s, t) = (-b -+ r, a) = (c, -b +- r), whichever does not cancel.
    disc = b * b - a * c
    real = some & (disc.detach() >= 0) & torch.isfinite(disc) & ((a.detach() != 0) | (b.detach() != 0) | (c.detach() != 0))
    positive = real & (disc.detach() > 0)
    root = torch.where(positive, torch.where(positive, disc, 1.0).sqrt(), 0.0)
    q = -(b + torch.where(b.detach() < 0, -root, root))
    first, second = torch.stack((q, a), -1), torch.stack((c, q), -1)
    # Only with b = 0 is q zero: then both are the one that is not zero.
    first, second = (torch.where((v.detach() == 0).all(-1, keepdim=True), o, v) for v, o in ((first, second), (second, first)))
    found = torch.stack((first, second), -2)
    found = found / torch.where(real[..., None, None], found.detach().abs().amax(-1, keepdim=True), 1.0)
    y = found[..., :1] * u[..., None, :] + found[..., 1:] * w[..., None, :]
    y = torch.where(real[..., None, None], y, _last_axis(y))
    return y / torch.linalg.vector_norm(y, dim=-1, keepdim=True), real
