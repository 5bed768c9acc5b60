"""Smallest eigenvectors of 4x4 matrices and steps on the unit sphere, the batch in the last dimensions, without LAPACK."""

import torch
from torch import Tensor


def smallest_eigenvector(N: Tensor) -> Tensor:
    """A unit vector (4, *b) near the eigenvector of the smallest eigenvalue of positive semidefinite N (4, 4, *b).

    Inverse iteration to the twelfth power, from the largest column of the inverse's square, which cannot be orthogonal to it.
    Not polished; that is what `tangent_step` is for.
    """
    trace = N[0, 0] + N[1, 1] + N[2, 2] + N[3, 3]
    M = inverse(N / torch.where(trace > 0, trace, 1.0), 4e-16)
    M = M / (M[0, 0] + M[1, 1] + M[2, 2] + M[3, 3])
    M = (M[:, :, None] * M[None]).sum(1)
    diagonal = torch.stack((M[0, 0], M[1, 1], M[2, 2], M[3, 3]))
    largest, pick = diagonal.max(0)
    M = M / largest
    x: Tensor = M.gather(0, pick.expand(1, 4, *pick.shape))[0]
    for _ in range(5):
        x = (M * x).sum(1)
    return x * (x * x).sum(0).rsqrt()


def tangent_step(x: Tensor, N: Tensor, g: Tensor, damping: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """The unit vector that a Newton step on the sphere leads to.

    Args:
        x: Unit vectors (4, *b).
        N: Symmetric matrices (4, 4, *b), used on the tangent space of x only.
        g: Gradients (4, *b), used likewise.
        damping: Added to N's diagonal in the tangent space, relative to it (*b).

    Returns:
        The new unit vector; the decrease `g' S^-1 g` a full step promises; the smallest pivot of S against its trace.
    """
    sign = torch.copysign(torch.ones_like(x[3]), x[3])
    v = torch.cat((x[:3], (x[3] + sign)[None]))
    beta = 1 / (1 + x[3].abs())
    Nv = (N * v).sum(1)
    u = beta * Nv - (0.5 * beta * beta * (v * Nv).sum(0)) * v
    vg = beta * (v * g).sum(0)
    s = {(i, j): N[i, j] - v[i] * u[j] - u[i] * v[j] for i in range(3) for j in range(i, 3)}
    h = [g[i] - v[i] * vg for i in range(3)]
    trace = s[0, 0] + s[1, 1] + s[2, 2]
    floor = 1e-16 * trace.clamp_min(0) + 1e-300
    more = 1.0 if damping is None else 1 + damping
    # L D L' of the 3x3 matrix.
    d0 = torch.maximum(s[0, 0] * more, floor)
    l10, l20 = s[0, 1] / d0, s[0, 2] / d0
    d1 = torch.maximum(s[1, 1] * more - l10 * s[0, 1], floor)
    k = s[1, 2] - l10 * s[0, 2]
    l21 = k / d1
    d2 = torch.maximum(s[2, 2] * more - l20 * s[0, 2] - l21 * k, floor)
    y1 = h[1] - l10 * h[0]
    y2 = h[2] - l20 * h[0] - l21 * y1
    z0, z1, z2 = h[0] / d0, y1 / d1, y2 / d2
    decrease = h[0] * z0 + y1 * z1 + y2 * z2
    p2 = z2
    p1 = z1 - l21 * p2
    p0 = z0 - l10 * p1 - l20 * p2
    # Back from the reflected frame, in which x is the last basis vector times -sign.
    q = torch.stack((-p0, -p1, -p2, -sign))
    new = q - v * (beta * (v * q).sum(0))
    new = new * (new * new).sum(0).rsqrt()
    smallest = torch.minimum(torch.minimum(d0, d1), d2) / trace.clamp_min(1e-300)
    good = torch.isfinite(new.detach()).all(0)
    return torch.where(good, new, x), decrease, smallest


def inverse(N: Tensor, shift: float = 0.0) -> Tensor:
    """The inverse of positive definite N + shift I, N about 1, by L D L', which needs no pivoting there."""
    floor = 1e-17
    d0 = (N[0, 0] + shift).clamp_min(floor)
    l1, l2, l3 = N[0, 1] / d0, N[0, 2] / d0, N[0, 3] / d0
    d1 = (N[1, 1] + shift - l1 * N[0, 1]).clamp_min(floor)
    a2, a3 = N[1, 2] - l1 * N[0, 2], N[1, 3] - l1 * N[0, 3]
    m2, m3 = a2 / d1, a3 / d1
    d2 = (N[2, 2] + shift - l2 * N[0, 2] - m2 * a2).clamp_min(floor)
    b3 = N[2, 3] - l2 * N[0, 3] - m2 * a3
    n3 = b3 / d2
    d3 = (N[3, 3] + shift - l3 * N[0, 3] - m3 * a3 - n3 * b3).clamp_min(floor)
    # The inverse of the unit lower triangle.
    k20 = m2 * l1 - l2
    k31 = n3 * m2 - m3
    k30 = -(l3 - m3 * l1 + n3 * k20)
    zero, one = torch.zeros_like(d0), torch.ones_like(d0)
    rows = (
        torch.stack((one, zero, zero, zero)) * d0.rsqrt(),
        torch.stack((-l1, one, zero, zero)) * d1.rsqrt(),
        torch.stack((k20, -m2, one, zero)) * d2.rsqrt(),
        torch.stack((k30, k31, -n3, one)) * d3.rsqrt(),
    )
    K = torch.stack(rows)
    return (K[:, :, None] * K[:, None]).sum(0)


def symmetric(upper: dict[tuple[int, int], Tensor]) -> Tensor:
    """A symmetric matrix (4, 4, *b) from its upper half."""
    rows = [torch.stack([upper[min(i, j), max(i, j)] for j in range(4)]) for i in range(4)]
    return torch.stack(rows)
