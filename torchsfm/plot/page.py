"""The interactive page: one HTML file with the model inside, to be turned with the mouse, without network or server."""

import base64
import html
import json
import math
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Curve
from torchsfm.images import MAX_PIXELS, read_image, save_image
from torchsfm.plot.framing import frame
from torchsfm.reconstruction.calibration import Calibration
from torchsfm.reconstruction.files import whole_file
from torchsfm.reconstruction.reconstruction import Reconstruction
from torchsfm.reconstruction.report import Report

_CURVES = torch.tensor([0.95, 0.55, 0.15])
"""Red, green and blue of curves."""


def write_page(
    reconstruction: Reconstruction | Sequence[Reconstruction],
    path: str | Path,
    *,
    title: str = "Reconstruction",
    report: Report | None = None,
    images: str | Path | None = None,
    curves: Curve | None = None,
    thumbnail: int = 320,
    max_pixels: int = MAX_PIXELS,
) -> Path:
    """Write a self-contained interactive page of one model or of several.

    It shows the coloured points, lines if there are any, and the cameras, upright; hovering names an image or tells a point's
    track; clicking a camera looks through it; points can be coloured and filtered by track length and
    error; a table lists every image. It needs a browser with WebGL 2 and nothing else. Points, lines and cameras are stored as
    32-bit floats.

    Args:
        reconstruction: The model, or models to choose from, the most interesting first.
        path: The HTML file to write. Its folder is made if need be.
        title: Heading of the page.
        report: Tells why images were not registered, and of files that could not be read.
        images: Folder with the photographs under their names. If given, small copies are put into the page, to be shown at
            the cameras; photographs that cannot be read are left out.
        curves: Curves in space (c, n) to draw with the first model.
        thumbnail: Longer side of these copies in pixels.
        max_pixels: Photographs that have more are left out too.

    Returns:
        The path written.

    Raises:
        ValueError: No model was given.
        OSError: The file cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> torchsfm.write_page(torchsfm.read_model("model.npz"), "model.html").name
        'model.html'
    """
    models = [reconstruction] if isinstance(reconstruction, Reconstruction) else list(reconstruction)
    if not models:
        raise ValueError("reconstruction: wanted at least one model, got none")
    if thumbnail < 1:
        raise ValueError(f"thumbnail: wanted a size in pixels, got {thumbnail}")
    photos: dict[str, str | None] = {}
    if images is not None:
        names = {name for model in models for name in model.names}
        photos = {name: _thumbnail(Path(images) / name, thumbnail, max_pixels) for name in sorted(names)}
    content = {
        "title": title,
        "models": [
            _model(model, number, report, photos, len(models), None if number else curves)
            for number, model in enumerate(models)
        ],
    }
    # Inside a script element only "<" could end the data early.
    text = json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    folder = files("torchsfm.plot")
    template = Template((folder / "page.html").read_text(encoding="utf-8"))
    script = (folder / "page.js").read_text(encoding="utf-8")
    page = template.substitute(title=html.escape(title), data=text, script=script)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as file:
        # A file name that is not UTF-8 has no characters of its own.
        file.write(page.encode("utf-8", "backslashreplace"))
    return path


def _pack(tensor: Tensor, dtype: type[np.generic]) -> str:
    array = tensor.detach().cpu().numpy().astype(np.dtype(dtype).newbyteorder("<"))
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _numbers(tensor: Tensor) -> list[float]:
    return [float(f"{value:.7g}") for value in tensor.detach().reshape(-1).tolist()]


def _quantile(values: Tensor, q: float) -> float:
    """A quantile of any number of values; 0 of none."""
    if not len(values):
        return 0.0
    ordered = values.to(torch.float64).sort().values
    return float(ordered[min(len(ordered) - 1, int(q * len(ordered)))])


