"""Conics in space, and ellipsoids, from their images: linear in the dual quadric, then least squares on image distances."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors, tensor_map
from torchsfm.geometry import Ellipsoid, PlaneConic, dual_quadric_from_ellipsoid, plane_conic_from_dual_quadric
from torchsfm.geometry.quadrics import dual_of_shape
from torchsfm.linalg import eigh, inverse
from torchsfm.optim import levenberg_marquardt
from torchsfm.triangulation.conic_evidence import contradicted, evidence
from torchsfm.triangulation.conic_images import ConicImages, first_guess, prepare
from torchsfm.triangulation.conics_2view import in_front
from torchsfm.triangulation.outlines import Shape

_RANK = 1e-12
"""Eigenvalues of the normal equations below this, in units in which their diagonal is one, are nothing."""
_UNSURE = 0.5
"""The standard deviation of a semi-axis, relative to the longest, from which a shape is not determined."""
_TILT = 0.15
"""The standard deviation of a turn of the plane, in radians, from which it is not determined."""
_ROUNDING = 1e-9
"""Of a conic in an image far from its origin, relative to its size."""
_FLAT = 1e-6
"""The shortest axis that is one, relative to the longest."""


@dataclass(frozen=True)
class ConicTriangulation:
    """Ellipses in space, or ellipsoids, and what is known about them.

    Example:
        >>> import torch, torchsfm
        >>> scene = torchsfm.simulation.simulate_conics((), generator=torch.Generator().manual_seed(0))  # a disc, three views
        >>> found = torchsfm.triangulate_conics(scene.C, scene.P)
        >>> axes, true = found.model.axes.norm(dim=-2), scene.model.axes.norm(dim=-2)
        >>> bool(axes.sort().values.allclose(true.sort().values)), bool((found.error < 1e-6).all())
        (True, True)
        >>> found.covariance.shape, found.Q_dual.shape
        (torch.Size([1, 8, 8]), torch.Size([1, 4, 4]))
    """

    model: Ellipsoid
    """Centres and semi-axes, finite always; of an ellipse in space the third axis is zero."""
    status: Int8[Tensor, "*batch n"]
    """OK; NOT_FINITE: a wanted conic, edge point or camera is not finite; TOO_FEW: fewer than two views (three for ellipsoids);
    DEGENERATE: an image is no ellipse, or the views do not determine the shape or its plane (no baseline to speak of, a plane
    through the centres, arcs: of two or three views, or any with covariances, two must show their ellipse by themselves), or
    it is clearly farther from edge points than the conics of their own images are: none was found that all belong to;
    BEHIND: not wholly in front of all views that see it; NOT_CONVERGED."""
    covariance: Float[Tensor, "*batch n k k"]
    """For independent noise of variance 1 / weight in every edge point (1 pixel where no weights are given), or as given with
    the conics. k = 8 for ellipses: centre, turns about the first and the second axis (radians), semi-axis a, (a - b) times the
    turn about the normal, semi-axis b. k = 9 for ellipsoids: centre and entries 11, 12, 13, 22, 23, 33 of the symmetric root of
    the shape in its own axes: 11, 22 and 33 are the semi-axes. Zero where the data do not determine it."""
    error: Float[Tensor, "*batch n"]
    """Root-mean-square distance (weighted) of the edge points from the images of the model, in pixels."""

    @property
    def Q_dual(self) -> Float[Tensor, "*batch n 4 4"]:
        """The dual quadrics, of rank three for ellipses in space."""
        return dual_quadric_from_ellipsoid(self.model)

    @property
    def plane_conic(self) -> PlaneConic:
        """The planes of ellipses in space, and the conics in them."""
        return plane_conic_from_dual_quadric(self.Q_dual)[0]


def triangulate_conics(
    C: Float[Tensor, "*#batch v n 3 3"],
    P: Float[Tensor, "*#batch v 3 4"],
    *,
    visible: Bool[Tensor, "*#batch v n"] | None = None,
    x: Float[Tensor, "*#batch v n k 2"] | None = None,
    weights: Float[Tensor, "*#batch v n k"] | None = None,
    covariance: Float[Tensor, "*#batch v n 5 5"] | None = None,
    max_iterations: int = 50,
) -> ConicTriangulation:
    """Find ellipses in space from their images in known views.

    Two views have two answers in closed form, see `conics_2view`: the one whose plane has both centres on the same side is
    taken. More views start from the linear solution for the dual quadric, with the scales of the images projected out, or from
    an answer of two views if that fits better. Then the sum of squared distances of edge points from the images of the ellipse
    is minimised; without edge points sixteen on each measured ellipse stand for them.

    Computed in float64 whatever comes in. The derivative of `model` with respect to edge points (or conics) and cameras is that
    of the optimum (implicit function theorem with the exact Hessian).

    Args:
        C: Images, ellipses. Up to scale.
        P: Cameras `K [R | t]`, of any scale and sign.
        visible: Which views see which conic; all by default.
        x: Edge points of each image, in pixels.
        weights: Factors of their squared distances (inverse variances), 0 for absent.
        covariance: Instead of edge points, of the measured ellipses' centres, semi-axes and angles, as `fit_ellipse` gives it.
        max_iterations: Of Levenberg-Marquardt, for each conic.

    Returns:
        The ellipses with status, covariance and error.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, or both edge points and covariances are given.

    Example:
        >>> import torch, torchsfm
        >>> scene = torchsfm.simulation.simulate_conics((), generator=torch.Generator().manual_seed(0))  # a disc, three views
        >>> found = torchsfm.triangulate_conics(scene.C, scene.P)
        >>> found.status == torchsfm.Status.OK, bool(found.model.centre.allclose(scene.model.centre))
        (tensor([True]), True)
    """
    return _triangulate(2, C, P, visible, x, weights, covariance, max_iterations)


def triangulate_quadrics(
    C: Float[Tensor, "*#batch v n 3 3"],
    P: Float[Tensor, "*#batch v 3 4"],
    *,
    visible: Bool[Tensor, "*#batch v n"] | None = None,
    x: Float[Tensor, "*#batch v n k 2"] | None = None,
    weights: Float[Tensor, "*#batch v n k"] | None = None,
    covariance: Float[Tensor, "*#batch v n 5 5"] | None = None,
    max_iterations: int = 50,
) -> ConicTriangulation:
    """Find ellipsoids from their outlines in at least three known views.

    As `triangulate_conics`; the outlines in two views leave one parameter open.

    Args:
        C: Outlines, ellipses. Up to scale.
        P: Cameras `K [R | t]`, of any scale and sign.
        visible: Which views see which ellipsoid; all by default.
        x: Edge points of each outline, in pixels.
        weights: Factors of their squared distances (inverse variances), 0 for absent.
        covariance: Instead of edge points, of the measured ellipses' centres, semi-axes and angles, as `fit_ellipse` gives it.
        max_iterations: Of Levenberg-Marquardt, for each ellipsoid.

    Returns:
        The ellipsoids with status, covariance and error.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, or both edge points and covariances are given.

    Example:
        >>> import torch, torchsfm
        >>> scene = torchsfm.simulation.simulate_conics((), flat=False, generator=torch.Generator().manual_seed(0))
        >>> found = torchsfm.triangulate_quadrics(scene.C, scene.P)  # an ellipsoid from three outlines
        >>> found.status == torchsfm.Status.OK, bool(found.model.centre.allclose(scene.model.centre))
        (tensor([True]), True)
    """
    return _triangulate(3, C, P, visible, x, weights, covariance, max_iterations)


def _triangulate(
    m: int,
    C: Tensor,
    P: Tensor,
    visible: Tensor | None,
    x: Tensor | None,
    weights: Tensor | None,
    covariance: Tensor | None,
    max_iterations: int,
) -> ConicTriangulation:
    """Ellipses in space (m = 2) or ellipsoids (m = 3)."""
    batch = check_tensors(
        C=(C, "v>=1 n 3 3"), P=(P, "v 3 4"), visible=(visible, "?v n: bool"), x=(x, "?v n k 2"), weights=(weights, "?v n k"),
        covariance=(covariance, "?v n 5 5"),
    )  # fmt: skip
    check_options(max_iterations=(max_iterations, "int >= 0"))
    if covariance is not None and (x is not None or weights is not None):
        raise ValueError("covariance: wanted edge points x or covariances of the conics, got both")
    if weights is not None and x is None:
        raise ValueError("weights: wanted edge points x, which they are of, got None")
    v, n = C.shape[-4:-2]
    dtype = C.dtype

    def by_conic(t: Tensor | None, dims: int) -> Tensor | None:
        """(*batch, n, v, ...) in float64."""
        return None if t is None else t.double().expand(*batch, *t.shape[t.ndim - dims :]).movedim(-dims, 1 - dims)

    conics = by_conic(C, 4)
    cameras = P.double()[..., None, :, :].expand(*batch, v, n, 3, 4).movedim(-4, -3)
    assert conics is not None
    seen = torch.ones(*batch, n, v, dtype=torch.bool, device=C.device)
    seen = seen if visible is None else visible.expand(*batch, v, n).mT
    images = prepare(conics, cameras, seen, by_conic(x, 4), by_conic(weights, 3), by_conic(covariance, 4))
    with torch.no_grad():
        fixed = tensor_map(torch.Tensor.detach, images)
        start, guessed = first_guess(fixed, m)
    found = levenberg_marquardt(
        lambda shape, sights: sights.residual(shape), start, images.sights, retract=Shape.moved, size=start.size,
        weights=images.weights, linearize=lambda shape, sights: sights.linearize(shape), max_iterations=max_iterations,
        function_tolerance=1e-12,
    )  # fmt: skip
    with torch.no_grad():
        squares = 2 * torch.where(torch.isfinite(found.cost), found.cost, 0.0)
        status, spread = _judge(fixed, tensor_map(torch.Tensor.detach, found.x), squares, found.status == Status.OK, guessed)
        total = fixed.weights.sum(-1)
        error = (squares / torch.where(total > 0, total, 1.0)).sqrt()
    model = _in_the_world(images, found.x)
    centre, axes = model.centre.to(dtype), model.axes.to(dtype)
    fine = torch.isfinite(centre).all(-1) & torch.isfinite(axes).all(-1).all(-1) & (axes[..., 0, :] != 0).any(-1)
    status = torch.where(fine | (status != Status.OK), status, int(Status.DEGENERATE)).to(torch.int8)
    model = Ellipsoid(torch.where(fine[..., None], centre, 0.0), torch.where(fine[..., None, None], axes, 0.0))
    return ConicTriangulation(model, status, spread.to(dtype), error.to(dtype))


def _judge(images: ConicImages, shape: Shape, squares: Tensor, converged: Tensor, guessed: Tensor) -> tuple[Tensor, Tensor]:
    """Statuses and covariances."""
    m, w = shape.root.shape[-1], images.weights
    lengths, directions = shape.principal()
    shape = Shape(shape.centre, directions.mT, torch.diag_embed(lengths))
    _, J = images.sights.linearize(shape)
    J = torch.where((w > 0)[..., None], J[..., 0, :], 0.0)
    information = (w[..., None] * J).mT @ J
    unit = information.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    scaled = information * unit[..., :, None] * unit[..., None, :]
    values, _, ok = eigh(scaled)
    regular = ok & (values[..., 0] > _RANK)
    inner, _ = inverse(torch.where(regular[..., None, None], scaled, torch.eye(shape.size, dtype=w.dtype, device=w.device)))
    covariance = inner * unit[..., :, None] * unit[..., None, :]
    semi_axes = [5, 7] if m == 2 else [3, 6, 8]
    scatter = (squares / ((w > 0).sum(-1) - shape.size).clamp_min(1)).sqrt()
    deviation = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt() * scatter[..., None]
    unsure = (deviation[..., semi_axes] > _UNSURE * lengths[..., :1]).any(-1)
    if m == 2:
        unsure = unsure | (deviation[..., 3:5] > _TILT).any(-1)
    flat = lengths[..., -1] <= _FLAT * lengths[..., 0]
    dual = dual_of_shape(shape.centre, shape.axes() @ shape.axes().mT)
    front = in_front(images.P, dual[..., None, :, :])
    # Of exact data the cost is rounding, and no step lowers it any more.
    rounding = (_ROUNDING * images.sights.unit).square().amax(-1) * w.sum(-1)
    views = images.seen.sum(-1)
    alone = evidence(images)
    # Two or three views have little to spare by which they would tell which of several answers it is; and what covariances of
    # ellipses say is true near ellipses that are known.
    several = views > 3 if images.sights.white is None else torch.zeros_like(guessed)
    vague = ~several & ((alone.known & images.seen).sum(-1) < 2)
    false = contradicted(alone, squares, (5 * views - shape.size).to(w.dtype), rounding)
    status = torch.full(squares.shape, int(Status.OK), dtype=torch.int8, device=w.device)
    for condition, code in (
        (~converged & (squares > rounding), Status.NOT_CONVERGED),
        (~(front | ~images.seen).all(-1), Status.BEHIND),
        (~images.ready | ~guessed | ~regular | unsure | flat | vague | false, Status.DEGENERATE),
        (views < m, Status.TOO_FEW),
        (images.broken, Status.NOT_FINITE),
    ):
        status = torch.where(condition, int(code), status)
    known = (status == Status.OK) | (status == Status.NOT_CONVERGED) | (status == Status.BEHIND)
    turns = torch.zeros(shape.size, dtype=torch.bool, device=w.device)
    turns[3:5] = m == 2
    lengths = torch.where(turns, 1.0, images.scale[..., None])
    return status, torch.where(known[..., None, None], covariance * lengths[..., :, None] * lengths[..., None, :], 0.0)


def _in_the_world(images: ConicImages, shape: Shape) -> Ellipsoid:
    """As centre and axes, with derivatives."""
    lengths, directions = shape.principal()
    axes = (images.scale[..., None] * lengths)[..., None] * directions
    axes = torch.nn.functional.pad(axes, (0, 0, 0, 3 - axes.shape[-2]))
    return Ellipsoid(images.scale[..., None] * shape.centre + images.origin, axes)
