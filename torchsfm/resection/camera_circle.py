"""The camera that sees a circle of known radius as a given conic.

The rays through the circle make a cone `d'Cd = 0` of second order. With its eigenvalues `a >= b > 0 > c` two families of planes
cut circles from it; their normals are `sqrt((a - b) / (a - c)) e_a +- sqrt((b - c) / (a - c)) e_c`. The centre is the pole of
the plane, and on it the cone is b times the identity, so that the plane's distance follows from the radius.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.linalg import cross, eigh, unit_scale, usable

_RANK = 1e-12
"""The smallest eigenvalue, relative to the largest, of what is a cone."""
_ROUND = 1e-9
"""The difference of the two positive ones, relative to them, of a cone that is round: both solutions are one."""


def camera_circle(
    C: Float[Tensor, "*#batch 3 3"], radius: Float[Tensor, "*#batch"]
) -> Solutions[Float[Tensor, "*batch 2 3 4"]]:
    """Both cameras that may see a circle in the plane z = 0 around the origin.

    A turn about the circle's axis cannot be seen: x is to be as far along the camera's x as can be. The circle is seen from
    the side of negative z.

    Args:
        C: The conic of the rays, `K' C K` of the conic C of pixels, of any scale and sign.
        radius: Of the circle, greater than 0.

    Returns:
        `[R | t]`, in front of which the circle is. None where C is no real cone or the radius not positive; the second is
        not valid where it is the first, as for a circle that is seen from its axis. Computed in float64. The derivatives are
        those of the closed form; a circle seen from its axis has none.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit.

    Example:
        >>> import torch, torchsfm
        >>> t = torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64)
        >>> turn = torch.tensor([0.5, 0.0, 0.0], dtype=t.dtype)
        >>> P = torchsfm.Pose(torchsfm.geometry.rotation_from_rotvec(turn), t).matrix()  # a circle seen aslant
        >>> H = torch.stack((P[:, 0], P[:, 1], P[:, 3]), 1)  # rays from the plane z = 0
        >>> C = torchsfm.geometry.transform_conic(H, torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=t.dtype)))
        >>> poses = torchsfm.resection.camera_circle(C, torch.tensor(1.0, dtype=t.dtype))
        >>> poses.valid, bool((poses.model - P).abs().amax((-2, -1)).min() < 1e-6)  # the true one is there
        (tensor([True, True]), True)
    """
    batch = check_tensors(C=(C, "3 3"), radius=(radius, ""))
    dtype = C.dtype
    Q, r = C.double().expand(*batch, 3, 3), radius.double().expand(batch)
    good = usable(Q).all(-1).all(-1) & usable(r) & (r.detach() > 0)
    some = torch.diag(torch.tensor([2.0, 1.0, -1.0], dtype=Q.dtype, device=Q.device))
    Q = torch.where(good[..., None, None], 0.5 * (Q + Q.mT), some)
    Q = Q * unit_scale(Q)
    with torch.no_grad():
        values, _, ok = eigh(Q)
        # Two of one sign: the middle one tells which.
        sign = torch.where(values[..., 1] > 0, 1.0, -1.0)
        least, size = values.abs().amin(-1), values.abs().amax(-1)
        good = good & ok & (values[..., 0] * values[..., 2] < 0) & (least > _RANK * size)
        a, b = torch.where(sign[..., None] > 0, values[..., 1:].flip(-1), -values[..., :2]).unbind(-1)
        single = good & (a - b <= _ROUND * a)
    Q = torch.where(good[..., None, None], sign[..., None, None] * Q, some)
    # Equal eigenvalues have eigenvectors without derivatives.
    Q = torch.where(single[..., None, None], Q.detach(), Q)
    values, vectors, _ = eigh(Q)
    c, b, a = values.unbind(-1)
    narrow = torch.where(single, 0.0, (a - b) / (a - c))
    first = torch.where(single, 0.0, torch.where(single, 1.0, narrow).clamp_min(1e-300).sqrt())[..., None] * vectors[..., 2]
    last = (1 - narrow).sqrt()[..., None] * vectors[..., 0]
    n = torch.stack((last + first, last - first), -2)
    inverse = (vectors / values[..., None, :]) @ vectors.mT
    pole = n @ inverse
    # n'Q^-1 n is negative: the plane's axis is inside the cone.
    height = -(n * pole).sum(-1)
    centre = pole * (-r[..., None] * (b[..., None] / height.clamp_min(1e-300)).sqrt())[..., None]
    behind = centre.detach()[..., 2:] < 0
    centre = torch.where(behind, -centre, centre)
    n = torch.where((n.detach() * centre.detach()).sum(-1, keepdim=True) < 0, -n, n)
    cameras = torch.cat((_turned(n), centre[..., None]), -1)
    valid = torch.stack((good, good & ~single), -1) & torch.isfinite(cameras.detach()).all(-1).all(-1)
    valid = valid & torch.isfinite(cameras.detach().to(dtype)).all(-1).all(-1)
    eye = torch.eye(3, 4, dtype=Q.dtype, device=Q.device)
    return Solutions(torch.where(valid[..., None, None], cameras, eye).to(dtype), valid)


def _turned(n: Tensor) -> Tensor:
    """Rotations with third columns n and first columns nearest to the x axis, or to the y axis where that is along n."""
    along = n.detach()[..., :1].abs() > 0.999
    axis = torch.zeros_like(n)
    axis[..., 0:1], axis[..., 1:2] = torch.where(along, 0.0, 1.0), torch.where(along, 1.0, 0.0)
    u = axis - (axis * n).sum(-1, keepdim=True) * n
    u = u / torch.linalg.vector_norm(u, dim=-1, keepdim=True)
    return torch.stack((u, cross(n, u), n), -1)