def _model(
    model: Reconstruction,
    number: int,
    report: Report | None,
    photos: dict[str, str | None],
    count: int,
    curves: Curve | None,
) -> dict[str, Any]:
    """Everything the script needs to draw one model."""
    model = model.to("cpu", torch.float64)
    # A camera with numbers that are not finite cannot be drawn.
    sound = [getattr(model.poses, name).flatten(1).isfinite().all(-1) for name in ("R", "t")]
    K_sound = model.cameras.K.flatten(1).isfinite().all(-1)[model.camera_index]
    model = replace(model, registered=model.registered & sound[0] & sound[1] & K_sound)
    found = report.calibrations[number] if report is not None and number < len(report.calibrations) else None
    framing = frame(model)
    residuals, errors = model.residuals().nan_to_num(), model.point_errors().nan_to_num()
    tracks = model.track_lengths()
    good = torch.isfinite(model.X).all(-1)
    # Observations by point, those of dropped points left out.
    order = model.point.sort(stable=True).indices
    views = model.view[order][good[model.point[order]]]
    large = len(model.names) > 65535
    index_type = np.uint32 if large else np.uint16
    X = model.X[good] @ framing.R.mT
    shown = tracks[good]
    low = int(shown.min()) if len(shown) else 2
    counts = torch.bincount(model.view, minlength=len(model.names)).tolist()
    by_view = np.split(model.view.sort(stable=True).indices.numpy(), np.cumsum(counts)[:-1])
    entries = [
        _image(model, i, framing.R, own := torch.from_numpy(by_view[i]), residuals[own], photos.get(name), found)
        | (_standing(name, report) if bool(model.registered[i]) else {"status": _status(name, number, report)})
        for i, name in enumerate(model.names)
    ]
    if report is not None and number == 0:
        known = set(model.names)
        entries += [
            {"name": image.name, "pose": None, "points": 0, "mean": 0, "high": 0, "status": image.reason or "not used"}
            for image in report.images
            if image.name not in known
        ]
    summary = [f"{model.num_registered} of {len(entries)} images, {int(good.sum()):,} points"]
    if len(residuals):
        track = model.num_observations / max(model.num_points, 1)
        summary.append(f"{model.num_observations:,} observations, mean track {track:.1f}")
        summary.append(f"residuals: mean {float(residuals.mean()):.3g}, median {_quantile(residuals, 0.5):.3g} px")
    line_ends, line_color = model.X.new_zeros(0, 2, 3), model.X.new_zeros(0, 3)
    if model.lines is not None:
        drawn = model.lines.ends.isfinite().flatten(1).all(-1)
        line_ends, line_color = model.lines.ends[drawn], model.lines.color[drawn]
        views_of_line, apart = model.lines.support().double(), model.line_residuals().nan_to_num()
        summary.append(
            f"{len(line_ends):,} lines"
            + (
                f", in {float(views_of_line.mean()):.1f} images, mean error {float(apart.mean()):.3g} px"
                if len(line_ends)
                else ""
            )
        )
    if model.conics is not None:
        conics = model.conics.select(model.conics.axes.isfinite().flatten(1).all(-1) & model.conics.centre.isfinite().all(-1))
        chords = conics.chords()
        shades = conics.color.repeat_interleave(len(chords) // max(len(conics), 1), 0)
        line_ends, line_color = torch.cat((line_ends, chords)), torch.cat((line_color, shades))
        summary.append(
            f"{len(conics):,} ellipses"
            + (f", in {float(conics.support().double().mean()):.1f} images" if len(conics) else "")
            + (f", mean error {float(model.conic_residuals().nan_to_num().mean()):.3g} px" if len(model.conics.x) else "")
        )
    if curves is not None:
        segments = _segments(curves).to(line_ends)
        line_ends, line_color = (
            torch.cat((line_ends, segments)),
            torch.cat((line_color, _CURVES.to(segments).expand(len(segments), 3))),
        )
        summary.append(f"{len(curves.x):,} curves")
    if found is not None and found.status != Status.OK:
        summary.append(f"the last adjustment did not converge in {found.iterations} steps")
    return {
        "label": f"{number + 1} of {count}: {model.num_registered} images",
        "summary": "\n".join(summary),
        "positions": _pack(X - framing.centre, np.float32),
        "colors": _pack((model.color[good].clamp(0, 1) * 255).round(), np.uint8),
        "tracks": _pack(shown, index_type),
        "errors": _pack(errors[good], np.float32),
        "views": _pack(views, index_type),
        "lineEnds": _pack(line_ends @ framing.R.mT - framing.centre, np.float32),
        "lineColors": _pack((line_color.clamp(0, 1) * 255).round(), np.uint8),
        "large": large,
        "images": [
            entry | ({"pose": _numbers(_moved(entry["pose"], framing.centre))} if entry["pose"] is not None else {})
            for entry in entries
        ],
        "radius": framing.radius,
        "viewFrom": _numbers(framing.direction),
        "frustum": _frustum_size(model, framing.radius),
        "trackRange": [low, max(low + 1, int(_quantile(shown, 0.98)))],
        "errorRange": [0, float(f"{max(_quantile(errors[good], 0.95), 1e-3):.3g}")],
    }


def _segments(curves: Curve) -> Float[Tensor, "s 2 3"]:
    """From each sample of curves to the next."""
    x, valid, number = curves.x.detach().cpu(), curves.valid.cpu(), curves.number.cpu()
    after = (torch.arange(x.shape[-2]) + 1) % number[:, None].clamp(min=1)
    there = valid & ((after > 0) | curves.closed.cpu()[:, None])
    following = x.gather(1, torch.where(valid, after, 0)[..., None].expand_as(x))
    return torch.stack((x[there], following[there]), 1)


def _moved(pose: Tensor, centre: Tensor) -> Tensor:
    return torch.cat((pose[:3] - centre, pose[3:]))


def _frustum_size(model: Reconstruction, radius: float) -> float:
    """Length of the drawn cameras: a part of the typical distance between neighbours, bounded by the size of the scene."""
    centres = model.poses.centre[model.registered]
    size = 0.12 * radius
    if len(centres) > 1:
        sample = centres[:: max(1, len(centres) // 500)]
        gaps = torch.cdist(sample, centres)
        nearest = torch.where(gaps > 0, gaps, math.inf).amin(1)
        typical = _quantile(nearest[torch.isfinite(nearest)], 0.5)
        size = min(size, max(0.7 * typical, 0.015 * radius))
    return float(f"{size:.6g}")


def _status(name: str, number: int, report: Report | None) -> str:
    """Why an image has no pose in this model."""
    for image in report.images if report is not None else ():
        if image.name == name:
            if image.model is None:
                return image.reason or "not registered"
            if image.model != number:
                return f"in model {image.model + 1}"
    return "not registered"


def _standing(name: str, report: Report | None) -> dict[str, Any]:
    """How well a registered image is placed, in words, and whether that is doubtful."""
    image = next((image for image in report.images if image.name == name), None) if report is not None else None
    if image is None:
        return {}
    known = math.isfinite(image.rotation_sigma) and math.isfinite(image.position_sigma)
    text = f"rotation ± {image.rotation_sigma:.2g}°, place ± {100 * image.position_sigma:.2g} % of the distance to the points"
    lines = ([text] if known else []) + ([f"doubtful: {image.doubt}"] if image.doubt else [])
    return {"standing": "\n".join(lines), "doubtful": bool(image.doubt)}


def _image(
    model: Reconstruction, i: int, R: Tensor, own: Tensor, residuals: Tensor, photo: str | None, found: Calibration | None
) -> dict[str, Any]:
    """One row of the table, and the camera if there is one; `own` are the image's observations."""
    entry: dict[str, Any] = {
        "name": model.names[i],
        "pose": None,
        "points": len(residuals),
        "mean": float(f"{float(residuals.mean()):.4g}") if len(residuals) else 0,
        "high": float(f"{_quantile(residuals, 0.95):.4g}"),
    }
    if not bool(model.registered[i]):
        return entry
    camera, pose = model.cameras[model.camera_index[i]], model.poses[i]
    # Centre, then the camera's axes (right, down, forward) in the picture's world.
    entry["pose"] = torch.cat((R @ pose.centre, (pose.R @ R.mT).reshape(-1)))
    width, height = model.image_size[i].tolist()
    corner = torch.tensor(
        [[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]], dtype=torch.float64
    )
    d, valid = camera.unproject(corner)
    plain = torch.linalg.solve_ex(camera.K, torch.cat((corner, torch.ones(4, 1, dtype=corner.dtype)), -1).mT)[0].mT
    usable = bool((valid & (d[:, 2] > 0.2)).all())
    rays = (d / d[:, 2:] if usable else plain)[:, :2].clamp(-4, 4)
    depth = pose.transform(model.X[model.point[own]])[:, 2]
    entry["corners"] = [_numbers(row) for row in rays]
    entry["depth"] = float(f"{_quantile(depth[depth > 0], 0.5) or 1.0:.6g}")
    entry["focal"] = float(f"{float(camera.K[0, 0]):.6g}")
    if found is not None:
        index = int(model.camera_index[i])
        sigma = float(found.deviation[index, 0])
        entry["focalDeviation"] = float(f"{sigma:.3g}") if math.isfinite(sigma) else 0
        entry["doubts"] = found.camera_doubts(index)
    if photo is not None:
        entry["photo"] = photo
    return entry


def _thumbnail(path: Path, size: int, max_pixels: int) -> str | None:
    """A small JPEG of a photograph as a data address; None where it cannot be read."""
    try:
        pixels = read_image(path, max_size=size, max_pixels=max_pixels).pixels
    except (OSError, ValueError):
        return None
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "thumbnail.jpg"
        save_image(file, pixels, quality=80)
        return "data:image/jpeg;base64," + base64.b64encode(file.read_bytes()).decode("ascii")
