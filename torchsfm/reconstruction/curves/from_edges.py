"""Curves in space from photographs with known cameras: edges, followed through the images around, fused, linked."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.bundle import bundle_adjust
from torchsfm.bundle.curves import edge_distances
from torchsfm.geometry import BundleProblem, Camera, Pose
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.optim import GemanMcClure
from torchsfm.reconstruction.curves.edge_maps import MapsOfImages
from torchsfm.reconstruction.curves.edge_on import seen_edge_on
from torchsfm.reconstruction.curves.fusion import fuse_pieces
from torchsfm.reconstruction.curves.image_edges import ImageEdges
from torchsfm.reconstruction.curves.noise import TRUSTED, measured_weights
from torchsfm.reconstruction.curves.outlines import on_outlines
from torchsfm.reconstruction.curves.pieces import Pieces, image_pieces
from torchsfm.reconstruction.curves.tracks import track_samples
from torchsfm.reconstruction.messages import Progress
from torchsfm.reconstruction.model.curves import Curves
from torchsfm.reconstruction.model.similarities import DEVIATION

_ANGLE = 15.0
"""Angle, in degrees, at which the images around an image see the scene best: edges still look alike, and depths are told."""
_FAR = 5.0
"""Depth of the scene in distances between neighbouring cameras where nothing tells it."""
_SHORTEST = 4
"""Samples of the shortest piece: ten pixels or so."""
_AGREE = 4
"""Images, the followed one included, that must see a sample."""
_SETTLED, _STEPS = 2, 5
"""Rounds in which samples come to the least squares of all edges that show them, and the most steps of each."""


class SeenEdges(NamedTuple):
    """The edges of images that their lenses show."""

    kept: list[ImageEdges]
    maps: MapsOfImages
    """Where they are without distortion."""

    @classmethod
    def of(cls, edges: Sequence[ImageEdges], size: tuple[int, int], cameras: Camera) -> "SeenEdges":
        """Those of images of which `size` is the largest height and width."""
        seen = [own.seen_by(cameras[i]) for i, own in enumerate(edges)]
        return cls([own for own, _ in seen], MapsOfImages([straight for _, straight in seen], size))


@on_the_cpu
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
) -> Curves:
    """Find the curves in space that the edges of photographs are images of.

    The edges of each image, linked into curves, are followed through the images around it: along the ray of an edge point those
    depths are candidates at which other images have an edge that runs as the image of the curve must, best with the brighter
    side on the same side; of these the path of most votes is taken, and refined to the least squares of distances. Pieces from
    different images that lie on each other are averaged; what too few images found is dropped; the rest is linked.

    Outlines of smooth surfaces are images of no one curve. Where four images and more say so, as lines of sight do not meet
    there but pass on one side, ten pixels and more away, they are left out; other pieces of them survive.

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
        The curves, the longest first, in the world of the poses, with the edge points that show them.

    Raises:
        ValueError: Wrong shape, dtype, device or option; another number of images than of cameras.

    Example:
        >>> import torch, torchsfm
        >>> scene = torchsfm.render_sequence(views=3, width=96, height=72, generator=torch.Generator().manual_seed(0))
        >>> images, cameras, poses = scene.images, scene.cameras, scene.poses
        >>> found = torchsfm.reconstruction.reconstruct_curves(images, cameras, poses, points=scene.X)
        >>> found.X.shape[-1], len(found) > 0, bool((found.support() >= 2).float().mean() > 0.9)
        (3, True, True)
    """
    check_views(cameras, poses, neighbours=neighbours)
    check_options(threshold=(threshold, "float > 0"), least_images=(least_images, "int >= 1"))
    report = progress or (lambda stage, done, total: None)
    edges, size = edges_of_images(images, len(poses.R), report)
    return curves_of_edges(
        edges, size, cameras, poses, points=points, neighbours=neighbours, threshold=threshold,
        least_images=least_images, progress=report,
    )  # fmt: skip


def check_views(cameras: Camera, poses: Pose, *, neighbours: int) -> None:
    """Raise where cameras and poses are not one of each for every image."""
    check_tensors(K=(cameras.K, "3 3"), R=(poses.R, "3 3"), t=(poses.t, "3"))
    check_options(neighbours=(neighbours, "int >= 1"))
    v = len(poses.R)
    if poses.R.shape != (v, 3, 3) or cameras.K.shape != (v, 3, 3):
        raise ValueError(
            f"cameras, poses: wanted one of each for every image, got {tuple(cameras.K.shape[:-2])} and {tuple(poses.shape)}"
        )


def edges_of_images(
    images: Iterable[Float[Tensor, "c h w"] | None], number: int, progress: Progress
) -> tuple[list[ImageEdges], tuple[int, int]]:
    """The edges of so many images, and the largest height and width."""
    edges = []
    height = width = 8
    for i, image in enumerate(images):
        progress("edges", i, number)
        if i >= number:
            raise ValueError(f"images: wanted {number}, as many as cameras, got more")
        if image is not None:
            height, width = max(height, image.shape[-2]), max(width, image.shape[-1])
        edges.append(ImageEdges.none() if image is None else ImageEdges.of(image))
    progress("edges", number, number)
    if len(edges) != number:
        raise ValueError(f"images: wanted {number}, as many as cameras, got {len(edges)}")
    return edges, (height, width)


def curves_of_edges(
    edges: Sequence[ImageEdges],
    size: tuple[int, int],
    cameras: Camera,
    poses: Pose,
    *,
    points: Float[Tensor, "n 3"] | None,
    neighbours: int = 10,
    threshold: float = 2.0,
    least_images: int = 3,
    finders_alone: bool = False,
    seen: SeenEdges | None = None,
    progress: Progress,
) -> Curves:
    """`reconstruct_curves` from the edges of images, of which `size` is the largest height and width.

    With `finders_alone` samples are shown by images alone whose own edges led there, for cameras that are to be adjusted by
    them. Elsewhere samples are behind something, next to its edges by chance, or on the rim of what is round, where every curve
    runs along the outline and lies inside of it: a third of all edges of smooth objects, and off alike. Where cameras are right
    already, samples are somewhat better by all edges. `seen` are the edges by these cameras, where they are known.
    """
    v = len(edges)
    kept, maps = seen or SeenEdges.of(edges, size, cameras)
    P = cameras.K.double() @ poses.matrix().double()
    around = neighbouring_views(P, size, None if points is None else points.double(), neighbours)
    pieces = []
    for i, near in enumerate(around):
        progress("follow", i, v)
        near = [j for j in near if len(kept[j])]
        if near and len(kept[i]):
            views = [i, *near]
            sights, agree = [maps[j] for j in views], min(_AGREE, len(views))
            pieces.append(image_pieces(i, sights, P[views], threshold=threshold, least_views=agree, shortest=_SHORTEST))
    progress("follow", v, v)
    if not sum(len(p.piece) for p in pieces):
        return no_curves(poses.R)
    offset, shifted = 0, []
    for p in pieces:
        shifted.append(p._replace(piece=p.piece + offset))
        offset += int(p.piece.amax()) + 1 if len(p.piece) else 0
    together = Pieces(*(torch.cat(field) for field in zip(*shifted, strict=True)))
    fused = fuse_pieces(together, least_images=least_images, shortest=_SHORTEST)
    # The longest first.
    number = torch.bincount(fused.curve, minlength=len(fused.closed))
    order = number.argsort(descending=True, stable=True)
    curve = torch.empty_like(order).scatter_(0, order, torch.arange(len(order), device=order.device))[fused.curve]
    moved = curve.argsort(stable=True)
    X, source, like = fused.X[moved], fused.source[moved], poses.R
    count = torch.tensor([len(own) for own in kept], device=like.device)
    edge = together.edge[source] + (count.cumsum(0) - count)[together.image[source]]
    color = torch.cat([own.color for own in kept])[edge]
    curves = replace(
        no_curves(like), X=X.to(like), curve=curve[moved], closed=fused.closed[order], color=color.to(like),
        sigma=fused.sigma[moved].to(like),
    )  # fmt: skip
    found = None
    if finders_alone:
        place = torch.empty_like(moved).scatter_(0, moved, torch.arange(len(moved), device=like.device))
        found = place[fused.finders[:, 0]] * v + fused.finders[:, 1]
    return _shown_by(curves, found, kept, maps, cameras, poses, threshold)


def curves_of_other_cameras(
    curves: Curves, edges: Sequence[ImageEdges], size: tuple[int, int], cameras: Camera, poses: Pose, *, threshold: float = 2.0
) -> Curves:
    """What `curves_of_edges` found, where cameras have changed a little since: shown by the edges that are near now.

    Images that did not show a sample before do not show it now.
    """
    shown = curves.sample * len(edges) + curves.view
    return _shown_by(curves, shown, *SeenEdges.of(edges, size, cameras), cameras, poses, threshold)


def _shown_by(
    curves: Curves,
    found: Int[Tensor, "f"] | None,
    edges: Sequence[ImageEdges],
    maps: MapsOfImages,
    cameras: Camera,
    poses: Pose,
    threshold: float,
) -> Curves:
    """The curves at the least squares of the edges that run along them, with these edges.

    If given, those alone that `found` tells: number of the sample times that of all images, and the image.
    """
    P = cameras.K.double() @ poses.matrix().double()

    def tracked(curves: Curves) -> Curves:
        near = track_samples(curves, curves.tangents(), edges, maps, P, threshold)
        if found is None:
            return near
        near = near.seen_where(torch.isin(near.sample * len(edges) + near.view, found))
        return near.seen_where(~seen_edge_on(near, cameras, poses))

    # After they have moved, what edges no longer run along is left behind.
    curves = tracked(settle_samples(tracked(curves), cameras, poses, threshold))
    outline = on_outlines(curves, cameras, poses)
    if bool(outline.any()):
        curves = curves.runs_where(~outline)
        curves = curves.select(curves.number >= _SHORTEST)
    return measured_weights(curves, edge_distances(poses, cameras, curves.bundle()))


def settle_samples(curves: Curves, cameras: Camera, poses: Pose, most: float) -> Curves:
    """The curves with samples at the robust least squares of their distances from all edges that show them; cameras are held.

    What is fused of pieces lies between them, off what images show by more than noise and alike along whole pieces: edges
    would be taken for that much worse.

    Args:
        curves: The curves, near there.
        cameras: Of each image (v).
        poses: Of each image (v).
        most: Pixels in the images a sample was found in by which it may move: what edges hardly hold stays.
    """
    moved, none = curves, curves.sample[:0]
    problem = BundleProblem(
        poses, cameras, torch.arange(len(poses.R), device=none.device), poses.t[:0], curves.x[:0], none, none
    )
    for _ in range(_SETTLED):
        r = edge_distances(poses, cameras, moved.bundle()).abs()
        scale = DEVIATION * float(r[r.isfinite()].median()) if bool(r.isfinite().any()) else 0.0
        if not scale > 0:
            return curves
        found = bundle_adjust(
            problem, structure=(moved.bundle(loss=GemanMcClure(TRUSTED * scale)),), free=(), max_iterations=_STEPS,
            fixed_poses=torch.ones(len(poses.R), dtype=torch.bool, device=none.device),
        )  # fmt: skip
        if found.status == Status.INTERRUPTED:
            raise KeyboardInterrupt
        moved = moved.adjusted(found.structure[0])  # type: ignore[arg-type]
    near = torch.linalg.vector_norm(moved.X - curves.X, dim=-1) <= most * curves.sigma
    return replace(curves, X=torch.where(near[:, None], moved.X, curves.X))


def no_curves(like: Tensor) -> Curves:
    """None, in the dtype of a tensor."""
    none = like.new_zeros(0)
    x, index = none.reshape(0, 2), none.long()
    return Curves(none.reshape(0, 3), index, none.bool(), none.reshape(0, 3), none, x, x, none, none, index, index)


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
