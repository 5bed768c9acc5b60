"""A bundle as blocks of variables and terms over them, and back."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TypedDict

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_index, check_one_problem, check_options, check_tensors
from torchsfm.bundle.bending import bend
from torchsfm.bundle.gauge import gauge_motions
from torchsfm.bundle.intrinsics import Switched, free_columns, free_switches, intrinsics_prior
from torchsfm.bundle.priors import Prior, RelativePosePrior
from torchsfm.bundle.projection import Projection
from torchsfm.bundle.rays import RayPoint, ray_points
from torchsfm.bundle.rig import Rig, RigProjection
from torchsfm.bundle.structure import Sight, Structure
from torchsfm.geometry import BundleProblem, Camera, Pose
from torchsfm.geometry.intrinsic_parameters import HEAD, SKEW, camera_from_row, row_from_camera
from torchsfm.optim import Block, Loss, RigidMotion, Subset, Term


class BundleTerms(TypedDict, total=False):
    """What of a bundle is adjusted, held and known: `bundle_adjust(problem, free=("focal", "k1"), fixed_points=known)`.

    Attributes:
        free: What is optimised in the cameras: any of "focal" (one scale of fx and fy), "aspect", "principal_point", "skew",
            and names of distortion parameters; "focal" if not given, empty for known intrinsics.
        fixed_poses: Poses that do not move, `(v)`; with a rig, those of its frames, `(f)`.
        fixed_points: Points that do not move, `(n)`.
        fixed_cameras: Cameras that do not change, `(g)`.
        fixed_intrinsics: By names as in `free`, cameras `(g)` in which these do not change, where they are free in others.
        rig: Which views were taken together: `cam_from_world = cam_from_rig rig_from_world`. It starts, frame by frame, where
            its first view is.
        fixed_sensors: Sensors `(k)` whose place on the rig does not change: all of a calibrated rig, or one of each rig, whose
            frame is then the rig's own (else damping decides that, too).
        weights: Weight of each observation's squared distance, `(m)`; 0 leaves it out.
        loss: Robust loss of the squared distance (see `torchsfm.optim`), squares if not given.
        priors: What is known of poses and points: `CentrePrior`, `PosePrior`, `RelativePosePrior`, `PointPrior`.
        intrinsics_sigma: Standard deviations of Gaussian priors on free intrinsics, by the names in `free`, as a fraction of
            the mean for "focal" and absolute otherwise, for all cameras or (g,) for each. An observation's distance counts in
            units of 1 pixel.
        intrinsics_mean: Where these are centred; the cameras given if not given.
        structure: What the views see besides points: `BundleLines`, `BundleConics`, `BundleCurves`. One of a kind.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.bundle import BundleTerms
        >>> g = torch.Generator().manual_seed(0)
        >>> problem = torchsfm.random_bundle_problem(4, 50, 150, noise=0.5, generator=g).problem
        >>> terms: BundleTerms = {"free": ("focal",), "fixed_poses": torch.arange(4) == 0, "loss": torchsfm.Huber(2.0)}
        >>> better = torchsfm.bundle_adjust_model(problem, **terms).model
        >>> bool(better.poses.t[0].equal(problem.poses.t[0]))
        True
        >>> torchsfm.bundle_covariance(better, **terms).nullity  # of the same terms: the size of the world alone is open
        1
    """

    free: Sequence[str]
    fixed_poses: Bool[Tensor, "f"] | None
    fixed_points: Bool[Tensor, "n"] | None
    fixed_cameras: Bool[Tensor, "g"] | None
    fixed_intrinsics: Mapping[str, Bool[Tensor, "g"]] | None
    rig: Rig | None
    fixed_sensors: Bool[Tensor, "k"] | None
    weights: Float[Tensor, "m"] | None
    loss: Loss | None
    priors: Sequence[Prior]
    intrinsics_sigma: Mapping[str, float | Tensor] | None
    intrinsics_mean: Camera | None
    structure: Sequence[Structure]


@dataclass(frozen=True)
class Bundle:
    """A problem with what is adjusted, held and known of it, by the names of `BundleTerms`.

    Raises:
        ValueError: Shapes, dtypes or indices do not fit.
    """

    start: BundleProblem
    free: Sequence[str] = ("focal",)
    fixed_poses: Tensor | None = None
    fixed_points: Tensor | None = None
    fixed_cameras: Tensor | None = None
    fixed_intrinsics: Mapping[str, Tensor] | None = None
    rig: Rig | None = None
    fixed_sensors: Tensor | None = None
    weights: Tensor | None = None
    loss: Loss | None = None
    priors: Sequence[Prior] = ()
    intrinsics_sigma: Mapping[str, float | Tensor] | None = None
    intrinsics_mean: Camera | None = None
    structure: Sequence[Structure] = ()

    @cached_property
    def poses(self) -> Pose:
        """The poses that move: of the views, or of the frames of the rig."""
        return self.start.poses if self.rig is None else self.rig.frame_poses(self.start.poses)

    def __post_init__(self) -> None:
        start, rig = self.start, self.rig
        check_options(problem=(start, BundleProblem))
        check_options(
            poses=(start.poses, Pose),
            cameras=(start.cameras, Camera),
            free=(self.free, Sequence),
            fixed_intrinsics=(self.fixed_intrinsics, Mapping | None),
            rig=(rig, Rig | None),
            loss=(self.loss, Callable | None),
            priors=(self.priors, list | tuple),
            intrinsics_sigma=(self.intrinsics_sigma, Mapping | None),
            intrinsics_mean=(self.intrinsics_mean, Camera | None),
            structure=(self.structure, list | tuple),
        )
        views, groups = start.poses.shape[0], start.cameras.shape[0]
        check_index(view=(start.view, views), point=(start.point, len(start.X)), camera_index=(start.camera_index, groups))
        if rig is not None:
            check_tensors(
                poses=(start.poses.R, "v 3 3"),
                cam_from_rig=(rig.cam_from_rig.R, "k 3 3"),
                sensor=(rig.sensor, "v: int"),
                fixed_sensors=(self.fixed_sensors, "?k: bool"),
            )
            check_index(**{"rig.sensor": (rig.sensor, len(rig.cam_from_rig.t)), "rig.frame": (rig.frame, views)})
        elif self.fixed_sensors is not None:
            raise ValueError("fixed_sensors: wanted none without a rig")
        poses = self.poses.shape[0]
        check_one_problem(
            X=(start.X, "n 3"),
            x=(start.x, "m 2"),
            cameras=(start.cameras.K, "g 3 3"),
            fixed_poses=(self.fixed_poses, f"?{poses}: bool"),
            fixed_points=(self.fixed_points, "?n: bool"),
            fixed_cameras=(self.fixed_cameras, "?g: bool"),
            weights=(self.weights, "?m"),
        )
        check_options(**{f"priors[{k}]": (prior, Prior) for k, prior in enumerate(self.priors)})
        check_options(**{f"structure[{k}]": (some, Structure) for k, some in enumerate(self.structure)})
        if len({some.block for some in self.structure}) < len(self.structure):
            raise ValueError(f"structure: wanted one of a kind, got {[some.block for some in self.structure]}")
        for some in self.structure:
            some.check(views)
        limits = {"pose": poses, "point": len(start.X), "camera": groups}
        check_index(**{f"priors[{k}].index": (prior.index, limits[prior.block]) for k, prior in enumerate(self.priors)})

    def problem(self) -> tuple[dict[str, Block], list[Term]]:
        """The variables, "pose", "camera", "point", with a rig "sensor", and those of other structure; and the terms.

        The first term is the reprojection of points, then come those of other structure, one each.

        Raises:
            ValueError: A name of a number in the cameras is unknown.
        """
        cameras, X, x, view, point = self.start.cameras, self.start.X, self.start.x, self.start.view, self.start.point
        camera = self.start.camera_index[view]
        model = type(cameras.distortion)
        columns = free_columns(self.free, model)
        rows = row_from_camera(cameras)
        manifold: Subset | Switched = Subset(rows.shape[1], columns)
        if self.fixed_intrinsics:
            manifold = Switched(rows.shape[1], columns)
            switches = free_switches(columns, self.fixed_intrinsics, model, cameras.K)
            rows = torch.cat((rows, switches.to(rows.dtype)), 1)
        counts = x.isfinite().all(-1) & rows.isfinite().all(-1)[camera]
        if self.weights is not None:
            counts &= self.weights > 0
        view_poses = self.poses if self.rig is None else self.rig.view_poses(self.poses)
        blocks = {
            "pose": Block(_pose_rows(self.poses), RigidMotion(), self.fixed_poses),
            "camera": Block(rows, manifold, self.fixed_cameras),
            "point": Block(ray_points(X, view_poses.centre, view, point, counts), RayPoint(), self.fixed_points),
        }
        skew = SKEW in columns or cameras.K.requires_grad or bool((rows[:, SKEW] != 0).any())
        projection = Projection(model, columns, skew, bool(self.fixed_intrinsics))
        data, options = (x,), (self.loss, self.weights)
        names: tuple[str, ...]
        of_view: tuple[Tensor, ...]
        through: Projection | RigProjection
        if self.rig is None:
            through, names = projection, ("pose", "camera")
            of_view = (torch.arange(len(view_poses.t), device=X.device), self.start.camera_index)
        else:
            blocks["sensor"] = Block(_pose_rows(self.rig.cam_from_rig), RigidMotion(), self.fixed_sensors)
            through, names = RigProjection(projection), ("pose", "sensor", "camera")
            of_view = (self.rig.frame, self.rig.sensor, self.start.camera_index)
        seen_by = cameras[self.start.camera_index]
        sight = Sight(names, of_view, projection, through.residual, through.linearize, view_poses, seen_by)
        seen = (*names, "point"), (*sight.at(view), point)
        terms = [Term(through.residual, *seen, data, *options, through.linearize, bend=partial(bend, projection))]
        for some in self.structure:
            blocks[some.block] = some.variables(sight)
            terms.append(some.term(sight, blocks[some.block]))
        terms += [_prior_term(prior) for prior in self.priors]
        if self.intrinsics_sigma:
            terms.append(intrinsics_prior(self.intrinsics_sigma, self.intrinsics_mean or cameras))
        if self.world_is_free(blocks) and not all(some.follows_world for some in self.structure):
            rest = partial(gauge_motions, keep_size=self.size_is_known)
            blocks["pose"] = replace(blocks["pose"], rest=rest)
        return blocks, terms

    def world_is_free(self, blocks: Mapping[str, Block]) -> bool:
        """Whether nothing says where the world is: no pose or structure held, no pose known but to others."""
        held = [blocks[name].fixed for name in ("pose", *structure_blocks(self))]
        relative = all(isinstance(prior, RelativePosePrior) or prior.block == "camera" for prior in self.priors)
        return relative and not any(fixed is not None and bool(fixed.any()) for fixed in held)

    @property
    def size_is_known(self) -> bool:
        """Whether a rig, or motions between poses, say how large the world is."""
        rig, held = self.rig, self.fixed_sensors
        rigid = rig is not None and held is not None and bool((rig.cam_from_rig.t[held] != 0).any())
        return rigid or any(isinstance(prior, RelativePosePrior) and prior.knows_places() for prior in self.priors)


def cheapest_elimination(
    blocks: Mapping[str, Block], terms: Sequence[Term], structure: tuple[str, ...] = ("point",)
) -> tuple[str, ...]:
    """Points and other structure, unless eliminating poses leaves a system of less than half the size: film of few points.

    Poses that something binds to each other, or that move together in no step, cannot be eliminated one by one.
    """
    sizes = {name: block.x.shape[0] * block.tangent for name, block in blocks.items()}
    seen = sum(sizes[name] for name in structure)
    rest = sum(size for name, size in sizes.items() if name not in ("pose", *structure))
    bound = blocks["pose"].rest is not None or any(term.blocks.count("pose") > 1 for term in terms)
    return ("pose",) if 2 * (seen + rest) < sizes["pose"] + rest and not bound else structure


def structure_blocks(bundle: Bundle) -> tuple[str, ...]:
    """The blocks of what the views see: points and other structure."""
    return ("point", *(some.block for some in bundle.structure))


def moved_poses(poses: Pose, start: Tensor, end: Tensor) -> Pose:
    """Poses that did not move keep every bit."""
    moved = (start != end).any(-1)
    new = end.to(poses.t.dtype)
    R = torch.where(moved[:, None, None], new[:, :9].reshape(-1, 3, 3), poses.R)
    return Pose(R, torch.where(moved[:, None], new[:, 9:], poses.t))


def moved_cameras(cameras: Camera, start: Tensor, end: Tensor) -> Camera:
    """Cameras whose K did not change keep every bit of it."""
    changed = (start[:, :HEAD] != end[:, :HEAD]).any(-1)
    new = camera_from_row(end, type(cameras.distortion))
    return Camera(torch.where(changed[:, None, None], new.K, cameras.K), new.distortion)


def _prior_term(prior: Prior) -> Term:
    """A prior's term; one on points sees them without where their rays begin."""
    term = prior.term()
    if prior.block != "point":
        return term
    return replace(term, residual=lambda point, *data: term.residual(point[:, :3], *data))


def _pose_rows(poses: Pose) -> Tensor:
    return torch.cat((_orthonormal(poses.R.double()).flatten(1), poses.t.double()), 1)


def _orthonormal(R: Tensor) -> Tensor:
    """The nearest rotations, by two Newton steps for the polar factor.

    Rotations that come rounded (float32, text files) would make scale a direction in which the cost still falls a little.
    """
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    near = (R.mT @ R - eye).abs().amax((-2, -1), keepdim=True) < 0.1
    turned = R
    for _ in range(2):
        turned = turned @ (1.5 * eye - 0.5 * (turned.mT @ turned))
    return torch.where(near, turned, R)
