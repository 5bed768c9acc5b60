"""Two places that pass for one, by what each of their photographs misses of the other's."""

from dataclasses import replace

import pytest
import torch
from chance import assert_share
from jaxtyping import Bool
from torch import Tensor

from torchsfm.geometry import Camera, Pose, intrinsics
from torchsfm.geometry.distortion import Radial
from torchsfm.reconstruction.evidence.missing import SIGNIFICANCE, Conflicts, _scores, missing_correspondences
from torchsfm.reconstruction.evidence.mutual_sight import CELLS, MutualSight
from torchsfm.reconstruction.evidence.occupied import Looks, Occupied
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.matching.view_graph import ViewGraph

SIZE = (640, 480)
GROUP = 6
WALL, CRATE, CLUTTER = 500, 120, 30000
F64 = torch.float64


def model(
    generator: torch.Generator, *, folded: bool, clutter: bool = False, described: bool = False, veiled: bool = False
) -> Mapping:
    """Twelve cameras before one wall, with one crate on its left and one on its right.

    Folded: six of them stand before another wall that looks the same, and each wall has one of the crates. Veiled: nothing is
    found again where the other six saw the crate, nor behind it. Clutter is image points that match nothing.
    """

    def uniform(n: int, *bounds: tuple[float, float]) -> Tensor:
        low, high = torch.tensor(bounds, dtype=F64).T
        return low + (high - low) * torch.rand(n, 3, generator=generator, dtype=F64)

    wall = uniform(WALL, (-3.5, 3.5), (-2.6, 2.6), (7.0, 7.4))
    crates = [uniform(CRATE, (side - 0.5, side + 0.5), (0.2, 1.2), (4.4, 5.0)) for side in (-1.3, 1.3)]
    X = torch.cat([wall, *crates])
    kind = torch.tensor([0] * WALL + [1] * CRATE + [2] * CRATE)
    v = 2 * GROUP
    centre = 0.3 * torch.randn(v, 3, generator=generator, dtype=F64)
    poses = Pose(torch.eye(3, dtype=F64).repeat(v, 1, 1), -centre)
    zero = torch.zeros(1, dtype=F64)
    middle = torch.tensor([[SIZE[0] / 2, SIZE[1] / 2]], dtype=F64)
    camera = Camera(intrinsics(torch.full((1,), 500.0, dtype=F64), middle), Radial(zero, zero))
    x = camera[torch.zeros(v, dtype=torch.long)].project(poses.transform(X.expand(v, -1, -1)))
    second = torch.arange(v) >= GROUP
    sees = ((x >= 1) & (x < torch.tensor(SIZE) - 2)).all(-1) & (torch.rand(x.shape[:-1], generator=generator) < 0.7)

    def behind(crate: int) -> Bool[Tensor, "v n"]:
        low, high = (torch.stack([edge(x[i, kind == crate], 0) for i in range(v)]) for edge in (torch.amin, torch.amax))
        return ((x >= low[:, None]) & (x <= high[:, None])).all(-1) & (kind == 0)

    here = [~second if folded else torch.ones_like(second), second if folded else torch.ones_like(second)]
    for crate, group in enumerate(here, 1):
        sees &= ~(behind(crate) & group[:, None]) & ((kind != crate) | group[:, None])
    if veiled:
        sees &= ~(second[:, None] & (behind(1) | (kind == 1)))
    view, point = sees.nonzero(as_tuple=True)
    looks = torch.randint(0, 256, (len(X), 32), generator=generator)
    place, look = x[view, point], looks[point]
    if clutter:
        place = torch.cat([place, torch.rand(v * CLUTTER, 2, generator=generator, dtype=F64) * torch.tensor(SIZE)])
        look = torch.cat([look, torch.randint(0, 256, (v * CLUTTER, 32), generator=generator)])
        view = torch.cat([view, torch.arange(v).repeat_interleave(CLUTTER)])
        point = torch.cat([point, torch.full((v * CLUTTER,), -1)])
    none = torch.zeros(0, dtype=torch.long)
    graph = ViewGraph(
        names=tuple(f"{i}.png" for i in range(v)),
        image_size=torch.tensor([SIZE] * v),
        x=place,
        view=view,
        color=torch.zeros(len(view), 3, dtype=F64),
        pairs=none.reshape(0, 2),
        num_matches=none,
        F=torch.zeros(0, 3, 3, dtype=F64),
        H=torch.zeros(0, 3, 3, dtype=F64),
        fundamental_inliers=none,
        homography_inliers=none,
        match=none.reshape(0, 2),
        match_pair=none,
        descriptors=(lambda: look.to(torch.uint8)) if described else None,
    )
    registered = torch.ones(v, dtype=torch.bool)
    return Mapping(graph, point, camera, torch.zeros(v, dtype=torch.long), poses, registered, X, point)


