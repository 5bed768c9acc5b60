import dataclasses

import pytest
import torch
from chance import assert_share, assert_unit_variance
from projective_scenes import MOTIONS, SIZE, projective_scene, stack
from torch import Tensor

from torchsfm._types import Status
from torchsfm.autocalibration import Assumption, autocalibrate_points
from torchsfm.geometry import project_points, rotation_angle, similarity_from_points
from torchsfm.optim.dense import DenseProblem

ALL = Assumption(free=("focal", "aspect", "skew", "principal_point"), principal_point_sigma=None)
VARYING = Assumption(varying=("focal",))


def solve(scene, **options):
    return autocalibrate_points(scene.P, scene.X, scene.x, image_size=SIZE, visible=scene.visible, **options)


def focal_error(found, scene) -> Tensor:
    return (found.K[..., 0, 0] / scene.K[..., 0, 0] - 1).abs().amax(-1)


@pytest.mark.parametrize(
    ("assume", "options"),
    [
        (Assumption(), {}),
        (ALL, {"aspect": 1.05, "skew": 0.01, "offset": 0.06}),
        (VARYING, {"varying": True}),
        (Assumption(free=("focal", "aspect", "principal_point"), varying=("focal",)), {"varying": True, "aspect": 0.97}),
    ],
    ids=["constant", "all five", "varying", "varying with aspect"],
)
@pytest.mark.parametrize("v", [6, 15])
def test_exact_scenes(generator, assume, options, v):
    scene = stack([projective_scene(generator, v, **options) for _ in range(6)])
    found = solve(scene, assume=assume)
    assert (found.status == Status.OK).all()
    # Priors pull by what the smallest noise assumed, a hundredth of a pixel, leaves open.
    assert focal_error(found, scene).max() < 2e-4
    assert (found.K - scene.K).abs().max() < 2e-4 * SIZE[0] * 4
    assert (found.in_front == 1).all()


def test_the_metric_model_is_the_true_one(generator):
    scene = stack([projective_scene(generator, 8, offset=0.0) for _ in range(4)])
    found = solve(scene, assume=Assumption(free=("focal",)))
    assert (found.status == Status.OK).all()
    x = project_points(found.P, found.X[:, None])
    assert (x - scene.x)[scene.visible].norm(dim=-1).max() < 1e-4
    R = torch.linalg.solve(found.K, found.P[..., :3])
    assert (rotation_angle(R @ R[:, :1].mT @ (scene.R @ scene.R[:, :1].mT).mT)).max() < 1e-5
    centre = -torch.linalg.solve(found.P[..., :3], found.P[..., 3:])[..., 0]
    aligned = similarity_from_points(centre, scene.centre).transform(centre)
    assert (aligned - scene.centre).norm(dim=-1).max() < 1e-4 * scene.centre.norm(dim=-1).max()
    # H takes what was given to the metric model.
    P = scene.P @ found.upgrade[:, None]
    cosine = torch.nn.functional.cosine_similarity(P.flatten(-2), found.P.flatten(-2), dim=-1)
    assert (cosine.abs() > 1 - 1e-8).all()
    X = (found.upgrade @ torch.cat((found.X, torch.ones_like(found.X[..., :1])), -1).mT).mT
    assert (torch.nn.functional.cosine_similarity(X, scene.X, dim=-1).abs() > 1 - 1e-8).all()


def test_the_answer_does_not_depend_on_the_frame(generator):
    scene = projective_scene(generator, 7, noise=1.0)
    found = solve(scene)
    frame = torch.randn(4, 4, generator=generator, dtype=torch.float64)
    frame[:, 0] *= -torch.linalg.det(frame).sign()
    moved = dataclasses.replace(scene, P=-3 * (scene.P @ frame), X=torch.linalg.solve(frame, scene.X.mT).mT)
    again = solve(moved)
    assert torch.allclose(again.K, found.K, rtol=1e-7)
    assert (again.P - found.P).abs().max() < 1e-7 * found.P.abs().max()
    order = torch.randperm(7, generator=generator)
    moved = dataclasses.replace(scene, P=scene.P[order], x=scene.x[order], visible=scene.visible[order])
    ratio = solve(moved).K[:, 0, 0] / found.K[order, 0, 0]
    assert (ratio.log().abs() < 0.01 * found.deviation[order, 0]).all()


def test_second_derivatives_are_for_the_best_alone(generator, monkeypatch):
    """And for what lies off it, two places; not for the search from many."""
    asked, curve = [], DenseProblem.curve

    def counted(problem, here, where):
        asked.append(len(where))
        return curve(problem, here, where)

    monkeypatch.setattr(DenseProblem, "curve", counted)
    for _ in range(3):
        solve(projective_scene(generator, 5, noise=1.0), assume=Assumption())
    assert asked
    assert max(asked) <= 2


