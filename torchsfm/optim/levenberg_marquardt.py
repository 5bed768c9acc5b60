"""Levenberg-Marquardt for thousands of small dense least-squares problems at once.

Minimises `sum_i w_i rho(|r_i(x)|^2) / 2` over `x` for every element of a batch. Each problem has its own damping, its own
accepted and rejected steps and its own end (`descent`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_options, check_tensors, tensor_map
from torchsfm.optim.dense import DenseProblem, Linearize, dense_problem
from torchsfm.optim.descent import MINIMUM, Options, descend
from torchsfm.optim.implicit import attach_optimum, wants_derivative
from torchsfm.optim.loss import Loss
from torchsfm.optim.pytree import cut, flatten, join, leaves

M = TypeVar("M")
PIECE = 600_000
"""Numbers in the Jacobians of the problems minimised together: more do not stay in the cache."""


@dataclass(frozen=True)
class LeastSquaresResult(Generic[M]):
    """The minima of a batch of least-squares problems.

    `x` is what the parameters came as. `cost` and `initial_cost` are `sum w rho / 2`; `iterations` counts linear solves.
    `status` is `Status.OK` where a tolerance was met, `NOT_CONVERGED` where the iteration limit came first or no step lowers
    the cost though more is promised. It is `TOO_FEW` where there are fewer residuals than parameters and `NOT_FINITE` where the
    cost or its slope at the start is not finite: there `x` is the start, and a cost that is not a number is inf.

    Example:
        >>> import torch, torchsfm
        >>> t = torch.linspace(0, 1, 20, dtype=torch.float64)
        >>> rate = torch.tensor([[1.0], [2.0], [torch.nan]], dtype=t.dtype)  # three problems, and the last has no data
        >>> def residual(x, y):
        ...     return (torch.exp(-x * t) - y)[..., None]
        ...
        >>> found = torchsfm.optim.levenberg_marquardt(residual, torch.zeros_like(rate), torch.exp(-rate * t))
        >>> found.x[:2, 0], [torchsfm.Status(k).name for k in found.status.tolist()]
        (tensor([1., 2.], dtype=torch.float64), ['OK', 'OK', 'NOT_FINITE'])
        >>> bool((found.cost[:2] < 1e-9 * found.initial_cost[:2]).all())
        True
    """

    x: M
    cost: Float[Tensor, "*batch"]
    initial_cost: Float[Tensor, "*batch"]
    iterations: Int[Tensor, "*batch"]
    status: Int[Tensor, "*batch"]


def levenberg_marquardt(
    residual: Callable[..., Tensor],
    x0: M,
    *data: Any,
    retract: Callable[[M, Tensor], M] | None = None,
    size: int | None = None,
    weights: Float[Tensor, "*#batch n"] | Bool[Tensor, "*#batch n"] | None = None,
    loss: Loss | None = None,
    linearize: Linearize | None = None,
    local_cost: Callable[..., Tensor] | None = None,
    max_iterations: int = 50,
    function_tolerance: float = 1e-10,
    step_tolerance: float = 1e-10,
    initial_damping: float = 1e-4,
) -> LeastSquaresResult[M]:
    """Minimise many small nonlinear least-squares problems, all in one batch.

    The Jacobian comes from automatic differentiation of `residual` along the tangent directions, or from `linearize`. Where
    Gauss-Newton steps become slow, as with robust losses and large residuals, Newton steps with the exact Hessian (automatic
    differentiation of the cost) take over wherever it is positive definite, problem by problem.

    Where `data` or `weights` require a gradient the minimum carries its derivative with respect to them, by the implicit
    function theorem with the exact Hessian; otherwise nothing is spent on it. It is that of a minimum, so each problem is then
    solved until hardly 1e-13 of its cost is left to gain, whatever `function_tolerance` says; where the status is not OK the
    minimum was not reached, and the derivative is zero.

    Args:
        residual: `residual(x, *data) -> (*batch, n, d)`: n residuals of d components each, for any number of batch dimensions
            in front of everything; each problem must depend on its own element alone.
        x0: The start, a tensor `(*batch, k)` or nested dataclasses of tensors that all have the batch dimensions in front.
        *data: Tensors, or dataclasses of tensors, with the batch dimensions in front, of size 1 where shared. Anything else
            is handed through.
        retract: `retract(x, delta) -> x` moves `x` by tangent steps `(b, size)`; addition if not given.
        size: Number of tangent directions; the last dimension of `x0` if not given.
        weights: Weight of each of the n residuals' squared norms; 0 or False leaves it out, whatever number it has, NaN too.
        loss: `rho(s)` of squared norms, see `torchsfm.optim.loss`; `s` if not given.
        linearize: `linearize(x, *data) -> (residual (b, n, d), jacobian (b, n, d, size))`, where a hand-written one pays.
        local_cost: `local_cost(x, *data) -> (b,)`, without `weights` and `loss`: what has the first and second derivatives at
            x of half the sum of squares, for the exact Hessian, where they take less. It may hold fixed at `x.detach()` what
            does not change them.
        max_iterations: Most linear solves per problem.
        function_tolerance: A problem is done when no more than this fraction of its cost is left to gain, by the promise of a
            step or by how fast gains fall; or no more than rounding of parameters and data makes of it.
        step_tolerance: A problem is done when the step is shorter than this fraction of `|x|` and promises next to nothing.
        initial_damping: Damping relative to the diagonal of the normal equations, at the start.

    Returns:
        The minima, costs, iterations and a status per element.

    Raises:
        ValueError: `residual` does not return `(*batch, n, d)`, or `size` is missing for parameters that are not one tensor.

    Example:
        >>> import torch, torchsfm
        >>> t = torch.linspace(0, 1, 20, dtype=torch.float64)
        >>> rate = torch.tensor([[1.0], [2.0]], dtype=t.dtype)  # two problems: y = exp(-rate t)
        >>> def residual(x, y):
        ...     return (torch.exp(-x * t) - y)[..., None]
        >>> found = torchsfm.optim.levenberg_marquardt(residual, torch.zeros_like(rate), torch.exp(-rate * t))
        >>> found.x, bool((found.status == torchsfm.Status.OK).all())
        (tensor([[1.0000],
                [2.0000]], dtype=torch.float64), True)
    """
    check_options(
        max_iterations=(max_iterations, "int >= 0"), function_tolerance=(function_tolerance, "float >= 0"),
        step_tolerance=(step_tolerance, "float >= 0"), initial_damping=(initial_damping, "float >= 0"),
        size=(size, "?int >= 1"), residual=(residual, Callable), retract=(retract, Callable | None),
        loss=(loss, Callable | None), linearize=(linearize, Callable | None), weights=(weights, Tensor | None),
        local_cost=(local_cost, Callable | None),
    )  # fmt: skip
    if local_cost is not None and (weights is not None or loss is not None):
        raise ValueError("local_cost: wanted without weights and loss")
    move = retract if retract is not None else _add
    if size is None:
        if not isinstance(x0, Tensor):
            raise ValueError("size: wanted the number of tangent directions, since x0 is not one tensor")
        check_tensors(x0=(x0, "k>=1"))
        size = x0.shape[-1]
    device = leaves(x0)[0].device
    if weights is not None and weights.device != device:
        raise ValueError(f"weights: wanted device {device} as x0 has, got {weights.device}")
    if weights is not None and weights.dtype not in (torch.float32, torch.float64, torch.bool):
        raise ValueError(f"weights: wanted a float32, float64 or bool tensor, got {weights.dtype}")
    followed = leaves((data, weights))
    wanted = wants_derivative(*followed)
    if wanted:
        function_tolerance = min(function_tolerance, MINIMUM)
    options = Options(max_iterations, function_tolerance, step_tolerance, initial_damping=initial_damping)
    with torch.no_grad():
        shape = _residual_shape(residual, x0, data)
        batch = shape[:-2]
        if weights is not None and (weights.ndim != len(batch) + 1 or weights.shape[-1:] != shape[-2:-1]):
            raise ValueError(f"weights: wanted shape (*batch, {shape[-2]}) of the residuals, got {tuple(weights.shape)}")
        start = flatten(tensor_map(torch.Tensor.detach, x0), batch)
        flat_data = flatten(tensor_map(torch.Tensor.detach, data), batch, "data")
        flat_weights = None if weights is None else flatten(weights.detach(), batch, "weights")
        problem = dense_problem(residual, move, size, loss, linearize, start, flat_data, flat_weights, shape[-2:], local_cost)
        step = max(1, PIECE // max(1, shape[-2] * shape[-1] * size))
        pieces = range(0, max(batch.numel(), 1), step)
        parts = [(problem.over(partial(cut, start=i, end=i + step)), cut(start, i, i + step)) for i in pieces]
        found = join([descend(part, x, options, enough=part.enough) for part, x in parts])
    x = found.x
    if wanted:
        x = _attach(problem, x, flatten(data, batch), None if weights is None else flatten(weights, batch), found.status)
    costs = (cost.nan_to_num(nan=torch.inf) for cost in (found.cost, found.initial_cost))
    return LeastSquaresResult(
        tensor_map(lambda v: v.reshape(batch + v.shape[1:]), x),
        *(v.reshape(batch) for v in (*costs, found.iterations, found.status)),
    )


def _attach(problem: DenseProblem, x: Any, data: Any, weights: Tensor | None, status: Tensor) -> Any:
    """The minimum with its derivatives with respect to all tensors in data and weights."""
    followed = leaves((data, weights))
    first = leaves(x)[0]
    zero = first.new_zeros((first.shape[0], problem.tangent))

    def objective(delta: Tensor, *tensors: Tensor) -> Tensor:
        replaced = iter(tensors)
        new_data, new_weights = tensor_map(lambda _: next(replaced), (data, weights))
        return replace(problem, data=new_data, weights=new_weights).cost(problem.retract(x, delta))

    delta = attach_optimum(objective, zero, *followed, valid=status == Status.OK)
    moved = iter(leaves(problem.retract(x, delta)))
    # The value stays what it was, bit for bit.
    return tensor_map(lambda v: v + (m := next(moved)) - m.detach(), x)


def _residual_shape(residual: Callable[..., Tensor], x0: Any, data: Any) -> torch.Size:
    """The shape (*batch, n, d) of the residuals."""
    places = {t.device for t in leaves((x0, data))}
    if len(places) > 1:
        raise ValueError(f"x0: wanted on the device of the data, got {', '.join(sorted(map(str, places)))}")
    first = leaves(x0)[0].shape
    if first[:1] == (0,) and any(t.shape[:1] > (1,) for t in leaves(data)):
        raise ValueError(f"x0: wanted parameters for each problem of the data, got shape {tuple(first)}")
    shape = residual(x0, *data).shape
    batch = shape[:-2]
    if len(shape) < 2 or first[: len(batch)] != batch or (isinstance(x0, Tensor) and len(first) != len(batch) + 1):
        raise ValueError(f"residual: wanted (*batch, n, d), the batch in front of x0 {tuple(first)}, got {tuple(shape)}")
    return shape


def _add(x: Any, delta: Tensor) -> Any:
    return x + delta
