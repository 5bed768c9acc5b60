"""Absolute dual quadric, constant intrinsics, modulus constraint, Kruppa, rotating camera, planar scene."""

import pytest
import torch
from chance import assert_share
from projective_scenes import MOTIONS, SIZE, projective_scene, stack
from torch import Tensor

from torchsfm._types import Status
from torchsfm.autocalibration import (
    Assumption,
    constant_intrinsics,
    dual_quadric,
    dual_quadric_linear,
    intrinsics_from_kruppa,
    intrinsics_from_modulus,
    intrinsics_from_plane,
    intrinsics_from_rotations,
)
from torchsfm.geometry import cross_matrix, rotation_from_rotvec

FOCAL = Assumption(free=("focal",))
ALL = Assumption(free=("focal", "aspect", "skew", "principal_point"), principal_point_sigma=None)


def intrinsic(f: float = 1300.0, aspect: float = 1.0, skew: float = 0.0, offset: float = 0.0) -> Tensor:
    c = (499.5 + offset, 374.5 - offset)
    return torch.tensor([[f, skew, c[0]], [0, f * aspect, c[1]], [0, 0, 1]], dtype=torch.float64)


def turns(generator: torch.Generator, m: int, size: float = 0.4) -> Tensor:
    return rotation_from_rotvec(size * torch.randn(m, 3, generator=generator, dtype=torch.float64))


def fundamentals(scene) -> Tensor:
    R, C, K = scene.R, scene.centre, scene.K
    i, j = torch.triu_indices(len(R), len(R), 1)
    relative = R[j] @ R[i].mT
    t = (R[j] @ (C[i] - C[j])[..., None])[..., 0]
    return torch.linalg.inv(K[j]).mT @ cross_matrix(t) @ relative @ torch.linalg.inv(K[i])


def test_dual_quadric_of_exact_cameras(generator):
    scene = stack([projective_scene(generator, 8, varying=True, offset=0.0) for _ in range(6)])
    found = dual_quadric_linear(scene.P, image_size=SIZE, expected_focal=None)
    assert (found.status == Status.OK).all()
    assert (found.K / scene.K - 1).nan_to_num(0.0, 0.0, 0.0).abs().max() < 1e-6
    assert found.gap.max() < 1e-6
    values = torch.linalg.eigvalsh(found.model)
    assert values[:, 0].abs().max() < 1e-12
    assert (values[:, 1] > 0).all()
    assert (found.model @ found.plane[..., None]).abs().max() < 1e-10
    # A soft expectation pulls, and only softly.
    soft = dual_quadric_linear(scene.P, image_size=SIZE)
    assert (soft.K[..., 0, 0] / scene.K[..., 0, 0] - 1).abs().max() < 0.5


def test_dual_quadric_says_what_it_cannot(generator):
    few = projective_scene(generator, 2, offset=0.0)
    still = projective_scene(generator, 6, motion="translation", offset=0.0)
    assert dual_quadric_linear(few.P, image_size=SIZE, expected_focal=None).status == Status.TOO_FEW
    assert dual_quadric_linear(still.P, image_size=SIZE, expected_focal=None).status == Status.DEGENERATE
    bad = torch.stack([still.P * torch.nan, still.P])
    assert dual_quadric_linear(bad, image_size=SIZE).status[0] == Status.NOT_FINITE


@pytest.mark.parametrize("expected_focal", [None, 1.2])
@pytest.mark.parametrize("noise", [0.0, 0.3])
@pytest.mark.parametrize("motion", ["general", *MOTIONS])
def test_dual_quadric_is_right_or_refused(generator, motion, noise, expected_focal):
    scene = stack([projective_scene(generator, 7, motion=motion, noise=noise, offset=0.0) for _ in range(20)])
    # With noise one of the twenty may lie outside its own deviation.
    allowed = 0 if noise == 0 else 1
    for dtype in (torch.float64, torch.float32):
        found = dual_quadric_linear(scene.P.to(dtype), image_size=SIZE, expected_focal=expected_focal)
        accepted = found.status == Status.OK
        error = (found.K[..., 0, 0] / scene.K[..., 0, 0] - 1).abs().amax(-1)
        assert (accepted & (error > 0.2)).sum() <= allowed
        # Translations, and orbits about a point, leave focal lengths that may vary open.
        if motion in ("translation", "orbital"):
            assert accepted.sum() <= allowed
            assert ((found.deviation > 0.15).any(-1) | accepted).all()
        elif motion == "general":
            assert (~accepted).sum() <= allowed
            assert found.deviation[accepted].max() < (1e-3 if noise == 0 else 0.15)


