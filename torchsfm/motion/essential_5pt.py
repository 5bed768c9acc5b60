"""Five rays in two calibrated cameras: E with d2' E d1 = 0 and 2 E E' E = tr(E E') E (Nister 2004)."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg import orthonormal_nullspace
from torchsfm.linalg.polynomial import companion_roots
from torchsfm.optim import attach_implicit, wants_derivative

# Monomials of degree 3 in Nister's order, as exponents of (x, y, z, 1).
_CUBICS = [
    "xxx",
    "yyy",
    "xxy",
    "xyy",
    "xxz",
    "xxw",
    "yyz",
    "yyw",
    "xyz",
    "xyw",
    "xzz",
    "xzw",
    "xww",
    "yzz",
    "yzw",
    "yww",
    "zzz",
    "zzw",
    "zww",
    "www",
]
_QUADRICS = ["xx", "yy", "zz", "ww", "xy", "xz", "xw", "yz", "yw", "zw"]
_LINEAR = "xyzw"
_TIMES = [[_CUBICS.index("".join(sorted(q + v, key=_LINEAR.index))) for q in _QUADRICS] for v in _LINEAR]
_I, _J = [0, 0, 0, 1, 1, 2], [1, 2, 3, 2, 3, 3]


def equations(
    E: Float[Tensor, "*#batch 3 3"], d1: Float[Tensor, "*#batch 5 3"], d2: Float[Tensor, "*#batch 5 3"]
) -> Float[Tensor, "*batch 15"]:
    """Fifteen equations of rank 9: d2' E d1 = 0 for each ray, 2 E E' E - tr(E E') E = 0, and |E|^2 = 2."""
    epipolar = (d2 * (d1 @ E.mT)).sum(-1)
    S = E @ E.mT
    trace = S.diagonal(dim1=-2, dim2=-1).sum(-1)
    cubic = (2 * S @ E - trace[..., None, None] * E).flatten(-2)
    gauge = trace[..., None] - 2
    shape = epipolar.shape[:-1]
    return torch.cat((epipolar, cubic.expand(*shape, 9), gauge.expand(*shape, 1)), -1)


def essential_5pt(
    d1: Float[Tensor, "*#batch 5 3"], d2: Float[Tensor, "*#batch 5 3"]
) -> Solutions[Float[Tensor, "*batch 10 3 3"]]:
    """The essential matrices with d2' E d1 = 0 for five rays, at most ten, with |E|^2 = 2 (Frobenius).

    Args:
        d1: Five rays of the first camera, of any length but 0.
        d2: The corresponding rays of the second camera.

    Returns:
        Ten slots. None is valid where the rays do not determine E (coinciding rays, a pure rotation) or are not finite. Computed
        in float64 whatever the dtype. Differentiable in both arguments.

    Raises:
        ValueError: Wrong shape, dtype or device.
    """
    check_tensors(d1=(d1, "5 3"), d2=(d2, "5 3"))
    E, valid = _solve(d1.detach(), d2.detach())
    if wants_derivative(d1, d2):
        E = attach_implicit(equations, E, d1[..., None, :, :], d2[..., None, :, :], dims=2, valid=valid)
    return Solutions(E, valid)


def _times_linear(q: Tensor, p: Tensor) -> Tensor:
    out = q.new_zeros(20, *torch.broadcast_shapes(q.shape[1:], p.shape[1:]))
    for k in range(4):
        out[_TIMES[k]] += q * p[k]
    return out


def _product(p: Tensor, q: Tensor) -> Tensor:
    return torch.cat((p * q, p[_I] * q[_J] + p[_J] * q[_I]))


def _constraints(basis: Tensor) -> Tensor:
    """The ten cubics (20 monomials, 10 equations, batch) of the basis (4, 3, 3, batch)."""
    S = [[_product(basis[:, i, 0], basis[:, j, 0]) for j in range(3)] for i in range(3)]
    for i in range(3):
        for j in range(i, 3):
            for m in (1, 2):
                S[i][j] = S[i][j] + _product(basis[:, i, m], basis[:, j, m])
            S[j][i] = S[i][j]
    half = 0.5 * (S[0][0] + S[1][1] + S[2][2])
    for i in range(3):
        S[i][i] = S[i][i] - half
    rows = []
    for i in range(3):
        for j in range(3):
            rows.append(sum(_times_linear(S[i][m], basis[:, m, j]) for m in range(3)))
    minor = [
        _product(basis[:, 1, j], basis[:, 2, k]) - _product(basis[:, 1, k], basis[:, 2, j]) for j, k in ((1, 2), (2, 0), (0, 1))
    ]
    rows.append(sum(_times_linear(minor[j], basis[:, 0, j]) for j in range(3)))
    return torch.stack(rows, 1)


def _solve(d1: Tensor, d2: Tensor) -> tuple[Tensor, Tensor]:
    dtype = d1.dtype
    d1, d2 = torch.broadcast_tensors(d1.double(), d2.double())
    batch = d1.shape[:-2]
    d1, d2 = d1.reshape(-1, 5, 3), d2.reshape(-1, 5, 3)
    count = d1.shape[0]
    finite = torch.isfinite(d1).all(-1).all(-1) & torch.isfinite(d2).all(-1).all(-1)
    rays = []
    for d in (d1, d2):
        d = torch.where(finite[:, None, None], d, 0)
        norm = (d * d).sum(-1, keepdim=True).sqrt()
        finite = finite & (norm > 0).all(-1).all(-1)
        rays.append(d / torch.where(norm > 0, norm, 1))
    A = (rays[1][..., :, None] * rays[0][..., None, :]).flatten(-2)
    basis = orthonormal_nullspace(A).permute(2, 1, 0).reshape(4, 3, 3, count)
    M = _constraints(basis).permute(2, 1, 0)
    C, info = torch.linalg.solve_ex(M[..., :10], M[..., 10:])
    regular = (info == 0) & torch.isfinite(C).all(-1).all(-1) & finite
    C = torch.where(regular[:, None, None], C, 0)
    # Rows x^2 z - z x^2, y^2 z - z y^2, xyz - z xy: three equations linear in (x, y, 1), polynomials in z.
    rows = []
    for top in (4, 6, 8):
        a, b = C[:, top], C[:, top + 1]
        px = torch.stack((a[:, 2], a[:, 1] - b[:, 2], a[:, 0] - b[:, 1], -b[:, 0]), -1)
        py = torch.stack((a[:, 5], a[:, 4] - b[:, 5], a[:, 3] - b[:, 4], -b[:, 3]), -1)
        pw = torch.stack((a[:, 9], a[:, 8] - b[:, 9], a[:, 7] - b[:, 8], a[:, 6] - b[:, 7], -b[:, 6]), -1)
        rows.append((px, py, pw))

    def times(p: Tensor, q: Tensor) -> Tensor:
        out = p.new_zeros(count, p.shape[1] + q.shape[1] - 1)
        for i in range(p.shape[1]):
            out[:, i : i + q.shape[1]] += p[:, i : i + 1] * q
        return out

    (a0, a1, a2), (b0, b1, b2), (c0, c1, c2) = rows
    n0 = times(b1, c2) - times(b2, c1)
    n1 = times(b2, c0) - times(b0, c2)
    n2 = times(b0, c1) - times(b1, c0)
    poly = times(a0, n0) + times(a1, n1) + times(a2, n2)
    z, real = companion_roots(poly)
    z = z.contiguous()
    powers = torch.stack([torch.ones_like(z), z, z * z, z * z * z, z * z * z * z], -1)
    B = torch.stack([torch.stack([powers[..., : p.shape[-1]] @ p[:, :, None] for p in row], -1)[..., 0, :] for row in rows], -2)
    # The null vector (x, y, 1): the largest of the cross products of two rows.
    n = torch.stack([torch.linalg.cross(B[..., i, :], B[..., j, :]) for i, j in ((0, 1), (1, 2), (2, 0))], -2)
    best = (n * n).sum(-1).argmax(-1)
    n = n.gather(-2, best[..., None, None].expand(*best.shape, 1, 3))[..., 0, :]
    u = torch.stack((n[..., 0], n[..., 1], z * n[..., 2], n[..., 2]), -1)
    u = u / (u * u).sum(-1, keepdim=True).sqrt()
    u = torch.where(torch.isfinite(u), u, 0)
    u, error = _polish(M, u)
    E = (
        u @ basis.permute(2, 0, 1, 3).reshape(4, 9, count).permute(2, 0, 1)
        if False
        else torch.einsum("bsk,kijb->bsij", u, basis)
    )
    norm = (E * E).sum((-2, -1), keepdim=True)
    E = E * (2 / norm).sqrt()
    valid = real & regular[:, None] & (error < 1e-9) & torch.isfinite(E).all(-1).all(-1)
    E = torch.where(valid[..., None, None], E, torch.eye(3, dtype=E.dtype, device=E.device))
    return E.to(dtype).reshape(*batch, 10, 3, 3), valid.reshape(*batch, 10)


def _monomials(u: Tensor) -> tuple[Tensor, Tensor]:
    """Values (..., 20) and gradients (..., 20, 4) of the cubic monomials at u (..., 4)."""
    index = torch.tensor([[_LINEAR.index(v) for v in m] for m in _CUBICS], device=u.device)
    f = u[..., index]
    value = f.prod(-1)
    gradient = torch.zeros(*u.shape[:-1], 20, 4, dtype=u.dtype, device=u.device)
    for k in range(3):
        part = f[..., (k + 1) % 3] * f[..., (k + 2) % 3]
        gradient = gradient.scatter_add(-1, index[:, k : k + 1].expand(*u.shape[:-1], 20, 1), part[..., None])
    return value, gradient


def _polish(M: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Gauss-Newton on the ten cubics over the unit sphere; the residual at the end."""
    for _ in range(3):
        value, gradient = _monomials(u)
        r = value @ M.mT
        J = M[:, None] @ gradient
        # |u| stays 1: the row u' du = 0 makes the normal matrix regular.
        N = J.mT @ J + u[..., :, None] * u[..., None, :]
        step, info = torch.linalg.solve_ex(N, J.mT @ r[..., None])
        new = u - step[..., 0]
        new = new / (new * new).sum(-1, keepdim=True).sqrt()
        error_new = (_monomials(new)[0] @ M.mT).abs().amax(-1)
        better = error_new < r.abs().amax(-1)
        u = torch.where(better[..., None], new, u)
    return u, (_monomials(u)[0] @ M.mT).abs().amax(-1)
