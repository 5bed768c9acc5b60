"""Is a reconstruction right, or does it say where it may not be? On scenes that mislead, beside COLMAP on the same photographs.

    python -m bench.doubt [--scenes 0:60] [--workers 4] [--keep FOLDER] [--out FILE] [--no-colmap]

prints a markdown table, one line a scene, in the order in which they end. Nothing is needed but the packages; without pycolmap
its columns stay empty. With --keep the photographs, features and matches stay in a folder and later runs begin at mapping.

An error is the angle by which a camera is turned or displaced (seen from what it looks at) after the common similarity on which
most cameras agree. Off is more than 5 degrees. A camera is silently off if it is off and not reported as doubtful, and lost if
COLMAP places it rightly and this library in no model.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench.doubt_scenes import Misleading, misleading
from torchsfm.geometry import Pose
from torchsfm.images.reading import save_image
from torchsfm.linalg import nearest_rotation
from torchsfm.reconstruction import reconstruct

OFF = 5.0
"""Degrees beyond which a camera is in a wrong place."""
Result = dict[str, Any]


def camera_errors(poses: Pose, truth: Pose, registered: Tensor, reach: float) -> Tensor:
    """How far each camera is off in degrees; infinite where it is not registered."""
    turn = truth.R.mT @ poses.R
    # Each camera proposes how the worlds lie to each other; the proposal most cameras agree to counts.
    off = _angle(turn[:, None] @ turn.mT[None]).rad2deg()
    off = torch.where(registered[:, None] & registered[None], off, torch.inf)
    votes = (off <= OFF).sum(-1)
    agree = off[int(votes.argmax())] <= OFF
    R = nearest_rotation(turn[agree].sum(0)) if bool(agree.any()) else torch.eye(3, dtype=turn.dtype)
    rotation = _angle(R.mT @ turn).rad2deg()
    # Places: scale and shift by pairs of cameras, again the proposal most agree to.
    placed, c = poses.centre @ R.mT, truth.centre
    apart = (placed[:, None] - placed).square().sum(-1)
    scale = ((placed[:, None] - placed) * (c[:, None] - c)).sum(-1) / apart.clamp(min=1e-30)
    shift = c[:, None] - scale[..., None] * placed[:, None]
    away = (scale[..., None, None] * placed + shift[..., None, :] - c).norm(dim=-1)
    angle = torch.atan(away / reach).rad2deg()
    both = (agree[:, None] & agree & (apart > 0))[..., None] & agree & (angle <= OFF)
    score = torch.where(both, OFF - angle, 0.0).sum(-1)
    angle = angle[divmod(int(score.argmax()), len(c))] if bool((score > 0).any()) else torch.zeros_like(rotation)
    return torch.where(registered, torch.maximum(rotation, angle), torch.inf)


def _angle(R: Tensor) -> Tensor:
    return torch.arccos(((R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))


def run_torchsfm(scene: Misleading, files: list[Path], folder: Path) -> Result:
    """Errors, models and doubts of this library."""
    start = time.perf_counter()
    result = reconstruct(files, out=folder, resume=True)
    error = torch.full((len(files),), torch.inf, dtype=torch.float64)
    for model in result.models:
        own = camera_errors(model.poses, scene.poses, model.registered, scene.reach)
        error = torch.where(model.registered, own, error)
    model_of = [-1 if image.model is None else image.model for image in result.report.images]
    focal = float(result.models[0].cameras.K[0, 0, 0]) / scene.focal if result.models else None
    return {
        "error": error.tolist(),
        "model": model_of,
        "doubt": [getattr(image, "doubt", "") for image in result.report.images],
        "reason": [image.reason for image in result.report.images],
        "focal": focal,
        "seconds": time.perf_counter() - start,
    }


def run_colmap(scene: Misleading, files: list[Path]) -> Result | None:
    """Errors of COLMAP's largest model, with its default settings and one camera for all; None where it is not installed."""
    try:
        import pycolmap
    except ImportError:
        return None
    start = time.perf_counter()
    pycolmap.set_random_seed(0)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    extraction = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    matching = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
    mapping = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=0)
    device = pycolmap.Device.cpu
    names = [path.name for path in files]
    with tempfile.TemporaryDirectory() as scratch:
        database = Path(scratch) / "database.db"
        pycolmap.extract_features(
            database, files[0].parent, names, pycolmap.CameraMode.SINGLE, extraction_options=extraction, device=device
        )
        pycolmap.match_exhaustive(database, matching_options=matching, device=device)
        models = pycolmap.incremental_mapping(database, files[0].parent, Path(scratch) / "models", mapping)
    registered = torch.zeros(len(files), dtype=torch.bool)
    matrix = torch.eye(3, 4, dtype=torch.float64).repeat(len(files), 1, 1)
    if models:
        best = max(models.values(), key=lambda m: m.num_reg_images())
        for image in best.images.values():
            if image.has_pose:
                i = names.index(image.name)
                matrix[i], registered[i] = torch.from_numpy(image.cam_from_world().matrix()), True
    error = camera_errors(Pose.from_matrix(matrix), scene.poses, registered, scene.reach)
    return {"error": error.tolist(), "seconds": time.perf_counter() - start}


