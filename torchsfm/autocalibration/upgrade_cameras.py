"""The upgrade of projective cameras to metric ones, whatever was seen of the structure: points, or curves."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_options, tensor_map
from torchsfm.autocalibration.assumption_fit import FINALISTS, STARTS, AssumptionFit, solve_assumption
from torchsfm.autocalibration.diagnosis import Motion, diagnose_motion
from torchsfm.autocalibration.evidence import weigh_assumptions
from torchsfm.autocalibration.intrinsics_model import Assumption
from torchsfm.autocalibration.metric_cameras import metric_cameras
from torchsfm.autocalibration.projective_input import MAX_COUPLED, Sightings, prepare_cameras
from torchsfm.geometry.intrinsic_parameters import intrinsics_from_relative, relative_from_intrinsics
from torchsfm.optim.pytree import cut, join

_DOUBLES = 12_000_000
"""Entries of covariances held at once; bounds memory, changes no result."""
_FAR = 3.0
"""Distortion this many times what was expected is beyond what its linear treatment reaches."""


@dataclass(frozen=True)
class Autocalibration:
    """Metric cameras and points, or samples of curves, and how far the data determine them.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> X, poses = torchsfm.random_points(30, generator=g), torchsfm.random_poses(6, wobble=0.5, generator=g)
        >>> x = torchsfm.project_points(K @ poses.matrix(), X) + 0.3 * torch.randn(6, 30, 2, generator=g)
        >>> projective = torchsfm.factorize_points(x)
        >>> found = torchsfm.autocalibrate_points(projective.P, projective.X, x, image_size=(1000.0, 750.0))
        >>> torchsfm.Status(found.status.item()).name, found.assumptions[found.assumption].varying  # nothing varies
        ('OK', ())
        >>> relative = found.K[0, 0, 0] / 900 - 1
        >>> bool(relative.abs() < 3 * found.deviation[0, 0]), bool(found.determined[0, 0])
        (True, True)
    """

    K: Float[Tensor, "*batch v 3 3"]
    """Intrinsics of each view, in pixels."""
    P: Float[Tensor, "*batch v 3 4"]
    """Metric cameras `K [R | t]`. The world is the frame of the view with most points, the unit the mean distance of the others
    from it."""
    X: Float[Tensor, "*batch n 3"] | Float[Tensor, "*batch c m 3"]
    """Metric points, or samples of curves; zero where they are at infinity."""
    upgrade: Float[Tensor, "*batch 4 4"]
    """H with `P_given H ~ P`, `X_given ~ H X`."""
    status: Int8[Tensor, "*batch"]
    """OK; DEGENERATE: the data do not determine the focal lengths, or determine two; NO_CONSENSUS: no camera of the kind
    assumed fits, or the images are distorted much more than was expected; BEHIND:
    points would be behind cameras; TOO_FEW: fewer than two views with six points, or eleven samples of curves, or fewer
    constraints than unknowns; NOT_FINITE. Where it is not OK the numbers are the best found, and not to be relied on."""
    assumption: Int8[Tensor, "*batch"]
    """Which of `fits` was taken."""
    probability: Float[Tensor, "*batch"]
    """Of that assumption among those tried; what the others would have had is in the deviations."""
    fits: tuple[AssumptionFit, ...]
    """What each of the assumptions tried leads to."""
    deviation: Float[Tensor, "*batch v 5"]
    """Standard deviations of focal length (relative), aspect (relative), skew over focal length, and principal point in
    pixels."""
    covariance: Float[Tensor, "*batch v 5 5"]
    """Of the same five numbers."""
    determined: Bool[Tensor, "*batch v 5"]
    """Which of those the data determine by themselves: better than `max_deviation` of the focal length. Others are what was
    assumed."""
    plane: Float[Tensor, "*batch 4"]
    """The plane at infinity in the frame given."""
    chi2: Float[Tensor, "*batch"]
    """Weighted squared departure from metric cameras; about `redundancy` where the assumption holds."""
    redundancy: Float[Tensor, "*batch"]
    """Constraints less unknowns."""
    distortion: Float[Tensor, "*batch"]
    """First coefficient of radial distortion, of which the cameras were freed before they were judged; see
    `distortion_sigma`."""
    distortion_deviation: Float[Tensor, "*batch"]
    """Its standard deviation."""
    noise: Float[Tensor, "*batch"]
    """Standard deviation of the observations that was estimated or given, pixels."""
    in_front: Float[Tensor, "*batch"]
    """Share of the observations in front of their cameras."""
    motion: Motion
    """How near the motion of the metric cameras is to a critical one."""

    @property
    def valid(self) -> Bool[Tensor, "*batch"]:
        """Which elements may be relied on."""
        return self.status == Status.OK

    @property
    def assumptions(self) -> tuple[Assumption, ...]:
        """What was tried."""
        return tuple(fit.assumption for fit in self.fits)


@dataclass(frozen=True)
class UpgradeOptions:
    """What is assumed of cameras and images; see `autocalibrate_points`."""

    assume: tuple[Assumption, ...]
    noise: float | None
    max_deviation: float
    distortion_sigma: float


def upgrade_options(
    assume: Assumption | Sequence[Assumption], noise: float | None, max_deviation: float, distortion_sigma: float
) -> UpgradeOptions:
    """The options, checked."""
    several = (assume,) if isinstance(assume, Assumption) else assume
    check_options(
        assume=(several, Sequence), noise=(noise, "?float > 0"), max_deviation=(max_deviation, "float > 0"),
        distortion_sigma=(distortion_sigma, "float >= 0"),
    )  # fmt: skip
    if not several or not all(isinstance(option, Assumption) for option in several):
        raise ValueError(f"assume: wanted one Assumption or several, got {assume!r}")
    return UpgradeOptions(tuple(several), noise, max_deviation, distortion_sigma)


def sizes_of(
    image_size: Tensor | tuple[float, float], K: Tensor | None, P: Float[Tensor, "*batch v 3 4"]
) -> Float[Tensor, "*size w 2"]:
    """Sizes of images as a tensor; they and K are to be of one view or of all."""
    v = P.shape[-3]
    sizes = image_size if isinstance(image_size, Tensor) else P.new_tensor([image_size])
    if sizes.shape[-2] not in (1, v):
        raise ValueError(f"image_size: wanted 1 or {v} views, got shape {tuple(sizes.shape)}")
    if K is not None and K.shape[-3] not in (1, v):
        raise ValueError(f"K: wanted 1 or {v} views, got shape {tuple(K.shape)}")
    return sizes


def upgrade_cameras(
    P: Float[Tensor, "*#batch v 3 4"],
    X: Float[Tensor, "*#batch n 4"],
    seen: Sightings,
    sizes: Float[Tensor, "*#batch #v 2"],
    K: Float[Tensor, "*#batch #v 3 3"] | None,
    options: UpgradeOptions,
    batch: tuple[int, ...],
) -> Autocalibration:
    """Metric cameras and points for a batch of problems, some at a time."""
    v, n = P.shape[-3], X.shape[-2]
    count = math.prod(batch)

    def flat(t: Tensor, *rest: int) -> Tensor:
        whole = t.detach().expand(*batch, *rest).reshape(count, *rest)
        # The shapes of the answer come from one problem of zeros, where there is none.
        whole = whole if count else whole.new_zeros(1, *rest)
        return whole.double() if t.is_floating_point() else whole

    with torch.no_grad():
        x, normal = (None if t is None else flat(t, v, n, 2) for t in (seen.x, seen.normal))
        data = (
            flat(P, v, 3, 4),
            flat(X, n, 4),
            flat(sizes, v, 2),
            Sightings(x, flat(seen.visible, v, n), normal),
            None if K is None else flat(K, v, 3, 3),
        )
        per_problem = (12 * v) ** 2 * (2 + FINALISTS) if v <= MAX_COUPLED else 144 * v * STARTS
        chunk = max(1, _DOUBLES // max(per_problem, 1))
        whole = join([_solve(*cut(data, i, i + chunk), options) for i in range(0, max(count, 1), chunk)])

    def restored(t: Tensor) -> Tensor:
        shaped = t[:count].reshape((*batch, *t.shape[1:]))
        return shaped.to(P.dtype) if t.is_floating_point() else shaped

    return tensor_map(restored, whole)


def _solve(
    P: Tensor, X: Tensor, image_size: Tensor, seen: Sightings, K: Tensor | None, options: UpgradeOptions
) -> Autocalibration:
    b, v = P.shape[:2]
    max_deviation, distortion_sigma = options.max_deviation, options.distortion_sigma
    noise = None if options.noise is None else torch.full((b,), options.noise, dtype=P.dtype, device=P.device)
    ready = prepare_cameras(P, X, seen, image_size, noise, distortion_sigma)
    rows = torch.arange(b, device=P.device)[:, None]
    base = P.new_zeros(b, v, 5)
    if K is not None:
        base = torch.nan_to_num(relative_from_intrinsics(ready.image @ K[rows, ready.order]), 0.0, 0.0, 0.0)
        base[..., 0] = 0
    solved = [solve_assumption(ready, base, assumption, max_deviation) for assumption in options.assume]
    statuses = torch.stack([s.fit.status for s in solved])
    possible = (statuses != Status.TOO_FEW) & (statuses != Status.NOT_FINITE) & (statuses != Status.BEHIND)
    weight = weigh_assumptions(torch.stack([s.evidence for s in solved]), possible)
    taken = weight.argmax(0)

    def pick(values: list[Tensor]) -> Tensor:
        return torch.stack(values)[taken, torch.arange(b, device=P.device)]

    parameters, plane = pick([s.parameters for s in solved]), pick([s.plane for s in solved])
    status = pick([s.fit.status for s in solved])
    inverse = ready.order.argsort(-1)
    K_ready = intrinsics_from_relative(parameters)
    metric = metric_cameras(ready, K_ready, plane)
    side = 1 / ready.image[..., 0, 0]
    unit = torch.stack((*[torch.ones_like(side)] * 3, side, side), -1)
    # What the other assumptions would have elsewhere is uncertain too.
    weight = torch.where(weight > 1e-6, weight, 0.0)[..., None, None, None]
    own = (torch.arange(len(solved), device=P.device)[:, None] == taken)[..., None, None, None]
    apart = torch.stack([s.likely for s in solved]) - parameters
    others = torch.stack([s.likely_covariance for s in solved]) + apart[..., :, None] * apart[..., None, :]
    spread = torch.where(own, torch.stack([s.covariance for s in solved]), torch.where(weight > 0, others, 0.0))
    covariance = (weight * spread).sum(0)
    focal = (covariance[..., 0, 0].clamp_min(0).sqrt() * ready.present).amax(-1)
    status = torch.where((status == Status.OK) & (focal > max_deviation), int(Status.DEGENERATE), status)
    bent = ready.distortion.abs() > _FAR * distortion_sigma
    status = torch.where((status == Status.OK) & bent, int(Status.NO_CONSENSUS), status)
    covariance = covariance[rows, inverse] * (unit[..., :, None] * unit[..., None, :])[rows, inverse]
    told = pick([s.data_deviation for s in solved])
    determined = (told <= max_deviation)[rows, inverse]
    K_pixels = _unscaled(ready.image) @ K_ready
    K_pixels = K_pixels / K_pixels[..., 2:, 2:]
    poses = torch.cat((metric.R, metric.t[..., None]), -1)
    plane_given = torch.linalg.solve_ex(
        ready.frame.mT, torch.cat((plane, torch.ones_like(plane[:, :1])), -1)[..., None]
    ).result[..., 0]
    plane_given = torch.nan_to_num(plane_given / plane_given.norm(dim=-1, keepdim=True).clamp_min(1e-300))
    motion = diagnose_motion(metric.R, -(metric.R.mT @ metric.t[..., None])[..., 0], ready.present)
    status = torch.where((status == Status.OK) & (metric.in_front < 0.95), int(Status.BEHIND), status)
    return Autocalibration(
        K=K_pixels[rows, inverse],
        P=(K_pixels @ poses)[rows, inverse],
        X=metric.X,
        upgrade=metric.upgrade,
        status=status.to(torch.int8),
        assumption=taken.to(torch.int8),
        probability=pick([*weight[..., 0, 0, 0]]),
        fits=tuple(s.fit for s in solved),
        deviation=covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt(),
        covariance=covariance,
        determined=determined,
        plane=plane_given,
        chi2=pick([s.fit.chi2 for s in solved]),
        redundancy=pick([s.fit.redundancy for s in solved]),
        distortion=ready.distortion,
        distortion_deviation=ready.distortion_deviation,
        noise=ready.noise,
        in_front=metric.in_front,
        motion=motion,
    )


def _unscaled(T: Tensor) -> Tensor:
    s = 1 / T[..., 0, 0]
    zero = torch.zeros_like(s)
    rows = (s, zero, -T[..., 0, 2] * s, zero, s, -T[..., 1, 2] * s, zero, zero, zero + 1)
    return torch.stack(rows, -1).reshape(T.shape)
