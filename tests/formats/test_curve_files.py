"""Curves in files: vertices in order with edges between them, and splines that SciPy reads."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import small_model
import torch

from torchsfm.formats import read_ply, write_curves
from torchsfm.geometry import Curve
from torchsfm.reconstruction import Curves


@pytest.fixture
def curves() -> Curves:
    """A closed one of 16 samples, an open one of 12, a closed one of 2."""
    found = small_model.with_curves(small_model.make()).curves
    assert found is not None
    return found


PAIRS = [[i, (i + 1) % 16] for i in range(16)] + [[i, i + 1] for i in range(16, 27)] + [[28, 29]]
"""Two samples are an edge, whether closed or not."""


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ply_has_samples_in_order_and_edges(curves: Curves, dtype: torch.dtype, tmp_path: Path) -> None:
    some = small_model.with_curves(small_model.make()).to(dtype).curves
    assert some is not None
    write_curves(some, tmp_path / "curves.ply")
    cloud = read_ply(tmp_path / "curves.ply")
    assert torch.equal(cloud.X, some.X)
    assert cloud.color is not None
    assert (cloud.color - curves.color).abs().max() <= 0.5 / 255 + 1e-6
    head, _, body = (tmp_path / "curves.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 30\n" in head
    real = "<f8" if dtype == torch.float64 else "<f4"
    columns = [("x", real), ("y", real), ("z", real), ("curve", "<i4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertex = np.dtype(columns)
    assert np.frombuffer(body, vertex, 30)["curve"].tolist() == [0] * 16 + [1] * 12 + [2] * 2
    assert np.frombuffer(body[30 * vertex.itemsize :], "<i4").reshape(-1, 2).tolist() == PAIRS


def test_obj_has_a_line_for_each_curve(curves: Curves, tmp_path: Path) -> None:
    write_curves(replace(small_model.make(), curves=curves), tmp_path / "curves.obj")
    rows = [row.split() for row in (tmp_path / "curves.obj").read_text().splitlines()]
    vertices = torch.tensor([[float(v) for v in row[1:]] for row in rows if row[0] == "v"], dtype=torch.float64)
    assert torch.equal(vertices[:, :3], curves.X)
    assert (vertices[:, 3:] - curves.color).abs().max() < 1e-4
    slots = [[int(v) - 1 for v in row[1:]] for row in rows if row[0] == "l"]
    assert [[a, b] for own in slots for a, b in pairwise(own)] == PAIRS


def test_json_holds_splines(curves: Curves, tmp_path: Path) -> None:
    interpolate = pytest.importorskip("scipy.interpolate")
    write_curves(curves, tmp_path / "curves.json")
    records = json.loads((tmp_path / "curves.json").read_text())["curves"]
    assert [record["closed"] for record in records] == curves.closed.tolist()
    for k, record in enumerate(records):
        read = interpolate.BSpline(np.array(record["knots"]), np.array(record["control_points"]), record["degree"])
        x = torch.from_numpy(read(np.linspace(0, 1, 2000)))
        assert torch.cdist(curves.X[curves.curve == k], x).amin(-1).max() < 0.02


def test_no_curves_and_broken_ones(curves: Curves, tmp_path: Path) -> None:
    X = curves.X.clone()
    X[17, 1] = torch.nan
    for some, count in ((curves.select(torch.zeros(3, dtype=torch.bool)), 0), (replace(curves, X=X), 18)):
        for name in ("a.ply", "a.obj", "a.json"):
            write_curves(some, tmp_path / name)
        assert len(read_ply(tmp_path / "a.ply").X) == count
        assert "nan" not in (tmp_path / "a.obj").read_text()
        assert len(json.loads((tmp_path / "a.json").read_text())["curves"]) == (2 if count else 0)


def drawn(path: Path) -> tuple[list[float], list[tuple[torch.Tensor, bool, str]]]:
    """The page and the paths of a drawing, in the pixels of its image."""
    svg = ElementTree.parse(path).getroot()
    group = svg.find("{*}g")
    assert group is not None
    assert group.get("transform") == "translate(0.5 0.5)"
    paths = []
    for one in group:
        words = (one.get("d") or "").replace(",", " ").split()
        closed = words[-1] == "Z"
        values = [float(word) for word in words[1 : len(words) - closed]]
        paths.append((torch.tensor(values, dtype=torch.float64).reshape(-1, 2), closed, one.get("stroke") or ""))
    return [float(word) for word in (svg.get("viewBox") or "").split()], paths


@pytest.mark.parametrize("lens", ["pinhole", "opencv", "fisheye"])
def test_a_drawing_of_a_model_is_what_its_camera_sees(lens: str, tmp_path: Path) -> None:
    model = small_model.with_curves(small_model.make(lens))
    assert model.curves is not None
    model = replace(model, names=("a.jpg", "<b>&\udcff\x01.jpg", "c.jpg", "d.jpg"))
    for image in (1, model.names[1]):
        write_curves(model, tmp_path / "a.svg", image=image)
        page, paths = drawn(tmp_path / "a.svg")
        assert page == [0, 0, 800, 600]
        assert [closed for _, closed, _ in paths] == model.curves.closed.tolist()
        wanted = model.cameras[0].project(model.poses[1].transform(model.curves.X))
        torch.testing.assert_close(torch.cat([x for x, _, _ in paths]), wanted, rtol=0, atol=6e-4)
        assert paths[0][2] == "#" + "".join(f"{v:02x}" for v in (model.curves.color[:16].mean(0) * 255).round().int().tolist())


def test_a_drawing_ends_where_the_image_does(tmp_path: Path) -> None:
    """Curves are cut at the border, and where they go behind the camera."""
    model = small_model.with_curves(small_model.make("pinhole"), finer=4)
    centre = model.poses.centre[0]
    assert model.curves is not None
    around = replace(model, curves=replace(model.curves, X=centre + model.curves.X))
    for some in (around, replace(model, image_size=torch.tensor([[430, 600]] * 4))):
        write_curves(some, tmp_path / "a.svg", image=0)
        (_, _, width, height), paths = drawn(tmp_path / "a.svg")
        x = torch.cat([x for x, _, _ in paths])
        assert bool(((x >= -0.5) & (x <= torch.tensor([width, height]) - 0.5)).all())
        assert some.curves is not None
        d = some.poses[0].transform(some.curves.X)
        y = some.cameras[0].project(d)
        inside = ((y >= -0.5) & (y <= some.image_size[0] - 0.5)).all(-1) & (d[:, 2] > 0)
        assert 0 < len(x) == int(inside.sum()) < len(inside)
        assert not all(closed for _, closed, _ in paths)


def test_a_drawing_of_curves_of_an_image(tmp_path: Path, generator: torch.Generator) -> None:
    x = 100 * torch.rand(2, 3, 7, 2, generator=generator) - 20
    valid = torch.arange(7) < torch.tensor([[7, 0, 3], [5, 1, 2]])[..., None]
    closed = torch.tensor([[True, False, False], [True, False, False]])
    write_curves(Curve(x, valid, closed), tmp_path / "a.svg")
    (left, top, width, height), paths = drawn(tmp_path / "a.svg")
    assert [len(own) for own, _, _ in paths] == [7, 3, 5, 1, 2]
    assert [around for _, around, _ in paths] == [True, False, True, False, False]
    torch.testing.assert_close(torch.cat([own for own, _, _ in paths]).float(), x[valid], rtol=0, atol=6e-4)
    corner = torch.tensor([left, top]) - 0.5
    assert bool(((x[valid] >= corner) & (x[valid] <= corner + torch.tensor([width, height]))).all())


@pytest.mark.usefixtures("unchecked")
def test_wrong_names_and_models(curves: Curves, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"path: wanted a name that ends with one of \.ply, \.obj, \.json, \.svg"):
        write_curves(curves, tmp_path / "curves.stl")
    with pytest.raises(ValueError, match="a model in which none were looked for"):
        write_curves(small_model.make(), tmp_path / "curves.ply")
    model = replace(small_model.make(), curves=curves)
    rows = Curve(torch.zeros(3, 2), torch.ones(3, dtype=torch.bool), torch.tensor(False))
    for some, name, image, words in (
        (model, "a.svg", None, "image: wanted one for a drawing"),
        (model, "a.svg", 3, "image: wanted one of the model that has a pose, got 3"),
        (model, "a.svg", "gone.jpg", "image: wanted one of the model that has a pose, got 'gone.jpg'"),
        (model, "a.ply", 0, "image: wanted one for a drawing"),
        (curves, "a.svg", None, "curves: wanted a model with cameras"),
        (rows, "a.ply", None, "path: wanted a name that ends with .svg for curves of an image"),
        (curves.rows(), "a.svg", None, "curves: wanted ones of an image"),
    ):
        with pytest.raises(ValueError, match=words):
            write_curves(some, tmp_path / name, image=image)
    assert not list(tmp_path.iterdir())
