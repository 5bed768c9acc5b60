"""Small least-squares problems in intrinsics from many starts, judged by their own residuals."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_options
from torchsfm.autocalibration.intrinsics_model import Assumption
from torchsfm.autocalibration.projective_input import image_scaling
from torchsfm.geometry.intrinsic_parameters import intrinsics_from_relative
from torchsfm.optim import levenberg_marquardt
from torchsfm.optim.likely_noise import likely_variance

MAX_DEVIATION = 0.15
"""Standard deviation of the logarithm of the focal length, from the residuals, beyond which it is not determined."""
_APART = 0.15
"""Focal lengths this far apart in logarithm are told apart by the constraints, or the focal length is not determined,"""
_CLEAR = 9.0
"""by so many variances in their sum of squares."""
_PRIOR = 1e-5
"""Weight of what is expected of the intrinsics: enough to hold what the data do not determine, too little to pull what they
do."""


@dataclass(frozen=True)
class IntrinsicsEstimate:
    """Intrinsics that all views share, from algebraic constraints.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> X, poses = torchsfm.random_points(60, generator=g), torchsfm.random_poses(8, generator=g)
        >>> x = torchsfm.project_points(K @ poses.matrix(), X) + 0.3 * torch.randn(8, 60, 2, generator=g)
        >>> projective = torchsfm.factorize_points(x)
        >>> found = torchsfm.autocalibration.constant_intrinsics(projective.P, projective.X, image_size=(1000.0, 750.0))
        >>> torchsfm.Status(found.status.item()).name, bool((found.K[0, 0] / 900 - 1).abs() < 0.02)
        ('OK', True)
        >>> bool(found.deviation < 0.01)  # how far images are from having these intrinsics
        True
    """

    K: Float[Tensor, "*batch 3 3"]
    """The intrinsics, in pixels."""
    deviation: Float[Tensor, "*batch"]
    """Standard deviation of the logarithm of the focal length, as the residuals tell it, with the most noise that these make
    likely: few say little; 1 where nothing is known."""
    cost: Float[Tensor, "*batch"]
    """Sum of squares of the constraints, without unit."""
    status: Int8[Tensor, "*batch"]
    """OK; DEGENERATE: the constraints do not determine the focal length, or determine two; TOO_FEW of them; NOT_FINITE. Where
    it is not OK, K is the best found and not to be relied on."""


def check_shared(assume: Assumption, image_size: tuple[float, float]) -> None:
    """Refuse assumptions under which views differ, and images without size.

    Raises:
        ValueError: They do, or have none.
    """
    check_options(assume=(assume, Assumption), image_size=(image_size, "2 float > 0"))
    if assume.varying:
        raise ValueError(f"assume: wanted intrinsics that are the same in all views, got varying {assume.varying}")


def scaled(H: Float[Tensor, "*batch m 3 3"], T: Float[Tensor, "*batch 3 3"], inverse_left: bool = True) -> Tensor:
    """Homographies between images in the coordinates that T leads to."""
    inverse = torch.linalg.inv_ex(T).inverse[..., None, :, :]
    moved: Tensor = T[..., None, :, :] @ H @ inverse if inverse_left else inverse.mT @ H @ inverse
    return moved


def fit_intrinsics(
    constraints: Callable[..., Tensor],
    starts: Float[Tensor, "b k u"],
    assume: Assumption,
    data: tuple[Any, ...],
    count: Float[Tensor, "b"],
    image_size: Float[Tensor, "b 2"],
) -> tuple[IntrinsicsEstimate, Float[Tensor, "b u"]]:
    """Minimise `constraints(K, further, *data) -> (..., n)` over intrinsics and further unknowns, from every start.

    Args:
        constraints: Takes K in scaled coordinates and the unknowns beyond the intrinsics.
        starts: Intrinsic unknowns as `assume.columns` has them, followed by the further ones.
        assume: What is free.
        data: Tensors with the batch in front.
        count: Number of constraints that count, of each problem.
        image_size: Width and height.

    Returns:
        The best of each problem, and all its unknowns.
    """
    b, k, u = starts.shape
    spread = assume.spread(1, starts)[0]
    q = spread.shape[-1]
    precision = assume.precision(1, starts) * _PRIOR

    def camera(x: Tensor) -> Tensor:
        # Beyond this range squares overflow, and what is divided by infinity would seem to fit.
        return intrinsics_from_relative((x[..., :q] @ spread.mT).clamp(-20, 20))

    def residual(x: Tensor, *tensors: Tensor) -> Tensor:
        K = camera(x)
        return torch.cat((constraints(K, x[..., q:], *tensors), x[..., :q] * precision), -1)[..., None]

    many = tuple(t[:, None].expand(b, k, *t.shape[1:]) for t in data)
    result = levenberg_marquardt(residual, starts, *many, max_iterations=60, function_tolerance=1e-13, step_tolerance=1e-11)
    cost = torch.nan_to_num(result.cost, torch.inf)
    best = cost.argmin(-1)
    rows = torch.arange(b, device=starts.device)
    x = torch.nan_to_num(result.x[rows, best])

    # The deviation of the focal length from the curvature, in the unit that the residuals themselves give.
    def only(delta: Tensor) -> Tensor:
        return residual(x + delta, *data)[..., 0]

    columns = []
    for i in range(u):
        step = torch.zeros_like(x)
        step[:, i] = 1e-6 * (1 + x[:, i].abs())
        columns.append((only(step) - only(-step)) / (2 * step[:, i : i + 1]))
    J = torch.nan_to_num(torch.stack(columns, -1))[:, : -q if q else None]
    J = torch.nan_to_num(J)
    total = 2 * cost[rows, best]
    finite = torch.isfinite(total)
    total = torch.where(finite, total, 0.0)
    scale = J.norm(dim=1).clamp_min(1e-12)
    A = (J / scale[:, None]).mT @ (J / scale[:, None])
    eye = torch.eye(u, dtype=x.dtype, device=x.device)
    inverse = torch.linalg.inv_ex(A + 1e-13 * eye).inverse / (scale[:, :, None] * scale[:, None])
    # Rounding is the least of errors.
    noise = total / (count - u).clamp_min(1) + 1e-20
    first = next(i for i, (p, _) in enumerate(assume.columns(1)) if p == 0)
    unit = inverse[:, first, first].clamp_min(0)
    seeming = torch.nan_to_num((unit * noise).sqrt(), 1.0)
    deviation = torch.nan_to_num((unit * (likely_variance(total, count - u) + 1e-20)).sqrt(), 1.0).clamp_max(1.0)
    T = image_scaling(image_size)
    K = torch.linalg.inv_ex(T).inverse @ camera(x)
    K = K / K[:, 2:, 2:]
    status = torch.full((b,), int(Status.OK), dtype=torch.int8, device=x.device)
    # Other focal lengths that fit as well, found or asked for, leave the question open, as linear as that may look here.
    limit = (total + _CLEAR * noise)[:, None]
    others = torch.nan_to_num((result.x[..., first] - x[:, None, first]).abs())
    rival = (2 * cost < limit) & (others > _APART)
    held = x[:, None].expand(b, 2, u).clone()
    held[..., first] += held.new_tensor((-_APART, _APART))

    def pinned(free: Tensor, place: Tensor, *tensors: Tensor) -> Tensor:
        return residual(torch.cat((free[..., :first], place, free[..., first:]), -1), *tensors)

    rest = torch.cat((held[..., :first], held[..., first + 1 :]), -1)
    two = tuple(t[:, None].expand(b, 2, *t.shape[1:]) for t in data)
    if u > 1:
        away = levenberg_marquardt(pinned, rest, held[..., first : first + 1], *two, max_iterations=60)
        flat = 2 * torch.nan_to_num(away.cost, torch.inf) < limit
    else:
        flat = torch.nan_to_num(residual(held, *two)[..., 0].square().sum(-1), torch.inf) < limit
    outside = (x[:, first].abs() > 3.7) | (seeming > MAX_DEVIATION) | rival.any(-1) | flat.any(-1)
    for condition, code in ((outside, Status.DEGENERATE), (~finite, Status.NOT_FINITE), (count < u, Status.TOO_FEW)):
        status = torch.where(condition, int(code), status)
    return IntrinsicsEstimate(K, torch.where(finite, deviation, 1.0), total, status.to(torch.int8)), x


def focal_starts(assume: Assumption, b: int, further: Tensor, focals: tuple[float, ...] = (0.4, 0.8, 1.5, 3.0, 6.0)) -> Tensor:
    """Every one of some focal lengths (over the image size) with every one of the further unknowns `(f, u)`: (b, k, q + u)."""
    q = len(assume.columns(1))
    logs = further.new_tensor(focals).log()
    intrinsic = further.new_zeros(len(focals), q)
    intrinsic[:, 0] = logs
    both = torch.cat((intrinsic.repeat_interleave(len(further), 0), further.repeat(len(focals), 1)), -1)
    return both.expand(b, *both.shape)
