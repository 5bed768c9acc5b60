"""Photographs that were cropped: principal points are found where the images say that they are not in the middle."""

from dataclasses import replace

import pytest
import torch
from chance import seeded
from torch import Tensor

from torchsfm.geometry import Camera, Pose, Radial, intrinsics
from torchsfm.reconstruction import SfmResult, reconstruct_tracks
from torchsfm.reconstruction.mappers import growth
from torchsfm.reconstruction.mappers.cropped import may_be_off_centre
from torchsfm.reconstruction.mappers.incremental import MappingOptions
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.model.evaluation import pose_errors
from torchsfm.reconstruction.written_report import report_markdown, report_record
from torchsfm.simulation import look_at, random_points, simulate_images

SIZE = (1000, 750)
MIDDLE = torch.tensor([499.5, 374.5], dtype=torch.float64)


Crops = tuple[SfmResult, Pose, Tensor, tuple[Mapping, MappingOptions]]


def photographs(
    generator: torch.Generator, focal: Tensor, *, share: float, relief: float = 1.5
) -> tuple[SfmResult, Pose, Tensor]:
    """Simulated photographs of one facade with relief, of which up to a share of each side was cut off: result and truth.

    Of one camera that has focal length `focal`, or of several.
    """
    v, options = 8, {"generator": generator, "dtype": torch.float64}
    X = random_points(250, kind="cube", **options) * torch.tensor([4.0, 3.0, relief])
    angle, distance = 1.6 * torch.rand(v, **options) - 0.8, 7 + 4 * torch.rand(v, **options)
    centre = torch.stack((distance * angle.sin(), torch.randn(v, **options), -distance * angle.cos()), -1)
    up = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    poses = look_at(centre, torch.randn(v, 3, **options) * torch.tensor([0.7, 0.4, 0.1]), up)
    zero = torch.zeros(v, dtype=torch.float64)
    cameras = Camera(intrinsics(focal.expand(v), MIDDLE.expand(v, 2)), Radial(zero - 0.05, zero))
    seen = simulate_images(
        X, poses, cameras, image_size=SIZE, noise=0.3, dropout=0.2, depth_range=(2.0, 25.0), generator=generator
    )
    whole = torch.tensor(SIZE)
    first = (torch.rand(v, 2, **options) * share * whole).long()
    # No two are of one size, also where nothing much is cut.
    last = whole - (torch.rand(v, 2, **options) * share * whole).long() - torch.arange(v)[:, None]
    inside = ((seen.x >= first[:, None]) & (seen.x < last[:, None])).all(-1)
    view, track = (seen.visible & inside).nonzero(as_tuple=True)
    result = reconstruct_tracks(seen.x[view, track] - first[view], view, track, last - first)
    return result, poses, MIDDLE - first


def angles(result: SfmResult, poses: Pose) -> Tensor:
    """Errors of relative rotations, in degrees."""
    return pose_errors(result.model.poses, poses, result.model.registered).rotation


@pytest.fixture(scope="module")
def of_one_camera() -> Crops:
    """Crops of one camera, and the first model that was asked whether principal points may be off the middle."""
    asked: list[tuple[Mapping, MappingOptions]] = []

    def remember(model: Mapping, options: MappingOptions) -> bool:
        asked.append((model, options))
        return may_be_off_centre(model, options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(growth, "may_be_off_centre", remember)
        result, poses, c = photographs(seeded(), torch.tensor([1200.0]).double(), share=0.2)
    return result, poses, c, asked[0]


def test_crops_of_one_camera(of_one_camera: Crops) -> None:
    result, poses, c, _ = of_one_camera
    assert bool(result.model.registered.all())
    assert float(angles(result, poses).max()) < 0.5
    (found,) = result.report.calibrations
    assert bool((found.values[:, 0] == found.values[0, 0]).all())
    assert float(((found.values[:, 0] - 1200) / found.deviation[:, 0]).abs().max()) < 5
    assert float(((found.values[:, 1:3] - c) / found.deviation[:, 1:3]).abs().max()) < 5
    assert not any(image.doubt for image in result.report.images)
    for text in (result.report.summary(), report_markdown(report_record(result))):
        assert "the images seem to be cropped, all of one camera" in text


def test_crops_of_several_cameras(generator: torch.Generator) -> None:
    focal = 900 + 500 * torch.rand(8, generator=generator, dtype=torch.float64)
    result, poses, c = photographs(generator, focal, share=0.2)
    (found,) = result.report.calibrations
    assert "of several cameras" in found.remark
    assert float(angles(result, poses).max()) < 1
    assert float(((found.values[:, 0] - focal) / found.deviation[:, 0]).abs().max()) < 5
    assert float(((found.values[:, 1:3] - c) / found.deviation[:, 1:3]).abs().max()) < 5


def test_crops_of_a_plane_are_doubtful(generator: torch.Generator) -> None:
    """Other focal lengths explain them as well, and errors that matches have in common, small as they are, choose one."""
    result, _, _ = photographs(generator, torch.tensor([1200.0]).double(), share=0.2, relief=0.05)
    assert result.report.calibrations[0].cropped
    assert all("one plane" in image.doubt for image in result.report.images)


def test_photographs_of_one_size_are_not_taken_for_crops(of_one_camera: Crops) -> None:
    """Of a zoom lens, a bent structure moves principal points, and freeing them bends it more."""
    model, options = of_one_camera[-1]
    assert may_be_off_centre(model, options)
    same = replace(model.graph, image_size=model.graph.image_size[:1].expand_as(model.graph.image_size))
    assert not may_be_off_centre(replace(model, graph=same), options)


def test_whole_photographs_are_not_made_anew(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growth, "map_cropped", lambda *given: pytest.fail("nothing is cropped"))
    focal = 900 + 500 * torch.rand(8, generator=generator, dtype=torch.float64)
    result, poses, _ = photographs(generator, focal, share=0.0)
    assert float(angles(result, poses).max()) < 0.5
