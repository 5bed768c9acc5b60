"""Rectangular grids among points of a plane that is seen in perspective."""

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.linalg import inverse, null_vector

_SIZES = 1.0
"""Largest logarithm of the ratio of the areas of neighbours."""
_SQUARE = 0.5
"""Largest cosine of the angle between the two directions, and largest logarithm of the ratio of the two lengths, where what
is seen of the point makes a circle round."""
_NEAR = 0.25
"""Distance from where the grid has a point, in units of the distance between neighbours."""
_STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))


def grid_in_points(
    x: Float[Tensor, "n 2"], D: Float[Tensor, "n 2 2"], columns: int, rows: int
) -> Int[Tensor, " points"] | None:
    """The points of a grid of ellipses, row by row; None where there is no grid of just that size.

    Args:
        x: The centres, more likely ones first.
        D: Their shapes, see `shape_of_ellipse`: what makes each one round shows the grid around it nearly without perspective.
        columns: Points in a row.
        rows: Points in a column.
    """
    if len(x) < rows * columns:
        return None
    orders = (_ordered(places, columns, rows) for places in _grids(x, D))
    return next((order for order in orders if order is not None), None)


def grid_size(x: Float[Tensor, "n 2"], D: Float[Tensor, "n 2 2"], least: int) -> tuple[int, int] | None:
    """Points along the longer and the shorter side of the largest full grid of ellipses, at least so many; None without one."""
    sizes = []
    for places in _grids(x, D):
        short, long = sorted(max(k) - min(k) + 1 for k in zip(*places, strict=True))
        if short >= least and len(places) == short * long:
            sizes.append((long, short))
    return max(sizes, key=lambda size: size[0] * size[1], default=None)


def _grids(x: Tensor, D: Tensor) -> Iterator[dict[tuple[int, int], int]]:
    """Points by places of one grid after the other, those around more likely points first."""
    x, D = x.cpu(), D.cpu()
    area = D.det().sqrt()
    tried = torch.zeros(len(x), dtype=torch.bool)
    for seed in range(len(x)):
        if tried[seed]:
            continue
        like = ((area / area[seed]).log().abs() < 2.5).nonzero()[:, 0]
        places = _grown(x, D[seed], area, seed, like)
        if places is None:
            continue
        yield places
        # Another seed of the same grid gives the same.
        tried[list(places.values())] = True


