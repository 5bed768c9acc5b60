"""The pose of a calibrated camera as points and lines together determine it: what `ransac` needs to know."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Solutions, broadcast_shapes
from torchsfm.geometry import to_homogeneous
from torchsfm.linalg import cross, eigh
from torchsfm.resection.camera_1p2l import camera_1p2l
from torchsfm.resection.camera_2p1l import camera_2p1l
from torchsfm.resection.camera_3l import camera_3l
from torchsfm.resection.camera_p3p import camera_p3p
from torchsfm.resection.flat_structure import flatness, flatness_suspected
from torchsfm.resection.reprojection_step import moved_pose, retracted_pose
from torchsfm.resection.sights import SEGMENT, look, seen_ends, sight_step, slopes, squared_distance
from torchsfm.robust import Degeneracy, Weigh

_SOLVERS: tuple[Callable[..., Solutions[Tensor]], ...] = (
    lambda d, X, *_: camera_p3p(d, X),
    camera_2p1l,
    camera_1p2l,
    lambda *sample: camera_3l(*sample[2:]),
)
"""By the number of lines."""
_MOTION = 0.5
"""A turn in radians, and a shift in distances of the camera from the structure, that should be seen."""


@dataclass(frozen=True)
class PointLineCameraEstimator:
    """The pose [R | t] of a calibrated camera from points and lines in one table.

    A row is a point, a segment on a line, or a line: `kind` 0, 1 or 2. Its image `x` are the two ends of the segment, or two
    image points of the line, or the point twice; in the world, `X` is the Pluecker vector (d, m) of the line, |d| = 1, or the
    point and three zeros. The distance of a line is the root of the sum of the squared distances of both ends from its image:
    two independent errors, as the two coordinates of a point are. It is infinite for what is behind the camera; of a line
    without ends nobody knows. The structure should be of moderate size around 0.

    Attributes:
        K: Intrinsics of the camera of each problem; its last row is (0, 0, 1).

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.geometry import pluecker_from_points
        >>> g = torch.Generator().manual_seed(0)
        >>> P = torchsfm.random_poses(generator=g).matrix()
        >>> points, ends = torchsfm.random_points(20, generator=g), torchsfm.random_points(20, generator=g).reshape(10, 2, 3)
        >>> seen = torchsfm.project_points(P, torch.cat((points[:, None].expand(20, 2, 3), ends)))  # a point twice, or two ends
        >>> seen[:3] += 0.1  # wrong
        >>> X = torch.cat((torch.cat((points, torch.zeros_like(points)), -1), pluecker_from_points(ends[:, 0], ends[:, 1])))
        >>> kind = torch.arange(30).ge(20).to(torch.int64)  # 0 is a point, 1 a segment
        >>> estimator = torchsfm.resection.PointLineCameraEstimator(torch.eye(3).double())
        >>> found = torchsfm.ransac(estimator, seen.flatten(-2), X, kind[:, None].double(), threshold=0.001, generator=g)
        >>> bool(found.model.allclose(P, atol=1e-6)), found.inliers.sum()
        (True, tensor(27))
    """

    K: Float[Tensor, "*batch 3 3"]

    model_name: ClassVar[str] = "point_line_camera"
    data_names: ClassVar[tuple[str, ...]] = ("x", "X", "kind")
    sample_size: ClassVar[int] = 3
    max_solutions: ClassVar[int] = 8
    codimension: ClassVar[int] = 2
    dimension: ClassVar[int] = 6
    never_zero: ClassVar[bool] = True

    def minimal(
        self, x: Float[Tensor, "*#batch 3 4"], X: Float[Tensor, "*#batch 3 6"], kind: Float[Tensor, "*#batch 3 1"]
    ) -> Solutions[Float[Tensor, "*batch 8 3 4"]]:
        """The poses of three points and lines that have all of them in front."""
        batch = broadcast_shapes(self.K.shape[:-2], x.shape[:-2], X.shape[:-2], kind.shape[:-2])
        K, x, X, kind = (t.expand(*batch, *t.shape[-2:]).flatten(0, -3) if batch else t[None] for t in (self.K, x, X, kind))
        order = (kind > 0.5 * SEGMENT).long().argsort(dim=1, stable=True)
        x, X, kind = (t.gather(1, order.expand_as(t)) for t in (x, X, kind))
        h, e = to_homogeneous(x[..., :2]), to_homogeneous(x[..., 2:])
        d, l = h @ torch.linalg.inv_ex(K)[0].mT, cross(h, e) @ K  # noqa: E741
        lines = (kind > 0.5 * SEGMENT).sum((1, 2))
        model = torch.eye(3, 4, dtype=x.dtype, device=x.device).expand(len(x), 8, 3, 4)
        valid = torch.zeros(len(x), 8, dtype=torch.bool, device=x.device)
        for number, solve in enumerate(_SOLVERS):
            row, k = (lines == number).nonzero()[:, 0], 3 - number
            if len(row) or not len(x):
                found = solve(d[row, :k], X[row, :k, :3], l[row, k:], X[row, k:])
                slots = found.valid.shape[-1]
                own = torch.cat((found.model, model[row, slots:]), 1)
                model = model.index_copy(0, row, own)
                valid = valid.index_copy(0, row, torch.nn.functional.pad(found.valid, (0, 8 - slots)))
        with torch.no_grad():
            sight = look((K[:, None] @ model).detach(), x[:, None], X[:, None], kind[:, None])
            valid = valid & (sight.depth > 0).all(-1)[..., 0] & kind.isfinite().all(1)
        return Solutions(model.reshape(*batch, 8, 3, 4), valid.reshape(*batch, 8))

    def squared_residual(
        self,
        model: Float[Tensor, "*#batch 3 4"],
        x: Float[Tensor, "*#batch n 4"],
        X: Float[Tensor, "*#batch n 6"],
        kind: Float[Tensor, "*#batch n 1"],
    ) -> Float[Tensor, "*batch n"]:
        """Squared distance in the image; infinite behind the camera."""
        return squared_distance(look(self.K @ model, x, X, kind))

    def degenerate(
        self, x: Float[Tensor, "*#batch 3 4"], X: Float[Tensor, "*#batch 3 6"], kind: Float[Tensor, "*#batch 3 1"]
    ) -> Bool[Tensor, "*batch"]:
        """Whether two of the image points, or of the segments, coincide."""
        batch = broadcast_shapes(self.K.shape[:-2], x.shape[:-2], X.shape[:-2], kind.shape[:-2])
        a, b, c = x.expand(*batch, 3, 4).unbind(-2)
        return (a == b).all(-1) | (b == c).all(-1) | (c == a).all(-1)

    def places(
        self,
        model: Float[Tensor, "*#batch 3 4"],
        x: Float[Tensor, "*#batch n 4"],
        X: Float[Tensor, "*#batch n 6"],
        kind: Float[Tensor, "*#batch n 1"],
    ) -> Float[Tensor, "*batch n 11"]:
        """The images, and the structure as seen from the distance of its size."""
        return torch.cat((x, self._focal()[..., None, None] * torch.cat((X, kind), -1)), -1)

    def step(
        self,
        model: Float[Tensor, "*#batch 3 4"],
        x: Float[Tensor, "*#batch n 4"],
        X: Float[Tensor, "*#batch n 6"],
        kind: Float[Tensor, "*#batch n 1"],
        *,
        weigh: Weigh,
    ) -> Float[Tensor, "*batch 3 4"]:
        """A Gauss-Newton step on the distances in the image, along the rigid motions."""
        step, batch = sight_step(self.K @ model, x, X, kind, weigh)
        return moved_pose(model, step, batch).to(x.dtype)

    def retract(self, model: Float[Tensor, "*#batch 3 4"], step: Float[Tensor, "*#batch 6"]) -> Float[Tensor, "*batch 3 4"]:
        """[R | t] <- exp(w) [R | t] + [0 | v], as `Pose.retract`."""
        return retracted_pose(model, step)

    def may_be_degenerate(
        self,
        model: Float[Tensor, "*#batch 3 4"],
        x: Float[Tensor, "*#batch n 4"],
        X: Float[Tensor, "*#batch n 6"],
        kind: Float[Tensor, "*#batch n 1"],
        *,
        inliers: Bool[Tensor, "*#batch n"],
        threshold: Float[Tensor, "*#batch"],
        chance: Float[Tensor, "*#batch"],
    ) -> Bool[Tensor, "*batch"]:
        """Whether what the inliers show of points and lines may be in a plane, or leave a motion of the camera unseen."""
        points, twice = self._structure(model, x, X, kind, inliers)
        flat = flatness_suspected(model, points, self._focal(), twice, threshold, 2 * (2 + chance))
        return flat if flat.all() else flat | self._unseen(model, x, X, kind, inliers, threshold, 2 + chance)

    def degeneracy(
        self,
        model: Float[Tensor, "*#batch 3 4"],
        x: Float[Tensor, "*#batch n 4"],
        X: Float[Tensor, "*#batch n 6"],
        kind: Float[Tensor, "*#batch n 1"],
        *,
        inliers: Bool[Tensor, "*#batch n"],
        threshold: Float[Tensor, "*#batch"],
        chance: Float[Tensor, "*#batch"],
    ) -> Int[Tensor, "*batch"]:
        """What all inliers but so few as chance explains have in common.

        COLLINEAR: what is seen of them is on one line; UNDETERMINED: a large motion of the camera changes nothing that is seen
        of them (lines that are parallel or meet in a point); PLANAR: what is seen of them is in a plane.
        """
        points, twice = self._structure(model, x, X, kind, inliers)
        code = flatness(model, points, self._focal(), twice, threshold, 2 * (2 + chance))
        unseen = self._unseen(model, x, X, kind, inliers, threshold, 2 + chance) & (code != Degeneracy.COLLINEAR)
        return torch.where(unseen, int(Degeneracy.UNDETERMINED), code).to(torch.int8)

    def _structure(self, model: Tensor, x: Tensor, X: Tensor, kind: Tensor, inliers: Tensor) -> tuple[Tensor, Tensor]:
        """Points, and the ends of what is seen of the lines; and which are inliers."""
        return torch.cat(seen_ends(self.K @ model, x, X, kind), -2), torch.cat((inliers, inliers), -1)

    def _unseen(
        self, model: Tensor, x: Tensor, X: Tensor, kind: Tensor, inliers: Tensor, threshold: Tensor, spare: Tensor
    ) -> Tensor:
        """Whether no more inliers than can be spared see the motion of the camera that they see least."""
        sight = look(self.K @ model, x, X, kind)
        J = torch.stack(slopes(sight, x, X), -1).movedim(-3, -1)
        # How far the structure is: a camera in a point of all lines has it at its nose.
        away = torch.linalg.vector_norm(sight.image, dim=-2)
        reach = torch.where(inliers, away, torch.nan).nanmedian(dim=-1).values[..., None, None, None]
        J = torch.cat((J[..., :3], J[..., 3:] * reach), -1)
        J = torch.where(inliers[..., None, None], J, 0.0).nan_to_num(0, 0, 0)
        weights = inliers.to(J.dtype)
        seen = torch.zeros_like(weights)
        for _ in range(4):
            weighted = (J * weights[..., None, None]).flatten(-3, -2)
            _, vectors, _ = eigh(weighted.mT @ weighted)
            seen = _MOTION * (J @ vectors[..., None, :, :1])[..., 0].square().sum(-1).sqrt()
            weights = torch.where(inliers, threshold[..., None] / (seen + threshold[..., None]), 0.0)
        unseen: Tensor = (inliers & (seen > threshold[..., None])).sum(-1) <= spare
        return unseen

    def _focal(self) -> Tensor:
        focal: Tensor = (self.K[..., 0, 0] * self.K[..., 1, 1]).abs().sqrt()
        return focal
