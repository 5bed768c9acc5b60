"""From which pairs of images, and from which focal lengths, few images are begun."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchsfm.geometry import Camera, intrinsics
from torchsfm.geometry.distortion import Radial
from torchsfm.reconstruction.mappers import incremental
from torchsfm.reconstruction.mappers.incremental import MappingOptions, grow_model
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.matching.track_graph import graph_from_tracks
from torchsfm.simulation import look_at

POINTS, FOCAL = 200, 700.0


def quiet(done: int, total: int) -> None:
    """No progress is shown."""


def seen(generator: torch.Generator, views: int = 4) -> Mapping:
    """Images that all see all points, and a camera whose focal length is the true one."""
    X = 2 * torch.rand(POINTS, 3, generator=generator, dtype=torch.float64) - 1
    angle = torch.linspace(-0.5, 0.5, views, dtype=torch.float64)
    centre = 5 * torch.stack((angle.sin(), 0.2 * angle.square(), -angle.cos()), -1)
    zero = torch.zeros(1, dtype=torch.float64)
    camera = Camera(intrinsics(zero + FOCAL, torch.full((1, 2), 250.0, dtype=torch.float64)), Radial(zero, zero))
    x = camera[torch.zeros(views, dtype=torch.long)].project(
        look_at(centre, torch.zeros_like(centre)).transform(X.expand(views, -1, -1))
    )
    x = x.flatten(0, 1) + 0.3 * torch.randn(views * POINTS, 2, generator=generator, dtype=torch.float64)
    view, track = torch.arange(views).repeat_interleave(POINTS), torch.arange(POINTS).repeat(views)
    names, sizes = [f"{i}.png" for i in range(views)], torch.full((views, 2), 501)
    graph, track = graph_from_tracks(
        names, sizes, x, view, track, torch.zeros(len(x), 3, dtype=torch.float64), generator=generator
    )
    return Mapping.start(graph, track, camera, torch.zeros(views, dtype=torch.long))


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> Callable[[Mapping, float, list[float]], tuple[float, list[float]]]:
    """Grows models of which each explains what is given, and says what the chosen one does, and where each began."""

    def grow(mapping: Mapping, sigma: float, explained: list[float]) -> tuple[float, list[float]]:
        models: list[Mapping] = []

        def extend(model: Mapping, *_: object) -> tuple[Mapping, dict[int, str]]:
            models.append(replace(model, registered=torch.ones_like(model.registered)))
            return models[-1], {}

        def support(model: Mapping, _: float) -> float:
            return explained[next(k for k, one in enumerate(models) if one is model)]

        monkeypatch.setattr(incremental, "extend_model", extend)
        monkeypatch.setattr(incremental, "support", support)
        options = MappingOptions(
            free=("focal",), expected=mapping.cameras, focal_sigma=torch.full((1,), sigma, dtype=torch.float64),
            generator=torch.Generator().manual_seed(0),
        )  # fmt: skip
        best = grow_model(mapping, options, quiet)
        assert best is not None
        return support(best[0], 4.0), [float(model.cameras.K[0, 0, 0]) / FOCAL for model in models]

    return grow


def test_few_images_are_begun_until_three_models_come_to_the_best(
    generator: torch.Generator, begun: Callable[[Mapping, float, list[float]], tuple[float, list[float]]]
) -> None:
    chosen, focal = begun(seen(generator), 0.05, [80.0, 100.0, 99.5, 99.7, 0.0])
    assert chosen == 100.0
    assert focal == [1.0] * 4


def test_where_starts_disagree_other_focal_lengths_are_tried(
    generator: torch.Generator, begun: Callable[[Mapping, float, list[float]], tuple[float, list[float]]]
) -> None:
    mapping = seen(generator)
    chosen, focal = begun(mapping, 0.6, [80.0, 81.0, 85.0, 80.5, 79.0, 100.0, 99.5, 99.7, 0.0])
    assert chosen == 100.0
    assert focal == pytest.approx([1.0] * 5 + [0.7] * 3)
    # Not those that are known.
    chosen, focal = begun(mapping, 0.05, [80.0, 81.0, 85.0, 80.5, 79.0])
    assert chosen == 85.0
    assert focal == [1.0] * 5


def test_several_images_are_begun_until_two_models_come_to_the_best(
    generator: torch.Generator, begun: Callable[[Mapping, float, list[float]], tuple[float, list[float]]]
) -> None:
    # Not of many images, and not where the focal length is known.
    for views, sigma, best, tried in ((8, 0.6, 100.0, 4), (13, 0.6, 80.0, 1), (8, 0.05, 80.0, 1)):
        chosen, focal = begun(seen(generator, views), sigma, [80.0, 100.0, 85.0, 99.5, 0.0])
        assert (chosen, focal) == (best, [1.0] * tried)


def test_few_images_come_to_one_model_whatever_was_guessed(generator: torch.Generator) -> None:
    mapping = seen(generator)
    for times in (0.5, 1.0, 2.0):
        K: Tensor = mapping.cameras.K.clone()
        K[:, :2, :2] *= times
        guess = Camera(K, mapping.cameras.distortion)
        empty = Mapping.start(mapping.graph, mapping.track, guess, mapping.camera_index)
        sigma = torch.full((1,), 0.6, dtype=torch.float64)
        options = MappingOptions(free=("focal",), expected=guess, focal_sigma=sigma, generator=generator)
        best = grow_model(empty, options, quiet)
        assert best is not None
        assert bool(best[0].registered.all())
        assert float(best[0].cameras.K[0, 0, 0]) == pytest.approx(FOCAL, rel=0.02)
