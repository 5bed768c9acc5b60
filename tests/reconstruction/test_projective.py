"""The road by factorisation and autocalibration."""

from dataclasses import replace

import pytest
import torch
from chance import seeded
from test_reconstruct_tracks import SIZE, Scene, make_scene, run

from torchsfm.geometry import Camera, Pose, Radial, intrinsics
from torchsfm.reconstruction import ReconstructionError
from torchsfm.reconstruction.mappers.projective import projective_start
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.matching.track_graph import graph_from_tracks
from torchsfm.reconstruction.model.evaluation import pose_errors
from torchsfm.simulation import orbit_poses


def wandering_poses(v: int, seed: int) -> Pose:
    """On an arc, at different heights and distances, looking past the scene's middle."""
    g = seeded(seed)
    poses = orbit_poses(v, radius=5.0, sweep=1.6)
    turn = 0.06 * torch.randn(v, 3, generator=g, dtype=torch.float64)
    shift = 0.4 * torch.randn(v, 3, generator=g, dtype=torch.float64)
    return poses.retract(torch.cat((turn, shift), -1))


@pytest.mark.parametrize("seed", [0])
def test_metric_model_from_tracks_alone(seed: int) -> None:
    scene = make_scene(wandering_poses(8, seed), seed=seed, points=250)
    result = run(scene, method="projective")
    model = result.model
    assert bool(model.registered.all())
    assert float(pose_errors(model.poses, scene.poses).pose.max()) < 0.5
    assert abs(float(model.cameras.K[0, 0, 0]) / scene.focal - 1) < 0.01
    assert abs(float(model.cameras.distortion.parameters()[0, 0]) + 0.08) < 0.02
    assert float(model.residuals().mean()) < 0.75
    (text,) = result.report.autocalibration
    assert "the same in all views" in text
    assert "determined by the images: focal length" in text
    assert result.report.focal_source == ("autocalibration",)
    assert "autocalibration" in result.report.summary()


@pytest.mark.parametrize("distortion", [-0.03, 0.03])
def test_a_lens_that_hardly_bends_is_passed_on(distortion: float) -> None:
    """Too little to be searched for, but autocalibration finds it."""
    scene = make_scene(wandering_poses(8, 0), points=250, distortion=distortion)
    color = torch.zeros(len(scene.x), 3, dtype=torch.float64)
    names = tuple(f"{i}" for i in range(8))
    track = torch.unique(scene.track, return_inverse=True)[1]
    graph, track = graph_from_tracks(names, scene.image_size, scene.x, scene.view, track, color, generator=seeded())
    zero = torch.zeros(1, dtype=torch.float64)
    K = intrinsics(torch.tensor([1200.0], dtype=torch.float64), torch.tensor([[499.5, 374.5]], dtype=torch.float64))
    empty = Mapping.start(graph, track, Camera(K, Radial(zero, zero)), torch.zeros(8, dtype=torch.long))
    start = projective_start(empty, ~empty.registered, threshold=4.0, min_angle=0.026)
    assert start is not None
    assert start.mapping is not None
    assert abs(float(start.mapping.cameras.distortion.parameters()[0, 0]) - distortion) < 0.02


def test_pure_translation_is_refused() -> None:
    g = seeded(3)
    centre = 0.8 * torch.randn(8, 3, generator=g, dtype=torch.float64) + torch.tensor([0.0, 0.0, -5.0])
    scene = make_scene(Pose(torch.eye(3, dtype=torch.float64).expand(8, 3, 3).clone(), -centre), points=120)
    result = run(scene, method="projective")
    assert not result.models
    assert "refused" in result.report.autocalibration[0]
    assert result.failure().startswith("autocalibration: ")


def test_two_scenes_make_two_models() -> None:
    a, b = (make_scene(wandering_poses(6, seed), seed=seed, points=120, outliers=0.0) for seed in (0, 1))
    both = replace(
        a,
        x=torch.cat((a.x, b.x)),
        view=torch.cat((a.view, b.view + 6)),
        track=torch.cat((a.track, b.track + int(a.track.max()) + 1)),
        image_size=torch.tensor([SIZE] * 12),
    )
    result = run(both, method="projective")
    assert [model.num_registered for model in result.models] == [6, 6]
    assert all(abs(float(m.cameras.K[0, 0, 0]) / Scene.focal - 1) < 0.02 for m in result.models)


def test_wrong_options() -> None:
    scene = make_scene(points=60)
    with pytest.raises(ReconstructionError, match="no method 'none'"):
        run(scene, method="none")
    with pytest.raises(ReconstructionError, match="finds the camera itself"):
        run(scene, method="projective", K=torch.eye(3, dtype=torch.float64))