def test_noise_stays_within_its_own_estimate(generator):
    scenes = {v: stack([projective_scene(generator, v, noise=1.0) for _ in range(12)]) for v in (5, 8)}
    scores = []
    for scene in scenes.values():
        found = solve(scene)
        assert (found.status == Status.OK).all()
        assert focal_error(found, scene).max() < 0.05
        assert ((found.noise - 1).abs() < 0.15).all()
        scores.append((found.K[:, 0, 0, 0] / scene.K[:, 0, 0, 0]).log() / found.deviation[:, 0, 0])
    assert_unit_variance(torch.cat(scores))


def test_focal_lengths_that_differ_are_noticed(generator):
    scene = stack([projective_scene(generator, 8, noise=1.0, varying=True) for _ in range(6)])
    found = solve(scene)
    assert (found.assumption == 1).all()
    assert (found.status == Status.OK).all()
    assert focal_error(found, scene).max() < 0.1
    alone = solve(scene, assume=Assumption())
    assert (alone.chi2 > 5 * alone.redundancy).all()


def test_three_views_through_a_lens_that_distorts_a_little(generator):
    options = {"noise": 0.3, "around": 0.8, "offset": 0.005, "distortion": 0.05}
    scene = stack([projective_scene(generator, 3, 80, **options) for _ in range(24)])
    found = solve(scene)
    accepted = found.status == Status.OK
    assert (~accepted).sum() <= 4
    # One focal length explains the images, though what is left of the distortion disturbs it.
    assert (found.assumption == 0).sum() >= 21
    assert not (accepted & (focal_error(found, scene) > 0.1)).any()
    score = (found.K[..., 0, 0] / scene.K[..., 0, 0]).log()[accepted] / found.deviation[..., 0][accepted]
    assert score.square().mean().sqrt() < 1.8
    bend = (found.distortion - scene.distortion) / found.distortion_deviation
    assert 0.4 < bend.square().mean().sqrt() < 1.8
    # Taken for a lens without distortion the same images say something else, and are too sure of it.
    plain = solve(scene, distortion_sigma=0.0)
    wrong = (plain.K[..., 0, 0] / scene.K[..., 0, 0]).log() / plain.deviation[..., 0]
    assert wrong.square().mean() > 1.5 * score.square().mean()


def test_a_lens_that_distorts_much_more_than_expected_is_refused(generator):
    scene = stack([projective_scene(generator, 4, 80, noise=0.3, distortion=0.1) for _ in range(12)])
    far = scene.distortion.abs() > 0.08
    assert far.any()
    assert (solve(scene, distortion_sigma=0.005).status[far] != Status.OK).all()
    straight = stack([projective_scene(generator, 4, 80, noise=0.3) for _ in range(4)])
    assert (solve(straight, distortion_sigma=0.005).status == Status.OK).all()


def test_deviations_hold_what_the_choice_leaves_open(generator):
    options = {"noise": 1.0, "around": 0.8, "varying": True, "variation": 0.03}
    scene = stack([projective_scene(generator, 3, 80, **options) for _ in range(24)])
    found = solve(scene)
    alone = [solve(scene, assume=assume) for assume in (Assumption(), VARYING)]
    chosen = torch.where(found.assumption[:, None] == 0, alone[0].deviation[..., 0], alone[1].deviation[..., 0])
    unsure = found.probability < 0.95
    assert unsure.any()
    apart = (alone[0].K[..., 0, 0] / alone[1].K[..., 0, 0]).log().abs()
    told = found.deviation[..., 0]
    assert (told >= 0.999 * (found.probability[:, None] * chosen.square()).sqrt()).all()
    kept = unsure & (found.assumption == 0)
    # As far apart as the deviation says, where the richer assumption is not held back by how little it is expected to vary.
    known = kept & (alone[1].deviation[..., 0] < 0.05).all(-1)
    assert known.any()
    least = (1 - found.probability)[:, None].sqrt() * apart
    assert (told > 0.5 * least)[known].all()
    scores = (found.K[..., 0, 0] / scene.K[..., 0, 0]).log()[found.valid] / told[found.valid]
    assert_share(scores.abs() < 3, 0.85)


@pytest.mark.parametrize("motion", MOTIONS)
def test_critical_motions_are_refused_or_reported(generator, motion):
    scene = stack([projective_scene(generator, 8, motion=motion, noise=1.0) for _ in range(3)])
    for assume in (Assumption(), ALL, (Assumption(), VARYING)):
        found = solve(scene, assume=assume)
        told = (found.status != Status.OK) | found.motion.critical
        assert told.all()
        assert not ((found.status == Status.OK) & (focal_error(found, scene) > 0.2)).any()
    if motion == "translation":
        assert (found.status != Status.OK).all()


