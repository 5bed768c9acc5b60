"""Minimal solvers for cameras against PoseLib, and where their problems are special."""

import numpy as np
import pytest
import torch
from chance import assert_share

from torchsfm.geometry import random_rotation
from torchsfm.resection import camera_gp3p, camera_p3p, camera_p4pf, camera_p35pf, camera_up2p

F64 = torch.float64


def all_found(theirs, ours, tolerance=1e-6):
    """Share of the peer's solutions that are among ours."""
    hit = total = 0
    for i, models in enumerate(theirs):
        for M in models:
            M = torch.as_tensor(M)
            gap = (ours.model[i][ours.valid[i]] - M).norm(dim=(-1, -2)) / M.norm()
            total += 1
            hit += bool((gap < tolerance).any())
    return hit / total


@pytest.mark.reference
def test_poselib_gp3p(make_scene, generator):
    poselib = pytest.importorskip("poselib")
    Y, X, _ = make_scene(500)
    p = torch.randn(Y.shape, generator=generator, dtype=F64)
    d = torch.nn.functional.normalize(Y - p, dim=-1)
    found = camera_gp3p(p, d, X)
    theirs = []
    for i in range(500):
        poses = [s.Rt for s in poselib.gp3p(p[i].numpy(), d[i].numpy(), X[i].numpy())]
        # PoseLib also returns what lies behind the rig.
        Z = [X[i].numpy() @ M[:, :3].T + M[:, 3] - p[i].numpy() for M in poses]
        theirs.append([M for M, z in zip(poses, Z, strict=True) if ((z * d[i].numpy()).sum(-1) > 0).all()])
    assert all_found(theirs, found, 1e-4) > 0.998
    assert found.valid.sum() >= sum(len(poses) for poses in theirs) - 1


@pytest.mark.reference
def test_poselib_up2p(make_scene):
    poselib = pytest.importorskip("poselib")
    Y, X, P = make_scene(500, n=2)
    # PoseLib's vertical is the second axis on both sides.
    axis = torch.tensor([0.0, 1.0, 0.0], dtype=F64)
    g = (P[..., :3] @ axis[:, None])[..., 0]
    a = torch.nn.functional.normalize(torch.linalg.cross(g, torch.randn_like(g)), dim=-1)
    turn = torch.stack((a, g, torch.linalg.cross(a, g)), -2)
    d = torch.nn.functional.normalize(Y @ turn.mT, dim=-1)
    found = camera_up2p(d, X, axis, axis)
    theirs = []
    for i in range(500):
        poses = [s.Rt for s in poselib.up2p(d[i].numpy(), X[i].numpy())]
        Z = [X[i].numpy() @ M[:, :3].T + M[:, 3] for M in poses]
        theirs.append([M for M, z in zip(poses, Z, strict=True) if ((z * d[i].numpy()).sum(-1) > 0).all()])
    assert all_found(theirs, found) > 0.998
    assert found.valid.sum() == sum(len(poses) for poses in theirs)


@pytest.mark.reference
def test_poselib_p4pf(make_scene):
    poselib = pytest.importorskip("poselib")
    Y, X, P = make_scene(500, n=4, width=0.5)
    x = 900 * Y[..., :2] / Y[..., 2:]
    truth = torch.diag(torch.tensor([900.0, 900, 1], dtype=F64)) @ P
    ours = ((camera_p4pf(x, X).model[:, 0] - truth).norm(dim=(-1, -2)) / truth.norm(dim=(-1, -2)) < 1e-6).sum()
    theirs = 0
    for i in range(500):
        poses, focals = poselib.p4pf(x[i].numpy(), X[i].numpy(), True)
        models = [np.diag([f, f, 1]) @ s.Rt for s, f in zip(poses, focals, strict=True)]
        theirs += any(np.linalg.norm(M - truth[i].numpy()) < 1e-6 * np.linalg.norm(truth[i].numpy()) for M in models)
    assert ours == 500
    assert ours >= theirs


def test_four_points_of_a_plane_fix_the_focal_length(generator):
    X = 4 * torch.rand(2000, 4, 3, generator=generator, dtype=F64) - 2
    X[..., 2] = 0.2 * X[..., 0]
    R = random_rotation(2000, generator=generator, dtype=F64)
    t = torch.tensor([0.0, 0, 7], dtype=F64)
    Y = X @ R.mT + t
    x = 800 * Y[..., :2] / Y[..., 2:]
    found = camera_p4pf(x, X)
    error = (found.model[:, 0, 0, :3].norm(dim=-1) / 800 - 1).abs()
    # A plane that faces the camera says nothing about the focal length.
    tilted = (R @ torch.tensor([-0.2, 0, 1], dtype=F64))[:, 2].abs() < 0.95
    assert_share(error[tilted] < 1e-6, 0.995)


