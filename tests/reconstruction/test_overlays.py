"""What is fixed to the images is told from what the camera sees, and nothing else is."""

import math
from unittest import mock

import cv2
import numpy as np
import torch
from torch import Tensor

from torchsfm.geometry import camera_from_krt, intrinsics, project_points, rotation_from_rotvec
from torchsfm.reconstruction import reconstruct
from torchsfm.reconstruction.matching import match_all
from torchsfm.reconstruction.matching.masks import Masks
from torchsfm.reconstruction.matching.overlays import WithoutOverlays, beside_overlays, find_overlays
from torchsfm.reconstruction.matching.view_graph import ViewGraph
from torchsfm.reconstruction.photographs import match_photographs

SIZE = torch.tensor([1000, 750])
K = intrinsics(torch.tensor(900.0), torch.tensor([499.5, 374.5])).double()
PAIRS = torch.combinations(torch.arange(6))


def scene(generator: torch.Generator, points: int = 120) -> Tensor:
    """Images (6, n, 2) of points, by cameras that move and turn a little."""
    kind = {"generator": generator, "dtype": torch.float64}
    X = 2 * torch.randn(points, 3, **kind) + torch.tensor([0.0, 0.0, 9.0], dtype=torch.float64)
    R, centre = rotation_from_rotvec(0.1 * torch.randn(6, 3, **kind)), torch.randn(6, 3, **kind)
    return project_points(camera_from_krt(K, R, -(R @ centre[..., None])[..., 0]), X)


def found(x: Tensor, sizes: Tensor | None = None) -> Tensor:
    """Which points of six images (6, n), whose points match by their numbers, are of an overlay."""
    sizes = SIZE.repeat(len(x), 1) if sizes is None else sizes
    same = torch.arange(x.shape[1])[:, None].expand(-1, 2)
    matches = [dict.fromkeys(range(len(PAIRS)), same)]
    fixed = find_overlays(sizes, list(x), PAIRS, lambda: matches, generator=torch.Generator().manual_seed(0))
    return fixed.view(x.shape[:2])


def overlay(generator: torch.Generator, points: int = 60) -> Tensor:
    """Places in a corner, the same in six images but for noise."""
    place = torch.rand(points, 2, generator=generator, dtype=torch.float64) * torch.tensor([300.0, 80.0]) + 20
    return place + 0.2 * torch.randn(6, points, 2, generator=generator, dtype=torch.float64)


def test_an_overlay_is_left_out_and_nothing_else(generator):
    x = torch.cat((scene(generator), overlay(generator)), 1)
    out = found(x)
    assert (out[:, 120:].double().mean(-1) > 0.95).all()
    assert not out[:, :120].any()


def test_more_of_an_overlay_than_of_the_scene(generator):
    x = torch.cat((scene(generator, 60), overlay(generator, 400)), 1)
    assert found(x)[:, 60:].double().mean() > 0.95


def test_scenes_have_none(generator):
    assert not found(scene(generator)).any()


def test_images_of_a_camera_that_stands_still_have_none(generator):
    x = scene(generator)[:1].expand(6, -1, -1)
    assert not found(x + 0.2 * torch.randn(x.shape, generator=generator, dtype=x.dtype)).any()


def test_a_camera_that_rests_while_something_moves_has_none(generator):
    """In two of six images only, before which a car passes: elsewhere the background moves."""
    x = torch.cat((scene(generator), scene(generator, 40)), 1)
    x[1, :120] = x[0, :120]
    assert not found(x).any()


def test_other_sizes_of_images_have_other_places(generator):
    x = torch.cat((scene(generator), overlay(generator)), 1)
    sizes = SIZE.repeat(6, 1)
    sizes[5, 0] = 900
    out = found(x, sizes)
    assert out[:5, 120:].double().mean() > 0.95
    assert not out[5].any()
    assert not found(x, SIZE + torch.arange(6)[:, None]).any()


