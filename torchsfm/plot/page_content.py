"""What the interactive page holds of a model: everything its scripts need to draw it and to answer questions about it."""

import base64
import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsfm._types import Status
from torchsfm.plot.framing import Framing, frame
from torchsfm.plot.strokes import model_strokes
from torchsfm.reconstruction.mapping.calibration import Calibration
from torchsfm.reconstruction.matching.view_graph import Verdict
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.report import Report


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


def model_content(model: Reconstruction, number: int, report: Report | None, count: int) -> dict[str, Any]:
    """Everything the scripts need to draw model `number` of `count`."""
    model = model.to("cpu", torch.float64)
    # A camera with numbers that are not finite cannot be drawn.
    sound = [getattr(model.poses, name).flatten(1).isfinite().all(-1) for name in ("R", "t")]
    K_sound = model.cameras.K.flatten(1).isfinite().all(-1)[model.camera_index]
    model = replace(model, registered=model.registered & sound[0] & sound[1] & K_sound)
    found = report.calibrations[number] if report is not None and number < len(report.calibrations) else None
    framing = frame(model)
    apart = (model.projections() - model.x).nan_to_num()
    residuals, errors = apart.norm(dim=-1), model.point_errors().nan_to_num()
    tracks = model.track_lengths()
    good = torch.isfinite(model.X).all(-1)
    # Observations by point, those of dropped points left out.
    order = model.point.sort(stable=True).indices
    order = order[good[model.point[order]]]
    place = (model.x + 0.5) / model.image_size[model.view].clamp(min=1)
    large = len(model.names) > 65535
    index_type = np.uint32 if large else np.uint16
    X = model.X[good] @ framing.R.mT
    shown = tracks[good]
    low = int(shown.min()) if len(shown) else 2
    counts = torch.bincount(model.view, minlength=len(model.names)).tolist()
    by_view = np.split(model.view.sort(stable=True).indices.numpy(), np.cumsum(counts)[:-1])
    entries = [
        _image(model, i, framing, own := torch.from_numpy(by_view[i]), residuals[own], found)
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
    strokes = model_strokes(model)
    summary += [stroke.summary for stroke in strokes.values()]
    ends = torch.cat([model.X.new_zeros(0, 2, 3), *(stroke.ends for stroke in strokes.values())])
    shades = torch.cat([model.X.new_zeros(0, 3), *(stroke.color for stroke in strokes.values())])
    doubtful = sum(bool(entry.get("doubtful")) for entry in entries)
    if doubtful:
        summary.append(f"{doubtful} doubtful image{'s' if doubtful > 1 else ''}, drawn in red")
    if found is not None and found.status != Status.OK:
        summary.append(f"the last adjustment did not converge in {found.iterations} steps")
    return {
        "label": f"{number + 1} of {count}: {model.num_registered} images",
        "summary": "\n".join(summary),
        "positions": _pack(X - framing.centre, np.float32),
        "colors": _pack((model.color[good].clamp(0, 1) * 255).round(), np.uint8),
        "tracks": _pack(shown, index_type),
        "errors": _pack(errors[good], np.float32),
        "views": _pack(model.view[order], index_type),
        "places": _pack((place[order].nan_to_num().clamp(0, 1) * 65535).round(), np.uint16),
        "residuals": _pack(apart[order].clamp(-6e4, 6e4), np.float16),
        "lineEnds": _pack(ends @ framing.R.mT - framing.centre, np.float32),
        "lineColors": _pack((shades.clamp(0, 1) * 255).round(), np.uint8),
        "lineCounts": {kind: len(stroke.ends) for kind, stroke in strokes.items()},
        "large": large,
        "images": entries,
        "radius": framing.radius,
        "viewFrom": _numbers(framing.direction),
        "axes": [_numbers(column) for column in framing.R.mT],
        "origin": _numbers(-framing.centre),
        "frustum": _frustum_size(model, framing.radius),
        "trackRange": [low, max(low + 1, int(_quantile(shown, 0.98)))],
        "errorRange": [0, float(f"{max(_quantile(errors[good], 0.95), 1e-3):.3g}")],
    }


def pairs_content(report: Report) -> dict[str, Any]:
    """Which pairs of images were compared, and what came out."""
    table, names = report.pairs, report.compared_names()
    if len(table.pairs) and int(table.pairs.max()) >= len(names):
        raise ValueError(f"report.pairs: there is no image {int(table.pairs.max())} among the {len(names)} that could be read")
    inliers = torch.maximum(table.fundamental_inliers, table.homography_inliers)
    return {
        "names": names,
        "verdicts": [verdict.name.lower() for verdict in Verdict],
        "pairs": _pack(table.pairs, np.uint32),
        "matches": _pack(table.num_matches, np.uint32),
        "inliers": _pack(inliers, np.uint32),
        "verdict": _pack(table.verdict, np.uint8),
    }


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
    model: Reconstruction, i: int, framing: Framing, own: Tensor, residuals: Tensor, found: Calibration | None
) -> dict[str, Any]:
    """One row of the table, and the camera if there is one; `own` are the image's observations."""
    entry: dict[str, Any] = {
        "name": model.names[i],
        "pose": None,
        "points": len(residuals),
        "mean": float(f"{float(residuals.mean()):.4g}") if len(residuals) else 0,
        "high": float(f"{_quantile(residuals, 0.95):.4g}"),
        "size": model.image_size[i].tolist(),
    }
    if not bool(model.registered[i]):
        return entry
    camera, pose = model.cameras[model.camera_index[i]], model.poses[i]
    # Centre, then the camera's axes (right, down, forward) in the picture's world.
    centre = framing.R @ pose.centre - framing.centre
    entry["pose"] = _numbers(torch.cat((centre, (pose.R @ framing.R.mT).reshape(-1))))
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
    return entry