def across(pairs: Tensor) -> Tensor:
    return (pairs < GROUP).sum(1) == 1


def test_weak_points_are_not_missed(generator: torch.Generator) -> None:
    folded = model(generator, folded=True)
    weak = torch.rand(len(folded.graph.x), generator=generator) < 0.5
    none, half, every = (
        missing_correspondences(replace(folded, graph=replace(folded.graph, weak=some)))
        for some in (torch.zeros_like(weak), weak, torch.ones_like(weak))
    )
    assert torch.equal(none.score, missing_correspondences(folded).score)
    assert none.folded
    assert half.score.any()
    assert half.strength < none.strength
    assert not every.score.any()


def test_what_is_seen_through_is_not_there(generator: torch.Generator) -> None:
    """Each camera misses a crate in another part of the image, before a wall that it sees."""
    for _ in range(5):
        conflicts = missing_correspondences(model(generator, folded=True))
        assert conflicts.folded
        assert across(conflicts.refuted).all()
        assert len(conflicts.refuted) >= GROUP


@pytest.mark.parametrize("veiled", [False, True])
def test_right_models_are_not_refuted(veiled: bool, generator: torch.Generator) -> None:
    """Nor is what may be hidden a fold; chance refutes a single pair in one of a hundred models."""
    found = [missing_correspondences(model(generator, folded=False, veiled=veiled)) for _ in range(20)]
    assert not any(conflicts.folded for conflicts in found)
    assert_share(torch.tensor([not len(conflicts.refuted) for conflicts in found]), 1 - SIGNIFICANCE)


def test_points_beside_each_other_need_not_look_alike(generator: torch.Generator) -> None:
    """Where image points are everywhere, only what they look like tells whether one is found again."""
    blind = missing_correspondences(model(generator, folded=True, clutter=True))
    assert not blind.folded
    told = missing_correspondences(model(generator, folded=True, clutter=True, described=True))
    assert told.folded
    assert across(told.refuted).all()
    assert not missing_correspondences(model(generator, folded=False, clutter=True, described=True)).folded


def test_a_point_at_the_last_pixel_that_looks_unlike_is_none() -> None:
    looks = Looks.of(torch.tensor([[9, 0], [0, 9]], dtype=torch.uint8))
    occupied = Occupied(torch.tensor([7]), torch.ones(8, dtype=torch.bool), torch.tensor([1]), looks, 4, 2)
    place, view = torch.tensor([[2], [0]]), torch.tensor([0])
    assert occupied.at(view, place, torch.tensor([0])).tolist() == [False]
    assert occupied.at(view, place, torch.tensor([1])).tolist() == [True]


def test_whatever_chance_finds_no_more_speaks_against_a_pair(generator: torch.Generator) -> None:
    """Without what chance finds a score is the most that it can be with it, and is reached."""
    pairs, cells = 200, CELLS[0] * CELLS[1]
    seen = torch.randint(0, 12, (3, 2 * pairs, cells), generator=generator).double()
    found = (seen * torch.rand(seen.shape, generator=generator, dtype=F64)).floor()
    chance = seen * torch.rand(seen.shape, generator=generator, dtype=F64) ** 3
    most = _scores(*torch.stack([seen, found], 1))
    assert bool((_scores(*torch.stack([seen, found, chance], 1)) <= most).all())
    # Chance that finds as much as is found, among so many points that its own share says nothing.
    many = torch.stack([1e6 * seen, 1e6 * found, 1e6 * found], 1)
    torch.testing.assert_close(_scores(*many), _scores(*many[:, :2]), rtol=1e-3, atol=0.0)


@pytest.mark.parametrize("folded", [False, True])
def test_pairs_are_refuted_as_if_all_were_asked(folded: bool, generator: torch.Generator) -> None:
    mapping = model(generator, folded=folded, clutter=True, described=True)
    found = missing_correspondences(mapping)
    every = _scores(*MutualSight.of(mapping).parts(found.pairs, by_chance=True))
    refuted = every > found.limit
    assert torch.equal(found.score > found.limit, refuted)
    # Chance refutes a pair of a right model now and then.
    assert bool(refuted.any()) or not folded
    assert torch.equal(found.score[refuted], every[refuted])


