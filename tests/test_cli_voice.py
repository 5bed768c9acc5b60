"""What commands say to programs and to people, and the commands that look at models: `view` and `compare`."""

import json
import math
import webbrowser
from dataclasses import replace
from pathlib import Path
from shutil import copy
from typing import Any

import pytest
import small_model
import torch
from chance import seeded
from command_line import HEIGHT, VIEWS, WIDTH, assert_one_line, report, torchsfm

from torchsfm.cli import job
from torchsfm.cli.job import Job, duration
from torchsfm.cli.voice import plain
from torchsfm.formats import write_colmap, write_model
from torchsfm.geometry import Pose, Similarity, random_rotation, rotation_from_rotvec
from torchsfm.images import read_image
from torchsfm.reconstruction import Reconstruction


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """A small model, its page not written yet."""
    small_model.make().save(tmp_path / "model.npz")
    return tmp_path / "model.npz"


def spoken(*words: object) -> tuple[int, dict[str, Any], str]:
    """Run with `--json`; status, the object, stderr."""
    status, text, stderr = torchsfm(*words, "--json")
    assert len(text.splitlines()) == 1, text
    found = json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))
    assert found["status"] == status
    return status, found, stderr


# ---- to programs and to nobody -------------------------------------------------------------------------------------------


def test_a_reconstruction_told_to_programs(courtyard: Path, tmp_path: Path) -> None:
    images = [courtyard / f"view{i}.png" for i in range(2)]
    out = tmp_path / "out"
    status, found, stderr = spoken("reconstruct", *images, "--out", out)
    assert status == 0
    assert stderr.startswith("finding features ...")
    record = json.loads((out / "report.json").read_text())
    assert {key: found[key] for key in record} == record
    assert found["out"] == str(out)
    assert str(out / "model.npz") in found["files"]
    assert all(Path(name).exists() for name in found["files"])
    assert "2 of 2 images registered" in found["text"][0]
    status, text, stderr = torchsfm("reconstruct", *images, "--out", out, "--resume", "--quiet")
    assert (status, text, stderr) == (0, "", "")


def test_every_command_speaks_json(saved: Path, tmp_path: Path) -> None:
    model = small_model.make()
    for words, keys in (
        (("info", saved), {"models"}),
        (("convert", saved, tmp_path / "sparse"), {"out", "format", "images", "points", "observations"}),
        (("export", saved, "--for", "colmap", "--out", tmp_path / "colmap"), {"exports"}),
        (("bundle", saved, "--out", tmp_path / "b.npz"), {"cost_before", "cost", "iterations", "ending", "out"}),
        (("compare", saved, saved), {"auc", "position_rmse", "images"}),
        (("view", saved, "--no-browser", "--out", tmp_path / "a.html"), {"page"}),
        (("align", saved, "--scale", 2.0, "--out", tmp_path / "c.npz"), {"similarity", "out", "format", "images", "points"}),
        (("align", saved, "--to", saved, "--out", tmp_path / "c.npz"), {"similarity", "aligned", "out"}),
        (("merge", saved, saved, "--out", tmp_path / "d.npz"), {"merged", "out", "format", "images", "points"}),
    ):
        status, found, _ = spoken(*words)
        assert status == 0
        assert keys <= set(found), words
        assert found["text"]
        assert torchsfm(*words, "--quiet") == (0, "", "")
    found = spoken("info", saved)[1]["models"][0]
    assert [image["name"] for image in found["images"]] == list(model.names)
    assert [image["observations"] for image in found["images"]] == torch.bincount(model.view, minlength=4).tolist()
    assert not found["images"][3]["registered"]
    assert found["images"][3]["mean_error_px"] is None
    # What holds no observations has no error of zero.
    write_model(model, tmp_path / "transforms.json")
    found = spoken("info", tmp_path / "transforms.json")[1]["models"][0]
    assert {image["mean_error_px"] for image in found["images"]} == {None}
    assert "0.000" not in torchsfm("info", tmp_path / "transforms.json")[1]


