"""The least squares over the views that agree with it.

The least squares over all inliers of a search may be farther than the threshold from some of them. These are left out, and the
rest is solved again, until all that is used agrees.
"""

from collections.abc import Callable
from typing import Any, TypeVar

from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import tensor_map
from torchsfm.optim.pytree import put

R = TypeVar("R")


def solve_agreed(
    solve: Callable[[Tensor, Tensor, Tensor, Tensor | None], R],
    distances: Callable[[R, Tensor, Tensor], Float[Tensor, "*batch v n"]],
    x: Float[Tensor, "..."],
    trailing: int,
    P: Float[Tensor, "*#batch v 3 4"],
    inliers: Bool[Tensor, "*batch v n"],
    weights: Float[Tensor, "*#batch v n"] | None,
    limit: Float[Tensor, "*batch n"],
) -> tuple[R, Bool[Tensor, "*batch v n"]]:
    """Solve for n objects seen in v views, each by views of which none is farther away from the answer than a limit.

    Args:
        solve: Of observations, cameras, which of these to use, and weights: the answer, whose fields are `(*batch, n, ...)`.
        distances: Of an answer, observations and cameras; not a number where the answer is none.
        x: Observations, `(*batch, v, n, ...)`,
        trailing: with so many dimensions after that.
        P: Cameras.
        inliers: Views to begin with.
        weights: Of the observations.
        limit: The largest distance.

    Returns:
        The answers, and the views they are made of.
    """
    result = solve(x, P, inliers, weights)
    far = inliers & (distances(result, x, P) > limit[..., None, :])
    if not bool(far.any()):
        return result, inliers
    batch, (v, n) = inliers.shape[:-2], inliers.shape[-2:]
    problems = len(batch)

    def by_object(t: Tensor, dims: int) -> Tensor:
        """From (*batch, v, n, ...) to (object, v, 1, ...)."""
        t = t.expand(*batch, *t.shape[t.ndim - dims :])
        return t.movedim(problems + 1, problems).reshape(-1, v, 1, *t.shape[problems + 2 :])

    own, used, off = by_object(x, 2 + trailing), by_object(inliers, 2), by_object(far, 2)
    factors = None if weights is None else by_object(weights, 2)
    cameras = P.expand(*batch, v, 3, 4).reshape(-1, v, 3, 4)
    most = limit.reshape(-1, 1, 1)
    flat: Any = tensor_map(lambda t: t.reshape(-1, *t.shape[problems + 1 :]), result)
    (rows,) = off.flatten(1).any(-1).nonzero(as_tuple=True)
    while len(rows):
        kept = used[rows] & ~off[rows]
        data, views = own[rows], cameras[rows // n]
        again = solve(data, views, kept, None if factors is None else factors[rows])
        flat = put((rows,), flat, tensor_map(lambda t: t[:, 0], again))
        beyond = kept & (distances(again, data, views) > most[rows])
        used, off = used.index_copy(0, rows, kept), off.index_copy(0, rows, beyond)
        rows = rows[beyond.flatten(1).any(-1)]
    used = used.reshape(*batch, n, v).mT
    return tensor_map(lambda t: t.reshape(*batch, n, *t.shape[1:]), flat), used
