"""Lines of space in a bundle: the two ends of each segment against the image of its line, whatever the lens makes of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_index, check_options, check_tensors
from torchsfm.bundle.line_bending import bend_line
from torchsfm.bundle.line_images import curve_distances, expand_distances, into_frames, nearest_on_curve, pull_back
from torchsfm.bundle.projection import Projection
from torchsfm.bundle.structure import Sight
from torchsfm.geometry import Camera, Line3D, Pose, Similarity, transform_lines
from torchsfm.geometry.intrinsic_parameters import row_from_camera
from torchsfm.geometry.line_manifold import line_tangents, world_covariance
from torchsfm.linalg import cross
from torchsfm.optim import Block, Loss, Term

_TINY = 1e-300


@dataclass(frozen=True)
class BundleLines:
    """Lines of space and segments that views show of them.

    Ends need not correspond between views. Lines without observations, or that are fixed, come back bit for bit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> truth = torchsfm.random_bundle_problem(4, 50, 100, layout="dome", noise=0.0, generator=g).truth
        >>> L = torchsfm.geometry.pluecker_from_points(truth.X[:1], truth.X[1:2])  # a line through two points
        >>> x = torchsfm.project_points(truth.poses, truth.X[:2], truth.cameras)  # the ends of a segment in every view
        >>> lines = torchsfm.BundleLines(L, x, torch.arange(4), torch.zeros(4, dtype=torch.int64))
        >>> found = torchsfm.bundle_adjust(truth, structure=(lines,), max_iterations=1)
        >>> found.structure[0].L.shape, bool(found.structure_residuals[0].max() < 1e-3)  # pixels
        (torch.Size([1, 6]), True)
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
    follows_world = True

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
        """Lines in frames of their own, about the centre of the farthest view that sees them.

        About one close to the line, a small step would turn it far.
        """
        L, centre = self.L.double(), sight.poses.centre.detach().double()
        d = L[:, :3]
        away = (L[:, 3:].detach()[self.line] - cross(centre[self.view], d.detach()[self.line])).square().sum(-1)
        most = away.new_zeros(len(L)).scatter_reduce(0, self.line, away, "amax")
        farthest = torch.where(away == most[self.line], self.view, len(centre))
        of_line = self.view.new_full((len(L),), len(centre)).scatter_reduce(0, self.line, farthest, "amin")
        origin = torch.cat((centre, centre.new_zeros(1, 3)))[of_line]
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
            moment = into_frames(line.mT, sight.motions(*poses))[-1][-1]
            return curve_distances(sight.projection, camera.mT, moment, _ends_first(x), _ends_first(rays)).mT

        def linearize(*rows: Tensor, out: list[Tensor | None]) -> Tensor:
            *poses, camera, line, x, rays = rows
            *by_poses, by_camera, by_line = (None if o is None else o.permute(1, 2, 0) for o in out)
            frames = into_frames(line.mT, sight.motions(*poses))
            by_free = None if by_camera is None else camera.new_empty(2, by_camera.shape[1], 2, len(camera))
            nearest = nearest_on_curve(sight.projection, camera.mT, frames[-1][-1], _ends_first(x), _ends_first(rays), by_free)
            if by_camera is not None and by_free is not None:
                torch.sum(nearest.across[:, None] * -by_free, 0, out=by_camera.transpose(0, 1))
            by_d, by_m = pull_back(nearest.by_normal(), frames, by_poses)
            if by_line is not None:
                _line_slopes(line, by_d, by_m, by_line)
            return nearest.distance.mT

        def second(*rows: Tensor, by: Tensor, wanted: Sequence[bool]) -> Tensor:
            *poses, camera, line, x, rays = rows
            frames = into_frames(line.mT, sight.motions(*poses))
            _, slope, lens = expand_distances(sight.projection, camera.mT, frames[-1][-1], _ends_first(x), _ends_first(rays))
            return bend_line(sight.projection, line, frames, camera, (by * slope[:3]).sum(1), (by * lens).sum(2), wanted)

        blocks = (*sight.blocks, self.block)
        return Term(residual, blocks, index, (x, rays), self.loss, self.weights, linearize, second)

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
    x, rays = _ends_first(lines.x.double()), _ends_first(torch.where(valid[..., None], rays, torch.nan).double())
    return curve_distances(Projection(model, ()), rows, normal.double().mT, x, rays).mT.to(lines.x.dtype)


@dataclass(frozen=True)
class LocalLine:
    """Lines (d, m) about an origin of their own, moments in a unit of their own, both of which stay: `(d, m, origin, unit)`."""

    ambient: int = 10
    tangent: int = 4

    def retract(self, x: Float[Tensor, "*#b 10"], delta: Float[Tensor, "*#b 4"]) -> Float[Tensor, "*b 10"]:
        """The line after a step of `Line3D` in its frame."""
        line = Line3D().retract(x[..., :6], delta)
        return torch.cat((line, x[..., 6:].expand(*line.shape[:-1], 4)), -1)


def _ends_first(x: Float[Tensor, "k e d"]) -> Float[Tensor, "d e k"]:
    return x.permute(2, 1, 0)


def _line_slopes(line: Tensor, by_d: Tensor, by_m: Tensor, out: Float[Tensor, "e 4 k"]) -> None:
    """From derivatives by direction and moment in the world to those by steps in frames of their own."""
    origin, unit = line.mT[6:9, None].expand_as(by_d), line.mT[9]
    by_line = torch.cat((by_d + torch.linalg.cross(by_m, origin, dim=0), unit * by_m))
    torch.sum(line_tangents(line[:, :6]).permute(2, 1, 0)[:, :, None] * by_line, 1, out=out.transpose(0, 1))