def test_what_align_and_merge_tell_to_programs(saved: Path, tmp_path: Path) -> None:
    model = small_model.make()
    moved(model).save(tmp_path / "moved.npz")
    found = spoken("align", saved, "--to", tmp_path / "moved.npz", "--out", tmp_path / "a.npz")[1]
    similarity = found["similarity"]
    assert similarity["scale"] == pytest.approx(3.0)
    assert torch.tensor(similarity["translation"]).allclose(torch.tensor([1.0, -2.0, 5.0]), atol=1e-6)
    R = torch.tensor(similarity["rotation"], dtype=torch.float64)
    torch.testing.assert_close(
        model.transform(Similarity(torch.tensor(3.0).double(), R, torch.tensor([1.0, -2.0, 5.0]).double())).X,
        Reconstruction.load(tmp_path / "a.npz").X,
    )
    assert [(row["name"], row["used"]) for row in found["aligned"]] == [(name, True) for name in model.names[:3]]
    assert max(row["apart"] for row in found["aligned"]) < 1e-9
    assert (found["images"], found["points"], found["format"]) == (3, 30, "torchsfm")
    small_model.with_curves(model).save(tmp_path / "curves.npz")
    found = spoken("merge", saved, saved, tmp_path / "curves.npz", "--out", tmp_path / "b.npz")[1]
    assert [part["shared_images"] for part in found["merged"]] == 2 * [list(model.names[:3])]
    assert [part["model"] for part in found["merged"]] == [str(saved), str(tmp_path / "curves.npz")]
    assert found["merged"][0]["shared_points"] == 30
    merged = Reconstruction.load(tmp_path / "b.npz")
    assert merged.curves is not None
    assert (found["points"], found["observations"]) == (merged.num_points, merged.num_observations)
    assert found["curves"] == len(merged.curves)


def test_faults_are_told_to_programs(tmp_path: Path) -> None:
    for words in (("info", tmp_path / "gone"), ("reconstruct", tmp_path / "gone", "--out", tmp_path / "out")):
        status, found, stderr = spoken(*words)
        assert status == 2
        assert_one_line(stderr, found["error"])
        status, text, stderr = torchsfm(*words, "--quiet")
        assert (status, text) == (2, "")
        assert_one_line(stderr, found["error"])
    for words in (("info", "--inof", tmp_path), ("compare", tmp_path), ("bundle", tmp_path, "--max-iterations", "many")):
        status, found, stderr = spoken(*words)
        assert status == 2
        assert found["error"] in " ".join(stderr.replace("│", " ").split())
        assert torchsfm(*words)[:2] == (2, "")


def test_numbers_that_json_has_not() -> None:
    found = plain({"a": [1.5, math.inf, (math.nan, -math.inf)], 3: {"b": None, "c": True}})
    assert found == {"a": [1.5, None, [None, None]], "3": {"b": None, "c": True}}


def test_how_far_a_stage_is(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(job.time, "monotonic", lambda: clock[0])
    run = Job(tmp_path, terminal=False)
    for second in range(101):
        clock[0] = float(second)
        run.progress("features", second, 100)
    clock[0] = 102.0
    run.progress("match", 0, 4)
    clock[0] = 200.0
    run.progress("match", 0, 4)
    clock[0] = 302.0
    run.progress("match", 1, 4)
    assert capsys.readouterr().err.splitlines() == [
        "finding features ...",
        "finding features: 30 of 100, 70 s left",
        "finding features: 60 of 100, 40 s left",
        "finding features: 90 of 100, 10 s left",
        "matching pairs ...",
        "matching pairs: 0 of 4",
        "matching pairs: 1 of 4, 10 min left",
    ]
    assert [duration(seconds) for seconds in (0.4, 89.0, 600.0, 7200.0)] == ["0 s", "89 s", "10 min", "2.0 h"]


# ---- view ----------------------------------------------------------------------------------------------------------------


def test_view_opens_the_page_of_a_run(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) or True)
    (saved.parent / "page.html").write_text("the page of the run")
    status, text, _ = torchsfm("view", saved.parent)
    assert status == 0
    assert opened == [(saved.parent / "page.html").as_uri()]
    assert str(saved.parent / "page.html") in text
    # Of a file a new page is written, elsewhere.
    status, text, _ = torchsfm("view", saved)
    assert status == 0
    page = Path(opened[1].removeprefix("file://"))
    assert page.read_text().startswith("<!")
    assert (saved.parent / "page.html").read_text() == "the page of the run"
    status, _, _ = torchsfm("view", saved, "--out", saved.parent / "new" / "a.html", "--unit", "ft", "--no-browser")
    assert status == 0
    assert '"unit":"ft"' in (saved.parent / "new" / "a.html").read_text()
    assert len(opened) == 2


