"""The fundamental matrix from conics that correspond: images of conics in space, or outlines of quadrics seen by both cameras.

Epipolar lines that touch a conic correspond to lines that touch its fellow, `F'C2*F ~ [e]x C1* [e]x` (Kahl & Heyden 1998): two
equations a conic. The tangents from the epipole e are a binary form, of which pairs of conics have the invariant
`q_ij / sqrt |q_ii q_jj|` with `q_ij = e' (mixed adjugate of Ci*, Cj*) e`; the invariants of both images agree. That leaves two
points on two spheres to look for, from many starts at once; what relates the forms is then linear.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors, tensor_map
from torchsfm.linalg import eigh, null_vector, unit_scale, usable
from torchsfm.motion.two_views.coplanar_conics import may_be_coplanar
from torchsfm.motion.two_views.epipolar_tangents import (
    ConicPairs,
    EpipolarFrames,
    carry_lines,
    linearize,
    residual,
    two_by_two,
)
from torchsfm.motion.two_views.epipole_search import cofactors, frame, relate_tangents, search_epipoles
from torchsfm.motion.two_views.fundamental_8pt import fundamental_8pt
from torchsfm.motion.two_views.normalised_conics import conic_of_six, normalised_conics
from torchsfm.optim import levenberg_marquardt

_SEARCH = 15
"""Steps of a start, most of which lead nowhere."""
_LAST = 12
"""Steps from the best of the refined starts."""
_KEPT, _KEPT_OF_FOUR = 8, 16
"""Best different starts that are refined, of more than four conics and of four: these leave one number over, which says little,
so that what starts cost tells less of where they lead, and several answers are likely."""
_UNSURE = 0.2
"""The standard deviation of a parameter (epipoles in radians, as seen in normalised images) that is none."""
_RIVAL = 9.0
"""In units of the noise: by how much more cost another answer must have."""
_LEAST = 5e-3
"""The least noise where none is given, for the question whether conics are in one plane: four tell next to nothing of it."""
_EXACT = 1e-14
"""The mean square of a residual that is rounding."""


@dataclass(frozen=True)
class ConicEpipolarFit:
    """Fundamental matrices and what is known about them.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> scene = torchsfm.simulation.simulate_conics((), conics=5, views=2, generator=g)
        >>> found = torchsfm.fundamental_from_conics(*scene.C, starts=4, generator=g)
        >>> torchsfm.Status(found.status.item()).name, bool(found.error < 1e-6)
        ('OK', True)
        >>> torchsfm.tensors.epipoles(found.model)[0].shape
        torch.Size([3])
    """

    model: Float[Tensor, "*batch 3 3"]
    """F with x2' F x1 = 0, of unit norm; finite always."""
    status: Int8[Tensor, "*batch"]
    """OK; NOT_FINITE: a wanted conic or point is not finite; TOO_FEW: fewer than four conics, and than eight points;
    DEGENERATE: a conic is no ellipse, or the data do not determine F (coplanar conics determine a homography alone), or another
    F explains them as well; NOT_CONVERGED."""
    error: Float[Tensor, "*batch"]
    """Root-mean-square residual, in standard deviations as given, or pixels where none are."""


