"""Cameras, images and points of two models in one world as those of one model."""

from dataclasses import replace

import torch
from jaxtyping import Int
from torch import Tensor

from torchsfm.geometry import DISTORTION_MODELS, Camera, Distortion, Pose
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.tracks import build_tracks
from torchsfm.reconstruction.matching.view_graph import ViewGraph
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.model.same_observations import joined_numbers


def common_kind(a: type[Distortion], b: type[Distortion]) -> type[Distortion] | None:
    """The first distortion model that holds those of both."""
    return next((kind for kind in DISTORTION_MODELS.values() if kind.includes(a) and kind.includes(b)), None)


def joined_views(a: Reconstruction, b: Reconstruction) -> Int[Tensor, "v"]:
    """The number of each image of the second model in the whole, which has those of the first one first."""
    place = {name: i for i, name in enumerate(a.names)}
    view = torch.tensor([place.get(name, -1) for name in b.names], dtype=torch.long)
    new = view < 0
    view[new] = len(place) + torch.arange(int(new.sum()))
    return view


def joined_points(
    a: Reconstruction, b: Reconstruction, both: list[tuple[int, int]], same: Int[Tensor, "k 2"], kind: type[Distortion]
) -> Mapping:
    """Both models, which are in one world now, as one whose shared points are one.

    Args:
        a: The first model.
        b: The second one in its world.
        both: Shared images.
        same: Observations of a and b that are one.
        kind: The distortion model that holds all cameras.
    """
    view_of = joined_views(a, b)
    new = (view_of >= len(a.names)).nonzero()[:, 0].tolist()
    camera_index, cameras = _joined_cameras(a, b, both, new, kind)
    poses = Pose(torch.cat((a.poses.R, b.poses.R[new])), torch.cat((a.poses.t, b.poses.t[new])))
    registered = torch.cat((a.registered, b.registered[new]))
    late = b.registered & ~registered[view_of]  # in both, with a pose in the second model alone
    R, t = poses.R.clone(), poses.t.clone()
    R[view_of[late]], t[view_of[late]] = b.poses.R[late], b.poses.t[late]
    registered[view_of[late]] = True
    # An image point for each observation, one for those that are the same.
    m = len(a.x)
    node_of = torch.full((len(b.x),), -1, dtype=torch.long)
    node_of[same[:, 1]] = same[:, 0]
    own = (node_of < 0).nonzero()[:, 0]
    node_of[own] = m + torch.arange(len(own))
    links = torch.cat((_links(a.point), node_of[_links(b.point)]))
    links = links[links[:, 0] != links[:, 1]]
    view = torch.cat((a.view, view_of[b.view[own]]))
    none = torch.zeros(0, dtype=torch.long)
    graph = ViewGraph(
        names=(*a.names, *(b.names[j] for j in new)),
        image_size=torch.cat((a.image_size, b.image_size[new])),
        x=torch.cat((a.x, b.x[own])),
        view=view,
        color=torch.cat((a.color[a.point], b.color[b.point[own]])),
        pairs=torch.zeros(0, 2, dtype=torch.long),
        num_matches=none,
        F=a.X.new_zeros(0, 3, 3),
        H=a.X.new_zeros(0, 3, 3),
        fundamental_inliers=none,
        homography_inliers=none,
        match=links,
        match_pair=torch.zeros(len(links), dtype=torch.long),
    )
    mapping = Mapping.start(graph, build_tracks(view, graph.match), cameras, camera_index)
    mapping = replace(mapping, poses=Pose(R, t), registered=registered)
    # The points of a keep their observations.
    target = joined_numbers(a.point[same[:, 0]], b.point[same[:, 1]], len(a.X), len(b.X))
    X = torch.cat((a.X, b.X[target >= len(a.X)]))
    mapping = replace(mapping, X=X, point=torch.cat((a.point, torch.full((len(own),), -1, dtype=torch.long))))
    point = target[b.point[own]]
    return mapping.assign(node_of[own], point, torch.zeros(len(own), dtype=X.dtype)).compacted()


def _links(point: Int[Tensor, "m"]) -> Int[Tensor, "k 2"]:
    """Observations of one point, each with the next; they are sorted by it, or not."""
    order = torch.argsort(point, stable=True)
    next_one = point[order[1:]] == point[order[:-1]]
    return torch.stack((order[:-1][next_one], order[1:][next_one]), 1)


def _joined_cameras(
    a: Reconstruction, b: Reconstruction, both: list[tuple[int, int]], new: list[int], kind: type[Distortion]
) -> tuple[Int[Tensor, "v"], Camera]:
    """The cameras of all images: one of b is one of a where it took the same images of both."""
    met: dict[int, set[int]] = {}
    for i, j in both:
        met.setdefault(int(b.camera_index[j]), set()).add(int(a.camera_index[i]))
    mine, theirs = _as_kind(a.cameras, kind), _as_kind(b.cameras, kind)
    number, added = dict[int, int](), list[int]()
    for k in sorted({int(b.camera_index[j]) for j in new}):
        if len(met.get(k, ())) == 1:
            number[k] = next(iter(met[k]))
        else:
            number[k] = len(mine.K) + len(added)
            added.append(k)
    index = torch.tensor([number[int(b.camera_index[j])] for j in new], dtype=torch.long)
    parameters = [one.distortion.parameters().reshape(len(one.K), kind.num_parameters) for one in (mine, theirs)]
    numbers = torch.cat((parameters[0], parameters[1][added]))
    cameras = Camera(torch.cat((mine.K, theirs.K[added])), kind.from_parameters(numbers))
    return torch.cat((a.camera_index, index)), cameras


def _as_kind(cameras: Camera, kind: type[Distortion]) -> Camera:
    """The same cameras with a distortion model that holds theirs."""
    own = cameras.distortion
    count = len(cameras.K)
    values = dict(zip(own.parameter_names, own.parameters().reshape(count, own.num_parameters).unbind(-1), strict=True))
    zero = cameras.K.new_zeros(count)
    columns = [values.get(name, zero) for name in kind.parameter_names]
    numbers = torch.stack(columns, -1) if columns else cameras.K.new_zeros(count, 0)
    return Camera(cameras.K, kind.from_parameters(numbers))
