"""Signs of cameras and points, and the plane at infinity in closed form."""

import pytest
import torch
from projective_scenes import projective_scene, stack

from torchsfm.autocalibration import diagnose_motion, metric_upgrade, orient_projective, plane_at_infinity_from_intrinsics
from torchsfm.geometry import random_rotation


def test_signs_put_all_points_in_front(generator):
    scene = stack([projective_scene(generator, 7) for _ in range(5)])
    found = orient_projective(scene.P, scene.X, visible=scene.visible)
    w = (found.P[..., 2, :] @ found.X.mT) * scene.visible
    assert (w >= 0).all()
    assert (found.consistent == 1).all()
    assert torch.equal(found.P.abs(), scene.P.abs())


def test_signs_outvote_what_is_wrong(generator):
    scene = projective_scene(generator, 7)
    X = scene.X.clone()
    X[3] = torch.nan
    P = scene.P.clone()
    found = orient_projective(P, X, visible=scene.visible)
    right = orient_projective(scene.P, scene.X, visible=scene.visible)
    assert torch.equal(found.P, right.P)
    # A view far from the first is reached over several others.
    chain = torch.zeros(7, len(X), dtype=torch.bool)
    for i in range(7):
        chain[i, 5 * i : 5 * i + 10] = True
    linked = orient_projective(scene.P, scene.X, visible=chain & scene.visible)
    assert ((linked.P[:, 2] @ linked.X.mT)[chain & scene.visible] > 0).all()
    assert orient_projective(P[:0], X).P.shape == (0, 3, 4)


def test_two_calibrated_views_give_the_plane(generator):
    K = torch.diag(torch.tensor([1.4, 1.5, 1.0], dtype=torch.float64)).repeat(2, 6, 1, 1)
    K[1, :, :2, 2] = 0.1
    R = random_rotation(6, generator=generator, dtype=torch.float64)
    t = torch.randn(6, 3, 1, generator=generator, dtype=torch.float64)
    p = 0.3 * torch.randn(6, 3, generator=generator, dtype=torch.float64)
    H = metric_upgrade(K[0], p)
    P = 2.5 * K[1] @ torch.cat((R, t), -1) @ torch.linalg.inv(H)
    assert torch.allclose(plane_at_infinity_from_intrinsics(P, K[0], K[1]), p, atol=1e-10)
    assert (
        torch.linalg.inv(H).mT @ torch.tensor([0.0, 0, 0, 1], dtype=torch.float64)
        - torch.nn.functional.pad(p, (0, 1), value=1.0)
    ).abs().max() < 1e-12
    # The opposite sign is another geometry.
    assert (plane_at_infinity_from_intrinsics(-P, K[0], K[1]) - p).abs().amax(-1).min() > 1e-3
    flat = torch.zeros(3, 4, dtype=torch.float64)
    assert plane_at_infinity_from_intrinsics(flat, K[0, 0], K[1, 0]).isfinite().all()


@pytest.mark.parametrize(
    ("motion", "flag"),
    [
        ("translation", "translation"),
        ("planar", "planar"),
        ("one axis", "one_axis"),
        ("collinear", "collinear"),
        ("orbital", "orbital"),
    ],
)
def test_motions_are_told_apart(generator, motion, flag):
    names = ("translation", "planar", "one_axis", "collinear", "orbital")
    scene = projective_scene(generator, 8, motion=motion)
    found = diagnose_motion(scene.R, scene.centre, torch.ones(8, dtype=torch.bool))
    assert getattr(found, flag)
    others = {"planar": {"one_axis"}}.get(flag, set()) | {flag}
    if flag != "translation":
        assert not any(bool(getattr(found, name)) for name in names if name not in others)
    general = projective_scene(generator, 8)
    assert not diagnose_motion(general.R, general.centre, torch.ones(8, dtype=torch.bool)).critical
