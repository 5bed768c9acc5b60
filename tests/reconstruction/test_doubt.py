"""What a finished model says of its own cameras, on scenes that are right, folded, or wrong in one camera."""

import math
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Camera, Pose, intrinsics
from torchsfm.geometry.distortion import Radial
from torchsfm.geometry.rotations import random_rotation, rotation_from_rotvec
from torchsfm.reconstruction.attempts import Attempt, matches_across
from torchsfm.reconstruction.evidence.consistency import excess_scatter, pair_agreement
from torchsfm.reconstruction.evidence.doubt import Standing, examine
from torchsfm.reconstruction.evidence.missing import Conflicts, missing_correspondences
from torchsfm.reconstruction.mappers.growth import Component, Growth, Wanted
from torchsfm.reconstruction.mappers.incremental import MappingOptions
from torchsfm.reconstruction.mappers.settle import settle
from torchsfm.reconstruction.mapping.adjust import LOSS, adjust
from torchsfm.reconstruction.mapping.calibration import ENOUGH, ENOUGH_OF_FEW, calibration_of, observation_weights
from torchsfm.reconstruction.mapping.camera_prior import CameraPrior
from torchsfm.reconstruction.mapping.mapping import Adjustment, Mapping
from torchsfm.reconstruction.matching.view_graph import ViewGraph
from torchsfm.reconstruction.model.evaluation import pose_errors
from torchsfm.simulation import look_at

SIZE = (640, 480)


def cameras_on_an_arc(v: int, sweep: float, distance: float = 10.0, swing: float = 0.5) -> Pose:
    """Cameras around the origin, looking at it."""
    angle = torch.linspace(0, sweep, v, dtype=torch.float64)
    centre = torch.stack((distance * angle.sin(), -distance * angle.cos(), swing * (3 * angle).sin()), -1)
    return look_at(centre, torch.zeros(3, dtype=torch.float64))


def mapping_of(
    poses: Pose, X: Tensor, sees: Tensor, generator: torch.Generator, noise: float = 0.5, focal: float = 600.0
) -> Mapping:
    """A model of the points that the views see inside their images, and every pair of views with its true matches."""
    v, n = sees.shape
    zero = torch.zeros(1, dtype=torch.float64)
    middle = torch.tensor([[SIZE[0] / 2, SIZE[1] / 2]], dtype=torch.float64)
    camera = Camera(intrinsics(torch.full((1,), focal, dtype=torch.float64), middle), Radial(zero, zero))
    X_cam = poses.transform(X.expand(v, n, 3))
    x = camera[torch.zeros(v, dtype=torch.long)].project(X_cam)
    sees = sees & (x >= 1).all(-1) & (x < torch.tensor(SIZE) - 2).all(-1)
    sees &= sees.sum(0) >= 2
    view, point = sees.nonzero(as_tuple=True)
    node = torch.full((v, n), -1)
    node[view, point] = torch.arange(len(view))
    pairs = torch.combinations(torch.arange(v))
    both = sees[pairs].all(1)
    match_pair, shared = both.nonzero(as_tuple=True)
    match = torch.stack([node[pairs[match_pair, k], shared] for k in range(2)], 1)
    kept, number = torch.unique(point, return_inverse=True)
    count = both.sum(1)
    eye = torch.eye(3, dtype=torch.float64).repeat(len(pairs), 1, 1)
    graph = ViewGraph(
        names=tuple(f"{i}.png" for i in range(v)),
        image_size=torch.tensor([SIZE] * v),
        x=x[view, point] + noise * torch.randn(len(view), 2, generator=generator, dtype=torch.float64),
        view=view,
        color=torch.zeros(len(view), 3, dtype=torch.float64),
        pairs=pairs,
        num_matches=count,
        F=eye,
        H=eye,
        fundamental_inliers=count,
        homography_inliers=torch.zeros_like(count),
        match=match,
        match_pair=match_pair,
    )
    start = Mapping.start(graph, number, camera, torch.zeros(v, dtype=torch.long))
    return replace(start, poses=poses, registered=torch.ones(v, dtype=torch.bool), X=X[kept], point=number)


def cloud(n: int, generator: torch.Generator, low: tuple[float, ...], high: tuple[float, ...]) -> Tensor:
    a, b = (torch.tensor(side, dtype=torch.float64) for side in (low, high))
    return a + (b - a) * torch.rand(n, 3, generator=generator, dtype=torch.float64)


