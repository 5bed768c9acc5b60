"""The report of a reconstruction as plain data for programs, and as a page of text for people."""

import html
import math
import re
from itertools import zip_longest
from typing import Any

import torch

from torchsfm._types import Status
from torchsfm.geometry import DISTORTION_MODELS
from torchsfm.reconstruction.mapping.calibration import Calibration
from torchsfm.reconstruction.matching.view_graph import Verdict
from torchsfm.reconstruction.messages import printable
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.report import STILL, SfmResult

Record = dict[str, Any]

VERDICTS = {
    Verdict.UNRELATED: "unrelated",
    Verdict.GENERAL: "general",
    Verdict.PLANAR: "planar",
    Verdict.ROTATION: "pure rotation",
}


def report_record(result: SfmResult, **more: Any) -> Record:
    """Everything the report knows as dicts, lists, strings and numbers, ready for JSON.

    Args:
        result: What `reconstruct` returned.
        **more: Further entries, such as the options of the run; `truth` is a dict that `report_markdown` shows as a table.

    Returns:
        `models`, `images`, `pairs`, `seconds`, `method`, `focal_source`, `autocalibration`, `still_matches`, `skipped` and the
        further entries.
    """
    report = result.report
    observed: dict[str, tuple[int, float]] = {}
    for model in reversed(result.models):
        counts = torch.bincount(model.view, minlength=len(model.names)).tolist()
        for i in model.registered.nonzero()[:, 0].tolist():
            observed[model.names[i]] = (counts[i], float(model.view_errors()[i]))
    images = []
    for image in report.images:
        count, error = observed.get(image.name, (0, 0.0)) if image.model is not None else (0, 0.0)
        entry = {"name": image.name, "registered": image.model is not None, "model": image.model, "reason": image.reason}
        images.append(entry | {"features": image.features, "observations": count, "mean_error_px": error})
        images[-1] |= {"doubt": image.doubt, "rotation_sigma_deg": _finite(image.rotation_sigma)}
        images[-1] |= {"position_sigma": _finite(image.position_sigma)}
    names = report.compared_names()
    table = report.pairs
    columns = (table.pairs, table.num_matches, table.fundamental_inliers, table.homography_inliers, table.verdict)
    pairs = [
        {
            "images": [names[i], names[j]],
            "matches": matches,
            "fundamental_inliers": num_F,
            "homography_inliers": num_H,
            "verdict": VERDICTS[Verdict(verdict)],
        }
        for (i, j), matches, num_F, num_H, verdict in zip(*(column.tolist() for column in columns), strict=True)
    ]
    return {
        "models": [_model_record(model, found) for model, found in zip_longest(result.models, report.calibrations)],
        "images": images,
        "pairs": pairs,
        "seconds": {stage: round(value, 3) for stage, value in report.seconds.items()},
        "method": report.method,
        "focal_source": list(report.focal_source),
        "autocalibration": list(report.autocalibration),
        "still_matches": report.still,
        "skipped": [{"name": name, "reason": reason} for name, reason in report.skipped],
        **more,
    }


