"""A bundle as blocks of variables and terms over them, and back."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsfm._types import check_one_problem, check_options, check_tensors
from torchsfm.bundle.intrinsics import Switched, free_columns, free_switches
from torchsfm.bundle.priors import Prior
from torchsfm.bundle.projection import Projection
from torchsfm.bundle.rays import RayPoint, ray_points
from torchsfm.bundle.rig import Rig, RigProjection
from torchsfm.geometry import Camera, Pose
from torchsfm.geometry.intrinsic_parameters import HEAD, SKEW, camera_from_row, row_from_camera
from torchsfm.optim import Block, Loss, RigidMotion, Subset, Term


@dataclass(frozen=True)
class Bundle:
    """What is adjusted: everything that blocks and terms are made of; see `bundle_adjust`."""

    poses: Pose
    cameras: Camera
    X: Tensor
    x: Tensor
    view: Tensor
    point: Tensor
    camera_index: Tensor | None
    free: Sequence[str]
    rig: Rig | None
    fixed_poses: Tensor | None
    fixed_points: Tensor | None
    fixed_cameras: Tensor | None
    fixed_intrinsics: Mapping[str, Tensor] | None
    fixed_sensors: Tensor | None
    weights: Tensor | None
    loss: Loss | None
    priors: Sequence[Prior]

    def camera_of_views(self) -> Tensor:
        """Check shapes and indices; return the camera of each view.

        Raises:
            ValueError: Something does not fit.
        """
        poses, cameras, rig = self.poses, self.cameras, self.rig
        check_options(
            poses=(poses, Pose),
            cameras=(cameras, Camera),
            free=(self.free, Sequence),
            fixed_intrinsics=(self.fixed_intrinsics, Mapping | None),
            rig=(rig, Rig | None),
            loss=(self.loss, Callable | None),
            priors=(self.priors, list | tuple),
        )
        if len(poses.shape) != 1 or len(cameras.shape) != 1:
            got = f"{tuple(poses.shape)}, {tuple(cameras.shape)}"
            raise ValueError(f"poses, cameras: wanted one batch dimension each, got {got}")
        views = poses.shape[0] if rig is None else rig.frame.shape[0]
        check_one_problem(
            poses=(poses.R, f"{poses.shape[0]} 3 3"),
            cameras=(cameras.K, "g 3 3"),
            X=(self.X, "n 3"),
            x=(self.x, "m 2"),
            view=(self.view, "m: int"),
            point=(self.point, "m: int"),
            camera_index=(self.camera_index, f"?{views}: int"),
            fixed_poses=(self.fixed_poses, f"?{poses.shape[0]}: bool"),
            fixed_points=(self.fixed_points, "?n: bool"),
            fixed_cameras=(self.fixed_cameras, "?g: bool"),
            weights=(self.weights, "?m"),
        )
        groups = cameras.shape[0]
        index = self.camera_index
        if index is None:
            if groups not in (1, views):
                raise ValueError(
                    f"camera_index: wanted the camera of each view, since there are {groups} cameras and {views} views"
                )
            index = torch.arange(views, device=self.X.device) if groups == views else self.view.new_zeros(views)
        check_index(view=(self.view, views), point=(self.point, self.X.shape[0]), camera_index=(index, groups))
        if rig is not None:
            check_tensors(
                poses=(poses.R, "f 3 3"),
                cam_from_rig=(rig.cam_from_rig.R, "k 3 3"),
                fixed_sensors=(self.fixed_sensors, "?k: bool"),
            )
            check_index(**{"rig.sensor": (rig.sensor, rig.cam_from_rig.shape[0]), "rig.frame": (rig.frame, poses.shape[0])})
        elif self.fixed_sensors is not None:
            raise ValueError("fixed_sensors: wanted none without a rig")
        limits = {"pose": poses.shape[0], "point": self.X.shape[0]}
        check_index(**{f"priors[{k}].index": (prior.index, limits[prior.block]) for k, prior in enumerate(self.priors)})
        return index

    def problem(self) -> tuple[dict[str, Block], list[Term]]:
        """The variables, "pose", "camera", "point" and with a rig "sensor", and the terms, reprojection first.

        Raises:
            ValueError: Something does not fit.
        """
        camera_index = self.camera_of_views()
        model = type(self.cameras.distortion)
        columns = free_columns(self.free, model)
        rows = row_from_camera(self.cameras)
        manifold: Subset | Switched = Subset(rows.shape[1], columns)
        if self.fixed_intrinsics:
            manifold = Switched(rows.shape[1], columns)
            switches = free_switches(columns, self.fixed_intrinsics, model, self.cameras.K)
            rows = torch.cat((rows, switches.to(rows.dtype)), 1)
        counts = (self.x.isfinite().all(-1)) & rows.isfinite().all(-1)[camera_index[self.view]]
        if self.weights is not None:
            counts &= self.weights > 0
        centres = (self.poses if self.rig is None else self.rig.view_poses(self.poses)).centre
        blocks = {
            "pose": Block(_pose_rows(self.poses), RigidMotion(), self.fixed_poses),
            "camera": Block(rows, manifold, self.fixed_cameras),
            "point": Block(ray_points(self.X, centres, self.view, self.point, counts), RayPoint(), self.fixed_points),
        }
        skew = SKEW in columns or self.cameras.K.requires_grad or bool((rows[:, SKEW] != 0).any())
        projection = Projection(model, columns, skew, bool(self.fixed_intrinsics))
        camera = camera_index[self.view]
        data, options = (self.x,), (self.loss, self.weights)
        if self.rig is None:
            index = (self.view, camera, self.point)
            term = Term(projection.residual, ("pose", "camera", "point"), index, data, *options, projection.linearize)
        else:
            blocks["sensor"] = Block(_pose_rows(self.rig.cam_from_rig), RigidMotion(), self.fixed_sensors)
            through = RigProjection(projection)
            names = ("pose", "sensor", "camera", "point")
            places = (self.rig.frame[self.view], self.rig.sensor[self.view], camera, self.point)
            term = Term(through.residual, names, places, data, *options, through.linearize)
        return blocks, [term, *(_prior_term(prior) for prior in self.priors)]


def cheapest_elimination(blocks: Mapping[str, Block]) -> str:
    """Points, unless eliminating poses leaves a system of less than half the size: film of few points."""
    sizes = {name: block.x.shape[0] * block.tangent for name, block in blocks.items()}
    rest = sum(size for name, size in sizes.items() if name not in ("pose", "point"))
    return "pose" if 2 * (sizes["point"] + rest) < sizes["pose"] + rest else "point"


def check_index(**indices: tuple[Tensor, int]) -> None:
    """See that index tensors, each given with its limit, point at something.

    Raises:
        ValueError: A number is negative or not below its limit.
    """
    for name, (index, limit) in indices.items():
        if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < limit:
            raise ValueError(f"{name}: wanted numbers from 0 to {limit - 1}, got {int(index.min())} to {int(index.max())}")


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
