"""What is known beforehand of poses and points: positions of camera centres (GPS), poses, motions between two, control points.

A prior adds `(v - v0)' C^-1 (v - v0) / 2` to the cost, C the covariance given. An observation's squared distance counts in
units of 1 pixel there: where image points have a standard deviation s other than 1 pixel, give observations the weight 1 / s^2.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry import Pose, rotvec_from_rotation
from torchsfm.optim import Loss, Term

Sigma = float | Tensor


@runtime_checkable
class Prior(Protocol):
    """A residual over one block of a bundle, written in units of its standard deviation.

    Example:
        >>> import torch, torchsfm
        >>> from dataclasses import dataclass
        >>> from torchsfm.optim import Term
        >>> @dataclass(frozen=True)
        ... class Height:  # known heights of some points above the ground
        ...     index: torch.Tensor
        ...     z: torch.Tensor
        ...     sigma: float
        ...     block = "point"
        ...     def term(self):
        ...         return Term(lambda X, z: (X[:, 2:] - z[:, None]) / self.sigma, ("point",), (self.index,), (self.z,))
        ...
        >>> simulated = torchsfm.random_bundle_problem(4, 50, 150, generator=torch.Generator().manual_seed(0))
        >>> known = Height(torch.arange(10), simulated.truth.X[:10, 2], 1e-4)
        >>> found = torchsfm.bundle_adjust(simulated.problem, priors=(known,))
        >>> bool((found.X[:10, 2] - known.z).abs().max() < 0.01)
        True
    """

    @property
    def index(self) -> Tensor:
        """Which poses, points or cameras it speaks of."""

    @property
    def block(self) -> str:
        """Which block: "pose", "point" or "camera", whose rows are focal length, aspect, skew, principal point, distortion."""

    def term(self) -> Term:
        """The prior as a term of the optimiser."""


@dataclass(frozen=True)
class CentrePrior:
    """Known camera centres: GPS, or a surveyed track. With rigs, those of the rig's own origin.

    Example:
        >>> import torch, torchsfm
        >>> simulated = torchsfm.random_bundle_problem(4, 50, 150, generator=torch.Generator().manual_seed(0))
        >>> gps = torchsfm.CentrePrior(torch.arange(4), simulated.truth.poses.centre, sigma=1e-6)
        >>> found = torchsfm.bundle_adjust(simulated.problem, priors=(gps,))
        >>> bool((found.poses.centre - gps.centre).norm(dim=-1).max() < 1e-3)
        True
    """

    index: Int[Tensor, "k"]
    """Which poses."""
    centre: Float[Tensor, "k 3"]
    """Where they are, in the world."""
    sigma: Sigma
    """Standard deviation in the unit of the world: one number, one for each (k, 1) or for each axis (3,) or (k, 3)."""
    covariance: Float[Tensor, "k 3 3"] | None = None
    """Whole covariances, instead of `sigma`."""
    loss: Loss | None = None
    """Robust loss of the squared, whitened error."""
    block = "pose"

    def __post_init__(self) -> None:
        check_tensors(index=(self.index, "k: int"), centre=(self.centre, "k 3"), covariance=(self.covariance, "?k 3 3"))

    def term(self) -> Term:
        """The prior as a term of the optimiser."""

        def residual(pose: Tensor, centre: Tensor, white: Tensor) -> Tensor:
            R, t = _split(pose)
            return _apply(white, -_apply(R.mT, t) - centre)

        white = _whitener(self.sigma, self.covariance, self.centre)
        return Term(residual, ("pose",), (self.index,), (self.centre, white), self.loss)


@dataclass(frozen=True)
class PosePrior:
    """Known poses: an inertial unit, an earlier adjustment.

    Example:
        >>> import torch, torchsfm
        >>> simulated = torchsfm.random_bundle_problem(4, 50, 150, generator=torch.Generator().manual_seed(0))
        >>> known = torchsfm.PosePrior(torch.arange(4), simulated.truth.poses, sigma=1e-6)
        >>> found = torchsfm.bundle_adjust(simulated.problem, priors=(known,))
        >>> bool((found.poses.t - known.poses.t).norm(dim=-1).max() < 1e-3)
        True
    """

    index: Int[Tensor, "k"]
    """Which poses."""
    poses: Pose
    """What they are, batch (k,)."""
    sigma: Sigma
    """Standard deviations of (w, v) as in `Pose.retract`, radians and the unit of the world: one number, (6,) or (k, 6)."""
    covariance: Float[Tensor, "k 6 6"] | None = None
    """Whole covariances of (w, v), instead of `sigma`; `BundleCovariance.poses` is one."""
    loss: Loss | None = None
    """Robust loss of the squared, whitened error."""
    block = "pose"

    def __post_init__(self) -> None:
        check_tensors(index=(self.index, "k: int"), poses=(self.poses.R, "k 3 3"), covariance=(self.covariance, "?k 6 6"))

    def term(self) -> Term:
        """The prior as a term of the optimiser."""

        def residual(pose: Tensor, known: Tensor, white: Tensor) -> Tensor:
            return _apply(white, _pose_error(_split(pose), _split(known)))

        return Term(residual, ("pose",), (self.index,), _known_poses(self), self.loss)


@dataclass(frozen=True)
class RelativePosePrior:
    """Known motions from one camera to another: wheels or an inertial unit between frames, pairs and models of a few images.

    The world as a whole stays free, so a gauge must be held elsewhere or left free. Where only rotations are known, let the
    standard deviations of the translation be infinite: `sigma=torch.tensor([s, s, s, inf, inf, inf])`.

    Example:
        >>> import torch, torchsfm
        >>> simulated = torchsfm.random_bundle_problem(4, 50, 150, generator=torch.Generator().manual_seed(0))
        >>> pairs, truth = torch.tensor([[0, 1], [1, 2], [2, 3]]), simulated.truth.poses
        >>> moved = truth[pairs[:, 1]] @ truth[pairs[:, 0]].inverse()
        >>> known = torchsfm.RelativePosePrior(pairs, moved, sigma=1e-6)
        >>> found = torchsfm.bundle_adjust(simulated.problem, priors=(known,)).poses
        >>> bool(((found[pairs[:, 1]] @ found[pairs[:, 0]].inverse()).t - moved.t).norm(dim=-1).max() < 1e-3)
        True
    """

    index: Int[Tensor, "k 2"]
    """The two poses of each motion, no two the same: from the first one's camera to the second one's."""
    poses: Pose
    """The motions, `poses[second] @ poses[first].inverse()`, batch (k,)."""
    sigma: Sigma
    """Standard deviations of (w, v) as in `Pose.retract`, radians and the unit of the world: one number, (6,) or (k, 6)."""
    covariance: Float[Tensor, "k 6 6"] | None = None
    """Whole covariances of (w, v), instead of `sigma`."""
    loss: Loss | None = None
    """Robust loss of the squared, whitened error."""
    block = "pose"

    def __post_init__(self) -> None:
        check_tensors(index=(self.index, "k 2: int"), poses=(self.poses.R, "k 3 3"), covariance=(self.covariance, "?k 6 6"))
        if bool((self.index[:, 0] == self.index[:, 1]).any()):
            raise ValueError("index: wanted two different poses in each row")

    def knows_places(self) -> bool:
        """Whether it says something of translations, not of rotations alone."""
        return bool((_known_poses(self)[1][:, :, 3:].nan_to_num() != 0).any())

    def term(self) -> Term:
        """The prior as a term of the optimiser."""

        def residual(first: Tensor, second: Tensor, known: Tensor, white: Tensor) -> Tensor:
            (A, a), (R, t) = _split(first), _split(known)
            return _apply(white, _pose_error(_split(second), (R @ A, _apply(R, a) + t)))

        return Term(residual, ("pose", "pose"), (self.index[:, 0], self.index[:, 1]), _known_poses(self), self.loss)


@dataclass(frozen=True)
class PointPrior:
    """Known points: ground control, markers that were measured.

    Example:
        >>> import torch, torchsfm
        >>> simulated = torchsfm.random_bundle_problem(4, 50, 150, generator=torch.Generator().manual_seed(0))
        >>> surveyed = torchsfm.PointPrior(torch.arange(5), simulated.truth.X[:5], sigma=1e-6)
        >>> found = torchsfm.bundle_adjust(simulated.problem, priors=(surveyed,))
        >>> bool((found.X[:5] - surveyed.X).norm(dim=-1).max() < 1e-3)
        True
    """

    index: Int[Tensor, "k"]
    """Which points."""
    X: Float[Tensor, "k 3"]
    """Where they are, in the world."""
    sigma: Sigma
    """Standard deviation in the unit of the world: one number, one for each (k, 1) or for each axis (3,) or (k, 3)."""
    covariance: Float[Tensor, "k 3 3"] | None = None
    """Whole covariances, instead of `sigma`."""
    loss: Loss | None = None
    """Robust loss of the squared, whitened error."""
    block = "point"

    def __post_init__(self) -> None:
        check_tensors(index=(self.index, "k: int"), X=(self.X, "k 3"), covariance=(self.covariance, "?k 3 3"))

    def term(self) -> Term:
        """The prior as a term of the optimiser."""

        def residual(point: Tensor, X: Tensor, white: Tensor) -> Tensor:
            return _apply(white, point - X)

        white = _whitener(self.sigma, self.covariance, self.X)
        return Term(residual, ("point",), (self.index,), (self.X, white), self.loss)


def _known_poses(prior: PosePrior | RelativePosePrior) -> tuple[Tensor, Tensor]:
    """Known poses as rows, and what turns errors of theirs into units of standard deviations."""
    known = torch.cat((prior.poses.R.flatten(1), prior.poses.t), 1)
    return known, _whitener(prior.sigma, prior.covariance, known[:, :6])


def _pose_error(pose: tuple[Tensor, Tensor], known: tuple[Tensor, Tensor]) -> Float[Tensor, "k 6"]:
    """The step (w, v) from known poses to poses, as in `Pose.retract`."""
    (R, t), (R0, t0) = pose, known
    turn = R @ R0.mT
    return torch.cat((rotvec_from_rotation(turn), t - _apply(turn, t0)), -1)


def _whitener(sigma: Sigma, covariance: Tensor | None, like: Tensor) -> Tensor:
    """Matrices (k, d, d) that turn errors into units of standard deviations; NaN, which counts as absent, if there is none."""
    if covariance is None:
        given = torch.as_tensor(sigma, dtype=like.dtype, device=like.device).expand(like.shape)
        return torch.diag_embed(torch.where(given > 0, 1 / given, torch.nan))
    lower, info = torch.linalg.cholesky_ex(covariance)
    eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device).expand_as(covariance)
    return torch.where((info == 0)[:, None, None], torch.linalg.solve_triangular(lower, eye, upper=False), torch.nan)


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix @ vector[:, :, None])[:, :, 0]


def _split(pose: Tensor) -> tuple[Tensor, Tensor]:
    return pose[:, :9].reshape(-1, 3, 3), pose[:, 9:]