def test_noise_is_answered_by_least_squares(make_scene, generator):
    Y, X, _ = make_scene(300, n=4, width=0.5)
    x = 900 * Y[..., :2] / Y[..., 2:] + torch.randn(300, 4, 2, generator=generator, dtype=F64)
    found = camera_p4pf(x, X)
    P = found.model[:, 0].clone().requires_grad_()
    R, f = P[:, :, :3] / P[:, :, :3].norm(dim=-1, keepdim=True), P[:, 0, :3].norm(dim=-1)
    torch.testing.assert_close((R @ R.mT).detach(), torch.eye(3, dtype=F64).expand(300, 3, 3))
    assert torch.allclose(f, P[:, 1, :3].norm(dim=-1))
    error = lambda P: ((X @ P[..., :3].mT + P[..., None, :, 3])[..., :2] / (  # noqa: E731
        X @ P[..., :3].mT + P[..., None, :, 3])[..., 2:] - x).square().sum((-1, -2))  # fmt: skip
    best = error(found.model[:, 0])
    seen = found.valid[:, 0]
    assert_share(seen, 0.9)
    assert best[seen].median() < 1
    for _ in range(20):
        w = 1e-4 * torch.randn(300, 3, generator=generator, dtype=F64)
        turn = torch.linalg.matrix_exp(torch.linalg.cross(torch.eye(3, dtype=F64).expand(300, 3, 3), w[:, None], dim=-1))
        K = torch.stack((f, f, torch.ones_like(f)), -1)[..., None].detach()
        zoom = 1 + 1e-4 * torch.randn(300, 1, 1, generator=generator, dtype=F64)
        other = turn @ (found.model[:, 0] / K)
        other[..., 3] += 1e-4 * torch.randn(300, 3, generator=generator, dtype=F64)
        scale = torch.cat((zoom, zoom, torch.ones_like(zoom)), -2)
        assert_share((error(scale * K * other) >= best * (1 - 1e-6))[seen], 0.96)


def test_one_centre_is_the_three_point_problem(make_scene):
    Y, X, _ = make_scene(1000)
    p = torch.zeros_like(Y)
    central, rig = camera_p3p(Y, X), camera_gp3p(p, Y, X)
    assert all_found([central.model[i][central.valid[i]] for i in range(1000)], rig) > 0.998
    assert_share(central.valid.sum(-1) == rig.valid.sum(-1), 0.995)


def test_symmetric_rigs(generator):
    """Three cameras at the corners of an equilateral triangle look at another one, from its axis and elsewhere."""
    angle = 2 * torch.pi / 3 * torch.arange(3, dtype=F64)
    triangle = torch.stack((angle.cos(), angle.sin(), torch.zeros(3, dtype=F64)), -1)
    R = random_rotation(400, generator=generator, dtype=F64)
    t = torch.randn(400, 3, generator=generator, dtype=F64) + torch.tensor([0.0, 0, 6])
    R[:200], t[:200, :2] = torch.eye(3, dtype=F64), 0
    Y = triangle @ R.mT + t[:, None]
    p = 0.5 * triangle.expand(400, 3, 3)
    found = camera_gp3p(p, Y - p, triangle)
    P = torch.cat((R, t[..., None]), -1)
    error = torch.where(found.valid, (found.model - P[:, None]).abs().amax((-1, -2)), torch.inf).amin(-1)
    assert_share(error < 1e-5, 0.99)


@pytest.mark.parametrize("solve", [camera_p4pf, camera_p35pf])
def test_a_point_at_the_principal_point(make_scene, solve):
    Y, X, P = make_scene(200, n=4, width=0.5)
    X[:, 0] -= (P[..., :3].mT @ (Y[:, 0] * torch.tensor([1.0, 1, 0], dtype=F64))[..., None])[..., 0]
    Y = X @ P[..., :3].mT + P[:, None, :, 3]
    found = solve(900 * Y[..., :2] / Y[..., 2:], X)
    truth = torch.diag(torch.tensor([900.0, 900, 1], dtype=F64)) @ P
    gap = (found.model - truth[:, None]).norm(dim=(-1, -2)) / truth[:, None].norm(dim=(-1, -2))
    assert_share(torch.where(found.valid, gap, torch.inf).amin(-1) < 1e-6, 0.99)
