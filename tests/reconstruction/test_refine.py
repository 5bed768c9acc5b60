"""How often a model in which all images are is adjusted."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from chance import seeded
from test_pair_poses import mapping_of
from test_reconstruct_tracks import make_scene

from torchsfm.reconstruction.mappers import incremental
from torchsfm.reconstruction.mappers.global_start import complete, fill, tighten
from torchsfm.reconstruction.mappers.incremental import extend_model, finish
from torchsfm.reconstruction.mappers.settle import _without_images
from torchsfm.reconstruction.mapping import adjust
from torchsfm.reconstruction.mapping.adjust import adjust_all
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.model.evaluation import pose_errors


@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_nothing_is_adjusted_for_the_sake_of_little(lost: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice, whether all observations are there from the start or a part comes back after the first time."""
    scene = make_scene(distortion=0.0)
    empty, options = mapping_of(scene, 1100.0)
    every = torch.ones_like(empty.registered)
    model = complete(fill(replace(empty, poses=scene.poses, registered=every), options), options)
    gone = torch.rand(len(model.point), generator=seeded(1)) < lost
    model = replace(model, point=torch.where(gone, -1, model.point)).compacted()
    tolerances: list[float] = []

    def recorded(*given: Any, **how: Any) -> Mapping:
        tolerances.append(how["tolerance"])
        return adjust_all(*given, **how)

    monkeypatch.setattr(incremental, "adjust_all", recorded)
    refined, _ = extend_model(model, ~every, options, lambda done, total: None)
    first, last = tolerances
    assert last < first
    assert int((refined.point >= 0).sum()) > 0.95 * int((empty.track >= 0).sum() * 0.95)
    # It is about at its minimum: `finish`, which goes there, moves no camera by more than its noise.
    moved = pose_errors(finish(refined, options).poses, refined.poses).pose
    assert float(moved.max()) < 0.1


def test_what_few_points_determine_of_cameras_is_not_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """All images are in when cameras are first adjusted with those that were placed at once, also for the principal point."""
    scene = make_scene(distortion=0.0)
    empty, options = mapping_of(scene, 1100.0)
    options, every = replace(options, free=("focal", "principal_point")), torch.ones_like(empty.registered)
    filled = fill(replace(empty, poses=scene.poses, registered=every), options)
    few = filled.without(torch.arange(len(filled.point))[filled.point % 2 == 1])
    start = tighten(few, 2.0, options)
    assert start.adjustment is not None
    assert set(start.adjustment.free) == set(options.free)
    assert all(bool(mask.all()) for mask in start.adjustment.free.values())
    asked: list[Mapping] = []

    def recorded(mapping: Mapping, *given: Any, **how: Any) -> dict[str, torch.Tensor]:
        asked.append(mapping)
        return choose_free(mapping, *given, **how)

    choose_free = adjust.choose_free
    monkeypatch.setattr(adjust, "choose_free", recorded)
    whole = replace(fill(start, options), adjustment=start.adjustment)
    refined, _ = extend_model(whole, ~every, options, lambda done, total: None)
    assert not asked
    assert refined.adjustment is not None
    assert set(refined.adjustment.free) == set(options.free)
    # What images that are taken out have determined is open again.
    left = _without_images(whole, torch.arange(len(every)) == 0)
    extend_model(left, torch.arange(len(every)) == 0, options, lambda done, total: None)
    assert asked