@pytest.mark.parametrize("motion", ["translation", "orbital"])
def test_dual_quadric_is_refused_whatever_the_rounding(generator, motion, monkeypatch):
    # Errors far below rounding, the same in every decomposition, choose one of the many solutions each time.
    error = torch.randn(10, 10, generator=generator, dtype=torch.float64)
    error = 1e-13 * error @ error.mT

    def chosen(N: Tensor) -> Tensor:
        unit = N.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
        return torch.linalg.eigh(N / unit + error)

    monkeypatch.setattr(dual_quadric, "eigh", lambda N: (*(chosen(N) if N.shape[-1] == 10 else torch.linalg.eigh(N)), None))
    monkeypatch.setattr(dual_quadric, "null_vector", lambda A: (chosen(A.mT @ A)[1][..., 0], None))
    scene = stack([projective_scene(generator, 7, motion=motion, offset=0.0) for _ in range(20)])
    found = dual_quadric_linear(scene.P, image_size=SIZE, expected_focal=None)
    assert (found.status != Status.OK).all()


def test_dual_quadric_without_a_view_is_that_of_the_others(generator):
    scene = projective_scene(generator, 7, noise=0.3, offset=0.0)
    weights = torch.ones(7, dtype=torch.float64)
    weights[3] = 0
    rest = [0, 1, 2, 4, 5, 6]
    found = dual_quadric_linear(scene.P, image_size=SIZE, weights=weights)
    less = dual_quadric_linear(scene.P[rest], image_size=SIZE)
    assert torch.allclose(found.deviation[rest], less.deviation, rtol=1e-6)
    assert found.deviation[3] == 1
    assert torch.allclose(found.K[rest], less.K, rtol=1e-6)


@pytest.mark.parametrize("method", [constant_intrinsics, intrinsics_from_modulus])
@pytest.mark.parametrize(
    ("assume", "options"), [(FOCAL, {"offset": 0.0}), (ALL, {"aspect": 1.04, "skew": 0.01, "offset": 0.04})]
)
def test_constant_intrinsics_of_exact_cameras(generator, method, assume, options):
    scene = stack([projective_scene(generator, 8, **options) for _ in range(6)])
    found = method(scene.P, scene.X, image_size=SIZE, visible=scene.visible, assume=assume)
    right = (found.K / scene.K[:, 0] - 1).nan_to_num(0.0, 0.0, 0.0).abs().amax((-2, -1)) < 1e-3
    assert (found.status == Status.OK).sum() >= 5
    assert right[found.status == Status.OK].all()


@pytest.mark.parametrize("noise", [0.0, 0.3])
@pytest.mark.parametrize("motion", ["orbital", "translation"])
def test_two_views_that_leave_the_focal_length_open(generator, motion, noise):
    scene = stack([projective_scene(generator, 2, motion=motion, noise=noise, offset=0.0) for _ in range(10)])
    found = constant_intrinsics(scene.P, scene.X, image_size=SIZE, visible=scene.visible, assume=FOCAL)
    error = (found.K[:, 0, 0] / scene.K[:, 0, 0, 0]).log().abs()
    # One redundant equation may fit by luck, but is then said to tell little.
    assert not ((found.status == Status.OK) & (error > 6 * found.deviation)).any()
    if noise == 0:
        assert (found.status != Status.OK).all()


def test_two_views_in_general(generator):
    scene = stack([projective_scene(generator, 2, noise=0.3, offset=0.0) for _ in range(20)])
    found = constant_intrinsics(scene.P, scene.X, image_size=SIZE, visible=scene.visible, assume=FOCAL)
    good = found.status == Status.OK
    assert good.sum() >= 14
    error = (found.K[:, 0, 0] / scene.K[:, 0, 0, 0]).log().abs()
    # One redundant constraint is now and then so well met that it says too little of the noise.
    assert_share((error < 6 * found.deviation)[good], 0.98)
    assert ((error < 6 * found.deviation) | (error < 0.05))[good].all()