def test_view_without_a_browser_says_where_the_page_is(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webbrowser, "open", lambda address: False)
    status, text, _ = torchsfm("view", saved, "--out", saved.parent / "a.html")
    assert status == 0
    assert "no browser was found here" in text


def test_view_of_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webbrowser, "open", lambda address: pytest.fail("nothing to open"))
    (tmp_path / "words.npz").write_text("words")
    for path in (tmp_path, tmp_path / "gone", tmp_path / "words.npz"):
        status, _, stderr = torchsfm("view", path)
        assert status == 2
        assert_one_line(stderr, str(path))


# ---- compare -------------------------------------------------------------------------------------------------------------


def moved(model: Reconstruction) -> Reconstruction:
    """The same in another frame and at another scale."""
    R = random_rotation(generator=seeded(1), dtype=torch.float64)
    return model.transform(Similarity(torch.tensor(3.0).double(), R, torch.tensor([1.0, -2.0, 5.0]).double()))


def test_compare_is_blind_to_frame_and_scale(tmp_path: Path) -> None:
    truth = small_model.make()
    truth.save(tmp_path / "truth.npz")
    moved(truth).save(tmp_path / "model.npz")
    _, found, _ = spoken("compare", tmp_path / "model.npz", tmp_path / "truth.npz")
    assert found["registered"] == found["images_of_truth"] == 3
    assert found["position_rmse"] < 1e-9
    assert min(found["auc"].values()) > 1 - 1e-9
    assert all(image["rotation_error_deg"] < 1e-9 for image in found["images"])
    assert [image["name"] for image in found["images"]] == list(truth.names[:3])


def test_compare_measures_each_image(tmp_path: Path) -> None:
    truth = small_model.make()
    truth.save(tmp_path / "truth.npz")
    turn = rotation_from_rotvec(torch.tensor([0.0, math.radians(0.9), 0.0]).double())
    R = truth.poses.R.clone()
    R[1] = turn @ R[1]
    centre = truth.poses.centre
    wrong = replace(truth, poses=Pose(R, -(R @ centre[..., None])[..., 0]), registered=torch.tensor([True, True, False, False]))
    # In another order, under other endings, in a folder.
    wrong = replace(wrong, names=tuple(f"x/{name[:-4]}.png" for name in wrong.names))
    wrong.save(tmp_path / "model.npz")
    status, text, _ = torchsfm("compare", tmp_path / "model.npz", tmp_path / "truth.npz")
    assert status == 0
    assert "2 of 3 images have a pose" in text
    assert "not registered" in text.splitlines()[-1]
    found = spoken("compare", tmp_path / "model.npz", tmp_path / "truth.npz")[1]
    # The common rotation lies between the two.
    assert [image["registered"] for image in found["images"]] == [True, True, False]
    errors = [image["rotation_error_deg"] for image in found["images"]]
    assert sum(errors[:2]) == pytest.approx(0.9, abs=1e-6)
    assert errors[2] is None
    # One pair of three, 0.9 degrees off, two without a pose.
    assert found["auc"]["1"] < 1 / 3
    assert found["auc"]["5"] < 1 / 3 + 1e-9


