"""The interactive page holds the model, tells the truth about it, and lets no text become code."""

import base64
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import small_model
import torch
from chance import seeded

from torchsfm.geometry import Pose
from torchsfm.images import read_image, save_image
from torchsfm.plot import write_page
from torchsfm.plot.framing import frame
from torchsfm.reconstruction.model.lines import Lines
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.report import ImageReport, PairReport, Report


def content(path: Path) -> dict[str, Any]:
    text = path.read_text(encoding="utf-8")
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    loaded: dict[str, Any] = json.loads(found.group(1))
    return loaded


def unpack(text: str, dtype: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype=dtype)


def test_the_page_holds_the_model(model: Reconstruction, tmp_path: Path) -> None:
    path = write_page(model, tmp_path / "new" / "page.html", title="A model")
    data = content(path)
    assert data["title"] == "A model"
    (shown,) = data["models"]
    assert shown["summary"].startswith("4 of 5 images, 200 points\n")
    positions = unpack(shown["positions"], "<f4").reshape(-1, 3)
    assert positions.shape == (200, 3)
    # A rotation and a shift: distances stay.
    expected = torch.cdist(model.X, model.X).numpy()
    assert np.allclose(torch.cdist(*(torch.from_numpy(positions.copy()).double(),) * 2).numpy(), expected, atol=1e-5)
    assert np.array_equal(unpack(shown["colors"], "u1").reshape(-1, 3), (model.color * 255).round().numpy().astype("u1"))
    tracks, views = unpack(shown["tracks"], "<u2"), unpack(shown["views"], "<u2")
    assert np.array_equal(tracks, model.track_lengths().numpy())
    assert np.allclose(unpack(shown["errors"], "<f4"), model.point_errors().numpy(), rtol=1e-6)
    assert np.array_equal(views, model.view.numpy())


def test_the_table_has_every_image(model: Reconstruction, tmp_path: Path) -> None:
    rows = content(write_page(model, tmp_path / "page.html"))["models"][0]["images"]
    assert [row["name"] for row in rows] == list(model.names)
    errors = model.view_errors()
    for i, row in enumerate(rows):
        assert row["points"] == int((model.view == i).sum())
        assert row["mean"] == pytest.approx(float(errors[i]), rel=1e-3)
        assert (row["pose"] is not None) == bool(model.registered[i])
    assert rows[3]["status"] == "not registered"
    assert rows[0]["focal"] == 500


def test_cameras_see_the_points_where_they_were_observed(model: Reconstruction, tmp_path: Path) -> None:
    shown = content(write_page(model, tmp_path / "page.html"))["models"][0]
    positions = unpack(shown["positions"], "<f4").reshape(-1, 3).astype(float)
    for i, row in enumerate(shown["images"]):
        if row["pose"] is None:
            continue
        centre, axes = np.array(row["pose"][:3]), np.array(row["pose"][3:]).reshape(3, 3)
        p = (positions - centre) @ axes.T
        X_cam = model.poses[i].transform(model.X).numpy()
        assert np.allclose(p, X_cam, atol=1e-5)
        # The corners are those of the undistorted image.
        d, _ = model.cameras[0].unproject(torch.tensor([[-0.5, -0.5], [639.5, 479.5]], dtype=torch.float64))
        assert np.allclose(np.array(row["corners"])[[0, 2]], d[:, :2].numpy(), atol=1e-6)
        own = X_cam[model.point[model.view == i].numpy(), 2]
        assert abs(row["depth"] - np.median(own)) < 0.1


