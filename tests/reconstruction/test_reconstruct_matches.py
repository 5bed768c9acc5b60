"""From keypoints and matches of any program to a model."""

from types import ModuleType

import pytest
import torch
from chance import seeded
from test_reconstruct_tracks import Scene, make_scene

from torchsfm.reconstruction import MatchedImages, SfmResult, reconstruct_matches
from torchsfm.reconstruction.evidence import doubt
from torchsfm.reconstruction.mappers import growth, incremental, unfold
from torchsfm.reconstruction.mapping import adjust
from torchsfm.reconstruction.model.evaluation import pose_errors


def matched(scene: Scene, *, wrong: float = 0.2, seed: int = 0) -> MatchedImages:
    """The scene as a matcher would see it: keypoints of each image in any order, some matches wrong and of low weight."""
    g = seeded(seed)
    v = len(scene.image_size)
    keypoints, tracks = [], []
    for i in range(v):
        own = (scene.view == i).nonzero()[:, 0]
        own = own[torch.randperm(len(own), generator=g)]
        keypoints.append(scene.x[own])
        tracks.append(scene.track[own])
    pairs, matches, weights = [], [], []
    for i in range(v):
        for j in range(i + 1, v):
            same = (tracks[i][:, None] == tracks[j]).nonzero()
            false = torch.rand(len(same), generator=g) < wrong
            same[false, 1] = torch.randint(len(tracks[j]), (int(false.sum()),), generator=g)
            pairs.append((i, j))
            matches.append(same)
            weights.append(torch.where(false, 0.3, 0.7) + 0.3 * torch.rand(len(same), generator=g))
    names = tuple(f"{i}.jpg" for i in range(v))
    return MatchedImages(names, scene.image_size, tuple(keypoints), torch.tensor(pairs), tuple(matches), tuple(weights))


