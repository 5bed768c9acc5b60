"""The command line: what a user may do wrong, what comes out, and that nothing finished is lost."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from shutil import copy

import pytest
import torch
from command_line import (
    FOCAL,
    HEIGHT,
    VIEWS,
    WIDTH,
    arc,
    assert_one_line,
    copies,
    render,
    report,
    same_model,
    torchsfm,
)

from torchsfm.cli.inputs import read_intrinsics, warn_about_intrinsics
from torchsfm.cli.job import Job
from torchsfm.cli.results import VERSION
from torchsfm.formats import read_lines, read_ply
from torchsfm.images import save_image
from torchsfm.reconstruction import Reconstruction
from torchsfm.reconstruction.matching.stages import saved_stages
from torchsfm.simulation import look_at


@pytest.fixture(scope="module")
def finished(courtyard: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a run over them, and what it printed."""
    out = tmp_path_factory.mktemp("finished") / "new" / "folder"
    status, text, _ = torchsfm("reconstruct", courtyard, "--out", out, "--seed", 3)
    assert status == 0
    return out, text


# ---- what comes out ------------------------------------------------------------------------------------------------------


def test_photographs_become_a_model_a_page_and_a_report(finished: tuple[Path, str]) -> None:
    out, text = finished
    model = Reconstruction.load(out / "model.npz")
    assert model.num_registered == VIEWS
    assert model.num_points > 100
    assert float(model.cameras.K[0, 0, 0]) == pytest.approx(FOCAL, rel=0.05)
    assert (out / "points.ply").stat().st_size > 1000
    assert "<html" in (out / "page.html").read_text()[:2000].lower()
    assert str(out / "page.html") in text
    assert f"{VIEWS} of {VIEWS} images registered" in text

    record = json.loads((out / "report.json").read_text())
    assert [image["registered"] for image in record["images"]] == [True] * VIEWS
    assert sum(image["observations"] for image in record["images"]) == model.num_observations
    assert len(record["pairs"]) == VIEWS * (VIEWS - 1) // 2
    neighbours = next(pair for pair in record["pairs"] if pair["images"] == ["view0.png", "view1.png"])
    assert neighbours["verdict"] == "general"
    assert neighbours["matches"] >= neighbours["fundamental_inliers"] > neighbours["homography_inliers"] > 0
    assert record["models"][0]["points"] == model.num_points
    assert record["models"][0]["cameras"][0]["focal"][0] == pytest.approx(float(model.cameras.K[0, 0, 0]))
    assert {"features", "match", "verify", "map"} <= set(record["seconds"])
    assert 50 < record["peak_memory_mb"] < 20_000
    written = (out / "report.md").read_text()
    assert "| view3.png | yes |" in written
    assert "| view0.png | view1.png |" in written


def test_lines_are_found_written_and_reported(finished: tuple[Path, str], courtyard: Path, tmp_path: Path) -> None:
    shutil.copytree(finished[0], tmp_path / "out")
    out = tmp_path / "out"
    status, text, _ = torchsfm("reconstruct", courtyard, "--out", out, "--seed", 3, "--lines", "--resume")
    assert status == 0
    model = Reconstruction.load(out / "model.npz")
    assert model.lines is not None
    assert len(model.lines) > 0
    assert (model.lines.support() >= 3).all()
    assert float(model.line_residuals().mean()) < 1
    assert f"{len(model.lines)} lines" in text
    assert torch.equal(read_lines(out / "lines.txt").view, model.lines.view)
    assert len(read_ply(out / "lines.ply").X) == 2 * len(model.lines)
    assert len(read_ply(out / "points.ply").X) == model.num_points
    record = json.loads((out / "report.json").read_text())
    assert record["models"][0]["lines"]["count"] == len(model.lines)
    assert {"segments", "lines"} <= set(record["seconds"])
    assert f"| lines | {len(model.lines)} of" in (out / "report.md").read_text()
    # Results without lines leave none behind.
    status, _, _ = torchsfm("reconstruct", courtyard, "--out", out, "--seed", 3, "--resume")
    assert status == 0
    assert not list(out.glob("lines*"))
    assert same_model(out / "model.npz", finished[0] / "model.npz")


