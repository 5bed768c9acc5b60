"""Few images and guessed focal lengths: is another one told that explains them as well?"""

from dataclasses import replace

import pytest
import torch
from test_pair_poses import mapping_of
from test_reconstruct_tracks import Scene, make_scene
from torch import Tensor

from torchsfm.reconstruction.mappers import rivals
from torchsfm.reconstruction.mappers.incremental import grow_model
from torchsfm.reconstruction.mappers.rivals import rival_focal
from torchsfm.reconstruction.model.evaluation import pose_errors
from torchsfm.simulation import orbit_poses


def quiet(done: int, total: int) -> None:
    """No progress is shown."""


def judged(scene: Scene, sigma: float = 0.5) -> tuple[float, Tensor | None]:
    """The largest error of a model's pairs in degrees, and the focal lengths that rival its own."""
    empty, options = mapping_of(scene, 1000.0)
    options = replace(options, focal_sigma=torch.tensor([sigma], dtype=torch.float64))
    grown = grow_model(empty, options, quiet)
    assert grown is not None
    model = grown[0]
    errors = pose_errors(model.poses, scene.poses, model.registered).pose
    return float(errors[errors.isfinite()].max()), rival_focal(empty, model, options)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(9))
def test_a_wall_from_afar_is_not_wrong_without_a_word(seed: int) -> None:
    """It is seen from the wrong side, from too far or from too near, and fits to a few per cent."""
    error, rival = judged(
        make_scene(orbit_poses(3, radius=12.0, sweep=0.3), kind="plane", points=200, distortion=0.0, seed=seed)
    )
    assert rival is not None
    assert error < 25 or bool(rival.isfinite().all())


@pytest.mark.parametrize(
    ("explained", "times", "lost", "told"),
    [(0.97, 1.3, 0, True), (1.01, 0.8, 0, True), (0.95, 1.3, 0, False), (0.99, 1.1, 0, False), (1.2, 1.3, 1, False)],
)
def test_a_rival_explains_all_images_and_nearly_as_much(
    explained: float, times: float, lost: int, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_scene(orbit_poses(3, radius=5.0, sweep=0.5), points=100, distortion=0.0)
    empty, options = mapping_of(scene, 1000.0)
    options = replace(options, focal_sigma=torch.tensor([0.5], dtype=torch.float64))
    every = torch.ones(3, dtype=torch.bool)
    model = replace(empty, poses=scene.poses, registered=every)
    K = model.cameras.K.clone()
    K[:, :2, :2] *= times
    other = replace(model, cameras=replace(model.cameras, K=K), registered=torch.arange(3) >= lost)
    monkeypatch.setattr(rivals, "extend_model", lambda *_: (other, {}))
    monkeypatch.setattr(rivals, "support", lambda which, _: 100.0 if which is model else 100.0 * explained)
    rival = rival_focal(empty, model, options)
    assert rival is not None
    assert rival.isfinite().tolist() == [told] * 3
    assert not told or torch.allclose(rival, torch.tensor(1000.0 * times, dtype=torch.float64))


def test_what_has_depth_leaves_nothing_open() -> None:
    for seed in range(2):
        error, rival = judged(make_scene(orbit_poses(3, radius=5.0, sweep=0.5), points=200, distortion=0.0, seed=seed))
        assert error < 1.5
        assert rival is not None
        assert not bool(rival.isfinite().any())


def test_of_known_focal_lengths_and_of_many_images_none_is_looked_for() -> None:
    assert judged(make_scene(orbit_poses(3, radius=5.0, sweep=0.5), points=100), sigma=0.05)[1] is None
    assert judged(make_scene(orbit_poses(7, radius=5.0, sweep=1.4), points=100))[1] is None
