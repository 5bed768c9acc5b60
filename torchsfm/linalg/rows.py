"""Sums over rows in a fixed order, for arithmetic that keeps the batch in the last dimension.

`Tensor.sum` chooses its order by the shape, so that an element's result would depend on how large its batch is.
"""

from collections.abc import Sequence

from torch import Tensor


def take_columns(rows: Tensor, column: Tensor) -> Tensor:
    """Columns by their numbers, in the last dimension; `gather` does it several times faster than `index_select`."""
    flat = rows.flatten(0, -2)
    return flat.gather(1, column.expand(len(flat), -1)).view(*rows.shape[:-1], len(column))


def add_rows(rows: Tensor | Sequence[Tensor]) -> Tensor:
    """The sum over the first dimension, from the first row to the last."""
    first, second, *rest = rows if isinstance(rows, Sequence) else rows.unbind(0)
    total = first + second
    for row in rest:
        total += row
    return total


def inner(a: Tensor, b: Tensor) -> Tensor:
    """`a'b` of vectors of few numbers in the last dimension; `sum` takes several times as long over so few."""
    return combine_rows(a.unbind(-1), b.unbind(-1))


def combine_rows(rows: Tensor | Sequence[Tensor], weights: Tensor | Sequence[Tensor]) -> Tensor:
    """The sum over the first dimension of rows times weights, from the first row to the last, without keeping the products."""
    rows = rows if isinstance(rows, Sequence) else rows.unbind(0)
    weights = weights if isinstance(weights, Sequence) else weights.unbind(0)
    total = rows[0] * weights[0]
    for row, weight in zip(rows[1:], weights[1:], strict=True):
        total.addcmul_(row, weight)
    return total
