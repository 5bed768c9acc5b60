"""Which way is up, and where is the ground? From how people hold cameras, and from the points."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Similarity, rotation_from_rotvec
from torchsfm.linalg import eigh
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.reconstruction import Reconstruction

CAP = math.radians(15)
"""A camera rolled by more than this was not held level on purpose."""
LEAST_ROLL = math.radians(1.5)
"""Nobody holds a camera more level than this, as a standard deviation."""
MOST_OPEN = math.radians(6)
"""Standard deviation beyond which the direction is not known."""
AGREEING = 2 / 3
"""The least share of the cameras that must be held level."""
PARALLEL, STEADY, CANCELLED = 0.9, 0.7, 0.3
"""For guesses: shares of their squares that directions have in common or not, and length of a mean that says nothing."""
MOST_PAIRS = 2000
SAMPLES, SETTLING = 500, 10
TOLERANCE = 0.01
"""Of the ground, over the median distance of points from the cameras that see them; a scene's ground is not flatter."""
STEEPEST = math.radians(15)
"""Of the ground against the level that cameras tell."""
LEAST_POINTS, LEAST_SHARE = 20, 0.03


@dataclass(frozen=True)
class Levelling:
    """The turn and shift that make z point up; with a ground, z = 0 is on it.

    Attributes:
        similarity: Of scale 1. Its status is `TOO_FEW` or `DEGENERATE` where nothing tells.
        roll: By how much the x axis of each registered camera is off the level, radians.
        held: The cameras that were held level; those turned on their side, say, were not.
        sigma: Standard deviation of the upward direction, radians.
        ground: The points that lie on the ground, where that was looked for.
        why: Why the direction, or the ground, is not known; empty where it is.

    Example:
        >>> import dataclasses, torch, torchsfm
        >>> poses = torchsfm.simulation.orbit_poses(8, radius=5.0)  # the world's z points up
        >>> problem = torchsfm.random_bundle_problem(8, 20, 100, generator=torch.Generator().manual_seed(0)).truth
        >>> torchsfm.write_model(problem, "model.npz")
        >>> tilted = torchsfm.geometry.rotation_from_rotvec(torch.tensor([0.3, 0.0, 0.0]).double())
        >>> model = dataclasses.replace(torchsfm.read_model("model.npz"), poses=torchsfm.Pose(poses.R @ tilted, poses.t))
        >>> level = torchsfm.reconstruction.align_upright(model)
        >>> bool((level.similarity.R @ tilted.mT)[2, 2] > 0.999), bool(level.roll.abs().max() < 1e-6)
        (True, True)
    """

    similarity: Similarity
    roll: Float[Tensor, "v"]
    held: Bool[Tensor, "v"]
    sigma: float
    ground: Bool[Tensor, "n"] | None = None
    why: str = ""

    def summary(self) -> str:
        """One line for people."""
        roll = math.degrees(float(self.roll[self.held].square().mean().sqrt()))
        text = f"z points up, known to {math.degrees(self.sigma):.2g} degrees"
        text += f", from {int(self.held.sum())} of {len(self.held)} cameras that are {roll:.2g} degrees off the level (RMS)"
        if self.ground is None:
            return text
        return f"z = 0 is the ground, of {int(self.ground.sum())} of {len(self.ground)} points, and z points up"

    def fault(self) -> str:
        """Why the direction is not known; empty where it is."""
        return self.why