def scene(generator: torch.Generator, v: int = 8, n: int = 600, share: float = 0.6) -> Mapping:
    """One cloud, each point seen in each view with one probability."""
    X = cloud(n, generator, (-3, -2, -2.5), (3, 2, 2.5))
    return mapping_of(cameras_on_an_arc(v, 0.8), X, torch.rand(v, n, generator=generator) < share, generator)


def folded(generator: torch.Generator, v: int = 12) -> Mapping:
    """Two places at which one thing stands, taken for one: every other camera sees the surroundings of the other place."""
    thing, around = cloud(400, generator, (-3, -1, 0), (3, 1, 2.5)), cloud(500, generator, (-3, -1, -2.5), (3, 1, -0.8))
    sees = torch.rand(v, 900, generator=generator) < 0.6
    place = torch.arange(v) % 2
    sees[:, 400:] &= place[:, None] == torch.arange(500) % 2
    return mapping_of(cameras_on_an_arc(v, 0.6), torch.cat([thing, around]), sees, generator)


def distant(generator: torch.Generator, v: int = 14) -> Mapping:
    """Cameras with a narrow field of view that all look along one plane, each point seen by some next to each other."""
    X = cloud(800, generator, (-3, -3, -2), (3, 3, 2))
    near = (torch.arange(v)[:, None] - v * torch.rand(800, generator=generator)).abs() < 2.5
    return mapping_of(cameras_on_an_arc(v, 1.2, 200.0, 0.0), X, near, generator, focal=12000.0)


def hinged(model: Mapping, angle: float, first: int) -> Mapping:
    """The model with the images from one on, and what they see, turned about the normal of the plane of the cameras."""
    turn = rotation_from_rotvec(torch.tensor([0.0, 0.0, angle], dtype=torch.float64))
    moved = torch.arange(len(model.registered)) >= first
    poses = replace(model.poses, R=torch.where(moved[:, None, None], model.poses.R @ turn.mT, model.poses.R))
    node = model.point >= 0
    point = torch.where(node & moved[model.graph.view], model.point + len(model.X), model.point)
    return replace(model, poses=poses, X=torch.cat([model.X, model.X @ turn.mT]), point=point).compacted()


def stand(mapping: Mapping, focal_sigma: float = 0.5, uncertain: Tensor | None = None) -> Standing:
    """The standing of a model whose focal length was known so well, as a fraction, before it was made."""
    prior = CameraPrior.of(mapping, mapping.cameras, torch.full((1,), focal_sigma, dtype=torch.float64))
    return examine(mapping, open_numbers=("focal", "k1"), prior=prior, threshold=4.0, uncertain=uncertain)


def judged(mapping: Mapping) -> tuple[str, ...]:
    return stand(mapping).doubt


def test_a_right_model_is_not_doubted(generator: torch.Generator) -> None:
    for _ in range(20):
        mapping = scene(generator)
        conflicts = missing_correspondences(mapping)
        assert len(conflicts.pairs) > 0
        assert not len(conflicts.refuted)
        assert judged(mapping) == ("",) * 8


def test_a_folded_model_is_doubted_whole(generator: torch.Generator) -> None:
    for _ in range(10):
        mapping = folded(generator)
        refuted = missing_correspondences(mapping).refuted
        assert len(refuted) > 1
        # Only cameras at different places miss what the others see.
        assert ((refuted[:, 0] + refuted[:, 1]) % 2 == 1).all()
        assert all("look alike" in reason for reason in judged(mapping))


def test_images_beyond_a_hinge_are_doubted(generator: torch.Generator) -> None:
    for _ in range(4):
        mapping = distant(generator)
        assert judged(mapping) == ("",) * 14
        bent = hinged(mapping, 0.7, 9)
        # No pair contradicts the poses: rays of distant cameras meet whatever the angle between these.
        poses = pair_agreement(bent, threshold=4.0, poses_alone=True)
        assert poses.agreeing.sum() > 0.95 * poses.matches.sum()
        assert not poses.contradicts.any()
        doubts = judged(bent)
        assert all("contradict" in reason for reason in doubts[9:])
        assert not any("to most others" in reason for reason in doubts[:9])


