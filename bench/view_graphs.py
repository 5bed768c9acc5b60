"""View graphs with known cameras, of the seven ways of taking photographs that ViewGraphBench has, by a simpler simulation.

Cameras stand and look as the name of the family says; pairs are the nearest in place and viewing direction and the three next
ones in the order of acquisition; the number of matches falls with the angle between the views, and the error of a relative pose
with its square root, by a factor of its own for each edge. Wrong edges are random ones, of those with few matches most, or,
where there is repeated structure, consistent ones: the pose relative to where a camera would be after a symmetry of the scene.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchsfm.geometry import Pose, random_rotation, rotation_from_rotvec

NEAREST, NEXT = 20, 3
"""Partners of each camera: those nearest to it, and those after it."""
MOST_MATCHES, LEAST_MATCHES = 400.0, 20.0
"""Of a pair of equal views, and of any."""
FALLS = math.radians(40)
"""The angle between two views over which matches fall by a factor of e."""
EACH, AROUND, SEEN = 400, 24, 0.5
"""Observations of an image, about; the cameras near one that may see a point, and how often each does."""
ERROR = 0.03
"""Standard deviation of a coordinate of an edge's rotation for a single match, radians: one pixel of 1,200, and geometry."""
SPREAD = 0.4
"""Standard deviation of the logarithm of each edge's own factor."""


@dataclass(frozen=True)
class ViewGraphTruth:
    """A view graph and its truth.

    Attributes:
        poses: Of the cameras.
        edges: Pairs of them.
        R: Their relative rotations as measured.
        deviation: The standard deviation that each is said to have, radians.
        wrong: Which are wrong.
    """

    poses: Pose
    edges: Tensor
    R: Tensor
    deviation: Tensor
    wrong: Tensor


def look(centre: Tensor, target: Tensor, roll: Tensor) -> Tensor:
    """Rotations of cameras that look at a point, upright but for a roll."""
    z = torch.nn.functional.normalize(target - centre, dim=-1)
    x = torch.nn.functional.normalize(torch.linalg.cross(z, torch.tensor([0.0, 0.0, 1.0]).to(z).expand_as(z)), dim=-1)
    upright = torch.stack((x, torch.linalg.cross(z, x), z), -2)
    return rotation_from_rotvec(roll[:, None] * torch.tensor([0.0, 0.0, 1.0]).to(z)) @ upright


Cameras = tuple[Tensor, Tensor]
"""Centres, and what they look at."""


def orbit(n: int, g: torch.Generator) -> Cameras:
    """A ring around an object."""
    a = 2 * math.pi * torch.arange(n, dtype=torch.float64) / n
    centre = torch.stack((a.cos(), a.sin(), torch.full_like(a, 0.3)), -1) * 5
    return centre, 0.3 * torch.randn(n, 3, generator=g, dtype=torch.float64)


def dome(n: int, g: torch.Generator) -> Cameras:
    """Rings at several heights over a hemisphere: a spiral."""
    k = torch.arange(n, dtype=torch.float64)
    height = 0.05 + 0.9 * k / n
    a = k * 2 * math.pi / max(math.sqrt(n), 1.0)
    flat = (1 - height.square()).sqrt()
    return 5 * torch.stack((flat * a.cos(), flat * a.sin(), height), -1), 0.3 * torch.randn(
        n, 3, generator=g, dtype=torch.float64
    )


def corridor(n: int, g: torch.Generator) -> Cameras:
    """Forward motion along a street."""
    k = torch.arange(n, dtype=torch.float64)
    centre = torch.stack((k, 0.2 * torch.randn(n, generator=g, dtype=torch.float64), 1.6 + 0 * k), -1)
    return centre, centre + torch.tensor([5.0, 0, 0]).double() + 0.5 * torch.randn(n, 3, generator=g, dtype=torch.float64)


def lawnmower(n: int, g: torch.Generator) -> Cameras:
    """An aerial survey in strips, looking down."""
    width = max(round(math.sqrt(n)), 1)
    k = torch.arange(n)
    row, column = k // width, k % width
    column = torch.where(row % 2 == 1, width - 1 - column, column)
    noise = 0.1 * torch.randn(n, 3, generator=g, dtype=torch.float64)
    centre = torch.stack((column.double(), row.double(), torch.full((n,), 3.0).double()), -1) + noise
    return centre, centre * torch.tensor([1, 1, 0]) + 0.3 * torch.randn(n, 3, generator=g, dtype=torch.float64)