@on_the_cpu
def align_upright(model: Reconstruction) -> Levelling:
    """Turn a model so that z points up, as far as those who held the camera kept its x axis level.

    The direction is the one to which most x axes are at right angles; cameras that were turned on their side, or rolled by
    more than 15 degrees, do not count. Photographs with their orientation in Exif are read upright, so that such cameras are
    few. The origin comes to the middle of the cameras. Photographs that all look the same way leave the tilt open, which
    `fault` tells.

    Args:
        model: The model; it takes two registered images.

    Example:
        >>> import torch, torchsfm
        >>> poses = torchsfm.simulation.orbit_poses(8, radius=5.0)  # the world's z points up
        >>> problem = torchsfm.random_bundle_problem(8, 20, 100, generator=torch.Generator().manual_seed(0)).truth
        >>> torchsfm.write_model(problem, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> import dataclasses
        >>> level = torchsfm.reconstruction.align_upright(dataclasses.replace(model, poses=poses))
        >>> level.fault(), level.similarity.R[2].round(decimals=6)
        ('', tensor([0., 0., 1.], dtype=torch.float64))
    """
    model = model.to("cpu", torch.float64)
    R, centre = model.poses.R[model.registered], model.poses.centre[model.registered]
    x, down, forward = R.unbind(-2)
    v = len(R)
    if v < 2:
        return _unknown(v, Status.TOO_FEW, f"{v} registered images, two are the least that tell which way is up")
    pair = torch.combinations(torch.arange(v), 2)
    if len(pair) > MOST_PAIRS:
        pair = pair[torch.linspace(0, len(pair) - 1, MOST_PAIRS).round().long()]
    normal = torch.linalg.cross(x[pair[:, 0]], x[pair[:, 1]])
    length = normal.norm(dim=-1, keepdim=True)
    normal = normal / length.clamp(min=1e-12)
    roll = (normal @ x.T).clamp(-1, 1).asin().abs()
    cost = torch.where(length[:, 0] > 1e-9, roll.clamp(max=CAP).square().sum(-1), torch.inf)
    up = normal[cost.argmin()]
    for _ in range(SETTLING):
        held = (x @ up).clamp(-1, 1).asin().abs() < CAP
        values, vectors = eigh(x[held].T @ x[held])[:2]
        up = vectors[:, 0]
    up = up * (-(down + 0.5 * forward) @ up).sum().sign()
    roll = (x @ up).clamp(-1, 1).asin()
    held = roll.abs() < CAP
    count = int(held.sum())
    off = max(LEAST_ROLL, float((roll[held].square().sum() / max(count - 2, 1)).sqrt()))
    # The direction turns about the axis along which most x axes lie; the others hold it.
    spread = float(values[1].clamp(min=0).sqrt())
    sigma = off / max(spread, 1e-9)
    if sigma > MOST_OPEN or spread < 2 * off * math.sqrt(count) or not bool(cost.isfinite().any()):
        return _unknown(v, Status.DEGENERATE, "all photographs look the same way, which leaves open how much they are tilted")
    if count < AGREEING * v:
        return _unknown(v, Status.DEGENERATE, f"only {count} of {v} cameras agree on which way is up")
    return Levelling(_upright(up, centre.mean(0)), roll, held, sigma)


@on_the_cpu
def up_direction(model: Reconstruction) -> Float[Tensor, "3"]:
    """Which way is up, for showing a model: as `align_upright` has it or, where that is not known, by the best guess.

    Photographs that lie on their side, all x axes parallel and the other ones not, have up along these, at the end from which
    they look down. Else up is the mean of the cameras' up directions; where these cancel but all look the same way, as from an
    aeroplane, it is against the view. Without registered images it is the world's z axis.

    Args:
        model: The model, of whose images only the poses are looked at.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> torchsfm.reconstruction.up_direction(torchsfm.read_model("model.npz")).norm()
        tensor(1., dtype=torch.float64)
    """
    level = align_upright(model)
    if not level.fault():
        return level.similarity.R[2]
    rows = model.poses.R[model.registered].to("cpu", torch.float64)
    if not len(rows):
        return rows.new_tensor([0.0, 0.0, 1.0])
    right, up, forward = rows[:, 0], -rows[:, 1], rows[:, 2]
    mean, view = up.mean(0), forward.mean(0)
    values, vectors = eigh(right.mT @ right / len(right))[:2]
    steadiness = float(eigh(up.mT @ up / len(up))[0][2])
    if float(values[2]) > PARALLEL and steadiness < STEADY:
        found = vectors[:, 2] * -torch.sign(vectors[:, 2] @ view - 1e-12)
    elif float(mean.norm()) >= CANCELLED:
        found = mean
    elif float(view.norm()) > STEADY:
        found = -view
    else:
        found = vectors[:, 0] * torch.sign(vectors[:, 0] @ mean + 1e-12)
    return torch.nn.functional.normalize(found, dim=0)


