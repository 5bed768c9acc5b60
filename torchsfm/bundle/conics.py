"""Ellipses of space in a bundle: measured ellipses against the images of those, whatever the lens makes of them.

Of a measured ellipse the points e at evenly spaced parameters stand for its edge, and their normals n. The image of the ellipse
in space meets the line along a normal at a distance d from e; these distances are those of edge points from which the measured
ellipse would have been fitted elsewhere: to first order its five numbers differ by the least squares solution of
`d = G delta`, which is compared with their covariance. Where lenses distort, images are no ellipses, but one that is fitted to
edge points all around has the same least squares solution. Nothing is undistorted, so that intrinsics may be free.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_index, check_options, check_tensors
from torchsfm.bundle.projection import Projection
from torchsfm.bundle.structure import Sight
from torchsfm.geometry import Camera, Ellipse, Ellipsoid, Pose, Similarity
from torchsfm.geometry.conic_distance import root_slopes
from torchsfm.geometry.ellipse_manifold import Ellipse3D, ellipse_from_row, ellipse_row, ellipse_size, spanning
from torchsfm.geometry.intrinsic_parameters import row_from_camera
from torchsfm.linalg import inverse
from torchsfm.optim import Block, Loss, Term

_POINTS = 16
"""Of each measured ellipse."""
_STEPS = 5
"""Newton steps to where the image of an ellipse meets a normal."""
_TURN = 0.5
"""Longest of them, in the ellipse's parameter, radians."""


@dataclass(frozen=True)
class BundleConics:
    """Ellipses of space and what views measured of them.

    Ellipses without observations, or that are fixed, come back bit for bit.

    Example:
        >>> import torch, torchsfm
        >>> scene = torchsfm.simulation.simulate_conics((), conics=20, generator=torch.Generator().manual_seed(0))
        >>> K, R, t = torchsfm.geometry.krt_from_camera(scene.P)
        >>> seen = torchsfm.geometry.ellipse_from_conic(scene.C.flatten(0, 1))[0]  # 20 discs in three views
        >>> view, disc = torch.arange(3).repeat_interleave(20), torch.arange(20).repeat(3)
        >>> conics = torchsfm.bundle.BundleConics(scene.model, seen, view, disc)
        >>> x, X = torchsfm.project_points(scene.P, scene.model.centre).flatten(0, 1), scene.model.centre
        >>> problem = torchsfm.BundleProblem.of(torchsfm.Pose(R, t), torchsfm.Camera(K), X, x, view, disc)
        >>> found = torchsfm.bundle_adjust(problem, structure=(conics,))
        >>> bool(found.structure_residuals[0].abs().max() < 1e-3)
        True
    """

    model: Ellipsoid
    """Ellipses in the world, batch (n,): semi-axes in the first two rows, no third."""
    ellipse: Ellipse
    """Measured ellipses, batch (k,), pixels."""
    view: Int[Tensor, "k"]
    """Which view shows each of them."""
    conic: Int[Tensor, "k"]
    """Which ellipse of space it shows."""
    ellipse_covariance: Float[Tensor, "k 5 5"] | None = None
    """Of measured centre, semi-axes and angle, as `fit_ellipse` and `detect_ellipses` give it, where observations of points
    have the variance 1; that of a fit to sixteen edge points if not given."""
    fixed: Bool[Tensor, "n"] | None = None
    """Ellipses that do not move."""
    weights: Float[Tensor, "k"] | None = None
    """Factors of the squared residuals; 0 leaves a measured ellipse out."""
    loss: Loss | None = None
    """Robust loss of the squared residual, all five numbers together: chi-square of 5 where the covariance is right."""
    block = "conic"
    follows_world = True

    def __post_init__(self) -> None:
        check_options(model=(self.model, Ellipsoid), ellipse=(self.ellipse, Ellipse), loss=(self.loss, Callable | None))
        check_tensors(
            **{"model.centre": (self.model.centre, "n 3"), "model.axes": (self.model.axes, "n 3 3")},
            **{"ellipse.centre": (self.ellipse.centre, "k 2"), "ellipse.semi_axes": (self.ellipse.semi_axes, "k 2")},
            **{"ellipse.angle": (self.ellipse.angle, "k")}, view=(self.view, "k: int"),
            conic=(self.conic, "k: int"), ellipse_covariance=(self.ellipse_covariance, "?k 5 5"),
            fixed=(self.fixed, "?n: bool"), weights=(self.weights, "?k"),
        )  # fmt: skip
        check_index(conic=(self.conic, len(self.model.centre)))

    def check(self, views: int) -> None:
        """See that the observations fit a bundle of so many views.

        Raises:
            ValueError: A measured ellipse is in no view.
        """
        check_index(**{"structure.view": (self.view, views)})

    def variables(self, sight: Sight) -> Block:
        """The ellipses, turned about their own axes."""
        return Block(ellipse_row(Ellipsoid(self.model.centre.double(), self.model.axes.double())), Ellipse3D(), self.fixed)

    def term(self, sight: Sight, start: Block) -> Term:
        """The five numbers by which each measured ellipse is off, in units of their standard deviations, independent."""
        e, n, W = _sampled(self.ellipse, self.ellipse_covariance)
        rays, valid = sight.cameras[self.view].unproject(e.detach())
        rays = torch.where(valid[..., None], rays, torch.nan)

        def residual(*rows: Tensor) -> Tensor:
            *poses, camera, conic, e, n, W, rays = rows
            centre, columns = conic.mT[:3], spanning(conic.mT)
            for R, t in sight.motions(*poses):
                centre, columns = (R * centre).sum(1) + t, (R[:, :, None] * columns).sum(1)
            e, n, rays = (v.permute(2, 1, 0) for v in (e, n, rays))
            d = _along_normals(sight.projection, camera.mT, centre, columns, e, n, rays)
            return (W @ d.mT[..., None])[..., 0]

        index = (*sight.at(self.view), self.conic)
        return Term(residual, (*sight.blocks, self.block), index, (e, n, W, rays), self.loss, self.weights)

    def covariance(self, x: Tensor, C: Tensor) -> Tensor:
        """Covariances (n, 8, 8) in the coordinates of `triangulate_conics`.

        These are the centre, turns about the first and the second axis (radians), semi-axis a, (a - b) times the turn about the
        normal, and semi-axis b.
        """
        size = ellipse_size(x)[:, None].expand(-1, 8)
        turns = torch.tensor([3, 4], device=x.device)
        unit = torch.where(size.isfinite(), size, 1.0).index_fill(1, turns, 1.0)
        return unit[:, :, None] * C * unit[:, None, :]

    def moved(self, start: Tensor, end: Tensor, world: Similarity | None) -> "BundleConics":
        """The ellipses after the adjustment."""
        moved = (start != end).any(-1) & start.isfinite().all(-1)
        found = ellipse_from_row(torch.where(moved[:, None], end, _unit_circle(end)))
        if world is not None:
            found = found.transform(world)
        centre = torch.where(moved[:, None], found.centre.to(self.model.centre.dtype), self.model.centre)
        axes = torch.where(moved[:, None, None], found.axes.to(self.model.axes.dtype), self.model.axes)
        return replace(self, model=Ellipsoid(centre, axes))


