"""Figures in space: points, lines, cameras, and tracks with the image number as the third axis."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import check_tensors
from torchsfm.geometry import Camera, Pose
from torchsfm.plot.axes import Axes, array, pyplot, spatial_axes


def plot_points_3d(
    X: Float[Tensor, "*batch n 3"],
    *,
    color: Float[Tensor, "*batch n 3"] | str | None = None,
    share: float = 1.0,
    ax: Axes | None = None,
    **style: Any,
) -> Axes:
    """Draw points in space, all axes at the same scale.

    Args:
        X: Points. Those that are not finite are left out.
        color: Red, green, blue in [0, 1] of each point, or one of matplotlib's colours for all.
        share: Draw only this share of the points, those nearest to their median; less than 1 keeps a few wild points from
            making all others small.
        ax: 3D axes to draw on; a new figure where not given.
        **style: Passed on to matplotlib's `scatter`.

    Returns:
        The axes.

    Raises:
        ValueError: A shape or option is wrong.
        ImportError: matplotlib is not installed.

    Example:
        >>> import torch, torchsfm
        >>> X = torchsfm.random_points(200, generator=torch.Generator().manual_seed(0))
        >>> ax = torchsfm.plot_points_3d(X, color=(X + 1) / 2)
    """
    check_tensors(X=(X, "n 3"), color=(color if isinstance(color, Tensor) else None, "?n 3"))
    if not 0 < share <= 1:
        raise ValueError(f"share: wanted a number in (0, 1], got {share}")
    ax = spatial_axes(ax)
    points = X.detach().reshape(-1, 3)
    good = torch.isfinite(points).all(-1)
    if share < 1 and good.any():
        distance = (points - points[good].median(0).values).norm(dim=-1)
        ordered = distance[good].sort().values
        good = good & (distance <= ordered[min(len(ordered) - 1, int(share * len(ordered)))])
    values: Any = array(color.expand_as(X).reshape(-1, 3)[good].clamp(0, 1)) if isinstance(color, Tensor) else color
    options = {"s": 2, "depthshade": False, **style}
    ax.scatter(*array(points[good].T), c=values, **options)
    return _finish(ax)


def plot_lines_3d(
    ends: Float[Tensor, "*batch l 2 3"],
    *,
    color: Float[Tensor, "*batch l 3"] | str | None = None,
    ax: Axes | None = None,
    **style: Any,
) -> Axes:
    """Draw parts of lines in space, such as `Reconstruction.lines.ends`, all axes at the same scale.

    Args:
        ends: Both ends of each. Those that are not finite are left out.
        color: Red, green, blue in [0, 1] of each line, or one of matplotlib's colours for all.
        ax: 3D axes to draw on; a new figure where not given.
        **style: Passed on to matplotlib's `Line3DCollection`.

    Returns:
        The axes.

    Raises:
        ValueError: A shape is wrong.
        ImportError: matplotlib is not installed.

    Example:
        >>> import torch, torchsfm
        >>> ax = torchsfm.plot_lines_3d(torch.rand(5, 2, 3), color="black")
    """
    check_tensors(ends=(ends, "l 2 3"), color=(color if isinstance(color, Tensor) else None, "?l 3"))
    ax = spatial_axes(ax)
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    segments = ends.detach().reshape(-1, 2, 3)
    good = segments.isfinite().flatten(1).all(-1)
    values: Any = color
    if isinstance(color, Tensor):
        values = array(color.expand(*ends.shape[:-2], 3).reshape(-1, 3)[good].clamp(0, 1))
    if good.any():
        ax.add_collection3d(Line3DCollection(list(array(segments[good])), **{"colors": values, "linewidths": 0.8, **style}))
    # Collections do not move the limits of the axes; invisible points at the ends do.
    ax.scatter(*array(segments[good].reshape(-1, 3).T), s=0)
    return _finish(ax)


def plot_cameras(
    poses: Pose,
    cameras: Camera | None = None,
    image_size: Int[Tensor, "*#batch 2"] | None = None,
    *,
    names: Sequence[str] | None = None,
    size: float | None = None,
    color: str = "tab:red",
    ax: Axes | None = None,
) -> Axes:
    """Draw cameras as pyramids: the apex is the centre, the base the image, a tick on its upper edge.

    Args:
        poses: World to camera, batch (v,) or none.
        cameras: Intrinsics, batch as the poses or none; the image is drawn a square of 53 degrees without them. Distortion is
            left out of the drawing.
        image_size: Width and height in pixels of each image or of all; without it the principal point is taken as the middle.
        names: Written at each camera.
        size: Depth of the pyramids in the unit of the world; 6 % of the extent of what is in the figure where not given.
        color: One of matplotlib's colours.
        ax: 3D axes to draw on; a new figure where not given.

    Returns:
        The axes.

    Raises:
        ValueError: A shape is wrong.
        ImportError: matplotlib is not installed.

    Example:
        >>> import torchsfm
        >>> ax = torchsfm.plot_cameras(torchsfm.simulation.orbit_poses(8))
    """
    if len(poses.shape) > 1:
        raise ValueError(f"poses: wanted batch shape (views,) or (), got {tuple(poses.shape)}")
    poses = poses if poses.shape else poses[None]
    if names is not None and len(names) != len(poses.t):
        raise ValueError(f"names: wanted {len(poses.t)} as there are poses, got {len(names)}")
    ax = spatial_axes(ax)
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    centre = poses.centre.detach()
    if size is None:
        span = centre.new_tensor([ax.get_xlim3d(), ax.get_ylim3d(), ax.get_zlim3d()]) if ax.has_data() else None
        everything = centre if span is None else torch.cat((centre, span.T))
        size = 0.06 * float((everything.amax(0) - everything.amin(0)).norm()) if len(centre) else 1.0
        size = size if size > 0 else 1.0
    corners = _image_corners(len(centre), centre, cameras, image_size) * size
    world = poses.inverse().transform(corners).detach()
    # Apex to corners, round the base, and a tick upwards from the middle of the upper edge.
    path = torch.stack((world, centre[:, None].expand_as(world)), -2)
    base = torch.stack((world, world.roll(-1, 1)), -2)
    top = (world[:, 0] + world[:, 1]) / 2
    tick = torch.stack((top, top + 0.15 * (world[:, 0] - world[:, 3])), -2)[:, None]
    segments = torch.cat((path, base, tick), 1).reshape(-1, 2, 3)
    if len(segments):
        ax.add_collection3d(Line3DCollection(list(array(segments)), colors=color, linewidths=0.8))
    ax.scatter(*array(centre.T), c=color, s=4, depthshade=False)
    # Collections do not move the limits of the axes; invisible points at the corners do.
    ax.scatter(*array(world.reshape(-1, 3).T), s=0)
    for name, place in zip(names or (), centre.tolist(), strict=bool(names)):
        ax.text(*place, name, fontsize="x-small")
    return _finish(ax)


def _image_corners(count: int, like: Tensor, cameras: Camera | None, image_size: Tensor | None) -> Tensor:
    """Corners of the images at depth 1, (count, 4, 3), from the upper left one clockwise; clockwise as the image is seen."""
    signs = like.new_tensor([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    if cameras is None:
        corners = (0.5 * signs).expand(count, 4, 2)
    else:
        check_tensors(K=(cameras.K, "3 3"), image_size=(image_size, "?2: int"))
        K = cameras.K.detach().to(like).expand(count, 3, 3)
        size = 2 * K[:, :2, 2] + 1 if image_size is None else image_size.to(like).expand(count, 2)
        pixels = (signs + 1) / 2 * size[:, None] - 0.5
        homogeneous = torch.cat((pixels, torch.ones_like(pixels[..., :1])), -1)
        corners = torch.linalg.solve_ex(K, homogeneous.mT)[0].mT[..., :2].clamp(-5, 5)
    return torch.cat((corners, torch.ones_like(corners[..., :1])), -1)


def plot_tracks(
    x: Float[Tensor, "m 2"],
    view: Int[Tensor, "m"],
    track: Int[Tensor, "m"],
    *,
    image_size: tuple[int, int] | None = None,
    ax: Axes | None = None,
    **style: Any,
) -> Axes:
    """Draw the tracks of points through a sequence as curves in space, the image number being the third axis.

    This is how the structure and motion papers of the Lund group drew them in the 1990s.

    Args:
        x: Observed image points in pixels.
        view: Number of the image of each.
        track: Number of the track of each. Order does not matter; tracks may be short or have gaps.
        image_size: Width and height, for the limits of the axes.
        ax: 3D axes to draw on; a new figure where not given.
        **style: Passed on to matplotlib's `Line3DCollection`.

    Returns:
        The axes: image number to the back, x to the right, y down.

    Raises:
        ValueError: A shape is wrong.
        ImportError: matplotlib is not installed.

    Example:
        >>> import torch, torchsfm
        >>> frame, x = torch.arange(5), torch.rand(5, 2)  # a point in five frames
        >>> ax = torchsfm.plot.plot_tracks(x, frame, torch.zeros_like(frame))
    """
    check_tensors(x=(x, "m 2"), view=(view, "m: int"), track=(track, "m: int"))
    ax = spatial_axes(ax)
    plt = pyplot()
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    x, view, track = x.detach().cpu(), view.detach().cpu(), track.detach().cpu()
    good = torch.isfinite(x).all(-1)
    x, view, track = x[good], view[good], track[good]
    order = view.sort(stable=True).indices
    order = order[track[order].sort(stable=True).indices]
    curve = torch.stack((view.to(x), x[:, 0], x[:, 1]), -1)[order]
    _, counts = torch.unique_consecutive(track[order], return_counts=True)
    pieces = np.split(array(curve), counts.cumsum(0)[:-1].tolist())
    cycle = plt.get_cmap("tab20")
    options = {"linewidths": 0.8, "colors": [cycle(i % 20) for i in range(len(counts))], **style}
    if len(curve):
        ax.add_collection3d(Line3DCollection(pieces, **options))
    single = torch.repeat_interleave(counts, counts) == 1
    ax.scatter(*array(curve[single].T), s=2, color="black", depthshade=False)
    ax.set_xlabel("image")
    ax.set_ylabel("x [px]")
    ax.set_zlabel("y [px]")
    low, high = (curve.amin(0).tolist(), curve.amax(0).tolist()) if len(curve) else ([0.0] * 3, [1.0] * 3)
    if image_size is not None:
        low, high = [low[0], -0.5, -0.5], [high[0], image_size[0] - 0.5, image_size[1] - 0.5]
    (a, b, c), (d, e, f) = low, [top if top > bottom else bottom + 1 for bottom, top in zip(low, high, strict=True)]
    ax.set_xlim3d(a, d)
    ax.set_ylim3d(b, e)
    ax.set_zlim3d(f, c)
    return ax


def _finish(ax: Axes) -> Axes:
    """Same scale on all axes, and their names."""
    ax.set_aspect("equal")
    ax.set_xlabel("x")
    ax.set_ylabel("y")
    ax.set_zlabel("z")
    return ax
