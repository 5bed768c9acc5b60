"""Derivatives of solutions by the implicit function theorem, without differentiating the solver.

A solver finds `y` with `g(y, inputs) = 0`. Whatever way it went, near the solution `dy = -(dg/dy)^-1 dg/dinputs`. The functions
here attach exactly this derivative to a detached solution and leave its value as it is, bit for bit. They work with reverse and
forward mode and inside `torch.func` transforms. First derivatives only: a second derivative through them is not meaningful.
"""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd import forward_ad

from torchsfm._types import check_options
from torchsfm.linalg import qr


def wants_derivative(*inputs: Tensor) -> bool:
    """Whether any of the tensors is followed by reverse- or forward-mode differentiation right now.

    Args:
        *inputs: Tensors, any number of them.

    Example:
        >>> import torch, torchsfm
        >>> x, y = torch.zeros(2), torch.zeros(2, requires_grad=True)
        >>> torchsfm.optim.wants_derivative(x), torchsfm.optim.wants_derivative(x, y)
        (False, True)
    """
    if torch.is_grad_enabled() and any(x.requires_grad for x in inputs):
        return True
    return any(forward_ad.unpack_dual(x).tangent is not None for x in inputs)  # type: ignore[no-untyped-call]


def for_slots(x: Float[Tensor, "..."], batch: tuple[int, ...], dims: int = 2) -> Float[Tensor, "..."]:
    """What a solver was given, as each of its solutions sees it: `(*batch, 1, ...)`, whatever batch dimensions it came with.

    Args:
        x: An argument of the solver; its last `dims` dimensions belong to one problem.
        batch: The batch dimensions of all arguments together.
        dims: See `x`.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.optim.for_slots(torch.zeros(7, 2), (5,)).shape  # seven points, the same for five problems
        torch.Size([5, 1, 7, 2])
    """
    return x.expand(*batch, *x.shape[x.ndim - dims :]).unsqueeze(len(batch))


def attach_implicit(
    equations: Callable[..., Tensor],
    y: Float[Tensor, "..."],
    *inputs: Tensor,
    dims: int = 1,
    valid: Bool[Tensor, "*batch"] | None = None,
) -> Float[Tensor, "..."]:
    """Give a solution `y` of `equations(y, *inputs) = 0` its derivatives with respect to the inputs.

    There must be at least as many equations as unknowns, and their Jacobian with respect to `y` must have full column rank at
    the solution: fix scale and gauge by equations (`|F|^2 - 1`), and let redundant equations stand (they are met in the sense
    of least squares). Where the Jacobian is singular or not finite, or `valid` is False, the derivative is exactly zero.

    Without an input that is being differentiated, `y` is returned as it came, and nothing is computed.

    Args:
        equations: A function of `(y, *inputs)` returning `(*batch, m)`, each element depending on its own element of the batch
            alone. It is called with inputs as they are given here.
        y: The solution, `(*batch, ...)` with `dims` trailing dimensions that make up one solution. Its graph, if any, is
            dropped.
        *inputs: What the solution depends on. Each carries the batch dimensions of `y` in front, of size 1 where shared
            (`for_slots` for several solution slots).
        dims: How many trailing dimensions of `y` belong to one solution.
        valid: Which elements of the batch are solutions at all.

    Returns:
        `y`, unchanged in value, with derivatives attached.

    Example:
        >>> import torch, torchsfm
        >>> a = torch.tensor([4.0, 9.0], requires_grad=True)
        >>> y = a.detach().sqrt()[:, None]  # found somehow: solves y^2 = a
        >>> y = torchsfm.optim.attach_implicit(lambda y, a: y**2 - a[:, None], y, a)
        >>> y.sum().backward()
        >>> a.grad  # 1 / (2 y)
        tensor([0.2500, 0.1667])
    """
    check_options(y=(y, Tensor), **{f"inputs[{i}]": (x, Tensor) for i, x in enumerate(inputs)})
    y = y.detach()
    if not wants_derivative(*inputs):
        return y
    batch = y.shape[: y.ndim - dims]
    detached = [x.detach() for x in inputs]
    jacobian = _jacobian(lambda z: equations(z, *detached), y, dims).double()
    pinv, regular = _pseudo_inverse(jacobian)
    if valid is not None:
        regular = regular & valid
    # `where` passes exact zeros back, also where the gradient behind it is NaN.
    guarded = [torch.where(_align(regular, x, len(batch)), x, x.detach()) for x in inputs]
    g = equations(y, *guarded).double()
    step = (pinv @ (g - g.detach()).unsqueeze(-1)).squeeze(-1).to(y.dtype).reshape(y.shape)
    # Not finite where the equations are not: keep the value there.
    return y - torch.where(_align(regular, y, len(batch)), step, torch.zeros_like(step))


