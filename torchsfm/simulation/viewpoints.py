"""Where synthetic cameras stand: looking at a target, on an arc around it, or anywhere around it."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import broadcast_shapes, check_options, check_tensors
from torchsfm.geometry.poses import Pose
from torchsfm.linalg.devices import drawn_on


def look_at(
    centre: Float[Tensor, "*#batch 3"],
    target: Float[Tensor, "*#batch 3"],
    up: Float[Tensor, "*#batch 3"] | None = None,
) -> Pose:
    """The pose of a camera at `centre` that looks at `target` and is held upright.

    The target comes to lie on the optical axis, and `up` points up in the image (the camera's y axis points down).

    Args:
        centre: Camera centre in the world.
        target: A point on the optical axis, in front of the camera.
        up: What is up in the world; the z axis unless given. Where it is parallel to the view, another axis is used.

    Returns:
        World to camera. Where centre and target coincide the camera looks along the world's z axis.

    Example:
        >>> import torch, torchsfm
        >>> pose = torchsfm.simulation.look_at(torch.tensor([0.0, -5.0, 0.0]), torch.zeros(3))
        >>> pose.transform(torch.tensor([[0.0, 0.0, 1.0]]))  # above the target: 5 ahead, y points down
        tensor([[ 0., -1.,  5.]])
    """
    check_tensors(centre=(centre, "3"), target=(target, "3"), up=(up, "?3"))
    if up is None:
        up = centre.new_tensor([0.0, 0.0, 1.0])
    shape = broadcast_shapes(centre.shape, target.shape, up.shape)
    centre, target, up = centre.expand(shape), target.expand(shape), up.expand(shape)
    z_axis, x_axis = centre.new_tensor([0.0, 0.0, 1.0]), centre.new_tensor([1.0, 0.0, 0.0])
    forward = target - centre
    length = forward.norm(dim=-1, keepdim=True)
    forward = torch.where(length > 0, forward / length.clamp_min(1e-300 if centre.dtype == torch.float64 else 1e-30), z_axis)
    right = torch.linalg.cross(forward, up)
    parallel = right.norm(dim=-1, keepdim=True) <= 1e-6 * up.norm(dim=-1, keepdim=True)
    spare = torch.where(forward[..., :1].abs() < 0.9, x_axis, z_axis)
    right = torch.where(parallel, torch.linalg.cross(forward, spare), right)
    right = right / right.norm(dim=-1, keepdim=True)
    R = torch.stack((right, torch.linalg.cross(forward, right), forward), -2)
    return Pose(R, -(R @ centre[..., None])[..., 0])


def orbit_poses(
    views: int,
    *,
    radius: float = 6.0,
    height: tuple[float, float] = (1.0, 2.5),
    sweep: float = math.pi / 2,
    start: float = 0.0,
    target: tuple[float, float, float] = (0.0, 0.0, 0.0),
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> Pose:
    """Cameras on an arc around a target, all looking at it, their height swinging between two values.

    Args:
        views: How many.
        radius: Horizontal distance from the target, in the unit of the scene.
        height: Lowest and highest camera above the target.
        sweep: Angle of the arc in radians, counter-clockwise; 2 pi goes all the way round without repeating the first view.
        start: Angle of the first camera, from the world's x axis, in radians.
        target: The point looked at.
        dtype: Of the poses.
        device: Of the poses.

    Returns:
        World to camera, batch (views,).

    Example:
        >>> import torch, torchsfm
        >>> poses = torchsfm.simulation.orbit_poses(8, radius=3.0)
        >>> poses.centre[:, :2].norm(dim=-1)[:4]
        tensor([3.0000, 3.0000, 3.0000, 3.0000], dtype=torch.float64)
    """
    check_options(
        views=(views, "int >= 1"), radius=(radius, "float"), height=(height, "2 float"), sweep=(sweep, "float"),
        start=(start, "float"), target=(target, "3 float"),
    )  # fmt: skip
    whole = abs(sweep) >= 2 * math.pi - 1e-9
    i = torch.arange(views, dtype=dtype, device=device)
    angle = start + sweep * i / max(views if whole else views - 1, 1)
    low, high = height
    # Two and a half swings, so that neighbours differ in height and no simple surface holds all centres.
    z = low + (high - low) * (0.5 - 0.5 * torch.cos(5 * math.pi * i / max(views - 1, 1)))
    middle = torch.tensor(target, dtype=dtype, device=device)
    centre = middle + torch.stack((radius * angle.cos(), radius * angle.sin(), z), -1)
    return look_at(centre, middle)


def random_poses(
    *shape: int,
    distance: tuple[float, float] = (4.0, 6.0),
    spread: float = math.pi / 3,
    wobble: float = 0.1,
    roll: float = math.pi / 18,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> Pose:
    """Cameras at random places around the origin, roughly facing it.

    Args:
        *shape: Batch shape, usually (*problems, views).
        distance: Least and largest distance from the origin, drawn evenly.
        spread: The centres' directions lie within this angle (radians) of the world's -z axis, evenly over that cap; pi is
            the whole sphere.
        wobble: Standard deviation of the point looked at about the origin, in the unit of the scene.
        roll: Standard deviation of the roll about the optical axis, in radians.
        generator: Source of randomness; torch's own where none is given.
        dtype: Of the poses.
        device: Of the poses; the generator's if not given.

    Returns:
        World to camera, with the given batch shape.

    Example:
        >>> import torch, torchsfm
        >>> poses = torchsfm.random_poses(8, 2, generator=torch.Generator().manual_seed(0))  # eight pairs
        >>> poses.shape, bool(poses.centre.norm(dim=-1).min() >= 4)
        (torch.Size([8, 2]), True)
    """
    check_options(distance=(distance, "2 float"), spread=(spread, "float"), wobble=(wobble, "float"), roll=(roll, "float"))
    options: dict[str, object] = {"dtype": dtype, "device": drawn_on(generator, device)}
    draw = torch.rand(*shape, 3, generator=generator, **options)  # type: ignore[call-overload]
    normal = torch.randn(*shape, 4, generator=generator, **options)  # type: ignore[call-overload]
    cosine = 1 - draw[..., 0] * (1 - math.cos(spread))
    sine, azimuth = (1 - cosine.square()).clamp_min(0).sqrt(), 2 * math.pi * draw[..., 1]
    direction = torch.stack((sine * azimuth.cos(), sine * azimuth.sin(), -cosine), -1)
    low, high = distance
    centre = direction * (low + (high - low) * draw[..., 2:])
    angle = roll * normal[..., 3]
    # At roll 0 the world's -y axis is up, so that cameras at -z see the world with their own axes.
    up = torch.stack((angle.sin(), -angle.cos(), torch.zeros_like(angle)), -1)
    return look_at(centre, wobble * normal[..., :3], up)
