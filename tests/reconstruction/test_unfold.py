"""Two places that look alike: which relations are distinctive, and how a folded model is put right."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from chance import seeded
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import Camera, Pose, intrinsics, rotation_from_euler
from torchsfm.geometry.distortion import Radial
from torchsfm.motion.many_views.components import components
from torchsfm.reconstruction.evidence.consistency import pair_agreement
from torchsfm.reconstruction.evidence.distinctive import Backbone, Distinctiveness
from torchsfm.reconstruction.evidence.doubt import examine
from torchsfm.reconstruction.evidence.groups import outvoted_groups
from torchsfm.reconstruction.evidence.missing import Conflicts, missing_correspondences
from torchsfm.reconstruction.mappers import unfold as unfolding
from torchsfm.reconstruction.mappers.beginning import grow_by
from torchsfm.reconstruction.mappers.incremental import MappingOptions, grow_model
from torchsfm.reconstruction.mappers.settle import settle
from torchsfm.reconstruction.mappers.unfold import Unfolded, hanging_on_copies, imitated, outvoted_by_rivals, unfold
from torchsfm.reconstruction.mapping.camera_prior import CameraPrior
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.tracks import build_tracks
from torchsfm.reconstruction.matching.view_graph import ViewGraph
from torchsfm.reconstruction.model.evaluation import pose_errors
from torchsfm.simulation import look_at
from torchsfm.tensors import fundamental_from_cameras

SIZE = (640, 480)
VIEWS = 14
THING, AROUND = 260, 700


def street(generator: torch.Generator, apart: float) -> tuple[Mapping, Pose, Bool[Tensor, "q"]]:
    """Cameras along a street with two copies of one thing, `apart` from each other.

    Every pair of images has the matches of the relation for which it has the most: the true one, or the one that takes the one
    copy for the other. Also given are the true poses, and which pairs have true matches.
    """

    def uniform(n: int, *bounds: tuple[float, float]) -> Float[Tensor, "n 3"]:
        low, high = torch.tensor(bounds, dtype=torch.float64).T
        return low + (high - low) * torch.rand(n, 3, generator=generator, dtype=torch.float64)

    thing = uniform(THING, (-1.2, 1.2), (5.0, 7.0), (-1.5, 1.5))
    shift = torch.tensor([apart / 2, 0.0, 0.0], dtype=torch.float64)
    reach = apart / 2 + 5
    X = torch.cat([thing - shift, thing + shift, uniform(AROUND, (-reach, reach), (5.0, 8.0), (-2.2, 2.2))])
    along = torch.linspace(-apart / 2 - 1.2, apart / 2 + 1.2, VIEWS, dtype=torch.float64)
    centre = torch.stack([along, 0.6 * (2 * along).sin(), 0.3 * along.cos()], -1)
    poses = look_at(centre, centre * torch.tensor([1.0, 0.0, 0.0]) + torch.tensor([0.0, 6.0, 0.0]))
    zero = torch.zeros(1, dtype=torch.float64)
    middle = torch.tensor([[SIZE[0] / 2, SIZE[1] / 2]], dtype=torch.float64)
    camera = Camera(intrinsics(torch.full((1,), 600.0, dtype=torch.float64), middle), Radial(zero, zero))
    x = camera[torch.zeros(VIEWS, dtype=torch.long)].project(poses.transform(X.expand(VIEWS, -1, -1)))
    inside = ((x >= 1) & (x < torch.tensor(SIZE) - 2)).all(-1)
    sees = inside & (torch.rand(inside.shape, generator=generator) < 0.7)
    view, point = sees.nonzero(as_tuple=True)
    node = torch.full(sees.shape, -1)
    node[view, point] = torch.arange(len(view))
    # The same thing at the other place.
    other = torch.arange(len(X))
    other[: 2 * THING] = other[: 2 * THING].roll(THING)
    copies = torch.arange(len(X)) < 2 * THING
    pairs = torch.combinations(torch.arange(VIEWS))
    matches, true = [], []
    for i, j in pairs.tolist():
        right = torch.stack([node[i], node[j]], 1)[sees[i] & sees[j]]
        wrong = torch.stack([node[i], node[j, other]], 1)[sees[i] & sees[j, other] & copies]
        true.append(len(right) >= len(wrong))
        chosen = right if true[-1] else wrong
        matches.append(chosen if len(chosen) >= 15 else chosen[:0])
    count = torch.tensor([len(m) for m in matches])
    eye = torch.eye(3, dtype=torch.float64).repeat(len(pairs), 1, 1)
    graph = ViewGraph(
        names=tuple(f"{i}.png" for i in range(VIEWS)),
        image_size=torch.tensor([SIZE] * VIEWS),
        x=x[view, point] + 0.4 * torch.randn(len(view), 2, generator=generator, dtype=torch.float64),
        view=view,
        color=torch.zeros(len(view), 3, dtype=torch.float64),
        pairs=pairs,
        num_matches=count,
        F=eye,
        H=eye,
        fundamental_inliers=count,
        homography_inliers=torch.zeros_like(count),
        match=torch.cat(matches),
        match_pair=torch.arange(len(pairs)).repeat_interleave(count),
    )
    track = build_tracks(graph.view, graph.match, graph.fundamental_inliers[graph.match_pair])
    empty = Mapping.start(graph, track, camera, torch.zeros(VIEWS, dtype=torch.long))
    return empty, poses, torch.tensor(true)


def options(empty: Mapping) -> MappingOptions:
    sigma = torch.full((1,), 0.05, dtype=torch.float64)
    return MappingOptions(
        free=("focal",), expected=empty.cameras, focal_sigma=sigma, generator=torch.Generator().manual_seed(0)
    )


def quiet(done: int, total: int) -> None:
    """No progress is shown."""


def mapped(empty: Mapping) -> Mapping:
    grown = grow_model(empty, options(empty), quiet)
    assert grown is not None
    return settle(grown[0], empty.registered, options(empty), quiet)[0]


def wrong_cameras(model: Mapping, truth: Pose) -> int:
    """Cameras more than five per cent of the street's length from where they are, after the best similarity."""
    errors = pose_errors(model.poses, truth, model.registered)
    return int((errors.image_position > 0.05 * (truth.centre[-1] - truth.centre[0]).norm())[model.registered].sum())


