"""Intrinsics and plane at infinity under one assumption: starts from the grid, the best of them refined, and how sure it is."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int8
from torch import Tensor

from torchsfm._types import Status
from torchsfm.autocalibration.evidence import expected_variation, log_evidence
from torchsfm.autocalibration.focal_search import search_focal
from torchsfm.autocalibration.intrinsics_model import Assumption
from torchsfm.autocalibration.projective_input import PreparedCameras
from torchsfm.autocalibration.upgrade_fit import UpgradeProblem, fit_information, fit_upgrade
from torchsfm.autocalibration.upgrade_residual import metric_blocks
from torchsfm.linalg import determinant_3x3, eigh

STARTS, FINALISTS = 8, 3
"""Places of the grid that are refined with each view weighed by itself, and of those the ones refined with all of it."""
NEAR = 1e-3
"""Part of its objective that a fit may leave which is only compared with others: they scatter by more. Steps without second
derivatives come as near."""
_APART = 0.15
"""Focal lengths this far apart in logarithm are told apart by the data, or the focal length is not determined."""
_CLEAR = 9.0
"""By how much chi squared must differ for that: three standard deviations."""


@dataclass(frozen=True)
class AssumptionFit:
    """What one assumption leads to, and what the data say of its unknowns.

    `status`, `chi2` and `redundancy` are as in `Autocalibration`.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
        >>> X, poses = torchsfm.random_points(30, generator=g), torchsfm.random_poses(6, wobble=0.5, generator=g)
        >>> x = torchsfm.project_points(K @ poses.matrix(), X) + 0.3 * torch.randn(6, 30, 2, generator=g)
        >>> projective = torchsfm.factorize_points(x)
        >>> found = torchsfm.autocalibrate_points(projective.P, projective.X, x, image_size=(1000.0, 750.0))
        >>> fit = found.fits[found.assumption]  # one focal length in all images
        >>> fit.assumption.names(6), bool(fit.chi2 < 2 * fit.redundancy)  # the data agree
        (('focal', 'cx', 'cy'), True)
        >>> sigma = 1 / fit.singular_values  # of log f and the principal point over 1000 pixels, or combinations of them
        >>> bool((sigma < 0.01).all()), fit.combinations.shape
        (True, torch.Size([3, 3]))
    """

    assumption: Assumption
    status: Int8[Tensor, "*batch"]
    chi2: Float[Tensor, "*batch"]
    redundancy: Float[Tensor, "*batch"]
    singular_values: Float[Tensor, "*batch q"]
    """Of the linearised system, the plane at infinity eliminated, in units of the noise, ascending: a combination of the
    unknowns with singular value s is determined by the data to a standard deviation of 1 / s."""
    combinations: Float[Tensor, "*batch q q"]
    """Those combinations as columns, over the unknowns `assumption.names(v)`: logarithms of focal length and aspect, skew over
    focal length, principal point over the longer side of the image."""


@dataclass(frozen=True)
class SolvedAssumption:
    """The answer under one assumption, views in the order of `PreparedCameras`."""

    parameters: Tensor
    plane: Tensor
    covariance: Tensor
    data_deviation: Tensor
    likely: Tensor
    """The parameters where what varies is expected to vary little, as far as the data leave it open, and their covariance."""
    likely_covariance: Tensor
    evidence: Tensor
    fit: AssumptionFit


def solve_assumption(ready: PreparedCameras, base: Tensor, assumption: Assumption, max_deviation: float) -> SolvedAssumption:
    """Find the metric cameras nearest to projective ones.

    Args:
        ready: The projective cameras.
        base: Expected intrinsic parameters of each view.
        assumption: What is free.
        max_deviation: Largest standard deviation of the logarithm of a focal length that is accepted.
    """
    b, v = ready.P.shape[:2]
    spread = assumption.spread(v, ready.P)
    q = spread.shape[-1]
    present = ready.present.to(ready.P.dtype)
    problem = UpgradeProblem(ready.straight, ready.covariance, base, present, spread)
    varying = "focal" in assumption.varying
    log_f, plane, _ = search_focal(
        ready.straight, ready.X, ready.visible.any(-2).to(ready.P.dtype), base, present, varying=varying, starts=STARTS
    )
    is_focal = spread[:, 0].sum(0) > 0
    starts = log_f.new_zeros(*log_f.shape[:2], q)
    starts[..., is_focal] = log_f if varying else log_f[..., :1]
    precision = assumption.precision(v, ready.P)
    # An absent view's focal length is nobody's: it stays where it was.
    held = present.new_full((b, q), 0.0)
    for k, (_, view) in enumerate(assumption.columns(v)):
        if view is not None:
            held[:, k] = 1 - present[:, view]
    precision = (precision + held)[:, None]
    mean = torch.zeros_like(precision)
    # Near enough to tell minima apart and to rank them; those that are kept go on, and the best to its end.
    rough = fit_upgrade(problem, starts, plane, mean, precision, coupled=False, max_iterations=30, tolerance=NEAR)
    ranked = (rough.objective + _impossible(problem, ready, rough.unknowns, rough.plane)).argsort(-1)
    finalists = _distinct(ranked, rough.unknowns[..., is_focal].mean(-1), rough.plane)
    rows = torch.arange(b, device=ready.P.device)[:, None]
    fine = fit_upgrade(
        problem, rough.unknowns[rows, finalists], rough.plane[rows, finalists], mean, precision, coupled=True,
        max_iterations=30, tolerance=NEAR,
    )  # fmt: skip
    total = fine.objective + _impossible(problem, ready, fine.unknowns, fine.plane)
    winner = total.argmin(-1)[:, None]
    best = fit_upgrade(
        problem, fine.unknowns[rows, winner], fine.plane[rows, winner], mean, precision, coupled=True, max_iterations=30
    )
    wrong = _impossible(problem, ready, best.unknowns, best.plane)[:, 0]
    unknowns, p, chi2, objective = best.unknowns[:, 0], best.plane[:, 0], best.cost[:, 0], best.objective[:, 0] + wrong

    number = present.sum(-1)
    redundancy = 5 * (number - 1) - 3 - (q - held.sum(-1)) + (precision[:, 0] > 0).sum(-1) - held.sum(-1)
    birge = (chi2 / redundancy.clamp_min(1)).clamp_min(1)
    information = fit_information(problem, unknowns, p)
    on_unknowns = _schur(information, q)
    values, vectors, _ = eigh(on_unknowns)
    values = values.clamp_min(0)
    expected = torch.diag_embed(precision[:, 0].square())
    tiny = 1e-12 * torch.eye(q, dtype=values.dtype, device=values.device)
    variation, log_density = expected_variation(assumption, precision[:, 0], present)
    calmed = torch.linalg.inv_ex(on_unknowns / birge[:, None, None] + variation + tiny).inverse
    likely = unknowns - (calmed @ (variation @ unknowns[..., None]))[..., 0]
    surprise = (unknowns * (variation @ unknowns[..., None])[..., 0]).sum(-1)
    whole = information / birge[:, None, None] + torch.nn.functional.pad(variation, (0, 3, 0, 3))
    evidence = log_evidence(chi2, redundancy, whole, surprise, log_density, q + 3 - held.sum(-1))
    covariance = torch.linalg.inv_ex(on_unknowns / birge[:, None, None] + expected + tiny).inverse
    # The floor makes the deviation of what the data do not determine at all large and finite.
    by_data = (vectors.square() @ (birge[:, None] / values.clamp_min(1e-6))[..., None])[..., 0].sqrt()
    per_view = spread @ covariance[:, None] @ spread.mT
    free = spread.sum(-1) > 0
    data_deviation = torch.einsum("vmq,bq->bvm", spread, by_data) * free
    focal = (per_view[..., 0, 0].clamp_min(0).sqrt() * present).amax(-1)

    # A second answer that fits as well, or focal lengths well off that do, leave the question open.
    others = (fine.unknowns - unknowns[:, None])[..., is_focal].abs().amax(-1) > _APART
    rival = (others & (total < (objective + _CLEAR * birge)[:, None])).any(-1)
    moved = unknowns[:, None].expand(b, 2, q).clone()
    moved[:, 0, is_focal] -= _APART
    moved[:, 1, is_focal] += _APART
    pinned = precision.expand(b, 2, q) + 1e3 * is_focal
    expectation = torch.where(is_focal, moved, 0.0)
    away = fit_upgrade(problem, moved, p[:, None].expand(b, 2, 3), expectation, pinned, coupled=True, max_iterations=12)
    flat = (away.objective < (objective + _CLEAR * birge)[:, None]).any(-1)

    log_focal = (problem.intrinsics(unknowns)[..., 0, 0].log() * present).abs().amax(-1)
    status = torch.full((b,), int(Status.OK), dtype=torch.int8, device=ready.P.device)
    for condition, code in (
        (flat | rival | (focal > max_deviation) | (log_focal > math.log(40)), Status.DEGENERATE),
        (chi2 > 200 * redundancy.clamp_min(1), Status.NO_CONSENSUS),
        (wrong > 0, Status.BEHIND),
        ((number < 2) | (redundancy < 0), Status.TOO_FEW),
        (~ready.finite, Status.NOT_FINITE),
        (number < 2, Status.TOO_FEW),
    ):
        status = torch.where(condition, int(code), status)
    fit = AssumptionFit(assumption, status.to(torch.int8), chi2, redundancy, values.sqrt(), vectors)

    def of_views(u: Tensor) -> Tensor:
        return base + torch.einsum("vmq,bq->bvm", spread, u).clamp(-20, 20)

    likely_covariance = spread @ calmed[:, None] @ spread.mT
    return SolvedAssumption(of_views(unknowns), p, per_view, data_deviation, of_views(likely), likely_covariance, evidence, fit)


def _impossible(problem: UpgradeProblem, ready: PreparedCameras, unknowns: Tensor, p: Tensor) -> Tensor:
    """A penalty where views would be mirrored or the plane at infinity would pass between points."""
    K = problem.intrinsics(unknowns)
    M = metric_blocks(problem.P[:, None], K, K[..., 0, :, :], p)
    mirrored = ((determinant_3x3(M) < 0) * problem.present[:, None]).sum(-1)
    side = (torch.cat((p, torch.ones_like(p[..., :1])), -1) @ ready.X.mT).sign()
    seen = ready.visible.any(-2).to(p.dtype)[:, None]
    share = (side * seen).sum(-1).abs() / seen.sum(-1).clamp_min(1)
    return 1e12 * (mirrored + (share < 0.9))


def _distinct(ranked: Tensor, log_f: Tensor, p: Tensor) -> Tensor:
    """The best of `ranked`, and the best of those that differ from it in focal length or plane, and so on."""
    rows = torch.arange(len(ranked), device=ranked.device)
    place = torch.zeros_like(ranked).scatter(1, ranked, torch.arange(ranked.shape[1], device=ranked.device).expand_as(ranked))
    order = place.to(p.dtype)
    chosen = []
    for _ in range(min(FINALISTS, ranked.shape[1])):
        best = order.argmin(-1)
        chosen.append(best)
        near = (log_f - log_f[rows, best][:, None]).abs() < 0.01
        near &= (p - p[rows, best][:, None]).norm(dim=-1) < 0.01 * (1 + p[rows, best].norm(dim=-1, keepdim=True))
        order = torch.where(near, order + ranked.shape[1], order)
        order[rows, best] += 10 * ranked.shape[1]
    return torch.stack(chosen, -1)


def _schur(information: Tensor, q: int) -> Tensor:
    """The information on the first q unknowns, the others being free."""
    A, B, D = information[:, :q, :q], information[:, :q, q:], information[:, q:, q:]
    scale = D.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    D = scale[:, :, None] * D * scale[:, None] + 1e-13 * torch.eye(3, dtype=D.dtype, device=D.device)
    B = B * scale[:, None]
    solved = torch.linalg.solve_ex(D, B.mT).result
    reduced = torch.nan_to_num(A - B @ solved, 0.0, 0.0, 0.0)
    return 0.5 * (reduced + reduced.mT)
