"""Places on the earth (WGS84) and a frame in metres around one of them: east, north and up."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors

SEMI_MAJOR = 6378137.0
"""Of the ellipsoid, metres (NIMA TR8350.2)."""
FLATTENING = 1 / 298.257223563
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)
"""The square of the eccentricity."""
ROUNDS = 6
"""Of the iteration for the latitude, of which near the earth one is exact to a thousandth of a millimetre."""


def enu_from_geodetic(place: Float[Tensor, "*#batch 3"], origin: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch 3"]:
    """Where places lie in the frame of an origin: metres to the east, to the north, and up.

    Up is the normal of the ellipsoid at the origin, so that far places lie below the plane although they are as high. Computed
    in double precision; degrees in single precision are a metre coarse.

    Args:
        place: Latitude and longitude in degrees, height above the ellipsoid in metres.
        origin: The same of the point that becomes zero.

    Example:
        >>> import torch, torchsfm
        >>> lund = torch.tensor([55.704, 13.191, 50.0], dtype=torch.float64)
        >>> north = lund + torch.tensor([0.001, 0.0, 0.0])
        >>> torchsfm.geometry.enu_from_geodetic(north, lund).round(decimals=1) + 0.0
        tensor([  0.0000, 111.4000,   0.0000], dtype=torch.float64)
    """
    check_tensors(place=(place, "3"), origin=(origin, "3"))
    start = origin.double()
    gap = _earth_from_geodetic(place.double()) - _earth_from_geodetic(start)
    return (_enu_axes(start) @ gap[..., None])[..., 0].to(place.dtype)


def geodetic_from_enu(X: Float[Tensor, "*#batch 3"], origin: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch 3"]:
    """Latitude and longitude in degrees and height in metres of points in the frame of an origin.

    The inverse of `enu_from_geodetic`, exact to rounding for heights from -100 km to 1000 km.

    Args:
        X: Metres to the east, to the north, and up.
        origin: Latitude, longitude (degrees) and height (metres) of zero.

    Example:
        >>> import torch, torchsfm
        >>> lund = torch.tensor([55.704, 13.191, 50.0], dtype=torch.float64)
        >>> east = torch.tensor([1000.0, 0.0, 0.0], dtype=torch.float64)
        >>> torchsfm.geometry.geodetic_from_enu(east, lund)  # the Earth falls away by 8 cm
        tensor([55.7040, 13.2069, 50.0782], dtype=torch.float64)
    """
    check_tensors(X=(X, "3"), origin=(origin, "3"))
    start = origin.double()
    earth = _earth_from_geodetic(start) + (_enu_axes(start).mT @ X.double()[..., None])[..., 0]
    return _geodetic_from_earth(earth).to(X.dtype)


def _radius(sine: Tensor) -> Tensor:
    """Radius of curvature across the meridian."""
    return SEMI_MAJOR / (1 - ECCENTRICITY2 * sine.square()).sqrt()


def _earth_from_geodetic(place: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Metres from the earth's centre: towards (0, 0), (0, 90 E) and the north pole."""
    latitude, longitude, height = place[..., 0].deg2rad(), place[..., 1].deg2rad(), place[..., 2]
    sine, N = latitude.sin(), _radius(latitude.sin())
    out = (N + height) * latitude.cos()
    return torch.stack((out * longitude.cos(), out * longitude.sin(), (N * (1 - ECCENTRICITY2) + height) * sine), -1)


def _geodetic_from_earth(earth: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """The place whose normal of the ellipsoid passes through a point, by Bowring's iteration (1976)."""
    x, y, z = earth.unbind(-1)
    out = torch.hypot(x, y)
    # The reduced latitude, on the sphere that the ellipsoid is flattened from.
    reduced = torch.atan2(z, (1 - FLATTENING) * out)
    second = ECCENTRICITY2 / (1 - FLATTENING)
    for _ in range(ROUNDS):
        up = z + second * SEMI_MAJOR * reduced.sin() ** 3
        across = out - ECCENTRICITY2 * SEMI_MAJOR * reduced.cos() ** 3
        latitude = torch.atan2(up, across)
        reduced = torch.atan2((1 - FLATTENING) * latitude.sin(), latitude.cos())
    sine, cosine = latitude.sin(), latitude.cos()
    height = out * cosine + z * sine - SEMI_MAJOR * (1 - ECCENTRICITY2 * sine.square()).sqrt()
    return torch.stack((latitude.rad2deg(), torch.atan2(y, x).rad2deg(), height), -1)


def _enu_axes(origin: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The directions of east, north and up from the earth's centre, as rows."""
    latitude, longitude = origin[..., 0].deg2rad(), origin[..., 1].deg2rad()
    (s, c), (sl, cl) = (latitude.sin(), latitude.cos()), (longitude.sin(), longitude.cos())
    zero = torch.zeros_like(s)
    east = torch.stack((-sl, cl, zero), -1)
    north = torch.stack((-s * cl, -s * sl, c), -1)
    up = torch.stack((c * cl, c * sl, s), -1)
    return torch.stack((east, north, up), -2)
