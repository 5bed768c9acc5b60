"""Other programs' robust estimators, one pair at a time: `peer(model, a, b, K, threshold)` with NumPy arrays.

For F, H and E, `a` and `b` are points of the two images in pixels; for P, `a` are points of the world and `b` their images.
Models come as 3 x 3 or 3 x 4 arrays, None where a program found nothing. All are asked for the same confidence.
"""

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch

Array = np.ndarray
CONFIDENCE = 0.9999
MOST = 100_000


def poselib_default(model: str, a: Array, b: Array, K: Array, threshold: float) -> Array | None:
    """PoseLib as it comes: at least 1,000 samples, and three times as many as the confidence asks for."""
    return _poselib(model, a, b, K, threshold, {})


def poselib_one(model: str, a: Array, b: Array, K: Array, threshold: float) -> Array | None:
    """PoseLib with no more samples than the confidence asks for."""
    return _poselib(model, a, b, K, threshold, {"min_iterations": 100, "dyn_num_trials_mult": 1.0})


def _poselib(model: str, a: Array, b: Array, K: Array, threshold: float, extra: dict[str, Any]) -> Array | None:
    import poselib as pl

    options = {
        "max_epipolar_error": threshold, "max_reproj_error": threshold, "success_prob": CONFIDENCE,
        "max_iterations": MOST, **extra,
    }  # fmt: skip
    parameters = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    camera = {"model": "PINHOLE", "width": int(2 * K[0, 2]), "height": int(2 * K[1, 2]), "params": parameters}
    if model == "F":
        return np.asarray(pl.estimate_fundamental(a, b, options, {})[0])
    if model == "H":
        return np.asarray(pl.estimate_homography(a, b, options, {})[0])
    if model == "P":
        return np.asarray(pl.estimate_absolute_pose(b, a, camera, options, {})[0].Rt)
    pose = pl.estimate_relative_pose(a, b, camera, camera, options, {})[0]
    length = np.linalg.norm(pose.t)
    return None if length == 0 else np.cross(np.eye(3), pose.t / length).T @ pose.R


def opencv_magsac(model: str, a: Array, b: Array, K: Array, threshold: float) -> Array | None:
    """OpenCV's USAC_MAGSAC; for P its RANSAC over AP3P."""
    import cv2

    if model == "F":
        found = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, threshold, CONFIDENCE, MOST)[0]
    elif model == "H":
        found = cv2.findHomography(a, b, cv2.USAC_MAGSAC, threshold, maxIters=MOST, confidence=CONFIDENCE)[0]
    elif model == "P":
        options = {
            "iterationsCount": MOST, "reprojectionError": threshold, "confidence": CONFIDENCE, "flags": cv2.SOLVEPNP_AP3P,
        }  # fmt: skip
        good, r, t, _ = cv2.solvePnPRansac(a, b, K, None, **options)
        found = np.concatenate((cv2.Rodrigues(r)[0], t), 1) if good else None
    else:
        found = cv2.findEssentialMat(a, b, K, cv2.USAC_MAGSAC, CONFIDENCE, threshold, MOST)[0]
    return None if found is None else found[:3]


def pycolmap_loransac(model: str, a: Array, b: Array, K: Array, threshold: float) -> Array | None:
    """COLMAP's LO-RANSAC, with no more samples than the confidence asks for."""
    import pycolmap

    options = pycolmap.RANSACOptions()
    options.max_error, options.confidence, options.max_num_trials = threshold, CONFIDENCE, MOST
    options.min_num_trials, options.dyn_num_trials_multiplier, options.random_seed = 100, 1.0, 0
    camera = pycolmap.Camera(
        model="PINHOLE", width=int(2 * K[0, 2]), height=int(2 * K[1, 2]), params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    )
    if model == "F":
        found = pycolmap.estimate_fundamental_matrix(a, b, options)
        return None if found is None else found["F"]
    if model == "H":
        found = pycolmap.estimate_homography_matrix(a, b, options)
        return None if found is None else found["H"]
    if model == "E":
        found = pycolmap.estimate_essential_matrix(a, b, camera, camera, options)
        return None if found is None else found["E"]
    absolute = pycolmap.AbsolutePoseEstimationOptions()
    absolute.ransac = options
    found = pycolmap.estimate_and_refine_absolute_pose(b, a, camera, absolute)
    return None if found is None else found["cam_from_world"].matrix()


def kornia_ransac(model: str, a: Array, b: Array, K: Array, threshold: float) -> Array | None:
    """Kornia's batched RANSAC, F and H alone."""
    from kornia.geometry.ransac import RANSAC

    if model not in "FH":
        return None
    engine = RANSAC(
        {"F": "fundamental", "H": "homography"}[model], inl_th=threshold, max_iter=50, confidence=CONFIDENCE, seed=0
    )
    found, _ = engine(torch.from_numpy(a).float(), torch.from_numpy(b).float())
    return found.double().numpy()


def fastpose_ransac(model: str, a: Array, b: Array, K: Array, threshold: float) -> Array | None:
    """Fastpose's LO-RANSAC compiled by numba, with no more samples than the confidence asks for."""
    from fastpose import estimators

    options = {"iterations": MOST, "min_iterations": 100, "success_prob": CONFIDENCE, "max_error": threshold, "seed": 0}
    if model == "F":
        found, info = estimators.estimate_fundamental(a, b, **options)
        return found["F"] if info["num_inliers"] else None
    if model == "H":
        found, info = estimators.estimate_homography(a, b, **options)
        return found["H"] if info["num_inliers"] else None
    if model == "P":
        found, info = estimators.estimate_absolute_pose(b, a, camera=K, **options)
        return np.column_stack((found["R"], found["t"])) if info["num_inliers"] else None
    found, info = estimators.estimate_relative_pose(a, b, camera1=K, camera2=K, **options)
    t = np.ravel(found["t"])
    length = np.linalg.norm(t)
    return np.cross(np.eye(3), t / length).T @ found["R"] if info["num_inliers"] and length > 0 else None


PEERS: dict[str, Callable[[str, Array, Array, Array, float], Array | None]] = {
    "PoseLib": poselib_default,
    "PL1": poselib_one,
    "MAGSAC": opencv_magsac,
    "pycolmap": pycolmap_loransac,
    "kornia": kornia_ransac,
    "fastpose": fastpose_ransac,
}
MODULES = {"PoseLib": "poselib", "PL1": "poselib", "MAGSAC": "cv2"}
"""What each is imported as, where it is not its own name."""


def installed(names: str) -> list[str]:
    """Those of some peers, separated by commas, that can be run here."""
    return [name for name in filter(None, names.split(",")) if find_spec(MODULES.get(name, name)) is not None]


def answer(name: str, model: str, a: Array, b: Array, K: Array, threshold: float) -> Array:
    """What a peer found, zeros where it found nothing."""
    found = PEERS[name](model, np.ascontiguousarray(a), np.ascontiguousarray(b), K, threshold)
    return np.zeros((3, 4) if model == "P" else (3, 3)) if found is None else np.asarray(found, dtype=np.float64)
