"""The state of a model while it grows: which images have poses, which image points have 3D points."""

from collections.abc import Mapping as Dict
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import BundleProblem, Camera, Pose
from torchsfm.reconstruction.matching.view_graph import ViewGraph
from torchsfm.reconstruction.model.reconstruction import Reconstruction


@dataclass(frozen=True)
class Adjustment:
    """How an adjustment of a whole model went.

    Attributes:
        status: `OK` where it reached a minimum, `NOT_CONVERGED` where its limit of steps came first.
        iterations: Steps tried.
        free: By the names that `bundle_adjust` knows, the cameras in which a number was estimated.
        cost: Half the sum of losses, and of what was expected of the cameras, square pixels.
        initial_cost: The same before it.
    """

    status: Status
    iterations: int
    free: Dict[str, Bool[Tensor, "g"]]
    cost: float = 0.0
    initial_cost: float = 0.0


@dataclass(frozen=True)
class Mapping:
    """Cameras and points so far, over the image points of one `ViewGraph`.

    Attributes:
        graph: Image points and verified matches.
        track: Track of each image point, or -1.
        cameras: Intrinsics of the distinct cameras.
        camera_index: Which camera took each image.
        poses: `cam_from_world`; the identity where not registered.
        registered: Images with a pose.
        X: Points.
        point: 3D point of each image point, or -1. Only image points of registered images have one.
        adjustment: How the last adjustment of the whole went, if there was one.
    """

    graph: ViewGraph
    track: Int[Tensor, "n"]
    cameras: Camera
    camera_index: Int[Tensor, "v"]
    poses: Pose
    registered: Bool[Tensor, "v"]
    X: Float[Tensor, "p 3"]
    point: Int[Tensor, "n"]
    adjustment: Adjustment | None = None

    @classmethod
    def start(cls, graph: ViewGraph, track: Int[Tensor, "n"], cameras: Camera, camera_index: Int[Tensor, "v"]) -> "Mapping":
        """Nothing registered, no points."""
        v = len(graph.names)
        return cls(
            graph=graph,
            track=track,
            cameras=cameras,
            camera_index=camera_index,
            poses=Pose.identity(v, dtype=graph.x.dtype, device=graph.x.device),
            registered=torch.zeros(v, dtype=torch.bool),
            X=graph.x.new_zeros(0, 3),
            point=torch.full_like(graph.view, -1),
        )

    def project(self, point: Int[Tensor, "k"], view: Int[Tensor, "k"]) -> tuple[Float[Tensor, "k 2"], Float[Tensor, "k"]]:
        """Projections in pixels, and depths, of points in images given by index."""
        X_cam = self.poses[view].transform(self.X[point, None])
        return self.cameras[self.camera_index[view]].project(X_cam)[:, 0], X_cam[:, 0, 2]

    def errors(self, point: Int[Tensor, "k"], node: Int[Tensor, "k"]) -> Float[Tensor, "k"]:
        """Reprojection errors in pixels of 3D points at image points; infinite behind the camera."""
        x, depth = self.project(point, self.graph.view[node])
        error = (x - self.graph.x[node]).norm(dim=-1)
        return torch.where((depth > 0) & error.isfinite(), error, torch.inf)

    def rays(self, node: Int[Tensor, "k"]) -> tuple[Float[Tensor, "k 3"], Bool[Tensor, "k"]]:
        """Directions of image points in their camera frames, and whether distortion could be removed."""
        if len(self.cameras.K) == 1:
            # What is found out of each camera is not found out for each image point.
            return self.cameras[0].unproject(self.graph.x[node])
        index = self.camera_index[self.graph.view[node]]
        d, valid = self.cameras[index].unproject(self.graph.x[node, None])
        return d[:, 0], valid[:, 0]

    def observations(self) -> Int[Tensor, "m"]:
        """Image points that have a 3D point, sorted by it."""
        return self._observations

    @cached_property
    def _observations(self) -> Int[Tensor, "m"]:
        node = (self.point >= 0).nonzero()[:, 0]
        return node[torch.argsort(self.point[node], stable=True)]

    def problem(self, node: Int[Tensor, "m"] | None = None) -> BundleProblem:
        """What bundle adjustment starts from: all observations, or those of some image points that have a 3D point."""
        if node is None:
            node = self.observations()
        x, view, point = self.graph.x[node], self.graph.view[node], self.point[node]
        return BundleProblem(self.poses, self.cameras, self.camera_index, self.X, x, view, point)

    def assign(self, node: Int[Tensor, "k"], point: Int[Tensor, "k"], error: Float[Tensor, "k"]) -> "Mapping":
        """Give image points to 3D points where that leaves each point one observation per image and each node one point.

        Conflicts are decided for the smaller error. Nodes that have a point keep it.
        """
        free = self.point[node] < 0
        node, point, error = node[free], point[free], error[free]
        order = torch.argsort(error, stable=True)
        node, point = node[order], point[order]
        node, point = (t[first_of_each(node)] for t in (node, point))
        # An image is taken for a point when an observation already has it, or a better candidate does.
        view, v = self.graph.view, len(self.graph.names)
        taken = self.observations()
        key = torch.cat([self.point[taken] * v + view[taken], point * v + view[node]])
        first = first_of_each(key)
        first = first[first >= len(taken)] - len(taken)
        new = self.point.clone()
        new[node[first]] = point[first]
        return replace(self, point=new)

    def without(self, node: Int[Tensor, "k"]) -> "Mapping":
        """Take image points out of the model, and with them points seen by fewer than two."""
        point = self.point.clone()
        point[node] = -1
        return replace(self, point=point).compacted()

    def compacted(self) -> "Mapping":
        """Drop points with fewer than two observations and renumber the rest."""
        has = self.point >= 0
        keep = torch.bincount(self.point[has], minlength=len(self.X)) >= 2
        number = torch.where(keep, keep.cumsum(0) - 1, -1)
        point = torch.where(has, number[self.point.clamp(min=0)], -1) if len(number) else self.point
        return replace(self, X=self.X[keep], point=point)

    def reconstruction(self) -> Reconstruction:
        """The finished model, with colours averaged over observations."""
        node = self.observations()
        point = self.point[node]
        order = torch.argsort(point * len(self.graph.names) + self.graph.view[node])
        node, point = node[order], point[order]
        total = self.graph.color.new_zeros(len(self.X), 3).index_add(0, point, self.graph.color[node])
        count = torch.bincount(point, minlength=len(self.X)).clamp(min=1)
        return Reconstruction(
            names=self.graph.names,
            image_size=self.graph.image_size,
            cameras=self.cameras,
            camera_index=self.camera_index,
            poses=self.poses,
            registered=self.registered,
            X=self.X,
            color=total / count[:, None],
            x=self.graph.x[node],
            view=self.graph.view[node],
            point=point,
        )


def first_of_each(key: Int[Tensor, "k"]) -> Int[Tensor, "u"]:
    """Positions at which each value occurs for the first time, in order."""
    order = torch.argsort(key, stable=True)
    ordered = key[order]
    new = torch.ones_like(ordered, dtype=torch.bool)
    new[1:] = ordered[1:] != ordered[:-1]
    return order[new].sort().values