class Elements(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def test_names_and_titles_stay_text(model: Reconstruction, tmp_path: Path) -> None:
    evil = ("</script><script>alert(1)</script>", "<img src=x onerror=alert(1)>", '"><b>', "$data ${script} $$", "naïve 図.png")
    wild = replace(model, names=evil)
    title = "<script>alert(2)</script> $script & </title>"
    path = write_page(wild, tmp_path / "page.html", title=title)
    data = content(path)
    assert data["title"] == title
    assert [row["name"] for row in data["models"][0]["images"]] == list(evil)
    plain = Elements()
    plain.feed(write_page(model, tmp_path / "plain.html").read_text(encoding="utf-8"))
    parsed = Elements()
    parsed.feed(path.read_text(encoding="utf-8"))
    assert parsed.found == plain.found, "no name adds an element or an attribute"


def test_the_page_asks_the_network_for_nothing(model: Reconstruction, tmp_path: Path) -> None:
    text = write_page(model, tmp_path / "page.html").read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert not re.search(r"https?://|//cdn|\bfetch\(|XMLHttpRequest|@import|url\(", text)
    # Names reach the document as text only.
    assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(", text)
    parsed = Elements()
    parsed.feed(text)
    for tag, attributes in parsed.found:
        assert "src" not in attributes, tag
        assert "href" not in attributes, tag


def test_several_models_and_a_report(model: Reconstruction, tmp_path: Path) -> None:
    entries = [
        *(ImageReport(name, 0) for name in ("view_0.png", "view_1.png")),
        ImageReport("view_2.png", 1),
        ImageReport("view_3.png", None, "too few matches"),
        ImageReport("view_4.png", 0),
        ImageReport("broken.jpg", None, "cut short"),
    ]
    none = torch.zeros(0, dtype=torch.long)
    report = Report(tuple(entries), PairReport(none.reshape(0, 2), none, none, none, none), {})
    first = replace(model, registered=torch.tensor([True, True, False, False, True]))
    data = content(write_page([first, model], tmp_path / "page.html", report=report))
    one, two = data["models"]
    assert one["label"].startswith("1 of 2: 3 images")
    assert two["label"].startswith("2 of 2: 4 images")
    status = {row["name"]: row.get("status") for row in one["images"]}
    assert status["view_2.png"] == "in model 2"
    assert status["view_3.png"] == "too few matches"
    assert status["broken.jpg"] == "cut short"
    assert "3 of 6 images" in one["summary"]


def test_photographs_are_put_in_small(model: Reconstruction, tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for name in model.names[:2]:
        save_image(folder / name, torch.rand(3, 48, 64))
    (folder / model.names[2]).write_text("no image")
    photos = content(write_page(model, tmp_path / "page.html", images=folder, thumbnail=32))["photos"]
    assert sorted(photos) == sorted(model.names[:2])
    for text in photos.values():
        head, _, body = text.partition(",")
        assert head == "data:image/jpeg;base64"
        (tmp_path / "copy.jpg").write_bytes(base64.b64decode(body))
        assert read_image(tmp_path / "copy.jpg").size == (32, 24)


def test_all_photographs_together_keep_the_limit(model: Reconstruction, tmp_path: Path, generator: torch.Generator) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for i, name in enumerate(model.names):
        # Some compress well, some do not at all.
        save_image(folder / name, 0.5 + (0.1 * i) * (torch.rand(3, 300, 400, generator=generator) - 0.5))
    before = math.inf
    for limit in (10**6, 100_000, 40_000, 12_000, 3_000, 0):
        photos = content(write_page(model, tmp_path / "page.html", images=folder, photo_bytes=limit))["photos"]
        total = sum(len(text) for text in photos.values())
        assert total <= min(limit, before)
        assert len(photos) == (5 if limit >= 40_000 else len(photos))
        # The limit is used, not only kept.
        assert not 40_000 <= limit <= 100_000 or total > 0.4 * limit
        before = total
    assert not photos


def test_every_observation_is_in_the_page(model: Reconstruction, tmp_path: Path, generator: torch.Generator) -> None:
    shuffled = torch.randperm(len(model.x), generator=generator)
    mixed = replace(model, x=model.x[shuffled], view=model.view[shuffled], point=model.point[shuffled])
    shown = content(write_page(mixed, tmp_path / "page.html"))["models"][0]
    views, places = unpack(shown["views"], "<u2"), unpack(shown["places"], "<u2").reshape(-1, 2)
    residuals = unpack(shown["residuals"], "<f2").reshape(-1, 2)
    point = np.repeat(np.arange(len(model.X)), unpack(shown["tracks"], "<u2"))
    key = {(int(v), int(p)): i for i, (v, p) in enumerate(zip(model.view, model.point, strict=True))}
    at = [key[pair] for pair in zip(views.tolist(), point.tolist(), strict=True)]
    assert len(set(at)) == len(model.x)
    size = model.image_size[model.view[at]].numpy()
    assert np.allclose(places / 65535 * size - 0.5, model.x[at].numpy(), atol=float(size.max()) / 65535)
    assert np.allclose(residuals, (model.projections() - model.x)[at].numpy(), rtol=1e-3, atol=1e-6)


def test_pairs_are_those_of_the_report(model: Reconstruction, tmp_path: Path) -> None:
    images = (*(ImageReport(name, 0, features=9) for name in model.names), ImageReport("broken.jpg", None, "cut short"))
    pairs, one = torch.tensor([[0, 1], [4, 2]]), torch.tensor([1, 0])
    table = PairReport(pairs, torch.tensor([70, 20]), torch.tensor([60, 5]), torch.tensor([65, 4]), one)
    shown = content(write_page(model, tmp_path / "page.html", report=Report(images, table, {})))["pairs"]
    assert shown["names"] == list(model.names)
    assert unpack(shown["pairs"], "<u4").tolist() == [0, 1, 4, 2]
    assert unpack(shown["inliers"], "<u4").tolist() == [65, 5]
    assert [shown["verdicts"][v] for v in unpack(shown["verdict"], "u1")] == ["general", "unrelated"]
    assert content(write_page(model, tmp_path / "page.html"))["pairs"] is None
    with pytest.raises(ValueError, match="no image 4 among the 2"):
        write_page(model, tmp_path / "page.html", report=Report(images[:2], table, {}))


def test_empty_and_broken_models_still_make_a_page(model: Reconstruction, tmp_path: Path) -> None:
    empty = replace(
        model, X=model.X[:0], color=model.color[:0], x=model.x[:0], view=model.view[:0], point=model.point[:0],
        registered=torch.zeros(5, dtype=torch.bool),
    )  # fmt: skip
    shown = content(write_page(empty, tmp_path / "empty.html"))["models"][0]
    assert shown["positions"] == ""
    assert shown["radius"] == 1
    X = model.X.clone()
    X[7, 1], X[9, 0] = math.nan, math.inf
    shown = content(write_page(replace(model, X=X), tmp_path / "broken.html"))["models"][0]
    positions = unpack(shown["positions"], "<f4")
    assert len(positions) == 3 * 198
    assert np.isfinite(positions).all()
    keep = (model.point != 7) & (model.point != 9)
    assert np.array_equal(unpack(shown["views"], "<u2"), model.view[keep].numpy())


def test_cameras_that_are_not_finite_are_not_drawn(model: Reconstruction, tmp_path: Path) -> None:
    t = model.poses.t.clone()
    t[1, 0] = math.nan
    shown = content(write_page(replace(model, poses=Pose(model.poses.R, t)), tmp_path / "page.html"))["models"][0]
    assert [row["pose"] is not None for row in shown["images"]] == [True, False, True, False, True]
    assert np.isfinite(unpack(shown["errors"], "<f4")).all()


def test_single_precision_models_are_welcome(model: Reconstruction, tmp_path: Path) -> None:
    assert content(write_page(model.to(torch.float32), tmp_path / "page.html"))["models"][0]["images"][0]["focal"] == 500


def test_wrong_arguments(model: Reconstruction, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="wanted at least one model"):
        write_page([], tmp_path / "page.html")
    with pytest.raises(ValueError, match="thumbnail"):
        write_page(model, tmp_path / "page.html", thumbnail=0)
    with pytest.raises(ValueError, match="photo_bytes"):
        write_page(model, tmp_path / "page.html", photo_bytes=-1)
    (tmp_path / "page").write_text("a file, not a folder")
    with pytest.raises(OSError, match="page"):
        write_page(model, tmp_path / "page" / "page.html")


def test_framing_ignores_wild_points(model: Reconstruction) -> None:
    clean = frame(model)
    X = model.X.clone()
    X[::20] = 1e5 * torch.randn(10, 3, dtype=torch.float64, generator=seeded(1))
    wild = frame(replace(model, X=X))
    assert wild.radius == pytest.approx(clean.radius, rel=0.1)
    assert torch.allclose(wild.centre, clean.centre, atol=0.1)
    # Seen from the side of the cameras, from above.
    side = (model.poses.centre[model.registered] @ clean.R.mT).mean(0)
    assert float(clean.direction[:2] @ side[:2]) > 0.5 * float(side[:2].norm())
    assert clean.direction[2] > 0.2
    assert torch.allclose(clean.R @ clean.R.mT, torch.eye(3, dtype=torch.float64))
    assert float(torch.linalg.det(clean.R)) == pytest.approx(1)


def test_lines_are_drawn_and_can_be_hidden(model: Reconstruction, tmp_path: Path, generator: torch.Generator) -> None:
    plain = content(write_page(model, tmp_path / "plain.html"))["models"][0]
    assert unpack(plain["lineEnds"], "<f4").size == 0
    points = torch.randint(len(model.X), (6, 2), generator=generator)
    color, none = torch.rand(6, 3, generator=generator, dtype=torch.float64), torch.zeros(0, dtype=torch.long)
    ends = model.X[points]
    ends[2, 1, 0] = torch.nan
    lines = Lines(ends, color, model.x.new_zeros(0, 2, 2), model.x.new_zeros(0), none, none)
    path = write_page(replace(model, lines=lines), tmp_path / "page.html")
    shown, keep = content(path)["models"][0], torch.arange(6) != 2
    positions = unpack(shown["positions"], "<f4").reshape(-1, 3)
    assert np.allclose(unpack(shown["lineEnds"], "<f4").reshape(-1, 2, 3), positions[points[keep].numpy()], atol=1e-6)
    assert np.array_equal(unpack(shown["lineColors"], "u1").reshape(-1, 3), (color[keep] * 255).round().numpy().astype("u1"))
    assert shown["lineCounts"] == {"lines": 5}
    assert "5 lines" in shown["summary"]
    assert 'id="lines"' in path.read_text()


def test_curves_are_drawn_from_sample_to_sample(tmp_path: Path) -> None:
    model = small_model.with_curves(small_model.make())
    curves = model.curves
    assert curves is not None
    broken = curves.X.clone()
    broken[3] = torch.nan
    points = replace(model, X=curves.X, color=curves.color, x=model.x[:0], view=model.view[:0], point=model.point[:0])
    path = write_page(replace(points, curves=replace(curves, X=broken)), tmp_path / "page.html")
    shown = content(path)["models"][0]
    X = unpack(shown["positions"], "<f4").reshape(-1, 3)
    pairs = [(i, (i + 1) % 16) for i in range(16)] + [(i, i + 1) for i in range(16, 27)] + [(28, 29)]
    pairs = [(a, b) for a, b in pairs if 3 not in (a, b)]
    assert np.allclose(unpack(shown["lineEnds"], "<f4").reshape(-1, 2, 3), X[np.array(pairs)], atol=1e-6)
    expected = (curves.color[[a for a, _ in pairs]] * 255).round().numpy().astype("u1")
    assert np.array_equal(unpack(shown["lineColors"], "u1").reshape(-1, 3), expected)
    assert shown["lineCounts"] == {"curves": len(pairs)}
    assert "3 curves, in 3.0 images" in shown["summary"]