def turning(generator: torch.Generator, views: int = 12) -> Tensor:
    """Images (v, n, 2) of an object that turns by 7 degrees from one to the next, about an axis upright in the image."""
    X = torch.randn(80, 3, generator=generator, dtype=torch.float64)
    turn = torch.zeros(views, 3, dtype=torch.float64)
    turn[:, 1] = torch.arange(views) * math.radians(7)
    return project_points(camera_from_krt(K, rotation_from_rotvec(turn), torch.tensor([0.0, 0.3, 8.0]).double()), X)


def behind(generator: torch.Generator, views: int, points: int = 300) -> Tensor:
    """Places all over the image, the same in all but for noise."""
    place = torch.rand(points, 2, generator=generator, dtype=torch.float64) * SIZE
    return place + 0.2 * torch.randn(views, points, 2, generator=generator, dtype=torch.float64)


def test_a_wall_behind_a_turntable_is_left_out(generator):
    """Few pairs show the same side of what turns: in the others all that moves is wrong, and the most stands still."""
    views = 12
    wall = behind(generator, views)
    x = torch.cat((turning(generator, views), wall), 1)
    pairs = torch.combinations(torch.arange(views))
    pairs = pairs[torch.argsort(pairs[:, 0] - pairs[:, 1], stable=True)]  # what tells nothing comes first
    same = torch.arange(x.shape[1])[:, None].expand(-1, 2)
    matches = {}
    for q, (i, j) in enumerate(pairs.tolist()):
        mixed = same.clone()
        if j - i > 3:
            mixed[:60, 1] = torch.randperm(60, generator=generator)
            mixed = torch.cat((mixed[:40], mixed[80:]))
        matches[q] = mixed
    size = SIZE.repeat(views, 1)
    out = find_overlays(size, list(x), pairs, lambda: [matches], generator=generator).view(views, -1)
    assert out[:, 80:].double().mean() > 0.9
    assert out[:, :80].double().mean() < 0.1


def test_what_is_beside_an_overlay_looks_other_there(generator):
    x = [torch.tensor([[100.0, 100.0], [110.0, 100.0], [130.0, 100.0]]).double(), torch.tensor([[100.0, 100.0]]).double()]
    fixed = torch.tensor([True, False, False, False])
    assert beside_overlays(SIZE.repeat(2, 1), x, fixed).tolist() == [True, True, False, False]


