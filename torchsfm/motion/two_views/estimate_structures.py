"""Several motions, or several planes, in one pair of images."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.linalg import unit_scale
from torchsfm.motion.two_views.collinear import number_aside
from torchsfm.motion.two_views.estimate_fundamental import FundamentalEstimator
from torchsfm.motion.two_views.estimate_homography import HomographyEstimator
from torchsfm.motion.two_views.normalization import common_scale
from torchsfm.robust import Structures, find_structures

_ROUNDING = 1e-14


def estimate_fundamentals(
    x1: Float[Tensor, "*#batch n 2"],
    x2: Float[Tensor, "*#batch n 2"],
    *,
    threshold: float | Float[Tensor, "*#batch"],
    mask: Bool[Tensor, "*#batch n"] | None = None,
    slots: int = 8,
    smallest: int | None = None,
    generator: torch.Generator | None = None,
) -> Structures[Float[Tensor, "*batch s 3 3"]]:
    """The fundamental matrices of bodies that moved differently between two images, and which matches belong to which.

    By preference clustering (`find_structures`) over seven-point hypotheses with the oriented epipolar constraint.

    Args:
        x1: Points in the first image.
        x2: The corresponding points in the second image, in the same unit.
        threshold: Largest Sampson distance of a body's points, in the unit of the points; about four times that for one motion.
        mask: Which correspondences exist. Rows that are not finite are left out too.
        slots: Most motions to return.
        smallest: Fewest points of a motion; 11 if not given.
        generator: Source of randomness.

    Returns:
        F with x2' F x1 = 0 and |F| = 1 (Frobenius) in each valid slot, zero in the others; labels, number found, status.

    Raises:
        ValueError: A shape, dtype, device or option does not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(2, 60, generator=g), torchsfm.random_poses(2, 2, generator=g)  # two bodies
        >>> x = torch.cat(tuple(torchsfm.project_points(poses, X[:, None])), -2)
        >>> found = torchsfm.estimate_fundamentals(x[0], x[1], threshold=0.005, generator=g)
        >>> int(found.found), found.model.shape
        (2, torch.Size([8, 3, 3]))
    """
    limit = threshold if isinstance(threshold, Tensor) else None
    if limit is None:
        check_options(threshold=(threshold, "float > 0"))
    check_tensors(x1=(x1, "n 2"), x2=(x2, "n 2"), threshold=(limit, "?"), mask=(mask, "?n: bool"))
    y = common_scale(x1.double(), x2.double(), mask)
    found = find_structures(
        FundamentalEstimator(), y.x1, y.x2, threshold=y.scale * threshold, mask=mask, slots=slots, smallest=smallest,
        generator=generator,
    )  # fmt: skip
    F = y.T2.mT[..., None, :, :] @ found.model[..., :3] @ y.T1[..., None, :, :]
    return _judged(found, F, x1.dtype, (y.x1, y.x2), y.scale * threshold, 5)


def estimate_homographies(
    x1: Float[Tensor, "*#batch n 2"],
    x2: Float[Tensor, "*#batch n 2"],
    *,
    threshold: float | Float[Tensor, "*#batch"],
    mask: Bool[Tensor, "*#batch n"] | None = None,
    slots: int = 8,
    smallest: int | None = None,
    generator: torch.Generator | None = None,
) -> Structures[Float[Tensor, "*batch s 3 3"]]:
    """The homographies of several planes seen in two images, and which matches belong to which.

    By preference clustering (`find_structures`) over four-point hypotheses.

    Args:
        x1: Points in the first image.
        x2: The corresponding points in the second image, in the same unit.
        threshold: Largest Sampson distance of a plane's points, in the unit of the points.
        mask: Which correspondences exist. Rows that are not finite are left out too.
        slots: Most planes to return.
        smallest: Fewest points of a plane; 8 if not given.
        generator: Source of randomness.

    Returns:
        H with x2 ~ H x1 and |H| = 1 (Frobenius) in each valid slot, zero in the others; labels, number found, status.

    Raises:
        ValueError: A shape, dtype, device or option does not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> x1 = torch.rand(60, 2, generator=g, dtype=torch.float64)
        >>> x2 = torch.cat((x1[:30] + 0.1, x1[30:] * 0.8))  # two planes
        >>> found = torchsfm.estimate_homographies(x1, x2, threshold=1e-3, generator=g)
        >>> int(found.found), found.label.bincount()
        (2, tensor([30, 30]))
    """
    limit = threshold if isinstance(threshold, Tensor) else None
    if limit is None:
        check_options(threshold=(threshold, "float > 0"))
    check_tensors(x1=(x1, "n 2"), x2=(x2, "n 2"), threshold=(limit, "?"), mask=(mask, "?n: bool"))
    y = common_scale(x1.double(), x2.double(), mask)
    found = find_structures(
        HomographyEstimator(), y.x1, y.x2, threshold=y.scale * threshold, mask=mask, slots=slots, smallest=smallest,
        generator=generator,
    )  # fmt: skip
    H = torch.linalg.inv_ex(y.T2)[0][..., None, :, :] @ found.model @ y.T1[..., None, :, :]
    return _judged(found, H, x1.dtype, (y.x1,), y.scale * threshold, 2)


def _judged(
    found: Structures[Tensor], model: Tensor, dtype: torch.dtype, x: Sequence[Tensor], threshold: Tensor, least: int
) -> Structures[Tensor]:
    """The structures that there is something to, with models of norm 1.

    They have `least` members or more off any line in the images, which are of size 1, and a threshold beyond rounding.
    """
    model = model * unit_scale(model)
    size = model.flatten(-2).norm(dim=-1)
    good = found.valid & (size > 0) & torch.isfinite(size) & (threshold > _ROUNDING)[..., None]
    slots = torch.arange(good.shape[-1], device=good.device)
    member = (found.label[..., None, :] == slots[:, None]) & good[..., None]
    for view in x:
        wide = view.expand(*member.shape[:-2], *view.shape[-2:])[..., None, :, :].expand(*member.shape, 2)
        limit = threshold[..., None].expand(good.shape)
        good = good & (number_aside(wide, member, limit) >= least)
    scale = torch.where(good, 1 / torch.where(good, size, 1), 0)[..., None, None]
    unit = torch.where(good[..., None, None], model, 0) * scale
    label = torch.where((member & good[..., None]).any(-2), found.label, -1)
    number = found.found - (found.valid & ~good).sum(-1)
    vain = (found.status == Status.OK) & ~good.any(-1)
    status = torch.where(vain, int(Status.NO_CONSENSUS), found.status).to(torch.int8)
    return replace(found, model=unit.to(dtype), valid=good, label=label, found=number, status=status)
