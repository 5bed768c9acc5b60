"""Simulated observations of lines: parts of segments in space, with noise, wrong matches and missing data."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import broadcast_shapes, check_options, check_tensors
from torchsfm.geometry.cameras import Camera
from torchsfm.geometry.lines import pluecker_from_points
from torchsfm.geometry.poses import Pose
from torchsfm.simulation.observations import simulate_images
from torchsfm.simulation.randomness import drawn


@dataclass(frozen=True)
class SimulatedSegments:
    """What the cameras measured of lines, and what they would have measured without errors.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(20, generator=g).reshape(10, 2, 3), torchsfm.random_poses(4, generator=g)
        >>> camera = torchsfm.Camera(torchsfm.random_intrinsics(generator=g))
        >>> seen = torchsfm.simulation.simulate_segments(X, poses, camera, cut=0.5, generator=g)
        >>> found = torchsfm.triangulate_lines(seen.l, camera.K @ poses.matrix())  # although no view shows the same ends
        >>> bool(found.model.allclose(seen.L))
        True
    """

    l: Float[Tensor, "*batch v n 2 2"]  # noqa: E741
    """Measured segments, both ends in pixels in the order of the line's; zero where not visible."""
    visible: Bool[Tensor, "*batch v n"]
    """Which lines were measured in which view."""
    outlier: Bool[Tensor, "*batch v n"]
    """Which of them are wrong: the segment of another line."""
    l_true: Float[Tensor, "*batch v n 2 2"]
    """Exact projections of the shown ends; finite but meaningless for ends that are not in front of the camera."""
    ends: Float[Tensor, "*batch v n 2 3"]
    """The ends in the world of the part that each view shows."""
    L: Float[Tensor, "*batch n 6"]
    """The lines, Pluecker vectors (d, m) with |d| = 1, d from the first end to the second."""


def simulate_segments(
    X: Float[Tensor, "*#batch n 2 3"],
    poses: Pose,
    cameras: Camera,
    *,
    image_size: tuple[int, int] | None = None,
    noise: float = 0.0,
    cut: float = 0.0,
    outliers: float = 0.0,
    dropout: float = 0.0,
    generator: torch.Generator | None = None,
) -> SimulatedSegments:
    """Observe lines in several views, of each a part with ends of its own.

    A line is visible where both ends of its part are in front of the camera and inside the image, unless it is dropped. Lines
    do not hide each other. With distortion the ends are where the lens shows them, and what is between is no straight line.

    Args:
        X: Both ends of the segments of each problem, which should differ.
        poses: World to camera, batch (*batch, v).
        cameras: Intrinsics and distortion; the batch broadcasts against (*batch, v), so one camera for all has batch (), one
            for each problem (*batch, 1).
        image_size: Width and height in pixels; without it the field of view is unlimited.
        noise: Standard deviation of each coordinate of the ends in pixels.
        cut: The share of a segment that a view may leave out, at most; how much and where is drawn for each view.
        outliers: Probability that a segment is replaced by that of another line which the view shows.
        dropout: Probability that a visible line is not measured.
        generator: Source of randomness; torch's own where none is given.

    Returns:
        Observations and truth, with batch shape that of all arguments together.

    Raises:
        ValueError: A shape, dtype, device or option does not fit.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(200, generator=g).reshape(100, 2, 3), torchsfm.random_poses(3, generator=g)
        >>> camera = torchsfm.Camera(torchsfm.random_intrinsics(generator=g))
        >>> seen = torchsfm.simulation.simulate_segments(X, poses, camera, noise=0.5, cut=0.3, outliers=0.1, generator=g)
        >>> seen.l.shape, bool(0 < seen.outlier.sum() < 60)
        (torch.Size([3, 100, 2, 2]), True)
    """
    check_tensors(X=(X, "n 2 3"))
    check_options(
        poses=(poses, Pose), cameras=(cameras, Camera), image_size=(image_size, "?2 int >= 1"), noise=(noise, "float >= 0"),
        cut=(cut, "0 <= float < 1"), outliers=(outliers, "0 <= float <= 1"), dropout=(dropout, "0 <= float <= 1"),
    )  # fmt: skip
    if len(poses.shape) < 1:
        raise ValueError(f"poses: wanted batch shape (*batch, views), got {tuple(poses.shape)}")
    check_tensors(X=(X[..., None, :, :, :], "n 2 3"), R=(poses.R, "3 3"), K=(cameras.K, "3 3"))
    n = X.shape[-3]
    batch = broadcast_shapes((*X.shape[:-3], 1), poses.shape, cameras.K.shape[:-2])
    lines = torch.Size((*batch, n))
    lost = cut * drawn(torch.rand, lines, X, generator)
    begin = lost * drawn(torch.rand, lines, X, generator)
    first, last = X[..., None, :, :1, :], X[..., None, :, 1:, :]
    ends = first + torch.stack((begin, begin + 1 - lost), -1)[..., None] * (last - first)
    # Each view sees points of its own.
    seen = simulate_images(
        ends.flatten(-3, -2), poses[..., None], cameras[..., None], image_size=image_size, noise=noise, generator=generator
    )
    l, l_true = (t.reshape(*lines, 2, 2) for t in (seen.x, seen.x_true))  # noqa: E741
    visible = seen.visible.reshape(*lines, 2).all(-1)
    visible = visible & (drawn(torch.rand, lines, X, generator) >= dropout)
    wrong = drawn(torch.rand, lines, X, generator) < outliers
    step = (1 + (max(n - 1, 1) * drawn(torch.rand, lines, X, generator)).long()).clamp_max(max(n - 1, 1))
    other = (torch.arange(n, device=X.device) + step) % max(n, 1)
    outlier = wrong & visible & visible.gather(-1, other) & (n > 1)
    l = torch.where(outlier[..., None, None], l.gather(-3, other[..., None, None].expand_as(l)), l)  # noqa: E741
    direction = X[..., 1, :] - X[..., 0, :]
    L = pluecker_from_points(X[..., 0, :], X[..., 1, :]) / torch.linalg.vector_norm(direction, dim=-1, keepdim=True)
    L = L.expand(*batch[:-1], n, 6)
    return SimulatedSegments(torch.where(visible[..., None, None], l, 0.0), visible, outlier, l_true, ends, L)
