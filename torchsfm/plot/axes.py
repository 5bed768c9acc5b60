"""Where figures are drawn: axes given by the caller, or new ones from matplotlib's pyplot."""

from typing import Any, TypeAlias

from numpy.typing import NDArray
from torch import Tensor

Axes: TypeAlias = Any
"""A `matplotlib.axes.Axes`; matplotlib itself is imported when a figure is drawn, not before."""
Figure: TypeAlias = Any
"""A `matplotlib.figure.Figure`."""


def pyplot() -> Any:
    """matplotlib.pyplot, imported now.

    Raises:
        ImportError: matplotlib is not installed.
    """
    try:
        import matplotlib.pyplot
    except ImportError as error:
        raise ImportError("figures need matplotlib; install it with: pip install 'torchsfm[plot]'") from error
    return matplotlib.pyplot


def flat_axes(ax: Axes | None, size: tuple[float, float] | None = None) -> Axes:
    """The given axes, or those of a new figure of a size in inches."""
    return pyplot().subplots(layout="constrained", figsize=size)[1] if ax is None else ax


def spatial_axes(ax: Axes | None) -> Axes:
    """The given 3D axes, or those of a new figure."""
    if ax is None:
        return pyplot().figure(layout="constrained", figsize=(8, 7)).add_subplot(projection="3d")
    if getattr(ax, "name", "") != "3d":
        raise ValueError("ax: wanted 3D axes, made with projection='3d'")
    return ax


def array(tensor: Tensor) -> NDArray[Any]:
    """The values of a tensor for matplotlib."""
    values: NDArray[Any] = tensor.detach().cpu().numpy()
    return values
