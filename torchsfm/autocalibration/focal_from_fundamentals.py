"""One focal length from many fundamental matrices.

With the principal point known and pixels square, `E = K2' F K1` must be an essential matrix: rank 2 with two equal
singular values. `k(f) = (s1 - s2) / (s1 + s2)` measures how far it is from one (Mendonca & Cipolla, "A simple technique
for self-calibration", CVPR 1999). Both s1^2 + s2^2 and s1 s2 are polynomials in f^2, so that a whole grid of focal
lengths costs no decomposition. One unknown makes a search over the grid exact, and robust against any number of pairs
that disagree without agreeing among themselves.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int8
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors
from torchsfm.linalg import cross, usable
from torchsfm.optim import attach_optimum
from torchsfm.optim.likely_noise import QUARTER, likely_variance

WIDE = (0.15, 12.0)
"""Focal lengths searched, over the longer side of the image: views of 147 to 5 degrees."""
SCALE = 0.005
"""Asymmetry `k` at which a pair starts to count as disagreeing; half a pixel of noise on 150 points gives about 0.0007."""
NOISE = 6e-4
"""Asymmetry that the best of fundamental matrices from real images is trusted to have."""
SUPPORT = 0.1
"""Share of the pairs, one not counted, that must agree on the focal length."""
APART = 0.35
"""Focal lengths this far apart in logarithm must differ in cost, or the pairs do not tell the focal length."""


@dataclass(frozen=True)
class FocalEstimate:
    """A focal length, and how well the pairs determine it.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> c = torch.tensor([[499.5, 374.5]]).double().expand(3, 2)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0).double(), c[0])
        >>> P = K @ torchsfm.random_poses(3, wobble=1.0, generator=g).matrix()
        >>> F = torchsfm.tensors.bifocal_tensors(P, torch.tensor([[0, 1], [0, 2], [1, 2]]))
        >>> found = torchsfm.autocalibration.focal_from_fundamentals(F, c, c)
        >>> best = found.candidates[found.cost.argmin()]  # of those that were tried
        >>> bool((best / found.model - 1).abs() < 0.05), found.model, bool(found.uncertainty < 0.01)  # relative
        (True, tensor(900.0000, dtype=torch.float64), True)
    """

    model: Float[Tensor, "*batch"]
    """In pixels; where `status` is not OK only the least bad of the candidates."""
    status: Int8[Tensor, "*batch"]
    """OK; DEGENERATE: very different focal lengths explain the pairs as well, or the best is at an end of the search range;
    NO_CONSENSUS: hardly two pairs agree; TOO_FEW: no pair has weight; NOT_FINITE: no pair with weight is finite."""
    uncertainty: Float[Tensor, "*batch"]
    """Standard deviation of the logarithm of the focal length, from the disagreement among the pairs; 1 where nothing
    is known."""
    candidates: Float[Tensor, "*batch k"]
    """Focal lengths searched, in pixels."""
    cost: Float[Tensor, "*batch k"]
    """Robust mean over the pairs of squared asymmetry at each candidate, at most `SCALE` squared."""
    asymmetry: Float[Tensor, "*batch p"]
    """`(s1 - s2) / (s1 + s2)` of each pair's essential matrix at the focal length found; 1 for pairs that are not finite."""


