"""Curves in space from photographs with known cameras: edges, followed through the images around, fused, linked."""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import check_options, check_tensors
from torchsfm.geometry import Camera, Curve, Pose, Spline, fit_spline
from torchsfm.images import Edges, detect_edges
from torchsfm.reconstruction.curve_fusion import fuse_pieces, piece_tangents
from torchsfm.reconstruction.curve_pieces import Pieces, image_pieces
from torchsfm.reconstruction.edge_maps import EdgePoints
from torchsfm.reconstruction.report import Progress

_ANGLE = 15.0
"""Angle, in degrees, at which the images around an image see the scene best: edges still look alike, and depths are told."""
_FAR = 5.0
"""Depth of the scene in distances between neighbouring cameras where nothing tells it."""
_SHORTEST = 4
"""Samples of the shortest piece: ten pixels or so."""
_AGREE = 4
"""Images, the followed one included, that must see a sample."""


@dataclass(frozen=True)
class CurveReconstruction:
    """Curves in space, sample by sample.

    See the example of `reconstruct_curves`.
    """

    curve: Curve
    """The curves (c, n), the longest first."""
    images: Int[Tensor, "c n"]
    """From how many images' edges each sample was found; 0 in empty slots."""
    sigma: Float[Tensor, "c n"]
    """Standard deviation of each sample across the curve for noise of one pixel in the images that see it from one image's
    edge; those of several images were averaged. 0 in empty slots."""

    def splines(self, tolerance: float) -> list[Spline]:
        """A cubic B-spline for each curve, of as few control points, by doubling, as leave no sample farther away than this."""
        check_options(tolerance=(tolerance, "float > 0"))
        return [
            _spline(self.curve.x[i, : int(n)], bool(self.curve.closed[i]), tolerance) for i, n in enumerate(self.curve.number)
        ]


def reconstruct_curves(
    images: Iterable[Float[Tensor, "c h w"] | None],
    cameras: Camera,
    poses: Pose,
    *,
    points: Float[Tensor, "n 3"] | None = None,
    neighbours: int = 10,
    threshold: float = 2.0,
    least_images: int = 3,
    progress: Progress | None = None,
) -> CurveReconstruction:
    """Find the curves in space that the edges of photographs are images of.

    The edges of each image, linked into curves, are followed through the images around it: along the ray of an edge point those
    depths are candidates at which other images have an edge that runs as the image of the curve must, best with the brighter
    side on the same side; of these the path of most votes is taken, and refined to the least squares of distances. Pieces from
    different images that lie on each other are averaged; what too few images found is dropped; the rest is linked.

    Outlines of smooth surfaces are images of no one curve: pieces of them survive where surfaces are bent much.

    Args:
        images: The photographs, one after another, grey or red, green, blue; None for one that is missing.
        cameras: Of each image (v).
        poses: Of each image (v).
        points: Points of the scene, if any are known: they tell how far away it is.
        neighbours: Images in which the edges of an image are sought.
        threshold: Distance in pixels of an edge that an image still agrees with.
        least_images: Images whose edges must have led to a sample.
        progress: Called as the work goes on.

    Returns:
        The curves, in the world of the poses.

    Raises:
        ValueError: Wrong shape, dtype, device or option; another number of images than of cameras.

    Example:
        >>> import torch, torchsfm
        >>> scene = torchsfm.render_sequence(views=3, width=96, height=72, generator=torch.Generator().manual_seed(0))
        >>> images, cameras, poses = scene.images, scene.cameras, scene.poses
        >>> found = torchsfm.reconstruction.reconstruct_curves(images, cameras, poses, points=scene.X)
        >>> found.curve.x.shape[-1], len(found.curve.x) > 0
        (3, True)
    """
    check_tensors(K=(cameras.K, "3 3"), R=(poses.R, "3 3"), t=(poses.t, "3"))
    check_options(
        neighbours=(neighbours, "int >= 1"), threshold=(threshold, "float > 0"), least_images=(least_images, "int >= 1")
    )
    report = progress or (lambda stage, done, total: None)
    v = len(poses.R)
    if poses.R.shape != (v, 3, 3) or cameras.K.shape != (v, 3, 3):
        raise ValueError(
            f"cameras, poses: wanted one of each for every image, got {tuple(cameras.K.shape[:-2])} and {tuple(poses.shape)}"
        )
    edges, size = _edges(images, cameras, v, report)
    P = cameras.K.double() @ poses.matrix().double()
    around = neighbouring_views(P, size, None if points is None else points.double(), neighbours)
    pieces = []
    for i, near in enumerate(around):
        report("follow", i, v)
        near = [j for j in near if len(edges[j].x)]
        if near and len(edges[i].x):
            views = [i, *near]
            agree = min(_AGREE, len(views))
            pieces.append(
                image_pieces(
                    i, [edges[j] for j in views], P[views], size, threshold=threshold, least_views=agree, shortest=_SHORTEST
                )
            )
    report("follow", v, v)
    return _packed(pieces, least_images, poses.R)


