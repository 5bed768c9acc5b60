"""Curves in space for other programs: PLY with edges between samples, JSON with splines."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from torchsfm._types import check_tensors
from torchsfm.geometry import Curve, Spline
from torchsfm.reconstruction.files import whole_file


def write_curves_ply(curves: Curve, path: str | Path) -> None:
    """Write space curves as binary little-endian PLY: their samples as vertices, in order, and edges from each to the next.

    MeshLab, Blender and Open3D show them as lines; programs that know only points show the samples. A property `curve` of the
    vertices says which curve it is.

    Args:
        curves: The curves (c, n).
        path: File to write; its folder must be there.

    Raises:
        ValueError: Wrong shape.
        OSError: The file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> t = torch.linspace(0, 6, 100)
        >>> helix = torch.stack((t.cos(), t.sin(), t), -1)
        >>> torchsfm.formats.write_curves_ply(torchsfm.geometry.curve_from_samples(helix[None]), "curves.ply")
    """
    check_tensors(x=(curves.x, "c n 3"), valid=(curves.valid, "c n: bool"), closed=(curves.closed, "c: bool"))
    valid = curves.valid.cpu()
    row, slot = valid.nonzero().unbind(-1)
    number = valid.sum(-1)
    first = number.cumsum(0) - number
    after = torch.where(slot + 1 < number[row], slot + 1, 0)
    there = (after > 0) | (curves.closed.cpu() & (number > 2))[row]
    real = "<f8" if curves.x.dtype == torch.float64 else "<f4"
    vertices = np.empty(len(row), dtype=[("x", real), ("y", real), ("z", real), ("curve", "<i4")])
    x = curves.x.detach().cpu()[valid].numpy()
    for i, axis in enumerate("xyz"):
        vertices[axis] = x[:, i]
    vertices["curve"] = row.numpy()
    edges = np.empty(int(there.sum()), dtype=[("vertex1", "<i4"), ("vertex2", "<i4")])
    edges["vertex1"] = (first[row] + slot)[there].numpy()
    edges["vertex2"] = (first[row] + after)[there].numpy()
    word = "double" if real == "<f8" else "float"
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {word} {axis}" for axis in "xyz"] + ["property int curve", f"element edge {len(edges)}"]
    header += ["property int vertex1", "property int vertex2", "end_header"]
    with whole_file(path) as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(vertices.tobytes())
        file.write(edges.tobytes())


def write_curves_json(splines: Sequence[Spline], path: str | Path) -> None:
    """Write cubic B-splines as JSON: of each its degree, knots and control points, as NURBS programs and SciPy take them.

    The control points of a closed spline end with its first three once more: its ends then meet smoothly.

    Args:
        splines: Splines, one each, with control points (k, 3).
        path: File to write; its folder must be there.

    Raises:
        ValueError: Wrong shape.
        OSError: The file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> control = torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 0.0], [3.0, 2.0, 0.0], [4.0, 0.0, 0.0]])
        >>> torchsfm.formats.write_curves_json([torchsfm.geometry.Spline(control, closed=False)], "curves.json")
    """
    records = []
    for spline in splines:
        check_tensors(control=(spline.control, "k>=4 d"))
        control = torch.cat((spline.control, spline.control[:3])) if spline.closed else spline.control
        records.append(
            {"closed": spline.closed, "degree": 3, "knots": spline.knots().tolist(), "control_points": control.tolist()}
        )
    with whole_file(path) as file:
        file.write(json.dumps({"curves": records}, allow_nan=False).encode())