@on_the_cpu
def align_to_ground(model: Reconstruction, *, generator: torch.Generator | None = None) -> Levelling:
    """Turn and shift a model so that z points up and z = 0 is the ground on which it stands.

    The ground is the plane, level within 15 degrees by `align_upright`, on which most points lie and beneath which hardly any
    do, all cameras above; points count as on it within a hundredth of the distance from which they are seen. The origin comes
    below the middle of the cameras.

    Args:
        model: The model.
        generator: Source of the samples that are tried; the same ones each time if not given.

    Example:
        >>> import torch, torchsfm
        >>> from dataclasses import replace
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(8, 300, 900, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> X = torch.rand(300, 3, dtype=torch.float64, generator=g)
        >>> X[:, 2] = (X[:, 2] + 0.2).where(torch.arange(300) >= 200, 0.0)  # 200 points on the ground, 100 above it
        >>> model = replace(model, poses=torchsfm.simulation.orbit_poses(8, radius=5.0), X=X - 0.5)
        >>> level = torchsfm.reconstruction.align_to_ground(model)
        >>> level.fault(), int(level.ground.sum())
        ('', 200)
        >>> bool(level.similarity.transform(model.X)[:200, 2].abs().max() < 1e-6)
        True
    """
    level = align_upright(model)
    if level.fault():
        return level
    generator = generator or torch.Generator().manual_seed(0)
    model = model.to("cpu", torch.float64)
    centre = model.poses.centre[model.registered]
    X, c = level.similarity.transform(model.X), level.similarity.transform(centre)
    n, v = len(X), len(c)
    if n < LEAST_POINTS:
        return _unknown(v, Status.TOO_FEW, f"{n} points are too few to find the ground")
    tolerance = TOLERANCE * float((model.X[model.point] - model.poses.centre[model.view]).norm(dim=-1).median())

    plane = _find_ground(X, tolerance, generator)
    if plane is None or float(((c - plane.middle) @ plane.up > 0).double().mean()) < 0.9:
        return _unknown(v, Status.DEGENERATE, "no level plane below the cameras holds enough of the points")
    foot = c.mean(0)
    onto = _upright(plane.up, foot - ((foot - plane.middle) @ plane.up) * plane.up)
    R = onto.R @ level.similarity.R
    whole = Similarity(onto.scale, R, onto.R @ level.similarity.t + onto.t, onto.status)
    return replace(level, similarity=whole, ground=plane.on)


@dataclass(frozen=True)
class _Plane:
    """A plane through a point, and the points that lie on it."""

    up: Float[Tensor, "3"]
    middle: Float[Tensor, "3"]
    on: Bool[Tensor, "n"]


def _find_ground(X: Float[Tensor, "n 3"], tolerance: float, generator: torch.Generator) -> _Plane | None:
    """The nearly level plane that holds most points, less twice those beneath it; z points up, roughly."""

    def support(height: Float[Tensor, "k n"], width: float) -> Tensor:
        score: Tensor = (height.abs() < width).sum(-1) - 2 * (height < -width).sum(-1)
        return score

    n, wide = len(X), 3 * tolerance
    heights = X[torch.linspace(0, n - 1, min(n, SAMPLES)).round().long(), 2]
    base = heights[support(X[:, 2] - heights[:, None], wide).argmax()]
    near = X[(X[:, 2] - base).abs() < wide]
    triple = near[torch.randint(len(near), (SAMPLES, 3), generator=generator)]
    normal = torch.linalg.cross(triple[:, 1] - triple[:, 0], triple[:, 2] - triple[:, 0])
    normal = torch.nn.functional.normalize(normal * normal[:, 2:].sign(), dim=-1)
    height = normal @ X.T - (triple[:, 0] * normal).sum(-1, keepdim=True)
    level = normal[:, 2] > math.cos(STEEPEST)
    best = torch.where(level, support(height, tolerance), -3 * n).argmax()
    up, middle, on = normal[best], triple[best, 0], height[best].abs() < tolerance
    values = torch.zeros(3, dtype=X.dtype)
    for _ in range(SETTLING):
        middle = X[on].mean(0) if bool(on.any()) else middle
        values, vectors = eigh((X[on] - middle).T @ (X[on] - middle))[:2]
        up = vectors[:, 0] * vectors[2, 0].sign()
        on = ((X - middle) @ up).abs() < tolerance
    count = int(on.sum())
    enough = count >= max(LEAST_POINTS, LEAST_SHARE * n) and float(up[2]) > math.cos(STEEPEST)
    # Points on a line leave the plane about it open.
    broad = float(values[1]) > (3 * tolerance) ** 2 * count
    return _Plane(up, middle, on) if bool(level.any()) and enough and broad else None


def _upright(up: Float[Tensor, "3"], origin: Float[Tensor, "3"]) -> Similarity:
    """The least turn that makes a direction z, about an origin that becomes zero."""
    axis = torch.linalg.cross(up, torch.tensor([0.0, 0.0, 1.0], dtype=up.dtype))
    sine = float(axis.norm())
    # What points down may turn about any level axis.
    axis = axis / sine if sine > 1e-12 else torch.tensor([1.0, 0.0, 0.0], dtype=up.dtype)
    R = rotation_from_rotvec(math.atan2(sine, float(up[2])) * axis)
    one = torch.ones((), dtype=up.dtype)
    return Similarity(one, R, -(R @ origin), torch.tensor(int(Status.OK), dtype=torch.int8))


def _unknown(v: int, status: Status, why: str) -> Levelling:
    """Nothing tells which way is up."""
    one, eye = torch.ones((), dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    similarity = Similarity(one, eye, torch.zeros(3, dtype=torch.float64), torch.tensor(int(status), dtype=torch.int8))
    return Levelling(similarity, torch.zeros(v, dtype=torch.float64), torch.zeros(v, dtype=torch.bool), math.inf, None, why)
