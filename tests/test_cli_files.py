"""The command line and the file system: names of any kind, files that are no photographs, a disk that fills up."""

import json
import os
import sys
from pathlib import Path
from shutil import copy

import pytest
import torch
from command_line import FOCAL, HEIGHT, WIDTH, assert_one_line, report, torchsfm
from full_disk import full_disk

from torchsfm.formats import read_colmap
from torchsfm.images import save_image
from torchsfm.reconstruction import Reconstruction
from torchsfm.reconstruction.messages import printable

NAMES = ("1 caf\udce9.png", "2 <img src=x onerror=alert(1)>|.png", "3 new\nline \x1b[31m.png")


@pytest.fixture(scope="module")
def odd(courtyard: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A run over photographs with odd names, among other things; its folder and what it printed."""
    folder = tmp_path_factory.mktemp("odd")
    for i, name in enumerate(NAMES):
        copy(courtyard / f"view{i}.png", folder / name)
    (folder / "4 caf\udce9 letter.png").write_text("Dear Sir or Madam,\n" * 40)
    for name in ("a.heic", "b.HEIC", "film.mp4", "notes.txt"):
        (folder / name).write_bytes(b"x")
    (folder / "more").mkdir()
    copy(courtyard / "view3.png", folder / "more")
    (folder / "more" / "c.heic").write_bytes(b"x")
    (folder / "results").mkdir()
    copy(courtyard / "view4.png", folder / "results")
    (folder / "results" / ".lock").touch()
    out = tmp_path_factory.mktemp("out\udce9")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "pillow_heif", None)
        status, text, stderr = torchsfm("reconstruct", folder, "--out", out)
    assert status == 0, stderr
    return out, text


def test_no_name_costs_the_work(odd: tuple[Path, str]) -> None:
    out, text = odd
    images = report(out)
    assert [name for name, image in images.items() if image["registered"]] == [*NAMES, "more/view3.png"]
    assert "text" in str(images["4 caf\udce9 letter.png"]["reason"])
    assert Reconstruction.load(out / "model.npz").names == (*NAMES, "more/view3.png")
    assert read_colmap(out / "colmap").names == (*NAMES, "more/view3.png")
    assert {"page.html", "points.ply", "report.md"} <= {path.name for path in out.iterdir()}
    text.encode("utf-8")
    assert "\x1b" not in text
    status, text, _ = torchsfm("info", out)
    assert status == 0
    assert all(printable(name) in text for name in NAMES)


def test_no_name_becomes_markup(odd: tuple[Path, str]) -> None:
    out, _ = odd
    page = (out / "report.md").read_bytes().decode("utf-8")
    assert "2 &lt;img src=x onerror=alert(1)&gt;\\|.png" in page
    for text in (page, (out / "page.html").read_bytes().decode("utf-8")):
        assert "<img src=x" not in text


def test_what_was_not_read_is_said(odd: tuple[Path, str]) -> None:
    out, text = odd
    skipped = {entry["name"]: entry["reason"] for entry in json.loads((out / "report.json").read_text())["skipped"]}
    assert list(skipped) == ["a.heic", "b.HEIC", "film.mp4", "results", "more/c.heic"]
    assert "not read: a.heic, b.HEIC, more/c.heic (HEIC" in text
    assert "not read: results (a folder with 1 pictures; it holds masks or results" in text
    assert all(f"| {name} |" in (out / "report.md").read_text() for name in skipped)


def test_a_folder_with_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    (tmp_path / "a.heic").touch()
    status, _, stderr = torchsfm("reconstruct", tmp_path, "--out", tmp_path / "out")
    assert status == 2
    assert_one_line(stderr, "no images in this folder; not read: a.heic (HEIC")


def test_the_same_name_in_two_folders(courtyard: Path, tmp_path: Path) -> None:
    files = []
    for i in range(3):
        (tmp_path / f"day {i}").mkdir()
        files.append(tmp_path / f"day {i}" / "view.png")
        copy(courtyard / f"view{i}.png", files[i])
    files[1].write_text("Dear Sir or Madam,\n" * 40)
    out = tmp_path / "out"
    assert torchsfm("reconstruct", *files, "--out", out)[0] == 0
    images = report(out)
    assert {name: image["registered"] for name, image in images.items()} == {
        "day 0/view.png": True,
        "day 1/view.png": False,
        "day 2/view.png": True,
    }
    assert "data:image/jpeg" in (out / "page.html").read_text()
    status, _, stderr = torchsfm("reconstruct", files[0], files[0], "--out", out)
    assert status == 2
    assert_one_line(stderr, str(files[0]), "given twice")


def test_a_full_disk_leaves_the_results_before(courtyard: Path, tmp_path: Path) -> None:
    images = [courtyard / f"view{i}.png" for i in range(3)]
    assert torchsfm("reconstruct", *images[:2], "--out", tmp_path)[0] == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file() and "stages" not in path.parts}
    sizes = sorted(len(content) for content in before.values())
    # Full already for the stages, for the page, for the model.
    for size, count, more in ((1000, 3, []), (sizes[-1] // 2, 2, ["--resume"]), (5000, 2, ["--resume"])):
        with full_disk(size):
            status, _, stderr = torchsfm("reconstruct", *images[:count], "--out", tmp_path, *more)
        assert status == 2
        assert stderr.splitlines()[-1].startswith(f"torchsfm: {tmp_path}{os.sep}"), stderr
        assert stderr.splitlines()[-1].endswith("File too large")
        assert f"{os.sep}." not in stderr.splitlines()[-1]
        after = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file() and "stages" not in path.parts}
        assert after == before


def test_a_model_that_colmap_cannot_hold_is_written_in_the_other_formats(courtyard: Path, tmp_path: Path) -> None:
    (tmp_path / "K.txt").write_text(f"{FOCAL} 0.5 {(WIDTH - 1) / 2}\n0 {FOCAL} {(HEIGHT - 1) / 2}\n0 0 1\n")
    images = [courtyard / f"view{i}.png" for i in range(2)]
    status, text, _ = torchsfm("reconstruct", *images, "--out", tmp_path / "out", "--intrinsics", tmp_path / "K.txt")
    assert status == 0
    assert "colmap  not written: camera 0 has skew" in text
    assert (tmp_path / "out/model.npz").exists()


def test_an_image_with_too_many_pixels_is_left_out_and_said(courtyard: Path, tmp_path: Path) -> None:
    images = [courtyard / f"view{i}.png" for i in range(2)]
    save_image(tmp_path / "large.png", torch.zeros(3, HEIGHT + 1, WIDTH))
    words = ["reconstruct", *images, tmp_path / "large.png", "--max-pixels", WIDTH * HEIGHT]
    assert torchsfm(*words, "--out", tmp_path / "out")[0] == 0
    (entry,) = [image for name, image in report(tmp_path / "out").items() if name.endswith("/large.png")]
    assert not entry["registered"]
    assert "400 x 301 are more than the 120000 pixels" in str(entry["reason"])
    words[-1] -= 1
    status, _, stderr = torchsfm(*words, "--out", tmp_path / "out")
    assert status == 2
    assert "0 of 3 files can be read" in stderr
