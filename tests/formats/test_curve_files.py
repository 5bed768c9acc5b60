"""Curves in files: vertices in order with edges between them, and splines that SciPy reads."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from torchsfm.formats import read_ply, write_curves_json, write_curves_ply
from torchsfm.geometry import Spline, curve_from_samples


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ply_has_samples_in_order_and_edges(dtype: torch.dtype, tmp_path: Path, generator: torch.Generator) -> None:
    x = torch.rand(3, 6, 3, generator=generator, dtype=dtype)
    valid = torch.arange(6) < torch.tensor([6, 4, 2])[:, None]
    curves = curve_from_samples(x, valid=valid, closed=torch.tensor([False, True, True]))
    write_curves_ply(curves, tmp_path / "curves.ply")
    assert torch.equal(read_ply(tmp_path / "curves.ply").X, curves.x[curves.valid])
    head, _, body = (tmp_path / "curves.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 12\n" in head
    real = "<f8" if dtype == torch.float64 else "<f4"
    vertex = np.dtype([("x", real), ("y", real), ("z", real), ("curve", "<i4")])
    assert np.frombuffer(body, vertex, 12)["curve"].tolist() == [0] * 6 + [1] * 4 + [2] * 2
    edges = np.frombuffer(body[12 * vertex.itemsize :], "<i4").reshape(-1, 2).tolist()
    # Two samples are an edge, whether closed or not.
    assert edges == [[i, i + 1] for i in range(5)] + [[6, 7], [7, 8], [8, 9], [9, 6]] + [[10, 11]]


def test_json_holds_splines(tmp_path: Path, generator: torch.Generator) -> None:
    interpolate = pytest.importorskip("scipy.interpolate")
    splines = [Spline(torch.rand(7, 3, generator=generator).double(), closed) for closed in (False, True)]
    write_curves_json(splines, tmp_path / "curves.json")
    records = json.loads((tmp_path / "curves.json").read_text())["curves"]
    t = torch.rand(20, generator=generator).double()
    for record, spline in zip(records, splines, strict=True):
        assert record["closed"] == spline.closed
        read = interpolate.BSpline(np.array(record["knots"]), np.array(record["control_points"]), record["degree"])
        torch.testing.assert_close(torch.from_numpy(read(t.numpy())), spline.at(t))


def test_no_curves(tmp_path: Path) -> None:
    none = curve_from_samples(torch.zeros(0, 2, 3))
    write_curves_ply(none, tmp_path / "curves.ply")
    write_curves_json([], tmp_path / "curves.json")
    assert len(read_ply(tmp_path / "curves.ply").X) == 0
