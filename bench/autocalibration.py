"""Autocalibration on simulated scenes, critical motions, chessboards and photographs.

`python -m bench.autocalibration` prints the tables. OpenCV calibrates from chessboards but has no autocalibration of a moving
camera; what stands beside it on scenes is the usual way of programs without it: a default focal length (1.2 times the longer
side), then incremental mapping and bundle adjustment. Factorisation has a bench of its own (`bench.factorization`); here it
makes the projective cameras. Times are CPU time of one thread.
"""

import argparse
import re
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from bench.projective_scenes import CRITICAL, SIZE, UnknownCameras, unknown_cameras
from bench.real_data import data_folder
from torchsfm.autocalibration import (
    Assumption,
    Autocalibration,
    autocalibrate_points,
    calibrate_planes,
    constant_intrinsics,
    dual_quadric_linear,
    intrinsics_from_kruppa,
    intrinsics_from_modulus,
)
from torchsfm.bundle import bundle_adjust
from torchsfm.geometry import BrownConrady, BundleProblem, Camera, NoDistortion, Pose, Radial
from torchsfm.reconstruction import reconstruct, reconstruct_tracks
from torchsfm.reconstruction.model.evaluation import pose_errors
from torchsfm.tensors import bifocal_tensors

IMAGE = (float(SIZE[0]), float(SIZE[1]))
WRONG = 0.1


def calibrate(scene: UnknownCameras, **options: Any) -> Autocalibration:
    """One scene, with everything by default."""
    return autocalibrate_points(scene.P, scene.X, scene.x, image_size=IMAGE, visible=scene.visible, **options)


def focal_error(K: Tensor, scene: UnknownCameras) -> float:
    """Largest relative error of a focal length."""
    return float((K[..., 0, 0] / scene.K[0, 0, 0] - 1).abs().max())


def quantiles(errors: list[float]) -> str:
    """Median, 90 % quantile and largest, in percent."""
    if not errors:
        return "-"
    return " ".join(f"{100 * q:.2f}" for q in np.quantile(errors, [0.5, 0.9, 1.0]))


def after_metric_bundle(scene: UnknownCameras, found: Autocalibration) -> float:
    """Error of the focal length after metric bundle adjustment over focal length and principal point."""
    view, point = scene.visible.nonzero().unbind(-1)
    R = torch.linalg.solve(found.K, found.P[..., :3])
    t = torch.linalg.solve(found.K, found.P[..., 3:])[..., 0]
    camera = Camera(found.K[:1], NoDistortion())
    problem = BundleProblem.of(Pose(R, t), camera, found.X, scene.x[scene.visible], view, point)
    result = bundle_adjust(
        problem, free=("focal", "principal_point"), max_iterations=50,
        intrinsics_sigma={"principal_point": 0.02 * IMAGE[0]}, intrinsics_mean=Camera(middle(camera.K), NoDistortion()),
    )  # fmt: skip
    return focal_error(result.cameras.K, scene)


def padded(t: Tensor, n: int, after: int) -> Tensor:
    """With zeros up to n along the dimension that has `after` others behind it."""
    return torch.nn.functional.pad(t, (0,) * (2 * after) + (0, n - t.shape[-1 - after]))


def middle(K: Tensor) -> Tensor:
    """The same with centred principal points."""
    K = K.clone()
    K[..., :2, 2] = (K.new_tensor(IMAGE) - 1) / 2
    return K


