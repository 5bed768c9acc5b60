"""Simulated observations of points: projections with noise, outliers and missing data, batched over problems."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_options, check_tensors
from torchsfm.geometry.cameras import Camera, intrinsics
from torchsfm.geometry.poses import Pose
from torchsfm.linalg.devices import drawn_on
from torchsfm.simulation.randomness import drawn


@dataclass(frozen=True)
class SimulatedImages:
    """What the cameras measured, and what they would have measured without errors.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(100, generator=g), torchsfm.random_poses(2, generator=g)
        >>> camera = torchsfm.Camera(torchsfm.random_intrinsics(generator=g))
        >>> seen = torchsfm.simulate_images(X, poses, camera, noise=0.5, outliers=0.2, generator=g)
        >>> right = (seen.visible & ~seen.outlier).all(0)
        >>> F = torchsfm.fundamental_8pt(seen.x[0, right], seen.x[1, right])
        >>> bool(torchsfm.sampson_distance(F, seen.x_true[0], seen.x_true[1]).mean() < 1)  # against points without noise
        True
    """

    x: Float[Tensor, "*batch v n 2"]
    """Measured image points in pixels; zero where not visible."""
    visible: Bool[Tensor, "*batch v n"]
    """Which points were measured in which view."""
    outlier: Bool[Tensor, "*batch v n"]
    """Which of them are gross errors, drawn evenly over the image."""
    x_true: Float[Tensor, "*batch v n 2"]
    """Exact projections; finite but meaningless for points that are not in front of the camera."""
    depth: Float[Tensor, "*batch v n"]
    """Signed depth of every point in every view."""


def simulate_images(
    X: Float[Tensor, "*#batch n 3"],
    poses: Pose,
    cameras: Camera,
    *,
    image_size: tuple[int, int] | None = None,
    noise: float = 0.0,
    outliers: float = 0.0,
    dropout: float = 0.0,
    depth_range: tuple[float, float] = (0.0, float("inf")),
    generator: torch.Generator | None = None,
) -> SimulatedImages:
    """Observe points in several views.

    A point is visible where its depth is in `depth_range`, its projection is inside the image and the lens formula can see it
    (no folding back), unless it is dropped. Points do not hide each other. Noise may carry an observation out of the image.

    Args:
        X: Points of each problem.
        poses: World to camera, batch (*batch, v).
        cameras: Intrinsics and distortion; the batch broadcasts against (*batch, v), so one camera for all has batch (), one
            for each problem (*batch, 1).
        image_size: Width and height in pixels; without it the field of view is unlimited.
        noise: Standard deviation of each coordinate in pixels.
        outliers: Probability that an observation is replaced by a random point of the image (without `image_size`: of the
            bounding box of the view's visible projections).
        dropout: Probability that a visible point is not measured.
        depth_range: Least (exclusive) and largest depth at which points are seen.
        generator: Source of randomness; torch's own where none is given.

    Returns:
        Observations and truth, with batch shape that of all arguments together.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> X, poses = torchsfm.random_points(100, generator=g), torchsfm.random_poses(3, generator=g)
        >>> camera = torchsfm.Camera(torchsfm.random_intrinsics(generator=g))
        >>> seen = torchsfm.simulate_images(X, poses, camera, image_size=(1000, 750), noise=0.5, outliers=0.1, generator=g)
        >>> seen.x.shape, bool(0 < seen.outlier.sum() < 60)
        (torch.Size([3, 100, 2]), True)
    """
    check_tensors(X=(X, "n 3"))
    check_options(
        poses=(poses, Pose), cameras=(cameras, Camera), image_size=(image_size, "?2 int >= 1"), noise=(noise, "float >= 0"),
        outliers=(outliers, "0 <= float <= 1"), dropout=(dropout, "0 <= float <= 1"),
    )  # fmt: skip
    if (
        not isinstance(depth_range, Sequence)
        or len(depth_range) != 2
        or not all(isinstance(d, int | float) for d in depth_range)
    ):
        raise ValueError(f"depth_range: wanted the least and the largest depth, got {depth_range!r}")
    if len(poses.shape) < 1:
        raise ValueError(f"poses: wanted batch shape (*batch, views), got {tuple(poses.shape)}")
    check_tensors(X=(X[..., None, :, :], "n 3"), R=(poses.R, "3 3"), K=(cameras.K, "3 3"))
    X_cam = poses.transform(X[..., None, :, :])
    depth = X_cam[..., 2]
    x_true = cameras.project(X_cam)
    if x_true.shape[:-1] != depth.shape:
        depth = depth.expand(x_true.shape[:-1])
        X_cam = X_cam.expand(*x_true.shape[:-1], 3)
    near, far = depth_range
    visible = (depth > near) & (depth <= far) & cameras.in_domain(X_cam)
    if image_size is not None:
        size = X.new_tensor(image_size)
        visible = visible & ((x_true >= -0.5) & (x_true < size - 0.5)).all(-1)
        low, high = torch.full_like(size, -0.5), size - 0.5
    else:
        shown = visible[..., None]
        exact = x_true.detach()
        low = torch.where(shown, exact, float("inf")).amin(-2, keepdim=True) if X.shape[-2] else exact
        high = torch.where(shown, exact, -float("inf")).amax(-2, keepdim=True) if X.shape[-2] else exact
        some = torch.isfinite(low) & torch.isfinite(high)
        low, high = torch.where(some, low, 0.0), torch.where(some, high, 0.0)
    visible = visible & (drawn(torch.rand, depth.shape, X, generator) >= dropout)
    x = x_true + noise * drawn(torch.randn, x_true.shape, X, generator)
    outlier = drawn(torch.rand, depth.shape, X, generator) < outliers
    wild = low + (high - low) * drawn(torch.rand, x_true.shape, X, generator)
    outlier = outlier & visible
    x = torch.where(outlier[..., None], wild, x)
    return SimulatedImages(torch.where(visible[..., None], x, 0.0), visible, outlier, x_true, depth)


def random_points(
    *shape: int,
    kind: str = "ball",
    size: float = 1.0,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> Float[Tensor, "*shape 3"]:
    """Random points around the origin.

    Args:
        *shape: Batch shape and number of points, (*batch, n).
        kind: "ball": evenly inside a ball; "cube": evenly inside a cube; "plane": evenly on a square in the plane z = 0;
            "line": evenly on a segment of the x axis; "gauss": normally distributed.
        size: Radius of the ball, half the side of the cube, square or segment, or the standard deviation.
        generator: Source of randomness; torch's own where none is given.
        dtype: Of the points.
        device: Of the points; the generator's if not given.

    Example:
        >>> import torch, torchsfm
        >>> X = torchsfm.random_points(8, 100, generator=torch.Generator().manual_seed(0))  # eight scenes
        >>> X.shape, bool(X.norm(dim=-1).max() <= 1)
        (torch.Size([8, 100, 3]), True)
    """
    check_options(kind=(kind, ("ball", "cube", "plane", "line", "gauss")), size=(size, "float"))
    device = drawn_on(generator, device)
    options: dict[str, object] = {"dtype": dtype, "device": device, "generator": generator}
    if kind == "gauss":
        return size * torch.randn(*shape, 3, **options)  # type: ignore[call-overload, no-any-return]
    if kind == "ball":
        direction = torch.randn(*shape, 3, **options)  # type: ignore[call-overload]
        radius = torch.rand(*shape, 1, **options) ** (1 / 3)  # type: ignore[call-overload]
        return size * radius * direction / direction.norm(dim=-1, keepdim=True).clamp_min(1e-30)  # type: ignore[no-any-return]
    used = {"cube": 3, "plane": 2, "line": 1}[kind]
    draw = size * (2 * torch.rand(*shape, 3, **options) - 1)  # type: ignore[call-overload]
    draw[..., used:] = 0
    return draw  # type: ignore[no-any-return]


def random_intrinsics(
    *shape: int,
    image_size: tuple[int, int] = (1000, 750),
    view_angle: tuple[float, float] = (0.7, 1.2),
    wobble: float = 0.02,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> Float[Tensor, "*shape 3 3"]:
    """Random calibration matrices of cameras with square pixels.

    Args:
        *shape: Batch shape.
        image_size: Width and height in pixels.
        view_angle: Least and largest angle of view across the width, in radians, drawn evenly.
        wobble: Standard deviation of the principal point about the middle of the image, as a share of the width.
        generator: Source of randomness; torch's own where none is given.
        dtype: Of the matrices.
        device: Of the matrices; the generator's if not given.

    Example:
        >>> import torch, torchsfm
        >>> K = torchsfm.random_intrinsics(5, image_size=(640, 480), generator=torch.Generator().manual_seed(0))
        >>> K.shape, bool((K[:, 0, 0] > 460).all())
        (torch.Size([5, 3, 3]), True)
    """
    device = drawn_on(generator, device)
    options: dict[str, object] = {"dtype": dtype, "device": device, "generator": generator}
    angles = (view_angle, "2 float > 0 < 3.1416 radians")
    check_options(image_size=(image_size, "2 int >= 1"), view_angle=angles, wobble=(wobble, "float >= 0"))
    low, high = view_angle
    angle = low + (high - low) * torch.rand(shape, **options)  # type: ignore[call-overload]
    width, height = image_size
    middle = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=dtype, device=device)
    c = middle + wobble * width * torch.randn(*shape, 2, **options)  # type: ignore[call-overload]
    return intrinsics(width / 2 / (angle / 2).tan(), c)
