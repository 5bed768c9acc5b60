"""One batch of small dense least-squares problems: its cost, and its normal equations by automatic differentiation."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchsfm.optim.loss import Loss, loss_slope
from torchsfm.optim.trees import leaves

Linearize = Callable[..., tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class DenseProblem:
    """What is minimised, and how parameters move."""

    residual: Callable[..., Tensor]
    retract: Callable[[Any, Tensor], Any]
    tangent: int
    loss: Loss | None
    linearize: Linearize | None

    def cost(self, x: Any, data: Any, weights: Tensor | None) -> Tensor:
        """`sum w rho / 2`, (batch)."""
        residual = self.residual(x, *data)
        if weights is not None:
            # Left out means left out: a NaN there must not come through.
            residual = torch.where((weights > 0)[..., None], residual, 0.0)
        square = residual.square().sum(-1).double()
        rho = square if self.loss is None else self.loss(square)
        if weights is not None:
            rho = torch.where(weights > 0, rho * weights, 0.0)
        return rho.sum(-1) / 2

    def hessian(self, x: Any, data: Any, weights: Tensor | None) -> Tensor:
        """The exact second derivatives of the cost along the tangent directions, (batch, size, size); not always positive."""
        first = leaves(x)[0]
        with torch.enable_grad():
            delta = first.new_zeros((first.shape[0], self.tangent)).requires_grad_()
            cost = self.cost(self.retract(x, delta), data, weights)
            (slope,) = torch.autograd.grad(cost.sum(), delta, create_graph=True, materialize_grads=True)
            if not slope.requires_grad:
                return delta.new_zeros((*delta.shape, self.tangent)).double()
            rows = [torch.autograd.grad(s.sum(), delta, retain_graph=True, materialize_grads=True)[0] for s in slope.unbind(-1)]
        return torch.stack(rows, -2).double()

    def size(self, x: Any, data: Any, weights: Tensor | None) -> Tensor:
        """What the cost would be if each residual were as large as the numbers in the data, (batch)."""
        first = leaves(x)[0]
        count = torch.full(first.shape[:1], self.residual(x, *data).shape[-2], dtype=torch.float64, device=first.device)
        numbers = [d[..., None].flatten(1).double() for d in leaves(data) if d.is_floating_point() and d.numel()]
        squares = [torch.where(d.isfinite(), d, 0.0).square().mean(1) for d in numbers]
        return (count if weights is None else weights.double().sum(-1)) * sum(squares, torch.zeros_like(count)) / 2

    def normal_equations(self, x: Any, data: Any, weights: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Cost, gradient and Gauss-Newton matrix, in float64."""
        r, jacobian = self.linearize(x, *data) if self.linearize is not None else self._differentiate(x, data)
        r, jacobian = r.double(), jacobian.double()
        square = r.square().sum(-1)
        scale = torch.ones_like(square) if self.loss is None else loss_slope(self.loss, square)
        rho = square if self.loss is None else self.loss(square)
        if weights is not None:
            counts = weights > 0
            rho = torch.where(counts, rho * weights, 0.0)
            scale = torch.where(counts, scale * weights, 0.0)
            r = torch.where(counts[..., None], r, 0.0)
            jacobian = torch.where(counts[..., None, None], jacobian, 0.0)
        flat = jacobian.flatten(1, 2)
        weighted = (scale[..., None, None] * jacobian).flatten(1, 2)
        gradient = (weighted * r.flatten(1)[..., None]).sum(1)
        return rho.sum(-1) / 2, gradient, weighted.mT @ flat

    def _differentiate(self, x: Any, data: Any) -> tuple[Tensor, Tensor]:
        """Residual and Jacobian, column by column.

        The pullback is linear in what it pulls back, so its own pullbacks are the columns of the Jacobian. Forward mode would
        do the same, but loading it takes PyTorch seconds.
        """
        first = leaves(x)[0]
        with torch.enable_grad():
            delta = first.new_zeros((first.shape[0], self.tangent)).requires_grad_()
            value = self.residual(self.retract(x, delta), *data)
            seed = torch.zeros_like(value).requires_grad_()
            (pulled,) = torch.autograd.grad(value, delta, seed, create_graph=True, materialize_grads=True)
            ones = torch.ones_like(pulled[:, 0])
            columns = [
                torch.autograd.grad(pulled[:, i], seed, ones, retain_graph=True, materialize_grads=True)[0]
                for i in range(self.tangent)
            ]
        return value.detach(), torch.stack(columns, -1)

    def too_few(self, x: Any, data: Any, weights: Tensor | None) -> Tensor:
        """Where there are fewer residuals than parameters."""
        count, components = self.residual(x, *data).shape[-2:]
        first = leaves(x)[0]
        if weights is None:
            return torch.full(first.shape[:1], count * components < self.tangent, device=first.device)
        return (weights > 0).sum(-1) * components < self.tangent
