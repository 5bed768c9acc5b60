"""Lines of space in a bundle: the two ends of each segment against the image of its line, whatever the lens makes of it.

An image line is the image of the plane through the line and the camera's centre, whose normal in the camera's frame is the
moment m of the line there. The residual of an end is its distance from that image, a curve where lenses distort: rays in the
plane are projected through the whole camera, never ends undistorted, so that intrinsics may be free. The foot of the end is
the ray of the plane nearest to the ray of the end, moved once along the curve: the distance does not change to first order
with where the foot is, so that the ray may be that of the camera at the start.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_index, check_options, check_tensors
from torchsfm.bundle.structure import Sight
from torchsfm.geometry import Camera, Line3D, Pose, Similarity, transform_lines
from torchsfm.geometry.intrinsic_parameters import row_from_camera
from torchsfm.geometry.line_manifold import world_covariance
from torchsfm.geometry.projection import PixelProjection
from torchsfm.linalg import cross
from torchsfm.optim import Block, Loss, Term

_TINY = 1e-300


@dataclass(frozen=True)
class BundleLines:
    """Lines of space and segments that views show of them.

    Ends need not correspond between views. Lines without observations, or that are fixed, come back bit for bit.
    """

    L: Float[Tensor, "l 6"]
    """Pluecker lines (d, m) in the world."""
    x: Float[Tensor, "k 2 2"]
    """Two points of each image line, pixels: ends of segments, or what `Segments.fit_points` gives."""
    view: Int[Tensor, "k"]
    """Which view shows each segment."""
    line: Int[Tensor, "k"]
    """Which line it shows."""
    fixed: Bool[Tensor, "l"] | None = None
    """Lines that do not move."""
    weights: Float[Tensor, "k"] | None = None
    """Factors of the squared distances of both ends of a segment: inverse variances, in the unit in which observations of
    points weigh 1; 0 leaves it out."""
    loss: Loss | None = None
    """Robust loss of the squared distance, both ends together, pixels."""
    block = "line"

    def __post_init__(self) -> None:
        check_tensors(
            L=(self.L, "l 6"), x=(self.x, "k 2 2"), view=(self.view, "k: int"), line=(self.line, "k: int"),
            fixed=(self.fixed, "?l: bool"), weights=(self.weights, "?k"),
        )  # fmt: skip
        check_options(loss=(self.loss, Callable | None))
        check_index(line=(self.line, len(self.L)))

    def check(self, views: int) -> None:
        """See that the observations fit a bundle of so many views.

        Raises:
            ValueError: A segment is in no view.
        """
        check_index(**{"structure.view": (self.view, views)})

    def variables(self, sight: Sight) -> Block:
        """Lines in frames of their own, where a view that sees them has its centre: no line that is seen passes there."""
        L, centre = self.L.double(), sight.poses.centre.detach().double()
        of_line = self.view.new_full((len(L),), len(centre)).scatter_reduce(0, self.line, self.view, "amin")
        origin = torch.cat((centre, centre.new_zeros(1, 3)))[of_line]
        d = L[:, :3]
        moment = L[:, 3:] - cross(origin, d)
        # The distance of the line for a unit makes direction and moment of one length.
        ratio = (moment.detach().square().sum(-1) / d.detach().square().sum(-1).clamp_min(_TINY)).sqrt()
        unit = torch.where((ratio > 0) & ratio.isfinite(), ratio, 1.0)[:, None]
        return Block(torch.cat((d, moment / unit, origin, unit), 1), LocalLine(), self.fixed)

    def term(self, sight: Sight, start: Block) -> Term:
        """The distances of both ends from the line's image."""
        x = self.x.double()
        rays, valid = sight.cameras[self.view].unproject(self.x.detach().double())
        rays = torch.where(valid[..., None], rays, torch.nan)
        index = (*sight.at(self.view), self.line)

        def residual(*rows: Tensor) -> Tensor:
            *poses, camera, line, x, rays = rows
            R, t = sight.pose(*poses)
            normal = _moment_in_camera(line.mT, R, t)
            return _distances(sight.projection.inside.pixels, camera.mT, normal, x.permute(2, 1, 0), rays.permute(2, 1, 0))

        return Term(residual, (*sight.blocks, self.block), index, (x, rays), self.loss, self.weights)

    def covariance(self, x: Tensor, C: Tensor) -> Tensor:
        """Covariances (l, 4, 4) of the steps of `Line3D` from the lines in the world; zero for lines through its origin."""
        d, m, origin, unit = x[:, :3], x[:, 3:6], x[:, 6:9], x[:, 9:]
        world = torch.cat((d, unit * m + cross(origin, d)), 1)
        world = world / torch.linalg.vector_norm(d, dim=1, keepdim=True).clamp_min(_TINY)
        known = C.diagonal(dim1=-2, dim2=-1).isfinite().all(-1)[:, None, None]
        return torch.where(known, world_covariance(torch.where(known, C, 0.0), x[:, :6], world, origin, unit[:, 0]), C)

    def moved(self, start: Tensor, end: Tensor, world: Similarity | None) -> "BundleLines":
        """The lines after the adjustment, of the length they had."""
        moved = (start != end).any(-1, keepdim=True)
        d, m, origin, unit = end[:, :3], end[:, 3:6], end[:, 6:9], end[:, 9:]
        L = torch.cat((d, unit * m + cross(origin, d)), 1)
        if world is not None:
            L = transform_lines(world.matrix().to(L), L)
        size = torch.linalg.vector_norm(self.L.double(), dim=1, keepdim=True)
        L = L * (size / torch.linalg.vector_norm(L, dim=1, keepdim=True).clamp_min(_TINY))
        return replace(self, L=torch.where(moved, L.to(self.L.dtype), self.L))