def test_curves_are_found_written_and_reported(finished: tuple[Path, str], courtyard: Path, tmp_path: Path) -> None:
    shutil.copytree(finished[0], tmp_path / "out")
    out = tmp_path / "out"
    status, text, _ = torchsfm("reconstruct", courtyard, "--out", out, "--seed", 3, "--curves", "--resume")
    assert status == 0
    model = Reconstruction.load(out / "model.npz")
    assert model.curves is not None
    assert len(model.curves) > 0
    assert (model.curves.support() >= 3).double().mean() > 0.75
    assert float(model.curve_residuals().mean()) < 1
    assert f"{len(model.curves)} curves" in text
    assert len(read_ply(out / "curves.ply").X) == len(model.curves.X)
    assert len(json.loads((out / "curves.json").read_text())["curves"]) == len(model.curves)
    record = json.loads((out / "report.json").read_text())
    assert record["models"][0]["curves"]["samples"] == len(model.curves.X)
    assert {"edges", "curves"} <= set(record["seconds"])
    assert f"| curves | {len(model.curves)} of" in (out / "report.md").read_text()
    assert f"{len(model.curves)} curves" in torchsfm("info", out)[1]
    # Results without curves leave none behind.
    status, _, _ = torchsfm("reconstruct", courtyard, "--out", out, "--seed", 3, "--resume")
    assert status == 0
    assert not list(out.glob("curves*"))
    assert same_model(out / "model.npz", finished[0] / "model.npz")


def test_info_describes_a_saved_model(finished: tuple[Path, str]) -> None:
    out, _ = finished
    for path in (out, out / "model.npz"):
        status, text, _ = torchsfm("info", path)
        assert status == 0
        assert f"{VIEWS} of {VIEWS} images registered" in text
        assert "view4.png" in text


def test_version_and_help() -> None:
    status, text, _ = torchsfm("--version")
    assert (status, text) == (0, f"torchsfm {VERSION}\n")
    assert torchsfm("--help")[0] == 0
    done = subprocess.run([sys.executable, "-m", "torchsfm", "--version"], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, text)


def test_no_bars_and_no_colours_outside_a_terminal(finished: tuple[Path, str], courtyard: Path, tmp_path: Path) -> None:
    images = sorted(courtyard.glob("*.png"))[:2]
    _, text, stderr = torchsfm("reconstruct", *images, "--out", tmp_path)
    assert "\x1b" not in text + stderr
    assert "\r" not in text + stderr
    assert stderr.splitlines()[0] == "finding features ..."


