"""Figures in the image: pictures, points, matches between two images, epipolar lines."""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.images import Photograph, scale_image
from torchsfm.images.reading import pixels_of
from torchsfm.plot.axes import Axes, array, flat_axes, pyplot
from torchsfm.tensors.bifocal import epipolar_lines


def show_image(image: Photograph | Float[Tensor, "*channels h w"], *, title: str | None = None, ax: Axes | None = None) -> Axes:
    """Show an image as it is: 0 is black, 1 is white, and the centre of the top-left pixel is at (0, 0).

    Args:
        image: Grey (h, w) or (1, h, w), or red, green, blue (3, h, w), or a photograph. Values are clamped to [0, 1].
        title: Written above.
        ax: Where to draw; a new figure where not given.

    Returns:
        The axes.

    Raises:
        ValueError: The shape is none of these.
        ImportError: matplotlib is not installed.

    Example:
        >>> import torch, torchsfm
        >>> ax = torchsfm.show_image(torch.rand(3, 48, 64), title="noise")
    """
    image = pixels_of(image)
    check_tensors(image=(image, "h w"))
    if image.ndim > 3 or (image.ndim == 3 and image.shape[0] not in (1, 3)):
        raise ValueError(f"image: wanted shape (h, w), (1, h, w) or (3, h, w), got {tuple(image.shape)}")
    ax = flat_axes(ax)
    pixels = image.detach().nan_to_num().clamp(0, 1)
    if image.ndim == 3:
        pixels = pixels.permute(1, 2, 0) if image.shape[0] == 3 else pixels[0]
    ax.imshow(array(pixels), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    if title is not None:
        ax.set_title(title)
    return ax


def show_scaled(
    image: Float[Tensor, "h w"],
    *,
    low: float | None = None,
    high: float | None = None,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Show any matrix as a grey image, its smallest value black and its largest white.

    Args:
        image: Values of any size; those that are not finite count as 0.
        low: The value shown black; the smallest where not given.
        high: The value shown white; the largest where not given.
        title: Written above; without it the range of values is.
        ax: Where to draw; a new figure where not given.

    Returns:
        The axes.

    Raises:
        ValueError: The shape is wrong.
        ImportError: matplotlib is not installed.

    Example:
        >>> import torch, torchsfm
        >>> ax = torchsfm.plot.show_scaled(torch.randn(48, 64))
    """
    check_tensors(image=(image, "h>=1 w>=1"))
    if image.ndim != 2:
        raise ValueError(f"image: wanted shape (h, w), got {tuple(image.shape)}")
    values = torch.where(torch.isfinite(image), image, 0.0).detach()
    if title is None:
        bottom = float(values.min()) if low is None else low
        top = float(values.max()) if high is None else high
        title = f"{bottom:.4g} ... {top:.4g}"
    return show_image(scale_image(values, low=low, high=high), title=title, ax=ax)


def plot_points_2d(
    x: Float[Tensor, "*batch n 2"], *, visible: Bool[Tensor, "*batch n"] | None = None, ax: Axes | None = None, **style: Any
) -> Axes:
    """Mark image points, one colour for each batch element, the y axis pointing down.

    Args:
        x: Points in pixels. Those that are not finite are left out.
        visible: Which of them to draw; all where not given.
        ax: Where to draw, for example over `show_image`; a new figure where not given.
        **style: Passed on to matplotlib's `plot`.

    Returns:
        The axes.

    Raises:
        ValueError: A shape is wrong.
        ImportError: matplotlib is not installed.

    Example:
        >>> import torch, torchsfm
        >>> ax = torchsfm.show_image(torch.rand(3, 48, 64))
        >>> ax = torchsfm.plot.plot_points_2d(torch.tensor([[10.0, 20.0], [30.0, 40.0]]), ax=ax)
    """
    check_tensors(x=(x, "n 2"), visible=(visible, "?n: bool"))
    fresh = ax is None
    ax = flat_axes(ax)
    shown = torch.isfinite(x).all(-1)
    if visible is not None:
        shown = shown & visible
    options = {"linestyle": "none", "marker": "+", "markersize": 5, **style}
    for points, good in zip(x.reshape(-1, *x.shape[-2:]), shown.reshape(-1, x.shape[-2]), strict=True):
        u, v = array(points[good].T)
        ax.plot(u, v, **options)
    if fresh:
        ax.set_aspect("equal")
        ax.yaxis.set_inverted(True)
    return ax


def plot_matches(
    image1: Photograph | Float[Tensor, "*channels1 h1 w1"],
    image2: Photograph | Float[Tensor, "*channels2 h2 w2"],
    x1: Float[Tensor, "n 2"],
    x2: Float[Tensor, "n 2"],
    *,
    inliers: Bool[Tensor, "n"] | None = None,
    every: int = 1,
    ax: Axes | None = None,
) -> Axes:
    """Show two images side by side with lines between matching points.

    Args:
        image1: First image, grey or coloured.
        image2: Second image, of any size.
        x1: Points in the first image, in pixels.
        x2: The matching points in the second image.
        inliers: If given, inliers are drawn green and the others red below them.
        every: Draw only every so-many-th match, where there are too many to see.
        ax: Where to draw; a new figure where not given.

    Returns:
        The axes. Points of the second image are moved right by the first one's width.

    Raises:
        ValueError: A shape is wrong.
        ImportError: matplotlib is not installed.

    Example:
        >>> import torch, torchsfm
        >>> image, x1 = torch.rand(48, 64), torch.tensor([[10.0, 20.0], [30.0, 40.0]])
        >>> ax = torchsfm.plot_matches(image, image, x1, x1 + 1.0, inliers=torch.tensor([True, False]))
    """
    check_tensors(x1=(x1, "n 2"), x2=(x2, "n 2"), inliers=(inliers, "?n: bool"))
    image1, image2 = pixels_of(image1), pixels_of(image2)
    check_tensors(image1=(image1, "h1 w1"), image2=(image2, "h2 w2"))
    if every < 1:
        raise ValueError(f"every: wanted at least 1, got {every}")
    pyplot()
    from matplotlib.collections import LineCollection

    pair = [image.expand(3, *image.shape[-2:]) for image in (image1, image2)]
    height = max(image.shape[1] for image in pair)
    canvas = pair[0].new_zeros(3, height, sum(image.shape[2] for image in pair))
    canvas[:, : pair[0].shape[1], : pair[0].shape[2]] = pair[0]
    canvas[:, : pair[1].shape[1], pair[0].shape[2] :] = pair[1]
    ax = show_image(canvas, ax=flat_axes(ax, (11.0, 4.5)))
    moved = x2 + x2.new_tensor([pair[0].shape[2], 0])
    segments = torch.stack((x1, moved.to(x1)), 1)[::every].detach().cpu()
    good = torch.ones(len(segments), dtype=torch.bool) if inliers is None else inliers[::every].detach().cpu()
    for chosen, color in ((~good, "#e5484d"), (good, "#30a46c" if inliers is not None else "#ffb020")):
        lines = array(segments[chosen])
        ax.add_collection(LineCollection(list(lines), colors=color, linewidths=0.7, alpha=0.8))
        ax.plot(*lines.reshape(-1, 2).T, linestyle="none", marker=".", markersize=3, color=color)
    ax.set_axis_off()
    return ax


def plot_epipolar_lines(
    F: Float[Tensor, "3 3"],
    x1: Float[Tensor, "n 2"],
    x2: Float[Tensor, "n 2"],
    image1: Photograph | Float[Tensor, "*channels1 h1 w1"],
    image2: Photograph | Float[Tensor, "*channels2 h2 w2"],
    *,
    axes: tuple[Axes, Axes] | None = None,
) -> tuple[Axes, Axes]:
    """Show both images with their points and the epipolar lines of the points in the other image, colour by colour.

    Args:
        F: Fundamental matrix, x2' F x1 = 0.
        x1: Points in the first image, in pixels; a dozen or so make a good figure.
        x2: The matching points in the second image.
        image1: First image, grey or coloured.
        image2: Second image.
        axes: Where to draw the two; a new figure where not given.

    Returns:
        The axes of both images. Lines that miss an image are not drawn.

    Raises:
        ValueError: A shape is wrong.
        ImportError: matplotlib is not installed.

    Example:
        >>> import torch, torchsfm
        >>> F = torchsfm.geometry.cross_matrix(torch.tensor([1.0, 0.0, 0.0]))  # moved sideways
        >>> image, x1 = torch.rand(48, 64), torch.tensor([[10.0, 20.0], [30.0, 40.0]])
        >>> left, right = torchsfm.plot_epipolar_lines(F, x1, x1 - torch.tensor([5.0, 0.0]), image, image)
    """
    check_tensors(F=(F, "3 3"), x1=(x1, "n 2"), x2=(x2, "n 2"))
    plt = pyplot()
    first, second = plt.subplots(1, 2, layout="constrained", figsize=(11, 4.5))[1] if axes is None else axes
    colors = [plt.get_cmap("hsv")(i / max(len(x1), 1)) for i in range(len(x1))]
    for ax, image, x, lines in (
        (first, image1, x1, epipolar_lines(F.mT, x2)),
        (second, image2, x2, epipolar_lines(F, x1)),
    ):
        show_image(image, ax=ax)
        height, width = pixels_of(image).shape[-2:]
        ends, meets = clip_lines(lines, width, height)
        for i, color in enumerate(colors):
            if bool(meets[i]):
                ax.plot(*array(ends[i].T), color=color, linewidth=1)
            ax.plot(*array(x[i, :, None]), color=color, marker="o", markersize=5, markeredgecolor="black")
        ax.set_xlim(-0.5, width - 0.5)
        ax.set_ylim(height - 0.5, -0.5)
    return first, second


def clip_lines(
    lines: Float[Tensor, "*batch 3"], width: int, height: int
) -> tuple[Float[Tensor, "*batch 2 2"], Bool[Tensor, "*batch"]]:
    """Where lines enter and leave an image, and whether they do; the end points of others are finite but meaningless."""
    a, b, c = lines.unbind(-1)
    square = a.square() + b.square()
    safe = torch.where(square > 0, square, 1.0)
    point = -torch.stack((a, b), -1) * (c / safe)[..., None]
    along = torch.stack((-b, a), -1) / safe.sqrt()[..., None]
    low, high = lines.new_tensor([-0.5, -0.5]), lines.new_tensor([width - 0.5, height - 0.5])
    level = along.abs() < 1e-12
    step = torch.where(level, 1.0, along)
    first, second = (low - point) / step, (high - point) / step
    near = torch.where(level, -torch.inf, torch.minimum(first, second)).amax(-1)
    far = torch.where(level, torch.inf, torch.maximum(first, second)).amin(-1)
    outside = (level & ((point < low) | (point > high))).any(-1)
    meets = (near < far) & (square > 0) & ~outside & torch.isfinite(lines).all(-1)
    near, far = torch.where(meets, near, 0.0), torch.where(meets, far, 0.0)
    ends = point[..., None, :] + torch.stack((near, far), -1)[..., None] * along[..., None, :]
    return torch.where(meets[..., None, None], ends, 0.0), meets
