"""Bundle adjustment against Ceres (through pycolmap) on the problems of Bundle Adjustment in the Large: time and final cost.

`python -m bench.bundle FOLDER` prints a table for the `problem-*.txt*` files in the folder (default: `bal` in $TORCHSFM_DATA).
Both start at the same numbers, use one thread and end at a relative decrease of 1e-6; runs alternate, and the least CPU time
counts. COLMAP drops observations of points behind their camera, so where there are any the costs differ by those.
"""

import argparse
import gzip
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsfm.bundle import bundle_adjust
from torchsfm.geometry import Camera, Pose, Radial, intrinsics, rotation_from_rotvec

Problem = tuple[Pose, Camera, Tensor, Tensor, Tensor, Tensor]


def read(path: Path) -> Problem:
    """BAL cameras look down -z: turn them half a turn about x, and mirror image y."""
    text = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    numbers = np.array(text.split(), dtype=np.float64)
    v, n, m = numbers[:3].astype(int)
    seen = torch.tensor(numbers[3 : 3 + 4 * m].reshape(m, 4))
    camera = torch.tensor(numbers[3 + 4 * m : 3 + 4 * m + 9 * v].reshape(v, 9))
    X = torch.tensor(numbers[3 + 4 * m + 9 * v :].reshape(n, 3))
    flip = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    poses = Pose(flip[:, None] * rotation_from_rotvec(camera[:, :3]), flip * camera[:, 3:6])
    cameras = Camera(intrinsics(camera[:, 6], torch.zeros(v, 2, dtype=torch.float64)), Radial(camera[:, 7], camera[:, 8]))
    view, point = seen[:, :2].long().unbind(1)
    return poses, cameras, X, seen[:, 2:] * flip[:2], view.clone(), point.clone()


def to_pycolmap(problem: Problem) -> Any:
    """The same problem as a COLMAP reconstruction, a camera and a rig of its own for every image."""
    import pycolmap

    poses, cameras, X, x, view, point = problem
    reconstruction = pycolmap.Reconstruction()
    order = torch.argsort(view, stable=True)
    starts = torch.bincount(view, minlength=len(poses.t)).cumsum(0).tolist()
    place = torch.empty_like(order)
    begin = 0
    for i, end in enumerate(starts):
        rows = order[begin:end]
        place[rows] = torch.arange(len(rows))
        f, k1, k2 = (float(p[i]) for p in (cameras.K[:, 0, 0], cameras.distortion.k1, cameras.distortion.k2))
        camera = pycolmap.Camera(camera_id=i + 1, model="RADIAL", width=2000, height=2000, params=[f, 0.0, 0.0, k1, k2])
        reconstruction.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=str(i), points2D=pycolmap.Point2DList([pycolmap.Point2D(p) for p in x[rows].numpy()]))
        image.image_id, image.camera_id = i + 1, i + 1
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(poses.R[i].numpy()), poses.t[i].numpy())
        reconstruction.add_image_with_trivial_frame(image, pose)
        begin = end
    tracks: list[list[Any]] = [[] for _ in range(len(X))]
    for v, p, k in zip(view.tolist(), point.tolist(), place.tolist(), strict=True):
        tracks[p].append(pycolmap.TrackElement(v + 1, k))
    for position, elements in zip(X.numpy(), tracks, strict=True):
        track = pycolmap.Track()
        for element in elements:
            track.add_element(element.image_id, element.point2D_idx)
        reconstruction.add_point3D(position, track)
    return reconstruction


def run_ceres(problem: Problem) -> tuple[float, float, int]:
    """CPU seconds, final cost, iterations."""
    import pycolmap

    reconstruction = to_pycolmap(problem)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    solver = options.ceres.solver_options
    solver.function_tolerance, solver.max_num_iterations, solver.num_threads = 1e-6, 100, 1
    config = pycolmap.BundleAdjustmentConfig()
    for image in reconstruction.images:
        config.add_image(image)
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, reconstruction)
    start = time.process_time()
    summary = adjuster.solve()
    seconds = time.process_time() - start
    summary = getattr(summary, "ceres_summary", summary)
    return seconds, summary.final_cost, summary.num_successful_steps + summary.num_unsuccessful_steps


def run_ours(problem: Problem) -> tuple[float, float, int]:
    """CPU seconds, final cost, iterations."""
    start = time.process_time()
    result = bundle_adjust(*problem, free=("focal", "k1", "k2"), tolerance=1e-6, max_iterations=100)
    return time.process_time() - start, result.cost, result.iterations


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", default=Path(os.environ.get("TORCHSFM_DATA", ".")) / "bal", type=Path)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{'problem':24s} {'program':10s} {'cost':>14s} {'iterations':>10s} {'seconds':>8s} {'ms / iteration':>14s}")
    for path in sorted(arguments.folder.glob("problem-*.txt*")):
        problem = read(path)
        runs = [(run_ours(problem), run_ceres(problem)) for _ in range(arguments.repeats)]
        for name, results in zip(("torchsfm", "Ceres"), zip(*runs, strict=True), strict=True):
            seconds, cost, iterations = min(results)
            print(
                f"{path.name.split('-pre')[0]:24s} {name:10s} {cost:14.3f} {iterations:10d} {seconds:8.3f}"
                f" {1e3 * seconds / iterations:14.1f}"
            )


if __name__ == "__main__":
    main()