def test_the_core_dependencies_are_enough(courtyard: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for extra in ("pycolmap", "plotly", "matplotlib"):
        monkeypatch.setitem(sys.modules, extra, None)
    images = sorted(courtyard.glob("*.png"))[:2]
    status, text, _ = torchsfm("reconstruct", *images, "--out", tmp_path)
    assert status == 0
    assert {"model.npz", "points.ply", "page.html", "report.md", "report.json"} <= {path.name for path in tmp_path.iterdir()}
    assert f"{tmp_path / 'colmap'}  the model for COLMAP" in text


def test_the_demonstration_finds_the_truth(tmp_path: Path) -> None:
    status, text, _ = torchsfm("demo", "--out", tmp_path, "--views", 5, "--width", 400)
    assert status == 0
    record = json.loads((tmp_path / "report.json").read_text())
    assert all(image["registered"] for image in record["images"])
    mean, largest = record["truth"]["rotation error, mean / largest"].removesuffix(" deg").split(" / ")
    assert float(mean) <= float(largest) < 1.0
    assert float(record["truth"]["focal length error"].removesuffix(" %")) < 5
    assert "focal length error" in text
    assert len(list((tmp_path / "images").glob("view*.jpg"))) == 5


# ---- what a user may do wrong --------------------------------------------------------------------------------------------


def test_no_such_folder(tmp_path: Path) -> None:
    status, _, stderr = torchsfm("reconstruct", tmp_path / "missing", "--out", tmp_path / "out")
    assert status == 2
    assert_one_line(stderr, str(tmp_path / "missing"), "no such folder")


def test_an_empty_folder(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    status, _, stderr = torchsfm("reconstruct", tmp_path / "empty", "--out", tmp_path / "out")
    assert status == 2
    assert_one_line(stderr, str(tmp_path / "empty"), "no images")


def test_one_image(courtyard: Path, tmp_path: Path) -> None:
    for images in (courtyard / "view0.png", copies(courtyard, tmp_path / "one", "view0.png")):
        status, _, stderr = torchsfm("reconstruct", images, "--out", tmp_path / "out")
        assert status == 2
        assert_one_line(stderr, "view0.png", "one image is not enough")


def test_damaged_files_are_named_and_the_others_reconstructed(courtyard: Path, tmp_path: Path) -> None:
    folder = copies(courtyard, tmp_path / "images", "view0.png", "view1.png", "view2.png")
    whole = (courtyard / "view3.png").read_bytes()
    (folder / "cut.png").write_bytes(whole[: len(whole) // 2])
    (folder / "letter.jpg").write_text("Dear Sir or Madam,\n" * 40)
    (folder / "nothing.png").touch()
    (folder / "notes.txt").write_text("not an image, and not named like one")
    out = tmp_path / "out"
    status, text, _ = torchsfm("reconstruct", folder, "--out", out)
    assert status == 0
    images = report(out)
    assert set(images) == {"view0.png", "view1.png", "view2.png", "cut.png", "letter.jpg", "nothing.png"}
    assert [name for name, image in images.items() if image["registered"]] == ["view0.png", "view1.png", "view2.png"]
    assert "cut short" in str(images["cut.png"]["reason"])
    assert "text" in str(images["letter.jpg"]["reason"])
    assert "empty" in str(images["nothing.png"]["reason"])
    assert "letter.jpg" in text


def test_only_damaged_files(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for name in ("a.jpg", "b.jpg"):
        (folder / name).write_text("Dear Sir or Madam,\n" * 40)
    status, _, stderr = torchsfm("reconstruct", folder, "--out", tmp_path / "out")
    assert status == 2
    assert "0 of 2 files" in stderr
    assert "a.jpg" in stderr.splitlines()[-1]


def test_two_sizes_are_two_cameras(courtyard: Path, tmp_path: Path) -> None:
    from torchsfm.images import read_image

    folder = copies(courtyard, tmp_path / "images", "view0.png", "view1.png", "view2.png")
    for name in ("view3.png", "view4.png"):
        save_image(folder / name, read_image(courtyard / name, max_size=320).pixels)
    out = tmp_path / "out"
    assert torchsfm("reconstruct", folder, "--out", out)[0] == 0
    model = Reconstruction.load(out / "model.npz")
    assert model.num_registered == VIEWS
    focal = model.cameras.K[model.camera_index, 0, 0]
    ratio = focal[3:].mean() / focal[:3].mean()
    assert float(ratio) == pytest.approx(320 / WIDTH, rel=0.05)


def test_the_same_image_twice_does_no_harm(courtyard: Path, tmp_path: Path) -> None:
    folder = copies(courtyard, tmp_path / "images", "view0.png", "view1.png", "view2.png")
    copy(courtyard / "view1.png", folder / "again.png")
    out = tmp_path / "out"
    assert torchsfm("reconstruct", folder, "--out", out)[0] == 0
    images = report(out)
    assert all(images[name]["registered"] for name in ("view0.png", "view1.png", "view2.png"))
    model = Reconstruction.load(out / "model.npz")
    twin, image = model.names.index("again.png"), model.names.index("view1.png")
    gap = (model.poses.centre[twin] - model.poses.centre[image]).norm()
    assert images["again.png"]["registered"]
    assert float(gap) < 1e-2 * float(torch.pdist(model.poses.centre).max())


def test_nothing_but_the_same_image(courtyard: Path, tmp_path: Path) -> None:
    folder = copies(courtyard, tmp_path / "images", "view0.png")
    copy(courtyard / "view0.png", folder / "again.png")
    assert_nothing(folder, tmp_path / "out", "turned about its centre")


def test_images_that_show_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for i in range(3):
        save_image(folder / f"wall{i}.png", torch.full((3, HEIGHT, WIDTH), 0.4 + 0.1 * i))
    assert_nothing(folder, tmp_path / "out", "0 of 3 images show anything to match")
    reasons = {image["reason"] for image in report(tmp_path / "out").values()}
    assert reasons == {"only 0 features: nothing to match"}


def test_a_camera_that_only_turns(tmp_path: Path) -> None:
    angle = torch.linspace(-0.15, 0.15, 3).double()
    centre = torch.tensor([0.0, -5.0, 1.5]).double()
    target = centre + torch.stack((angle.sin(), angle.cos(), 0.2 * angle), -1)
    folder = tmp_path / "images"
    folder.mkdir()
    for i, image in enumerate(render(look_at(centre.expand(3, 3), target), seed=0)):
        save_image(folder / f"view{i}.png", image)
    assert_nothing(folder, tmp_path / "out", "turned about its centre")
    pairs = json.loads((tmp_path / "out" / "report.json").read_text())["pairs"]
    assert {pair["verdict"] for pair in pairs} == {"pure rotation"}


def assert_nothing(folder: Path, out: Path, *words: str) -> None:
    """The work was done, there is no model, and stderr and the report say why."""
    status, text, stderr = torchsfm("reconstruct", folder, "--out", out)
    assert status == 1
    last = stderr.splitlines()[-1]
    assert last.startswith("torchsfm: nothing could be reconstructed")
    for word in words:
        assert word in last
    assert not (out / "model.npz").exists()
    assert "Nothing could be reconstructed" in (out / "report.md").read_text()
    assert str(out / "report.md") in text


def test_two_scenes_are_two_models(courtyard: Path, tmp_path: Path) -> None:
    folder = copies(courtyard, tmp_path / "images", *(f"view{i}.png" for i in range(VIEWS)))
    for i, image in enumerate(render(arc(4, 30), seed=7)):
        save_image(folder / f"other{i}.png", image)
    out = tmp_path / "out"
    status, text, _ = torchsfm("reconstruct", folder, "--out", out)
    assert status == 0
    images = report(out)
    assert {image["model"] for name, image in images.items() if name.startswith("view")} == {0}
    assert {image["model"] for name, image in images.items() if name.startswith("other")} == {1}
    assert Reconstruction.load(out / "model-1.npz").num_registered == 4
    assert (out / "page.html").exists()
    assert "model 1: 4 of 9 images registered" in text


@pytest.mark.parametrize("command", ["reconstruct", "demo"])
def test_a_folder_that_cannot_be_written_is_found_first(command: str, courtyard: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    words = ["reconstruct", courtyard] if command == "reconstruct" else ["demo"]
    status, _, stderr = torchsfm(*words, "--out", tmp_path / "file" / "out")
    assert status == 2
    assert_one_line(stderr, str(tmp_path / "file" / "out"), "cannot be written")


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="the administrator may write anywhere")
def test_a_folder_without_permission(courtyard: Path, tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    status, _, stderr = torchsfm("reconstruct", courtyard, "--out", tmp_path)
    tmp_path.chmod(0o700)
    assert status == 2
    assert_one_line(stderr, "cannot be written")


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("500 0 320\n0 500 240\n", "three lines of three numbers"),
        ("500 0 320 0\n0 500 240 0\n0 0 1 0\n", "three lines of three numbers"),
        ("500 0 320\n0 500 240\n0 0 2\n", "not a calibration matrix"),
        ("500 0 320\n0 -500 240\n0 0 1\n", "not a calibration matrix"),
        ("nan 0 320\n0 500 240\n0 0 1\n", "not a calibration matrix"),
        ("f = 500\n", "not a matrix of numbers"),
        ("", "three lines of three numbers"),
        (None, "cannot be read"),
    ],
)
def test_intrinsics_that_are_none(text: str | None, word: str, courtyard: Path, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / "K.txt").write_text(text)
    status, _, stderr = torchsfm("reconstruct", courtyard, "--out", tmp_path / "out", "--intrinsics", tmp_path / "K.txt")
    assert status == 2
    assert_one_line(stderr, "K.txt", word)


@pytest.mark.parametrize(
    "text",
    [
        "500 0.5 320\n0 510 240\n0 0 1\n",
        "# K\n500, 0.5, 320\n0, 510, 240\n\n0, 0, 1",
        "500 0.5 320 0 510 240 0 0 1",
        "500 0.5 320\n0 510 240\n0 0 1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n0.1 0.2 0.3\n640 480\n",
        "500 0.5 320\n0 510 240\n0 0 1\n1 0 0 -3.4\n0 1 0 -1.1\n0 0 1 -9.8\n",
    ],
)
def test_intrinsics_are_read_in_their_usual_forms(text: str, tmp_path: Path) -> None:
    (tmp_path / "K.txt").write_text(text)
    K = read_intrinsics(tmp_path / "K.txt")
    assert K.tolist() == [[500, 0.5, 320], [0, 510, 240], [0, 0, 1]]


def test_known_intrinsics_are_kept(courtyard: Path, tmp_path: Path) -> None:
    K = f"{FOCAL} 0 {(WIDTH - 1) / 2}\n0 {FOCAL} {(HEIGHT - 1) / 2}\n0 0 1\n"
    (tmp_path / "K.txt").write_text(K)
    images = sorted(courtyard.glob("*.png"))[:3]
    status, _, stderr = torchsfm("reconstruct", *images, "--out", tmp_path / "out", "--intrinsics", tmp_path / "K.txt")
    assert status == 0
    assert "warning" not in stderr
    camera = json.loads((tmp_path / "out/report.json").read_text())["models"][0]["cameras"][0]
    assert camera["model"] == "pinhole"
    assert camera["focal"] == [FOCAL, FOCAL]


def test_intrinsics_for_another_size_are_warned_of(finished: tuple[Path, str], capsys: pytest.CaptureFixture[str]) -> None:
    model = Reconstruction.load(finished[0] / "model.npz")
    wrong = torch.tensor([[1520.0, 0, 800], [0, 1520, 600], [0, 0, 1]]).double()
    warn_about_intrinsics(wrong, model)
    assert "400 x 300" in capsys.readouterr().err
    warn_about_intrinsics(model.cameras.K[0], model)
    assert capsys.readouterr().err == ""


def test_info_of_nothing(tmp_path: Path) -> None:
    (tmp_path / "letter.npz").write_text("Dear Sir or Madam,\n")
    for path, word in (
        (tmp_path / "missing", "no such file or folder"),
        (tmp_path, "no model"),
        (tmp_path / "letter.npz", "not a saved"),
    ):
        status, _, stderr = torchsfm("info", path)
        assert status == 2
        assert_one_line(stderr, str(path), word)


def test_a_wrong_option_is_wrong_usage(courtyard: Path, tmp_path: Path) -> None:
    assert torchsfm("reconstruct", courtyard)[0] == 2
    assert torchsfm("reconstruct", courtyard, "--out", tmp_path, "--camera", "pinhole camera")[0] == 2
    assert torchsfm("reconstruct", courtyard, "--out", tmp_path, "--threads", 0)[0] == 2


# ---- interruption --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stage", "saved"),
    [("features", []), ("match", ["features", "pairs"]), ("verify", ["features", "match", "overlays", "pairs"])],
)
def test_an_interrupted_run_goes_on_where_it_was(
    stage: str, saved: list[str], finished: tuple[Path, str], courtyard: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["reconstruct", str(courtyard), "--out", str(tmp_path), "--seed", "3"]
    monkeypatch.setattr(sys, "argv", ["torchsfm", *words])

    def interrupt(job: Job, reported: str, *_: int) -> None:
        job.stage = reported
        if reported == stage:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Job, "progress", interrupt)
        status, _, stderr = torchsfm(*words)
    assert status == 130
    assert "interrupted while" in stderr
    assert saved_stages(tmp_path) == saved
    assert ("--resume" in stderr) == bool(saved)

    seen: list[str] = []
    monkeypatch.setattr(Job, "progress", lambda job, reported, *_: seen.append(reported))
    assert torchsfm(*words, "--resume")[0] == 0
    assert {"map", "write"} <= set(seen)
    assert not set(saved) & set(seen), "what is saved is not made again"
    # Where nothing was saved it is a run of its own: the same seed gives the same model.
    assert same_model(finished[0] / "model.npz", tmp_path / "model.npz")


def test_what_was_saved_for_other_images_is_not_used(courtyard: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    images = sorted(courtyard.glob("*.png"))
    assert torchsfm("reconstruct", *images[:2], "--out", out)[0] == 0
    assert torchsfm("reconstruct", *images[:3], "--out", out, "--resume")[0] == 0
    assert Reconstruction.load(out / "model.npz").num_registered == 3
