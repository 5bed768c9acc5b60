"""Three rays in two calibrated cameras that know the vertical: one angle of rotation and the direction of translation remain.

In frames whose third axis is the vertical, R turns about that axis by an angle a. The three vectors (R d1) x d2 are
perpendicular to t, so their determinant vanishes: a trigonometric polynomial of a, of degree two once c^2 + s^2 = 1 is used
(Fraundorfer, Tanskanen & Pollefeys 2010; Sweeney, Flynn & Turk 2014). Five values give its coefficients, and in tan(a / 2) it
is a quartic. All arithmetic has the batch in the last dimension.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Solutions, check_tensors
from torchsfm.geometry.homogeneous import moderate_directions
from torchsfm.linalg import cross
from torchsfm.linalg.quartic import quartic_rows
from torchsfm.linalg.rows import add_rows, combine_rows
from torchsfm.linalg.vectors import fma, fms
from torchsfm.motion.two_views.sample_rows import cross_columns, in_chunks, rows_of, unit_rays
from torchsfm.optim import attach_implicit, for_slots, wants_derivative

_CHUNK = 2048
"""Problems at a time: their numbers fit the cache."""
_NOTHING = 1e-13
"""A polynomial this small is zero."""
_PARALLAX = 1e-9
"""Product of two parallaxes, in radians, of rays that have none to rounding."""
_STEP = 1e-2
"""Longest Newton step of an angle, in radians."""
_ANGLES = [2 * math.pi * k / 5 for k in range(5)]
_FOURIER = [(0.2, *(0.4 * wave(k * angle) for k in (1, 2) for wave in (math.cos, math.sin))) for angle in _ANGLES]
"""Weights of a value in the mean and in the cosines and sines of the angle and its double."""


def equations(
    pose: Float[Tensor, "*#batch 3 4"],
    d1: Float[Tensor, "*#batch 3 3"],
    d2: Float[Tensor, "*#batch 3 3"],
    gravity1: Float[Tensor, "*#batch 3"],
    gravity2: Float[Tensor, "*#batch 3"],
) -> Float[Tensor, "*batch 13"]:
    """Thirteen equations of rank 12 of [R | t]: d2' [t]x R d1 = 0, R'R = I, R g1 = g2 for unit g, and |t|^2 = 1."""
    R, t = pose[..., :3], pose[..., 3]
    normal = cross(d1 @ R.mT, d2)
    epipolar = (normal * t[..., None, :]).sum(-1)
    i, j = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    orthogonal = (R.mT @ R - torch.eye(3, dtype=R.dtype, device=R.device))[..., i, j]
    g1, g2 = (g / (g * g).sum(-1, keepdim=True).sqrt() for g in (gravity1, gravity2))
    vertical = (R @ g1[..., None])[..., 0] - g2
    gauge = (t * t).sum(-1, keepdim=True) - 1
    parts = (epipolar, orthogonal, vertical, gauge)
    return torch.cat([p.expand(*epipolar.shape[:-1], p.shape[-1]) for p in parts], -1)


def relative_upright_3pt(
    d1: Float[Tensor, "*#batch 3 3"],
    d2: Float[Tensor, "*#batch 3 3"],
    gravity1: Float[Tensor, "*#batch 3"],
    gravity2: Float[Tensor, "*#batch 3"],
) -> Solutions[Float[Tensor, "*batch 4 3 4"]]:
    """The poses [R | t], |t| = 1, of a second camera from three rays and a direction known in both: the vertical.

    `d2 ~ R d1 + t` up to positive depths, and gravity2 = R gravity1 as directions.

    Args:
        d1: Three rays of the first camera, of any length but 0.
        d2: The corresponding rays of the second camera.
        gravity1: The vertical (or any other common direction, such as that of a vanishing point) in the first camera, of any
            length; an accelerometer at rest measures it.
        gravity2: The same direction in the second camera.

    Returns:
        Four slots. Of t and -t the one is returned for which more of the six depths are positive; whether all are is not asked.
        None is valid where a ray or direction is zero or not finite, or the rays determine nothing: no baseline, coinciding
        rays. Computed in float64 whatever the dtype. Differentiable in all arguments.

    Raises:
        ValueError: Wrong shape, dtype or device.

    Example:
        >>> import torch, torchsfm
        >>> d1 = torch.tensor([[0.0, 0.0, 5.0], [1.0, 0.5, 4.0], [-1.0, 0.7, 6.0]])
        >>> t, down = torch.tensor([0.6, 0.0, 0.8]), torch.tensor([0.0, 1.0, 0.0])
        >>> found = torchsfm.motion.relative_upright_3pt(d1, d1 + t, down, down)
        >>> bool((found.model[found.valid][..., 3] - t).norm(dim=-1).min() < 1e-3)  # the true one is there
        True
    """
    batch = check_tensors(d1=(d1, "3 3"), d2=(d2, "3 3"), gravity1=(gravity1, "3"), gravity2=(gravity2, "3"))
    with torch.no_grad():
        rows = rows_of(batch, d1, d2, gravity1[..., None, :], gravity2[..., None, :])
        pose, valid = in_chunks(_solve, _CHUNK, *rows)
        pose, valid = pose.permute(2, 1, 0).to(d1.dtype).reshape(*batch, 4, 3, 4), valid.mT.reshape(*batch, 4)
    if wants_derivative(d1, d2, gravity1, gravity2):
        d1, d2, gravity1, gravity2 = (moderate_directions(v) for v in (d1, d2, gravity1, gravity2))
        inputs = (for_slots(d1, batch), for_slots(d2, batch), for_slots(gravity1, batch, 1), for_slots(gravity2, batch, 1))
        pose = attach_implicit(equations, pose, *inputs, dims=2, valid=valid)
    return Solutions(pose, valid)


def _frame(g: Float[Tensor, "3 batch"]) -> Float[Tensor, "3 3 batch"]:
    """A rotation whose last row is the unit vector g, without branches (Duff et al. 2017)."""
    x, y, z = g
    sign = torch.copysign(torch.ones_like(z), z)
    a = -1 / (sign + z)
    b = x * y * a
    return torch.stack((1 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y, x, y, z)).view(3, 3, -1)


def _solve(d1: Tensor, d2: Tensor, g1: Tensor, g2: Tensor) -> tuple[Tensor, Tensor]:
    """Poses as (12, 4, batch) and valid as (4, batch)."""
    (d1, fine1), (d2, fine2), (g1, up1), (g2, up2) = (unit_rays(d) for d in (d1, d2, g1, g2))
    frame1, frame2 = _frame(g1[0]), _frame(g2[0])
    a, b = (torch.stack([combine_rows(f.unbind(1), d) for d in rays]) for f, rays in ((frame1, d1), (frame2, d2)))
    ax, ay, az = a.unbind(1)
    bx, by, bz = b.unbind(1)
    # Rows (R a) x b = cosine * C + sine * S + rest.
    C = torch.stack((ay * bz, -ax * bz, ax * by - ay * bx), 1)
    S = torch.stack((ax * bz, ay * bz, -(ax * bx + ay * by)), 1)
    rest = torch.stack((-az * by, az * bx, torch.zeros_like(ax)), 1)
    values = []
    for angle in _ANGLES:
        r0, r1, r2 = C * math.cos(angle) + S * math.sin(angle) + rest
        values.append(combine_rows(cross_columns(r0, r1), r2))
    # Angles are counted from opposite the largest value: the leading coefficient below.
    stack = torch.stack(values)
    largest, start = stack.abs().max(0)
    order = (start + torch.arange(5, device=start.device)[:, None]) % 5
    v = stack.gather(0, order)
    # The discrete Fourier transform of five values around the start, as a quartic in tan(b / 2), a = start + pi + b.
    mean, c1, s1, c2, s2 = (combine_rows(v, weights) for weights in v.new_tensor(_FOURIER).mT)
    quartic = torch.stack((mean - c1 + c2, -2 * s1 + 4 * s2, 2 * mean - 6 * c2, -2 * s1 - 4 * s2, mean + c1 + c2))
    fine = fine1 & fine2 & up1 & up2 & (largest > _NOTHING)
    x, real = quartic_rows(torch.where(fine, quartic, 1))
    scale = 1 / (1 + x * x)
    cos_b, sin_b = (1 - x * x) * scale, 2 * x * scale
    turn = stack.new_tensor([[-math.cos(angle) for angle in _ANGLES], [-math.sin(angle) for angle in _ANGLES]])
    cos_0, sin_0 = turn[0].index_select(0, start), turn[1].index_select(0, start)
    cosine, sine = cos_0 * cos_b - sin_0 * sin_b, sin_0 * cos_b + cos_0 * sin_b
    # From here on (..., 4, batch): each root has a row of its own, and t is perpendicular to three vectors.
    cosine, sine = _polished(cosine, sine, C, S, rest)
    n0, n1, n2 = (C[i][:, None] * cosine + S[i][:, None] * sine + rest[i][:, None] for i in range(3))
    crosses = torch.stack([_cross(p, q) for p, q in ((n0, n1), (n1, n2), (n2, n0))])
    square, best = combine_rows(crosses.unbind(1), crosses.unbind(1)).max(0)
    long = square > _PARALLAX**2
    t = crosses.gather(0, best[None, None].expand(1, 3, *best.shape))[0] * torch.where(long, square, 1).rsqrt()
    # Depths along the rays in the turned frames: positive with t or with -t.
    votes = torch.zeros_like(square)
    for i, normal in enumerate((n0, n1, n2)):
        bi = b[i][:, None].expand_as(normal)
        ray = torch.stack((cosine * ax[i] - sine * ay[i], sine * ax[i] + cosine * ay[i], az[i].expand_as(sine)))
        votes = votes - torch.sign(combine_rows(_cross(t, bi), normal)) - torch.sign(combine_rows(_cross(t, ray), normal))
    t = torch.where(votes < 0, -t, t)
    f0, f1, f2 = frame1[:, :, None].unbind(0)
    turned = (cosine * f0 - sine * f1, sine * f0 + cosine * f1, f2.expand(3, 4, -1))
    columns = frame2[:, :, None]
    rows = [torch.cat((combine_rows(turned, columns[:, i]), combine_rows(columns[:, i], t)[None])) for i in range(3)]
    pose = torch.cat(rows)
    valid = real & fine & long & torch.isfinite(pose).all(0)
    # An empty slot holds [I | e3].
    empty = torch.eye(3, 4, dtype=pose.dtype, device=pose.device)
    empty[2, 3] = 1
    return torch.where(valid, pose, empty.view(12, 1, 1)), valid


def _polished(cosine: Tensor, sine: Tensor, C: Tensor, S: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
    """Angles after two Newton steps on the determinant of the three vectors, where these settle.

    The vectors of far points are small at the roots, and so is what rounding makes of their determinant; that of the quartic's
    coefficients is as large as the determinant is anywhere.
    """
    before, steps = (cosine, sine), []
    C, S, rest = (t.transpose(0, 1)[:, :, None] for t in (C, S, rest))
    for _ in range(2):
        # (coordinate, ray, root, batch).
        n, slope = fma(S, sine, fma(C, cosine, rest)), fms(C, sine, S * cosine)
        n0, n1, n2 = n.unbind(1)
        minors = torch.stack((_cross(n1, n2), _cross(n2, n0), _cross(n0, n1)), 1)
        step = combine_rows(n0, minors[:, 0]) / add_rows(combine_rows(slope, minors))
        step = torch.where(step.abs() < _STEP, step, 0)
        cosine, sine = fma(sine, step, cosine), fms(cosine, step, sine)
        size = fma(sine, sine, cosine * cosine).rsqrt()
        cosine, sine = cosine * size, sine * size
        steps.append(step.abs())
    # Not so where two roots are almost one.
    settled = steps[1] <= 0.25 * steps[0]
    return torch.where(settled, cosine, before[0]), torch.where(settled, sine, before[1])


def _cross(a: Tensor, b: Tensor) -> Tensor:
    (a0, a1, a2), (b0, b1, b2) = a.unbind(0), b.unbind(0)
    return torch.stack((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0))
