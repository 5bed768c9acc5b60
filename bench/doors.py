"""Known poses, new photographs in old models, and models joined, on real photographs whose poses were measured.

    TORCHSFM_DATA=/path/to/data python -m bench.doors [--out FOLDER]

reconstructs castle-P19 whole, in two halves that share three images, and without one image, and prints how good the merged
halves are beside the whole, with their lines and curves, where the image left out is placed beside where the whole has it, and
for fountain-P11 what points the true poses give beside free ones; then temple_ring as a film, and fountain-P11 by COLMAP's
features and matches in its database and in hloc's two files, where pycolmap and h5py are installed. With `--out`, what was
finished there is not computed again.
"""

import argparse
import subprocess
import sys
import tempfile
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import torch

from bench import merged_structure
from bench.real_data import PhotographSet, data_folder, strecha, temple
from torchsfm.formats import read_hloc
from torchsfm.geometry import Camera, Pose, rotation_angle
from torchsfm.reconstruction import (
    Reconstruction,
    align_models,
    merge_models,
    reconstruct,
    reconstruct_matches,
    register_photographs,
    saved_features,
    triangulate_photographs,
)
from torchsfm.reconstruction.model.evaluation import align_poses, pose_auc, pose_errors, position_rmse

HEAD = """
| model | images | points | error, px | AUC at 1 / 2 / 5 deg | position, RMS mm | rotation, mean deg |
|---|---|---|---|---|---|---|"""
SHARED = 3
LEFT_OUT = 9


def true_poses(photographs: PhotographSet, names: tuple[str, ...]) -> Pose:
    """The measured poses of images."""
    rows = torch.stack([torch.from_numpy(photographs.poses[name]) for name in names])
    return Pose(rows[:, :, :3], rows[:, :, 3])


def true_camera(photographs: PhotographSet) -> Camera:
    """The measured intrinsics of the camera that took all images, which are free of distortion."""
    path = photographs.paths[0]
    rows = [line.split() for line in (path.parent.parent / "gt" / f"{path.stem}.txt").read_text().splitlines()[:3]]
    return Camera(torch.tensor([[float(word) for word in row] for row in rows], dtype=torch.float64)[None])


def model_of(paths: list[Path], out: Path, *, structure: bool = False) -> Reconstruction:
    """The model of some photographs, with lines and curves or without, made once."""
    file = out / ("structure.npz" if structure else "model.npz")
    if not file.exists():
        found = reconstruct(paths, shared_camera=True, out=out, resume=True, lines=structure, curves=structure)
        found.model.save(file)
    return Reconstruction.load(file)


def describe(name: str, model: Reconstruction, truth: Pose) -> str:
    """A row of the table of models against the truth."""
    errors = pose_errors(model.poses, truth, model.registered)
    areas = " / ".join(f"{area:.3f}" for area in pose_auc(errors.pose).tolist())
    rmse = 1000 * float(position_rmse(model.poses, truth, model.registered))
    rotation = float(errors.image_rotation[model.registered].mean())
    error = float(model.residuals().mean())
    return f"| {name} | {model.num_registered} | {model.num_points} | {error:.3f} | {areas} | {rmse:.1f} | {rotation:.4f} |"


def merging(castle: PhotographSet, out: Path) -> None:
    """The two halves of the court against the whole."""
    middle = (len(castle.paths) + SHARED) // 2
    whole = model_of(castle.paths, out / "whole")
    first, second = model_of(castle.paths[:middle], out / "first"), model_of(castle.paths[middle - SHARED :], out / "second")
    merged = merge_models(first, second)
    print(HEAD)
    for name, model in (("whole", whole), ("first", first), ("second", second), ("merged", merged.model)):
        print(describe(name, model, true_poses(castle, model.names)))
    print(merged.fault() or merged.summary())


def merging_structure(castle: PhotographSet, out: Path) -> None:
    """Lines and curves of the merged halves against those of the whole."""
    middle = (len(castle.paths) + SHARED) // 2
    parts = {"whole": castle.paths, "first": castle.paths[:middle], "second": castle.paths[middle - SHARED :]}
    models = {name: model_of(paths, out / name, structure=True) for name, paths in parts.items()}
    merged = merge_models(models["first"], models["second"])
    models["merged"] = merged.model
    print(merged.fault() or merged.summary())
    # The whole in metres of the truth, all others on it: a model bends by more than its lines are thick.
    whole = models["whole"]
    whole = whole.transform(align_poses(whole.poses, true_poses(castle, whole.names), whole.registered))
    metric = {name: model.transform(align_models(model, whole).similarity) for name, model in models.items()}
    for row, what in ((merged_structure.line_row, "lines"), (merged_structure.curve_row, "curve samples")):
        print(merged_structure.HEAD.format(what=what))
        for name, model in metric.items():
            print(row(name, model, whole))