@pytest.fixture(scope="module")
def folded() -> tuple[Mapping, Pose, Mapping]:
    """A street, its true poses, and the model in which both copies are at one place."""
    empty, truth, _ = street(seeded(), apart=8.0)
    model = mapped(empty)
    assert wrong_cameras(model, truth) > 0
    return empty, truth, model


def test_the_backbone_passes_by_copies(generator: torch.Generator) -> None:
    fooled = 0
    for _ in range(10):
        empty, _, true = street(generator, apart=8.0)
        graph = empty.graph
        assert not true.all()
        assert true[Backbone.of(graph.pairs, Distinctiveness.of(graph).weight, VIEWS).chosen].all()
        fooled += int(not true[Backbone.of(graph.pairs, graph.fundamental_inliers.double(), VIEWS).chosen].all())
    # The scenes are not so easy that numbers of matches would do.
    assert fooled > 0


@pytest.mark.parametrize("method", ["incremental", "global"])
def test_a_folded_model_is_put_right(folded: tuple[Mapping, Pose, Mapping], method: str) -> None:
    empty, truth, model = folded
    unfolded = unfold(empty, model, empty.registered, options(empty), quiet, partial(grow_by, method))
    assert unfolded.model.registered.all()
    assert wrong_cameras(unfolded.model, truth) == 0
    assert not unfolded.uncertain.any()
    assert not len(missing_correspondences(unfolded.model).refuted)
    # The pairs that took one copy for the other have no say in it any more.
    left = torch.unique(unfolded.model.graph.match_pair)
    assert set(left.tolist()) < set(empty.graph.match_pair.tolist())


def test_what_nothing_refutes_is_left_alone(generator: torch.Generator) -> None:
    empty, truth, true = street(generator, apart=8.0)
    graph = empty.graph.only(true)
    right = replace(empty, graph=graph, track=build_tracks(graph.view, graph.match))
    model = mapped(right)
    assert wrong_cameras(model, truth) == 0
    unfolded = unfold(right, model, right.registered, options(right), quiet)
    assert unfolded.model is model
    assert not unfolded.uncertain.any()


def test_what_contradicts_the_most_distinctive_relations_is_doubted(
    folded: tuple[Mapping, Pose, Mapping], monkeypatch: pytest.MonkeyPatch
) -> None:
    empty, _, model = folded
    # Nothing better is found.
    monkeypatch.setattr("torchsfm.reconstruction.mappers.unfold.ROUNDS", 0)
    unfolded = unfold(empty, model, empty.registered, options(empty), quiet)
    assert unfolded.model is model
    assert unfolded.uncertain.any()