def fundamental_from_conics(
    C1: Float[Tensor, "*#batch m 3 3"],
    C2: Float[Tensor, "*#batch m 3 3"],
    *,
    mask: Bool[Tensor, "*#batch m"] | None = None,
    covariance1: Float[Tensor, "*#batch m 5 5"] | None = None,
    covariance2: Float[Tensor, "*#batch m 5 5"] | None = None,
    x1: Float[Tensor, "*#batch n 2"] | None = None,
    x2: Float[Tensor, "*#batch n 2"] | None = None,
    starts: int = 128,
    max_iterations: int = 25,
    generator: torch.Generator | None = None,
) -> ConicEpipolarFit:
    """Estimate F from at least four pairs of conics, and from points with them.

    Computed in float64 whatever comes in. The derivative of `model` with respect to conics and points is that of the optimum of
    the first-order (Sampson) errors, which are whitened with the covariances.

    Args:
        C1: Ellipses in the first image, images of conics in space or outlines of quadrics. Up to scale.
        C2: The same in the second image.
        mask: Which pairs count; all by default.
        covariance1: Of centres, semi-axes and angles, as `fit_ellipse` gives it; without it that of sixteen edge points that
            are one pixel off.
        covariance2: In the second image.
        x1: Points in the first image, one pixel off.
        x2: The same points in the second image. With eight of them a linear solution is another start.
        starts: Pairs of epipoles to start from, drawn evenly over the directions.
        max_iterations: Of Levenberg-Marquardt, for each start and for each refinement.
        generator: Source of randomness; torch's own where none is given.

    Returns:
        The fundamental matrices with status and error.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, or points are given in one image alone.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> scene = torchsfm.simulation.simulate_conics((), conics=5, views=2, generator=g)
        >>> found = torchsfm.fundamental_from_conics(*scene.C, starts=4, generator=g)
        >>> truth = torchsfm.tensors.fundamental_from_cameras(*scene.P)
        >>> float((found.model * truth).sum().abs() / found.model.norm() / truth.norm())  # 1: the same up to scale
        1.0
    """
    batch = check_tensors(
        C1=(C1, "m>=1 3 3"), C2=(C2, "m 3 3"), mask=(mask, "?m: bool"), covariance1=(covariance1, "?m 5 5"),
        covariance2=(covariance2, "?m 5 5"), x1=(x1, "?n 2"), x2=(x2, "?n 2"),
    )  # fmt: skip
    check_options(
        starts=(starts, "int >= 1"), max_iterations=(max_iterations, "int >= 0"), generator=(generator, torch.Generator | None)
    )
    if (x1 is None) != (x2 is None):
        raise ValueError("x1, x2: wanted the points of both images, got those of one")
    if (covariance1 is None) != (covariance2 is None):
        raise ValueError("covariance1, covariance2: wanted those of both images, got those of one")
    dtype, m = C1.dtype, C1.shape[-3]
    seen = torch.ones(*batch, m, dtype=torch.bool, device=C1.device) if mask is None else mask.expand(*batch, m)
    # Without points, one that does not count.
    count = 0 if x1 is None else x1.shape[-2]
    points = [
        C1.new_zeros(*batch, 1, 2).double() if x is None or not count else x.double().expand(*batch, -1, 2) for x in (x1, x2)
    ]
    conics = [C.double().expand(*batch, m, 3, 3) for C in (C1, C2)]
    spread = [None if S is None else S.double().expand(*batch, m, 5, 5) for S in (covariance1, covariance2)]
    sound = torch.stack([usable(t).all(-1).all(-1) for t in [*conics, *(S for S in spread if S is not None)]]).all(0)
    broken = (seen & ~sound).any(-1) | torch.stack([~(p.detach().abs() < 1e12).all(-1).all(-1) for p in points]).any(0)
    seen = seen & ~broken[..., None]
    images = [
        normalised_conics(torch.where(seen[..., None, None], C, torch.diag(C.new_tensor([1.0, 1.0, -1.0]))), S, seen, x, broken)
        for C, S, x in zip(conics, spread, points, strict=True)
    ]
    ellipses = (torch.stack([image.ellipse for image in images]).all(0) | ~seen).all(-1)
    one, two = images
    data = ConicPairs(one.c, two.c, one.S, two.S, one.x, two.x, one.T[..., 0, 0], two.T[..., 0, 0])
    with torch.no_grad():
        fixed = tensor_map(torch.Tensor.detach, data)
        weights = torch.cat((seen.to(one.c.dtype), (count > 0) * torch.ones_like(points[0][..., 0])), -1)
        start = _starts(fixed, seen, weights, starts, max_iterations, generator)
        few = (seen.sum(-1) < 4) & (count < 8)
        tried = levenberg_marquardt(
            residual, start, _beside(fixed, len(batch)), retract=EpipolarFrames.moved, size=7, weights=weights[..., None, :],
            linearize=linearize, max_iterations=max_iterations, function_tolerance=1e-3,
        )  # fmt: skip
        proper = carry_lines(tried.x, _beside(fixed, len(batch)), seen[..., None, :]) & torch.isfinite(tried.cost)
        cost = torch.where(proper, tried.cost, torch.inf)
        best = _pick(tried.x, cost.argmin(-1, keepdim=True), squeeze=True)
    final = levenberg_marquardt(
        residual, best, data, retract=EpipolarFrames.moved, size=7, weights=weights, linearize=linearize,
        max_iterations=min(_LAST, max_iterations), function_tolerance=1e-10,
    )  # fmt: skip
    with torch.no_grad():
        state = tensor_map(torch.Tensor.detach, final.x)
        rows = (2 * seen.sum(-1) + count).to(final.cost.dtype)
        freedom = (rows - 7).clamp_min(1)
        noise = 2 * final.cost / freedom
        # An estimate from few residuals may be too small by much.
        noise = noise * (1 + 12 / freedom) if covariance1 is None else noise.clamp_min(1.0)
        unsure = _uncertain(state, fixed, weights, noise)
        if count < 2:
            # Two points off the plane of conics are enough for F.
            least = _LEAST if covariance1 is None else _EXACT
            plane = may_be_coplanar(fixed.c1, fixed.c2, fixed.S1, fixed.S2, seen, noise.clamp_min(least))
            unsure = unsure | plane
        apart = torch.linalg.matrix_norm(_signed(tried.x.F()) - _signed(state.F())[..., None, :, :]) > 1e-2
        rivals = (apart & (2 * cost <= (2 * final.cost + _RIVAL * noise + _EXACT * rows)[..., None])).any(-1)
        settled = (final.status == Status.OK) | (2 * final.cost < _EXACT * rows)
        status = torch.full(batch, int(Status.OK), dtype=torch.int8, device=C1.device)
        for condition, code in (
            (~settled, Status.NOT_CONVERGED),
            (~ellipses | unsure | rivals | ~torch.isfinite(cost.amin(-1)), Status.DEGENERATE),
            (few, Status.TOO_FEW),
            (broken, Status.NOT_FINITE),
        ):
            status = torch.where(condition, int(code), status)
        error = (2 * final.cost / rows.clamp_min(1)).nan_to_num(0.0, 0.0, 0.0).clamp_min(0).sqrt()
    F = two.T.mT @ final.x.F() @ one.T
    F = F * unit_scale(F)
    F = F / torch.linalg.matrix_norm(F, keepdim=True).clamp_min(1e-300)
    fine = torch.isfinite(F).all(-1).all(-1)
    F = torch.where(fine[..., None, None], F, torch.eye(3, dtype=F.dtype, device=F.device))
    status = torch.where(fine | (status != Status.OK), status, int(Status.DEGENERATE)).to(torch.int8)
    return ConicEpipolarFit(F.to(dtype), status, error.to(dtype))


