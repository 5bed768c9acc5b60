"""Robust losses: functions of a squared residual, in units of the measurement.

A loss maps the squared norm `s` of one residual to `rho(s)`, with `rho(s) ~ s` for small residuals; a problem's cost is
`sum rho(s) / 2`. Any callable on tensors that is monotone and differentiable serves; the dataclasses here are the usual ones,
with `scale` the residual (not squared) at which outliers start. All values are finite for every finite `s`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

Loss = Callable[[Tensor], Tensor]
"""What engines accept: `rho(s)`, elementwise. A method `slope(s)` giving `rho'(s)` is used where there is one."""


@dataclass(frozen=True)
class Huber:
    """`s` inside, `2 scale sqrt(s) - scale^2` outside (Huber 1964): convex, outliers pull with constant force.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.Huber(2.0)(torch.tensor([1.0, 4.0, 100.0]))  # of squared residuals
        tensor([ 1.,  4., 36.])
    """

    scale: float = 1.0

    def __call__(self, s: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """The loss of squared residuals."""
        k2 = self.scale**2
        return torch.where(s <= k2, s, 2 * self.scale * s.clamp_min(k2).sqrt() - k2)

    def slope(self, s: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """The derivative with respect to the squared residual."""
        return self.scale * s.clamp_min(self.scale**2).rsqrt()


@dataclass(frozen=True)
class SoftL1:
    """`2 scale^2 (sqrt(1 + s / scale^2) - 1)`: a smooth Huber (Charbonnier).

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.SoftL1(2.0)(torch.tensor([0.0, 12.0, 60.0]))  # of squared residuals
        tensor([ 0.,  8., 24.])
    """

    scale: float = 1.0

    def __call__(self, s: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """The loss of squared residuals."""
        # s / (sqrt(1 + u) + 1) keeps small residuals exact.
        return 2 * s / ((1 + s / self.scale**2).sqrt() + 1)

    def slope(self, s: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """The derivative with respect to the squared residual."""
        return (1 + s / self.scale**2).rsqrt()


@dataclass(frozen=True)
class Cauchy:
    """`scale^2 log(1 + s / scale^2)`: outliers lose their pull as 1 / residual.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.Cauchy(2.0)(torch.tensor([0.0, 4.0, 1e4]))  # of squared residuals
        tensor([ 0.0000,  2.7726, 31.2976])
    """

    scale: float = 1.0

    def __call__(self, s: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """The loss of squared residuals."""
        return self.scale**2 * torch.log1p(s / self.scale**2)

    def slope(self, s: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """The derivative with respect to the squared residual."""
        return 1 / (1 + s / self.scale**2)


@dataclass(frozen=True)
class GemanMcClure:
    """`s / (1 + s / scale^2)`, bounded by `scale^2` (Geman & McClure 1987).

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.GemanMcClure(2.0)(torch.tensor([0.0, 4.0, 1e4]))  # of squared residuals: never more than 4
        tensor([0.0000, 2.0000, 3.9984])
    """

    scale: float = 1.0

    def __call__(self, s: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """The loss of squared residuals."""
        return s / (1 + s / self.scale**2)

    def slope(self, s: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """The derivative with respect to the squared residual."""
        return (1 + s / self.scale**2) ** -2


@dataclass(frozen=True)
class Tukey:
    """The biweight (Beaton & Tukey 1974): constant `scale^2 / 3` beyond `scale`, where residuals have no pull at all.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.Tukey(3.0)(torch.tensor([0.0, 9.0, 100.0]))  # of squared residuals: never more than 3
        tensor([0., 3., 3.])
    """

    scale: float = 1.0

    def __call__(self, s: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """The loss of squared residuals."""
        u = (s / self.scale**2).clamp_max(1)
        return self.scale**2 * u * (1 - u + u * u / 3)

    def slope(self, s: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """The derivative with respect to the squared residual."""
        return (1 - s / self.scale**2).clamp_min(0) ** 2


@dataclass(frozen=True)
class Truncated:
    """`min(s, scale^2)`: least squares over the inliers of the moment (MSAC's score).

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.Truncated(2.0)(torch.tensor([1.0, 4.0, 100.0]))  # of squared residuals
        tensor([1., 4., 4.])
    """

    scale: float = 1.0

    def __call__(self, s: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """The loss of squared residuals."""
        return s.clamp_max(self.scale**2)

    def slope(self, s: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """The derivative with respect to the squared residual."""
        return (s <= self.scale**2).to(s.dtype)


def loss_slope(loss: Loss, s: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """`rho'(s)`, by the loss's own `slope` or by automatic differentiation; negative and non-finite slopes become 0.

    Args:
        loss: The loss `rho(s)`.
        s: Squared residuals, in the loss's unit squared.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.optim.loss_slope(torch.sqrt, torch.tensor([1.0, 4.0]))  # any function of squared residuals
        tensor([0.5000, 0.2500])
    """
    own = getattr(loss, "slope", None)
    if own is not None:
        slope: Tensor = own(s)
    else:
        with torch.enable_grad():
            variable = s.detach().requires_grad_()
            (slope,) = torch.autograd.grad(loss(variable).sum(), variable)
    return torch.nan_to_num(slope, nan=0.0, posinf=0.0, neginf=0.0).clamp_min_(0)