def with_a_copy(mapping: Mapping, image: int) -> Mapping:
    """The same photograph once more, all its observations again."""
    graph, again = mapping.graph, mapping.graph.view == image
    v = len(graph.names)

    def twice(t: Tensor) -> Tensor:
        return torch.cat([t, t[again]])

    copied = replace(
        graph, names=(*graph.names, "copy.png"), image_size=torch.cat([graph.image_size, graph.image_size[image, None]]),
        x=twice(graph.x), view=torch.cat([graph.view, graph.view.new_full((int(again.sum()),), v)]), color=twice(graph.color),
    )  # fmt: skip
    rows = torch.cat([torch.arange(v), torch.tensor([image])])
    return Mapping(
        copied, twice(mapping.track), mapping.cameras, mapping.camera_index[rows], mapping.poses[rows],
        mapping.registered[rows], mapping.X, twice(mapping.point),
    )  # fmt: skip


@pytest.mark.parametrize(("places", "refuted", "folded"), [(90, 1, True), (800, 1, False), (800, 7, False), (800, 8, True)])
def test_one_place_of_many_hundred_folds_no_model(places: int, refuted: int, folded: bool) -> None:
    """Each is compared with 40 others around, and those refuted with four of them in vain."""
    first = torch.arange(places)
    pairs = torch.stack((first.repeat_interleave(20), (first[:, None] + torch.arange(1, 21)).flatten() % places), 1)
    score = torch.zeros(len(pairs), dtype=F64)
    for number in range(refuted):
        # Far enough from each other that no other place is refuted by two.
        score[20 * 45 * number + torch.tensor([3, 8, 13, 18])] = 99.0
    assert Conflicts(pairs, score, 18.0, torch.arange(places)).folded == folded


@pytest.mark.parametrize("folded", [False, True])
def test_copies_of_a_photograph_are_one_witness(folded: bool, generator: torch.Generator) -> None:
    """What two cameras miss of each other does not depend on whether one of them, or a third, is there twice."""
    alone = model(generator, folded=folded)
    once, twice = missing_correspondences(alone), missing_correspondences(with_a_copy(alone, 0))
    own = (twice.pairs < 2 * GROUP).all(1)
    torch.testing.assert_close(twice.pairs[own], once.pairs)
    counts = (MutualSight.of(some).parts(once.pairs, by_chance=True) for some in (alone, with_a_copy(alone, 0)))
    for first, second in zip(*counts, strict=True):
        torch.testing.assert_close(first, second)
    assert twice.place[-1] == twice.place[0]
    assert once.folded == twice.folded == folded
    # Two places that are refuted twice by one photograph and its copy are refuted once.
    pairs = torch.tensor([[0, 1], [1, 2 * GROUP]])
    assert not Conflicts(pairs, torch.full((2,), 99.0), 1.0, twice.place).folded
    assert Conflicts(pairs, torch.full((2,), 99.0), 1.0, torch.arange(2 * GROUP + 1)).folded


@pytest.mark.parametrize(("larger", "compared"), [(1.3, True), (2.0, False)])
def test_images_of_other_sizes_need_not_show_the_same(larger: float, compared: bool, generator: torch.Generator) -> None:
    """Where a thing is twice as large in the one image as in the other, neither has to find the points of the other."""
    folded = model(generator, folded=True)
    second = torch.arange(2 * GROUP) >= GROUP
    scale = torch.where(second, larger, 1.0)
    c = (torch.tensor(SIZE, dtype=F64) - 1) / 2
    K = intrinsics(torch.tensor([500.0, 500.0 * larger], dtype=F64), torch.stack([c, larger * c]))
    zero = torch.zeros(2, dtype=F64)
    graph = replace(
        folded.graph,
        x=folded.graph.x * scale[folded.graph.view, None],
        image_size=(folded.graph.image_size * scale[:, None]).long(),
    )
    found = missing_correspondences(
        replace(folded, graph=graph, cameras=Camera(K, Radial(zero, zero)), camera_index=second.long())
    )
    assert bool((found.score[across(found.pairs)] > 0).any()) == compared


@pytest.mark.parametrize(("refuted", "folded"), [(1, False), (3, False), (4, True)])
def test_where_many_are_compared_chance_refutes_some(refuted: int, folded: bool) -> None:
    """A place taken for another is refuted from more of those around than points that are missed together explain."""
    others = torch.arange(1, 48)
    pairs = torch.stack([torch.zeros_like(others), others], 1)
    score = torch.where(others <= refuted, 20.0, 3.0)
    assert Conflicts(pairs, score, 17.0, torch.arange(48)).folded == folded