def placing(castle: PhotographSet, out: Path) -> None:
    """An image that the model was made without."""
    whole = model_of(castle.paths, out / "whole")
    rest = [path for i, path in enumerate(castle.paths) if i != LEFT_OUT]
    without = model_of(rest, out / "without")
    features = saved_features(out / "without", without)
    assert features is not None
    placed = register_photographs([castle.paths[LEFT_OUT]], without, features).model
    name = castle.paths[LEFT_OUT].name
    i, j = placed.names.index(name), whole.names.index(name)
    if not bool(placed.registered[i]):
        print(f"{name} found no pose")
        return
    # Both in metres of the truth, the one on the other by the images that both were made of.
    metric = whole.transform(align_poses(whole.poses, true_poses(castle, whole.names), whole.registered))
    found = without_image(placed, i)
    moved = placed.transform(align_models(found, metric).similarity)
    gap = 1000 * float((moved.poses.centre[i] - metric.poses.centre[j]).norm())
    turn = float(rotation_angle(moved.poses.R[i] @ metric.poses.R[j].mT).rad2deg())
    seen = int((placed.view == i).sum())
    print(f"{name}: {gap:.1f} mm and {turn:.4f} deg from where the whole model has it, by {seen} points")


def without_image(model: Reconstruction, image: int) -> Reconstruction:
    """The model with one pose less."""
    registered = model.registered.clone()
    registered[image] = False
    return replace(model, registered=registered)


def pointing(fountain: PhotographSet, out: Path) -> None:
    """Points by the true poses beside those of free ones, in the same images with the same features."""
    free = model_of(fountain.paths, out / "free")
    posed = replace(free, cameras=true_camera(fountain), poses=true_poses(fountain, free.names))
    fixed = triangulate_photographs(fountain.paths, posed, out=out / "fixed", resume=True).model
    for name, model in (("free", free), ("fixed", fixed)):
        lengths = model.track_lengths().double().mean()
        print(f"fountain, {name} poses: {model.num_points} points, {float(lengths):.2f} images each, "
              f"{float(model.residuals().mean()):.3f} px mean, {float(model.residuals().median()):.3f} px median")  # fmt: skip


def filming(ring: PhotographSet, out: Path) -> None:
    """The views around an object as frames of a film, compressed as one, and the model that the film gives."""
    if not (out / "model.npz").exists():
        out.mkdir(parents=True, exist_ok=True)
        height, width = cv2.imread(str(ring.paths[0])).shape[:2]
        writer = cv2.VideoWriter(str(out / "film.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, (width, height))
        for path in ring.paths:
            writer.write(cv2.imread(str(path)))
        writer.release()
        command(out / "film.avi", "--fps", "10", "--out", out)
    model = Reconstruction.load(out / "model.npz")
    names = tuple(ring.paths[number].name for number in range(len(model.names)))
    print(describe("temple_ring, a film", model, true_poses(ring, names)))


def by_colmap(fountain: PhotographSet, out: Path) -> None:
    """The model that COLMAP's own features and matches give, read from its database."""
    try:
        import pycolmap
    except ImportError:
        print("pycolmap is not installed")
        return
    if not (out / "model.npz").exists():
        out.mkdir(parents=True, exist_ok=True)
        pycolmap.extract_features(out / "database.db", fountain.paths[0].parent, camera_mode=pycolmap.CameraMode.SINGLE)
        pycolmap.match_exhaustive(out / "database.db")
        command(out / "database.db", "--out", out)
    model = Reconstruction.load(out / "model.npz")
    print(describe("fountain-P11, COLMAP's database", model, true_poses(fountain, model.names)))
    try:
        import h5py
    except ImportError:
        print("h5py is not installed")
        return
    files = out / "features.h5", out / "matches.h5"
    if not files[1].exists():
        with pycolmap.Database.open(out / "database.db") as database, h5py.File(files[0], "w") as features:
            images = database.read_all_images()
            for image in images:
                camera = database.read_camera(image.camera_id)
                # hloc has the centre of the top-left pixel at (0, 0), COLMAP at (0.5, 0.5).
                features[f"{image.name}/keypoints"] = database.read_keypoints(image.image_id)[:, :2] - 0.5
                features[f"{image.name}/image_size"] = [camera.width, camera.height]
            with h5py.File(files[1], "w") as matches:
                for first, second in combinations(images, 2):
                    pairs = database.read_matches(first.image_id, second.image_id)
                    match = np.full(len(features[f"{first.name}/keypoints"]), -1, dtype=np.int16)
                    match[pairs[:, 0]] = pairs[:, 1]
                    group = f"{first.name}/{second.name}"
                    matches[f"{group}/matches0"] = match
                    matches[f"{group}/matching_scores0"] = (match >= 0).astype(np.float16)
    found = read_hloc(*files)
    result = reconstruct_matches(
        found.keypoints,
        found.pairs,
        found.matches,
        found.image_size,
        weights=found.weights,
        names=found.names,
        shared_camera=True,
    )
    print(describe("fountain-P11, hloc's two files", result.model, true_poses(fountain, result.model.names)))


def command(*words: object) -> None:
    """Run `torchsfm reconstruct`."""
    subprocess.run([sys.executable, "-m", "torchsfm", "reconstruct", *map(str, words)], check=True, stdout=subprocess.DEVNULL)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    data = data_folder()
    if data is None:
        parser.error("TORCHSFM_DATA names no folder with the photographs")
    with tempfile.TemporaryDirectory() as temporary:
        out = arguments.out or Path(temporary)
        castle, fountain = strecha(data, "castle-P19"), strecha(data, "fountain-P11")
        merging(castle, out / "castle")
        merging_structure(castle, out / "castle")
        placing(castle, out / "castle")
        pointing(fountain, out / "fountain")
        print(HEAD)
        filming(temple(data), out / "film")
        by_colmap(fountain, out / "database")


if __name__ == "__main__":
    main()