def test_conflicts_that_are_known_are_those_that_are_found(generator: torch.Generator) -> None:
    mapping = folded(generator)
    prior = CameraPrior.of(mapping, mapping.cameras, torch.full((1,), 0.5, dtype=torch.float64))
    known = {"open_numbers": ("focal", "k1"), "prior": prior, "threshold": 4.0}
    given = examine(mapping, conflicts=missing_correspondences(mapping), **known)  # type: ignore[arg-type]
    assert given.doubt == judged(mapping)
    none = missing_correspondences(scene(generator, v=len(mapping.registered)))
    assert not any("look alike" in reason for reason in examine(mapping, conflicts=none, **known).doubt)  # type: ignore[arg-type]


def test_whether_a_model_is_folded_is_asked_once(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    mapping, asked = scene(generator, v=8), []
    whether = Conflicts.folded.fget
    assert whether is not None
    monkeypatch.setattr(Conflicts, "folded", property(lambda self: asked.append(1) or whether(self)))
    judged(mapping)
    assert len(asked) == 1


def test_deviations_of_cameras_do_not_depend_on_where_their_covariance_comes_from(generator: torch.Generator) -> None:
    names = ("focal", "k1", "k2", "principal_point")
    mapping = scene(generator)
    free = {name: torch.ones(1, dtype=torch.bool) for name in names}
    mapping = replace(mapping, adjustment=Adjustment(Status.OK, 3, free))
    prior = CameraPrior.of(mapping, mapping.cameras, torch.full((1,), 0.5, dtype=torch.float64))
    weights = observation_weights(mapping, LOSS)
    standing = examine(mapping, open_numbers=names, prior=prior, threshold=4.0, weights=weights)
    known = standing.intrinsics
    assert known is not None
    plain, given, other = (
        calibration_of(mapping, prior, loss=LOSS, weights=weights, covariance=covariance, excess=standing.excess)
        for covariance in (None, (names, known), (("focal",), torch.eye(1).double()[None]))
    )
    assert bool((plain.deviation > 0).all())
    assert given.deviation.allclose(plain.deviation, rtol=1e-4)
    # Of other numbers it says nothing.
    assert other.deviation.equal(plain.deviation)


def test_what_hides_points_explains_that_they_are_missing(generator: torch.Generator) -> None:
    mapping = folded(generator)
    # Something seen by all stands before the surroundings, wide enough for the cameras at both ends of the arc.
    screen = cloud(800, generator, (-4.5, -4, -3), (4.5, -3.8, -0.3))
    X = torch.cat([mapping.X, screen])
    v = len(mapping.registered)
    sees = torch.zeros(v, len(X), dtype=torch.bool)
    sees[mapping.graph.view, mapping.point] = True
    sees[:, len(mapping.X) :] = torch.rand(v, len(screen), generator=generator) < 0.6
    assert not len(missing_correspondences(mapping_of(mapping.poses, X, sees, generator)).refuted)


def test_matches_agree_with_right_poses_alone(generator: torch.Generator) -> None:
    for _ in range(10):
        mapping = scene(generator)
        right = pair_agreement(mapping, threshold=4.0)
        assert right.agreeing.sum() > 0.99 * right.matches.sum()
        assert right.supports.all()
        axis = torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
        delta = torch.zeros(8, 6, dtype=torch.float64)
        delta[3, :3] = math.radians(20) * axis
        wrong = pair_agreement(replace(mapping, poses=mapping.poses.retract(delta)), threshold=4.0)
        own = (wrong.pairs == 3).any(1)
        assert wrong.supports[~own].all()
        assert not wrong.supports[own].any()
        assert wrong.balance(8)[3] < 0
        assert (wrong.balance(8)[torch.arange(8) != 3] > 0).all()


def test_a_camera_that_its_pairs_contradict_is_doubted(generator: torch.Generator) -> None:
    mapping = scene(generator)
    delta = torch.zeros(8, 6, dtype=torch.float64)
    delta[3, :3] = torch.tensor([0.2, 0.2, 0.2])
    # It keeps the few points that fit a wrong pose, as a camera does that was registered by chance.
    turned = replace(mapping, poses=mapping.poses.retract(delta))
    error = turned.errors(turned.point, torch.arange(len(turned.point)))
    point = torch.where((turned.graph.view == 3) & (error > 30), -1, turned.point)
    doubt = judged(replace(turned, point=point))
    assert "contradict" in doubt[3]


@pytest.mark.parametrize("clean", [-1, 0])
def test_places_that_leave_many_matches_unexplained_are_doubted(clean: int, generator: torch.Generator) -> None:
    """Of things that repeat, a pair has matches of another relation, too; most may still agree with the model.

    If a single view has right matches only, the model that it is part of has not.
    """
    mapping = scene(generator)
    graph = mapping.graph
    share = 0.6 if clean < 0 else 0.8
    start = torch.searchsorted(graph.view, torch.arange(8))
    wrong, pair = [], []
    for number, (q, n) in enumerate(_sizes(mapping)):
        i, j = graph.pairs[number].tolist()
        if clean not in (i, j):
            rows = torch.randint(0, int(n), (int(share * q), 1), generator=generator)
            wrong.append(torch.cat((start[i] + rows, start[j] + rows.flip(0)), 1))
            pair.append(torch.full((len(rows),), number))
    ambiguous = replace(graph, match=torch.cat([graph.match, *wrong]), match_pair=torch.cat([graph.match_pair, *pair]))
    doubt = judged(replace(mapping, graph=ambiguous))
    if clean < 0:
        assert pair_agreement(replace(mapping, graph=ambiguous), threshold=4.0).supports.all()
        assert all("matches of its pairs agree" in reason for reason in doubt)
    else:
        assert "matches of all pairs agree" in doubt[clean]
        assert all(doubt)


def test_images_that_agree_with_fewer_than_half_are_doubted(generator: torch.Generator) -> None:
    mapping = scene(generator)
    for marked in range(9):
        uncertain = torch.randperm(8, generator=generator) < marked
        doubt = stand(mapping, uncertain=uncertain).doubt
        if marked <= 4:
            assert [bool(reason) for reason in doubt] == uncertain.tolist()
        else:
            assert all(doubt)
            assert all(("most images" in reason) != bool(u) for reason, u in zip(doubt, uncertain, strict=True))


def _sizes(mapping: Mapping) -> list[tuple[Tensor, Tensor]]:
    """For each pair the number of its matches, and the smaller number of image points of its two views."""
    graph = mapping.graph
    points = torch.bincount(graph.view, minlength=len(graph.names))
    matches = torch.bincount(graph.match_pair, minlength=len(graph.pairs))
    return list(zip(matches, points[graph.pairs].amin(1), strict=True))


def test_deviations_do_not_depend_on_the_frame(generator: torch.Generator) -> None:
    mapping = scene(generator)
    R = random_rotation(generator=generator, dtype=torch.float64)
    shift = torch.tensor([3.0, -2.0, 1.0], dtype=torch.float64)
    X = 7 * mapping.X @ R.mT + shift
    R_cam = mapping.poses.R @ R.mT
    moved = replace(mapping, X=X, poses=Pose(R_cam, 7 * mapping.poses.t - (R_cam @ shift)))
    first, second = stand(mapping, 0.01), stand(moved, 0.01)
    torch.testing.assert_close(first.rotation_sigma, second.rotation_sigma, rtol=1e-5, atol=0)
    torch.testing.assert_close(first.position_sigma, second.position_sigma, rtol=0.05, atol=0)
    assert (first.rotation_sigma > 0).all()


def test_images_that_are_not_registered_have_no_standing(generator: torch.Generator) -> None:
    mapping = scene(generator)
    registered = torch.arange(8) != 5
    point = torch.where(mapping.graph.view == 5, -1, mapping.point)
    standing = stand(replace(mapping, registered=registered, point=point).compacted())
    assert standing.rotation_sigma[5] == torch.inf
    assert standing.position_sigma[5] == torch.inf
    assert standing.rotation_sigma[registered].isfinite().all()
    assert standing.doubt == ("",) * 8


@pytest.mark.parametrize("guessed", [True, False])
def test_two_images_with_a_guessed_focal_length_are_doubted(guessed: bool, generator: torch.Generator) -> None:
    mapping = scene(generator, v=2)
    doubt = stand(mapping, 0.5 if guessed else 0.01).doubt
    assert all(("focal" in reason) == guessed for reason in doubt)


def test_a_camera_of_few_points_is_less_well_known(generator: torch.Generator) -> None:
    mapping = scene(generator, n=600)
    # The last camera keeps four points of one corner: a rotation and a place are not known from them.
    own = (mapping.graph.view == 7).nonzero()[:, 0]
    point = mapping.point.clone()
    point[own[4:]] = -1
    standing = stand(replace(mapping, point=point).compacted())
    assert standing.rotation_sigma[7] > 3 * standing.rotation_sigma[:7].max()


def options(mapping: Mapping) -> MappingOptions:
    sigma = torch.full((1,), 0.05, dtype=torch.float64)
    return MappingOptions(free=("focal",), expected=mapping.cameras, focal_sigma=sigma)


def misplaced(mapping: Mapping, images: list[int], generator: torch.Generator) -> Mapping:
    """The images turned and moved, left with those of their observations that fit by chance."""
    delta = torch.zeros(len(mapping.registered), 6, dtype=torch.float64)
    delta[images] = 0.3 * torch.randn(6, generator=generator, dtype=torch.float64)
    turned = replace(mapping, poses=mapping.poses.retract(delta))
    error = turned.errors(turned.point, torch.arange(len(turned.point)))
    moved = torch.isin(turned.graph.view, torch.tensor(images))
    return replace(turned, point=torch.where(moved & (error > 10), -1, turned.point)).compacted()


def test_a_contradicted_camera_is_put_right(generator: torch.Generator) -> None:
    for _ in range(3):
        mapping = scene(generator)
        wrong = misplaced(mapping, [3], generator)
        settled, parted, _ = settle(wrong, torch.zeros(8, dtype=torch.bool), options(mapping), lambda n, v: None)
        assert settled.registered.all()
        assert not parted
        errors = pose_errors(settled.poses, mapping.poses)
        assert errors.image_rotation.max() < 0.5
        assert not any(judged(settled))


def test_a_model_of_two_halves_is_parted(generator: torch.Generator) -> None:
    mapping = scene(generator, v=10)
    a, b = mapping.graph.match.unbind(1)
    pairs = mapping.graph.pairs
    across = (pairs < 4).sum(1) == 1
    # Matches between the halves that no poses explain: each says that the points lie elsewhere.
    shuffled = b.clone()
    wrong = across[mapping.graph.match_pair]
    for q in across.nonzero()[:, 0].tolist():
        own = (mapping.graph.match_pair == q).nonzero()[:, 0]
        shuffled[own] = b[own[torch.randperm(len(own), generator=generator)]]
    graph = replace(mapping.graph, match=torch.stack([a, shuffled], 1))
    assert wrong.any()
    settled, parted, _ = settle(
        replace(mapping, graph=graph), torch.zeros(10, dtype=torch.bool), options(mapping), lambda n, v: None
    )
    assert settled.registered.tolist() == [False] * 4 + [True] * 6
    assert sorted(parted) == [0, 1, 2, 3]


def test_scatter_tells_common_errors_from_independent_ones(generator: torch.Generator) -> None:
    for _ in range(3):
        mapping = scene(generator, share=0.35)
        independent = excess_scatter(adjust(mapping, free=None), threshold=4.0)
        assert independent < 1.5
        # Whole regions of each image lie off by about the noise, as where highlights and outlines pass for marks.
        graph = mapping.graph
        region = (graph.view * 16 + (graph.x[:, 0] / SIZE[0] * 4).long() * 4 + (graph.x[:, 1] / SIZE[1] * 4).long()).clamp(0)
        offset = torch.randn(int(region.max()) + 1, 2, generator=generator, dtype=torch.float64)
        bent = replace(mapping, graph=replace(graph, x=graph.x + offset[region]))
        assert excess_scatter(adjust(bent, free=None), threshold=4.0) > 2 * independent


def test_deviations_of_cameras_know_of_errors_in_common(generator: torch.Generator) -> None:
    mapping = scene(generator, share=0.35)
    graph = mapping.graph
    region = (graph.view * 16 + (graph.x[:, 0] / SIZE[0] * 4).long() * 4 + (graph.x[:, 1] / SIZE[1] * 4).long()).clamp(0)
    offset = torch.randn(int(region.max()) + 1, 2, generator=generator, dtype=torch.float64)
    mapping = replace(mapping, graph=replace(graph, x=graph.x + offset[region]))
    for sigma in (0.5, 1e-6):
        choices = MappingOptions(("focal",), mapping.cameras, torch.tensor([sigma], dtype=torch.float64))
        prior = choices.prior(mapping)
        adjusted = adjust(mapping, free={"focal": torch.ones(1, dtype=torch.bool)}, prior=prior, max_iterations=100)
        growth = Mock(Growth, begun=SimpleNamespace(options=choices), taken=adjusted.registered, given_up=~adjusted.registered)
        component = Component(adjusted, choices, off_centre=False)
        attempt = Attempt(adjusted.graph, Wanted(free_principal_point=False), growth, (component,))
        standing, told = attempt.judge(component)
        weights = observation_weights(adjusted, LOSS, enough=ENOUGH)
        alone = calibration_of(adjusted, prior, loss=LOSS, weights=weights).deviation[0, 0]
        assert standing.excess > 2
        # By as much as rotations and places; what was known before is not known less.
        grown = standing.excess**0.5 if sigma > 0.1 else 1.0
        assert float(told.deviation[0, 0] / alone) == pytest.approx(grown, rel=0.05)


def test_what_was_held_is_still_uncertain(generator: torch.Generator) -> None:
    mapping = scene(generator)
    known, guessed = stand(mapping, 1e-6), stand(mapping, 0.5)
    assert (known.rotation_sigma < guessed.rotation_sigma).all()


def test_a_group_on_a_hinge_is_doubted_unless_a_third_image_sees_it(generator: torch.Generator) -> None:
    """Five images see one cloud, three another; two of them see 40 points between the clouds."""
    X = torch.cat((cloud(300, generator, (-3, -2, -2.5), (3, 2, 2.5)), cloud(40, generator, (-3, -2, -2.5), (3, 2, 2.5))))
    for third in (False, True):
        sees = torch.zeros(8, 340, dtype=torch.bool)
        sees[:5, :150] = sees[5:, 150:300] = sees[4:6, 300:] = True
        sees[6, 300:] = third
        doubt = judged(mapping_of(cameras_on_an_arc(8, 0.8), X, sees, generator))
        hanging = ["holds it, with 2 more," in reason for reason in doubt]
        assert hanging == [False] * 5 + [not third] * 3


def test_a_model_of_images_that_have_more_in_common_with_another(generator: torch.Generator) -> None:
    mapping = scene(generator)
    own = torch.arange(8) < 4
    across = matches_across(mapping.graph, own, ~own)
    pairs, count = mapping.graph.pairs, mapping.graph.fundamental_inliers
    between = own[pairs].sum(1) == 1
    assert int(across.sum()) == int(count[between].sum())
    assert not across[~own].any()
    prior = CameraPrior.of(mapping, mapping.cameras, torch.full((1,), 0.5, dtype=torch.float64))
    known = {"open_numbers": ("focal", "k1"), "prior": prior, "threshold": 4.0}
    matches = torch.zeros(8, dtype=torch.long).index_add_(0, pairs.flatten(), count.repeat_interleave(2))
    for more, doubtful in ((-1, 0), (1, 3)):
        elsewhere = torch.where(torch.arange(8) < 3, matches + more, 0)
        doubt = examine(mapping, elsewhere=elsewhere, **known).doubt  # type: ignore[arg-type]
        assert [("another model" in reason) for reason in doubt] == [i < doubtful for i in range(8)]


def test_tracks_of_two_views_wait_for_cameras_that_longer_ones_place(generator: torch.Generator) -> None:
    poses, X = cameras_on_an_arc(6, 1.5), cloud(320, generator, (-3, -3, -3), (3, 3, 3))
    sees = torch.zeros(6, 320, dtype=torch.bool)
    sees[:5, :200] = True
    sees[0:2, 200:240] = sees[4:, 240:280] = sees[3:, 280:] = True
    mapping = mapping_of(poses, X, sees, generator)
    first, then = (observation_weights(mapping, LOSS, enough=enough) for enough in (100, None))
    problem = mapping.problem()
    length = torch.bincount(problem.point)
    placed, open_end = ((length == 2) & (torch.bincount(problem.point, problem.view == v) > 0) for v in (1, 5))
    long = (length > 2)[problem.point]
    assert float(first[placed[problem.point]].max()) <= 0.01
    # The last image has forty long tracks alone, and needs the others.
    assert float(first[open_end[problem.point]].median()) > 0.4
    assert first[long].equal(then[long])
    assert float(then[~long].median()) > 0.6
    # Of few images it would be judged by these alone.
    judged_by = observation_weights(mapping, LOSS, enough=ENOUGH_OF_FEW)
    assert float(judged_by[open_end[problem.point]].max()) <= 0.01


def test_few_images_that_do_not_tell_the_focal_length(generator: torch.Generator) -> None:
    for sweep, doubtful in ((0.1, True), (1.2, False)):
        X, sees = cloud(120, generator, (-3, -2, -0.5), (3, 2, 0.5)), torch.ones(3, 120, dtype=torch.bool)
        mapping = mapping_of(cameras_on_an_arc(3, sweep), X, sees, generator)
        assert [("hardly determine" in reason) for reason in judged(mapping)] == [doubtful] * 3
        assert not any("hardly determine" in reason for reason in stand(mapping, 1e-3).doubt)
    # Many such images are told of by their deviations alone.
    X, sees = cloud(120, generator, (-3, -2, -0.5), (3, 2, 0.5)), torch.ones(8, 120, dtype=torch.bool)
    assert not any("hardly determine" in reason for reason in judged(mapping_of(cameras_on_an_arc(8, 0.1), X, sees, generator)))


def test_deviations_do_not_rest_on_tracks_of_two_views(generator: torch.Generator) -> None:
    """A camera with a focal length of its own before a wall; the little that it sees before the wall, wrong, says 5 % more."""
    wall, before = cloud(300, generator, (-3, -0.02, -2), (3, 0.02, 2)), cloud(30, generator, (-3, -3, -2), (3, -1, 2))
    poses = cameras_on_an_arc(6, 1.0)
    poses = poses[torch.arange(5, -1, -1)]  # The last one looks at the wall from the front.
    sees = torch.ones(6, 330, dtype=torch.bool)
    sees[:4, 300:] = False
    mapping = mapping_of(poses, torch.cat((wall, before)), sees, generator, noise=0.3)
    cameras = Camera(mapping.cameras.K.repeat(2, 1, 1), Radial(*torch.zeros(2, 2, dtype=torch.float64)))
    own = mapping.graph.view == 5
    mapping = replace(mapping, cameras=cameras, camera_index=(torch.arange(6) == 5).long())
    K = cameras.K.clone()
    K[:, [0, 1], [0, 1]] *= 1.05
    farther = replace(poses, t=torch.where(torch.arange(6)[:, None] == 5, 1.05, 1.0) * poses.t)
    longer = replace(mapping, poses=farther, cameras=replace(cameras, K=torch.stack((cameras.K[0], K[1]))))
    wrong = (own & (torch.bincount(mapping.point)[mapping.point] == 2)).nonzero()[:, 0]
    assert len(wrong) > 15
    x = mapping.graph.x.clone()
    x[wrong] = longer.project(mapping.point[wrong], mapping.graph.view[wrong])[0]
    prior = CameraPrior.of(mapping, mapping.cameras, torch.tensor([1e-4, 0.4], dtype=torch.float64))
    free = {"focal": torch.tensor([False, True])}
    mapping = replace(longer, graph=replace(mapping.graph, x=x))
    for _ in range(3):
        weights = observation_weights(mapping, LOSS)
        mapping = adjust(mapping, free=free, prior=prior, weights=weights, max_iterations=100)
    off = abs(float(mapping.cameras.K[1, 0, 0]) - 600)
    rest = calibration_of(mapping, prior, loss=LOSS, weights=observation_weights(mapping, LOSS)).deviation[1, 0]
    options = MappingOptions(("focal",), mapping.cameras, torch.tensor([1e-4, 0.4], dtype=torch.float64))
    begun = SimpleNamespace(options=options)
    growth = Mock(Growth, begun=begun, taken=mapping.registered, given_up=~mapping.registered)
    component = Component(mapping, options, off_centre=False)
    _, told = Attempt(mapping.graph, Wanted(free_principal_point=False), growth, (component,)).judge(component)
    assert off > 8 * float(rest)
    assert off < 3 * float(told.deviation[1, 0])