def run_scene(number: int, keep: Path | None, colmap: bool) -> Result:
    """Render one scene and reconstruct it."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as scratch:
        folder = (keep or Path(scratch)) / f"scene-{number:03d}"
        saved = folder / "scene.pt"
        scene = Misleading(**torch.load(saved, weights_only=False)) if saved.exists() else misleading(number)
        files = [folder / "images" / f"{i:02d}.png" for i in range(len(scene.poses.t))]
        if not saved.exists():
            files[0].parent.mkdir(parents=True, exist_ok=True)
            for path, image in zip(files, scene.images, strict=True):
                save_image(path, image)
            torch.save({**scene.__dict__, "images": None}, saved)
        result = {"scene": number, "kind": scene.kind, "torchsfm": run_torchsfm(scene, files, folder), "colmap": None}
        stored = folder / "colmap.json"
        if colmap:
            if not stored.exists():
                stored.write_text(json.dumps(run_colmap(scene, files)))
            result["colmap"] = json.loads(stored.read_text())
    return result


HEADER = (
    "| scene | kind | images | registered | models | largest error, deg | off | doubtful | silently off | f / true f | s "
    "| COLMAP registered | largest error, deg | off | lost | s |"
)


def counts(result: Result) -> dict[str, int]:
    """What the table sums up over scenes."""
    ours, theirs = result["torchsfm"], result["colmap"]
    error = ours["error"]
    off = [OFF < e < float("inf") for e in error]
    doubtful = [bool(d) for d in ours["doubt"]]
    found = {
        "images": len(error),
        "registered": sum(e < float("inf") for e in error),
        "off": sum(off),
        "doubtful": sum(doubtful),
        "silent": sum(o and not d for o, d in zip(off, doubtful, strict=True)),
        "doubtful but right": sum(d and e <= OFF for d, e in zip(doubtful, error, strict=True)),
    }
    if theirs:
        found["colmap registered"] = sum(e < float("inf") for e in theirs["error"])
        found["colmap off"] = sum(OFF < e < float("inf") for e in theirs["error"])
        found["lost"] = sum(t <= OFF < e for t, e in zip(theirs["error"], error, strict=True))
        found["gained"] = sum(e <= OFF < t for t, e in zip(theirs["error"], error, strict=True))
    return found


def row(result: Result) -> str:
    """One line of the table."""
    ours, theirs, found = result["torchsfm"], result["colmap"], counts(result)

    def largest(error: list[float]) -> str:
        known = [e for e in error if e < float("inf")]
        return f"{max(known):.1f}" if known else ""

    cells = [
        result["scene"], result["kind"], found["images"], found["registered"], max(ours["model"]) + 1, largest(ours["error"]),
        found["off"], found["doubtful"], found["silent"], "" if ours["focal"] is None else f"{ours['focal']:.3f}",
        f"{ours['seconds']:.0f}",
    ]  # fmt: skip
    if theirs:
        cells += [
            found["colmap registered"], largest(theirs["error"]), found["colmap off"], found["lost"], f"{theirs['seconds']:.0f}"
        ]  # fmt: skip
    else:
        cells += [""] * 5
    return "| " + " | ".join(map(str, cells)) + " |"


def run_apart(number: int, options: argparse.Namespace) -> Result:
    """Run one scene in a process of its own on one thread."""
    command = [sys.executable, "-m", "bench.doubt", "--worker", str(number)]
    command += ["--keep", str(options.keep)] if options.keep else []
    command += ["--no-colmap"] if options.no_colmap else []
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | threads)
    if done.returncode != 0:
        return {"scene": number, "failed": (done.stderr.strip().splitlines() or ["no reason given"])[-1]}
    return dict(json.loads(done.stdout.splitlines()[-1]))


def main(arguments: list[str] | None = None) -> None:
    """Print the table, a line as soon as it is known."""
    parser = argparse.ArgumentParser(prog="python -m bench.doubt", description="Right, or doubtful and said so?")
    parser.add_argument("--scenes", default="0:60", help="FROM:TO (without TO), or numbers separated by commas")
    parser.add_argument("--workers", type=int, default=1, help="scenes at the same time")
    parser.add_argument("--keep", type=Path, help="folder for photographs, features and matches")
    parser.add_argument("--out", type=Path, help="file for everything that was found, JSON")
    parser.add_argument("--no-colmap", action="store_true")
    parser.add_argument("--worker", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.worker is not None:
        print(json.dumps(run_scene(options.worker, options.keep, not options.no_colmap)))
        return
    first, _, end = options.scenes.partition(":")
    numbers = range(int(first), int(end)) if end else [int(word) for word in options.scenes.split(",")]
    print(HEADER, "|---" * 16 + "|", sep="\n", flush=True)
    results: list[Result] = []

    def work(number: int) -> None:
        result = run_apart(number, options)
        results.append(result)
        print(f"| {number} | {result['failed']} |" if "failed" in result else row(result), flush=True)

    with ThreadPoolExecutor(options.workers) as pool:
        list(pool.map(work, numbers))
    good = sorted((r for r in results if "failed" not in r), key=lambda r: int(r["scene"]))
    total: dict[str, int] = {}
    for found in map(counts, good):
        total |= {key: total.get(key, 0) + value for key, value in found.items()}
    print(f"\n{len(good)} of {len(results)} scenes: " + ", ".join(f"{value} {key}" for key, value in total.items()))
    if options.out:
        options.out.write_text(json.dumps(good))


if __name__ == "__main__":
    main()
