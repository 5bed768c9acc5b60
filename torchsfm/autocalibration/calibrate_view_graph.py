"""The focal length of every camera from the fundamental matrices among them.

With principal points known and pixels square, `E = K2' F K1` of every pair must be essential: rank 2 with two equal singular
values. Each pair says something of two focal lengths, often too little to find them (Bougnoux's formula is 0 / 0 where the
optical axes meet); all pairs together determine most. The robust sum of the asymmetries `(s1 - s2) / (s1 + s2)` over all
pairs, with what was expected, is minimised over all focal lengths at once (Sweeney et al., "Optimizing the viewing graph for
structure-from-motion", ICCV 2015).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Int8
from torch import Tensor

from torchsfm._types import Status, check_tensors
from torchsfm.autocalibration.focal_from_fundamentals import SCALE
from torchsfm.linalg import cross, inverse, nearest_psd, usable
from torchsfm.optim import Cauchy, levenberg_marquardt

STARTS, SPREAD = 9, 1.6
"""Starts: all focal lengths longer, or shorter, by up to so many standard deviations of what was expected of them."""
COMMON = 0.5
"""Share of the variance of what was expected that is one and the same for all cameras: a guess is off for all of them."""
TINY, ROUNDING = 1e-300, 1e-14
"""The least denominator; the square of an asymmetry that rounding makes."""
CHANCE = 3.0
"""Slopes that are so many standard deviations of what noise makes of them tell something."""
DETERMINED = 0.6
"""A focal length at most so uncertain, compared to what was expected, is determined by the pairs."""


@dataclass(frozen=True)
class ViewGraphFocals:
    """The focal lengths of v cameras, and how well p pairs determine them.

    Attributes:
        model: In pixels.
        deviation: Standard deviation of the logarithm of each, by the pairs that agree and by what was expected.
        status: OK; DEGENERATE: the pairs add little to what was expected, or the minimisation failed; TOO_FEW: no pair of this
            camera counts; NOT_FINITE: what was expected of it is not finite or not positive. Only where it is OK does `model`
            differ from what was expected.
        asymmetry: `(s1 - s2) / (s1 + s2)` of each pair's essential matrix at the focal lengths found; 1 for pairs that do not
            count.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> f, c = torch.tensor([800.0, 900.0, 1000.0, 1100.0]).double(), torch.zeros(4, 2).double()
        >>> P = torchsfm.intrinsics(f, c) @ torchsfm.random_poses(4, wobble=1.0, generator=g).matrix()
        >>> pairs = torch.combinations(torch.arange(4))
        >>> F = torchsfm.tensors.bifocal_tensors(P, pairs)
        >>> F[5] = torch.randn(3, 3, generator=g)  # one of six pairs is wrong
        >>> found = torchsfm.calibrate_view_graph(F, pairs, c, torch.full_like(f, 950), torch.full_like(f, 0.3))
        >>> bool((found.model / f - 1).abs().max() < 0.05), found.asymmetry.argmax()  # and is told
        (True, tensor(5))
        >>> bool((found.deviation < 0.3).all())  # less than before anything was seen
        True
    """

    model: Float[Tensor, "*batch v"]
    deviation: Float[Tensor, "*batch v"]
    status: Int8[Tensor, "*batch v"]
    asymmetry: Float[Tensor, "*batch p"]


def calibrate_view_graph(
    F: Float[Tensor, "*#batch p 3 3"],
    cameras: Int[Tensor, "p 2"],
    c: Float[Tensor, "*#batch v 2"],
    focal: Float[Tensor, "*#batch v"],
    sigma: Float[Tensor, "*#batch v"],
) -> ViewGraphFocals:
    """Focal lengths of many cameras of which little is known; principal points known, square pixels, no distortion.

    A pair that sees one plane, or whose cameras turn about one centre, has no fundamental matrix to speak of: leave such pairs
    out. Wrong pairs are outvoted. Nothing is learned from a camera all of whose pairs look at one point from equal distances,
    or have parallel axes (Sturm 2001): the status says so.

    Args:
        F: Fundamental matrices, `x2' F x1 = 0`, of any scale.
        cameras: The cameras of the first and second image of each pair.
        c: Principal points in pixels.
        focal: Focal lengths as expected, in pixels.
        sigma: How uncertain they are: standard deviation of the logarithm, that is, the fraction by which they may be off.

    Returns:
        Focal lengths, their standard deviations, a status each, and every pair's asymmetry.

    Raises:
        ValueError: Shapes, dtypes or devices do not fit, or a camera's number is out of range.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> f, c = torch.tensor([800.0, 900.0, 1000.0]).double(), torch.zeros(3, 2).double()
        >>> P = torchsfm.intrinsics(f, c) @ torchsfm.random_poses(3, wobble=1.0, generator=g).matrix()
        >>> pairs = torch.tensor([[0, 1], [0, 2], [1, 2]])
        >>> F = torchsfm.tensors.bifocal_tensors(P, pairs)
        >>> found = torchsfm.calibrate_view_graph(F, pairs, c, torch.full_like(f, 850), torch.full_like(f, 0.3))
        >>> bool((found.model / f - 1).abs().max() < 0.05)
        True
    """
    batch = check_tensors(F=(F, "p 3 3"), cameras=(cameras, "p 2: int"), c=(c, "v 2"), focal=(focal, "v"), sigma=(sigma, "v"))
    v, p = focal.shape[-1], F.shape[-3]
    if cameras.ndim != 2 or (p and not 0 <= int(cameras.min()) <= int(cameras.max()) < v):
        raise ValueError(f"cameras: wanted {p} pairs of numbers from 0 to {v - 1}, got {tuple(cameras.shape)}")
    dtype = F.dtype
    with torch.no_grad():
        F, c, expected, width = (t.double().expand(*batch, *t.shape[-k:]) for t, k in ((F, 3), (c, 2), (focal, 1), (sigma, 1)))
        known = usable(c).all(-1) & usable(expected) & (expected > 0) & usable(width) & (width > 0)
        c, width = torch.where(known[..., None], c, 0), torch.where(known, width, 1)
        start = torch.where(known, expected, 1)
        i, j = cameras.unbind(-1)
        good = usable(F).all(-1).all(-1) & (F.abs() > 0).any(-1).any(-1) & known[..., i] & known[..., j] & (i != j)
        E = _calibrated(torch.where(good[..., None, None], F, torch.eye(3, dtype=F.dtype, device=F.device)), c, start, i, j)
        data = _invariants(E)[..., None, :, :], width[..., None, :], good[..., None, :]
        graph = _Graph(i, j, v)
        shift = torch.linspace(-SPREAD, SPREAD, STARTS, dtype=torch.float64, device=F.device)
        fit = levenberg_marquardt(
            graph.residual,
            shift[:, None] * width[..., None, :],
            *data,
            linearize=graph.linearize,
            loss=Cauchy(1.0),
            max_iterations=100,
            function_tolerance=1e-9,
        )
        cost, best = torch.where(fit.cost.isfinite(), fit.cost, torch.inf).min(-1, keepdim=True)
        x = fit.x.gather(-2, best[..., None].expand(*batch, 1, v))
        residual, J = graph.linearize(x, *data)
        residual, J = residual[..., 0, :, 0], J[..., 0, :, 0, :]
        weight = 1 / (1 + residual.square())
        told = _beyond_noise(residual[..., :p], J[..., :p, :], weight[..., :p], good, i, j)
        prior = J[..., p:, :]
        covariance, regular = inverse(told + prior.mT @ (weight[..., p:, None] * prior))
        variance = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0)
        deviation = torch.where(regular[..., None], torch.minimum(variance.sqrt(), width), width)
        x = x[..., 0, :]
        number = torch.zeros_like(x).index_add(-1, i, good.double()).index_add(-1, j, good.double())
        status = torch.full_like(x, int(Status.OK), dtype=torch.int8)
        for condition, code in (
            (~(cost.isfinite() & (deviation < DETERMINED * width)), Status.DEGENERATE),
            (number == 0, Status.TOO_FEW),
            (~known, Status.NOT_FINITE),
        ):
            status = torch.where(condition, int(code), status).to(torch.int8)
        found = status == Status.OK
        model = torch.where(found, start * x.exp(), expected)
        asymmetry = torch.where(good, residual[..., :p] * SCALE, 1)
    return ViewGraphFocals(model.to(dtype), torch.where(found, deviation, width).to(dtype), status, asymmetry.to(dtype))


@dataclass(frozen=True)
class _Graph:
    """Which cameras each pair has: residuals of problems that share them, for any batch in front.

    The unknowns x are the logarithms of the focal lengths over the expected ones. Residuals are the asymmetries of the pairs in
    units of `SCALE`, 0 for pairs that do not count, then deviations from what was expected, uncorrelated, in theirs.
    """

    i: Int[Tensor, "p"]
    j: Int[Tensor, "p"]
    number: int

    def residual(self, x: Tensor, invariants: Tensor, width: Tensor, good: Tensor) -> Tensor:
        """All residuals `(*batch, p + v, 1)` for invariants `(*batch, p, 8)`."""
        pairs = _asymmetry(x[..., self.i], x[..., self.j], invariants, good)
        return torch.cat((pairs, (x / width) @ self._apart()), -1)[..., None]

    def linearize(self, x: Tensor, invariants: Tensor, width: Tensor, good: Tensor) -> tuple[Tensor, Tensor]:
        """The same, and the derivatives `(*batch, p + v, 1, v)`: each pair has two."""
        with torch.enable_grad():
            a, b = (x[..., index].detach().requires_grad_() for index in (self.i, self.j))
            slopes = torch.autograd.grad(_asymmetry(a, b, invariants, good).sum(), (a, b))
        J = x.new_zeros(*x.shape[:-1], len(self.i), x.shape[-1])
        for index, slope in zip((self.i, self.j), slopes, strict=True):
            J.scatter_add_(-1, index[:, None].expand(*slope.shape, 1), slope[..., None])
        prior = (self._apart() / width[..., None, :]).expand(*x.shape, x.shape[-1])
        return self.residual(x, invariants, width, good), torch.cat((J, prior), -2)[..., None, :]

    def _apart(self) -> Float[Tensor, "v v"]:
        """The inverse root of the covariance of what is expected of v cameras, half of which they have in common."""
        eye = torch.eye(self.number, dtype=torch.float64, device=self.i.device)
        root = COMMON**-0.5
        whitening: Tensor = root * eye - (root - (COMMON * (1 + self.number)) ** -0.5) / max(self.number, 1)
        return whitening


def _beyond_noise(residual: Tensor, J: Tensor, weight: Tensor, good: Tensor, i: Tensor, j: Tensor) -> Tensor:
    """The information `(*batch, v, v)` of the pairs on the logarithms of focal lengths, without what their noise alone makes.

    Noise gives slopes too: the asymmetry of a pair whose cameras only translate is its noise, which a focal length scales. An
    asymmetry is the length of two numbers, so that each pair has one redundant number less than it has unknowns, two; the
    scale that losses have counts as one more.
    """
    weight = torch.where(good, weight, 0.0)
    # Each focal length scales half of the noise.
    share = torch.zeros_like(J[..., :1, :].sum(-2)).index_add(-1, i, weight / 2).index_add(-1, j, weight / 2)
    redundancy = (2 * weight.sum(-1) - (share > 0).sum(-1)).clamp(min=0)
    noise = (1 + (weight * residual.square()).sum(-1)) / (1 + redundancy)
    return nearest_psd(J.mT @ (weight[..., None] * J) - torch.diag_embed(CHANCE**2 * noise[..., None] * share))


def _asymmetry(a: Tensor, b: Tensor, invariants: Tensor, good: Tensor) -> Tensor:
    """The asymmetries of E' = diag(e^b, e^b, 1) E diag(e^a, e^a, 1) in units of `SCALE`.

    s1^2 + s2^2 is the sum of the squares of its entries, (s1 s2)^2 that of its cofactors.
    """
    block, row, column, corner, co_block, co_row, co_column, co_corner = invariants.unbind(-1)
    u, w = (2 * a).exp(), (2 * b).exp()
    sums = u * w * block + u * row + w * column + corner
    products = 2 * (u * w * (co_block + w * co_row + u * co_column + u * w * co_corner)).clamp(min=TINY).sqrt()
    ratio = products / sums.clamp(min=TINY)
    # The root has no slope at 0, and rounding is no asymmetry.
    k = ((1 - ratio).clamp(min=0) / (1 + ratio) + ROUNDING).sqrt()
    return torch.where(good, k / SCALE, 0.0)


def _calibrated(F: Tensor, c: Tensor, f: Tensor, i: Tensor, j: Tensor) -> Tensor:
    """`K2' F K1` of norm 1."""
    K = torch.diag_embed(torch.stack((f, f, torch.ones_like(f)), -1))
    K[..., :2, 2] = c
    E = K[..., j, :, :].mT @ F @ K[..., i, :, :]
    unit: Tensor = E / torch.linalg.matrix_norm(E).clamp(min=TINY)[..., None, None]
    return unit


def _invariants(E: Tensor) -> Tensor:
    """Sums of squares of E, then of its cofactors: upper left block, rest of the last row, of the last column, corner."""
    r0, r1, r2 = E.unbind(-2)
    parts = []
    for M in (E, torch.stack((cross(r1, r2), cross(r2, r0), cross(r0, r1)), -2)):
        square = M * M
        parts += [square[..., :2, :2].sum((-2, -1)), square[..., 2, :2].sum(-1), square[..., :2, 2].sum(-1), square[..., 2, 2]]
    return torch.stack(parts, -1)