def crowd(n: int, g: torch.Generator) -> Cameras:
    """Unordered photographs of a landmark, from a half-circle of places that people like."""
    spots = math.pi * torch.rand(max(n // 50, 4), generator=g, dtype=torch.float64)
    a = spots[torch.randint(len(spots), (n,), generator=g)] + 0.1 * torch.randn(n, generator=g, dtype=torch.float64)
    r = 4 + 3 * torch.rand(n, generator=g, dtype=torch.float64)
    centre = torch.stack((r * a.cos(), r * a.sin(), 1.6 + 0.3 * torch.randn(n, generator=g, dtype=torch.float64)), -1)
    return centre, torch.randn(n, 3, generator=g, dtype=torch.float64)


def walk(n: int, g: torch.Generator) -> Cameras:
    """Hand-held motion in a room as large as it takes, looking around."""
    side = max(math.sqrt(n) / 4, 2.0)
    step = torch.randn(n, 2, generator=g, dtype=torch.float64).cumsum(0) * 0.3
    # Reflected at the walls.
    place = (step % (4 * side) - 2 * side).abs() - side
    turn = (0.1 * torch.randn(n, generator=g, dtype=torch.float64)).cumsum(0)
    centre = torch.cat((place, torch.full((n, 1), 1.6, dtype=torch.float64)), -1)
    return centre, centre + torch.stack((turn.cos(), turn.sin(), 0 * turn), -1)


def manhattan(n: int, g: torch.Generator) -> Cameras:
    """A vehicle on a grid of streets, which turns at random and comes back to where it was."""
    block, side = 20, max(round(math.sqrt(n) / 20), 2)
    ways = torch.tensor([[1, 0], [0, 1], [-1, 0], [0, -1]])
    at, way, places, looks = torch.tensor([side // 2, side // 2]), 0, [], []
    turns = torch.randint(-1, 2, (n // block + 1,), generator=g).tolist()
    for turn in turns:
        for k in range(4):
            new = (way + turn + k) % 4
            if bool(((at + ways[new] >= 0) & (at + ways[new] < side)).all()):
                way = new
                break
        steps = torch.arange(block)[:, None] / block
        places.append(block * (at + steps * ways[way]))
        looks.append(ways[way].double().expand(block, 2))
        at = at + ways[way]
    centre, ahead = torch.cat(places)[:n].double(), torch.cat(looks)[:n]
    centre = torch.cat(
        (centre + 0.3 * torch.randn(n, 2, generator=g, dtype=torch.float64), torch.full((n, 1), 1.6).double()), -1
    )
    return centre, centre + torch.cat((5 * ahead, 0.2 * torch.randn(n, 1, generator=g, dtype=torch.float64)), -1)


FAMILIES: dict[str, Callable[[int, torch.Generator], Cameras]] = {
    "orbit": orbit, "dome": dome, "corridor": corridor, "lawnmower": lawnmower, "crowd": crowd, "walk": walk,
    "manhattan": manhattan,
}  # fmt: skip
DEPTH = {"orbit": 4.0, "dome": 4.0, "corridor": 8.0, "lawnmower": 3.0, "crowd": 5.0, "walk": 2.5, "manhattan": 8.0}
"""How far away what the cameras of a family see is, about."""


def stand(family: str, views: int, generator: torch.Generator) -> Pose:
    """The poses of a number of cameras of a family."""
    centre, target = FAMILIES[family](views, generator)
    R = look(centre, target, 0.1 * torch.randn(views, generator=generator, dtype=torch.float64))
    return Pose(R, -(R @ centre[..., None])[..., 0])


def nearest_cameras(poses: Pose, count: int) -> Tensor:
    """The numbers of the cameras nearest to each in place and viewing direction, itself the first."""
    centre = poses.centre
    # Half a radian counts as much as four steps.
    step = float((centre[1:] - centre[:-1]).norm(dim=-1).median()) if len(centre) > 1 else 1.0
    place = torch.cat((centre / (4 * step), 2 * poses.R[:, 2]), -1).numpy()
    _, near = cKDTree(place).query(place, k=min(count + 1, len(centre)))
    return torch.from_numpy(near)


@dataclass(frozen=True)
class Looks:
    """Points X and the image points x, without errors, at which cameras see them."""

    poses: Pose
    X: Tensor
    x: Tensor
    view: Tensor
    point: Tensor


def look_around(family: str, views: int, focal: float, size: tuple[int, int], *, generator: torch.Generator) -> Looks:
    """What the cameras of a family see: points at random before one of them, seen by some of those around it."""
    poses = stand(family, views, generator)
    count = round(views * EACH / (AROUND * SEEN * 0.7))
    own = torch.arange(count) % views
    middle, limits = (torch.tensor(size) - 1) / 2, torch.tensor(size)
    x = torch.rand(count, 2, generator=generator, dtype=torch.float64) * limits
    depth = DEPTH[family] * (0.7 + 0.6 * torch.rand(count, 1, generator=generator, dtype=torch.float64))
    local = depth * torch.cat(((x - middle) / focal, torch.ones(count, 1).double()), -1)
    X = (poses.R[own].mT @ (local - poses.t[own])[..., None])[..., 0]
    view = nearest_cameras(poses, AROUND - 1)[own]
    point = torch.arange(count)[:, None].expand_as(view)
    seen = torch.rand(view.shape, generator=generator) < SEEN
    view, point = view[seen], point[seen]
    at = (poses.R[view] @ X[point][..., None])[..., 0] + poses.t[view]
    x = at[:, :2] / at[:, 2:] * focal + middle
    inside = (at[:, 2] > 0) & (x >= 0).all(-1) & (x < limits).all(-1)
    return Looks(poses, X, x[inside], view[inside], point[inside])


def make_view_graph(
    family: str, views: int, *, outliers: float = 0.1, symmetric: float = 0.0, seed: int = 0, nearest: int = NEAREST
) -> ViewGraphTruth:
    """A view graph of a family.

    Args:
        family: One of `FAMILIES`.
        views: Number of cameras.
        outliers: The part of edges whose rotation is random.
        symmetric: The part of edges from the first half of the cameras to the second that say the same wrong thing: that the
            second half is turned by a quarter, as a scene of fourfold symmetry lets it look.
        seed: Of everything.
        nearest: Partners of each camera that are nearest to it.
    """
    g = torch.Generator().manual_seed(seed)
    poses = stand(family, views, g)
    R, near = poses.R, nearest_cameras(poses, nearest)
    own = torch.arange(views)[:, None].expand_as(near)
    following = [torch.stack((torch.arange(views - k), torch.arange(k, views)), -1) for k in range(1, min(NEXT + 1, views))]
    edges = torch.cat([torch.stack((own, near), -1).reshape(-1, 2), *following])
    edges = torch.unique(edges.sort(dim=1).values, dim=0)
    edges = edges[edges[:, 0] != edges[:, 1]]
    i, j = edges.unbind(-1)
    angle = torch.acos((R[i, 2] * R[j, 2]).sum(-1).clamp(-1, 1))
    matches = (MOST_MATCHES * (-angle / FALLS).exp() * torch.rand(len(edges), generator=g, dtype=torch.float64)).clamp(
        min=LEAST_MATCHES
    )
    deviation = ERROR / matches.sqrt()
    own_factor = (SPREAD * torch.randn(len(edges), generator=g, dtype=torch.float64)).exp()
    noise = (deviation * own_factor)[:, None] * torch.randn(len(edges), 3, generator=g, dtype=torch.float64)
    measured = rotation_from_rotvec(noise) @ R[j] @ R[i].mT
    chance = outliers * len(edges) * (1 / matches) / (1 / matches).sum()
    wrong = torch.rand(len(edges), generator=g) < chance
    measured = torch.where(wrong[:, None, None], random_rotation(len(edges), generator=g, dtype=torch.float64), measured)
    if symmetric:
        alike = torch.rand(len(edges), generator=g) < symmetric
        quarter = rotation_from_rotvec(torch.tensor([0.0, 0.0, math.pi / 2], dtype=torch.float64))
        across = (i < views // 2) & (j >= views // 2) & alike & ~wrong
        measured = torch.where(across[:, None, None], rotation_from_rotvec(noise) @ R[j] @ quarter @ R[i].mT, measured)
        wrong = wrong | across
    return ViewGraphTruth(poses, edges, measured, deviation, wrong)