def attach_optimum(
    objective: Callable[..., Tensor],
    y: Float[Tensor, "..."],
    *inputs: Tensor,
    dims: int = 1,
    valid: Bool[Tensor, "*batch"] | None = None,
) -> Float[Tensor, "..."]:
    """Give a stationary point `y` of `objective(y, *inputs)` its derivatives with respect to the inputs.

    The equations are the vanishing of the gradient with respect to `y`, their Jacobian is the exact Hessian. A direction in
    which the objective is flat (gauge, scale) makes it singular and the derivative zero: write the objective over a minimal
    parameterisation, or add a term that fixes the gauge.

    Args:
        objective: A twice differentiable function of `(y, *inputs)` returning `(*batch)`, each element depending on its own
            element of the batch alone.
        y: The stationary point, `(*batch, ...)` with `dims` trailing dimensions that make up one point.
        *inputs: What the optimum depends on, with the batch dimensions of `y` in front, of size 1 where shared.
        dims: How many trailing dimensions of `y` belong to one point.
        valid: Which elements are optima at all; the others get zero derivatives.

    Returns:
        `y`, unchanged in value, with derivatives attached.

    Example:
        >>> import torch, torchsfm
        >>> a = torch.tensor([1.0, 2.0], requires_grad=True)
        >>> y = 3 * a.detach()[:, None]  # found somehow: makes (y - 3 a)^2 smallest
        >>> y = torchsfm.optim.attach_optimum(lambda y, a: (y[:, 0] - 3 * a) ** 2, y, a)
        >>> y.sum().backward()
        >>> a.grad
        tensor([3., 3.])
    """

    def gradient(z: Tensor, *arguments: Tensor) -> Tensor:
        slope = _gradient(lambda v: objective(v, *arguments).sum(), z)
        return slope.reshape(*z.shape[: z.ndim - dims], -1)

    return attach_implicit(gradient, y, *inputs, dims=dims, valid=valid)


def _transformed() -> bool:
    """Whether `torch.func` is at work. Only then are its own functions used: their first call imports dynamo, for a second.

    It forbids to say of a tensor that it wants a gradient.
    """
    try:
        torch.empty(0).requires_grad_()
    except RuntimeError:
        return True
    return False


def _gradient(function: Callable[[Tensor], Tensor], y: Tensor) -> Tensor:
    """The gradient of a scalar function, itself differentiable in whatever else the function depends on."""
    if _transformed():
        return torch.func.grad(function)(y)  # type: ignore[no-any-return]
    with torch.enable_grad():
        z = y if y.requires_grad else y.detach().requires_grad_()
        return torch.autograd.grad(function(z), z, create_graph=True)[0]


def _jacobian(function: Callable[[Tensor], Tensor], y: Tensor, dims: int) -> Tensor:
    """The Jacobian `(*batch, m, k)` of a function that treats the elements of the batch one by one."""
    if _transformed():
        value, pull = torch.func.vjp(function, y)[:2]
    else:
        with torch.enable_grad():
            z = y.detach().requires_grad_()
            value = function(z)

        def pull(seed: Tensor) -> tuple[Tensor, ...]:
            return torch.autograd.grad(value, z, seed, retain_graph=True, materialize_grads=True)

    rows = []
    for i in range(value.shape[-1]):
        seed = torch.zeros_like(value)
        seed[..., i] = 1
        rows.append(pull(seed)[0].flatten(y.ndim - dims))
    return torch.stack(rows, -2).detach()


def _pseudo_inverse(jacobian: Tensor) -> tuple[Tensor, Tensor]:
    """`(J'J)^-1 J'` by QR, and where J has full column rank; zeros elsewhere."""
    rows, columns = jacobian.shape[-2:]
    finite = jacobian.isfinite().all(-1).all(-1)
    eye = torch.eye(rows, columns, dtype=jacobian.dtype, device=jacobian.device)
    safe = torch.where(finite[..., None, None], jacobian, eye)
    # Equations and unknowns come in any unit: scale both before judging the rank.
    tiny = torch.finfo(jacobian.dtype).tiny
    row_scale = safe.abs().amax(-1, keepdim=True).clamp_min(tiny)
    scaled = safe / row_scale if rows == columns else safe
    column_scale = torch.linalg.vector_norm(scaled, dim=-2, keepdim=True).clamp_min(tiny)
    q, r, _ = qr(scaled / column_scale)
    pivots = r.diagonal(dim1=-2, dim2=-1).abs()
    floor = 64 * columns * torch.finfo(jacobian.dtype).eps
    regular = finite & (pivots.amin(-1) > floor)
    r = torch.where(regular[..., None, None], r, eye[:columns])
    pinv = torch.linalg.solve_triangular(r, q.mT, upper=True) / column_scale.mT
    if rows == columns:
        pinv = pinv / row_scale.mT
    return torch.where(regular[..., None, None], pinv, torch.zeros_like(pinv)), regular


def _align(mask: Tensor, x: Tensor, batch_dims: int) -> Tensor:
    return mask.reshape(mask.shape + (1,) * (x.ndim - batch_dims))
