"""How sure a calibration from views of a plane is, by what its residuals say."""

from dataclasses import replace

import torch
from torch import Tensor

from torchsfm.autocalibration.plane_problem import PlaneProblem
from torchsfm.autocalibration.plane_start import CameraAndPoses
from torchsfm.geometry.intrinsic_parameters import HEAD
from torchsfm.linalg import eigh, qr

_RANK = 1e-8
"""Part of the largest information of one view below which it has none."""


def without_lens(
    problem: PlaneProblem, at: tuple[CameraAndPoses, Tensor, Tensor], residual: Tensor, w: Tensor, used: Tensor
) -> Tensor:
    """The covariance that the intrinsics had for such residuals if the lens were known not to bend.

    What a lens bends tells of the camera, too, but along a valley that no covariance shows: planes must do without.
    """
    u, x, X = at
    columns = torch.arange(u.row.shape[-1], device=u.row.device)
    _, J = problem.linearize(replace(u, row=torch.where(columns < HEAD, u.row, 0.0)), x, X)
    free = problem.projection.free
    head = sum(column < HEAD for column in free)
    J = torch.cat((J[..., :head], J[..., len(free) :]), -1)
    return plane_covariance(residual, J, w, head + problem.shared - len(free), x.shape[1], used)[0]


def plane_covariance(residual: Tensor, J: Tensor, w: Tensor, q: int, v: int, used: Tensor) -> tuple[Tensor, Tensor]:
    """Covariances of intrinsics and of each pose, scaled by the residuals."""
    J = J * w.sqrt()[..., None, None]
    A = J.flatten(1, 2)
    information = A.mT @ A
    scale = information.diagonal(dim1=-2, dim2=-1)
    live = scale > 0
    scale = torch.where(live, scale, 1.0).rsqrt()
    information = scale[:, :, None] * information * scale[:, None]
    eye = torch.eye(information.shape[-1], dtype=J.dtype, device=J.device)
    inverse = torch.linalg.inv_ex(torch.nan_to_num(information) + (1e-13 + 1.0 * ~live[:, None, :]) * eye).inverse
    inverse = inverse * scale[:, :, None] * scale[:, None]
    redundancy = 2 * w.sum(-1) - q - 6 * used.sum(-1)
    variance = (residual.square().sum(-1) * w).sum(-1) / redundancy.clamp_min(1)
    inverse = torch.nan_to_num(inverse * variance[:, None, None], 0.0, 0.0, 0.0)
    blocks = inverse[:, q:, q:].reshape(-1, v, 6, v, 6).diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)
    return inverse[:, :q, :q], blocks * used[..., None, None]


def view_disagreement(residual: Tensor, J: Tensor, w: Tensor, q: int, v: int, used: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """How much more variance than its noise each view has in what all share, at least one.

    Besides, the variance of the noise, and how much more than that each view (b, v) has against all others.

    Had every view the `q` shared numbers for itself, the squares of the residuals would shrink by what noise explains, or by
    more: where the views are of several cameras, the board is bent, or the lens another one. The ratio, to first order, is that
    of an F test; the variance of a mean is multiplied by it where measurements contradict each other (Birge 1932).
    """
    scale = w.sqrt()[..., None]
    r = (residual * scale).reshape(len(w), v, 2 * w.shape[1] // v)
    J = (J * scale[..., None]).reshape(*r.shape, J.shape[-1])
    poses = J[..., q:].reshape(*J.shape[:-1], v, 6).diagonal(dim1=1, dim2=3).movedim(-1, 1)
    Q, _, _ = qr(poses * used[..., None, None])
    own = J[..., :q] - Q @ (Q.mT @ J[..., :q])
    own = own / own.norm(dim=(1, 2), keepdim=True).clamp_min(1e-300)
    values, vectors, _ = eigh(own.mT @ own)
    some = (values > _RANK * values[..., -1:]) & used[..., None]
    # Of each view the shift that it would take, and what remains of it by noise where the others stay.
    root = torch.where(some, values, 1.0).sqrt()
    pull = torch.where(some, (vectors.mT @ (own.mT @ r[..., None]))[..., 0] / root, 0.0)
    explained = pull.square().sum((1, 2))
    count = (some.sum((1, 2)) - q).clamp_min(0)
    rest = 2 * w.sum(-1) - q - 6 * used.sum(-1) - count
    noise = (r.square().sum((1, 2)) - explained) / rest.clamp_min(1)
    tested = (count > 0) & (rest >= 1) & (noise > 0)
    ratio = explained / torch.where(tested, count * noise, 1.0)
    ratio = torch.nan_to_num(torch.where(tested, ratio, 1.0), 1.0, 1.0, 1.0).clamp_min(1.0)
    alone = _alone(pull, vectors * (root * some)[..., None, :], some)
    alone = torch.where(tested[:, None], alone / torch.where(tested, noise, 1.0)[:, None], 0.0)
    return ratio, torch.where(rest >= 1, noise, 0.0), torch.nan_to_num(alone, 0.0, 0.0, 0.0)


def _alone(pull: Tensor, root: Tensor, some: Tensor) -> Tensor:
    """What the squares of the residuals shrink by, to first order, where a view goes by itself, over how many numbers it has.

    Args:
        pull: The gradient of each view in the axes of its information, over the roots of these (b, v, q).
        root: Roots R of its information R R' (b, v, q, q), that of all having a diagonal of ones.
        some: Which axes there are (b, v, q).
    """
    eye = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device)
    inverse = torch.linalg.inv_ex((root @ root.mT).sum(1) + 1e-12 * eye).inverse
    # Of an axis that one view alone has the others say nothing.
    share = (1 + _RANK) * eye - root.mT @ inverse[:, None] @ root
    shrunk = (pull * torch.linalg.solve_ex(share, pull[..., None]).result[..., 0]).sum(-1)
    alone: Tensor = shrunk.clamp_min(0) / some.sum(-1).clamp_min(1)
    return alone
