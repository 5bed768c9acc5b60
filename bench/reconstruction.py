"""The main job, photographs to model, against COLMAP on the same photographs with the same threads.

    TORCHSFM_DATA=/path/to/data python -m bench.reconstruction [--sets fountain sceaux ...] [--threads 2] [--lines] [--curves]
    python -m bench.reconstruction --rendered 16 24 32 --curves

prints one markdown table, of photographs or of so many rendered ones, of which the truth is known exactly; with `--lines` also
of points and lines together, with `--curves` of points and curves. Each run is a process of its own, so that its processor time
and its peak memory are its own; both programs start from the same knowledge: one shared camera, its focal length from the EXIF
header where there is one, else unknown, or K where the set gives it. `pytest bench/reconstruction.py` times the whole job with
pytest-benchmark instead.
"""

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bench.real_data import SETS, PhotographSet, data_folder
from bench.scale import render, ring

Result = dict[str, Any]
RENDERED = "rendered-"
"""Before their number, the name of photographs that are rendered."""
STAGES = ("start", "extract", "match", "verify", "map")


def photographs_of(name: str, data: Path) -> PhotographSet:
    """The photographs of a name, in the folder of the data sets, or of rendered ones where they are."""
    if not name.startswith(RENDERED):
        return SETS[name](data)
    paths = sorted((data / name).iterdir())
    _, poses = ring(len(paths), torch.Generator().manual_seed(0))
    truth = {path.name: pose.numpy() for path, pose in zip(paths, poses.matrix(), strict=True)}
    return PhotographSet(f"{len(paths)} rendered", paths, truth)


def run_torchsfm(photographs: PhotographSet, threads: int, seed: int, **more: bool) -> Result:
    """Reconstruct with this library; the seconds of its stages are those of its own report."""
    clock = time.perf_counter()
    torch.set_num_threads(threads)
    import cv2

    from torchsfm.reconstruction import reconstruct

    cv2.setNumThreads(threads)
    K = None if photographs.K is None else torch.from_numpy(photographs.K)
    start = time.perf_counter() - clock
    clock = time.perf_counter()
    result = reconstruct(photographs.paths, sequence=photographs.sequence, shared_camera=True, K=K, seed=seed, **more)
    total = time.perf_counter() - clock
    model = result.models[0]
    group = {
        "read": "extract",
        "features": "extract",
        "segments": "extract",
        "edges": "extract",
        "look": "match",
        "match": "match",
        "track": "match",
        "overlays": "verify",
        "verify": "verify",
    }
    seconds = dict.fromkeys(STAGES, 0.0)
    seconds["start"] = start
    for stage, value in result.report.seconds.items():
        seconds[group.get(stage, "map")] += value
    cameras, index = model.cameras, model.camera_index[model.registered]
    K_found = cameras.K[index]
    Rt = model.poses.matrix().tolist()
    return {
        "poses": {name: Rt[i] for i, name in enumerate(model.names) if model.registered[i]},
        "points": len(model.X),
        "observations": len(model.x),
        "error": float(model.residuals().mean()),
        "focal": float((K_found[:, 0, 0] + K_found[:, 1, 1]).mean() / 2),
        "seconds": seconds,
        "total": start + total,
    }


