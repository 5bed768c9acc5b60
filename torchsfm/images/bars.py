"""Bars beside pictures, as films of another shape than the screen and scans have them: the picture ends where they begin."""

from jaxtyping import Float
from torch import Tensor

_ALIKE = 0.05
"""Largest difference of values of a bar: what compression leaves along its edge."""
_MOST = 0.9
"""Part of a row that must be alike for it to be one of a bar."""
_EDGE = 0.5
"""Part of a row, two behind the last of a bar, that must differ from it: else it is sky, or what a thing stands before."""
_LEAST = 3
"""Rows of a bar."""
_SHARE = 3
"""Pictures are not less than one in so many of the rows between two bars."""


def picture_in_bars(pixels: Float[Tensor, "c h w"]) -> tuple[slice, slice]:
    """The rows and columns of an image without uniform bars at its sides; all where there are none.

    Args:
        pixels: The image.
    """
    gray = pixels.mean(0)
    height, width = gray.shape
    top, bottom = _bar(gray), _bar(gray.flip(0))
    inner = gray[top : height - bottom]
    left, right = _bar(inner.T), _bar(inner.T.flip(0))
    return slice(top, height - bottom), slice(left, width - right)


def _bar(rows: Float[Tensor, "h w"]) -> int:
    """Rows of a bar that begins with the first row."""
    limit = len(rows) // _SHARE
    alike = ((rows[: limit + 2] - rows[0].median()).abs() <= _ALIKE).double().mean(-1)
    count = int((alike >= _MOST).long().cumprod(0).sum())
    if not _LEAST <= count <= limit or count + 1 >= len(alike):
        return 0
    step = (rows[count + 1] - rows[count - 1]).abs() > _ALIKE
    return count if float(step.double().mean()) >= _EDGE else 0
