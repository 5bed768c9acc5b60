"""Structure and motion from points in many images of affine cameras (Tomasi & Kanade 1992; HZ 18.2), with metric upgrade.

`x_ij = M_i X_j + t_i`: the measurements about their centroids have rank three. With every point seen everywhere the singular
value decomposition is the least-squares answer; with missing data it is the start of a descent in which the points are
eliminated exactly. What is known of the cameras, equal scales and right angles in the image, then makes the answer metric.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.geometry.homogeneous import finite_or_zero
from torchsfm.linalg import eigh, inverse, qr, solve, svd, svdvals
from torchsfm.motion.many_views.affine_evidence import metric_equations, sharpen_metric, stretch_deviation, turn_deviation
from torchsfm.motion.many_views.bilinear_fit import Rays, core, fit_with_prior
from torchsfm.optim.likely_noise import likely_variance

AffineModel = Literal["orthographic", "weak_perspective", "paraperspective"]

MAX_DEVIATION = 0.15
"""Standard deviation beyond which it is not determined: of the stretch of the points in any direction against others, or of a
rotation in radians."""
_STIFF = 1e3
"""Weight of the third row of the cameras, which must be (0, 0, 0, 1), over that of the measurements."""
_CHANCE = 1.3
"""A third singular value less than this many times that of noise is noise."""


@dataclass(frozen=True)
class AffineFactorization:
    """Affine cameras and points, metric up to a similarity and a mirror image.

    The mirror image in depth, X3 -> -X3 with rotations to match, gives the same images: affine cameras cannot tell.

    Attributes:
        P: Affine cameras with last row (0, 0, 0, 1); zero where `used_view` is False.
        X: Points, about their centroid; zero where `used_point` is False.
        R: Rotation of each view, cam_from_world.
        scale: Length in the image of a unit across the line of sight, for each view.
        deviation: Standard deviation of the rotation of each view against the others, in radians, by the noise that the images
            show; one redundant measurement shows little, and much noise is then possible.
        singular_values: Those of the reprojected measurements about their centroids: three, largest first; the third is near
            the noise where the scene is a plane or the camera did not turn.
        error: Distance of each observed point from its reprojection; inf where not observed.
        used_view: Views with at least four points that other views see too.
        used_point: Points in at least two used views.
        status: `OK`; `NOT_CONVERGED`; `TOO_FEW` points, or views (three are needed); `DEGENERATE`: planar scene, no turning,
            two orientations only, so little of depth or turns that the noise leaves the shape or a rotation open, or cameras
            that are not of the kind asked for (P and X are then some affine frame's, R and scale mean nothing);
            `NOT_FINITE`: numbers beyond what the dtype holds, all fields are zero.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(30, generator=g), torchsfm.random_poses(5, generator=g)
        >>> found = torchsfm.factorize_affine(100 * (X @ poses.R.mT)[..., :2])  # five views from far away
        >>> relative = found.R[1:] @ found.R[:1].mT
        >>> truth = poses.R[1:] @ poses.R[:1].mT
        >>> mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0]).double())  # far away, relief and hollow look alike
        >>> bool(relative.allclose(truth) or relative.allclose(mirror @ truth @ mirror))
        True
        >>> found.singular_values.shape, bool(found.used_view.all())
        (torch.Size([3]), True)
    """

    P: Float[Tensor, "*batch v 3 4"]
    X: Float[Tensor, "*batch n 3"]
    R: Float[Tensor, "*batch v 3 3"]
    scale: Float[Tensor, "*batch v"]
    deviation: Float[Tensor, "*batch v"]
    singular_values: Float[Tensor, "*batch 3"]
    error: Float[Tensor, "*batch v n"]
    used_view: Bool[Tensor, "*batch v"]
    used_point: Bool[Tensor, "*batch n"]
    status: Int[Tensor, "*batch"]


def factorize_affine(
    x: Float[Tensor, "*#batch v n 2"],
    *,
    visible: Bool[Tensor, "*#batch v n"] | None = None,
    weights: Float[Tensor, "*#batch v n"] | None = None,
    model: AffineModel = "weak_perspective",
    max_iterations: int = 200,
) -> AffineFactorization:
    """Find affine cameras and points from points in three or more images, up to a similarity and a mirror image.

    For scenes that are shallow against their distance; the least-squares answer for noise equal in all directions.

    Args:
        x: Points in the images. For "paraperspective" relative to the principal point and over the focal length; in any unit
            otherwise.
        visible: Which points were seen in which view; rows with NaN or inf were not.
        weights: Non-negative; of squared residuals.
        model: "orthographic": unit scale in all views; "weak_perspective": a scale for each view; "paraperspective": a scale
            for each view, and lines of sight parallel to that of the centroid of the points (Poelman & Kanade 1997).
        max_iterations: Most steps of the descent for missing data.

    Returns:
        Cameras, points, rotations, scales, singular values and status; computed in float64.

    Raises:
        ValueError: Wrong shape, dtype, device or option.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(30, generator=g), torchsfm.random_poses(5, generator=g)
        >>> x = 100 * (X @ poses.R.mT)[..., :2]  # five views from far away
        >>> found = torchsfm.factorize_affine(x)
        >>> bool(found.status == torchsfm.Status.OK), bool(found.error.max() < 1e-6)
        (True, True)
    """
    batch = check_tensors(x=(x, "v>=2 n>=1 2"), visible=(visible, "?v n: bool"), weights=(weights, "?v n"))
    check_options(model=(model, get_args(AffineModel)), max_iterations=(max_iterations, "int >= 0"))
    v, n = x.shape[-3:-1]
    with torch.no_grad():
        flat = x.detach().double().expand(*batch, v, n, 2).reshape(-1, v, n, 2)
        w = torch.isfinite(flat).all(-1).double()
        if visible is not None:
            w = w * visible.expand(*batch, v, n).reshape(-1, v, n)
        if weights is not None:
            given = weights.detach().double().expand(*batch, v, n).reshape(-1, v, n)
            w = torch.where(torch.isfinite(given), w * given.clamp(min=0), 0)
        view, point = core(w, 4)
        w = w * view[..., None] * point[:, None]
        M, t, X, steady = _affine(finite_or_zero(flat), w, max_iterations)
        A, metric = _metric(M, t, view, model)
        M, X = M @ A[:, None], solve(A, X.mT)[0].mT
        M, X, misfit, information = sharpen_metric(M, t, X, w, view, model)
        R, scale, unit = _rotations(M, t, model)
        # Orthographic scales are 1 by definition; else the mean scale is made 1.
        if model != "orthographic":
            mean = ((scale * view).sum(-1) / view.sum(-1).clamp(min=1)).clamp_min(1e-300)
            M, X, scale = M / mean[:, None, None, None], X * mean[:, None, None], scale / mean[:, None]
        fitted = X[:, None] @ M.mT
        error = torch.linalg.vector_norm(fitted + t[:, :, None] - flat.nan_to_num(), dim=-1)
        seen = w > 0
        rows, columns, measured = 2 * view.sum(-1), point.sum(-1), 2 * seen.sum((-2, -1))
        # Noise shows where the points are not affine, and where the cameras are not metric.
        unknown = (5 if model == "orthographic" else 6) * view.sum(-1) + 3 * columns - (6 if model == "orthographic" else 7)
        squares = (w * error.square()).sum((-2, -1)) + misfit
        rounding = torch.finfo(x.dtype).eps * flat.nan_to_num().abs().masked_fill(~seen[..., None], 0).flatten(1).amax(-1)
        sigma = torch.maximum(likely_variance(squares, measured - unknown).sqrt(), rounding)
        stretch = sigma * stretch_deviation(information)
        turn = (sigma[:, None] * turn_deviation(M, X, w, information)).nan_to_num(torch.inf).clamp(max=torch.pi) * view
        stacked = (M * view[..., None, None]).flatten(1, 2) @ (X * point[..., None]).mT
        values, _ = svdvals(stacked)
        values = torch.nn.functional.pad(values, (0, 3))[:, :3]
        chance = _CHANCE * sigma * (rows.double().sqrt() + columns.double().sqrt())
        loose = (values[:, 2] <= torch.maximum(chance, 1e-10 * values[:, 0])) | ~metric | ~(unit | ~view).all(-1)
        loose = loose | ~(torch.maximum(stretch, turn.amax(-1)) <= MAX_DEVIATION)
        few = (view.sum(-1) < 3) | (columns < 4) | (measured < 4 * rows + 3 * columns - 12)
        status = torch.where(steady, int(Status.OK), int(Status.NOT_CONVERGED))
        status = torch.where(loose, int(Status.DEGENERATE), status)
        status = torch.where(few, int(Status.TOO_FEW), status).to(torch.int8)
        last = torch.zeros(*M.shape[:2], 1, 4, dtype=M.dtype, device=M.device)
        last[..., 3] = 1
        P = torch.cat((torch.cat((M, t[..., None]), -1), last), -2) * view[..., None, None]
        error = torch.where(seen, error, 0)
        numbers = [f.to(x.dtype) for f in (P, X * point[..., None], R, scale * view, turn, values, error)]
        held = torch.stack([torch.isfinite(f).flatten(1).all(-1) for f in numbers]).all(0)
        status = torch.where(held, status, int(Status.NOT_FINITE)).to(torch.int8)
        *numbers, error = (torch.where(held.reshape(-1, *(1,) * (f.ndim - 1)), f, 0) for f in numbers)
        found = (*numbers, torch.where(seen, error, torch.inf), view, point, status)
    return AffineFactorization(*(f.reshape(batch + f.shape[1:]) for f in found))


def _affine(x: Tensor, w: Tensor, steps: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """M (p, v, 2, 3), t (p, v, 2) and X (p, n, 3) with centroid 0, and whether the descent came to its end."""
    p, v, n, _ = x.shape
    total = w.sum(-1).clamp_min(1e-300)
    middle = (w[..., None] * x).sum(-2) / total[..., None]
    y = torch.where(w[..., None] > 0, x - middle[:, :, None], 0)
    size = ((w[..., None] * y.square()).sum((-3, -2, -1)) / w.sum((-2, -1)).clamp_min(1e-300)).sqrt()
    size = torch.where(size > 0, size, 1)[:, None, None, None]
    y = y / size
    U, s, _, _ = svd(y.mT.reshape(p, 2 * v, n), full_matrices=False)
    M = torch.nn.functional.pad(U * s[:, None], (0, 3))[..., :3].reshape(p, v, 2, 3)
    P = torch.zeros(p, v, 3, 4, dtype=x.dtype, device=x.device)
    P[:, :, :2, :3] = M / torch.linalg.matrix_norm(M.flatten(1, 2))[:, None, None, None].clamp_min(1e-300) * v**0.5
    P[:, :, 2, 3] = _STIFF
    a = torch.cat((y, torch.full_like(y[..., :1], _STIFF)), -1)
    rays = Rays(torch.where(w[..., None] > 0, a, 0).mT.contiguous(), w)
    P, u, steady = fit_with_prior(rays, P, 1.0, steps, 1e-12)
    # The frame in which the third rows are (0, 0, 0, stiff) and points end in 1.
    present = (w > 0).any(-1)[..., None]
    last = (P[:, :, 2] * present).sum(1) / present.sum(1).clamp(min=1) / _STIFF
    frame, _, _ = qr(torch.cat((last[..., None], torch.eye(4, dtype=x.dtype, device=x.device).expand(p, 4, 4)), -1))
    G = torch.cat((frame[..., 1:].mT, last[:, None]), -2)
    back, _ = inverse(G)
    P, u = P @ back[:, None], G @ u
    X = (u[:, :3] / torch.where(u[:, 3:].abs() > 1e-6, u[:, 3:], 1)).mT
    seen = (w > 0).any(1).double()
    centroid = (X * seen[..., None]).sum(1) / seen.sum(-1, keepdim=True).clamp(min=1)
    M, t = P[:, :, :2, :3], P[:, :, :2, 3] + (P[:, :, :2, :3] @ centroid[:, None, :, None])[..., 0]
    size = size[..., 0]
    return M * size[..., None], t * size + middle, X - centroid[:, None], steady


def _metric(M: Tensor, t: Tensor, view: Tensor, model: AffineModel) -> tuple[Tensor, Tensor]:
    """A with M A metric, and whether there is one: Q = A A' solves what the model says of M Q M'."""
    told = metric_equations(M, t, model)
    if model == "orthographic":
        # Not scaled: the equations are inhomogeneous.
        rows, right = (told.rows * view[..., None, None]).flatten(1, 2), (told.right * view[..., None]).flatten(1)
        size = rows.square().sum((-2, -1)).clamp_min(1e-300).sqrt()[:, None, None]
        normal = (rows / size).mT @ (rows / size)
        q, fine = solve(normal, (rows / size).mT @ right[..., None])
        q = q[..., 0] / size[..., 0]
    else:
        weight = view / torch.linalg.matrix_norm(M).square().clamp_min(1e-300)
        rows = (told.rows * weight[..., None, None]).flatten(1, 2)
        values, vectors, _ = eigh(rows.mT @ rows)
        q = vectors[..., 0]
        fine = values[..., 1] > 1e-12 * values[..., -1]
    i, j = torch.triu_indices(3, 3, device=M.device)
    Q = torch.zeros(*q.shape[:-1], 3, 3, dtype=q.dtype, device=q.device)
    Q[..., i, j] = q
    Q[..., j, i] = q
    if model != "orthographic":
        Q = Q * torch.where(Q.diagonal(dim1=-2, dim2=-1).sum(-1) < 0, -1.0, 1.0)[..., None, None]
    values, vectors, _ = eigh(Q)
    fine = fine & (values[..., 0] > 1e-8 * values[..., -1].clamp_min(1e-300))
    A = vectors * torch.where(fine[..., None], values.clamp_min(0), 1).sqrt()[..., None, :] @ vectors.mT
    return torch.where(fine[..., None, None], A, torch.eye(3, dtype=A.dtype, device=A.device)), fine


def _rotations(M: Tensor, t: Tensor, model: AffineModel) -> tuple[Tensor, Tensor, Tensor]:
    """Rotation and scale of each view, and whether it has one. M = s ([I; 0] - ...) R, HZ 6.3 and Poelman & Kanade 1997."""
    m, n = M.unbind(-2)
    third = torch.linalg.cross(m, n)
    area = torch.linalg.vector_norm(third, dim=-1)
    scale = area.sqrt()
    if model == "paraperspective":
        # m = s (i - a k), n = s (j - b k): (i, j, k) from s^2 i x j and the lengths.
        a, b = t.unbind(-1)
        scale = ((m.square().sum(-1) / (1 + a * a) + n.square().sum(-1) / (1 + b * b)) / 2).sqrt()
        s = scale[..., None].clamp_min(1e-300)
        one, zero = torch.ones_like(a), torch.zeros_like(a)
        basis = torch.stack((one, zero, -a, zero, one, -b, a, b, one), -1).reshape(*a.shape, 3, 3)
        rows = torch.stack((m / s, n / s, third / s / s), -2)
        m, n, _ = solve(basis, rows)[0].unbind(-2)
    # The nearest rotation of (m, n): the frame halfway between their sum and difference.
    unit = torch.nn.functional.normalize
    p, q = unit(m, dim=-1), unit(n, dim=-1)
    plus, minus = unit(p + q, dim=-1), unit(p - q, dim=-1)
    x, y = (plus + minus) * 0.5**0.5, (plus - minus) * 0.5**0.5
    R = torch.stack((x, y, torch.linalg.cross(x, y)), -2)
    fine = (area > 0) & (torch.linalg.det(R) > 0.5)
    return torch.where(fine[..., None, None], R, torch.eye(3, dtype=M.dtype, device=M.device)), scale, fine