def report_markdown(record: Record) -> str:
    """The record as a markdown page: models, cameras, images, pairs, and where the time went."""
    lines = ["# Reconstruction", ""]
    lines += _models_text(record)
    if texts := record.get("autocalibration"):
        lines += ["## Autocalibration", "", *(f"- {_escape(text)}" for text in texts), ""]
    if truth := record.get("truth"):
        lines += ["## Against the truth", "", *_table(["", ""], [[key, value] for key, value in truth.items()]), ""]
    lines += ["## Images", ""]
    rows = [
        [
            image["name"],
            "yes" if image["registered"] else "no",
            "" if image["model"] is None else image["model"],
            image["features"],
            image["observations"],
            f"{image['mean_error_px']:.3f}" if image["registered"] else "",
            *(_deviation(image, key, factor) for key, factor in (("rotation_sigma_deg", 1.0), ("position_sigma", 100.0))),
            f"doubtful: {image['doubt']}" if image["doubt"] else image["reason"],
        ]
        for image in record["images"]
    ]
    header = ["image", "registered", "model", "features", "observations", "mean error, px"]
    lines += _table([*header, "rotation ±, deg", "place ±, % of depth", "reason"], rows)
    if skipped := record.get("skipped"):
        lines += ["", "Not read:", "", *_table(["name", "reason"], [[entry["name"], entry["reason"]] for entry in skipped])]
    related = [pair for pair in record["pairs"] if pair["verdict"] != "unrelated"]
    lines += ["", "## Pairs", ""]
    lines += [f"{len(record['pairs'])} pairs were compared, {len(record['pairs']) - len(related)} have too little in common."]
    if still := record.get("still_matches"):
        lines += [f"{still} matches were left out: {STILL}."]
    lines += ["Matches, and how many of them one fundamental matrix and one homography explain:", ""]
    lines += _table(
        ["image", "image", "matches", "F", "H", "verdict"],
        [
            [*pair["images"], pair["matches"], pair["fundamental_inliers"], pair["homography_inliers"], pair["verdict"]]
            for pair in related
        ],
    )
    lines += ["", "## Time and memory", ""]
    seconds = record["seconds"]
    lines += _table(["stage", "seconds"], [[stage, f"{value:.2f}"] for stage, value in seconds.items()])
    lines += ["", f"{sum(seconds.values()):.1f} seconds in all."]
    if memory := record.get("peak_memory_mb"):
        lines += [f"The process held {memory:.0f} MB at most."]
    return "\n".join(lines) + "\n"


def _finite(value: float) -> float | None:
    """JSON has no infinity."""
    return value if math.isfinite(value) else None


def _deviation(image: Record, key: str, factor: float) -> str:
    if not image["registered"]:
        return ""
    return "unknown" if image[key] is None else f"{factor * image[key]:.3g}"


def _model_record(model: Reconstruction, found: Calibration | None) -> Record:
    cameras: list[Record] = []
    kind = next(name for name, cls in DISTORTION_MODELS.items() if type(model.cameras.distortion) is cls)
    for index in torch.unique(model.camera_index[model.registered]).tolist():
        camera = model.cameras[index]
        K = camera.K.tolist()
        names = camera.distortion.parameter_names
        cameras.append(
            {
                "model": kind,
                "images": int((model.registered & (model.camera_index == index)).sum()),
                "focal": [K[0][0], K[1][1]],
                "principal_point": [K[0][2], K[1][2]],
                "distortion": dict(zip(names, camera.distortion.parameters().tolist(), strict=True)),
            }
        )
        if found is not None:
            sigma, estimated = found.deviation[index].tolist(), found.estimated[index].tolist()
            cameras[-1] |= {
                "deviation": {name: s if math.isfinite(s) else None for name, s in zip(found.names, sigma, strict=True)},
                "held": [name for name, free in zip(found.names, estimated, strict=True) if not free],
                "doubts": found.camera_doubts(index),
            }
    adjustment = {}
    if found is not None:
        adjustment = {
            "converged": found.status == Status.OK,
            "adjustment_steps": found.iterations,
            "noise_px": found.noise,
            "remark": found.remark,
        }
    return {
        "images": model.num_registered,
        "points": model.num_points,
        "observations": model.num_observations,
        "mean_track_length": model.num_observations / max(model.num_points, 1),
        "mean_error_px": float(model.residuals().mean()) if model.num_observations else 0.0,
        "cameras": cameras,
        **adjustment,
        **_lines_record(model),
        **_curves_record(model),
    }


def _lines_record(model: Reconstruction) -> Record:
    if model.lines is None:
        return {}
    support, apart = model.lines.support(), model.line_residuals()
    return {
        "lines": {
            "count": len(model.lines),
            "segments": len(model.lines.x),
            "mean_images": float(support.double().mean()) if len(support) else 0.0,
            "mean_error_px": float(apart.mean()) if len(apart) else 0.0,
        }
    }


