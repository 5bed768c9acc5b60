"""Models adjusted by points and curves: what curves add, and what edges that are wrong alike along curves are worth."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from torchsfm.bundle import bundle_adjust_model
from torchsfm.bundle.curves import edge_distances
from torchsfm.geometry import Camera, Pose, Radial, intrinsics, random_rotation, rotation_from_rotvec
from torchsfm.reconstruction import Curves
from torchsfm.reconstruction.curves.noise import alike, measured_weights, moved_alike, sample_weights
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.matching.track_graph import graph_from_tracks

F64 = torch.float64
VIEWS, POINTS, CURVES, SAMPLES = 6, 30, 15, 40


def make_scene(generator: torch.Generator, noise: float = 0.0, aside: Tensor | None = None) -> tuple[Mapping, Curves]:
    """The truth, but for noise of image points, and of edges `aside`, (view, curve, sample); curves are parts of helices."""

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=F64)

    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=F64)

    angle = torch.linspace(-0.5, 0.5, VIEWS, dtype=F64)
    turn = torch.stack((0.15 * torch.cos(4 * angle), angle, 0.1 * torch.sin(5 * angle)), -1)
    poses = Pose(rotation_from_rotvec(turn), torch.tensor([[0.1, -0.1, 4.0]], dtype=F64).repeat(VIEWS, 1))
    K = intrinsics(torch.tensor([700.0], dtype=F64), torch.tensor([[320.0, 240.0]], dtype=F64))
    cameras = Camera(K, Radial(torch.tensor([-0.05], dtype=F64), torch.tensor([0.0], dtype=F64)))
    X = 2 * rand(POINTS, 3) - 1
    view, point = torch.cartesian_prod(torch.arange(VIEWS), torch.arange(POINTS)).unbind(1)
    at = cameras[0].project(poses[view].transform(X[point, None])[:, 0]) + noise * randn(len(view), 2)
    size, names = torch.tensor([[640, 480]] * VIEWS), tuple(f"{v}.jpg" for v in range(VIEWS))
    graph, track = graph_from_tracks(names, size, at, view, point, rand(len(view), 3), generator=generator)
    start = Mapping.start(graph, track, cameras, torch.zeros(VIEWS, dtype=torch.long))
    mapping = dataclasses.replace(start, poses=poses, registered=torch.ones(VIEWS, dtype=torch.bool), X=X, point=track)

    axes = random_rotation(CURVES, generator=generator, dtype=F64) * torch.tensor([0.5, 0.5, 0.4])[:, None]
    centre = 1.4 * rand(CURVES, 3) - 0.7
    place = torch.linspace(0, 2, SAMPLES, dtype=F64).repeat(CURVES)
    curve = torch.arange(CURVES).repeat_interleave(SAMPLES)

    def on(t: Tensor, of: Tensor) -> Tensor:
        return centre[of] + (torch.stack((t.cos(), t.sin(), t), -1)[:, None] @ axes[of])[:, 0]

    sample, seen = torch.cartesian_prod(torch.arange(len(curve)), torch.arange(VIEWS)).unbind(1)
    there = place[sample] + 0.002 * rand(len(sample))
    h = 1e-4
    points = (on(t, curve[sample])[:, None] for t in (there - h, there, there + h))
    before, x, after = (cameras[0].project(poses[seen].transform(X))[:, 0] for X in points)
    first, second = (after - before) / (2 * h), (after - 2 * x + before) / h**2
    speed = first.norm(dim=-1)
    normal = torch.stack((-first[:, 1], first[:, 0]), -1) / speed[:, None]
    curvature = (normal * second).sum(-1) / speed.square()
    if aside is not None:
        x = x + aside.permute(1, 2, 0).flatten()[:, None] * normal
    keep = speed > 40  # where a curve runs towards a camera, its image has a cusp
    none, one = torch.zeros(len(curve), 3, dtype=F64), torch.ones(len(curve), dtype=F64)
    curves = Curves(
        on(place, curve), curve, torch.zeros(CURVES, dtype=torch.bool), none, one, x[keep], normal[keep], curvature[keep],
        torch.full((int(keep.sum()),), 4.0, dtype=F64), seen[keep], sample[keep],
    )  # fmt: skip
    return mapping, curves


def relative_error(poses: Pose, true: Pose) -> float:
    """Mean angle of relative rotations from the first view, radians."""
    turn = (poses @ poses[0].inverse()).R @ (true @ true[0].inverse()).R.mT
    return float(((turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1).acos()[1:].mean())


def adjusted(mapping: Mapping, curves: Curves | None, tolerance: float = 1e-6) -> Pose:
    model = dataclasses.replace(mapping.reconstruction(), curves=curves)
    return bundle_adjust_model(model, free=(), tolerance=tolerance, max_iterations=100).model.poses


def test_curves_hold_what_few_points_leave_open(generator: torch.Generator) -> None:
    """Poses of exact edges and of three points, which alone determine none of them, come back from where they were moved."""
    whole, curves = make_scene(generator)
    mapping = whole.without((whole.track >= 3).nonzero()[:, 0])
    step = 0.002 * torch.randn(VIEWS, 6, generator=generator, dtype=F64)
    step[0] = 0
    moved = dataclasses.replace(mapping, poses=mapping.poses.retract(step))
    assert relative_error(adjusted(moved, None, 1e-14), mapping.poses) > 3e-4
    assert relative_error(adjusted(moved, curves, 1e-14), mapping.poses) < 2e-5


def drifting(generator: torch.Generator, shape: tuple[int, ...], stay: float) -> Tensor:
    """Normal numbers of variance 1, each `stay` times the one before and the rest its own."""
    own = torch.randn(shape, generator=generator, dtype=F64)
    found = [own[..., 0]]
    for k in range(1, shape[-1]):
        found.append(stay * found[-1] + math.sqrt(1 - stay**2) * own[..., k])
    return torch.stack(found, -1)


@pytest.mark.parametrize("stay", [0.0, 0.5, 0.9])
def test_how_many_distances_are_alike(generator: torch.Generator, stay: float) -> None:
    """The sum of correlations is (1 + a) / (1 - a), less the tail that is told from none no more."""
    views, curves, samples = 8, 40, 100
    r = drifting(generator, (views, curves, samples), stay)
    view, curve, sample = torch.cartesian_prod(*map(torch.arange, (views, curves, samples))).unbind(1)
    order = torch.randperm(len(view), generator=generator)
    found = alike(
        r.flatten()[order], view[order], (curve * samples + sample)[order], torch.arange(curves).repeat_interleave(samples)
    )
    wanted = (1 + stay) / (1 - stay)
    assert 0.75 * wanted < found < 1.15 * wanted


def test_weights_are_inverse_variances_of_what_is_independent(generator: torch.Generator) -> None:
    """Edges off by five times what they say, for themselves and all along curves; those that cannot be measured say nothing."""
    weights = []
    for stay in (0.0, 0.9):
        aside = 2.5 * drifting(generator, (VIEWS, CURVES, SAMPLES), stay)
        mapping, curves = make_scene(generator, 0.0, aside)
        model = dataclasses.replace(mapping.reconstruction(), curves=curves)
        apart = edge_distances(model.poses, model.cameras[model.camera_index], curves.bundle())
        apart[::50] = torch.nan
        # Samples that fit as they would after an adjustment: those of the truth are further off.
        share = (1 - 2 * len(curves.X) / len(curves.x)) ** 0.5
        weighed = measured_weights(curves, share * apart)
        assert (weighed.weight.diff() == 0).all()
        weights.append(float(weighed.weight[0]))
    assert weights[0] == pytest.approx(1 / 2.5**2, rel=0.25)
    assert weights[0] / weights[1] == pytest.approx(19, rel=0.4)
    assert measured_weights(curves, torch.full_like(apart, torch.nan)) is curves


def test_what_moves_the_image_of_a_curve_is_one_error(generator: torch.Generator) -> None:
    """Edges off for themselves count one by one; off by one vector in an image of a curve, as if they were a few.

    Off alike along curves that bend, they count for less than the signs along them tell: most of it cancels.
    """
    _, curves = make_scene(generator)
    shape = (VIEWS, CURVES, SAMPLES)
    of = (curves.view, curves.curve[curves.sample], curves.sample % SAMPLES)
    own = torch.randn(shape, generator=generator, dtype=F64)[of]
    assert moved_alike(curves, own) < 1.4
    vector = torch.randn(VIEWS, CURVES, 2, generator=generator, dtype=F64)[of[0], of[1]]
    together = moved_alike(curves, (vector * curves.normal).sum(-1))
    assert together > 0.25 * SAMPLES
    waves = torch.cos(
        2 * torch.pi * (torch.arange(SAMPLES) / 20 + torch.rand(VIEWS, CURVES, 1, generator=generator, dtype=F64))
    )
    waved = waves[of] + 0.1 * own
    assert moved_alike(curves, waved) < 0.5 * alike(waved, curves.view, curves.sample, curves.curve)
    assert moved_alike(curves, torch.full_like(own, torch.nan)) == 1


def test_samples_that_fit_badly_as_a_whole_count_less(generator: torch.Generator) -> None:
    """Edges each a little off, of one curve four times as far; samples that cannot be measured keep what they have."""
    mapping, curves = make_scene(generator)
    model = dataclasses.replace(mapping.reconstruction(), curves=curves)
    apart = edge_distances(model.poses, model.cameras[model.camera_index], curves.bundle())
    apart = apart + torch.randn(apart.shape, generator=generator, dtype=F64)
    bad = curves.curve[curves.sample] == 3
    apart[bad] *= 4
    weights = sample_weights(curves, apart)
    assert bool(((weights > 0) & (weights <= 1)).all())
    assert weights[bad].mean() < 0.3
    assert weights[~bad].mean() > 0.75
    # All of a sample count alike, and only the sizes of distances among each other matter.
    own = torch.full_like(curves.X[:, 0], torch.nan).index_copy(0, curves.sample, weights)
    assert torch.equal(own[curves.sample], weights)
    assert torch.allclose(sample_weights(curves, 10 * apart), weights)
    broken = apart.clone()
    broken[curves.sample == 0] = torch.nan
    assert (sample_weights(curves, broken)[curves.sample == 0] == 1).all()
    assert (sample_weights(curves, torch.full_like(apart, torch.nan)) == 1).all()