def run_colmap(photographs: PhotographSet, threads: int, seed: int) -> Result:
    """Reconstruct with pycolmap in its default settings: SIFT on the CPU, all pairs (neighbours in a sequence), incremental."""
    clock = time.perf_counter()
    import pycolmap

    pycolmap.set_random_seed(seed)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    seconds = dict.fromkeys(STAGES, 0.0)
    begin = clock

    def lap(stage: str) -> None:
        nonlocal clock
        seconds[stage], clock = time.perf_counter() - clock, time.perf_counter()

    reader = pycolmap.ImageReaderOptions()
    extraction = pycolmap.FeatureExtractionOptions(num_threads=threads, use_gpu=False)
    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    mapping = pycolmap.IncrementalPipelineOptions(num_threads=threads, random_seed=seed)
    if photographs.K is not None:
        K = photographs.K
        reader.camera_model = "PINHOLE"
        # COLMAP puts the centre of the first pixel at (0.5, 0.5).
        reader.camera_params = f"{K[0, 0]},{K[1, 1]},{K[0, 2] + 0.5},{K[1, 2] + 0.5}"
        mapping.ba_refine_focal_length = mapping.ba_refine_extra_params = False
    folder = photographs.paths[0].parent
    names = [path.name for path in photographs.paths]
    device = pycolmap.Device.cpu
    with tempfile.TemporaryDirectory() as scratch:
        database = Path(scratch) / "database.db"
        lap("start")
        pycolmap.extract_features(
            database, folder, names, pycolmap.CameraMode.SINGLE, reader, extraction_options=extraction, device=device
        )
        lap("extract")
        if photographs.sequence:
            pycolmap.match_sequential(database, matching_options=matching, device=device)
        else:
            pycolmap.match_exhaustive(database, matching_options=matching, device=device)
        lap("match")
        models = pycolmap.incremental_mapping(database, folder, Path(scratch) / "models", mapping)
        lap("map")
    total = time.perf_counter() - begin
    if not models:
        raise RuntimeError("COLMAP made no model")
    model = max(models.values(), key=lambda m: m.num_reg_images())
    images = [image for image in model.images.values() if image.has_pose]
    tracks = [(point.error, point.track.length()) for point in model.points3D.values()]
    observations = sum(length for _, length in tracks)
    return {
        "poses": {image.name: image.cam_from_world().matrix().tolist() for image in images},
        "points": len(tracks),
        "observations": observations,
        "error": sum(error * length for error, length in tracks) / observations,
        "focal": float(np.mean([model.cameras[image.camera_id].mean_focal_length() for image in images])),
        "seconds": seconds,
        "total": total,
    }


PROGRAMS: dict[str, Callable[[PhotographSet, int, int], Result]] = {
    "torchsfm": run_torchsfm,
    "torchsfm with lines": partial(run_torchsfm, lines=True),
    "torchsfm with curves": partial(run_torchsfm, curves=True),
    "colmap": run_colmap,
}


def run_apart(program: str, name: str, data: Path, threads: int, seed: int) -> Result:
    """Run one program on one set in a process of its own, and add its processor time and its peak memory in MB."""
    command = [sys.executable, "-m", "bench.reconstruction", "--data", str(data), "--threads", str(threads)]
    command += ["--seed", str(seed), "--worker", program, name]
    limits = {key: str(threads) for key in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | limits)
    if done.returncode != 0:
        reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        return {"failed": f"exit status {done.returncode}: {reason}"}
    return dict(json.loads(done.stdout.splitlines()[-1]))


def judge(result: Result, photographs: PhotographSet) -> Result:
    """Compare the poses of a result with the truth."""
    if not photographs.poses:
        return {}
    from torchsfm.geometry.poses import Pose
    from torchsfm.reconstruction.model.evaluation import pose_auc, pose_errors, position_rmse

    names = [path.name for path in photographs.paths]
    nothing = np.eye(3, 4)
    poses = Pose.from_matrix(torch.from_numpy(np.array([result["poses"].get(name, nothing) for name in names])))
    truth = Pose.from_matrix(torch.from_numpy(np.array([photographs.poses[name] for name in names])))
    registered = torch.tensor([name in result["poses"] for name in names])
    errors = pose_errors(poses, truth, registered)
    return {
        "auc": pose_auc(errors.pose).tolist(),
        "rmse": float(position_rmse(poses, truth, registered)),
        "rotation": float(errors.rotation[torch.isfinite(errors.rotation)].median()),
    }


HEADER = (
    "| data set | program | registered | points | observations | track length | error px | "
    "start / extract / match / verify / map = total s | CPU s | memory MB | AUC 1 / 2 / 5 deg | position RMSE | focal (truth) |"
)


