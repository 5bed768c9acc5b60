"""Lines in space by LIMAP from the same segments and cameras as ours: errors over the Cramer-Rao bound, and the Oxford sets.

`python -m bench.line_peers`, in an environment with `pylimap` (which wants a pycolmap of its own). LIMAP gets the best of its
two-view lines, the one that is least off in all views, and adjusts the lines with the cameras held: with its usual settings
(Cauchy loss of 1 px, weights by the lengths of segments), and by least squares as here.
"""

import argparse
import itertools
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch
from limap import _limap
from torch import Tensor

from bench.lines import SIGMA, STORED, scene, steps
from torchsfm.formats import read_vgg
from torchsfm.geometry import krt_from_camera, pluecker_from_points, point_depths, point_line_distance, project_lines
from torchsfm.triangulation import triangulate_lines

F64 = torch.float64


def adjusted(segments: Tensor, seen: Tensor, P: Tensor, plain: bool) -> tuple[Tensor, Tensor, float]:
    """Lines (n, 6) from segments (v, n, 2, 2), which of them there are, and the seconds of their adjustment."""
    points = pycolmap.Reconstruction()
    for i, camera in enumerate(P):
        K, R, t = krt_from_camera(camera)
        focal = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]) + 0.5, float(K[1, 2]) + 0.5]
        points.add_camera_with_trivial_rig(
            pycolmap.Camera(model="PINHOLE", width=4000, height=4000, params=focal, camera_id=i + 1)
        )
        pose = pycolmap.Rigid3d(torch.cat((R, t[:, None]), 1).numpy())
        image = pycolmap.Image(name=str(i), camera_id=i + 1, image_id=i + 1)
        points.add_image_with_trivial_frame(image, pose)
    whole = _limap._scene.HolisticReconstruction(points)
    lines = whole.structure_recon
    pixels = segments.numpy() + 0.5
    two = [[_limap._geometry.Line2d(pixels[i, j, 0], pixels[i, j, 1]) for j in range(len(seen[0]))] for i in range(len(P))]
    for i, row in enumerate(two):
        flat = _limap._scene.Structure2d()
        flat.set_lines(row)
        lines.add_structure2d(i + 1, flat)
    images = [points.image(i + 1) for i in range(len(P))]
    numbers = {}
    for j in range(len(seen[0])):
        views = seen[:, j].nonzero()[:, 0].tolist()
        best, least = None, np.inf
        for a, b in itertools.combinations(views, 2):
            found = _limap._estimators._triangulation.triangulate_line(two[a][j], images[a], two[b][j], images[b])
            if found is None:
                continue
            L = pluecker_from_points(torch.tensor(found.start), torch.tensor(found.end))
            error = float(distances(segments[views, j], P[views], L).square().sum())
            if error < least:
                best, least = found, error
        if best is not None:
            numbers[j] = lines.add_line3D(best)
            for i in views:
                lines.add_line_observation(numbers[j], pycolmap.TrackElement(i + 1, j))
    bundle = _limap._estimators._bundle_adjustment
    options, config = bundle.PointLineBundleAdjustmentOptions(), bundle.PointLineBundleAdjustmentConfig()
    options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.gradient_tolerance, options.ceres.solver_options.function_tolerance = 1e-10, 1e-10
    options.refine_rig_from_world = options.refine_focal_length = options.refine_extra_params = False
    if plain:
        options.loss_function_type_line = pycolmap.LossFunctionType.TRIVIAL
        options.line_weight_normalization_length = 0.0
    for i in range(len(P)):
        config.add_image(i + 1)
        config.set_constant_cam_intrinsics(i + 1)
        config.set_constant_rig_from_world_pose(points.image(i + 1).frame_id)
    for number in numbers.values():
        config.add_variable_line(number)
    adjuster = bundle.create_point_line_bundle_adjuster(options, config, whole)
    start = time.process_time()
    adjuster.solve()
    seconds = time.process_time() - start
    model, there = torch.zeros(len(seen[0]), 6, dtype=F64), torch.zeros(len(seen[0]), dtype=torch.bool)
    for j, number in numbers.items():
        line: Any = lines.line(number)
        line = getattr(line, "line", line)
        model[j] = pluecker_from_points(torch.tensor(line.start), torch.tensor(line.end))
        there[j] = True
    return model, there, seconds


