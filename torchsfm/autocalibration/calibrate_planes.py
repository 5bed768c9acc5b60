"""Calibration from views of a known plane, such as a chessboard.

Zhang, "A flexible new technique for camera calibration", PAMI 2000: the homography of each view constrains the image of the
absolute conic, `h1' w h2 = 0` and `h1' w h1 = h2' w h2`; then all intrinsics, distortion and poses are adjusted to the least
reprojection error.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors, tensor_map
from torchsfm.autocalibration.board_shape import BOARD, NAMES, shaped
from torchsfm.autocalibration.circle_outlines import circle_points
from torchsfm.autocalibration.plane_copies import first_of_copies, of_first
from torchsfm.autocalibration.plane_covariance import plane_covariance, view_disagreement, without_lens
from torchsfm.autocalibration.plane_problem import PlaneProblem
from torchsfm.autocalibration.plane_start import start_from_homographies
from torchsfm.geometry import Camera, Distortion, Pose, Radial
from torchsfm.geometry.intrinsic_parameters import (
    ASPECT,
    FOCAL,
    HEAD,
    INTRINSICS,
    SKEW,
    camera_from_row,
    intrinsic_columns,
    intrinsic_labels,
)
from torchsfm.geometry.projection import PixelProjection
from torchsfm.linalg import eigvalsh, usable
from torchsfm.optim import Loss, levenberg_marquardt, loss_slope

MAX_DEVIATION = 0.3
"""Standard deviation of the logarithm of the focal length beyond which the views do not determine it."""


@dataclass(frozen=True)
class PlaneCalibration:
    """A calibrated camera and its poses before the plane z = 0.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(40, kind="plane", generator=g), torchsfm.random_poses(6, generator=g)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> x = torchsfm.project_points(K @ poses.matrix(), X) + 0.3 * torch.randn(6, 40, 2, generator=g)
        >>> found = torchsfm.calibrate_planes(x, X[:, :2], image_size=(1000.0, 750.0))
        >>> found.parameter_names[:4], bool(0.2 < found.rms < 0.6)  # pixels
        (('fx', 'fy', 'cx', 'cy'), True)
        >>> fx = found.parameter_names.index("fx")
        >>> bool((found.camera.K[0, 0] - 900).abs() < 4 * found.deviation[fx])
        True
    """

    camera: Camera
    """Intrinsics and distortion that all views share."""
    poses: Pose
    """Camera from plane, batch (*batch, v)."""
    cost: Float[Tensor, "*batch"]
    """Half the sum of the loss, or of the squares, of all distances."""
    rms: Float[Tensor, "*batch"]
    """Root mean square distance between observation and projection, pixels."""
    view_rms: Float[Tensor, "*batch v"]
    """The same of each view."""
    used: Bool[Tensor, "*batch v"]
    """Views with at least four points that are not on a line, and not a copy of another one."""
    copy_of: Int[Tensor, "*batch v"]
    """The first view that shows the same noise, of which this one is a copy, or the view itself: copies are no new evidence."""
    parameter_names: tuple[str, ...]
    """What was estimated."""
    covariance: Float[Tensor, "*batch q q"]
    """Of the free parameters in the order of `parameter_names`: "fx", "fy" (one of them stands for both without "aspect"),
    "skew", "cx", "cy" in pixels, the distortion, and the shape of the board, from the residuals' own noise and from how far the
    views disagree."""
    pose_covariance: Float[Tensor, "*batch v 6 6"]
    """Of each pose, rotation vector and translation from the left."""
    disagreement: Float[Tensor, "*batch"]
    """How many times more the views contradict each other about what they share than the noise of each lets them, at least 1;
    covariances have been multiplied by its square. Much more than 1 says that they are not of one camera, that the board is
    bent or its squares are not square, or that the lens is of another kind."""
    view_disagreement: Float[Tensor, "*batch v"]
    """How many times more than by noise each view contradicts all others about what they share, to first order; about 1 by
    noise. The largest is most likely of another camera, mirrored, or of another board."""
    board: Float[Tensor, "*batch n 3"]
    """Where the points of the board are, in the unit of X; X and zero where its shape is not free."""
    board_shape: Float[Tensor, "*batch 5"]
    """Stretch, shear and bends, see `calibrate_planes`; zero where they are not free."""
    iterations: Int[Tensor, "*batch"]
    """Steps tried."""
    status: Int8[Tensor, "*batch"]
    """OK; DEGENERATE: the views do not determine the focal length, or would not if the lens were known not to bend (all
    parallel to the image or to each other, for instance, or too few for the free parameters), or a pose so badly that the
    dtype cannot hold its covariance; TOO_FEW: no view, or fewer measurements than unknowns; NOT_CONVERGED."""

    @property
    def deviation(self) -> Float[Tensor, "*batch q"]:
        """Standard deviations of the free parameters."""
        return self.covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()


def calibrate_planes(
    x: Float[Tensor, "*#batch v n 2"],
    X: Float[Tensor, "*#batch n 2"],
    *,
    image_size: tuple[float, float] | None = None,
    visible: Bool[Tensor, "*#batch v n"] | None = None,
    distortion: type[Distortion] = Radial,
    free: Sequence[str] = ("focal", "aspect", "principal_point"),
    loss: Loss | None = None,
    radius: float | None = None,
    max_iterations: int = 60,
) -> PlaneCalibration:
    """Calibrate a camera from views of points, or of circles, on a plane, whose places on it are known.

    Needs three views of different directions, or fewer with fewer free parameters. Views parallel to the image, or to each
    other, add nothing. Where x or X require a gradient the answer carries its derivative, that of the optimum.

    Args:
        x: Image points in pixels; of circles the centres of the ellipses that fit their outlines.
        X: Points on the plane, in any unit; the centres of circles.
        image_size: Width and height in pixels, whose middle is the first guess of the principal point, and stays it where that
            is not free; the middle of the observations by default.
        visible: Which points each view sees; all by default. What stands elsewhere is not looked at.
        distortion: The distortion model.
        free: Which of "focal" (always), "aspect", "skew", "principal_point" are estimated; all of the distortion is. With
            "board" also five numbers of a board that is nearly what it should be: "stretch" along x and "shear" in its plane,
            and its bend `z = bend_xx x^2 + bend_xy x y + bend_yy y^2` around its middle, in one over the unit of X.
        loss: Of squared distances in pixels, see `torchsfm.optim.loss`; the squares if not given.
        radius: Of the circles, in the unit of X; points if not given. The middle of a circle is not seen in the middle of its
            outline, the less so the larger it is: what the outlines look like through the lens is taken into account.
        max_iterations: Most steps of the optimiser.

    Returns:
        Camera, poses, residuals, covariance and status.

    Raises:
        ValueError: Shapes, dtypes, devices or names do not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(40, kind="plane", generator=g), torchsfm.random_poses(6, generator=g)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> x = torchsfm.project_points(K @ poses.matrix(), X)  # six views of a plane, z = 0
        >>> found = torchsfm.calibrate_planes(x, X[:, :2], image_size=(1000.0, 750.0))
        >>> bool(found.status == torchsfm.Status.OK), bool((found.camera.K - K).abs().max() < 0.01)
        (True, True)
    """
    batch = check_tensors(x=(x, "v>=1 n>=4 2"), X=(X, "n 2"), visible=(visible, "?v n : bool"))
    check_options(
        image_size=(image_size, "?2 float > 0"), free=(free, Sequence), loss=(loss, Callable | None),
        radius=(radius, "?float > 0"), max_iterations=(max_iterations, "int >= 0"),
    )  # fmt: skip
    wrong = [name for name in free if name not in (*INTRINSICS, BOARD)]
    if wrong:
        raise ValueError(f"free: wanted names among {sorted((*INTRINSICS, BOARD))}, got {wrong[0]!r}")
    columns = tuple(sorted(set(intrinsic_columns([name for name in free if name != BOARD]))))
    if "focal" not in free:
        raise ValueError("free: wanted 'focal' among the free parameters")
    v, n = x.shape[-3:-1]
    seen = torch.ones(v, n, dtype=torch.bool, device=x.device) if visible is None else visible
    x64, X64 = (t.double().expand(*batch, *rest) for t, rest in ((x, (v, n, 2)), (X, (n, 2))))
    placed = usable(X64).all(-1)
    seen = seen.expand(*batch, v, n) & usable(x64).all(-1) & placed[..., None, :]
    x64 = torch.where(seen[..., None], x64, 0.0)
    X64 = torch.where(placed[..., None], X64, 0.0)
    with torch.no_grad():
        used = (seen.sum(-1) >= 4) & _spread_out(X64, seen)
        seen = seen & used[..., None]
        middle, unit = _extent(X64, seen.any(-2))
    # Neither the unit of the plane nor its origin matters, nor what rounding makes of them.
    shown = X64 if radius is None else circle_points(X64, radius)
    X64, shown = ((p - middle[..., None, :]) / unit[..., None, None] for p in (X64, shown))
    with torch.no_grad():
        start = start_from_homographies(x64, X64, seen, used, image_size, columns, distortion.num_parameters)
    columns += tuple(range(HEAD, HEAD + distortion.num_parameters))
    problem = PlaneProblem(PixelProjection(distortion, columns, SKEW in columns), radius is not None, BOARD in free)
    q = problem.shared
    weights = seen.double().flatten(-2)
    result = levenberg_marquardt(
        problem.residual,
        start,
        x64,
        shown,
        retract=problem.retract,
        size=q + 6 * v,
        weights=weights,
        loss=loss,
        linearize=problem.linearize,
        max_iterations=max_iterations,
        function_tolerance=1e-12,
        step_tolerance=1e-12,
    )
    found = result.x
    with torch.no_grad():
        settled = tensor_map(torch.Tensor.detach, found)
        flat = tensor_map(lambda a: a.reshape(-1, *a.shape[len(batch) :]), (settled, x64.detach(), shown.detach(), weights))
        residual, J = problem.linearize(flat[0], flat[1], flat[2])
        # Where nothing is measured, points may be anywhere.
        residual = torch.where((flat[3] > 0)[..., None], residual, 0.0)
        # What the loss trusts an observation.
        trust = flat[3] if loss is None else flat[3] * loss_slope(loss, residual.square().sum(-1))
        at = (residual, J, trust, q, v, used.reshape(-1, v))
        covariance, pose_covariance = plane_covariance(*at)
        disagreement, noise, alone = view_disagreement(*at)
        covariance = disagreement[:, None, None] * covariance
        pose_covariance = disagreement[:, None, None, None] * pose_covariance
        units = torch.stack((torch.ones_like(unit), unit), -1).repeat_interleave(3, -1).reshape(-1, 1, 6)
        pose_covariance = units[..., :, None] * pose_covariance * units[..., None, :]
        square = residual.square().sum(-1) * flat[3]
        rms = (square.sum(-1) / flat[3].sum(-1).clamp_min(1)).sqrt().reshape(batch)
        view_rms = (square.view(-1, v, n).sum(-1) / seen.reshape(-1, v, n).sum(-1).clamp_min(1)).sqrt().reshape(*batch, v)
        focal = settled.row[..., FOCAL].abs().clamp_min(1e-12)
        straight = without_lens(problem, flat[:3], residual, trust, used.reshape(-1, v))
        deviations = torch.stack((covariance[..., 0, 0], straight[..., 0, 0])).clamp_min(0).sqrt()
        unsure = ~(deviations.amax(0).reshape(batch) <= MAX_DEVIATION * focal)
        measured, unknowns = 2 * seen.sum((-2, -1)), q + 6 * used.sum(-1)
        held = [torch.isfinite(c.to(x.dtype)).flatten(1).all(-1).reshape(batch) for c in (covariance, pose_covariance)]
        unsure = unsure | ~(held[0] & held[1])
        status = torch.where(unsure, int(Status.DEGENERATE), result.status)
        status = torch.where((measured < unknowns) | ~used.any(-1), int(Status.TOO_FEW), status).to(torch.int8)
        first = first_of_copies(flat[1], seen.reshape(-1, v, n), noise).reshape(*batch, v)
        new = first == torch.arange(v, device=x.device)
    if not bool(new.all()):
        each_once = calibrate_planes(
            x, X, image_size=image_size, visible=seen & new[..., None], distortion=distortion, free=free, loss=loss,
            radius=radius, max_iterations=max_iterations,
        )  # fmt: skip
        of_views = ("poses", "view_rms", "view_disagreement", "pose_covariance")
        copied = of_first(first, {name: getattr(each_once, name) for name in of_views})
        return replace(each_once, copy_of=first, **copied)
    dtype = x.dtype
    t = unit[..., None, None] * found.t - (found.R[..., :2] @ middle[..., None, :, None])[..., 0]
    board = unit[..., None, None] * shaped(X64, found.shape) + torch.nn.functional.pad(middle, (0, 1))[..., None, :]
    bend = unit.reciprocal()
    names = [intrinsic_labels(distortion)[column] for column in columns]
    names[0] = "fx"
    if ASPECT in columns:
        names[1], covariance = "fy", _lengths(covariance, flat[0].row)
    if BOARD in free:
        names += NAMES
        scales = torch.cat((torch.ones_like(covariance[:, 0, :-3]), bend.reshape(-1, 1).expand(-1, 3)), -1)
        covariance = scales[:, :, None] * covariance * scales[:, None]
    return PlaneCalibration(
        camera=camera_from_row(found.row.to(dtype), distortion),
        poses=Pose(found.R.to(dtype), t.to(dtype)),
        cost=result.cost.to(dtype),
        rms=rms.to(dtype),
        view_rms=view_rms.to(dtype),
        used=used,
        copy_of=first,
        parameter_names=tuple(names),
        covariance=covariance.reshape(*batch, q, q).to(dtype),
        pose_covariance=pose_covariance.reshape(*batch, v, 6, 6).to(dtype),
        iterations=result.iterations,
        status=status,
        disagreement=disagreement.sqrt().reshape(batch).to(dtype),
        view_disagreement=alone.sqrt().reshape(*batch, v).to(dtype),
        board=board.to(dtype),
        board_shape=torch.cat((found.shape[..., :2], bend[..., None] * found.shape[..., 2:]), -1).to(dtype),
    )


def _lengths(covariance: Tensor, found: Tensor) -> Tensor:
    """The covariance of fx, fy, ... from that of focal length, aspect, ..."""
    f, aspect = found[..., FOCAL], found[..., ASPECT]
    J = torch.eye(covariance.shape[-1], dtype=f.dtype, device=f.device).repeat(*f.shape, 1, 1)
    J[..., 1, 0], J[..., 1, 1] = aspect, f
    return J @ covariance @ J.mT


def _extent(X: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """The middle (*batch, 2) of the points that are seen, and how far from it they reach."""
    low, high = torch.where(seen[..., None], X, torch.inf).amin(-2), torch.where(seen[..., None], X, -torch.inf).amax(-2)
    some = seen.any(-1)[..., None]
    low, high = torch.where(some, low, 0.0), torch.where(some, high, 0.0)
    unit = (high / 2 - low / 2).amax(-1)
    return low / 2 + high / 2, torch.where(unit > 0, unit, 1.0)


def _spread_out(X: Tensor, seen: Tensor) -> Tensor:
    """Whether the visible points of each view span the plane."""
    w = seen.to(X.dtype)[..., None]
    mean = (X[..., None, :, :] * w).sum(-2, keepdim=True) / w.sum(-2, keepdim=True).clamp_min(1)
    D = (X[..., None, :, :] - mean) * w
    values, _ = eigvalsh(D.mT @ D)
    spans: Tensor = values[..., 0] > 1e-10 * values[..., 1].clamp_min(1e-300)
    return spans