def focal_from_fundamentals(
    F: Float[Tensor, "*#batch p 3 3"],
    c1: Float[Tensor, "*#batch p 2"],
    c2: Float[Tensor, "*#batch p 2"],
    *,
    weights: Float[Tensor, "*#batch p"] | None = None,
    image_size: Float[Tensor, "*#batch 2"] | None = None,
    focal_range: tuple[float, float] | None = None,
    num_candidates: int = 320,
) -> FocalEstimate:
    """The focal length that both cameras of every one of p pairs have: principal points known, square pixels, no distortion.

    The robust mean of the squared asymmetries of all pairs is evaluated on a logarithmic grid, and its lowest place
    refined by Newton's method. A pair whose optical axes meet at equal distances from both centres, as on a turntable,
    and a pair without rotation say nothing (Sturm 2001): their asymmetry hardly changes along the grid and they do no
    harm; if all pairs are such, the status is DEGENERATE. A pair that sees one plane has no fundamental matrix to speak
    of; leave such pairs out, or let them be outvoted. A single pair of that kind can pass for a good one; several
    cannot, and give NO_CONSENSUS.

    The derivative with respect to F, principal points and weights is that of the optimum.

    Args:
        F: Fundamental matrices, `x2' F x1 = 0`, of any scale.
        c1: Principal points in the first images, in pixels.
        c2: Principal points in the second images, in pixels.
        weights: Of the pairs, for instance numbers of inliers; all 1 by default.
        image_size: Width and height; taken from the principal points, as twice their coordinates, by default.
        focal_range: Smallest and largest focal length to search, in pixels; 0.15 to 12 times the longer side by default.
        num_candidates: Number of focal lengths on the grid.

    Returns:
        The focal length, its status and uncertainty, the cost curve and every pair's asymmetry.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, or the search range is empty.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> c = torch.tensor([[499.5, 374.5]]).double().expand(3, 2)
        >>> K = torchsfm.intrinsics(torch.tensor(900.0).double(), c[0])
        >>> P = K @ torchsfm.random_poses(3, wobble=1.0, generator=g).matrix()
        >>> F = torchsfm.tensors.bifocal_tensors(P, torch.tensor([[0, 1], [0, 2], [1, 2]]))
        >>> found = torchsfm.autocalibration.focal_from_fundamentals(F, c, c)
        >>> bool(found.status == torchsfm.Status.OK), found.model
        (True, tensor(900.0000, dtype=torch.float64))
    """
    batch = check_tensors(
        F=(F, "p 3 3"), c1=(c1, "p 2"), c2=(c2, "p 2"), weights=(weights, "?p"), image_size=(image_size, "?2")
    )
    check_options(focal_range=(focal_range, "?2 float > 0"), num_candidates=(num_candidates, "int >= 8"))
    if focal_range is not None and not focal_range[0] < focal_range[1]:
        raise ValueError(f"focal_range: wanted 0 < smallest < largest, got {focal_range}")
    p = F.shape[-3]
    F64, a, b = (t.double().expand(*batch, p, *t.shape[-k:]) for t, k in ((F, 2), (c1, 1), (c2, 1)))
    w = torch.ones(*batch, p, dtype=torch.float64, device=F.device) if weights is None else weights.double().expand(*batch, p)
    wanted = ~(w <= 0)
    finite = usable(F64).all(-1).all(-1) & usable(a).all(-1) & usable(b).all(-1) & usable(w)
    finite = finite & (F64.abs() > 0).any(-1).any(-1)
    used = wanted & finite
    w = torch.where(used, w, 0.0)
    F64 = torch.where(finite[..., None, None], F64, torch.eye(3, dtype=torch.float64, device=F.device))
    a, b = torch.where(finite[..., None], a, 0.0), torch.where(finite[..., None], b, 0.0)

    if image_size is not None:
        unit = image_size.detach().double().amax(-1).expand(batch)
    else:
        centres = torch.maximum(a.detach().abs().amax(-1), b.detach().abs().amax(-1))
        unit = 2 * torch.where(used, centres, 0.0).amax(-1) if p else torch.ones(batch, dtype=torch.float64, device=F.device)
    unit = torch.where(torch.isfinite(unit) & (unit > 0), unit, 1.0)
    span = torch.tensor(WIDE if focal_range is None else focal_range, dtype=torch.float64, device=F.device).log()
    steps = torch.linspace(0, 1, num_candidates, dtype=torch.float64, device=F.device)
    # Logarithms of focal lengths in units of the image.
    grid = span[0] + steps * (span[1] - span[0]) - (unit.log()[..., None] if focal_range is not None else 0.0)
    grid = grid.expand(*batch, num_candidates)

    with torch.no_grad():
        curves = _Curves(F64, a, b, unit)
        total = w.sum(-1).clamp_min(1e-300)
        cost = _robust(curves(grid), w) / total[..., None]
        best = cost.argmin(-1, keepdim=True)
        inside = ((best > 0) & (best < num_candidates - 1))[..., 0]
        start = grid.gather(-1, best)
        log_f = _polish(curves, w, start, (span[1] - span[0]) / (num_candidates - 1))
        k2 = curves(log_f)[..., 0, :]
        # The pairs that agree decide whether another focal length would do as well.
        agreeing = w * (SCALE**2 / (SCALE**2 + k2)) ** 2
        share = agreeing.sum(-1, keepdim=True).clamp_min(1e-300)
        number = share[..., 0] ** 2 / (agreeing**2).sum(-1).clamp_min(1e-300)
        mean = (agreeing * k2).sum(-1) / share[..., 0]
        level = (mean + NOISE**2)[..., None]
        # An asymmetry is the length of two numbers; of few pairs the best focal length leaves little by chance.
        likely = 2 * likely_variance(number * mean, 2 * number - 1, QUARTER)[..., None] + NOISE**2
        along = (agreeing[..., None, :] * curves(grid)).sum(-1) / share
        told = ((along > 4 * likely) | ((grid - log_f).abs() < APART)).all(-1)
        # One pair always agrees with itself; of the others some must agree too.
        support = (w * SCALE**2 / (SCALE**2 + k2)).sum(-1)
        largest = w.amax(-1) if p else torch.zeros(batch, dtype=torch.float64, device=F.device)
        supported = (support - largest >= SUPPORT * (w.sum(-1) - largest)) | ((w > 0).sum(-1) == 1)
        uncertainty = _spread(curves, log_f, agreeing / share, level) / number.clamp_min(1).sqrt()

    status = torch.full(batch, int(Status.OK), dtype=torch.int8, device=F.device)
    for condition, code in (
        (~(inside & told), Status.DEGENERATE),
        (~supported, Status.NO_CONSENSUS),
        (~used.any(-1), Status.NOT_FINITE),
        (~wanted.any(-1), Status.TOO_FEW),
    ):
        status = torch.where(condition, int(code), status)
    known = status == Status.OK

    def objective(x: Tensor, F: Tensor, a: Tensor, b: Tensor, w: Tensor) -> Tensor:
        return _robust(_Curves(F, a, b, unit)(x), w)[..., 0]

    log_f = attach_optimum(objective, log_f, F64, a, b, w, valid=known)[..., 0]
    return FocalEstimate(
        (log_f.exp() * unit).to(F.dtype),
        status,
        torch.where(known, uncertainty.clamp_max(1.0), 1.0).to(F.dtype),
        (grid.exp() * unit[..., None]).to(F.dtype),
        cost.to(F.dtype),
        torch.where(finite, k2.sqrt(), 1.0).to(F.dtype),
    )