@pytest.mark.parametrize("assume", [FOCAL, ALL])
def test_kruppa_with_exact_pairs(generator, assume):
    # From some starts the first step leads to focal lengths whose squares overflow, where everything would seem to fit.
    scenes = [projective_scene(generator, 6, offset=0.0) for _ in range(20)]
    F = torch.stack([fundamentals(s) for s in scenes])
    found = intrinsics_from_kruppa(F, image_size=SIZE, assume=assume)
    truth = torch.stack([s.K[0] for s in scenes])
    assert (found.status == Status.OK).all()
    error = (found.K - truth).abs().amax((-2, -1)) / truth[:, 0, 0]
    assert error.max() < 1e-3


@pytest.mark.parametrize(("assume", "K"), [(FOCAL, intrinsic()), (ALL, intrinsic(aspect=1.03, skew=8.0, offset=40.0))])
def test_a_turning_camera(generator, assume, K):
    R = turns(generator, 6)
    H = K @ R @ torch.linalg.inv(K) * torch.randn(6, 1, 1, generator=generator, dtype=torch.float64)
    found = intrinsics_from_rotations(H, image_size=SIZE, assume=assume)
    assert found.status == Status.OK
    assert (found.K - K).abs().max() < 1e-2
    noisy = H + 1e-3 * H.norm(dim=(-2, -1), keepdim=True) * torch.randn(H.shape, generator=generator, dtype=torch.float64) / 1e3
    again = intrinsics_from_rotations(noisy, image_size=SIZE, assume=FOCAL)
    assert again.deviation > 0


def test_turns_that_tell_nothing(generator):
    K = intrinsic()
    roll = torch.zeros(5, 3, dtype=torch.float64)
    roll[:, 2] = torch.linspace(0.1, 1.0, 5)
    H = K @ rotation_from_rotvec(roll) @ torch.linalg.inv(K)
    H = H + 1e-6 * torch.randn(H.shape, generator=generator, dtype=torch.float64)
    found = intrinsics_from_rotations(torch.stack([H, H * torch.nan]), image_size=SIZE)
    assert found.status[0] == Status.DEGENERATE
    assert found.status[1] == Status.TOO_FEW
    assert found.K.isfinite().all()


@pytest.mark.parametrize(("assume", "m", "offset"), [(FOCAL, 4, 0.0), (Assumption(principal_point_sigma=None), 7, 25.0)])
def test_an_unknown_plane(generator, assume, m, offset):
    K = intrinsic(offset=offset)
    normal = torch.nn.functional.normalize(torch.tensor([0.3, -0.4, 1.0], dtype=torch.float64), dim=0)
    R, t = turns(generator, m, 0.35), torch.randn(m, 3, generator=generator, dtype=torch.float64)
    H = K @ (R + 0.5 * t[..., None] * normal) @ torch.linalg.inv(K)
    found = intrinsics_from_plane(H, image_size=SIZE, assume=assume)
    assert found.status == Status.OK
    assert (found.K - K).abs().max() < 0.02 * 1300 * 1e-2
    weights = torch.ones(m, dtype=torch.float64)
    weights[0] = 0
    H[0] = torch.nan
    assert (intrinsics_from_plane(H, image_size=SIZE, assume=assume, weights=weights).K - K).abs().max() < 5


def test_weighing_beats_not_weighing(generator):
    """The classical constraints on noisy cameras are near the truth, and farther from it than the weighed ones."""
    from torchsfm.autocalibration import autocalibrate_points

    scene = stack([projective_scene(generator, 6, noise=1.0, offset=0.0) for _ in range(60)])
    plain = constant_intrinsics(scene.P, scene.X, image_size=SIZE, visible=scene.visible, assume=FOCAL)
    best = autocalibrate_points(scene.P, scene.X, scene.x, image_size=SIZE, visible=scene.visible, assume=FOCAL)
    truth = scene.K[:, 0, 0, 0]
    plain_error = (plain.K[:, 0, 0] / truth - 1).abs()
    error = (best.K[:, 0, 0, 0] / truth - 1).abs()
    assert plain_error.median() < 0.05
    assert error.square().mean() < plain_error.square().mean()


def test_wrong_input(unchecked):
    eye = torch.eye(3, dtype=torch.float64).expand(4, 3, 3)
    varying = Assumption(varying=("focal",))
    for method in (intrinsics_from_kruppa, intrinsics_from_plane, intrinsics_from_rotations):
        with pytest.raises(ValueError, match="the same in all views"):
            method(eye, image_size=SIZE, assume=varying)
        with pytest.raises(ValueError, match="wanted shape"):
            method(eye[..., :2], image_size=SIZE)