def test_compare_wants_common_images(tmp_path: Path) -> None:
    model = small_model.make()
    model.save(tmp_path / "a.npz")
    replace(model, names=("1", "2", "3", "4")).save(tmp_path / "b.npz")
    status, _, stderr = torchsfm("compare", tmp_path / "a.npz", tmp_path / "b.npz")
    assert status == 2
    assert_one_line(stderr, "has a pose for 0 of the 3 images", "'a.jpg'", "'1'")
    write_colmap(model, tmp_path / "colmap")
    assert torchsfm("compare", tmp_path / "colmap", tmp_path / "a.npz")[0] == 0
    status, _, stderr = torchsfm("compare", tmp_path / "gone", tmp_path / "a.npz")
    assert status == 2
    assert_one_line(stderr, "gone", "no such file or folder")


# ---- ways in -------------------------------------------------------------------------------------------------------------


def test_subfolders_are_cameras_of_their_own(courtyard: Path, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    for i in range(VIEWS - 1):
        (photos / "ab"[i % 2]).mkdir(parents=True, exist_ok=True)
        copy(courtyard / f"view{i}.png", photos / "ab"[i % 2])
    (photos / "list.txt").write_text("a/view0.png\nb/view1.png\na/view2.png\n")
    names = ["a/view0.png", "a/view2.png", "b/view1.png", "b/view3.png"]
    # Results within the photographs are not taken for such by the next run.
    out = photos / "results"
    assert torchsfm("reconstruct", photos, "--out", out, "--for", "gsplat")[0] == 0
    model = Reconstruction.load(out / "model.npz")
    assert list(model.names) == names
    assert model.camera_index.tolist() == [0, 0, 1, 1]
    assert (
        sorted(path.relative_to(out / "gsplat/images").as_posix() for path in (out / "gsplat/images").rglob("*.png")) == names
    )
    assert '"a/view0.png"' in (out / "page.html").read_text()
    assert torchsfm("reconstruct", photos / "list.txt", "--out", out, "--shared-camera")[0] == 0
    assert list(report(out)) == ["a/view0.png", "b/view1.png", "a/view2.png"]
    assert Reconstruction.load(out / "model.npz").camera_index.tolist() == [0, 0, 0]


def test_a_film_becomes_a_model(courtyard: Path, tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    writer = cv2.VideoWriter(str(tmp_path / "film.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, (WIDTH, HEIGHT))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no films")
    for i in range(3):
        pixels = (read_image(courtyard / f"view{i}.png").pixels.flip(0) * 255).round().byte()
        for _ in range(2):
            writer.write(pixels.permute(1, 2, 0).numpy())
    writer.release()
    out = tmp_path / "out"
    status, _, stderr = torchsfm("reconstruct", tmp_path / "film.avi", "--fps", 5, "--out", out)
    assert status == 0
    assert stderr.splitlines()[0] == "reading the film ..."
    assert "tracking corners ..." in stderr
    assert len(list(out.glob("frames/*.jpg"))) == 3
    assert Reconstruction.load(out / "model.npz").num_registered == 3
    times = [path.stat().st_mtime_ns for path in sorted(out.glob("frames/*.jpg"))]
    _, _, stderr = torchsfm("reconstruct", tmp_path / "film.avi", "--fps", 5, "--out", out, "--resume")
    assert "finding features" not in stderr
    assert [path.stat().st_mtime_ns for path in sorted(out.glob("frames/*.jpg"))] == times


def test_films_that_are_none(courtyard: Path, tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_bytes(b"x" * 1000)
    out = tmp_path / "out"
    for words, part in (
        ((tmp_path / "film.mp4",), "not a film that can be read"),
        ((tmp_path / "gone.mp4",), "no such file"),
        ((tmp_path / "film.mp4", courtyard / "view0.png"), "a film is reconstructed by itself"),
        ((courtyard, "--fps", 2), "--fps: wants a film"),
    ):
        status, _, stderr = torchsfm("reconstruct", *words, "--out", out)
        assert status == 2
        assert_one_line(stderr, part)
        assert not (out / "frames").exists()
    assert torchsfm("reconstruct", tmp_path / "film.mp4", "--fps", 0, "--out", out)[0] == 2
    status, _, stderr = torchsfm("triangulate", tmp_path / "film.mp4", courtyard, "--poses", tmp_path, "--out", out)
    assert status == 2