def random_scenes(count: int, bundles: int) -> None:
    """Print accuracy and success over random scenes, alone and batched."""
    print("random scenes, 1 px noise, 60 points, f 0.6 to 4 widths: error of f, %: median, 90 %, largest")
    print("views  solved of made  refused  wrong | f alone | f after bundle | f over its deviation, rms | ms alone, in a batch")
    for views in (5, 8, 12, 20):
        g = torch.Generator().manual_seed(views)
        scenes = [unknown_cameras(g, views) for _ in range(max(count // 4, 1))]
        good = [s for s in scenes if s.solved]
        start = time.process_time()
        found = [calibrate(s) for s in good]
        alone = (time.process_time() - start) / max(len(good), 1)
        n = max(s.x.shape[1] for s in good)
        P, X = torch.stack([s.P for s in good]), torch.stack([padded(s.X, n, 1) for s in good])
        x, visible = torch.stack([padded(s.x, n, 1) for s in good]), torch.stack([padded(s.visible, n, 0) for s in good])
        start = time.process_time()
        autocalibrate_points(P, X, x, image_size=IMAGE, visible=visible)
        batch = (time.process_time() - start) / max(len(good), 1)
        sure = [(s, a) for s, a in zip(good, found, strict=True) if a.valid]
        errors = [focal_error(a.K, s) for s, a in sure]
        later = [after_metric_bundle(s, a) for s, a in sure[:bundles]]
        scores = [float((a.K[0, 0, 0] / s.K[0, 0, 0]).log() / a.deviation[0, 0]) for s, a in sure]
        rms = float(np.sqrt(np.mean(np.square(scores)))) if scores else 0.0
        print(
            f"{views:5d}  {len(good):6d} of {len(scenes)}  {len(good) - len(sure):7d}  {sum(e > WRONG for e in errors):5d} | "
            f"{quantiles(errors)} | {quantiles(later)} | {rms:.2f} | {1e3 * alone:.0f} {1e3 * batch:.0f}",
            flush=True,
        )


def critical_motions(count: int) -> None:
    """Print how often critical motions are refused or reported, under weak and strong assumptions."""
    everything = Assumption(free=("focal", "aspect", "skew", "principal_point"), principal_point_sigma=None)
    print("critical motions, 8 views, 1 px: refused; refused or told; off by > 10 % in silence; error of f where accepted, %")
    for motion in (*CRITICAL, "general"):
        g = torch.Generator().manual_seed(1)
        scenes = [s for s in (unknown_cameras(g, 8, motion=motion) for _ in range(count)) if s.solved]
        for name, options in (("default", {}), ("all of K free", {"assume": everything})):
            found = [calibrate(s, **options) for s in scenes]
            refused = [not bool(a.valid) for a in found]
            told = [r or bool(a.motion.critical) for r, a in zip(refused, found, strict=True)]
            errors = [focal_error(a.K, s) for s, a in zip(scenes, found, strict=True)]
            silent = sum(e > WRONG and not t for e, t in zip(errors, told, strict=True))
            kept = [e for e, r in zip(errors, refused, strict=True) if not r]
            n = max(len(scenes), 1)
            print(
                f"{motion:12s} {name:14s} {len(scenes):4d} scenes: refused {sum(refused) / n:.2f}, told {sum(told) / n:.2f}, "
                f"silently wrong {silent}, {quantiles(kept)}",
                flush=True,
            )


def classical(count: int) -> None:
    """Print the classical methods on the same scenes."""
    print("methods on the same scenes, 8 views, 1 px, principal point in the middle: accepted, error of f, %")
    g = torch.Generator().manual_seed(2)
    scenes = [s for s in (unknown_cameras(g, 8, offset=0.0) for _ in range(count)) if s.solved]
    focal = Assumption(free=("focal",))

    def kruppa(s: UnknownCameras) -> Any:
        i, j = torch.triu_indices(len(s.P), len(s.P), 1)
        return intrinsics_from_kruppa(bifocal_tensors(s.P, torch.stack((i, j), -1)), image_size=IMAGE, assume=focal)

    methods: dict[str, Callable[[UnknownCameras], Any]] = {
        "weighed (autocalibrate_points)": lambda s: calibrate(s, assume=focal),
        "Heyden & Astrom": lambda s: constant_intrinsics(s.P, s.X, image_size=IMAGE, visible=s.visible, assume=focal),
        "dual quadric, linear": lambda s: dual_quadric_linear(s.P, image_size=IMAGE),
        "dual quadric, no expectation": lambda s: dual_quadric_linear(s.P, image_size=IMAGE, expected_focal=None),
        "modulus constraint": lambda s: intrinsics_from_modulus(s.P, s.X, image_size=IMAGE, visible=s.visible, assume=focal),
        "Kruppa": kruppa,
    }
    for name, method in methods.items():
        start = time.process_time()
        found = [method(s) for s in scenes]
        seconds = (time.process_time() - start) / max(len(scenes), 1)
        kept = [
            float((a.K[..., 0, 0] / s.K[0, 0, 0] - 1).abs().median())
            for s, a in zip(scenes, found, strict=True)
            if a.status == 0
        ]
        print(f"{name:32s} {len(kept)} of {len(scenes)}: {quantiles(kept)}   {1e3 * seconds:.0f} ms", flush=True)


def guesses(count: int) -> None:
    """Print what a default focal length and incremental mapping with bundle adjustment make of the same scenes."""
    print("default focal length, incremental mapping, bundle adjustment, 8 views, 1 px: all registered, error of f, %")
    g = torch.Generator().manual_seed(2)
    scenes = [s for s in (unknown_cameras(g, 8, offset=0.0) for _ in range(count)) if s.solved]
    size = torch.tensor([SIZE] * 8)
    for name, options in (("guess of 1.2 widths", {"focal": 1200.0}), ("projective, then the same", {"method": "projective"})):
        errors, complete = [], 0
        start = time.process_time()
        for s in scenes:
            view, track = s.visible.nonzero().unbind(-1)
            result = reconstruct_tracks(s.x[s.visible], view, track, size, camera="pinhole", **options)  # type: ignore[arg-type]
            if result.models and bool(result.models[0].registered.all()):
                complete += 1
                errors.append(focal_error(result.models[0].cameras.K, s))
        seconds = (time.process_time() - start) / max(len(scenes), 1)
        wrong = sum(e > WRONG for e in errors)
        print(
            f"{name:28s} {complete} of {len(scenes)}, {wrong} off by > 10 %: {quantiles(errors)}   {seconds:.1f} s", flush=True
        )


def chessboards(data: Path) -> None:
    """Print intrinsics from chessboards beside OpenCV's."""
    corners = []
    for path in sorted((data / "calibration/chessboard_stereo").glob("left*.jpg")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        found, x = cv2.findChessboardCorners(image, (9, 6))
        if found:
            x = cv2.cornerSubPix(image, x, (5, 5), (-1, -1), (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 30, 1e-3))
            corners.append(x.reshape(-1, 2))
    i, j = np.meshgrid(np.arange(9), np.arange(6))
    board = np.stack((i.ravel(), j.ravel(), 0 * i.ravel()), -1).astype(np.float32)
    x, X = torch.from_numpy(np.stack(corners)).double(), torch.from_numpy(board[:, :2]).double()
    print(f"chessboards, {len(corners)} views: f, c, RMS px, seconds")
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-12)
    for name, model, flags in (
        ("radial", Radial, cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3),
        ("Brown-Conrady", BrownConrady, 0),
    ):
        start = time.process_time()
        points = [p.reshape(-1, 1, 2) for p in corners]
        rms, K, *_ = cv2.calibrateCamera([board] * len(points), points, (640, 512), None, None, flags=flags, criteria=criteria)
        theirs = time.process_time() - start
        start = time.process_time()
        ours = calibrate_planes(x, X, image_size=(640.0, 512.0), distortion=model)
        seconds = time.process_time() - start
        rows = (("torchsfm", ours.camera.K.numpy(), float(ours.rms), seconds), ("OpenCV", K, rms, theirs))
        for who, M, error, t in rows:
            print(
                f"{name:14s} {who:9s} {M[0, 0]:.4f} {M[1, 1]:.4f}  {M[0, 2]:.4f} {M[1, 2]:.4f}  {error:.6f}  {t:.2f}",
                flush=True,
            )


def photographs(data: Path, work: Path) -> None:
    """Print the projective road on photographs: after autocalibration alone and after metric bundle adjustment."""
    print(
        "photographs: f true, alone, after bundle (error, %); c alone, off the stored one (% of the width); rotation error, deg"
    )
    sets: dict[str, tuple[list[Path], list[float], Pose | None]] = {}
    folder = data / "images/fountain-P11"
    files = sorted((folder / "images").glob("*.jpg"))
    truths = [folder / "gt" / f"{path.stem}.txt" for path in files]
    lines = [[[float(word) for word in line.split()] for line in p.read_text().splitlines()] for p in truths]
    K = lines[0]
    poses = torch.tensor([rows[3:6] for rows in lines], dtype=torch.float64)
    sets["fountain-P11"] = files, [(K[0][0] + K[1][1]) / 2, K[0][2], K[1][2]], Pose(poses[..., :3], poses[..., 3])
    folder = data / "images/sceaux_castle"
    k = np.loadtxt(folder / "K.txt")
    sets["sceaux_castle"] = sorted(folder.glob("*.JPG")), [k[0, 0], k[0, 2], k[1, 2]], None
    folder = data / "images/temple_ring"
    table = [line.split() for line in (folder / "templeR_par.txt").read_text().splitlines()[1:]]
    values = torch.tensor([[float(word) for word in line[1:]] for line in table], dtype=torch.float64)
    ring = Pose(values[:, 9:18].reshape(-1, 3, 3), values[:, 18:])
    f = float(values[0, 0] + values[0, 4]) / 2
    sets["temple_ring"] = [folder / line[0] for line in table], [f, float(values[0, 2]), float(values[0, 5])], ring
    for name, (paths, (f, cx, cy), truth) in sets.items():
        result = reconstruct(paths, method="projective", shared_camera=True, out=work / name, resume=True)
        text = result.report.autocalibration[0] if result.report.autocalibration else "no three images hang together"
        alone = re.search(r"focal length ([\d.]+) \+-.*principal point \(([\d.]+), ([\d.]+)\)", text)
        if not result.models or alone is None:
            print(f"{name:14s} {text}", flush=True)
            continue
        model = result.models[0]
        fa, xa, ya = (float(g) for g in alone.groups())
        width = float(model.image_size[0, 0])
        fb = float(model.cameras.K[0, 0, 0])
        turn = "-" if truth is None else f"{float(pose_errors(model.poses, truth, model.registered).rotation.nanmedian()):.3f}"
        off = 100 * max(abs(xa - cx), abs(ya - cy)) / width
        print(
            f"{name:14s} {f:.1f} {fa:.1f} ({100 * (fa / f - 1):+.2f}) {fb:.1f} ({100 * (fb / f - 1):+.2f})",
            f"({xa:.1f}, {ya:.1f}) {off:.2f}; {turn}; {model.num_registered} of {len(paths)} images; {text}",
            flush=True,
        )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=500)
    parser.add_argument("--trials", type=int, default=100, help="of each critical motion")
    parser.add_argument("--work", type=Path, default=None, help="folder in which the stages of photographs are kept")
    parts = ["random", "critical", "classical", "guess", "chessboards", "photographs"]
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    data = data_folder()
    if "random" in arguments.parts:
        random_scenes(arguments.scenes, 25)
    if "critical" in arguments.parts:
        critical_motions(arguments.trials)
    if "classical" in arguments.parts:
        classical(min(arguments.trials, 50))
    if "guess" in arguments.parts:
        guesses(min(arguments.trials, 20))
    if data is None:
        return
    if "chessboards" in arguments.parts:
        chessboards(data)
    if "photographs" in arguments.parts:
        with tempfile.TemporaryDirectory() as folder:
            photographs(data, arguments.work or Path(folder))


@pytest.mark.parametrize("views", [5, 12])
def test_autocalibration(benchmark: Any, views: int) -> None:
    torch.set_num_threads(1)
    g = torch.Generator().manual_seed(0)
    scene = unknown_cameras(g, views)
    found = benchmark.pedantic(lambda: calibrate(scene), rounds=3, warmup_rounds=1)
    assert focal_error(found.K, scene) < WRONG


if __name__ == "__main__":
    main()