def neighbouring_views(
    P: Float[Tensor, "v 3 4"], size: tuple[int, int], points: Float[Tensor, "n 3"] | None, number: int
) -> list[list[int]]:
    """For each image those that see what is in its middle from the sides, the best first."""
    axes = torch.nn.functional.normalize(P[:, 2, :3], dim=-1)
    back = torch.linalg.inv_ex(P[:, :, :3]).inverse
    centres = -(back @ P[..., 3:])[..., 0]
    depth = _depths(centres, axes, P, size, points)
    middle = centres + depth[:, None] * axes
    seen = torch.einsum("jab,ib->ija", P[..., :3], middle) + P[:, :, 3]
    y = seen[..., :2] / seen[..., 2:].clamp_min(1e-300)
    extent = torch.tensor([size[1], size[0]], dtype=P.dtype, device=P.device)
    visible = (seen[..., 2] > 0) & ((y > -0.25 * extent) & (y < 1.25 * extent)).all(-1)
    to_own = torch.nn.functional.normalize(centres - middle, dim=-1)[:, None]
    to_other = torch.nn.functional.normalize(centres - middle[:, None], dim=-1)
    angle = torch.rad2deg(torch.linalg.vector_norm(torch.linalg.cross(to_own.expand_as(to_other), to_other), dim=-1).asin())
    good = visible & ((to_own * to_other).sum(-1) > 0.3) & (angle > 0.5)
    score = torch.where(good, (angle.clamp_min(0.5) / _ANGLE).log().abs(), torch.inf)
    return [[j for j in row.argsort().tolist()[:number] if score[i, j] < torch.inf] for i, row in enumerate(score)]


def _depths(centres: Tensor, axes: Tensor, P: Tensor, size: tuple[int, int], points: Tensor | None) -> Float[Tensor, "v"]:
    """How far along its axis each camera's scene is."""
    v = len(centres)
    gap = torch.cdist(centres, centres) + torch.where(torch.eye(v, dtype=torch.bool, device=P.device), torch.inf, 0)
    typical = gap.amin(-1)[torch.isfinite(gap.amin(-1))]
    far = _FAR * (float(typical.median()) if len(typical) else 1.0)
    # The point nearest to all axes, held weakly where the axes are parallel.
    across = torch.eye(3, dtype=P.dtype, device=P.device) - axes[:, :, None] * axes[:, None]
    guess = centres + far * axes
    weak = 1e-2 * torch.eye(3, dtype=P.dtype, device=P.device)
    focus = torch.linalg.solve_ex(
        across.sum(0) + v * weak, ((across @ centres[..., None])[..., 0] + guess @ weak).sum(0)
    ).result
    depth = ((focus - centres) * axes).sum(-1)
    depth = torch.where(depth > 0, depth, far)
    if points is None or not len(points):
        return depth
    y = torch.einsum("vab,nb->vna", P[..., :3], points) + P[:, None, :, 3]
    x = y[..., :2] / y[..., 2:].clamp_min(1e-300)
    inside = (y[..., 2] > 0) & (x > 0).all(-1) & (x < torch.tensor([size[1], size[0]], dtype=P.dtype, device=P.device)).all(-1)
    scale = torch.linalg.vector_norm(P[:, 2, :3], dim=-1, keepdim=True)
    known = torch.where(inside, y[..., 2] / scale, torch.nan).nanmedian(-1).values
    return torch.where(known.isnan(), depth, known)