def row(program: str, result: Result, photographs: PhotographSet) -> str:
    """One line of the table."""
    if "failed" in result:
        return f"| {photographs.name} | {program} | {result['failed']} |" + " |" * 10
    truth = judge(result, photographs)
    seconds = " / ".join(f"{result['seconds'][stage]:.1f}" for stage in STAGES)
    cells = [
        photographs.name,
        program,
        f"{len(result['poses'])}/{len(photographs.paths)}",
        f"{result['points']:,}",
        f"{result['observations']:,}",
        f"{result['observations'] / max(result['points'], 1):.2f}",
        f"{result['error']:.3f}",
        f"{seconds} = {result['total']:.1f}",
        f"{result['processor']:.0f}",
        f"{result['memory']:.0f}",
        " / ".join(f"{area:.3f}" for area in truth["auc"]) if truth else "",
        "" if not truth else f"{truth['rmse'] * photographs.unit:.2f} mm" if photographs.unit else f"{truth['rmse']:.4g}",
        f"{result['focal']:.1f}" + (f" ({photographs.focal:.1f})" if photographs.focal else ""),
    ]
    return "| " + " | ".join(cells) + " |"


def main(arguments: list[str] | None = None) -> None:
    """Print the table, a line as soon as it is known."""
    parser = argparse.ArgumentParser(prog="python -m bench.reconstruction", description="Photographs to model against COLMAP.")
    parser.add_argument("--data", type=Path, default=data_folder(), help="folder of the data sets (default: $TORCHSFM_DATA)")
    parser.add_argument("--sets", nargs="+", choices=sorted(SETS), help="default: all, where none are rendered")
    parser.add_argument("--rendered", nargs="+", type=int, default=[], metavar="N", help="so many rendered photographs")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--lines", action="store_true", help="also reconstruct with lines")
    parser.add_argument("--curves", action="store_true", help="also reconstruct with curves")
    parser.add_argument("--no-colmap", action="store_true")
    parser.add_argument("--no-torchsfm", action="store_true")
    parser.add_argument("--worker", nargs=2, metavar=("PROGRAM", "SET"), help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    sets = options.sets or ([] if options.rendered else list(SETS))
    if options.data is None and sets:
        parser.error("name the folder of the data sets with --data or TORCHSFM_DATA")
    if options.worker:
        program, name = options.worker
        result = PROGRAMS[program](photographs_of(name, options.data), options.threads, options.seed)
        # Linux counts in kilobytes, macOS in bytes.
        unit = 2**20 if platform.system() == "Darwin" else 2**10
        used = resource.getrusage(resource.RUSAGE_SELF)
        result |= {"memory": used.ru_maxrss / unit, "processor": used.ru_utime + used.ru_stime}
        print(json.dumps(result))
        return
    wanted = dict(zip(PROGRAMS, (not options.no_torchsfm, options.lines, options.curves, not options.no_colmap), strict=True))
    chosen = [program for program in PROGRAMS if wanted[program]]
    print(HEADER, "|---" * 13 + "|", sep="\n", flush=True)
    remarks = []
    with tempfile.TemporaryDirectory() as scratch:
        places = [(name, options.data) for name in sets]
        for number in options.rendered:
            name = f"{RENDERED}{number}"
            folder = Path(scratch) / name
            folder.mkdir()
            render(folder, number)
            places.append((name, Path(scratch)))
        for name, data in places:
            photographs = photographs_of(name, data)
            if photographs.remark:
                remarks.append(f"{photographs.name}: {photographs.remark}.")
            for program in chosen:
                result = run_apart(program, name, data, options.threads, options.seed)
                print(row(program, result, photographs), flush=True)
    print(f"\n{options.threads} threads, seed {options.seed}; mean error over observations. COLMAP verifies while it matches.")
    print(*remarks, sep="\n")


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("name", ["fountain", "sceaux"])
def test_photographs_to_model(benchmark: Any, program: str, name: str) -> None:
    """Time the whole job once; all photographs must be registered."""
    data = data_folder()
    if data is None:
        pytest.skip("TORCHSFM_DATA does not name a folder of data sets")
    photographs = SETS[name](data)
    result = benchmark.pedantic(PROGRAMS[program], (photographs, torch.get_num_threads(), 0), rounds=1)
    assert len(result["poses"]) == len(photographs.paths)


if __name__ == "__main__":
    main()
