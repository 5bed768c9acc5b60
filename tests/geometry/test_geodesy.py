"""Places on the earth and the frame around one of them."""

import math

import torch

from torchsfm.geometry import enu_from_geodetic, geodetic_from_enu

F64 = torch.float64


def places(count: int, generator: torch.Generator, *, height: float = 1e5) -> torch.Tensor:
    """All over the earth, its poles too."""
    unit = torch.rand(count, 3, generator=generator, dtype=F64)
    latitude, longitude = (2 * unit[:, 0] - 1).asin().rad2deg(), 360 * unit[:, 1] - 180
    return torch.stack((latitude, longitude, height * (unit[:, 2] - 0.1)), -1)


def test_there_and_back(generator: torch.Generator) -> None:
    place, origin = places(1000, generator), places(1000, generator)
    X = enu_from_geodetic(place, origin)
    back = geodetic_from_enu(X, origin)
    away = enu_from_geodetic(back, place).norm(dim=-1)
    assert float(away.max()) < 1e-6  # metres; the earth is 6e6 of them
    torch.testing.assert_close(enu_from_geodetic(origin, origin), torch.zeros(1000, 3, dtype=F64), rtol=0, atol=1e-8)


def test_radii_of_the_ellipsoid(generator: torch.Generator) -> None:
    """Small steps along meridian, parallel and plumb line are as long as the ellipsoid's radii of curvature say."""
    a, b = 6378137.0, 6356752.314245179
    origin = places(200, generator)
    origin[:, 0] = origin[:, 0].clamp(-89, 89)
    phi, h = origin[:, 0].deg2rad(), origin[:, 2]
    root = (a * phi.cos()).square() + (b * phi.sin()).square()
    M, N = (a * b) ** 2 / root**1.5, a**2 / root.sqrt()
    step = 1e-5
    for axis, length, direction in (
        (0, (M + h) * math.radians(step), 1),
        (1, (N + h) * phi.cos() * math.radians(step), 0),
        (2, torch.full_like(h, step), 2),
    ):
        moved = origin.clone()
        moved[:, axis] += step
        found = enu_from_geodetic(moved, origin)
        expected = torch.zeros_like(found)
        expected[:, direction] = length
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


def test_the_date_line_is_no_border() -> None:
    east, west = torch.tensor([[10.0, 179.9999, 0.0], [10.0, -179.9999, 0.0]], dtype=F64)
    assert abs(float(enu_from_geodetic(west, east)[0]) - 21.92) < 0.1


def test_batches_and_dtypes(generator: torch.Generator) -> None:
    place = places(6, generator).reshape(2, 3, 3)
    whole = enu_from_geodetic(place, place[:, :1])
    for i in range(2):
        for j in range(3):
            torch.testing.assert_close(whole[i, j], enu_from_geodetic(place[i, j], place[i, 0]))
    assert enu_from_geodetic(place.float(), place[:, :1].float()).dtype == torch.float32
    assert geodetic_from_enu(whole.float(), place[:, :1].float()).dtype == torch.float32
