"""Curves for other programs: PLY and OBJ with edges between samples, JSON with splines, SVG drawings of images."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from torchsfm._types import check_options
from torchsfm.formats.drawing import draw_curves, draw_model_curves
from torchsfm.geometry import Curve
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.curves import Curves
from torchsfm.reconstruction.model.files import whole_file
from torchsfm.reconstruction.model.reconstruction import Reconstruction


@on_the_cpu
def write_curves(curves: Curves | Reconstruction | Curve, path: str | Path, *, image: str | int | None = None) -> None:
    """Write curves in space, or those of an image, in the format that the name ends with.

    `.ply` (binary) has the samples as coloured vertices, in order, and edges from each to the next: MeshLab, Blender and Open3D
    show them as lines, programs that know only points show the samples. A property `curve` of the vertices says which curve it
    is. `.obj` has coloured vertices and a line element `l` for each curve. `.json` has cubic B-splines, of each its degree,
    knots and control points, as NURBS programs and SciPy take them; samples are no farther from them than half of the samples
    are known to be, where they are dense enough to tell. The control points of a closed spline end with its first three once
    more: its ends then meet smoothly. `.svg` is a drawing, in the pixels of an image: of curves of an image, or of those in
    space where an image of the model would show them, whatever may hide them.

    Args:
        curves: Curves in space or a model with some; for a drawing a model with some, or curves of an image.
        path: File to write; its folder must be there.
        image: The image of the model, by its name or number, that a drawing is of.

    Raises:
        ValueError: The model has no curves, or the name ends otherwise, or there is no such image.
        OSError: The file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> scene = torchsfm.render_sequence(views=3, width=96, height=72, generator=torch.Generator().manual_seed(0))
        >>> found = torchsfm.reconstruction.reconstruct_curves(scene.images, scene.cameras, scene.poses, points=scene.X)
        >>> torchsfm.write_curves(found, "curves.ply")
        >>> len(torchsfm.read_ply("curves.ply").X) == len(found.X)
        True
    """
    path = Path(path)
    check_options(curves=(curves, Curves | Reconstruction | Curve))
    some = curves.curves if isinstance(curves, Reconstruction) else curves
    if some is None:
        raise ValueError("curves: wanted curves or a model with some, got a model in which none were looked for")
    writers = {".ply": _ply, ".obj": _obj, ".json": _json}
    if path.suffix not in (*writers, ".svg"):
        raise ValueError(f"path: wanted a name that ends with one of {', '.join(writers)}, .svg, got {path.name!r}")
    if (image is not None) != (path.suffix == ".svg" and isinstance(curves, Reconstruction)):
        raise ValueError(f"image: wanted one for a drawing of a model's curves, and for nothing else, got {image!r}")
    if isinstance(some, Curve):
        if path.suffix != ".svg":
            raise ValueError(f"path: wanted a name that ends with .svg for curves of an image, got {path.name!r}")
        content = draw_curves(some).encode()
    elif path.suffix == ".svg":
        if not isinstance(curves, Reconstruction) or image is None:
            raise ValueError("curves: wanted a model with cameras, or curves of an image, for a drawing")
        content = draw_model_curves(replace(curves, curves=_sound(some)), image).encode()
    else:
        content = writers[path.suffix](_sound(some))
    with whole_file(path) as file:
        file.write(content)


def _sound(curves: Curves) -> Curves:
    """The curves of which every sample is a point."""
    some = curves.detached()
    return some.select(torch.ones_like(some.closed).index_fill(0, some.curve[~some.X.isfinite().all(-1)], value=False))


def _ply(curves: Curves) -> bytes:
    real = "<f8" if curves.X.element_size() == 8 else "<f4"
    columns = [(axis, real) for axis in "xyz"] + [("curve", "<i4")] + [(name, "u1") for name in ("red", "green", "blue")]
    vertices = np.empty(len(curves.X), dtype=columns)
    levels = (curves.color.nan_to_num(0).clamp(0, 1) * 255).round().numpy()
    for i, (axis, channel) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        vertices[axis], vertices[channel] = curves.X[:, i].numpy(), levels[:, i]
    vertices["curve"] = curves.curve.numpy()
    edges = curves.links().numpy().astype("<i4")
    word = "double" if real == "<f8" else "float"
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {word} {axis}" for axis in "xyz"] + ["property int curve"]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")] + [f"element edge {len(edges)}"]
    header += ["property int vertex1", "property int vertex2", "end_header"]
    return ("\n".join(header) + "\n").encode("ascii") + vertices.tobytes() + edges.tobytes()


def _obj(curves: Curves) -> bytes:
    rows = ["# curves of a model: vertices with colours, and a line element for each curve"]
    for x, shade in zip(curves.X.tolist(), curves.color.nan_to_num(0).clamp(0, 1).tolist(), strict=True):
        rows.append("v " + " ".join(map(repr, [*x, *(round(c, 4) for c in shade)])))
    first = 1
    for number, closed in zip(curves.number.tolist(), curves.closed.tolist(), strict=True):
        slots = list(range(first, first + number)) + ([first] if closed and number > 2 else [])
        rows.append("l " + " ".join(map(str, slots)))
        first += number
    return ("\n".join(rows) + "\n").encode("ascii")


def _json(curves: Curves) -> bytes:
    known = curves.sigma[curves.sigma.isfinite() & (curves.sigma > 0)]
    records = []
    for spline in curves.splines(float(known.median()) if len(known) else 1.0):
        control = spline.control.tolist()
        control += control[:3] if spline.closed else []
        records.append({"closed": spline.closed, "degree": 3, "knots": spline.knots().tolist(), "control_points": control})
    return json.dumps({"curves": records}, allow_nan=False).encode()
