"""Folders, files and lists of photographs: which files they are, and what they are called."""

import os
from pathlib import Path

import pytest
import torch

from torchsfm.images import save_image
from torchsfm.reconstruction.mapping.cameras import group_cameras
from torchsfm.reconstruction.matching.image_points import detect_all
from torchsfm.reconstruction.matching.sources import Sources
from torchsfm.reconstruction.matching.stages import Stages
from torchsfm.reconstruction.messages import ReconstructionError


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def test_names_begin_at_the_folder(tmp_path: Path) -> None:
    touch(tmp_path, "v10.jpg", "v9.jpg", "b/1.jpg", "a/deep/1.png", "a/2.jpg", ".hidden/3.jpg", "c/notes.md")
    found = Sources.of(tmp_path)
    assert found.names == ("v9.jpg", "v10.jpg", "a/2.jpg", "a/deep/1.png", "b/1.jpg")
    assert found.folder == tmp_path
    assert [tmp_path / name for name in found.names] == list(found.files)
    # A folder whose images all lie in one subfolder is still where their names begin.
    assert Sources.of(tmp_path / "a").names == ("2.jpg", "deep/1.png")
    touch(tmp_path, "only/one/1.jpg", "only/one/2.jpg")
    assert Sources.of([tmp_path / "only"]).names == ("one/1.jpg", "one/2.jpg")


def test_several_things_are_one_set(tmp_path: Path) -> None:
    touch(tmp_path, "a/1.jpg", "b/1.jpg", "b/2.jpg", "c.jpg")
    found = Sources.of([tmp_path / "b", tmp_path / "a", tmp_path / "c.jpg"])
    assert found.names == ("b/1.jpg", "b/2.jpg", "a/1.jpg", "c.jpg")
    assert found.folder == tmp_path
    assert Sources.of([tmp_path / "b/2.jpg", tmp_path / "b/1.jpg"]).names == ("2.jpg", "1.jpg")
    with pytest.raises(ReconstructionError, match="given twice"):
        Sources.of([tmp_path / "b", tmp_path / "b/1.jpg"])


def test_lists_of_images(tmp_path: Path) -> None:
    touch(tmp_path, "a/1.jpg", "a/no\u0308ch eins.jpg", "b/1.jpg", "elsewhere/9.jpg")
    text = "\ufeff# left and right\n\nb/1.jpg\r\n  a/no\u0308ch eins.jpg  \na/1.jpg"
    (tmp_path / "list.txt").write_bytes(text.encode())
    found = Sources.of(tmp_path / "list.txt")
    assert found.names == ("b/1.jpg", "a/no\u0308ch eins.jpg", "a/1.jpg")
    assert found.folder == tmp_path
    (tmp_path / "a" / "list").write_text(f"../b/1.jpg\n{tmp_path / 'elsewhere/9.jpg'}\n")
    assert Sources.of(tmp_path / "a" / "list").names == ("b/1.jpg", "elsewhere/9.jpg")
    assert len(Sources.of([tmp_path / "a" / "list", tmp_path / "a"]).files) == 4


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"a.jpg\ngone.jpg\n", "list.txt, line 2: no such file: 'gone.jpg'"),
        (b"# nothing\n", "list.txt: lists no images"),
        (b"", "list.txt: lists no images"),
        (b"a.jpg", "one image is not enough"),
        (b"500 0 320\n0 500 240\n0 0 1\n", "list.txt, line 1: no such file: '500 0 320'"),
        (b"\x00\x01\x02", "one image is not enough"),
    ],
)
def test_lists_that_are_none(content: bytes, words: str, tmp_path: Path) -> None:
    touch(tmp_path, "a.jpg")
    (tmp_path / "list.txt").write_bytes(content)
    with pytest.raises(ReconstructionError) as caught:
        Sources.of(tmp_path / "list.txt")
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_results_and_masks_are_no_photographs(tmp_path: Path) -> None:
    touch(tmp_path, "1.jpg", "2.jpg", "old/.lock", "old/undistorted/1.jpg", "set/.torchsfm-export", "set/images/1.jpg")
    touch(tmp_path, "out/frames/1.jpg", "masks/1.jpg.png")
    found = Sources.of(tmp_path, without=[tmp_path / "out", tmp_path / "masks"])
    assert found.names == ("1.jpg", "2.jpg")
    assert [name for name, _ in found.skipped] == ["masks"]  # the others hold no pictures themselves
    # What is asked for by name is read.
    touch(tmp_path, "old/2.jpg")
    assert len(Sources.of(tmp_path / "old").files) == 2


def test_a_folder_within_itself_is_read_once(tmp_path: Path) -> None:
    touch(tmp_path, "1.jpg", "a/2.jpg")
    (tmp_path / "a" / "loop").symlink_to(tmp_path)
    assert Sources.of(tmp_path).names == ("1.jpg", "a/2.jpg")


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="the administrator may read anything")
def test_a_subfolder_that_cannot_be_read_is_told(tmp_path: Path) -> None:
    touch(tmp_path, "1.jpg", "2.jpg", "a/2.jpg")
    (tmp_path / "a").chmod(0)
    found = Sources.of(tmp_path)
    (tmp_path / "a").chmod(0o700)
    assert found.names == ("1.jpg", "2.jpg")
    assert "cannot be read" in found.skipped[0][1]


def test_one_camera_a_folder(tmp_path: Path) -> None:
    for name in ("left/1.png", "right/1.png", "left/2.png", "right/2.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        save_image(tmp_path / name, torch.rand(40, 50))
    found = Sources.of(tmp_path)
    points = detect_all(found.files, found.names, Stages(None, False, ""), 100, 10**6, lambda *_: None)
    assert points.names == ("left/1.png", "left/2.png", "right/1.png", "right/2.png")
    assert group_cameras(points.image_size, points.labels, None).tolist() == [0, 0, 1, 1]
    assert group_cameras(points.image_size, points.labels, True).tolist() == [0, 0, 0, 0]
