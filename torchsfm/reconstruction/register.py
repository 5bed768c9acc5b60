"""Place further images by the points they see."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Camera, Pose
from torchsfm.reconstruction.mapping import Mapping
from torchsfm.reconstruction.structure import visible_points
from torchsfm.resection import estimate_camera

MIN_VISIBLE = 20
MIN_INLIERS = 15
MIN_INLIER_RATIO = 0.25
FOCAL_GRID = torch.logspace(-0.4, 0.6, 12, dtype=torch.float64)
"""Focal lengths tried for a camera nothing is known of, as multiples of the first guess."""


def visibility_scores(mapping: Mapping) -> tuple[Int[Tensor, "v"], Float[Tensor, "v"]]:
    """How many 3D points each unregistered image sees, and how well they are spread over it.

    The spread counts occupied cells on grids of 2, 4, ..., 64 cells a side, finer grids weighing more (Schönberger & Frahm
    2016, section 4.2).
    """
    graph, v = mapping.graph, len(mapping.graph.names)
    node, _ = visible_points(mapping, ~mapping.registered)
    node = torch.unique(node)
    view = graph.view[node]
    score = graph.x.new_zeros(v)
    relative = (graph.x[node] / graph.image_size[view]).clamp(0, 1 - 1e-9)
    for level in range(1, 7):
        cells = 2**level
        cell = (relative * cells).long()
        occupied = torch.unique(view * cells * cells + cell[:, 0] * cells + cell[:, 1]) // (cells * cells)
        score = score + torch.bincount(occupied, minlength=v) * cells
    return torch.bincount(view, minlength=v), score


def register_images(
    mapping: Mapping,
    images: Int[Tensor, "k"],
    *,
    threshold: float,
    focal_known: Bool[Tensor, "g"],
    generator: torch.Generator | None,
) -> tuple[Mapping, Int[Tensor, "k"], Int[Tensor, "k"]]:
    """Estimate the poses of several images in one batched call, and register those that find enough support.

    Args:
        mapping: The model so far.
        images: Images to try.
        threshold: Largest reprojection error of an inlier in pixels.
        focal_known: Cameras whose focal length is known; for the others a grid of focal lengths is tried as well.
        generator: Source of randomness.

    Returns:
        The mapping with the images that fit, and per image the number of correspondences and of inliers.
    """
    graph = mapping.graph
    chosen = torch.zeros(len(graph.names), dtype=torch.bool)
    chosen[images] = True
    node, point = visible_points(mapping, chosen)
    view = graph.view[node]
    members = [(view == i).nonzero()[:, 0] for i in images.tolist()]
    slots = max(1, *(len(m) for m in members))
    k = len(images)
    d, X = graph.x.new_zeros(k, slots, 3), graph.x.new_zeros(k, slots, 3)
    mask = torch.zeros(k, slots, dtype=torch.bool)
    for row, member in enumerate(members):
        d[row, : len(member)], mask[row, : len(member)] = mapping.rays(node[member])
        X[row, : len(member)] = mapping.X[point[member]]
    K = mapping.cameras.K[mapping.camera_index[images]]
    scale = torch.ones(1, dtype=K.dtype) if bool(focal_known[mapping.camera_index[images]].all()) else FOCAL_GRID.to(K.dtype)
    best_scale = torch.ones(k, dtype=K.dtype)
    x = d @ K.mT
    x = x[..., :2] / x[..., 2:].clamp(min=1e-9)
    if len(scale) > 1:
        # The pixels of a camera with another focal length are rays of another spread.
        K_try = K[:, None].repeat(1, len(scale), 1, 1)
        K_try[..., :2, :2] *= scale[:, None, None]
        trial = estimate_camera(
            x[:, None], X[:, None], K_try, threshold=threshold, mask=mask[:, None], generator=generator, max_iterations=200
        )
        support = trial.inliers.sum(-1)
        known = focal_known[mapping.camera_index[images]]
        support = torch.where(known[:, None] & (scale != 1), -1, support)
        best = support.argmax(dim=-1)
        best_scale, K = scale[best], K_try[torch.arange(k), best]
    result = estimate_camera(x, X, K, threshold=threshold, mask=mask, generator=generator)
    count, inliers = mask.sum(-1), result.inliers.sum(-1)
    good = (result.status == Status.OK) & (inliers >= MIN_INLIERS) & (inliers >= MIN_INLIER_RATIO * count.double())
    R, t, registered = mapping.poses.R.clone(), mapping.poses.t.clone(), mapping.registered.clone()
    accepted = images[good]
    R[accepted], t[accepted] = result.model[good][..., :3], result.model[good][..., 3]
    registered[accepted] = True
    K_all = mapping.cameras.K.clone()
    changed = good & (best_scale != 1)
    K_all[mapping.camera_index[images[changed]]] = K[changed]
    mapping = replace(mapping, poses=Pose(R, t), registered=registered, cameras=Camera(K_all, mapping.cameras.distortion))
    fits = torch.cat([m[result.inliers[row, : len(m)]] for row, m in enumerate(members) if bool(good[row])] or [node[:0]])
    mapping = mapping.assign(node[fits], point[fits], mapping.errors(point[fits], node[fits]))
    return mapping, count, inliers
