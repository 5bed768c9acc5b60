"""What follows from a refined model being an optimum: how it moves with the data, and its covariance.

The refinement ends at a minimum of the sum of w rho(r^2 / c^2) over the data within the reach c, rho(u) = u - u^2 / 2, whose
weights are 1 - u. Here it is written over a step along the model's manifold, `estimator.retract(model, step)`.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.linalg.portions import portion
from torchsfm.optim import attach_optimum, wants_derivative
from torchsfm.robust.estimator import Estimator
from torchsfm.robust.hypotheses import NUMBERS, squared_residual
from torchsfm.robust.models import tensors_of, zip_map

M = TypeVar("M")


def attach_derivative(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Float[Tensor, "p n _"]],
    weights: Float[Tensor, "p n"],
    selected: Bool[Tensor, "p n"],
    reach: Float[Tensor, "p"],
) -> M:
    """Give refined models their derivatives with respect to data, weights and fields of the estimator.

    Args:
        estimator: The problem, its fields per problem.
        model: The refined model of each problem, detached.
        data: The data, with their graph.
        weights: Factors of the data's losses.
        selected: Which data are within reach; none for a model that is no optimum, which gets zero derivatives.
        reach: The squared distance at which weights vanish.
    """
    fields = tensors_of(estimator)
    if not wants_derivative(*data, weights, *fields):
        return model
    with torch.no_grad():
        tangent = _zero_step(estimator, reach)
    safe = [_others_replaced(d, selected) for d in data]
    k = len(safe)

    def objective(step: Tensor, *inputs: Tensor) -> Tensor:
        parts = iter(inputs[k + 1 :])
        own: Any = tensor_map(lambda _: next(parts), estimator)
        return _losses(own, own.retract(model, step), inputs[:k], inputs[k], selected, reach).sum(-1)

    optimal = selected.any(-1)

    def at_optima(t: Tensor, other: Tensor | float) -> Tensor:
        return torch.where(optimal.reshape(-1, *(1,) * (t.ndim - 1)), t, other)

    step = attach_optimum(objective, tangent, *safe, weights, *fields, valid=optimal)
    own: Any = tensor_map(lambda t: at_optima(t, t.detach()), estimator)
    moved: M = own.retract(model, step)
    # The value stays as it is, bit for bit.
    return zip_map(lambda value, free: value + at_optima(free - free.detach(), 0.0), model, moved)


def step_covariance(
    estimator: Estimator[M],
    model: M,
    data: Sequence[Float[Tensor, "p n _"]],
    weights: Float[Tensor, "p n"],
    selected: Bool[Tensor, "p n"],
    reach: Float[Tensor, "p"],
) -> Float[Tensor, "p k k"]:
    """The covariance of the step from a refined model to the true one.

    That of an M-estimate: H^-1 (sum of g g') H^-1 with the gradients g of the data's losses and the Hessian H (Huber 1981,
    6.3), times n / (n - k). The scatter of the data themselves is the scale of the noise. Zero for models that are no optimum
    or not determined. Arguments as for `attach_derivative`.
    """
    with torch.no_grad():
        tangent = _zero_step(estimator, reach)
        size = tangent.shape[-1]
        safe = [_others_replaced(d, selected) for d in data]

        def losses(step: Tensor) -> Tensor:
            return _losses(estimator, estimator.retract(model, step), safe, weights, selected, reach)  # type: ignore[attr-defined]

        def slope(step: Tensor, counts: Tensor) -> Tensor:
            """The gradient of the sum of the losses, each so many times: linear in that, by a datum's own gradient."""
            gradient: Tensor = torch.func.vjp(losses, step)[1](counts)[0]
            return gradient

        hessian, gradients = derivatives(slope, tangent, torch.ones_like(weights))
        gradients = torch.where(selected[:, None], gradients, 0)
        number = selected.sum(-1).to(reach.dtype)
        scatter = gradients @ gradients.mT * (number / (number - size).clamp(min=1))[:, None, None]
        # Scaled to a unit diagonal, as the unknowns may be of different units.
        scale = hessian.diagonal(dim1=-2, dim2=-1).clamp(min=1e-280).rsqrt()
        scale = scale[..., :, None] * scale[..., None, :]
        inverse, info = torch.linalg.inv_ex(hessian * scale)
        inverse = inverse * scale
        covariance = inverse @ scatter @ inverse.mT
        good = (info == 0) & torch.isfinite(covariance).all(-1).all(-1) & (number > size)
        return torch.where(good[:, None, None], covariance, 0)


def derivatives(function: Callable[..., Tensor], *x: Float[Tensor, "*batch _"]) -> list[Float[Tensor, "*batch m _"]]:
    """The derivatives of a function to `(*batch, m)` by each argument; it treats the elements of a batch one by one."""
    value, pull = torch.func.vjp(function, *x)[:2]
    m = value.shape[-1]
    seeds = torch.eye(m, dtype=value.dtype, device=value.device).view(m, *(1,) * (value.ndim - 1), m).expand(m, *value.shape)
    # All rows together are faster until they leave the cache.
    together = m * sum(t.numel() for t in x) <= portion(NUMBERS, value.device)
    rows = torch.func.vmap(pull)(seeds) if together else map(torch.stack, zip(*map(pull, seeds), strict=True))
    return [row.movedim(0, -2) for row in rows]


def push_forward(function: Callable[[Tensor], Tensor], covariance: Float[Tensor, "*batch k k"]) -> Float[Tensor, "*batch m m"]:
    """The covariance of `function(step)`, `(*batch, k) -> (*batch, m)`, from that of a step around zero, to first order."""
    with torch.no_grad():
        (J,) = derivatives(function, torch.zeros_like(covariance[..., 0]))
        # Where no model was found, what stands in its place may have no derivative; its covariance is zero.
        J = torch.where(torch.isfinite(J), J, 0)
        return J @ covariance @ J.mT


def _zero_step(estimator: Any, reach: Tensor) -> Tensor:
    return torch.zeros(len(reach), estimator.dimension, dtype=reach.dtype, device=reach.device)


def _losses(
    estimator: Estimator[Any], model: Any, data: Sequence[Tensor], weights: Tensor, selected: Tensor, reach: Tensor
) -> Tensor:
    u = torch.where(selected, squared_residual(estimator, model, *data), 0) / reach[..., None]
    return torch.where(selected, weights, 0) * (u - 0.5 * u * u)


def _others_replaced(d: Tensor, selected: Tensor) -> Tensor:
    """Put a selected datum of the same problem, detached, in the place of all that are not selected: nothing infinite."""
    if d.shape[1] == 0:
        return d
    row = d.detach()[torch.arange(len(d), device=d.device), selected.to(torch.int8).argmax(-1)]
    return torch.where(selected[..., None], d, row.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)[:, None])