def _edges(
    images: Iterable[Tensor | None], cameras: Camera, v: int, report: Progress
) -> tuple[list[EdgePoints], tuple[int, int]]:
    """The edges of each image, without distortion, and the largest height and width."""
    found: list[EdgePoints] = []
    height = width = 8
    for i, image in enumerate(images):
        report("edges", i, v)
        if i >= v:
            raise ValueError(f"images: wanted {v}, as many as cameras, got more")
        if image is None:
            found.append(_straight(None, cameras[i]))
            continue
        height, width = max(height, image.shape[-2]), max(width, image.shape[-1])
        found.append(_straight(detect_edges(image), cameras[i]))
    report("edges", v, v)
    if len(found) != v:
        raise ValueError(f"images: wanted {v}, as many as cameras, got {len(found)}")
    return found, (height, width)


def _straight(edges: Edges | None, camera: Camera) -> EdgePoints:
    """Edge points as a camera without distortion sees them."""
    if edges is None:
        none = torch.zeros(0, 2, dtype=torch.float64, device=camera.K.device)
        return EdgePoints(none, none, torch.zeros(0, dtype=torch.long, device=camera.K.device))
    n = int(edges.valid.sum())
    d, valid = camera.unproject(edges.x[:n].to(camera.K))
    y = d.double() @ camera.K.double().mT
    good = valid & (d[:, 2] > 0.1)
    x = y[good, :2] / y[good, 2:]
    chain, out = edges.chain[:n][good], (~good).long().cumsum(0)[good]
    # What is taken out of a chain leaves two.
    new = torch.zeros_like(chain)
    new[1:] = (chain[1:] != chain[:-1]) | (out[1:] != out[:-1])
    chain = new.cumsum(0)
    return EdgePoints(x, piece_tangents(x, chain), chain)


def _packed(pieces: list[Pieces], least_images: int, like: Tensor) -> CurveReconstruction:
    """The curves of all pieces, the longest first, of the dtype and on the device of a tensor."""
    offset, shifted = 0, []
    for p in pieces:
        shifted.append(p._replace(piece=p.piece + offset))
        offset += int(p.piece.amax()) + 1 if len(p.piece) else 0
    if not offset:
        none = like.new_zeros(0, 2)
        return CurveReconstruction(Curve(like.new_zeros(0, 2, 3), none.bool(), none[:, 0].bool()), none.long(), none)
    together = Pieces(*(torch.cat(field) for field in zip(*shifted, strict=True)))
    fused = fuse_pieces(together, least_images=least_images, shortest=_SHORTEST)
    number = torch.bincount(fused.curve, minlength=len(fused.closed))
    order = number.argsort(descending=True, stable=True)
    place = torch.empty_like(order).scatter_(0, order, torch.arange(len(order), device=order.device))
    slot = torch.arange(len(fused.curve), device=order.device) - (number.cumsum(0) - number)[fused.curve]
    row, most = place[fused.curve], int(number.amax()) if len(number) else 2

    def lay(values: Tensor) -> Tensor:
        out = values.new_zeros(len(number), most, *values.shape[1:])
        out[row, slot] = values
        return out

    x, sigma = lay(fused.X).to(like.dtype), lay(fused.sigma).to(like.dtype)
    return CurveReconstruction(
        Curve(x, lay(torch.ones_like(fused.curve, dtype=torch.bool)), fused.closed[order]), lay(fused.images), sigma
    )


def _spline(x: Float[Tensor, "n 3"], closed: bool, tolerance: float) -> Spline:
    curve = Curve(x, torch.ones(len(x), dtype=torch.bool, device=x.device), torch.tensor(closed, device=x.device))
    controls = 4
    while True:
        spline, gap = fit_spline(curve, controls, closed=closed)
        if float(gap.amax()) <= tolerance or 2 * controls > len(x):
            return spline
        controls *= 2
