"""The page in a real browser: what it shows is so, mouse, touch and keys reach everything, and nothing is cut off."""

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser import CHROMIUM, Browser

from torchsfm.geometry import Pose
from torchsfm.images import save_image
from torchsfm.plot import write_page
from torchsfm.reconstruction.matching.view_graph import Verdict
from torchsfm.reconstruction.model.curves import Curves
from torchsfm.reconstruction.model.lines import Lines
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.report import ImageReport, PairReport, Report

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
WIDE, PHONE = (1400, 900), (390, 844)
EVIL = (
    "</script><script>alert(1)</script>",
    "<img src=x onerror=alert(1)>",
    '"><b onmouseover=alert(1)>',
    "$data ${script}",
    "naïve 図.png",
)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    browser = Browser(tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


def reported(model: Reconstruction) -> Report:
    """Of the ten pairs of five images, eight were compared, two of them in vain; one image is doubtful."""
    images = tuple(
        ImageReport(name, 0 if known else None, "" if known else "too few matches", 50, "few points" if i == 1 else "")
        for i, (name, known) in enumerate(zip(model.names, model.registered.tolist(), strict=True))
    )
    pairs = torch.combinations(torch.arange(5))[:8]
    verdict = torch.tensor([Verdict.GENERAL, Verdict.PLANAR, Verdict.UNRELATED, Verdict.GENERAL, Verdict.ROTATION] + 3 * [0])
    verdict[5:7] = Verdict.GENERAL
    inliers = torch.where(verdict == 0, 3, torch.arange(8) * 10 + 15)
    return Report(images, PairReport(pairs, torch.full((8,), 100), inliers, inliers // 2, verdict), {})


def photographs(model: Reconstruction, folder: Path) -> Path:
    """Black, with a white spot of 7 x 7 pixels wherever a point was observed."""
    folder.mkdir()
    for i, name in enumerate(model.names):
        if "/" in name:
            continue
        width, height = model.image_size[i].tolist()
        image = torch.zeros(3, height, width)
        for x, y in model.x[model.view == i].round().long().tolist():
            image[:, max(0, y - 3) : y + 4, max(0, x - 3) : x + 4] = 1
        save_image(folder / name, image)
    return folder


@pytest.fixture
def page(model: Reconstruction, tmp_path: Path) -> Path:
    folder = photographs(model, tmp_path / "images")
    return write_page(model, tmp_path / "page.html", title="A model", report=reported(model), images=folder, unit="m")


COVERED = """(() => {
  const bad = [], shown = e => e.checkVisibility() && e.getClientRects().length;
  if (document.documentElement.scrollWidth > innerWidth) bad.push("the page is wider than the window");
  for (const e of document.querySelectorAll("button, select, input, summary")) if (shown(e)) {
    e.scrollIntoView({ block: "nearest" });
    const box = e.getBoundingClientRect();
    const hit = document.elementFromPoint(box.left + box.width / 2, box.top + box.height / 2);
    if (box.left < -1 || box.right > innerWidth + 1 || box.top < -1 || box.bottom > innerHeight + 1)
      bad.push(`cut off: ${e.outerHTML} ${JSON.stringify(box)}`);
    else if (!hit || !(e.contains(hit) || hit.contains(e) && hit.tagName == "LABEL"))
      bad.push(`covered: ${e.outerHTML} by ${hit?.outerHTML.slice(0, 80)}`);
  }
  return bad;
})()"""
STATES = {
    "overview": "0",
    "panel": "showPanel(true)",
    "keys": "showPanel(true), $('keys').open = true",
    "a point": "showPoint(0)",
    "an image": "showImage(0)",
    "an image that was not registered": "showImage(3)",
    "pairs": "showPairs()",
    "looking through": "lookThrough(0)",
    "looking through, and its residuals": "showImage(0)",
    "measuring": "escape(), escape(), startMeasuring(true), measureTo(positionOf(0)), measureTo(positionOf(1))",
}


@pytest.mark.parametrize(("size", "touch"), [(WIDE, False), (PHONE, True), (PHONE[::-1], True), ((960, 600), False)])
def test_nothing_is_cut_off_or_covered(browser: Browser, page: Path, size: tuple[int, int], touch: bool) -> None:
    browser.open(page, size, touch=touch)
    for state, script in STATES.items():
        browser.run(script)
        if touch and state not in ("panel", "keys"):
            browser.run("showPanel(false)")
        assert browser.run(COVERED) == [], state
    assert browser.complaints == []


@pytest.mark.parametrize("size", [WIDE, PHONE])
def test_the_overview_has_all_cameras_in_it(
    browser: Browser, model: Reconstruction, tmp_path: Path, size: tuple[int, int], generator: torch.Generator
) -> None:
    t = model.poses.t.clone()
    # One camera far from all others.
    t[1] += 200 * torch.randn(3, generator=generator, dtype=torch.float64)
    for number, shown in enumerate((model, replace(model, poses=Pose(model.poses.R, t)))):
        browser.open(write_page(shown, tmp_path / f"{number}.html"), size)
        places = browser.run(
            "(() => { const project = projector(); return model.images.filter(c => c.pose)"
            ".flatMap(c => [c.centre, ...corners(c)]).map(p => project(...p)); })()"
        )
        width, height = browser.run("[canvas.clientWidth, canvas.clientHeight]")
        assert len(places) == 20
        assert all(p is not None and 0 < p[0] < width and 0 < p[1] < height for p in places)


# Points that lie in front of all that is near them, and where.
APART = """(() => { const project = projector(), found = [];
  for (let i = 0; i < model.count && found.length < 9; i++) { const p = project(...positionOf(i));
    const free = p[0] > 60 && p[0] < 1000 && p[1] > 90 && p[1] < 800 && cameraAt(p[0], p[1], 30) < 0;
    if (free && pointAt(p[0], p[1]) == i) found.push([i, p[0], p[1]]); }
  return found; })()"""


def test_distances_between_clicked_points(browser: Browser, model: Reconstruction, page: Path) -> None:
    browser.open(page)
    (i, *at), *_, (j, *other) = browser.run(APART)
    browser.run("$('measure').click()")
    browser.click(*at)
    browser.click(*other)
    expected = float((model.X[i] - model.X[j]).norm())
    assert browser.run("measured()") == pytest.approx(expected, rel=1e-5)
    assert browser.run("$('distance').textContent") == f"{float(f'{expected:.4g}'):g} m"
    assert browser.run("details.hidden"), "a click that measures opens nothing"
    # Told how long it is, the page tells all lengths so.
    browser.run("$('true').value = '2.5 ft', $('rescale').requestSubmit()")
    assert browser.run("$('distance').textContent") == "2.5 ft"
    assert browser.run("length(1)") == f"{float(f'{2.5 / expected:.4g}'):g} ft"
    browser.run("$('true').value = 'long', $('rescale').requestSubmit()")
    assert browser.run("$('distance').textContent") == "2.5 ft"
    browser.click(*at)
    browser.key("Escape")
    assert browser.run("$('measuring').hidden && !measure.ends.length")
    assert browser.complaints == []


def test_coordinates_are_those_of_the_model(browser: Browser, model: Reconstruction, page: Path) -> None:
    browser.open(page)
    X = np.array(browser.run("[...Array(model.count).keys()].map(i => inWorld(positionOf(i)))"))
    assert np.allclose(X, model.X.numpy(), atol=1e-5)
    # The axes on the screen are the model's, as the camera of the picture sees them.
    drawn = np.array(browser.run("model.axes.map(a => [dot(a, turn(view.q, [1, 0, 0])), dot(a, turn(view.q, [0, 1, 0]))])"))
    middle = np.array(browser.run("inWorld(view.pivot)"))
    shown = (
        "(() => { const project = projector(), [a, b] = [%s, %s].map(p => project(...p));"
        " return [b[0] - a[0], a[1] - b[1]]; })()"
    )
    for axis in range(3):
        end = browser.run(f"add(view.pivot, model.axes[{axis}], 1e-3)")
        assert np.allclose(np.array(browser.run(f"inWorld({json.dumps(end)})")) - middle, 1e-3 * np.eye(3)[axis], atol=1e-9)
        step = np.array(browser.run(shown % ("view.pivot", json.dumps(end))))
        assert np.allclose(step, drawn[axis] * 1e-3 / browser.run("perPixel()"), atol=2e-2)


INKED = """(() => { paint(performance.now());
  const pixels = new Uint8Array(4 * canvas.width * canvas.height), back = cssColor("--back").map(v => Math.round(255 * v));
  gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  let count = 0;
  for (let i = 0; i < pixels.length; i += 4) if (back.some((v, k) => Math.abs(pixels[i + k] - v) > 2)) count++;
  return count; })()"""


def test_points_cameras_and_photographs_can_be_hidden(browser: Browser, page: Path) -> None:
    browser.open(page)
    browser.wait("model.images.every(c => !c.pose || photograph(c, false))")
    everything = browser.run(INKED)
    browser.run("$('photos').click()")
    without = browser.run(INKED)
    assert 0 < without < everything, "photographs are shown at first"
    browser.run("$('points').click()")
    cameras = browser.run(INKED)
    browser.run("$('cameras').click()")
    assert browser.run(INKED) == 0
    browser.run("$('points').click()")
    points = browser.run(INKED)
    assert 0 < points < without
    assert 0 < cameras < without
    browser.run("$('points').click()")
    # What is hidden cannot be clicked.
    at = browser.run("projector()(...positionOf(0))")
    assert browser.run(f"pointAt({at[0]}, {at[1]}, 1e4)") == -1
    assert browser.run(f"cameraAt({at[0]}, {at[1]}, 1e4)") == -1


def test_lines_and_curves_can_be_hidden_each_by_itself(browser: Browser, model: Reconstruction, tmp_path: Path) -> None:
    none = torch.zeros(0, dtype=torch.long)
    lines = Lines(
        model.X[:20].reshape(10, 2, 3), model.color[:10], model.x.new_zeros(0, 2, 2), model.x.new_zeros(0), none, none
    )
    empty = model.x.new_zeros(0)
    curves = Curves(
        X=model.X[40:60], curve=torch.arange(20) // 10, closed=torch.zeros(2, dtype=torch.bool), color=model.color[40:60],
        sigma=model.x.new_ones(20), x=model.x.new_zeros(0, 2), normal=model.x.new_zeros(0, 2), curvature=empty, weight=empty,
        view=none, sample=none,
    )  # fmt: skip
    browser.open(write_page(replace(model, lines=lines, curves=curves), tmp_path / "page.html"))
    browser.run("$('points').click(), $('cameras').click()")
    assert browser.run("[$('lines'), $('ellipses'), $('curves')].map(e => e.hidden)") == [False, True, False]
    both = browser.run(INKED)
    one = []
    for kind in ("lines", "curves"):
        browser.run(f"$('{kind}').click()")
        one.append(browser.run(INKED))
        browser.run(f"$('{kind}').click()")
    assert 0 < min(one) <= max(one) < both <= sum(one)
    browser.run("$('lines').click(), $('curves').click()")
    assert browser.run(INKED) == 0


def test_the_matrix_of_pairs_is_that_of_the_report(browser: Browser, model: Reconstruction, page: Path) -> None:
    browser.open(page)
    browser.run("$('pairs').click()")
    cells = np.array(
        browser.run(
            "(() => { const face = $('matrix').querySelector('canvas'), context = face.getContext('2d'), side = face.width / 5;"
            " return [0, 1, 2, 3, 4].map(i => [0, 1, 2, 3, 4].map(j =>"
            " [...context.getImageData((j + .5) * side, (i + .5) * side, 1, 1).data])); })()"
        )
    )
    table = reported(model).pairs
    known = {tuple(pair): Verdict(v) for pair, v in zip(table.pairs.tolist(), table.verdict.tolist(), strict=True)}
    for i in range(5):
        for j in range(i + 1, 5):
            red, green, blue, alpha = cells[i, j].tolist()
            assert np.array_equal(cells[i, j], cells[j, i])
            if (i, j) not in known:
                assert alpha == 0
            elif known[i, j] == Verdict.UNRELATED:
                assert max(red, green, blue) - min(red, green, blue) < 30
            else:
                assert green > 1.3 * max(red, blue)
    browser.run("$('matrix').querySelector('canvas').focus()")
    browser.key("ArrowRight")
    text = browser.run("$('pair').textContent")
    assert "view_0.png – view_2.png" in text
    assert "100 matches, 25 agree" in text
    assert "verified (planar)" in text
    common = len(set(model.point[model.view == 0].tolist()) & set(model.point[model.view == 2].tolist()))
    assert f"{common} points of this model in common" in text
    browser.key("ArrowRight")
    assert "refused" in browser.run("$('pair').textContent")
    browser.key("Enter")
    assert browser.run("$('subject').textContent") == "view_0.png"


def test_without_a_report_the_matrix_shows_points_in_common(browser: Browser, model: Reconstruction, tmp_path: Path) -> None:
    browser.open(write_page(model, tmp_path / "page.html"))
    browser.run("showPairs()")
    seen = np.zeros((5, len(model.X)), dtype=int)
    seen[model.view.numpy(), model.point.numpy()] = 1
    assert (
        browser.run("[0, 1, 2, 3, 4].map(i => [0, 1, 2, 3, 4].map(j => i == j ? 0 : shared(i, j)))")
        == ((seen @ seen.T) * (1 - np.eye(5, dtype=int))).tolist()
    )


def test_a_click_on_a_point_shows_its_patches(browser: Browser, model: Reconstruction, page: Path) -> None:
    browser.open(page)
    i, *at = browser.run(APART)[0]
    browser.click(*at)
    assert browser.run("$('subject').textContent") == f"Point {i}"
    mine = model.point == i
    names = [model.names[v] for v in model.view[mine].tolist()]
    labels = browser.run("[...document.querySelectorAll('.patch')].map(e => e.title)")
    assert [label.partition(": ")[0] for label in labels] == names
    shown = [float(label.partition(": ")[2].removesuffix(" px")) for label in labels]
    assert np.allclose(shown, model.residuals()[mine].numpy(), atol=0.006)
    browser.wait(
        "[...document.querySelectorAll('.patch canvas')].every(e => e.getContext('2d').getImageData(46, 46, 1, 1).data[3])"
    )
    middles = browser.run(
        "[...document.querySelectorAll('.patch canvas')].map(e => e.getContext('2d').getImageData(46, 46, 1, 1).data[0])"
    )
    assert min(middles) > 80, "the spot is in the middle of the patch, black is around it"
    browser.run("document.querySelector('.patch').click()")
    assert browser.run("$('subject').textContent") == names[0]


def test_a_click_on_a_camera_shows_its_residuals(browser: Browser, model: Reconstruction, page: Path) -> None:
    browser.open(page)
    *at, _ = browser.run("projector()(...model.images[2].centre)")
    browser.click(*at)
    assert browser.run("$('subject').textContent") == model.names[2]
    own = model.view == 2
    seen = browser.run("observationsIn(2).map(o => [o.point, ...o.at, ...o.off])")
    assert [row[0] for row in seen] == model.point[own].tolist()
    values, size = np.array(seen)[:, 1:], model.image_size[2].numpy()
    assert np.allclose(values[:, :2] * size - 0.5, model.x[own].numpy(), atol=size.max() / 65535)
    off = (model.projections() - model.x)[own].numpy()
    assert np.allclose(values[:, 2:], off, rtol=1e-3, atol=1e-6)
    # On the picture the observation is under its mark, and a click on it opens the point.
    browser.wait("$('image').querySelector('canvas').getContext('2d').getImageData(1, 1, 1, 1).data[3]")
    box = browser.run(
        "(({ left, top, width, height }) => [left, top, width, height])($('image').firstChild.getBoundingClientRect())"
    )
    assert box[2] / box[3] == pytest.approx(size[0] / size[1], rel=0.01)
    browser.click(box[0] + values[0, 0] * box[2], box[1] + values[0, 1] * box[3])
    assert browser.run("$('subject').textContent").startswith("Point ")
    browser.key("Escape")
    assert browser.run("details.hidden")


def test_doubtful_cameras_are_marked(browser: Browser, model: Reconstruction, page: Path) -> None:
    browser.open(page)
    assert "1 doubtful image" in browser.run("$('summary').textContent")
    assert [i for i in range(5) if browser.run(f"!!model.images[{i}].doubtful")] == [1]
    color = browser.run("[...allFrusta([0, 0, 0], [1, 0, 0]).arrays[2]]")
    assert np.array_equal(np.array(color).reshape(4, -1, 4)[:, :, 0].mean(1), [0, 1, 0, 0])
    assert "⚠" in browser.run("$('list').querySelector('tr.doubtful').textContent")
    browser.run("showImage(1)")
    assert "doubtful: few points" in browser.run("$('matter').textContent")


@pytest.mark.parametrize("size", [WIDE, PHONE])
def test_every_control_is_reached_by_tab_and_seen(browser: Browser, page: Path, size: tuple[int, int]) -> None:
    browser.open(page, size)
    browser.run("showPanel(true), narrow.matches || showPoint(0), document.activeElement.blur()")
    wanted = (
        "[...document.querySelectorAll('canvas[tabindex], button, select, input, summary')].filter(e => e.checkVisibility())"
    )
    browser.run(f"window.left = new Set({wanted})")
    count = browser.run("left.size")
    assert count > 20
    for _ in range(count + 12):
        browser.key("Tab")
        outline = browser.run(
            "(e => { left.delete(e); return e == document.body || getComputedStyle(e).outlineStyle != 'none'; })"
            "(document.activeElement)"
        )
        assert outline, browser.run("document.activeElement.outerHTML")
    assert browser.run("[...left].map(e => e.outerHTML)") == []


def test_keys_turn_move_zoom_open_and_close(browser: Browser, page: Path) -> None:
    browser.open(page)
    browser.run("canvas.focus()")
    for key in ("ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"):
        before = browser.run("[...view.q]")
        pivot = browser.run("view.pivot")
        browser.key(key)
        assert not np.allclose(browser.run("[...view.q]"), before, atol=1e-3), key
        assert browser.run("view.pivot") == pivot
        browser.key(key, shift=True)
        assert browser.run("view.pivot") != pivot
    browser.run("view = { ...home }")
    for key in ("ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"):
        browser.key(key)
    assert np.allclose(browser.run("[...view.q]"), browser.run("[...home.q]"), atol=1e-9), "there and back"
    browser.key("+")
    assert browser.run("view.distance") < browser.run("home.distance")
    # Enter opens what is in the middle.
    browser.run("view = { ...home, pivot: positionOf(7), offset: [0, 0], distance: home.distance * .2 }, set.cameras = false")
    browser.key("Enter")
    assert browser.run("$('subject').textContent").startswith("Point ")
    browser.key("Escape")
    assert browser.run("details.hidden && document.activeElement == canvas")
    # The table: one stop, arrows within.
    browser.run("$('list').querySelector('tbody tr').focus()")
    browser.key("ArrowDown")
    browser.key("Enter")
    assert browser.run("$('subject').textContent") == "view_1.png"
    browser.run("lookThrough(1)")
    browser.key("Escape")
    browser.key("Escape")
    assert browser.run("details.hidden && looking == -1")
    browser.key("m")
    assert browser.run("measure.on")
    browser.key("Escape")
    assert not browser.run("measure.on")
    assert browser.complaints == []


def test_fingers_turn_pinch_and_tap(browser: Browser, page: Path) -> None:
    browser.open(page, PHONE, touch=True)
    before = browser.run("({ q: [...view.q], distance: view.distance, pivot: view.pivot })")
    browser.touch([(200.0, 400.0)], [(240.0, 410.0)], [(280.0, 430.0)])
    turned = browser.run("({ q: [...view.q], distance: view.distance, pivot: view.pivot })")
    assert not np.allclose(turned["q"], before["q"], atol=1e-2)
    assert turned["distance"] == before["distance"]
    browser.touch([(180.0, 400.0), (220.0, 400.0)], [(160.0, 400.0), (240.0, 400.0)], [(140.0, 400.0), (260.0, 400.0)])
    pinched = browser.run("({ q: [...view.q], distance: view.distance })")
    assert pinched["distance"] == pytest.approx(before["distance"] / 3, rel=0.05)
    assert pinched["q"] == turned["q"]
    browser.touch([(180.0, 400.0), (220.0, 400.0)], [(180.0, 460.0), (220.0, 460.0)])
    assert math.dist(browser.run("view.pivot"), before["pivot"]) > 1e-3
    browser.run("leave(true), flight = null, view = { ...home }")
    *at, _ = browser.run("projector()(...model.images[0].centre)")
    browser.touch([tuple(at)])
    assert browser.run("$('subject').textContent") == "view_0.png"
    box: dict[str, Any] = browser.run("details.getBoundingClientRect().toJSON()")
    assert 0.4 * PHONE[1] < box["height"] < 0.7 * PHONE[1], "a part of the picture stays to be seen"
    visible = browser.run("model.images.filter(c => c.pose).map(c => projector()(...c.centre)[1])")
    assert max(visible) < box["top"], "and the model moves there"
    browser.run("lookThrough(0)")
    assert browser.run("details.hidden")


MIDDLE = (
    "(e => { e.scrollIntoView({ block: 'nearest' });"
    " const box = e.getBoundingClientRect(); return [box.x + box.width / 2, box.y + box.height / 2]; })"
)


def test_details_close_on_phones(browser: Browser, page: Path) -> None:
    """By a tap on their button or by opening the panel over them: the picture is whole again and can be touched."""
    browser.open(page, PHONE, touch=True)
    places = "model.images.filter(c => c.pose).map(c => projector()(...c.centre))"
    before = browser.run(places)
    rows = "document.querySelectorAll('#list tbody tr')"
    for close in ("$('closedetails')", "$('bare')"):
        browser.run("showPanel(true)")
        browser.touch([tuple(browser.run(f"{MIDDLE}({rows}[0])"))])
        browser.wait("!details.hidden")
        assert browser.run("$('subject').textContent") == "view_0.png"
        assert not browser.run("$('panel').checkVisibility()"), "one of the two at a time"
        assert np.abs(np.array(browser.run(places)) - before).max() > 20, "the model makes room"
        browser.touch([tuple(browser.run(f"{MIDDLE}({close})"))])
        browser.wait("details.hidden")
        assert browser.run("$('panel').checkVisibility()") == (close == "$('bare')")
        assert browser.run("chosen.camera") == -1
        browser.run("showPanel(false)")
        assert np.allclose(browser.run(places), before, atol=1e-6)
        x, y = browser.run(f"{MIDDLE}(canvas)")
        assert browser.run(f"document.elementFromPoint({x}, {y + 250}) == canvas")
    # With keys, from the table, which is hidden meanwhile.
    browser.run(f"showPanel(true), {rows}[1].focus()")
    browser.key("Enter")
    assert browser.run("$('subject').textContent") == "view_1.png"
    browser.key("Escape")
    assert browser.run("details.hidden && document.activeElement == canvas")
    assert browser.complaints == []


def test_names_stay_text_in_every_panel(browser: Browser, model: Reconstruction, tmp_path: Path) -> None:
    wild = replace(model, names=EVIL)
    title = "<script>alert(2)</script>"
    browser.open(write_page(wild, tmp_path / "page.html", title=title, report=reported(wild), unit="<b onclick=alert(3)>"))
    elements = "document.querySelectorAll('script, img, b').length"
    before = browser.run(elements)
    for script in ("showPoint(0)", "showImage(0)", "showImage(3)", "showPairs()", "lookThrough(1)", "hover(2, -1), hideTip()"):
        browser.run(script)
        assert browser.run(elements) == before, script
    browser.run("hover(0, -1), showTip(5, 5)")
    assert EVIL[0] in browser.run("tip.textContent")
    assert browser.run("document.querySelector('h1').textContent") == title
    listed = browser.run("[...document.querySelectorAll('td:first-child bdi')].map(e => e.textContent.replace('⚠ ', ''))")
    assert listed == list(EVIL)
    assert browser.complaints == []


def test_scroll_bars_are_as_dark_as_the_page(browser: Browser, page: Path) -> None:
    browser.open(page)
    bars = "['#list', '#matter', '#panel'].map(s => getComputedStyle(document.querySelector(s)))"
    bars += ".map(s => [s.colorScheme, Number(/\\d+/.exec(s.scrollbarColor))])"
    assert all(scheme == "dark" and red < 90 for scheme, red in browser.run(bars))
    browser.run("$('theme').click()")
    assert all(scheme == "light" and red > 160 for scheme, red in browser.run(bars))


def test_nothing_is_drawn_while_nothing_changes(browser: Browser, page: Path) -> None:
    browser.open(page)
    browser.wait("model.images.every(c => !c.pose || photograph(c, false))")
    rest = "new Promise(done => setTimeout(() => done(painted), 250))"
    browser.run(rest)
    assert browser.run(rest) == browser.run(rest)
    # However many events there are, one drawing for each picture of the screen.
    browser.run("window.start = painted; for (let i = 0; i < 100; i++) orbit(.01, 0)")
    assert (
        browser.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(painted - start))))") <= 2
    )
