"""Scenes of ellipses in space and of ellipsoids, and what cameras around them see of their edges."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_options
from torchsfm.geometry import (
    Ellipsoid,
    camera_from_krt,
    dual_conic,
    dual_quadric_from_ellipsoid,
    ellipse_from_conic,
    project_quadric,
    random_rotation,
    rotation_from_rotvec,
)
from torchsfm.simulation.randomness import where_drawn
from torchsfm.simulation.viewpoints import look_at


@dataclass(frozen=True)
class SimulatedConics:
    """Conics in space or ellipsoids, and their images; n of them in v views.

    Example:
        >>> import torch, torchsfm
        >>> scene = torchsfm.simulation.simulate_conics((), conics=2, views=3, generator=torch.Generator().manual_seed(0))
        >>> outline, is_ellipse = torchsfm.geometry.ellipse_from_conic(scene.C)
        >>> outline.centre.shape, is_ellipse.all()  # two discs in three images
        (torch.Size([3, 2, 2]), tensor(True))
        >>> x = torchsfm.to_homogeneous(scene.x)  # points of the outlines
        >>> bool(torch.einsum("vmni,vmij,vmnj->vmn", x, scene.C, x).abs().max() < 1e-6 * scene.C.abs().max())
        True
    """

    model: Ellipsoid
    """The truth, of batch (*batch, n)."""
    P: Float[Tensor, "*batch v 3 4"]
    """Cameras of 800 pixels focal length that look at the middle of the scene from 5 to 7 units away."""
    C: Float[Tensor, "*batch v n 3 3"]
    """The exact images."""
    x: Float[Tensor, "*batch v n k 2"]
    """Edge points, spread evenly by the ellipse's parameter, with noise."""


@where_drawn
def simulate_conics(
    shape: Sequence[int],
    *,
    conics: int = 1,
    views: int = 3,
    points: int = 60,
    flat: bool = True,
    coplanar: bool = False,
    noise: float = 0.0,
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
) -> SimulatedConics:
    """Draw scenes of conics that all views see whole, flat ones from one side and not along their planes.

    Args:
        shape: Batch dimensions.
        conics: Number of conics in a scene.
        views: Number of cameras.
        points: Number of edge points on each image.
        flat: Ellipses in space; else ellipsoids.
        coplanar: Ellipses that all lie in one plane.
        noise: Standard deviation of the coordinates of edge points, in pixels.
        generator: Source of randomness; torch's own where none is given.
        dtype: Of the numbers.

    Returns:
        The scenes, on the generator's device, on the CPU where none is given.

    Example:
        >>> import torch, torchsfm
        >>> scene = torchsfm.simulation.simulate_conics((), conics=2, views=3, generator=torch.Generator().manual_seed(0))
        >>> scene.model.centre.shape, scene.C.shape
        (torch.Size([2, 3]), torch.Size([3, 2, 3, 3]))
    """
    check_options(
        conics=(conics, "int >= 1"), views=(views, "int >= 1"), points=(points, "int >= 1"), noise=(noise, "float >= 0"),
        flat=(flat, bool), coplanar=(coplanar, bool),
    )  # fmt: skip
    batch = tuple(shape)

    def uniform(*size: int, low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(*batch, *size, generator=generator, dtype=dtype)

    # Planes face the z axis, give or take 25 degrees, and cameras stand around it, up to 40 degrees away.
    tilt = uniform(1 if coplanar else conics, 2, low=-0.3, high=0.3)
    R = rotation_from_rotvec(torch.nn.functional.pad(tilt, (0, 1)))
    spin = rotation_from_rotvec(torch.nn.functional.pad(uniform(conics, 1, low=-3.1, high=3.1), (2, 0)))
    directions = (R @ spin).mT if flat else random_rotation(*batch, conics, generator=generator, dtype=dtype)
    longest = uniform(conics, low=0.2, high=0.6)
    ratios = uniform(conics, 2, low=0.4, high=0.95).sort(-1, descending=True).values
    lengths = torch.stack((longest, longest * ratios[..., 0], 0 * longest if flat else longest * ratios[..., 1]), -1)
    place = uniform(conics, 3, low=-1.0, high=1.0)
    if coplanar:
        place = (torch.nn.functional.pad(place[..., :2], (0, 1))[..., None, :] @ R.mT)[..., 0, :]
    model = Ellipsoid(place, lengths[..., None] * directions)
    polar, azimuth = uniform(views, low=0.1, high=0.7), uniform(views, low=0.0, high=2 * math.pi)
    ray = torch.stack((polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()), -1)
    pose = look_at(uniform(views, 1, low=5.0, high=7.0) * ray, uniform(views, 3, low=-0.2, high=0.2))
    K = torch.tensor([[800.0, 0, 500], [0, 800, 400], [0, 0, 1]], dtype=dtype)
    P = camera_from_krt(K.expand(*batch, views, 3, 3), pose.R, pose.t)
    C = dual_conic(project_quadric(P[..., :, None, :, :], dual_quadric_from_ellipsoid(model)[..., None, :, :, :]))
    image, _ = ellipse_from_conic(C)
    x = image.points(torch.arange(points, dtype=dtype) * (2 * math.pi / points))
    x = x + noise * torch.randn(x.shape, generator=generator, dtype=dtype)
    return SimulatedConics(model, P, C, x)