def run(m: MatchedImages, **options: object) -> SfmResult:
    return reconstruct_matches(m.keypoints, m.pairs, m.matches, m.image_size, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("weighted", [False, True])
def test_the_scene_is_found(weighted: bool) -> None:
    scene = make_scene(points=300, outliers=0.0)
    m = matched(scene)
    result = run(m, weights=m.weights if weighted else None, names=m.names)
    model = result.model
    assert bool(model.registered.all())
    assert model.names == m.names
    assert float(pose_errors(model.poses, scene.poses).pose.max()) < 2
    assert float(model.residuals().mean()) < 0.75
    assert model.num_points > 250
    # The observations are keypoints of their images.
    for i in range(len(m.names)):
        assert bool(torch.isin(model.x[model.view == i, 0], m.keypoints[i][:, 0]).all())


def test_missing_correspondences_are_looked_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was found of a model when it was made serves to judge it."""
    m, looks = matched(make_scene(points=300, outliers=0.0)), list[str]()

    def spy(room: ModuleType) -> None:
        find = room.missing_correspondences
        monkeypatch.setattr(room, "missing_correspondences", lambda mapping: (looks.append(room.__name__), find(mapping))[1])

    spy(unfold)
    spy(doubt)
    assert bool(run(m).model.registered.all())
    assert looks == [unfold.__name__]


def test_how_pairs_agree_and_what_cameras_are_known_to_is_found_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was found of the same model before serves to judge it, and to say how well its cameras are known."""
    m, looks = matched(make_scene(points=300, outliers=0.0)), list[str]()

    def spy(room: ModuleType, name: str) -> None:
        find = getattr(room, name)
        monkeypatch.setattr(room, name, lambda *given, **options: (looks.append(name), find(*given, **options))[1])

    spy(doubt, "pair_agreement")
    spy(adjust, "choose_free")
    result = run(m)
    assert bool(result.model.registered.all())
    assert "pair_agreement" not in looks
    (found,) = result.report.calibrations
    assert found.estimated.all()
    # Each time as it grows, and once of the whole, which hardly changes between its last adjustments.
    grown = looks.count("choose_free")
    monkeypatch.setattr(incremental, "_refine", lambda model, options: model)
    looks.clear()
    run(m)
    assert grown == looks.count("choose_free") + 1


def test_order_of_pairs_and_matches_that_are_absent_do_not_matter() -> None:
    """A pair turned round, given in two parts, with doubled matches and others of weight 0 and NaN, is the same pair."""
    m = matched(make_scene(points=150, outliers=0.0))
    assert m.weights is not None
    half = [len(rows) // 2 for rows in m.matches]
    pairs = torch.cat([m.pairs, m.pairs.flip(1)])
    first = [rows[:k] for rows, k in zip(m.matches, half, strict=True)]
    second = [torch.cat([rows[k:], rows[:5], rows[:1]]).flip(1) for rows, k in zip(m.matches, half, strict=True)]
    none = torch.tensor([0.0, torch.nan])
    none = torch.cat([none[:1].expand(5), none[1:]])
    trust = [w[:k] for w, k in zip(m.weights, half, strict=True)]
    trust += [torch.cat([w[k:], none]) for w, k in zip(m.weights, half, strict=True)]
    plain, other = (
        run(m, weights=m.weights),
        reconstruct_matches(m.keypoints, pairs, first + second, m.image_size, weights=trust),
    )
    assert torch.equal(plain.model.X, other.model.X)
    assert torch.equal(plain.model.poses.t, other.model.poses.t)


def test_keypoints_that_are_not_finite_match_nothing() -> None:
    m = matched(make_scene(points=150, outliers=0.0))
    keypoints = [x.clone() for x in m.keypoints]
    keypoints[2][::7] = torch.nan
    result = reconstruct_matches(keypoints, m.pairs, m.matches, m.image_size)
    assert bool(result.model.registered.all())
    assert bool(result.model.x.isfinite().all())
    assert bool(result.model.X.isfinite().all())


def test_known_cameras_and_focal_lengths_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growth, "part_zoomed", lambda *given: pytest.fail("cameras are known"))
    scene = make_scene(points=200, outliers=0.0)
    m = matched(scene)
    index = torch.tensor([0, 1] * 4)
    result = run(m, camera_index=index, focal=[1100.0, None] * 4)
    assert torch.equal(result.model.camera_index, index)
    assert result.report.focal_source[0] == "exif"
    assert result.report.focal_source[1] != "exif"
    K = torch.tensor([[1100.0, 0, 499.5], [0, 1100.0, 374.5], [0, 0, 1]], dtype=torch.float64)
    known = run(m, K=K, camera="radial").model
    assert torch.equal(known.cameras.K[0], K)


def test_nothing_matches() -> None:
    m = matched(make_scene(points=50))
    empty = run(m, weights=[torch.zeros(len(rows)) for rows in m.matches])
    assert not empty.models
    assert len(empty.report.images) == 8
    nothing = reconstruct_matches(m.keypoints, torch.zeros(0, 2, dtype=torch.long), [], m.image_size)
    assert not nothing.models


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"keypoints": []}, r"keypoints: wanted 8 entries, one for each image, got 0"),
        ({"matches": []}, r"matches: wanted 28 entries, one for each pair, got 0"),
        ({"weights": [torch.ones(3)] * 28}, r"weights\[0\]: "),
        ({"pairs": torch.full((28, 2), 8)}, r"pairs: wanted indices from 0 to 7, got 8 to 8"),
        ({"pairs": torch.full((28, 2), 1)}, r"pairs: wanted two images, got image 1 twice in pair 0"),
        ({"matches": [torch.tensor([[0, 10**6]])] * 28}, r"matches\[0\]: wanted indices of the"),
        ({"focal": [1.0]}, r"focal: wanted 8 entries"),
        ({"threshold": 0.0}, r"threshold: wanted float > 0"),
    ],
)
def test_wrong_arguments_are_named(change: dict[str, object], words: str) -> None:
    m = matched(make_scene(points=50))
    good = {"keypoints": m.keypoints, "pairs": m.pairs, "matches": m.matches, "image_size": m.image_size}
    with pytest.raises(ValueError, match=words):
        reconstruct_matches(**(good | change))  # type: ignore[arg-type]
