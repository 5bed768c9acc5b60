"""Curves in files: vertices in order with edges between them, and splines that SciPy reads."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import small_model
import torch

from torchsfm.formats import read_ply, write_curves
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


@pytest.mark.usefixtures("unchecked")
def test_wrong_names_and_models(curves: Curves, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"path: wanted a name that ends with one of \.ply, \.obj, \.json"):
        write_curves(curves, tmp_path / "curves.stl")
    with pytest.raises(ValueError, match="a model in which none were looked for"):
        write_curves(small_model.make(), tmp_path / "curves.ply")