def test_what_distinctive_relations_give_again_was_refuted_by_chance(
    generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A right model that is refuted once, and not when its backbone gives it again, is kept and leaves no image uncertain."""
    empty, truth, true = street(generator, apart=8.0)
    graph = empty.graph.only(true)
    right = replace(empty, graph=graph, track=build_tracks(graph.view, graph.match))
    model, asked = mapped(right), []
    chance = Conflicts(torch.tensor([[0, 1], [1, 2]]), torch.tensor([12.0, 12.0]).double(), 10.0, torch.arange(VIEWS))

    def refuted_at_first(model: Mapping) -> Conflicts:
        asked.append(model)
        return chance if len(asked) == 1 else replace(chance, score=torch.tensor([12.0, 9.0]).double())

    monkeypatch.setattr(unfolding, "missing_correspondences", refuted_at_first)
    unfolded = unfold(right, model, right.registered, options(right), quiet)
    assert chance.folded
    assert len(asked) == 2
    assert unfolded.model is model
    assert not unfolded.conflicts.folded
    assert not unfolded.uncertain.any()
    assert wrong_cameras(asked[1], truth) == 0


def test_halves_that_only_copies_connect_are_parted(generator: torch.Generator) -> None:
    empty, truth, true = street(generator, apart=8.0)
    across = (empty.graph.pairs < VIEWS // 2).sum(1) == 1
    graph = empty.graph.only(~(across & true))
    half = replace(empty, graph=graph, track=build_tracks(graph.view, graph.match, graph.fundamental_inliers[graph.match_pair]))
    folded = mapped(half)
    unfolded = unfold(half, folded, half.registered, options(half), quiet)
    own = unfolded.model.registered
    assert own.reshape(2, -1).any(1).tolist().count(True) == 1
    assert wrong_cameras(unfolded.model, truth) == 0
    # Had relations been given up that are more distinctive than those of the half, which are wrong?
    inside = own[graph.pairs].all(1)[graph.match_pair]
    few = ~inside | (torch.rand(len(inside), generator=generator) < 0.2)
    thin = replace(graph, match=graph.match[few], match_pair=graph.match_pair[few])
    uncertain = hanging_on_copies(thin, unfolded.model, ~own, threshold=4.0)
    assert uncertain.any()
    assert not uncertain[~own].any()


def test_matches_along_epipolar_lines_alone_do_not_come_in(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pair that joins different points, at places where their rays meet, is left out: the points are elsewhere."""
    empty, truth, true = street(generator, apart=8.0)
    graph = empty.graph
    model = mapped(replace(empty, graph=graph.only(true), track=build_tracks(graph.view, graph.only(true).match)))
    P = model.cameras.K[0] @ model.poses.matrix()
    seen = (model.point >= 0) & (torch.bincount(model.point.clamp(min=0), minlength=1)[model.point.clamp(min=0)] >= 3)
    first, second = ((seen & (graph.view == k)).nonzero()[:, 0] for k in (2, 6))
    line = torch.nn.functional.pad(graph.x[first], (0, 1), value=1.0) @ fundamental_from_cameras(P[2], P[6]).mT
    away = (line @ torch.nn.functional.pad(graph.x[second], (0, 1), value=1.0).mT).abs() / line[:, None, :2].norm(dim=-1)
    away[empty.track[first][:, None] == empty.track[second]] = torch.inf
    false = torch.stack([first, second[away.argmin(1)]], 1)
    pair = int((graph.pairs == torch.tensor([2, 6])).all(1).nonzero())
    others = graph.only(true & (torch.arange(len(true)) != pair))
    match = torch.cat([others.match, false])
    of = torch.cat([others.match_pair, torch.full((len(false),), pair)])
    count = torch.bincount(of, minlength=len(true))
    wrong = replace(graph, match=match, match_pair=of, num_matches=count, fundamental_inliers=count)
    poses, points = (pair_agreement(replace(model, graph=wrong), threshold=4.0, poses_alone=alone) for alone in (True, False))
    assert bool(poses.supports[poses.index == pair])
    assert bool(points.contradicts[points.index == pair])
    chance = Conflicts(torch.tensor([[0, 1], [1, 2]]), torch.tensor([12.0, 12.0]).double(), 10.0, torch.arange(VIEWS))
    answers = iter([replace(chance, score=torch.tensor([13.0, 13.0]).double()), chance])
    monkeypatch.setattr(unfolding, "ROUNDS", 1)
    monkeypatch.setattr(unfolding, "missing_correspondences", lambda model: next(answers))
    kept = replace(empty, graph=wrong, track=build_tracks(graph.view, others.match))
    unfolded = unfold(kept, model, kept.registered, options(kept), quiet)
    assert unfolded.model is not model
    assert pair not in unfolded.model.graph.match_pair
    assert wrong_cameras(unfolded.model, truth) == 0


def test_only_pairs_as_distinctive_as_those_believed_say_how_groups_stand(generator: torch.Generator) -> None:
    empty, truth, true = street(generator, apart=8.0)
    graph = empty.graph.only(true)
    model = mapped(replace(empty, graph=graph, track=build_tracks(graph.view, graph.match)))
    assert wrong_cameras(model, truth) == 0
    # Matches of copies with each other would outvote the right ones.
    assert outvoted_groups(pair_agreement(replace(model, graph=empty.graph), threshold=4.0), model.registered).any()
    assert not outvoted_by_rivals(empty.graph, model, threshold=4.0).any()
    apart = torch.arange(VIEWS) < 4
    turn = rotation_from_euler(torch.where(apart, 0.4, 0.0)[:, None].double(), "y")
    poses = replace(model.poses, R=model.poses.R @ turn)
    bent = replace(model, poses=poses, point=torch.where(apart[model.graph.view], -1, model.point)).compacted()
    assert torch.equal(outvoted_by_rivals(empty.graph, bent, threshold=4.0), apart)


@pytest.mark.parametrize("rival", [0.5, 0.95, 1.05])
def test_what_is_hardly_more_distinctive_than_its_rival_is_uncertain(rival: float, generator: torch.Generator) -> None:
    """A chain of three images, and a pair of its first with one elsewhere that has a share of the weakest link's matches."""
    n = 400
    # Images 0 to 3, the last of another model; what each pair shows is its own.
    numbers = {(0, 1): n, (1, 2): 2 * n, (0, 3): int(rival * n)}
    pairs = torch.tensor(list(numbers))
    count = torch.tensor(list(numbers.values()))
    ends = pairs.repeat_interleave(count, 0)
    match = torch.arange(2 * len(ends)).reshape(-1, 2)
    view, order = ends.flatten().sort(stable=True)
    graph = ViewGraph(
        names=("a", "b", "c", "d"),
        image_size=torch.tensor([SIZE] * 4),
        x=torch.rand(len(view), 2, generator=generator, dtype=torch.float64),
        view=view,
        color=torch.zeros(len(view), 3, dtype=torch.float64),
        pairs=pairs,
        num_matches=count,
        F=torch.eye(3, dtype=torch.float64).repeat(3, 1, 1),
        H=torch.eye(3, dtype=torch.float64).repeat(3, 1, 1),
        fundamental_inliers=count,
        homography_inliers=torch.zeros_like(count),
        match=order.argsort()[match],
        match_pair=torch.arange(3).repeat_interleave(count),
    )
    distinct = Distinctiveness.of(graph)
    assert distinct.weight.tolist() == count.tolist() == distinct.variance.tolist()
    backbone = Backbone.of(pairs, torch.tensor([1.0, 1.0, 0.0]), 4)
    false = torch.tensor([False, False, True])
    found = imitated(distinct, backbone, false, torch.tensor([True, True, True, False]))
    assert found.tolist() == [rival > 0.9, False, False]


def test_uncertain_images_are_doubted(generator: torch.Generator) -> None:
    empty, _, true = street(generator, apart=8.0)
    graph = empty.graph.only(true)
    model = mapped(replace(empty, graph=graph, track=build_tracks(graph.view, graph.match)))
    prior = CameraPrior.of(model, model.cameras, torch.full((1,), 0.05, dtype=torch.float64))
    uncertain = torch.arange(VIEWS) < 3
    plain, told = (
        examine(model, open_numbers=("focal",), prior=prior, threshold=4.0, uncertain=marked).doubt
        for marked in (None, uncertain)
    )
    assert not any(plain)
    assert [bool(reason) for reason in told] == uncertain.tolist()


def random_graph(generator: torch.Generator, views: int = 9, pairs: int = 14) -> tuple[Int[Tensor, "q 2"], Float[Tensor, "q"]]:
    every = torch.combinations(torch.arange(views))
    chosen = torch.randperm(len(every), generator=generator)[:pairs]
    return every[chosen], torch.rand(pairs, generator=generator, dtype=torch.float64) + 0.1


def test_a_backbone_is_a_spanning_forest_of_largest_weight(generator: torch.Generator) -> None:
    for _ in range(50):
        pairs, weight = random_graph(generator)
        backbone = Backbone.of(pairs, weight, 9)
        group = components(pairs, 9)
        assert torch.equal(components(pairs[backbone.chosen], 9), group)
        assert int(backbone.chosen.sum()) == 9 - len(torch.unique(group))
        # No pair would make a better one: each is no stronger than the weakest on the way between its images.
        for q, (i, j) in enumerate(pairs.tolist()):
            way = backbone.way(i, j)
            assert float(weight[way].min()) >= float(weight[q])


def test_ways_and_sides_agree(generator: torch.Generator) -> None:
    for _ in range(20):
        pairs, weight = random_graph(generator)
        backbone = Backbone.of(pairs, weight, 9)
        group = components(pairs, 9)
        sides = {q: backbone.sides(q, 9) for q in backbone.chosen.nonzero()[:, 0].tolist()}
        for first, second in sides.values():
            assert not (first & second).any()
        for i, j in torch.combinations(torch.arange(9)).tolist():
            way = backbone.way(i, j)
            assert bool(way) == bool(group[i] == group[j])
            parted = [q for q, (first, second) in sides.items() if (first[i] and second[j]) or (first[j] and second[i])]
            assert sorted(way) == sorted(parted)


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_pairs_of_no_weight_hold_nothing_together(weight: float) -> None:
    pairs = torch.tensor([[0, 1], [1, 2]])
    backbone = Backbone.of(pairs, torch.tensor([1.0, weight]), 3)
    assert backbone.chosen.tolist() == [True, weight > 0]
    assert bool(backbone.way(0, 2)) == (weight > 0)
    assert not backbone.way(1, 1)


def test_matches_that_return_to_an_image_do_not_count() -> None:
    # Points 0 and 1 are of one image; both are matched with point 2, point 3 with point 4 alone.
    view = torch.tensor([0, 0, 1, 0, 1])
    match = torch.tensor([[0, 2], [1, 2], [3, 4]])
    graph = ViewGraph(
        names=("a", "b"),
        image_size=torch.tensor([SIZE] * 2),
        x=torch.zeros(5, 2, dtype=torch.float64),
        view=view,
        color=torch.zeros(5, 3, dtype=torch.float64),
        pairs=torch.tensor([[0, 1]]),
        num_matches=torch.tensor([3]),
        F=torch.eye(3, dtype=torch.float64)[None],
        H=torch.eye(3, dtype=torch.float64)[None],
        fundamental_inliers=torch.tensor([3]),
        homography_inliers=torch.tensor([0]),
        match=match,
        match_pair=torch.zeros(3, dtype=torch.long),
    )
    assert Distinctiveness.of(graph).weight.tolist() == [1.0]
    assert Distinctiveness.of(graph.only(torch.tensor([False]))).weight.tolist() == [0.0]


def test_no_image_is_given_up_for_less_than_a_fold(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once a model of all images is not folded, one of fewer images with a little less against it is no better."""
    empty, poses, _ = street(generator, 0.5)
    everything = torch.ones(VIEWS, dtype=torch.bool)
    whole = replace(empty, poses=poses, registered=everything)
    part = replace(whole, registered=torch.arange(VIEWS) > 2)
    options = MappingOptions(free=(), expected=empty.cameras, focal_sigma=torch.zeros(1, dtype=torch.float64))
    pairs, place = torch.tensor([[0, 1], [1, 2]]), torch.arange(VIEWS)

    def found(model: Mapping, *score: float) -> Unfolded:
        conflicts = Conflicts(pairs, torch.tensor(score, dtype=torch.float64), 10.0, place)
        # None of the pairs that agree with the first model agree with these.
        other = pair_agreement(model, threshold=4.0, poses_alone=True)
        return Unfolded(model, ~everything, conflicts, 1.0, replace(other, agreeing=0 * other.agreeing))

    better = found(whole, 10.1, 0.0)
    monkeypatch.setattr(unfolding, "missing_correspondences", lambda _: found(whole, 12.0, 12.0).conflicts)
    monkeypatch.setattr(unfolding, "_trials", lambda *_: [better, found(part, 0.0, 0.0)])
    assert unfold(empty, whole, ~everything, options, lambda *_: None) is better
    monkeypatch.setattr(unfolding, "_trials", lambda *_: [found(whole, 11.0, 11.0), found(part, 0.0, 0.0)])
    assert not unfold(empty, whole, ~everything, options, lambda *_: None).model.registered.all()
