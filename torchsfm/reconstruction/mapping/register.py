"""Place further images by the points they see."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Camera, Pose, krt_from_camera
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.structure import visible_points
from torchsfm.resection import estimate_camera, estimate_camera_focal

MIN_VISIBLE = 20
MIN_INLIERS = 15
MIN_INLIER_RATIO = 0.25
SEARCHED = 0.1
"""Focal lengths more uncertain than this, as a fraction, are estimated with the pose of the first image of a camera."""
DEVIATIONS, TOGETHER = 4.0, 10.0
"""The largest error of an inlier in standard deviations of image points, as long as a model is rough; so many image points err
alike, as neighbours and things that look alike do, and count as one."""
SURPRISE = 10.0
"""Twice the logarithm of how many times likelier an image must be with another focal length than its camera has."""


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
    focal_sigma: Float[Tensor, "g"],
    least: Float[Tensor, "g"] | None = None,
    ratios: Sequence[float] = (1.0,),
    generator: torch.Generator | None,
) -> tuple[Mapping, Int[Tensor, "k"], Int[Tensor, "k"]]:
    """Estimate the poses of several images in one batched call, and register those that find enough support.

    Args:
        mapping: The model so far.
        images: Images to try.
        threshold: Largest reprojection error of an inlier in pixels.
        focal_sigma: How uncertain the focal lengths are, as a fraction; those of more than `SEARCHED` are estimated as well.
        least: What another focal length must gain, twice the logarithm of a likelihood; 0 where it is not given.
        ratios: How many times as much as their cameras have it images may have been stretched along y where the focal length is
            estimated; each but 1 must gain `SURPRISE` more.
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
    camera = mapping.camera_index[images]
    K = mapping.cameras.K[camera]
    x = d @ K.mT
    x = x[..., :2] / x[..., 2:].clamp(min=1e-9)
    result = estimate_camera(x, X, K, threshold=threshold, mask=mask, generator=generator)
    model, inliers, status = result.model.clone(), result.inliers.clone(), result.status.clone()
    surplus = focal_sigma.new_zeros(k) if least is None else least[camera]
    K, changed = _with_focal_lengths(
        x, X, K, mask, camera, focal_sigma[camera], result.support, surplus, ratios, threshold, generator
    )
    if len(changed):
        again = estimate_camera(
            x[changed], X[changed], K[changed], threshold=threshold, mask=mask[changed], generator=generator
        )
        model[changed], inliers[changed], status[changed] = again.model, again.inliers, again.status
    count, fitting = mask.sum(-1), inliers.sum(-1)
    good = (status == Status.OK) & (fitting >= MIN_INLIERS) & (fitting >= MIN_INLIER_RATIO * count.double())
    R, t, registered = mapping.poses.R.clone(), mapping.poses.t.clone(), mapping.registered.clone()
    accepted = images[good]
    R[accepted], t[accepted] = model[good][..., :3], model[good][..., 3]
    registered[accepted] = True
    K_all = mapping.cameras.K.clone()
    K_all[camera[good]] = K[good]
    mapping = replace(mapping, poses=Pose(R, t), registered=registered, cameras=Camera(K_all, mapping.cameras.distortion))
    fits = torch.cat([m[inliers[row, : len(m)]] for row, m in enumerate(members) if bool(good[row])] or [node[:0]])
    mapping = mapping.assign(node[fits], point[fits], mapping.errors(point[fits], node[fits]))
    return mapping, count, fitting


def _with_focal_lengths(
    x: Float[Tensor, "k n 2"],
    X: Float[Tensor, "k n 3"],
    K: Float[Tensor, "k 3 3"],
    mask: Bool[Tensor, "k n"],
    camera: Int[Tensor, "k"],
    sigma: Float[Tensor, "k"],
    support: Float[Tensor, "k"],
    least: Float[Tensor, "k"],
    ratios: Sequence[float],
    threshold: float,
    generator: torch.Generator | None,
) -> tuple[Float[Tensor, "k 3 3"], Int[Tensor, "c"]]:
    """Intrinsics with the focal lengths that are likelier than those expected, and the rows that have others now.

    Likelier by what the points say of it, and by how far it is from what was expected: points in a plane that faces the
    camera say nothing, and agree with any.
    """
    open_ = (sigma > SEARCHED).nonzero()[:, 0]
    if not len(open_):
        return K, open_
    # Images as cameras with square pixels would show them, at the scale that they have, so that errors stay as large.
    ratio = K[open_, 1, 1] / K[open_, 0, 0] * x.new_tensor(ratios)[:, None]
    squared = torch.stack((ratio.sqrt(), ratio.rsqrt()), -1)
    centre = K[open_, :2, 2]
    found = estimate_camera_focal(
        x[open_] + (x[open_] - centre[:, None]) * (squared[:, :, None] - 1), X[open_], centre,
        threshold=threshold, mask=mask[open_], generator=generator,
    )  # fmt: skip
    focal = krt_from_camera(found.model)[0][..., 0, 0, None] / squared
    expected = K[open_].diagonal(dim1=-2, dim2=-1)[:, :2].log().mean(-1)
    gain = (found.support - support[open_]) * DEVIATIONS**2 / TOGETHER
    gain = gain - ((focal.log().mean(-1) - expected) / sigma[open_]).square() - least[open_]
    gain = gain - SURPRISE * (x.new_tensor(ratios) != 1)[:, None]
    gain, which = torch.where(found.status == Status.OK, gain, -1.0).nan_to_num(-1.0).max(0)
    focal = focal.gather(0, which[None, :, None].expand(1, -1, 2))[0]
    K = K.clone()
    for own in torch.unique(camera[open_]).tolist():
        # Images of one camera have one focal length: that of the image which tells most of it.
        row = (camera[open_] == own).nonzero()[:, 0]
        best = row[gain[row].argmax()]
        if gain[best] > 0:
            K[camera == own, :2, :2] *= (focal[best] / K[open_[best]].diagonal()[:2])[:, None]
    return K, open_[torch.isin(camera[open_], camera[open_][gain > 0])]
