"""How large noise may be that few residuals show."""

from torch import Tensor

TWENTIETH, QUARTER = 1.645, 0.674
"""Standard deviations that one in twenty exceeds, and one in four."""
_LEAST = 0.0039
"""What nineteen in twenty chi-squares of one degree of freedom exceed."""


def likely_variance(square_sum: Tensor, redundancy: Tensor, beyond: float = TWENTIETH) -> Tensor:
    """The largest variance of noise of which one in twenty sums of squares is so small; infinite where nothing is redundant.

    The mean square is near it where much is redundant. One redundant residual may be small by luck, and then says little.

    Args:
        square_sum: Of the residuals at their minimum.
        redundancy: Their number less that of the unknowns.
        beyond: Standard deviations that the wanted share exceeds, if not one in twenty.
    """
    some = redundancy.to(square_sum.dtype).clamp_min(1)
    # The quantile of chi-square, after Wilson and Hilferty.
    least = some * (1 - 2 / (9 * some) - beyond * (2 / (9 * some)).sqrt()).clamp_min(0) ** 3
    least = least.clamp_min(_LEAST)
    return (square_sum / least).masked_fill(redundancy <= 0, float("inf"))
