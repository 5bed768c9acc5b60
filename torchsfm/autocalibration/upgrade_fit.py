"""Intrinsics and plane at infinity by weighted least squares.

The departures of all cameras from metric ones are weighed with their covariance, to which the covariance of the projective
cameras propagates. To first order this is what bundle adjustment over metric cameras finds, in as few unknowns as intrinsics
and plane have, so that many starts of many problems fit in one batch; its singular values say what the data determine in units
of their noise.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.autocalibration.upgrade_residual import Departures, departures
from torchsfm.geometry.intrinsic_parameters import intrinsics_from_relative
from torchsfm.optim import levenberg_marquardt


@dataclass(frozen=True)
class UpgradeProblem:
    """Cameras in the frame where the first is [I | 0], with what is needed to weigh them; one batch dimension."""

    P: Float[Tensor, "b v 3 4"]
    covariance: Float[Tensor, "b v 12 v 12"] | Float[Tensor, "b v 12 12"]
    """Of the cameras' entries, of all views together or of each by itself."""
    base: Float[Tensor, "b v 5"]
    """Intrinsic parameters where the unknowns are zero."""
    present: Float[Tensor, "b v"]
    """1 for views that take part."""
    spread: Float[Tensor, "v 5 q"]
    """From unknowns to the parameters of every view."""

    def intrinsics(self, unknowns: Float[Tensor, "b *k q"]) -> Float[Tensor, "b *k v 3 3"]:
        """K of every view."""
        parameters = torch.einsum("vmq,...q->...vm", self.spread, unknowns)
        base = self.base.reshape(len(self.base), *([1] * (unknowns.ndim - 2)), *self.base.shape[1:])
        return intrinsics_from_relative(base + parameters)

    def select(self, index: Tensor) -> "UpgradeProblem":
        """Some of the problems."""
        return UpgradeProblem(self.P[index], self.covariance[index], self.base[index], self.present[index], self.spread)


@dataclass(frozen=True)
class UpgradeFit:
    """Solutions of a batch of problems, from k starts each."""

    unknowns: Float[Tensor, "b k q"]
    plane: Float[Tensor, "b k 3"]
    cost: Float[Tensor, "b k"]
    """Sum of the squared weighted departures, of the data alone: chi squared."""
    objective: Float[Tensor, "b k"]
    """With what was expected of the unknowns."""


def fit_upgrade(
    problem: UpgradeProblem,
    unknowns: Float[Tensor, "b k q"],
    plane: Float[Tensor, "b k 3"],
    mean: Float[Tensor, "b #k q"],
    precision: Float[Tensor, "b #k q"],
    *,
    coupled: bool,
    max_iterations: int,
    tolerance: float = 1e-9,
) -> UpgradeFit:
    """Minimise from k starts each.

    Args:
        problem: The cameras.
        unknowns: Intrinsic unknowns at the start.
        plane: Planes at infinity at the start.
        mean: What is expected of the unknowns.
        precision: One over the standard deviation of that.
        coupled: Weigh with the covariance of all views together; else view by view, which is cheaper and less exact.
        max_iterations: Most steps.
        tolerance: A fit is done when no more than this fraction of its objective is left to gain.
    """
    b, k, q = unknowns.shape
    v = problem.P.shape[1]
    size = (b, k)
    covariance = problem.covariance
    coupled = coupled and covariance.ndim == 5
    if not coupled and covariance.ndim == 5:
        covariance = covariance.diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)
    shared = [
        t[:, None].expand(*size, *t.shape[1:]).flatten(0, 1) for t in (problem.P, covariance, problem.base, problem.present)
    ]
    expected = [t.expand(b, k, q).flatten(0, 1) for t in (mean, precision)]
    weighed = _WeighedDepartures(problem.spread, coupled)
    start = torch.cat((unknowns, plane), -1).flatten(0, 1)
    result = levenberg_marquardt(
        weighed.residual,
        start,
        *shared,
        *expected,
        linearize=weighed.linearize,
        local_cost=weighed.local_cost,
        max_iterations=max_iterations,
        function_tolerance=tolerance,
        step_tolerance=1e-9,
        initial_damping=1e-3,
    )
    residual = weighed.residual(result.x, *shared, *expected)
    cost = residual[:, : 5 * v, 0].square().sum(-1)
    bad = torch.finfo(cost.dtype).max / 4
    cost = torch.nan_to_num(cost, bad, bad, bad)
    x = torch.nan_to_num(result.x).reshape(b, k, -1)
    return UpgradeFit(
        x[..., :q],
        x[..., q:],
        cost.reshape(size),
        torch.nan_to_num(2 * result.cost, bad, bad, bad).reshape(size),
    )


def fit_information(
    problem: UpgradeProblem, unknowns: Float[Tensor, "b q"], plane: Float[Tensor, "b 3"]
) -> Float[Tensor, "b q+3 q+3"]:
    """The information of the data on the unknowns and the plane, `J' C^-1 J`."""
    zero = torch.zeros_like(unknowns)
    x = torch.cat((unknowns, plane), -1)
    data = (problem.P, problem.covariance, problem.base, problem.present, zero, zero)
    _, J = _WeighedDepartures(problem.spread, problem.covariance.ndim == 5).linearize(x, *data)
    J = torch.nan_to_num(J[:, :, 0], 0.0, 0.0, 0.0)
    return J.mT @ J


