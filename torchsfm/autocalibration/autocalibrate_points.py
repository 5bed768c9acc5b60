"""From a projective reconstruction to a metric one, with nothing known of the cameras but what is assumed of all cameras."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors, tensor_map
from torchsfm.autocalibration.assumption_fit import FINALISTS, STARTS, AssumptionFit, solve_assumption
from torchsfm.autocalibration.diagnosis import Motion, diagnose_motion
from torchsfm.autocalibration.evidence import weigh_assumptions
from torchsfm.autocalibration.intrinsics_model import CONSTANT, VARYING_FOCAL, Assumption
from torchsfm.autocalibration.metric_cameras import metric_cameras
from torchsfm.autocalibration.projective_input import MAX_COUPLED, prepare_cameras
from torchsfm.geometry.intrinsic_parameters import intrinsics_from_relative, relative_from_intrinsics

_DOUBLES = 12_000_000
"""Entries of covariances held at once; bounds memory, changes no result."""
_FAR = 3.0
"""Distortion this many times what was expected is beyond what its linear treatment reaches."""


@dataclass(frozen=True)
class Autocalibration:
    """Metric cameras and points, and how far the data determine them.

    See the example of `autocalibrate_points`.
    """

    K: Float[Tensor, "*batch v 3 3"]
    """Intrinsics of each view, in pixels."""
    P: Float[Tensor, "*batch v 3 4"]
    """Metric cameras `K [R | t]`. The world is the frame of the view with most points, the unit the mean distance of the others
    from it."""
    X: Float[Tensor, "*batch n 3"]
    """Metric points, zero where they are at infinity."""
    upgrade: Float[Tensor, "*batch 4 4"]
    """H with `P_given H ~ P`, `X_given ~ H X`."""
    status: Int8[Tensor, "*batch"]
    """OK; DEGENERATE: the data do not determine the focal lengths, or determine two; NO_CONSENSUS: no camera of the kind
    assumed fits, or the images are distorted much more than was expected; BEHIND:
    points would be behind cameras; TOO_FEW: fewer than two views with six points, or fewer constraints than unknowns;
    NOT_FINITE. Where it is not OK the numbers are the best found, and not to be relied on."""
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


def autocalibrate_points(
    P: Float[Tensor, "*#batch v 3 4"],
    X: Float[Tensor, "*#batch n 4"],
    x: Float[Tensor, "*#batch v n 2"] | None = None,
    *,
    image_size: Float[Tensor, "*#batch #v 2"] | tuple[float, float],
    visible: Bool[Tensor, "*#batch v n"] | None = None,
    K: Float[Tensor, "*#batch #v 3 3"] | None = None,
    assume: Assumption | Sequence[Assumption] = (CONSTANT, VARYING_FOCAL),
    noise: float | None = None,
    max_deviation: float = 0.05,
    distortion_sigma: float = 0.05,
) -> Autocalibration:
    """Upgrade projective cameras and points to metric ones.

    A grid of focal lengths, each with the plane at infinity it implies, is the start; then intrinsics and plane are adjusted
    so that all cameras are metric, weighed with the covariance that the observations give the cameras. That is what bundle
    adjustment over metric cameras finds, to first order, at a small part of its cost; metric bundle adjustment is still the
    last step for those who want it. Of several assumptions the likeliest is taken, a later one only where its further unknowns
    explain much more; the deviations tell also what the others would have had, as likely as they are.

    The answer is refused (`status`), not guessed, where the data do not determine the focal length: by their information, and
    by a second look at focal lengths 15 % off, which must fit worse. Critical motions are refused by that, and described in
    `motion`.

    Not differentiable: metric bundle adjustment, which follows, is.

    Args:
        P: Projective cameras in pixels, each of any scale and sign, in any frame, after projective bundle adjustment.
        X: Homogeneous points, of any scale and sign.
        x: Observations in pixels. They serve to estimate the noise; without them it is taken as 1 pixel, or `noise`.
        image_size: Width and height in pixels, of all views or of each.
        visible: Which points each view sees; all by default. A view with fewer than six takes no part.
        K: Where intrinsics are expected: held at these values where they are known, except for the focal length; square pixels
            and the principal point in the middle of the image by default.
        assume: What is assumed of the intrinsics, or several such to be tried in that order.
        noise: Standard deviation of the observations per coordinate, in pixels.
        max_deviation: Largest standard deviation of the logarithm of a focal length that is accepted.
        distortion_sigma: Standard deviation of the radial distortion that the images may have, before any was seen: of k in
            `x_distorted = (1 + k |x|^2) x`, x relative to the middle of the image and over its longer side, the same k in all
            views. It is estimated from the residuals, where x is given, and taken out of the cameras; 0 for images that have
            none.

    Returns:
        Intrinsics, metric cameras and points, with covariance, diagnosis and status.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, or nothing is assumed.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(30, generator=g), torchsfm.random_poses(5, generator=g)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> x = torchsfm.project_points(K @ poses.matrix(), X)
        >>> projective = torchsfm.factorize_points(x)  # in an unknown projective frame
        >>> found = torchsfm.autocalibrate_points(projective.P, projective.X, x, image_size=(1000.0, 750.0))
        >>> bool(found.valid), bool((found.K - K).abs().max() < 0.1)
        (True, True)
    """
    options = (assume,) if isinstance(assume, Assumption) else assume
    check_options(
        assume=(options, Sequence), noise=(noise, "?float > 0"), max_deviation=(max_deviation, "float > 0"),
        distortion_sigma=(distortion_sigma, "float >= 0"),
    )  # fmt: skip
    if not options or not all(isinstance(option, Assumption) for option in options):
        raise ValueError(f"assume: wanted one Assumption or several, got {assume!r}")
    options = tuple(options)
    given = image_size if isinstance(image_size, Tensor) else None
    if given is None:
        check_options(image_size=(image_size, "2 float > 0"))
    batch = check_tensors(
        P=(P, "v>=2 3 4"),
        X=(X, "n>=1 4"),
        x=(x, "?v n 2"),
        image_size=(given, "?w 2"),
        visible=(visible, "?v n : bool"),
        K=(K, "?k 3 3"),
    )
    sizes = P.new_tensor([image_size]) if given is None else given
    v, n = P.shape[-3], X.shape[-2]
    if sizes.shape[-2] not in (1, v):
        raise ValueError(f"image_size: wanted 1 or {v} views, got shape {tuple(sizes.shape)}")
    if K is not None and K.shape[-3] not in (1, v):
        raise ValueError(f"K: wanted 1 or {v} views, got shape {tuple(K.shape)}")

    count = math.prod(batch)

    def flat(t: Tensor, *rest: int) -> Tensor:
        whole = t.detach().expand(*batch, *rest).reshape(count, *rest)
        return whole.double() if t.is_floating_point() else whole

    with torch.no_grad():
        seen = torch.ones(v, n, dtype=torch.bool, device=P.device) if visible is None else visible
        data = [flat(P, v, 3, 4), flat(X, n, 4), flat(seen, v, n), flat(sizes, v, 2)]
        data += [] if x is None else [flat(x, v, n, 2)]
        data += [] if K is None else [flat(K, v, 3, 3)]
        if count == 0:
            # The shapes of the answer come from one problem of zeros.
            data = [t.new_zeros(1, *t.shape[1:]) for t in data]
        per_problem = (12 * v) ** 2 * (2 + FINALISTS) if v <= MAX_COUPLED else 144 * v * STARTS
        chunk = max(1, _DOUBLES // max(per_problem, 1))
        pieces = []
        for start in range(0, len(data[0]), chunk):
            part = [t[start : start + chunk] for t in data]
            rest = part[4:]
            observed = rest.pop(0) if x is not None else None
            expected = rest.pop(0) if K is not None else None
            pieces.append(
                _solve(
                    part[0],
                    part[1],
                    observed,
                    part[2],
                    part[3],
                    expected,
                    tuple(options),
                    noise,
                    max_deviation,
                    distortion_sigma,
                )
            )
        whole = pieces[0] if len(pieces) == 1 else _concatenate(pieces)

    def restored(t: Tensor) -> Tensor:
        shaped = t[:count].reshape((*batch, *t.shape[1:]))
        return shaped.to(P.dtype) if t.is_floating_point() else shaped

    return tensor_map(restored, whole)


def _concatenate(pieces: list[Autocalibration]) -> Autocalibration:
    lists: list[list[Tensor]] = []
    for piece in pieces:
        leaves: list[Tensor] = []
        tensor_map(_collector(leaves), piece)
        lists.append(leaves)
    joined = iter([torch.cat(group) for group in zip(*lists, strict=True)])
    return tensor_map(lambda _: next(joined), pieces[0])


def _collector(into: list[Tensor]) -> Callable[[Tensor], Tensor]:
    def collect(t: Tensor) -> Tensor:
        into.append(t)
        return t

    return collect


def _solve(
    P: Tensor,
    X: Tensor,
    x: Tensor | None,
    visible: Tensor,
    image_size: Tensor,
    K: Tensor | None,
    assume: tuple[Assumption, ...],
    noise: float | None,
    max_deviation: float,
    distortion_sigma: float,
) -> Autocalibration:
    b, v = P.shape[:2]
    given_noise = None if noise is None else torch.full((b,), noise, dtype=P.dtype, device=P.device)
    ready = prepare_cameras(P, X, x, visible, image_size, given_noise, distortion_sigma)
    rows = torch.arange(b, device=P.device)[:, None]
    base = P.new_zeros(b, v, 5)
    if K is not None:
        base = torch.nan_to_num(relative_from_intrinsics(ready.image @ K[rows, ready.order]), 0.0, 0.0, 0.0)
        base[..., 0] = 0
    solved = [solve_assumption(ready, base, assumption, max_deviation) for assumption in assume]
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