def segment_distances(poses: Pose, cameras: Camera, lines: BundleLines) -> Float[Tensor, "k 2"]:
    """Signed distances of both ends of segments from the images of their lines, pixels, by the pose and camera of each view."""
    model = type(cameras.distortion)
    pose, camera = poses[lines.view], cameras[lines.view]
    rays, valid = camera.unproject(lines.x)
    L = lines.L[lines.line]
    d = torch.linalg.vecdot(pose.R, L[:, None, :3])
    normal = torch.linalg.vecdot(pose.R, L[:, None, 3:]) + cross(pose.t, d)
    rows = row_from_camera(camera).double().mT
    x, rays = lines.x.double().permute(2, 1, 0), torch.where(valid[..., None], rays, torch.nan).double().permute(2, 1, 0)
    return _distances(PixelProjection(model).pixels, rows, normal.double().mT, x, rays).to(lines.x.dtype)


@dataclass(frozen=True)
class LocalLine:
    """Lines (d, m) about an origin of their own, moments in a unit of their own, both of which stay: `(d, m, origin, unit)`."""

    ambient: int = 10
    tangent: int = 4

    def retract(self, x: Float[Tensor, "*#b 10"], delta: Float[Tensor, "*#b 4"]) -> Float[Tensor, "*b 10"]:
        """The line after a step of `Line3D` in its frame."""
        line = Line3D().retract(x[..., :6], delta)
        return torch.cat((line, x[..., 6:].expand(*line.shape[:-1], 4)), -1)


def _moment_in_camera(line: Tensor, R: Tensor, t: Tensor) -> Tensor:
    """The normals (3, k) of the planes of sight, up to scale: the moments of lines (10, k) about the camera's centre."""
    d, m, origin, unit = line[:3], line[3:6], line[6:9], line[9:]
    from_origin = (R * origin).sum(1) + t
    turned, moment = (R * d).sum(1), (R * m).sum(1)
    normal: Tensor = unit * moment + torch.linalg.cross(from_origin, turned, dim=0)
    return normal


def _distances(
    pixels: Callable[[Tensor, Tensor], Tensor],
    camera: Float[Tensor, "c k"],
    normal: Float[Tensor, "3 k"],
    x: Float[Tensor, "2 e k"],
    rays: Float[Tensor, "3 e k"],
) -> Float[Tensor, "k e"]:
    """Signed distances of image points from the images of planes through the centre, positive to one side all along."""
    unit = (normal / normal.square().sum(0).clamp_min(_TINY).sqrt())[:, None]
    foot = rays - (rays * unit).sum(0) * unit
    camera = camera[:, None]
    for last in (False, True):
        along = torch.linalg.cross(unit.expand_as(foot), foot, dim=0)
        place, tangent = _projected(pixels, camera, foot, along)
        square = tangent.square().sum(0).clamp_min(_TINY)
        away = x - place
        if last:
            break
        foot = foot + ((away * tangent).sum(0) / square) * along
    distance: Tensor = (tangent[0] * away[1] - tangent[1] * away[0]) / square.sqrt()
    return distance.mT


def _projected(
    pixels: Callable[[Tensor, Tensor], Tensor], camera: Tensor, ray: Float[Tensor, "3 *n"], along: Float[Tensor, "3 *n"]
) -> tuple[Float[Tensor, "2 *n"], Float[Tensor, "2 *n"]]:
    """Image points of rays, and how they move where the rays move along a direction."""
    follow = torch.is_grad_enabled() and any(t.requires_grad for t in (camera, ray, along))
    with torch.enable_grad():
        ray = ray if ray.requires_grad else ray.detach().requires_grad_()
        place = pixels(ray, camera)
        ones = torch.ones_like(place[0])
        slopes = [torch.autograd.grad(row, ray, ones, create_graph=follow, retain_graph=True)[0] for row in place]
        tangent = torch.stack([(slope * along).sum(0) for slope in slopes])
    return (place, tangent) if follow else (place.detach(), tangent.detach())