def distances(segments: Tensor, P: Tensor, L: Tensor) -> Tensor:
    """Of the ends of segments (v, 2, 2) from the images of a line (v, 2)."""
    away: Tensor = point_line_distance(segments, project_lines(P, L[None]))
    return away


def bounds(generator: torch.Generator, trials: int) -> None:
    """Squared errors over the bound."""
    print(f"{SIGMA} px at each end: mean squared error / bound, found, lines a second (LIMAP: adjusted)")
    print("views  ours                     LIMAP                    as least squares")
    for views in (3, 8):
        ends, P, _ = scene(views, 20, generator)
        weights = torch.full(ends.shape[:2], SIGMA**-2, dtype=F64)
        truth = triangulate_lines(ends, P, weights=weights)
        noisy = ends[:, None] + SIGMA * torch.randn(views, trials, *ends.shape[1:], generator=generator, dtype=F64)
        noisy = noisy.flatten(1, 2)
        seen = torch.ones(noisy.shape[:2], dtype=torch.bool)
        start = time.process_time()
        ours = triangulate_lines(noisy, P, weights=weights[:, :1].expand(noisy.shape[:2]))
        rows = [(ours.model, ours.status == 0, time.process_time() - start)]
        rows += [adjusted(noisy, seen, P, plain) for plain in (False, True)]
        cells = []
        for model, there, seconds in rows:
            L = model / model[:, :3].norm(dim=-1, keepdim=True)
            e = steps(truth.model.repeat(trials, 1), L)
            flip = steps(truth.model.repeat(trials, 1), -L)
            e = torch.where((flip.norm(dim=-1) < e.norm(dim=-1))[:, None], flip, e)
            square = (e * torch.linalg.solve(truth.covariance.repeat(trials, 1, 1), e[..., None])[..., 0]).sum(-1) / 4
            cells.append(f"{float(square[there].mean()):6.3f} {float(there.double().mean()):.3f} {len(seen[0]) / seconds:7.0f}")
        print(f"{views:5}  " + "   ".join(cells), flush=True)


def oxford(folder: Path) -> None:
    """Root-mean-square distances of measured ends, all cameras without skew."""
    print("\nOxford lines    stored px  ours px  LIMAP px  as least squares  found by LIMAP")
    for name, stored in STORED.items():
        data = read_vgg(folder / "vgg" / name)
        P, L = data.P, data.L
        if float(point_depths(P[0], L.flatten(0, 1)).median()) < 0:
            # A mirrored world, seen the right way round.
            P = P * P.new_tensor([1.0, 1, 1, -1])
        # LIMAP's cameras have no skew.
        parts = [krt_from_camera(camera) for camera in P]
        K = torch.stack([part[0] for part in parts])
        K[:, 0, 1] = 0
        P = K @ torch.stack([torch.cat((R, t[:, None]), 1) for _, R, t in parts])
        seen = data.segments_visible
        ours = triangulate_lines(data.segments, P, visible=seen)
        cells = []
        for model, there in [
            (ours.model, ours.status == 0),
            *(adjusted(data.segments, seen, P, plain)[:2] for plain in (0, 1)),
        ]:
            away = point_line_distance(data.segments, project_lines(P, model)[..., None, :])
            cells.append(float(away[seen & there].square().mean().sqrt()))
        print(
            f"{name:14}  {stored:9.3f}  " + "  ".join(f"{c:7.3f}" for c in cells) + f"  {int(there.sum())}/{len(there)}",
            flush=True,
        )


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    bounds(torch.Generator().manual_seed(options.seed), options.trials)
    oxford(Path(os.environ["TORCHSFM_DATA"]))


if __name__ == "__main__":
    main()
