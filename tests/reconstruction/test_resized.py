"""Photographs that were upright and lying, and were all resized to one square."""

from unittest.mock import Mock

import pytest
import torch
from chance import seeded
from torch import Tensor

from bench.doubt import camera_errors
from torchsfm.geometry import Camera, Pose, intrinsics
from torchsfm.reconstruction import attempts, reconstruct_tracks, resized
from torchsfm.reconstruction.attempts import Attempt
from torchsfm.reconstruction.mappers.growth import Wanted
from torchsfm.reconstruction.matching.track_graph import graph_from_tracks
from torchsfm.reconstruction.matching.view_graph import ViewGraph
from torchsfm.reconstruction.resized import Shapes, shapes_of_squares
from torchsfm.simulation import look_at, random_points, simulate_images

SIDE, FOCAL, RADIUS = 640, 520.0, 4.0
UPRIGHT = torch.tensor([False, True, False, False, True, True])


def images(ratio: float, upright: Tensor = UPRIGHT) -> tuple[Tensor, Tensor, Tensor, Pose]:
    """Image points, their images and tracks, and the true poses; one side of the sensor is `ratio` times the other."""
    v, options = len(upright), {"generator": seeded(), "dtype": torch.float64}
    angle, distance = torch.linspace(-0.75, 0.75, v, dtype=torch.float64), RADIUS + 0.5 * torch.rand(v, **options)
    centre = torch.stack((distance * angle.sin(), 0.2 * torch.randn(v, **options), -distance * angle.cos()), -1)
    poses = look_at(centre, 0.1 * torch.randn(v, 3, **options), torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    X = random_points(300, kind="ball", size=5.0, **options)
    # The shorter side of the sensor is spread over as many pixels.
    f = FOCAL * torch.where(upright, ratio, 1.0).double()
    K = intrinsics(f, torch.full((v, 2), (SIDE - 1) / 2).double(), aspect=torch.where(upright, 1 / ratio, ratio).double())
    seen = simulate_images(X, poses, Camera(K), image_size=(SIDE, SIDE), noise=0.3, generator=options["generator"])
    view, track = seen.visible.nonzero(as_tuple=True)
    return seen.x[view, track], view, track, poses


def graph(ratio: float, upright: Tensor = UPRIGHT) -> ViewGraph:
    x, view, track, _ = images(ratio, upright)
    v = len(upright)
    size = torch.tensor([(SIDE, SIDE)] * v)
    found, _ = graph_from_tracks([str(i) for i in range(v)], size, x, view, track, torch.zeros(len(x), 3), generator=seeded(1))
    return found


@pytest.mark.parametrize(("ratio", "most"), [(4 / 3, 2000), (1.4, 2000), (16 / 9, 2000), (1.5, 12)])
def test_pairs_tell_which_were_upright(ratio: float, most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resized, "MOST", most)
    told = shapes_of_squares(graph(ratio))
    assert told is not None
    assert told.clear
    aspect = told.aspect
    assert torch.equal(aspect < 1, UPRIGHT)
    assert aspect.log().abs().allclose(aspect[0].log())
    assert abs(float(aspect[0]) / ratio - 1) < 0.15


@pytest.mark.parametrize(
    ("ratio", "upright"), [(1.0, UPRIGHT), (1.5, torch.zeros_like(UPRIGHT)), (1.5, torch.ones_like(UPRIGHT))]
)
def test_images_of_one_shape_are_not_told_apart(ratio: float, upright: Tensor) -> None:
    assert shapes_of_squares(graph(ratio, upright)) is None


def test_what_is_not_square_is_not_asked() -> None:
    one = graph(1.5)
    oblong = torch.tensor([(SIDE, SIDE - 1)] * len(UPRIGHT))
    assert shapes_of_squares(ViewGraph(**{**vars(one), "image_size": oblong})) is None


def test_poses_are_right() -> None:
    x, view, track, poses = images(1.5)
    found = reconstruct_tracks(x, view, track, torch.tensor([(SIDE, SIDE)] * len(UPRIGHT)))
    model = found.model
    assert model.registered.all()
    assert float(camera_errors(model.poses, poses, model.registered, RADIUS).max()) < 0.3
    K = model.cameras.K[model.camera_index]
    ratio = K[:, 1, 1] / K[:, 0, 0]
    assert torch.allclose(ratio, torch.where(UPRIGHT, 1 / 1.5, 1.5).double(), rtol=0.01)
    assert "others" in found.report.calibrations[0].remark


@pytest.mark.parametrize(
    ("told", "apart", "better", "made", "kept"),
    [
        (None, False, True, ["plain"], "plain"),
        (True, False, False, ["shaped"], "shaped"),
        (True, True, False, ["shaped", "plain"], "plain"),
        (False, False, False, ["shaped", "plain"], "plain"),
        (False, False, True, ["shaped", "plain"], "shaped"),
    ],
)
def test_models_decide_where_pairs_are_not_sure(
    monkeypatch: pytest.MonkeyPatch, told: bool | None, apart: bool, better: bool, made: list[str], kept: str
) -> None:
    shapes = None if told is None else Shapes(torch.tensor([1.5, 1 / 1.5]), told)
    monkeypatch.setattr(attempts, "shapes_of_squares", lambda graph: shapes)
    monkeypatch.setattr(attempts, "explains_better", lambda model, other: better)
    names: list[str] = []

    def make(wanted: Wanted) -> Attempt:
        names.append("plain" if wanted.aspect is None else "shaped")
        one = Mock(spec=Attempt, components=(Mock(),), registered=2, fell_apart=apart, largest=Mock())
        one.name = names[-1]
        return one

    found = attempts._of_all_shapes(Mock(spec=ViewGraph), Wanted(), make)
    assert names == made
    assert found.name == kept
