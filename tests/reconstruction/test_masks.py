"""Masks: nothing of a model comes from where they are black."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from command_line import HEIGHT, VIEWS, WIDTH, assert_one_line, torchsfm

from torchsfm.images import ImageError, save_image
from torchsfm.reconstruction import Reconstruction
from torchsfm.reconstruction.matching.masks import Masks
from torchsfm.reconstruction.photographs import MatchedPhotographs, match_photographs


def mask(*, width: int = WIDTH, height: int = HEIGHT) -> torch.Tensor:
    """Black at the left and in the middle at the bottom."""
    picture = torch.ones(height, width)
    picture[:, : width // 5] = 0
    picture[height // 2 :, 2 * width // 5 : 3 * width // 5] = 0
    return picture


def black(x: torch.Tensor) -> torch.Tensor:
    """Whether a place is in the black parts, a pixel from their borders or more."""
    left = x[..., 0] < WIDTH / 5 - 1.5
    middle = (x[..., 1] > HEIGHT / 2 + 0.5) & (x[..., 0] > 2 * WIDTH / 5 + 0.5) & (x[..., 0] < 3 * WIDTH / 5 - 1.5)
    return left | middle


def masks_for_all_but_the_last(folder: Path, size: int) -> Path:
    """Under either name, and of any resolution."""
    for i in range(VIEWS - 1):
        save_image(folder / (f"view{i}.png.png" if i % 2 else f"view{i}.png"), mask(width=size * WIDTH, height=size * HEIGHT))
    return folder


def assert_masked(model: Reconstruction) -> None:
    masked = model.view < VIEWS - 1
    assert not bool(black(model.x[masked]).any())
    # The last photograph has no mask and counts as a whole.
    assert bool(black(model.x[~masked]).any())


def test_no_point_and_no_line_comes_from_masked_parts(courtyard: Path, tmp_path: Path) -> None:
    masks_for_all_but_the_last(tmp_path, 2)
    status, _, stderr = torchsfm("reconstruct", courtyard, "--masks", tmp_path, "--lines", "--out", tmp_path / "out")
    assert status == 0, stderr
    model = Reconstruction.load(tmp_path / "out" / "model.npz")
    assert_masked(model)
    assert model.lines is not None
    assert len(model.lines.x) > 0
    assert not bool(black(model.lines.x[model.lines.view < VIEWS - 1]).any())


def matched(folder: Path, masks: Path | None, *, out: Path | None = None, sequence: bool = False) -> MatchedPhotographs:
    """Features and matches alone."""
    return match_photographs(
        folder, sequence=sequence, max_features=1000, max_pixels=10**7, neighbours=20, out=out, resume=True,
        seed=0, progress=lambda stage, done, total: None, masks=masks,
    )  # fmt: skip


def test_no_tracked_corner_comes_from_masked_parts(courtyard: Path, tmp_path: Path) -> None:
    masks_for_all_but_the_last(tmp_path, 1)
    graph = matched(courtyard, tmp_path, sequence=True).graph
    assert len(graph.x) > sum(map(len, matched(courtyard, tmp_path).points.features))
    masked = graph.view < VIEWS - 1
    assert not bool(black(graph.x[masked]).any())
    assert bool(black(graph.x[~masked]).any())


def test_other_masks_make_other_stages(courtyard: Path, tmp_path: Path) -> None:
    for i in range(VIEWS):
        save_image(tmp_path / f"view{i}.png", mask())
    assert bool(black(matched(courtyard, None, out=tmp_path / "out").graph.x).any())
    assert not bool(black(matched(courtyard, tmp_path, out=tmp_path / "out").graph.x).any())


def test_masks_of_labels_and_of_other_kinds(tmp_path: Path) -> None:
    photograph, x = tmp_path / "a.jpg", torch.tensor([[0.0, 0.0], [3.0, 0.0]])
    masks = Masks(tmp_path / "masks", tmp_path)
    masks.folder.mkdir()
    half = np.array([[0, 0, 1, 1]], dtype=np.uint8)
    for name, values, kept in (
        ("a.webp", 255 * half, [False, True]),
        ("a.jpg.bmp", half, [False, True]),
        ("a.jpg", 0 * half, [False, False]),
        ("a.png", half.astype(np.uint16), [False, True]),
        ("a.jpg.png", 3 * half, [False, False]),
    ):
        cv2.imwrite(str(masks.folder / name), values)
        path = masks.path(photograph)
        assert path is not None
        assert path.name == name
        assert masks.admit(photograph, x, (4, 1)).tolist() == kept


def test_places_between_pixels(tmp_path: Path) -> None:
    save_image(tmp_path / "a.png", torch.tensor([[0.0, 1.0], [1.0, 0.0]]))
    masks = Masks(tmp_path, Path("b"))
    x = torch.tensor([[-0.4, -0.4], [3.4, 0.0], [3.6, 0.0], [4.0, 3.0], [7.4, 3.4], [7.4, 7.4], [99.0, 99.0]])
    assert masks.admit(Path("b/a.jpg"), x, (8, 8)).tolist() == [False, False, True, True, True, False, False]
    assert masks.admit(Path("b/c.jpg"), x, (8, 8)).all()
    assert masks.admit(Path("b/c/a.jpg"), x, (8, 8)).all()
    with pytest.raises(ImageError, match="a mask of 2 x 2 pixels for an image of 8 x 4"):
        masks.admit(Path("b/a.jpg"), x, (8, 4))
    (tmp_path / "c").mkdir()
    (tmp_path / "a.png").rename(tmp_path / "c" / "a.png")
    assert not masks.admit(Path("b/c/a.jpg"), x, (8, 8)).all()


def test_wrong_masks_are_told(courtyard: Path, tmp_path: Path) -> None:
    status, _, stderr = torchsfm("reconstruct", courtyard, "--masks", tmp_path, "--out", tmp_path / "out")
    assert status == 2
    assert_one_line(stderr, "no mask for any image; that of view0.png would be view0.png.png")
    save_image(tmp_path / "view0.png", torch.ones(HEIGHT, HEIGHT))
    (tmp_path / "view1.png").write_text("words")
    failures = matched(courtyard, tmp_path).points.failures
    assert "a mask of 300 x 300 pixels" in failures["view0.png"]
    assert "not an image" in failures["view1.png"]
    assert len(failures) == 2
