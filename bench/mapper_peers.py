"""COLMAP's two mappers on verified pairs that this library found, for `bench.mappers`."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsfm.reconstruction.matching.view_graph import MIN_INLIERS, ViewGraph

HALF = 0.5
"""COLMAP puts the centre of the first pixel at (0.5, 0.5)."""
FLAT = 0.8
"""Of the inliers of a fundamental matrix: so many of a homography, and the pair is called planar or panoramic."""


def write_pairs(path: Path, graph: ViewGraph, focal: float | None, K: torch.Tensor | None) -> None:
    """A database with all image points, one camera, and the verified pairs with their matrices, as COLMAP verifies itself."""
    import pycolmap

    counts = torch.bincount(graph.view, minlength=len(graph.names))
    first = counts.cumsum(0) - counts
    width, height = graph.image_size[0].tolist()
    guess = focal or 1.2 * max(width, height)
    params = [guess, width / 2, height / 2, 0.0, 0.0]
    if K is not None:
        params = [float(v) for v in (K[0, 0], K[1, 1], K[0, 2] + HALF, K[1, 2] + HALF)]
    camera = pycolmap.Camera(model="RADIAL" if K is None else "PINHOLE", width=width, height=height, params=params)
    camera.has_prior_focal_length = focal is not None or K is not None
    related = torch.maximum(graph.fundamental_inliers, graph.homography_inliers) >= MIN_INLIERS
    shift = np.array([[1.0, 0, -HALF], [0, 1, -HALF], [0, 0, 1]])
    kinds = pycolmap.TwoViewGeometryConfiguration
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        number = database.write_camera(camera)
        ids = []
        for name, x in zip(graph.names, torch.split(graph.x, counts.tolist()), strict=True):
            ids.append(database.write_image(pycolmap.Image(name=name, camera_id=number)))
            database.write_keypoints(ids[-1], (x.numpy() + HALF).astype(np.float32))
        order = torch.argsort(graph.match_pair, stable=True)
        rows = torch.split(graph.match[order], torch.bincount(graph.match_pair, minlength=len(graph.pairs)).tolist())
        for q in related.nonzero()[:, 0].tolist():
            i, j = graph.pairs[q].tolist()
            matches = (rows[q] - torch.stack((first[i], first[j]))).numpy().astype(np.uint32)
            flat = int(graph.homography_inliers[q]) >= FLAT * int(graph.fundamental_inliers[q])
            seen = pycolmap.TwoViewGeometry()
            seen.config = kinds.PLANAR_OR_PANORAMIC if flat else kinds.UNCALIBRATED
            seen.F = shift.T @ graph.F[q].numpy() @ shift
            seen.H = np.linalg.inv(shift) @ graph.H[q].numpy() @ shift
            seen.inlier_matches = matches
            database.write_matches(ids[i], ids[j], matches)
            database.write_two_view_geometry(ids[i], ids[j], seen)


def run(database: Path, together: bool, known: bool, seed: int) -> Any:
    """The largest model that COLMAP makes of the database; None where it makes none.

    Args:
        database: What `write_pairs` wrote.
        together: By the global mapper, before which COLMAP finds unknown focal lengths, in place of the incremental one.
        known: The intrinsics are known.
        seed: Of its random numbers.
    """
    import pycolmap

    pycolmap.set_random_seed(seed)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    folder = database.parent
    out = folder / "colmap"
    out.mkdir(exist_ok=True)
    if together:
        if not known:
            pycolmap.calibrate_view_graph(database, pycolmap.ViewGraphCalibrationOptions(random_seed=seed))
        every = pycolmap.GlobalPipelineOptions(num_threads=1, random_seed=seed)
        every.mapper.bundle_adjustment.refine_focal_length = every.mapper.bundle_adjustment.refine_extra_params = not known
        models = pycolmap.global_mapping(database, folder, out, every)
    else:
        options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed, extract_colors=False)
        options.ba_refine_focal_length = options.ba_refine_extra_params = not known
        models = pycolmap.incremental_mapping(database, folder, out, options)
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)