def grid_homography(x: Float[Tensor, "n 2"], columns: int) -> Float[Tensor, "3 3"]:
    """From places (column, row) to the points of a grid, row by row, by least squares."""
    own = torch.arange(len(x), device=x.device)
    return _homography(torch.stack((own % columns, own // columns), -1).to(x), x)


def _grown(x: Tensor, D: Tensor, area: Tensor, seed: int, like: Tensor) -> dict[tuple[int, int], int] | None:
    """Points by places in a grid around the seed."""
    round_ = torch.linalg.inv_ex(torch.linalg.cholesky_ex(D).L).inverse
    away = (x[like] - x[seed]) @ round_.mT
    distance = away.norm(dim=-1)
    similar = (area[like] / area[seed]).log().abs() < 0.7
    near = torch.where((like != seed) & similar & (distance > 2), distance, torch.inf)
    if len(near) < 3:
        return None
    first = int(near.argmin())
    if not float(near[first]) < 50:
        return None
    along = away[first]
    # The other direction: across the first, about as long.
    cosine = (away @ along / (distance * along.norm()).clamp_min(1e-12)).abs()
    length = (distance / along.norm()).clamp_min(1e-12).log().abs()
    fits = near.isfinite() & (cosine < _SQUARE) & (length < _SQUARE)
    if not bool(fits.any()):
        return None
    second = int(torch.where(fits, cosine + length, torch.inf).argmin())
    places = {(0, 0): seed, (1, 0): int(like[first]), (0, 1): int(like[second])}
    free = set(like.tolist()) - set(places.values())
    refused: set[tuple[int, int]] = set()
    while True:
        site = next((s for s in _around(places) if s not in refused), None)
        if site is None:
            return places
        guess, pitch = _guess(x, places, site)
        candidates = torch.tensor(sorted(free), dtype=torch.long)
        off = (x[candidates] - guess).norm(dim=-1) if free else torch.full((1,), torch.inf)
        best = int(off.argmin())
        if float(off[best]) < _NEAR * pitch and _alike(area, int(candidates[best]), places, site):
            places[site] = int(candidates[best])
            free.remove(places[site])
            refused.clear()
        else:
            refused.add(site)


def _around(places: dict[tuple[int, int], int]) -> list[tuple[int, int]]:
    """Places next to the grid's, those with the most neighbours first."""
    count: dict[tuple[int, int], int] = {}
    for i, j in places:
        for di, dj in _STEPS:
            if (i + di, j + dj) not in places:
                count[i + di, j + dj] = count.get((i + di, j + dj), 0) + 1
    return sorted(count, key=lambda site: (-count[site], site[0] ** 2 + site[1] ** 2, site))


def _guess(x: Tensor, places: dict[tuple[int, int], int], site: tuple[int, int]) -> tuple[Tensor, float]:
    """Where a place is, and the distance to its neighbours, by the nearest known ones."""
    known = sorted(places, key=lambda p: ((p[0] - site[0]) ** 2 + (p[1] - site[1]) ** 2, p))[:12]
    grid = torch.tensor(known, dtype=x.dtype) - torch.tensor(site, dtype=x.dtype)
    points = x[[places[p] for p in known]]
    wide = min(len({p[k] for p in known}) for k in (0, 1)) >= 2 and len(known) >= 6
    if wide:
        H = _homography(grid, points)
        if abs(float(H[2, 2])) > 1e-3:
            guess = H[:2, 2] / H[2, 2]
            step = min((points - guess).norm(dim=-1).tolist())
            return guess, step
    rows = torch.cat((grid, torch.ones_like(grid[:, :1])), -1)
    inverted, _ = inverse(rows.mT @ rows)
    affine = inverted @ (rows.mT @ points)
    return affine[2], float(affine[:2].norm(dim=-1).min())


def _alike(area: Tensor, new: int, places: dict[tuple[int, int], int], site: tuple[int, int]) -> bool:
    beside = [places[site[0] + a, site[1] + b] for a, b in _STEPS if (site[0] + a, site[1] + b) in places]
    return all(float((area[new] / area[k]).log().abs()) < _SIZES for k in beside)


def _ordered(places: dict[tuple[int, int], int], columns: int, rows: int) -> Tensor | None:
    i, j = zip(*places, strict=True)
    width, height = max(i) - min(i) + 1, max(j) - min(j) + 1
    if len(places) != rows * columns or sorted((width, height)) != sorted((columns, rows)):
        return None
    if width == columns:
        keys = [(a, b) for b in range(min(j), max(j) + 1) for a in range(min(i), max(i) + 1)]
    else:
        keys = [(a, b) for a in range(min(i), max(i) + 1) for b in range(min(j), max(j) + 1)]
    return torch.tensor([places[key] for key in keys])


def _homography(x: Tensor, y: Tensor) -> Tensor:
    """From points x to points y (n, 2), by least squares in normalised coordinates."""
    frames = []
    for v in (x, y):
        mean = v.mean(0)
        size = (v - mean).norm(dim=-1).mean().clamp_min(1e-12)
        T = torch.eye(3, dtype=v.dtype, device=v.device) / size
        T[:2, 2], T[2, 2] = -mean / size, 1.0
        frames.append((T, (v - mean) / size))
    (T1, u), (T2, v) = frames
    h = torch.nn.functional.pad(u, (0, 1), value=1.0)
    zero = torch.zeros_like(h)
    rows = torch.cat((torch.cat((h, zero, -v[:, :1] * h), -1), torch.cat((zero, h, -v[:, 1:] * h), -1)))
    H, _ = null_vector(rows)
    moved: Tensor = torch.linalg.inv_ex(T2).inverse @ H.reshape(3, 3) @ T1
    return moved