def _beside(data: ConicPairs, dim: int) -> ConicPairs:
    """For several states of one problem."""
    return tensor_map(lambda t: t.unsqueeze(dim), data)


def _pick(state: EpipolarFrames, index: Tensor, *, squeeze: bool = False) -> EpipolarFrames:
    """Some of several states of each problem."""
    dim = index.ndim - 1

    def gather(t: Tensor) -> Tensor:
        place = index.reshape(*index.shape, *[1] * (t.ndim - dim - 1)).expand(*index.shape, *t.shape[dim + 1 :])
        picked = t.gather(dim, place)
        return picked.squeeze(dim) if squeeze else picked

    return tensor_map(gather, state)


def _starts(
    data: ConicPairs, seen: Tensor, weights: Tensor, starts: int, max_iterations: int, generator: torch.Generator | None
) -> EpipolarFrames:
    """The best different ones, (*batch, kept)."""
    dim = seen.ndim - 1
    duals = conic_of_six(data.c1), conic_of_six(data.c2)
    e1, e2 = search_epipoles(*duals, seen, starts, min(_SEARCH, max_iterations), generator)
    R1, R2 = frame(e1), frame(e2)
    forms = [R[..., None, :, :2].mT @ C.unsqueeze(dim) @ R[..., None, :, :2] for R, C in ((R1, duals[0]), (R2, duals[1]))]
    N = cofactors(two_by_two(relate_tangents(forms[0], forms[1], seen.unsqueeze(dim)))).flatten(-2)
    R1, R2 = (R.repeat_interleave(2, dim) for R in (R1, R2))
    N = N.flatten(dim, dim + 1)
    if data.x1.shape[-2] >= 8:
        F = fundamental_8pt(data.x1[..., :2], data.x2[..., :2])
        f1, f2 = frame(null_vector(F)[0]), frame(null_vector(F.mT)[0])
        turn = torch.tensor([[0.0, 1.0], [-1.0, 0.0]], dtype=F.dtype, device=F.device)
        linear = (f2[..., :2].mT @ F @ f1[..., :2] @ turn).flatten(-2)
        R1, R2, N = (torch.cat((a.unsqueeze(dim), b), dim) for a, b in ((f1, R1), (f2, R2), (linear, N)))
    state = EpipolarFrames(R1, R2, N / torch.linalg.vector_norm(N, dim=-1, keepdim=True).clamp_min(1e-300))
    several = _beside(data, dim)
    r = residual(state, several)
    cost = (r.square().sum(-1) * weights.unsqueeze(dim)).sum(-1)
    cost = torch.where(carry_lines(state, several, seen.unsqueeze(dim)), cost, cost + 1e30).nan_to_num(
        torch.inf, torch.inf, torch.inf
    )
    F = _signed(state.F())
    kept = []
    for _ in range(_KEPT if seen.shape[-1] > 4 else _KEPT_OF_FOUR):
        index = cost.argmin(-1, keepdim=True)
        kept.append(index)
        chosen = F.gather(dim, index[..., None, None].expand(*index.shape, 3, 3))
        cost = torch.where(torch.linalg.matrix_norm(F - chosen) < 1e-2, torch.inf, cost)
    return _pick(state, torch.cat(kept, -1))


def _signed(F: Tensor) -> Tensor:
    """Of unit norm, with a sign of its own."""
    flat = F.flatten(-2)
    largest = flat.gather(-1, flat.abs().argmax(-1, keepdim=True))
    length: Tensor = torch.linalg.vector_norm(flat, dim=-1, keepdim=True)
    return (flat * largest.sign() / length.clamp_min(1e-300)).reshape(F.shape)


def _uncertain(state: EpipolarFrames, data: ConicPairs, weights: Tensor, noise: Tensor) -> Tensor:
    """Where a parameter has a large standard deviation."""
    batch = weights.shape[:-1]
    flat = tensor_map(lambda t: t.reshape(-1, *t.shape[len(batch) :]) if batch else t[None], (state, data))
    J = linearize(*flat)[1].reshape(*weights.shape, 2, 7)
    J = torch.where((weights > 0)[..., None, None], J, 0.0).flatten(-3, -2)
    values, _, ok = eigh(J.mT @ J)
    return ~ok | (values[..., 0] <= 1e-11 * values[..., -1]) | (values[..., 0] * _UNSURE**2 < noise)
