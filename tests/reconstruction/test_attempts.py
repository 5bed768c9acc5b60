"""Two mappers: where models fall apart images are placed all at once, and what is less in doubt is kept."""

import math
from collections.abc import Callable
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch
from chance import seeded

from bench.doubt import camera_errors
from torchsfm.geometry import Camera, Pose, Radial, intrinsics, rotation_from_euler
from torchsfm.reconstruction import SfmResult, attempts, reconstruct_tracks
from torchsfm.reconstruction.attempts import Attempt
from torchsfm.reconstruction.mappers.growth import Growth, Wanted
from torchsfm.reconstruction.matching.view_graph import ViewGraph
from torchsfm.simulation import orbit_poses, random_points, simulate_images

SIZE, VIEWS, RADIUS = (1000, 750), 9, 5.0


def chain(seed: int, three: int) -> tuple[Callable[..., SfmResult], Pose]:
    """Each pair of neighbours sees 60 points that no other image does, and any three in a row see so many together."""
    g, v, two = seeded(seed), VIEWS, 60
    poses = orbit_poses(v, radius=RADIUS, sweep=1.8)
    X = random_points((v - 1) * two + (v - 2) * three, kind="ball", size=1.6, generator=g)
    first = torch.cat((torch.arange(v - 1).repeat_interleave(two), torch.arange(v - 2).repeat_interleave(three)))
    length = torch.full_like(first, 3).index_fill_(0, torch.arange((v - 1) * two), 2)
    view = torch.arange(v)[:, None]
    zero = torch.zeros(v, dtype=torch.float64)
    camera = Camera(intrinsics(torch.tensor(1100.0), torch.tensor([499.5, 374.5])).double().expand(v, 3, 3), Radial(zero, zero))
    seen = simulate_images(X, poses, camera, image_size=SIZE, noise=0.3, generator=g)
    i, track = (seen.visible & (view >= first) & (view < first + length)).nonzero(as_tuple=True)

    def run(**options: object) -> SfmResult:
        size = torch.tensor([SIZE] * v)
        return reconstruct_tracks(seen.x[i, track], i, track, size, focal=1100.0, **options)  # type: ignore[arg-type]

    return run, poses


def test_images_with_few_points_in_common_are_placed_all_at_once() -> None:
    run, poses = chain(2, 18)
    assert run(method="incremental").model.num_registered == 2
    found = run()
    assert found.report.method == "global"
    own = found.model.registered
    assert int(own.sum()) >= 7
    assert float(camera_errors(found.model.poses, poses, own, RADIUS)[own].max()) < 1.0
    assert not any(image.doubt for image in found.report.images)


def test_images_that_hang_together_are_placed_one_by_one() -> None:
    run, _ = chain(1, 60)
    found = run()
    assert found.report.method == "incremental"
    assert found.model.num_registered == VIEWS


def test_models_in_doubt_do_not_replace_others(monkeypatch: pytest.MonkeyPatch) -> None:
    run, _ = chain(0, 18)
    undoubted = {"incremental": 3}
    monkeypatch.setattr(Attempt, "undoubted", property(lambda attempt: undoubted[attempt.growth.method]))
    made, attempted = Attempt.of, dict[str, Attempt]()

    def once(graph: ViewGraph, wanted: Wanted, growth: Growth) -> Attempt:
        """The same images are mapped three times alike."""
        if growth.method not in attempted:
            attempted[growth.method] = made(graph, wanted, growth)
        return attempted[growth.method]

    monkeypatch.setattr(Attempt, "of", once)
    for number, kept in ((2, "incremental"), (4, "global")):
        undoubted["global"] = number
        assert run().report.method == kept
    hinged = Mock(side_effect=lambda agreement, _: torch.ones_like(agreement.supports))
    monkeypatch.setattr(attempts, "hinges", hinged)
    assert run().report.method == "incremental"
    hinged.assert_called()


@pytest.mark.parametrize(("degrees", "kept"), [(8.0, "global"), (13.0, "incremental")])  # half of it to either side
def test_what_is_placed_at_once_must_not_bend_the_parts(degrees: float, kept: str, monkeypatch: pytest.MonkeyPatch) -> None:
    run, _ = chain(2, 18)
    made = Attempt.of

    def bent(graph: ViewGraph, wanted: Wanted, growth: Growth) -> Attempt:
        """The neighbours in each model of two are turned against each other by `degrees` where all are placed at once."""
        attempt = made(graph, wanted, growth)
        if growth.method == "incremental":
            return attempt
        (one,) = attempt.components
        poses = one.model.poses
        turn = torch.arange(VIEWS) % 2 * math.radians(degrees)
        R = rotation_from_euler(turn[:, None].double(), "z") @ poses.R
        return replace(attempt, components=(replace(one, model=replace(one.model, poses=replace(poses, R=R))),))

    monkeypatch.setattr(Attempt, "of", bent)
    monkeypatch.setattr(Attempt, "hinged", False)
    monkeypatch.setattr(Attempt, "sure", lambda attempt, component: component.model.registered)
    undoubted = {"incremental": 0, "global": 9}
    monkeypatch.setattr(Attempt, "undoubted", property(lambda attempt: undoubted[attempt.growth.method]))
    assert run().report.method == kept


def test_a_model_in_doubt_is_made_again_all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    run, _ = chain(1, 60)
    undoubted = {"incremental": 4, "global": 9}
    monkeypatch.setattr(Attempt, "undoubted", property(lambda attempt: undoubted[attempt.growth.method]))
    monkeypatch.setattr(Attempt, "bends", lambda attempt, other: False)
    assert run().report.method == "global"
    undoubted["incremental"] = 5
    assert run().report.method == "incremental"


def test_pairs_that_were_given_up_are_asked_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Images that stand elsewhere are doubtful, though what joins them to the others was taken for copies of it."""
    made: list[Attempt] = []
    of = Attempt.of

    def kept(graph: ViewGraph, wanted: Wanted, growth: Growth) -> Attempt:
        made.append(of(graph, wanted, growth))
        return made[-1]

    monkeypatch.setattr(Attempt, "of", kept)
    run, _ = chain(1, 60)
    run()
    attempt = made[0]
    (one,) = attempt.components
    model, apart = one.model, torch.arange(VIEWS) < 3
    turn = rotation_from_euler(torch.where(apart, 0.7, 0.0)[:, None].double(), "y")
    across = apart[attempt.graph.pairs].sum(1) == 1
    moved = replace(
        model,
        graph=attempt.graph.only(~across),
        poses=replace(model.poses, R=model.poses.R @ turn),
        point=torch.where(apart[model.graph.view], -1, model.point),
    )
    standing, _ = attempt.judge(one.moved(moved.compacted()))
    assert [("contradict how it stands" in doubt) for doubt in standing.doubt] == apart.tolist()
