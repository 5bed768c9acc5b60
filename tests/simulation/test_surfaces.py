"""Rays and textures on surfaces, against implicit equations and finite differences."""

import math

import pytest
import torch
from torch import Tensor

from torchsfm.geometry.rotations import random_rotation
from torchsfm.simulation.surfaces import Box, Cylinder, Ellipsoid, Rectangle, Sphere, Surface

N = 2000


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def surface(kind: str, generator: torch.Generator) -> Surface:
    axes = random_rotation(generator=generator, dtype=torch.float64)
    if kind == "rectangle":
        return Rectangle(vector(-0.5, 0.3, 0.1), 1.5 * axes[0], 2.0 * axes[1])
    if kind == "disc":
        return Rectangle(vector(-0.5, 0.3, 0.1), 1.5 * axes[0], 1.5 * axes[1], round=True)
    if kind == "box":
        return Box(vector(0.1, -0.2, 0.3), axes, vector(0.4, 0.7, 1.0))
    if kind == "sphere":
        return Sphere(vector(0.1, -0.2, 0.3), 0.8)
    if kind == "ellipsoid":
        return Ellipsoid(vector(0.1, -0.2, 0.3), axes, vector(0.5, 0.8, 1.1))
    return Cylinder(vector(0.1, -0.2, -0.5), axes, 0.6, 1.3)


def outside(thing: Surface, X: Tensor) -> Tensor:
    """How far a point is from the surface, by its equation: 0 on it, and for solids negative inside."""
    if isinstance(thing, Rectangle):
        u, v = thing.edge_u, thing.edge_v
        p, q = (u @ (X - thing.corner[:, None])) / (u @ u), (v @ (X - thing.corner[:, None])) / (v @ v)
        n = torch.linalg.cross(u, v)
        height = (n @ (X - thing.corner[:, None])).abs() / n.norm()
        rim = (
            (p - 0.5).square() + (q - 0.5).square() - 0.25
            if thing.round
            else torch.maximum((p - 0.5).abs(), (q - 0.5).abs()) - 0.5
        )
        return torch.maximum(height, rim)
    if isinstance(thing, Box):
        p = (thing.axes @ (X - thing.centre[:, None])).abs() - thing.half[:, None]
        return p.amax(0)
    if isinstance(thing, Sphere):
        return (X - thing.centre[:, None]).norm(dim=0) - thing.radius
    if isinstance(thing, Ellipsoid):
        return (thing.axes @ (X - thing.centre[:, None]) / thing.radii[:, None]).norm(dim=0) - 1
    p = thing.axes @ (X - thing.base[:, None])
    side = (p[0].square() + p[1].square()).sqrt() - thing.radius
    return torch.maximum(side.abs(), (p[2] - thing.height / 2).abs() - thing.height / 2)


KINDS = ("rectangle", "disc", "box", "sphere", "ellipsoid", "cylinder")


@pytest.mark.parametrize("kind", KINDS)
def test_rays_end_on_the_surface_and_nowhere_before(kind: str, generator: torch.Generator) -> None:
    thing = surface(kind, generator)
    origin = 3 * torch.randn(3, N, generator=generator, dtype=torch.float64)
    d = torch.randn(3, N, generator=generator, dtype=torch.float64) * 0.5 - origin
    s = thing.intersect(origin, d)
    hit = torch.isfinite(s)
    # A rectangle or disc is hit by one ray in thirty where it is seen from the side.
    assert hit.sum() > N / 100
    assert outside(thing, origin + torch.where(hit, s, 0.0) * d)[hit].abs().max() < 1e-9
    # Marching along each ray finds nothing before the hit, and nothing at all on rays that miss.
    steps = torch.linspace(0, 4, 4001, dtype=torch.float64)
    near = torch.stack([outside(thing, origin + k * d) for k in steps])
    before = steps[:, None] < torch.where(hit, s, math.inf) - 1e-9
    length = d.norm(dim=0)
    value = torch.where(before, near, math.inf)
    thin = kind in ("rectangle", "disc", "cylinder")
    if thin:
        # A thin surface is crossed between two steps: distances along the normal shrink at most as fast as the step.
        crossing = (
            (value[1:-1] < 1e-4 * length) & (steps[1:-1, None] > 1e-3) & (value[1:-1] < value[:-2]) & (value[1:-1] < value[2:])
        )
        assert crossing[:, ~hit].float().mean() < 1e-4
    else:
        started_outside = near[0] > 0
        assert (value[:, started_outside] > -1e-9).all()


@pytest.mark.parametrize("kind", KINDS)
def test_chart_gradients_are_derivatives(kind: str, generator: torch.Generator) -> None:
    thing = surface(kind, generator)
    origin = 4 * torch.nn.functional.normalize(torch.randn(3, N, generator=generator, dtype=torch.float64), dim=0)
    d = torch.randn(3, N, generator=generator, dtype=torch.float64) * 0.4 - origin
    s = thing.intersect(origin, d)
    hit = torch.isfinite(s)
    X = (origin + torch.where(hit, s, 0.0) * d)[:, hit]
    chart = thing.chart(X)
    assert torch.allclose(chart.normal.norm(dim=0), torch.ones_like(X[0]))
    for gradient in (chart.du, chart.dv):
        assert (gradient * chart.normal).sum(0).abs().max() < 1e-6
    sizes = torch.tensor(thing.sheets(), dtype=torch.float64)[chart.layer].T
    assert (chart.uv > -1e-9).all()
    assert (chart.uv < sizes + 1e-9).all()
    h = 1e-6
    tangents = torch.linalg.cross(chart.normal, torch.randn(3, X.shape[1], generator=generator, dtype=torch.float64), dim=0)
    moved = thing.chart(X + h * tangents)
    same = (moved.layer == chart.layer) & ((moved.uv - chart.uv).abs() < 1e-3).all(0)
    assert same.float().mean() > 0.99
    for i, gradient in enumerate((chart.du, chart.dv)):
        slope = (moved.uv[i] - chart.uv[i]) / h
        assert torch.allclose(slope[same], (gradient * tangents).sum(0)[same], atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_the_ball_holds_the_surface(kind: str, generator: torch.Generator) -> None:
    thing = surface(kind, generator)
    middle, radius = thing.ball()
    origin = 4 * torch.nn.functional.normalize(torch.randn(3, N, generator=generator, dtype=torch.float64), dim=0)
    d = torch.randn(3, N, generator=generator, dtype=torch.float64) * 0.4 - origin
    s = thing.intersect(origin, d)
    hit = torch.isfinite(s)
    X = (origin + torch.where(hit, s, 0.0) * d)[:, hit]
    distance = (X - middle[:, None]).norm(dim=0)
    assert (distance <= radius).all()
    assert distance.max() > 0.8 * radius


@pytest.mark.parametrize(("axis", "sign"), [(0, -1), (0, 1), (1, -1), (1, 1), (2, -1), (2, 1)])
def test_pictures_on_boxes_are_not_mirrored(axis: int, sign: int) -> None:
    box = Box(torch.zeros(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64), vector(1.0, 2.0, 3.0))
    X = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    X[axis] = sign * box.half[axis]
    chart = box.chart(X[:, None])
    outward = sign * torch.eye(3, dtype=torch.float64)[axis]
    # u right and v down in the picture: u x v points into the box.
    assert torch.allclose(torch.linalg.cross(chart.du[:, 0], chart.dv[:, 0]), -outward)
    assert int(chart.layer) == 2 * axis + (sign > 0)