def ellipse_distances(poses: Pose, cameras: Camera, conics: BundleConics) -> Float[Tensor, "k s"]:
    """Distances of the images of ellipses in space from points all around the measured ones, along normals, pixels.

    By the pose and camera of each view.
    """
    pose, camera = poses[conics.view], cameras[conics.view]
    row = ellipse_row(Ellipsoid(conics.model.centre.double(), conics.model.axes.double()))[conics.conic]
    e, n, _ = _sampled(conics.ellipse, None)
    rays, valid = camera.unproject(e.to(conics.ellipse.centre.dtype))
    rays = torch.where(valid[..., None], rays, torch.nan).double()
    R = pose.R.double()
    centre = (R @ row[:, :3, None])[..., 0] + pose.t.double()
    columns = R @ spanning(row.mT).permute(2, 0, 1)
    e, n, rays = (v.permute(2, 1, 0) for v in (e, n, rays))
    through = Projection(type(cameras.distortion), ())
    d = _along_normals(through, row_from_camera(camera).double().mT, centre.mT, columns.permute(1, 2, 0), e, n, rays)
    return d.mT.to(conics.model.centre.dtype)


def _sampled(ellipse: Ellipse, covariance: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Points (k, s, 2) on measured ellipses, normals there, and the rows (k, 5, s) that whiten distances along them.

    NaN where a covariance, or an ellipse, is none.
    """
    centre, axes, angle = ellipse.centre.double(), ellipse.semi_axes.double(), ellipse.angle.double()
    t = torch.arange(_POINTS, dtype=axes.dtype, device=axes.device) * (2 * math.pi / _POINTS)
    e = Ellipse(centre, axes, angle).points(t)
    first = torch.stack((angle.cos(), angle.sin()), -1)
    second = torch.stack((-first[..., 1], first[..., 0]), -1)
    on, a, b = torch.stack((t.cos(), t.sin()), -1), axes[:, 0], axes[:, 1]
    directions = torch.stack((first, second), -2)
    n = (on * axes.flip(-1)[:, None]) @ directions
    n = n / torch.linalg.vector_norm(n, dim=-1, keepdim=True)
    # By centre and root of the shape: a circle's axes have no direction.
    G = root_slopes(n, on @ directions)
    N = G.mT @ G
    inner, fine = inverse(N)
    if covariance is None:
        spread = inner
    else:
        mixed = [_symmetric(p, q) for p, q in ((first, first), (second, second), (first, second))]
        turned = torch.maximum(a - b, 1e-9 * a)[:, None] * mixed[2]
        J = torch.nn.functional.pad(torch.stack((mixed[0], mixed[1], turned), -1), (2, 0, 2, 0))
        J = J + torch.diag(J.new_tensor([1.0, 1.0, 0.0, 0.0, 0.0]))
        spread = J @ covariance.double() @ J.mT
    factor, info = torch.linalg.cholesky_ex(spread)
    fine = fine & (info == 0) & torch.isfinite(spread).all(-1).all(-1)
    eye = torch.eye(5, dtype=e.dtype, device=e.device)
    W = torch.linalg.solve_triangular(torch.where(fine[:, None, None], factor, eye), inner @ G.mT, upper=False)
    return e, n, torch.where(fine[:, None, None], W, torch.nan)


def _symmetric(p: Float[Tensor, "k 2"], q: Float[Tensor, "k 2"]) -> Float[Tensor, "k 3"]:
    """Entries 11, 12 and 22 of `pq'`, or of `pq' + qp'` where they differ."""
    M = p[:, :, None] * q[:, None] + (0 if p is q else q[:, :, None] * p[:, None])
    return torch.stack((M[:, 0, 0], M[:, 0, 1], M[:, 1, 1]), -1)


def _along_normals(
    projection: Projection,
    camera: Float[Tensor, "c k"],
    centre: Float[Tensor, "3 k"],
    columns: Float[Tensor, "3 2 k"],
    e: Float[Tensor, "2 s k"],
    n: Float[Tensor, "2 s k"],
    rays: Float[Tensor, "3 s k"],
) -> Float[Tensor, "s k"]:
    """How far the images of ellipses (in the camera's frame) are from image points along normals.

    Newton's method finds where, without derivatives, from where the ray meets the ellipse's plane. Two more steps with the
    slope held carry them: they are right to second order.
    """
    across = torch.stack((-n[1], n[0]))
    with torch.no_grad():
        t = _seen(centre, columns, rays)
        by_ray = rays.new_empty(2, *rays.shape)
        for left in reversed(range(_STEPS)):
            w, turned = torch.stack((t.cos(), t.sin())), torch.stack((-t.sin(), t.cos()))
            place = projection.slopes(_points(centre, columns, w), camera[:, None], by_ray, None)
            tangent = (by_ray * (columns[:, :, None] * turned).sum(1)).sum(1)
            slope = (across * tangent).sum(0)
            if left:
                t = t - ((across * (place - e)).sum(0) / slope).clamp(-_TURN, _TURN)
    for left in (2, 1, 0):
        w = torch.stack((t.cos(), t.sin()))
        away = projection.inside.pixels(_points(centre, columns, w), camera[:, None]) - e
        if left:
            t = t - (across * away).sum(0) / slope
    distance: Tensor = (n * away).sum(0)
    return distance


def _points(centre: Tensor, columns: Tensor, w: Float[Tensor, "2 s k"]) -> Float[Tensor, "3 s k"]:
    """The points of ellipses with parameters w."""
    return centre[:, None] + (columns[:, :, None] * w).sum(1)


def _seen(centre: Tensor, columns: Tensor, rays: Float[Tensor, "3 s k"]) -> Float[Tensor, "s k"]:
    """The parameters of the ellipses' points in the directions in which rays meet their planes."""
    u, v = columns[:, 0], columns[:, 1]
    normals = [torch.linalg.cross(p, q, dim=0)[:, None] for p, q in ((v, centre), (centre, u), (u, v))]
    a, b, depth = ((rays * p).sum(0) for p in normals)
    return torch.atan2(b * depth.sign(), a * depth.sign())


def _unit_circle(like: Float[Tensor, "n 12"]) -> Float[Tensor, "n 12"]:
    row = like.new_zeros(12)
    row[[3, 7, 9, 11]] = 1.0
    return row.expand_as(like)