def test_general_motion_is_not_called_critical(generator):
    scene = stack([projective_scene(generator, 8, noise=1.0) for _ in range(8)])
    assert solve(scene).motion.critical.sum() <= 1


def test_singular_values_are_the_deviations(generator):
    scene = projective_scene(generator, 8, noise=1.0)
    found = solve(scene, assume=ALL)
    (fit,) = found.fits
    assert fit.singular_values.shape == (5,)
    birge = (fit.chi2 / fit.redundancy).clamp_min(1)
    unknown = (fit.combinations**2 @ (birge / fit.singular_values**2)[:, None])[:, 0].sqrt()
    # The data outweigh the expectation of aspect and skew.
    assert abs(float(unknown[0] / found.deviation[0, 0]) - 1) < 0.2
    assert found.determined[:, 0].all()


def test_what_the_data_do_not_tell_is_the_assumption(generator):
    # Rotation about the vertical leaves the vertical scale open: with the aspect free nothing but its prior tells it.
    scene = projective_scene(generator, 8, motion="planar", noise=1.0)
    found = solve(scene, assume=Assumption(free=("focal", "aspect", "principal_point")))
    assert not found.determined[:, 1].any()


def test_bad_elements_change_nothing_else(generator):
    scenes = [projective_scene(generator, 6, noise=1.0) for _ in range(6)]
    good = solve(stack([scenes[0], scenes[5]]))
    P, X, x = (torch.stack([getattr(s, name) for s in scenes]) for name in ("P", "X", "x"))
    visible = torch.stack([s.visible for s in scenes])
    P[1] = torch.nan
    P[2, 3] = 0
    X[3, 5], x[3, :, 6] = torch.inf, torch.nan
    visible[4, 1:] = False
    whole = autocalibrate_points(P, X, x, image_size=SIZE, visible=visible)
    assert whole.status[1] == Status.TOO_FEW
    assert whole.status[4] == Status.TOO_FEW
    assert whole.status[3] == Status.OK
    assert whole.status[2] == Status.OK
    for field in dataclasses.fields(whole):
        value = getattr(whole, field.name)
        if isinstance(value, Tensor):
            assert value.isfinite().all(), field.name
            assert torch.allclose(value[[0, 5]].double(), getattr(good, field.name).double(), rtol=1e-9, atol=1e-9), field.name
    for k in (0, 3):
        alone = autocalibrate_points(P[k], X[k], x[k], image_size=SIZE, visible=visible[k])
        assert torch.allclose(alone.K, whole.K[k], rtol=1e-6)
        assert alone.status == whole.status[k]


def test_an_absent_view_is_left_out(generator):
    scene = projective_scene(generator, 8, noise=1.0)
    visible = scene.visible.clone()
    visible[3] = False
    found = autocalibrate_points(scene.P, scene.X, scene.x, image_size=SIZE, visible=visible)
    rest = [0, 1, 2, 4, 5, 6, 7]
    less = autocalibrate_points(scene.P[rest], scene.X, scene.x[rest], image_size=SIZE, visible=visible[rest])
    assert torch.allclose(found.K[rest], less.K, rtol=1e-6)
    assert found.redundancy == less.redundancy


def test_shapes(generator):
    scene = stack([projective_scene(generator, 4) for _ in range(6)])
    size = torch.tensor([SIZE], dtype=torch.float64)
    found = autocalibrate_points(scene.P.unflatten(0, (2, 3)), scene.X.unflatten(0, (2, 3)), image_size=size)
    assert found.K.shape == (2, 3, 4, 3, 3)
    assert found.covariance.shape == (2, 3, 4, 5, 5)
    empty = autocalibrate_points(scene.P[:0], scene.X[:0], image_size=size)
    assert empty.K.shape == (0, 4, 3, 3)
    single = autocalibrate_points(scene.P.float(), scene.X.float(), image_size=size.float())
    assert single.K.dtype == torch.float32


def test_wrong_input(generator, unchecked):
    scene = projective_scene(generator, 4)
    with pytest.raises(ValueError, match="X: wanted shape"):
        autocalibrate_points(scene.P, scene.X[:, :3], image_size=SIZE)
    with pytest.raises(ValueError, match="image_size"):
        autocalibrate_points(scene.P, scene.X, image_size=torch.ones(3, 2, dtype=torch.float64))
    with pytest.raises(ValueError, match="free: wanted names among"):
        Assumption(free=("focal", "zoom"))
    with pytest.raises(ValueError, match="distortion_sigma: wanted"):
        autocalibrate_points(scene.P, scene.X, image_size=SIZE, distortion_sigma=-1.0)
    with pytest.raises(ValueError, match="assume: wanted one Assumption or several"):
        autocalibrate_points(scene.P, scene.X, image_size=SIZE, assume=())