class _Curves:
    """The squared asymmetry of every pair as a function of the logarithm of the focal length, in units of the image."""

    def __init__(self, F: Tensor, c1: Tensor, c2: Tensor, unit: Tensor) -> None:
        # Move the origins to the principal points and take the unit out: G = T2' F T1.
        s = unit[..., None]
        columns = torch.stack((F[..., 0], F[..., 1], ((F[..., :2] @ c1[..., None])[..., 0] + F[..., 2]) / s[..., None]), -1)
        last = ((c2[..., None, :] @ columns[..., :2, :])[..., 0, :] + columns[..., 2, :]) / s[..., None]
        G = torch.cat((columns[..., :2, :], last[..., None, :]), -2)
        r0, r1, r2 = G.unbind(-2)
        cofactors = torch.stack((cross(r1, r2), cross(r2, r0), cross(r0, r1)), -2)
        self.sums = _parts(G)
        self.products = _parts(cofactors)

    def __call__(self, log_f: Tensor) -> Tensor:
        """Squared asymmetries (*batch, k, p) at log focal lengths (*batch, k)."""
        u = (2 * log_f).exp()[..., None]
        # With D = diag(f, f, 1), the cofactors of D G D are f times diag(1, 1, f) cof(G) diag(1, 1, f).
        a0, a1, a2 = (t[..., None, :] for t in self.sums)
        b0, b1, b2 = (t[..., None, :] for t in self.products)
        sums = (a0 * u + a1) * u + a2
        products = 2 * u * _root(b0 + (b1 + b2 * u) * u)
        ratio = products / torch.where(sums > 0, sums, 1.0)
        return (1 - ratio).clamp_min(0) / (1 + ratio)


def _parts(M: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sums of squares of the upper left block, of the last row and column without the corner, and of the corner."""
    square = M * M
    block = square[..., :2, :2].sum(-1).sum(-1)
    return block, square[..., 2, :2].sum(-1) + square[..., :2, 2].sum(-1), square[..., 2, 2]


def _root(x: Tensor) -> Tensor:
    positive = x > 0
    return torch.where(positive, torch.where(positive, x, 1.0).sqrt(), 0.0)


def _robust(k2: Tensor, w: Tensor) -> Tensor:
    """The weighted sum over pairs of Geman & McClure's loss of the asymmetries (*batch, k, p)."""
    return (w[..., None, :] * k2 * (SCALE**2 / (SCALE**2 + k2))).sum(-1)


def _polish(curves: _Curves, w: Tensor, start: Tensor, step: Tensor) -> Tensor:
    """The minimum within one step of the grid: golden section, then Newton's method."""
    golden = (5**0.5 - 1) / 2
    low, high = start - step, start + step
    for _ in range(24):
        width = golden * (high - low)
        left, right = high - width, low + width
        lower = _robust(curves(left), w) < _robust(curves(right), w)
        low, high = torch.where(lower, low, left), torch.where(lower, right, high)
    x = 0.5 * (low + high)

    for _ in range(3):
        # Plain autograd: the first call of torch.func imports for seconds.
        with torch.enable_grad():
            t = x.detach().requires_grad_()
            (first,) = torch.autograd.grad(_robust(curves(t), w).sum(), t, create_graph=True)
            (second,) = torch.autograd.grad(first.sum(), t)
        move = first.detach() / torch.where(second > 0, second, 1.0)
        x = torch.where((second > 0) & (move.abs() < 1e-4), x - move, x)
    return x


def _spread(curves: _Curves, log_f: Tensor, w: Tensor, level: Tensor) -> Tensor:
    """The standard deviation of one pair's log focal length, from the curvature of the weighted mean asymmetry (*batch)."""
    h = 0.02
    low, middle, high = ((w[..., None, :] * curves(log_f + s)).sum(-1) for s in (-h, 0.0, h))
    curvature = (low - 2 * middle + high) / (2 * h * h)
    return (level / curvature.clamp_min(1e-12)).sqrt()[..., 0]