def with_logo(courtyard, folder):
    """Photographs with the same texture in a corner."""
    logo = np.random.default_rng(0).integers(0, 255, (14, 40, 3)).astype(np.uint8)
    for path in sorted(courtyard.iterdir()):
        image = cv2.imread(str(path))
        if image is None:
            continue
        h, w = image.shape[:2]
        image[-h // 5 :, : w // 2] = cv2.resize(logo, (w // 2, h // 5), interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(folder / f"{path.stem}.png"), image)


def test_points_of_overlays_match_nothing_and_those_beside_are_not_expected(courtyard, tmp_path):
    with_logo(courtyard, tmp_path)
    options = {"sequence": False, "max_features": 1500, "max_pixels": 10**7, "neighbours": 20, "masks": None, "out": None}
    graph = match_photographs(tmp_path, resume=False, seed=0, progress=lambda *_: None, **options).graph
    assert graph.fixed.sum() > 100
    assert not graph.fixed[graph.match].any()
    assert graph.still > 100
    assert graph.weak[graph.fixed].all()
    assert not graph.weak[graph.x[:, 1] < 0.5 * float(graph.image_size[0, 1])].all()


def test_one_end_on_an_overlay_is_enough(courtyard, monkeypatch):
    """What a point of one matches in another image is no point of the scene."""

    def every_third(size, x, pairs, matches, *, generator):
        number = torch.arange(sum(map(len, x)))
        return (number % 3 == 0) & (number < len(x[0]))

    monkeypatch.setattr(match_all, "find_overlays", every_third)
    options = {"sequence": False, "max_features": 600, "max_pixels": 10**7, "neighbours": 20, "masks": None, "out": None}
    graph = match_photographs(courtyard, resume=False, seed=0, progress=lambda *_: None, **options).graph
    assert graph.fixed.any()
    assert (graph.view[graph.match] == 0).any()
    assert not graph.fixed[graph.match].any()
    assert graph.still > 0


def test_photographs_with_a_large_logo(courtyard, tmp_path):
    """The same model as of photographs without it."""
    with_logo(courtyard, tmp_path)
    plain = reconstruct(courtyard)
    result = reconstruct(tmp_path)
    assert result.report.still > 100
    assert plain.report.still == 0
    assert "stand still" in result.report.summary()
    model, wanted = result.model, plain.model
    assert model.registered.all()
    R, other = model.poses.R, wanted.poses.R
    relative = (R @ R[:1].mT) @ (other @ other[:1].mT).mT
    angle = ((relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1).arccos().rad2deg()
    assert (angle < 0.3).all()


def hidden(generator: torch.Generator, fixed: Tensor, images: Tensor) -> float:
    """Which share is left out of points that stand still in so many of twelve images, the rest of which moves."""
    seen = scene(generator, 240).reshape(6, 2, 120, 2).transpose(0, 1).reshape(12, 120, 2)
    x = torch.cat((seen, fixed + 0.1 * torch.randn(12, *fixed.shape, generator=generator, dtype=fixed.dtype)), 1)
    shown = torch.rand(12, len(fixed), generator=generator).argsort(0).argsort(0) < images
    shown = torch.cat((torch.ones(12, 120, dtype=torch.bool), shown), 1)
    # The images of either half see the same points of the scene.
    pairs = torch.cat((PAIRS, PAIRS + 6))
    few = torch.cat((torch.zeros(120, dtype=torch.bool), images < 6))
    matches = {q: (shown[i] & shown[j]).nonzero().expand(-1, 2) for q, (i, j) in enumerate(pairs.tolist())}
    again = torch.Generator().manual_seed(0)
    out = find_overlays(SIZE.repeat(12, 1), list(x), pairs, lambda: [matches], generator=again).view(12, -1)
    assert not out[:, :120].any()
    return float(out[shown & (torch.arange(out.shape[1]) >= 120)[None] & few].double().mean())


def test_parts_of_an_overlay_that_most_images_hide(generator):
    """Beside what nine of twelve images show, five are enough; elsewhere they may be those of a camera that rested."""
    text = 20 + 20 * torch.cartesian_prod(torch.arange(16.0), torch.arange(5.0)).double()
    images = torch.where(torch.arange(80) % 2 == 0, 9, 5)
    assert hidden(generator, text, images) > 0.5
    apart = torch.where(images[:, None] == 5, text + torch.tensor([600.0, 500.0]), text)
    assert hidden(generator, apart, images) < 0.1


def test_edges_beside_an_overlay_are_not_looked_at(tmp_path):
    """Nor is what masks do not admit."""
    files = (tmp_path / "a.png", tmp_path / "b.png")
    x = torch.tensor([[100.0, 100.0], [400.0, 100.0], [100.0, 100.0]]).double()
    graph = mock.Mock(ViewGraph, fixed=torch.tensor([True, False, False]), view=torch.tensor([0, 0, 1]), x=x)
    places = torch.tensor([[[100.0, 112.0], [100.0, 120.0]], [[400.0, 100.0], [101.0, 99.0]]])
    scene = WithoutOverlays.of(files, graph, None)
    assert scene.admit(files[0], places, (1000, 750)).tolist() == [[False, True], [True, False]]
    assert scene.admit(files[1], places, (1000, 750)).all()
    masks = mock.Mock(Masks)
    masks.admit.return_value = torch.tensor([[True, False], [True, True]])
    both = WithoutOverlays.of(files, graph, masks)
    assert both.admit(files[0], places, (1000, 750)).tolist() == [[False, False], [True, False]]
    graph.fixed = None
    assert WithoutOverlays.of(files, graph, masks) is masks
