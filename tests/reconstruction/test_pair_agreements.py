"""How pairs agree with a model: by several thresholds at once, by its poses alone, and asked no more than once."""

from dataclasses import replace

import pytest
import torch
from chance import seeded
from test_pair_poses import mapping_of
from test_reconstruct_tracks import make_scene

from torchsfm.geometry import Pose, rotation_from_rotvec
from torchsfm.reconstruction.evidence import consistency
from torchsfm.reconstruction.evidence.consistency import PairAgreement, pair_agreement, pair_agreements
from torchsfm.reconstruction.mappers import unfold as unfolding
from torchsfm.reconstruction.mappers.global_start import complete, fill
from torchsfm.reconstruction.mappers.incremental import MappingOptions
from torchsfm.reconstruction.mapping.mapping import Mapping


def filled() -> tuple[Mapping, Mapping, MappingOptions]:
    """A mapping of nothing, and a model of all images."""
    scene = make_scene(distortion=0.0)
    empty, options = mapping_of(scene, 1100.0)
    every = torch.ones_like(empty.registered)
    return empty, complete(fill(replace(empty, poses=scene.poses, registered=every), options), options), options


def same(one: PairAgreement, other: PairAgreement) -> bool:
    names = ("pairs", "matches", "agreeing", "index", "by_poses")
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in names)


def test_several_thresholds_say_what_each_says() -> None:
    _, model, _ = filled()
    turn = rotation_from_rotvec(3e-3 * torch.randn(len(model.registered), 3, generator=seeded(1), dtype=torch.float64))
    bent = replace(model, poses=Pose(turn @ model.poses.R, model.poses.t))
    limits = (1.0, 4.0)
    for alone in (True, False):
        told = pair_agreements(bent, limits, poses_alone=alone)
        apart = [pair_agreement(bent, threshold=limit, poses_alone=alone) for limit in limits]
        assert all(same(one, other) for one, other in zip(told, apart, strict=True))
        assert not torch.equal(told[0].agreeing, told[1].agreeing)
    by_points, by_poses = (pair_agreement(bent, threshold=4.0, poses_alone=alone) for alone in (False, True))
    assert same(by_points.of_poses, by_poses)
    assert int((by_points.agreeing < by_poses.agreeing).sum()) > 0


def test_what_is_known_of_pairs_is_not_found_out_again(monkeypatch: pytest.MonkeyPatch) -> None:
    empty, model, options = filled()
    agreement = pair_agreement(model, threshold=options.reprojection)

    def asked(*model: object, **how: object) -> PairAgreement:
        raise AssertionError("asked again")

    monkeypatch.setattr(unfolding, "pair_agreement", asked)
    given = model, ~model.registered, options, lambda done, total: None
    found = unfolding.unfold(empty, *given, agreement=agreement)
    assert found.model is model
    assert same(found.agreement, pair_agreement(model, threshold=options.reprojection, poses_alone=True))
    # What was found with other matches says nothing of these.
    with pytest.raises(AssertionError, match="asked again"):
        unfolding.unfold(replace(empty, graph=replace(empty.graph)), *given, agreement=agreement)


def test_one_camera_is_looked_at_once() -> None:
    """Rays of one camera are those of several that are alike, bit for bit."""
    _, model, _ = filled()
    node, v = torch.arange(len(model.graph.view)), len(model.registered)
    lens = model.cameras.distortion.from_parameters(torch.tensor([[-0.1, 0.02]], dtype=torch.float64))
    one = replace(model, cameras=replace(model.cameras, distortion=lens))
    several = replace(one, cameras=one.cameras[torch.zeros(v, dtype=torch.long)], camera_index=torch.arange(v))
    for mine, other in zip(one.rays(node), several.rays(node), strict=True):
        assert torch.equal(mine, other)
    told = [consistency.pair_agreement(m, threshold=4.0) for m in (one, several)]
    assert same(*told)