def _curves_record(model: Reconstruction) -> Record:
    if model.curves is None:
        return {}
    support, apart = model.curves.support(), model.curve_residuals()
    return {
        "curves": {
            "count": len(model.curves),
            "samples": len(model.curves.X),
            "mean_images": float(support.double().mean()) if len(support) else 0.0,
            "mean_error_px": float(apart.mean()) if len(apart) else 0.0,
        }
    }


def _models_text(record: Record) -> list[str]:
    if not record["models"]:
        return [f"Nothing could be reconstructed: {_escape(record.get('failure', 'see the images below'))}.", ""]
    lines: list[str] = []
    total = len(record["images"])
    for number, model in enumerate(record["models"]):
        lines += [f"## Model {number}" if len(record["models"]) > 1 else "## Model", ""]
        rows = [
            ["images", f"{model['images']} of {total}"],
            ["points", f"{model['points']:,}"],
            ["observations", f"{model['observations']:,}"],
            ["mean track length", f"{model['mean_track_length']:.2f}"],
            ["mean reprojection error", f"{model['mean_error_px']:.3f} px"],
        ]
        if found := model.get("lines"):
            rows.append(["lines", f"{found['count']:,} of {found['segments']:,} segments"])
            rows.append(["images of a line, mean", f"{found['mean_images']:.2f}"])
            rows.append(["ends of segments off their lines, mean", f"{found['mean_error_px']:.3f} px"])
        if found := model.get("curves"):
            rows.append(["curves", f"{found['count']:,} of {found['samples']:,} samples"])
            rows.append(["images of a sample, mean", f"{found['mean_images']:.2f}"])
            rows.append(["samples off the edges, mean", f"{found['mean_error_px']:.3f} px"])
        if "converged" in model:
            ending = "converged" if model["converged"] else "did not converge"
            rows.append(["last adjustment", f"{ending} in {model['adjustment_steps']} steps"])
        if model.get("remark"):
            rows.append(["cameras", model["remark"]])
        for camera in model["cameras"]:
            rows.append([f"camera of {camera['images']} images ({camera['model']})", _camera_text(camera)])
        lines += [*_table(["", ""], rows), ""]
    return lines


MARKUP = re.compile(r"[\\`*~|$\[\]]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9])")
"""What markdown could take for more than a character; it does not so take underscores within words."""


def _escape(value: object) -> str:
    """Text that a markdown page shows as it is, in one line."""
    return MARKUP.sub(r"\\\g<0>", html.escape(printable(str(value)), quote=False))


def _camera_text(camera: Record) -> str:
    """The numbers of a camera, each with its standard deviation where it was estimated."""
    fx, fy = camera["focal"]
    cx, cy = camera["principal_point"]
    spread = camera.get("deviation", {})

    def number(name: str, value: float, digits: int) -> str:
        sigma = spread.get(name, 0.0)
        known = "" if sigma == 0 else " +- ?" if sigma is None else f" +- {sigma:.{digits}f}"
        return f"{value:.{digits}f}{known}" + (" (held)" if known and name in camera.get("held", []) else "")

    text = f"f = {number('focal', fx, 2)}" + ("" if abs(fx - fy) <= 1e-9 * fx else f", {fy:.2f}")
    text += f", c = ({number('cx', cx, 2)}, {number('cy', cy, 2)}) px"
    text += "".join(f", {name} = {number(name, value, 5)}" for name, value in camera["distortion"].items())
    return "; ".join([text, *camera.get("doubts", [])])


def _table(header: list[str], rows: list[list[Any]]) -> list[str]:
    def line(cells: list[Any]) -> str:
        return "| " + " | ".join(map(_escape, cells)) + " |"

    return [line(header), "|" + "---|" * len(header), *map(line, rows)]