@dataclass(frozen=True)
class _WeighedDepartures:
    """The departures of present views over their noise, and what is expected of the unknowns: residuals of one number each."""

    spread: Float[Tensor, "v 5 q"]
    coupled: bool

    def residual(
        self, x: Tensor, P: Tensor, covariance: Tensor, base: Tensor, present: Tensor, mean: Tensor, precision: Tensor
    ) -> Tensor:
        """The residuals (b, 5 v + q, 1)."""
        found, counts = self._departures(x, P, base, present)
        weighed = self._weigh(found.by_camera, covariance, counts, (found.g * counts[..., None])[..., None])
        expected = (x[:, : self.spread.shape[-1]] - mean) * precision
        return torch.cat((weighed[..., 0], expected), -1)[..., None]

    def linearize(
        self, x: Tensor, P: Tensor, covariance: Tensor, base: Tensor, present: Tensor, mean: Tensor, precision: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The residuals, and their derivatives (b, 5 v + q, 1, q + 3), those of the weights left out."""
        found, counts = self._departures(x, P, base, present)
        own, reference, by_plane = found.by_parameters()
        J = torch.cat((own @ self.spread + reference @ self.spread[0], by_plane), -1)
        whole = torch.cat((found.g[..., None], J), -1) * counts[..., None, None]
        whole = self._weigh(found.by_camera, covariance, counts, whole)
        q = self.spread.shape[-1]
        expected = (x[:, :q] - mean) * precision
        tail = torch.cat((torch.diag_embed(precision), precision.new_zeros(len(x), q, 3)), -1)
        r = torch.cat((whole[..., 0], expected), -1)
        return r[..., None], torch.cat((whole[..., 1:], tail), -2)[..., None, :]

    def local_cost(
        self, x: Tensor, P: Tensor, covariance: Tensor, base: Tensor, present: Tensor, mean: Tensor, precision: Tensor
    ) -> Tensor:
        """Half the sum of squares at x, with its first and second derivatives, without those of a decomposition.

        `g' C^-1 g / 2` is the maximum over z of `z'g - z'C z / 2`; one Newton step from the z at x follows it to second order.
        """
        found, counts = self._departures(x, P, base, present)
        b, v = counts.shape
        B, g = found.by_camera * counts[..., None, None], (found.g * counts[..., None])[..., None]
        with torch.no_grad():
            L, scale, added = self._root(B, covariance, counts)
            scale = scale[..., None]
            z = (scale * torch.cholesky_solve(scale * g.reshape(scale.shape), L)).reshape(g.shape)
        w = B.mT @ z
        spread = covariance.reshape(b, 12 * v, 12 * v) @ w.flatten(1, 2) if self.coupled else covariance @ w
        Cz = B @ spread.reshape(w.shape) + added.reshape(g.shape) * z
        short = torch.linalg.solve_triangular(L, scale * (g - Cz).reshape(scale.shape), upper=False)
        expected = (x[:, : self.spread.shape[-1]] - mean) * precision
        squares: Tensor = short.flatten(1).square().sum(-1) + expected.square().sum(-1)
        return (z * (g - Cz / 2)).flatten(1).sum(-1) + squares / 2

    def _departures(self, x: Tensor, P: Tensor, base: Tensor, present: Tensor) -> tuple[Departures, Tensor]:
        """Those of all views, and which count: the first is metric by the choice of frame, absent ones say nothing."""
        q = self.spread.shape[-1]
        K = intrinsics_from_relative(base + torch.einsum("vmq,bq->bvm", self.spread, x[:, :q]))
        counts = present.clone()
        counts[:, 0] = 0
        return departures(P, K, K[:, 0], x[:, q:]), counts

    def _weigh(self, by_camera: Tensor, covariance: Tensor, counts: Tensor, columns: Tensor) -> Tensor:
        """Columns (b, v, 5, k) times the inverse root of the covariance of the departures, (b, 5 v, k)."""
        b, v = counts.shape
        L, scale, _ = self._root(by_camera * counts[..., None, None], covariance, counts)
        weighed: Tensor = torch.linalg.solve_triangular(L, columns.reshape(*scale.shape, -1) * scale[..., None], upper=False)
        return weighed.reshape(b, 5 * v, -1)

    def _root(self, by_camera: Tensor, covariance: Tensor, counts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """L and s of the covariance `s^-1 L L' s^-1` of the departures, and what was added to its diagonal."""
        b, v = counts.shape
        idle = (1 - counts)[..., None].expand(b, v, 5)
        if self.coupled:
            half = (by_camera @ covariance.reshape(b, v, 12, 12 * v)).reshape(b, 5 * v, v, 12)
            C = torch.einsum("brvi,bvmi->brvm", half, by_camera).reshape(b, 5 * v, 5 * v)
            C = 0.5 * (C + C.mT)
            idle = idle.reshape(b, 5 * v)
        else:
            C = by_camera @ covariance @ by_camera.mT
        diagonal = C.diagonal(dim1=-2, dim2=-1)
        added = idle + 1e-10 * diagonal.sum(-1, keepdim=True) / diagonal.shape[-1] + 1e-200
        C = C + torch.diag_embed(added)
        scale = C.diagonal(dim1=-2, dim2=-1).rsqrt()
        L, info = torch.linalg.cholesky_ex(scale[..., :, None] * C * scale[..., None, :])
        # A covariance that is none makes the residual infinite, and the step is not taken.
        return L, torch.where((info == 0)[..., None], scale, torch.nan), added
