"""The laws of the solvers that know less than all calibration, or more: every law against every solver."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from chance import assert_share
from torch import Tensor
from two_view_scenes import F64, two_views

from torchsfm._types import Solutions
from torchsfm.geometry import cross_matrix, rotation_from_rotvec
from torchsfm.motion import (
    FocalMotion,
    essential_6pt,
    fundamental_affine_4pt,
    relative_6pt_focal,
    relative_known_rotation_2pt,
    relative_upright_3pt,
)
from torchsfm.motion.two_views.essential_6pt import equations as six_equations
from torchsfm.motion.two_views.fundamental_affine_4pt import equations as affine_equations
from torchsfm.motion.two_views.relative_6pt_focal import equations as focal_equations
from torchsfm.motion.two_views.relative_known_rotation_2pt import equations as translation_equations
from torchsfm.motion.two_views.relative_upright_3pt import equations as upright_equations
from torchsfm.tensors import essential_from_pose, pose_from_essential

EASY = ("random", "roll 90", "convergent 90", "far points", "small baseline")
CALIBRATED = (*EASY, "near planar", "narrow view", "forward", "sideways")


def tensor(model: Tensor | FocalMotion) -> Tensor:
    """A model as one tensor."""
    return model if isinstance(model, Tensor) else torch.cat((model.E.flatten(-2), model.f[..., None]), -1)


def either_sign(A: Tensor, B: Tensor) -> Tensor:
    A, B = (M.double().flatten(-2) for M in (A, B))
    A, B = (v / v.norm(dim=-1, keepdim=True) for v in (A, B))
    return torch.minimum((A - B).norm(dim=-1), (A + B).norm(dim=-1))


def pose_gap(A: Tensor, B: Tensor) -> Tensor:
    return (A.double() - B.double()).norm(dim=(-2, -1))


def focal_gap(A: Tensor, B: Tensor) -> Tensor:
    turned = either_sign(A[..., :9].unflatten(-1, (3, 3)), B[..., :9].unflatten(-1, (3, 3)))
    return torch.maximum(turned, (A[..., 9] / B[..., 9]).double().log().abs())


@dataclass(frozen=True)
class Case:
    """A solver, its equations, exact samples of it with the model behind them, and the distance of two models."""

    solve: Callable[..., Solutions[Any]]
    equations: Callable[..., Tensor]
    slots: int
    shape: tuple[int, ...]
    families: tuple[str, ...]
    error: Callable[[Tensor, Tensor], Tensor]
    tolerance32: float

    def of_model(self, model: Tensor, *sample: Tensor) -> Tensor:
        """The equations, of which those of two rays look at t alone."""
        if self.solve is relative_known_rotation_2pt:
            return self.equations(model[..., 3], *sample)
        return self.equations(model, *sample)

    def sample(self, family: str, count: int, generator: torch.Generator) -> tuple[tuple[Tensor, ...], Tensor]:
        size = {relative_upright_3pt: 3, relative_known_rotation_2pt: 2, fundamental_affine_4pt: 4}.get(self.solve, 6)
        X1, X2, E = two_views(family, count, size, generator)
        d1, d2 = (X / X.norm(dim=-1, keepdim=True) for X in (X1, X2))
        if self.solve is essential_6pt:
            return (d1, d2), E
        if self.solve is relative_6pt_focal:
            f = 400 * (1 + 3 * torch.rand(count, dtype=F64, generator=generator))
            x1, x2 = (f[:, None, None] * X[..., :2] / X[..., 2:] for X in (X1, X2))
            return (x1, x2), torch.cat((E.flatten(-2), f[:, None]), -1)
        if self.solve is fundamental_affine_4pt:
            P = torch.randn(2, count, 2, 4, dtype=F64, generator=generator)
            x1, x2 = (X1 @ A[..., :3].mT + 10 * A[..., None, :, 3] for A in P)
            # The parallel projections' epipolar geometry is that of any fifth point of the line through the fourth.
            normal = torch.linalg.svd(torch.cat((P[1, ..., :3], P[0, ..., :3]), -2).mT)[2][..., 3, :]
            offset = -(normal * torch.cat((x2[:, 0], x1[:, 0]), -1)).sum(-1)
            zero = torch.zeros_like(offset)
            F = torch.stack((zero, zero, normal[:, 0], zero, zero, normal[:, 1], normal[:, 2], normal[:, 3], offset), -1)
            return (x1, x2), F.reshape(count, 3, 3)
        pose = pose_from_essential(E, X1, X2).model
        if self.solve is relative_known_rotation_2pt:
            return (d1, d2, pose[..., :3]), pose
        gravity = torch.randn(count, 3, dtype=F64, generator=generator)
        return (d1, d2, gravity, 3 * (pose[..., :3] @ gravity[..., None])[..., 0]), pose


CASES = {
    "essential_6pt": Case(essential_6pt, six_equations, 1, (3, 3), CALIBRATED, either_sign, 1e-3),
    "relative_6pt_focal": Case(relative_6pt_focal, focal_equations, 15, (10,), (*EASY, "narrow view"), focal_gap, 3e-2),
    "relative_upright_3pt": Case(relative_upright_3pt, upright_equations, 4, (3, 4), CALIBRATED, pose_gap, 1e-2),
    "relative_known_rotation_2pt": Case(
        relative_known_rotation_2pt, translation_equations, 1, (3, 4), CALIBRATED, pose_gap, 1e-2
    ),
    "fundamental_affine_4pt": Case(fundamental_affine_4pt, affine_equations, 1, (3, 3), ("random",), either_sign, 1e-2),
}


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param]


def nearest(case: Case, solutions: Solutions[Any], truth: Tensor) -> Tensor:
    gap = case.error(tensor(solutions.model), truth.unsqueeze(truth.ndim - len(case.shape)))
    return torch.where(solutions.valid, gap, 9).amin(-1)


def test_recall_on_random_scenes(case: Case, generator: torch.Generator) -> None:
    sample, truth = case.sample("random", 2000, generator)
    solutions = case.solve(*sample)
    assert tensor(solutions.model).shape == (2000, case.slots, *case.shape)
    assert_share(nearest(case, solutions, truth) < 1e-6, at_least=0.9999)
    single = case.solve(*(s.float() for s in sample))
    assert tensor(single.model).dtype == torch.float32
    assert_share(nearest(case, single, truth) < case.tolerance32, at_least=0.97)


@pytest.mark.parametrize(("name", "family"), [(n, f) for n, c in CASES.items() for f in c.families])
def test_recall_on_hard_families(name: str, family: str, generator: torch.Generator) -> None:
    case = CASES[name]
    sample, truth = case.sample(family, 4000, generator)
    assert_share(nearest(case, case.solve(*sample), truth) < 1e-6, at_least=0.9995)


def test_upright_motion_is_as_exact_as_far_points_let_it_be(generator: torch.Generator) -> None:
    # A few hundred times the baseline away the determinant is a millionth at its roots of what it is elsewhere.
    X1, _, _ = two_views("random", 4000, 3, generator)
    R = rotation_from_rotvec(torch.randn(4000, 3, dtype=F64, generator=generator))
    t = torch.nn.functional.normalize(torch.randn(4000, 3, dtype=F64, generator=generator), dim=-1)
    X1 = X1 * 1000 ** torch.rand(4000, 3, 1, dtype=F64, generator=generator)
    gravity = torch.randn(4000, 3, dtype=F64, generator=generator)
    found = relative_upright_3pt(X1, X1 @ R.mT + t[:, None], gravity, (R @ gravity[..., None])[..., 0])
    truth = torch.cat((R, t[..., None]), -1)
    gap = torch.where(found.valid, pose_gap(found.model, truth[:, None]), 9).amin(-1)
    assert_share(gap < 1e-9, at_least=0.998)


def test_critical_motions_leave_no_focal_length(generator: torch.Generator) -> None:
    """Parallel optical axes, and axes that meet at the same distance from both centres: a family, whatever rounding says."""
    count, middle = 500, torch.tensor([0.0, 0, 6], dtype=F64)
    X = 4 * torch.rand(count, 6, 3, dtype=F64, generator=generator) - 2 + middle
    f = 400 * (1 + 3 * torch.rand(count, 1, 1, dtype=F64, generator=generator))
    t = torch.randn(count, 1, 3, dtype=F64, generator=generator)
    axis = torch.randn(count, 3, dtype=F64, generator=generator)
    roll = rotation_from_rotvec(axis * torch.tensor([0.0, 0, 1], dtype=F64))
    turn = rotation_from_rotvec(0.3 * axis * torch.tensor([1.0, 1, 0], dtype=F64))
    Y = torch.stack((X + t, X + 0.1 * t, X @ roll.mT + t, (X - middle) @ turn.mT + middle, X @ turn.mT))
    x1, x2 = (f * Z[..., :2] / Z[..., 2:] for Z in (X, Y))
    assert_share(~relative_6pt_focal(x1, x2).valid.any(-1), 0.9999)


def test_soundness(case: Case, generator: torch.Generator) -> None:
    sample, _ = case.sample("random", 300, generator)
    if case.solve is not essential_6pt:
        # Also samples that no scene could give; six rays then have no exact solution.
        sample[1][150:] = sample[1][150:].flip(0).roll(1, 1)
    solutions = case.solve(*sample)
    residual = case.of_model(tensor(solutions.model), *(s[:, None] for s in sample)).abs().amax(-1)
    assert residual[solutions.valid].max() < 1e-8
    assert_share(solutions.valid.any(-1), 0.9)
    assert torch.isfinite(tensor(solutions.model)).all()


def test_solutions_are_distinct(case: Case, generator: torch.Generator) -> None:
    sample, _ = case.sample("random", 500, generator)
    solutions = case.solve(*sample)
    model = tensor(solutions.model)
    gap = case.error(model[:, :, None], model[:, None])
    both = solutions.valid[:, :, None] & solutions.valid[:, None] & ~torch.eye(case.slots, dtype=torch.bool)
    assert not ((gap < 1e-7) & both).any()


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,), (4, 0)])
def test_batch_shapes(case: Case, shape: tuple[int, ...], generator: torch.Generator) -> None:
    sample, _ = case.sample("random", 6, generator)
    count = torch.Size(shape).numel()
    solutions = case.solve(*(s[:count].reshape(*shape, *s.shape[1:]) for s in sample))
    assert tensor(solutions.model).shape == (*shape, case.slots, *case.shape)
    assert solutions.valid.shape == (*shape, case.slots)


def test_batch_equals_loop(case: Case, generator: torch.Generator) -> None:
    sample, _ = case.sample("random", 40, generator)
    many = case.solve(*(s.repeat(60, *([1] * (s.ndim - 1))) for s in sample))
    together = case.solve(*sample)
    assert torch.equal(many.valid, together.valid.repeat(60, 1))
    for i in range(0, 40, 3):
        one = case.solve(*(s[i] for s in sample))
        assert torch.equal(one.valid, together.valid[i])
        # LAPACK's last bit may depend on where a matrix lies in memory.
        torch.testing.assert_close(tensor(one.model), tensor(together.model)[i], rtol=1e-9, atol=1e-9)


def test_broadcasting(case: Case, generator: torch.Generator) -> None:
    sample, _ = case.sample("random", 4, generator)
    first, *rest = sample
    solutions = case.solve(first[:, None], *(s[None, :2] for s in rest))
    assert solutions.valid.shape == (4, 2, case.slots)
    alone = case.solve(first[1], *(s[1] for s in rest))
    torch.testing.assert_close(tensor(solutions.model)[1, 1], tensor(alone.model), rtol=1e-9, atol=1e-9)


def test_bad_samples_leave_neighbours_alone(case: Case, generator: torch.Generator) -> None:
    sample, _ = case.sample("random", 12, generator)
    reference = case.solve(*sample)
    x1, x2 = sample[:2]
    x1[1], x2[1] = x1[1, :1], x2[1, :1]  # one point
    x1[2, 1], x2[2, 1] = x1[2, 0], x2[2, 0]  # a point twice
    x1[3, 0, 0] = float("nan")
    x2[4, 1, 1] = float("inf")
    x1[5] = 0
    x2[6] = 0
    x1[7], x2[7] = 1e200 * x1[7], 1e-200 * x2[7]
    for s in sample:
        s.requires_grad_()
    solutions = case.solve(*sample)
    model = tensor(solutions.model)
    assert torch.isfinite(model).all()
    untouched = [0, 8, 9, 10, 11]
    assert torch.equal(model[untouched], tensor(reference.model)[untouched])
    assert torch.equal(solutions.valid[untouched], reference.valid[untouched])
    assert not solutions.valid[[1, 2, 3, 4]].any()
    model.sum().backward()
    for s in sample:
        assert s.grad is not None
        assert torch.isfinite(s.grad).all()


def test_no_motion_has_no_solution(generator: torch.Generator) -> None:
    """A camera that only turns leaves nothing to find; for a known vertical and a known rotation too."""
    for name in ("essential_6pt", "relative_6pt_focal"):
        (x1, x2), _ = CASES[name].sample("random", 50, generator)
        del x2
        assert not CASES[name].solve(x1, x1).valid.any()
    d = torch.nn.functional.normalize(torch.randn(50, 3, 3, dtype=F64, generator=generator), dim=-1)
    R = rotation_from_rotvec(torch.randn(50, 3, dtype=F64, generator=generator))
    turned = d @ R.mT
    assert not essential_6pt(torch.cat((d, d.flip(1)), 1), torch.cat((turned, turned.flip(1)), 1)).valid.any()
    assert not relative_known_rotation_2pt(d[:, :2], turned[:, :2], R).valid.any()
    up = torch.tensor([0.0, 1, 0], dtype=F64)
    poses = relative_upright_3pt(d, turned, up.expand(50, 3), (R @ up))
    # Turns that are not the right one may still fit.
    right = poses.valid & ((poses.model[..., :3] - R[:, None]).norm(dim=(-2, -1)) < 1e-3)
    assert_share(~right, 0.98)


def test_planes(generator: torch.Generator) -> None:
    X1, X2, E = two_views("random", 100, 10, generator)
    pose = pose_from_essential(E, X1, X2).model
    X1[..., 2] = 6 + 0.3 * X1[..., 0]
    X2 = X1 @ pose[..., :3].mT + pose[:, None, :, 3]
    for n in (6, 10):
        assert_share(~essential_6pt(X1[:, :n], X2[:, :n]).valid, 0.98)
    x1, x2 = (X[:, :6, :2] / X[:, :6, 2:] for X in (X1, X2))
    solutions = relative_6pt_focal(x1, x2)
    # The conditions are fewer than the unknowns: no valid answer, or one that means nothing but is finite.
    assert torch.isfinite(solutions.model.f).all()
    y1, y2 = X1[..., :2], X1[..., 1:] @ torch.randn(100, 2, 2, dtype=F64, generator=generator)
    assert not fundamental_affine_4pt(y1[:, :4], y2[:, :4]).valid.any()
    assert not fundamental_affine_4pt(y1, y2).valid.any()


@pytest.mark.parametrize("name", ["essential_6pt", "fundamental_affine_4pt"])
def test_more_points_with_weights(name: str, generator: torch.Generator) -> None:
    case = CASES[name]
    X1, X2, E = two_views("random", 40, 30, generator)
    if name == "fundamental_affine_4pt":
        P = torch.randn(2, 40, 2, 3, dtype=F64, generator=generator)
        x1, x2 = (X1 @ A.mT for A in P)
        truth = case.solve(x1[:, :4], x2[:, :4]).model[:, 0]
    else:
        x1, x2, truth = X1 / X1[..., 2:], X2 / X2[..., 2:], E
    assert case.error(case.solve(x1, x2).model[:, 0], truth).max() < 1e-9
    noise = 1e-3 * torch.randn(x2.shape, dtype=F64, generator=generator)
    weights = torch.ones(40, 30, dtype=F64)
    weights[:, :4] = 0
    bad = x2 + noise
    bad[:, 0], bad[:, 1], bad[:, 2] = 1e3, torch.nan, torch.inf
    fit = case.solve(x1, bad, weights=weights)
    assert fit.valid.all()
    error = case.error(fit.model[:, 0], truth)
    assert error.median() < 0.05
    # Points of weight 0 are not there; a weight of 2 is a point twice; a common factor means nothing.
    assert_share(case.error(fit.model, case.solve(x1[:, 4:], bad[:, 4:]).model) < 1e-6, 0.99)
    weights[:, 5] = 2
    once = case.solve(x1, bad, weights=10 * weights).model
    twice = case.solve(torch.cat((x1, x1[:, 5:6]), 1)[:, 4:], torch.cat((bad, bad[:, 5:6]), 1)[:, 4:]).model
    assert_share(case.error(once, twice) < 1e-6, 0.99)
    # More points are better than few.
    few = case.error(case.solve(x1[:, 4:12], bad[:, 4:12]).model[:, 0], truth)
    assert error.median() < few.median()
    weights[0], weights[1, 0], weights[2, 3:] = 0, -1, 0
    assert case.solve(x1, bad, weights=weights).valid[:, 0].tolist() == [False] * 3 + [True] * 37


def test_the_affine_fit_is_the_gold_standard(generator: torch.Generator) -> None:
    """No neighbour has a smaller sum of squared distances to exact pairs."""
    X, _, _ = two_views("random", 1, 20, generator)
    P = torch.randn(2, 1, 2, 3, dtype=F64, generator=generator)
    x1, x2 = (X @ A.mT + 0.05 * torch.randn(1, 20, 2, dtype=F64, generator=generator) for A in P)
    F = fundamental_affine_4pt(x1, x2).model[0, 0]

    def cost(F: Tensor) -> Tensor:
        distance = x2[0] @ F[:2, 2] + x1[0] @ F[2, :2] + F[2, 2]
        return (distance**2).sum() / (F[:2, 2] @ F[:2, 2] + F[2, :2] @ F[2, :2])

    for _ in range(30):
        move = torch.randn(3, 3, dtype=F64, generator=generator) * 1e-4
        move[:2, :2] = 0
        assert cost(F + move) > cost(F)


def test_six_rays_with_noise_are_at_a_stationary_point(generator: torch.Generator) -> None:
    X1, X2, _ = two_views("random", 300, 15, generator)
    d1, d2 = (X / X[..., 2:] + 3e-4 * torch.randn(X.shape, dtype=F64, generator=generator) for X in (X1, X2))
    fit = essential_6pt(d1, d2)
    assert_share(fit.valid, 0.99)
    assert six_equations(fit.model, d1[:, None], d2[:, None]).abs().amax(-1).median() < 1e-10


def test_derivatives(case: Case, generator: torch.Generator) -> None:
    sample, _ = case.sample("random", 2, generator)
    if case.solve is relative_6pt_focal:
        sample = tuple(s / 500 for s in sample)
    valid = case.solve(*sample).valid
    if case.solve is relative_known_rotation_2pt:
        # A rotation moved off the rotations is still used as it comes.
        solve = lambda *s: case.solve(*s).model[valid]  # noqa: E731
    else:
        solve = lambda *s: tensor(case.solve(*s).model)[valid]  # noqa: E731
    assert valid.any(-1).all()
    # Next to a double root focal lengths bend so much that differences need short steps.
    eps = 1e-8 if case.solve is relative_6pt_focal else 1e-7
    assert torch.autograd.gradcheck(solve, [s.requires_grad_() for s in sample], eps=eps, atol=1e-4, rtol=1e-3)


def test_derivatives_of_a_fit(generator: torch.Generator) -> None:
    X1, X2, _ = two_views("random", 1, 12, generator)
    d1, d2 = (X / X[..., 2:] + 1e-4 * torch.randn(X.shape, dtype=F64, generator=generator) for X in (X1, X2))
    weights = 0.5 + torch.rand(1, 12, dtype=F64, generator=generator)

    def solve(a: Tensor, b: Tensor, w: Tensor) -> Tensor:
        """The sign of E means nothing: that of its largest entry is made positive."""
        E = essential_6pt(a, b, weights=w).model
        return E * E.detach().flatten()[E.detach().abs().argmax()].sign()

    inputs = [v.requires_grad_() for v in (d1, d2, weights)]
    assert torch.autograd.gradcheck(solve, inputs, eps=1e-6, atol=1e-3, rtol=1e-2)
    x1, x2 = (d.detach()[..., :2].requires_grad_() for d in (d1, d2))
    affine = lambda a, b, w: fundamental_affine_4pt(a, b, weights=w).model  # noqa: E731
    assert torch.autograd.gradcheck(affine, [x1, x2, weights], eps=1e-6, atol=1e-4)


def test_focal_lengths_scale_with_the_image(generator: torch.Generator) -> None:
    case = CASES["relative_6pt_focal"]
    (x1, x2), truth = case.sample("random", 100, generator)
    for scale in (1e-4, 1e5):
        found = relative_6pt_focal(scale * x1, scale * x2)
        moved = torch.cat((truth[:, :9], scale * truth[:, 9:]), -1)
        assert_share(nearest(case, found, moved) < 1e-7, 0.98)


def test_the_order_of_points_and_of_views(case: Case, generator: torch.Generator) -> None:
    sample, truth = case.sample("random", 200, generator)
    order = torch.randperm(sample[0].shape[1], generator=generator)
    turned = case.solve(sample[0][:, order], sample[1][:, order], *sample[2:])
    assert_share(nearest(case, turned, truth) < 1e-7, 0.99)
    assert_share(turned.valid.sum(-1) == case.solve(*sample).valid.sum(-1), 0.99)
    if case.slots in (1, 15) and case.shape != (3, 4):
        back = case.solve(sample[1], sample[0])
        swapped = truth.mT if case.shape == (3, 3) else torch.cat((truth[:, [0, 3, 6, 1, 4, 7, 2, 5, 8]], truth[:, 9:]), -1)
        assert_share(nearest(case, back, swapped) < 1e-7, 0.99)


def test_wrong_arguments(case: Case, generator: torch.Generator, unchecked: None) -> None:
    sample, _ = case.sample("random", 2, generator)
    first, second, *rest = sample
    for bad in (second[:, :1], second[..., :1], second.float(), second.long(), second.tolist()):
        with pytest.raises(ValueError, match="wanted"):
            case.solve(first, bad, *rest)
    with pytest.raises(ValueError, match="broadcast"):
        case.solve(first, torch.cat((second, second[:1])), *rest)


@pytest.mark.reference
def test_solutions_of_poselib_are_found(generator: torch.Generator) -> None:
    poselib = pytest.importorskip("poselib")
    case = CASES["relative_upright_3pt"]
    (d1, d2, _, _), _ = case.sample("random", 200, generator)
    # PoseLib's vertical is the second axis, in both cameras.
    up = torch.tensor([0.0, 1, 0], dtype=F64)
    ours = relative_upright_3pt(d1, d2, up, up)
    assert ours.valid.any()
    total = found = 0
    for i in range(200):
        for theirs in poselib.relpose_upright_3pt(d1[i].numpy(), d2[i].numpy()):
            pose = torch.from_numpy(np.column_stack((theirs.R, theirs.t / np.linalg.norm(theirs.t))))
            if case.equations(pose, d1[i], d2[i], up, up).abs().max() < 1e-9:
                total += 1
                # Where rays meet behind a camera the sign of t is a matter of choice.
                turned = pose_gap(ours.model[i, ..., :3], pose[:, :3])[ours.valid[i]]
                found += int(turned.min() < 1e-6)
    assert total > 100
    assert found >= 0.99 * total


@pytest.mark.reference
def test_focal_lengths_of_poselib_are_found(generator: torch.Generator) -> None:
    poselib = pytest.importorskip("poselib")
    case = CASES["relative_6pt_focal"]
    (x1, x2), truth = case.sample("random", 150, generator)
    x1, x2, truth = x1 / 500, x2 / 500, torch.cat((truth[:, :9], truth[:, 9:] / 500), -1)
    ours = relative_6pt_focal(x1, x2)
    h1, h2 = (torch.nn.functional.pad(x, (0, 1), value=1.0) for x in (x1, x2))
    total = found = theirs_right = 0
    for i in range(150):
        right = False
        for pair in poselib.shared_focal_relpose_6pt(h1[i].numpy(), h2[i].numpy()):
            R, t = torch.tensor(pair.pose.R), torch.tensor(pair.pose.t)
            E = essential_from_pose(R, t / t.norm())
            y = torch.cat((E.flatten(), torch.tensor([pair.camera1.focal()], dtype=F64)))
            right = right or bool(case.error(y, truth[i]) < 1e-6)
            if focal_equations(y, x1[i], x2[i]).abs().max() < 1e-8:
                total += 1
                found += int(case.error(tensor(ours.model)[i], y)[ours.valid[i]].min() < 1e-5)
        theirs_right += int(right)
    assert total > 150
    assert found >= 0.99 * total
    assert (nearest(case, ours, truth) < 1e-6).sum() >= theirs_right


def test_known_rotation_is_kept(generator: torch.Generator) -> None:
    (d1, d2, R), truth = CASES["relative_known_rotation_2pt"].sample("random", 20, generator)
    pose = relative_known_rotation_2pt(5 * d1, 0.1 * d2, R).model[:, 0]
    assert torch.equal(pose[..., :3], R)
    E = cross_matrix(pose[..., 3]) @ R
    assert ((d2 * (d1 @ E.mT)).sum(-1).abs() < 1e-12).all()
    assert (pose[..., 3] * truth[..., 3]).sum(-1).min() > 1 - 1e-9


def test_linear_essential_matrices_are_essential_whatever_the_rays(generator: torch.Generator) -> None:
    d1, d2 = (torch.randn(500, 12, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    found = essential_6pt(d1, d2)
    values = torch.linalg.svdvals(found.model[found.valid])
    assert len(values)
    assert (values - torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)).abs().max() < 1e-9
