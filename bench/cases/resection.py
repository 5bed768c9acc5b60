"""Cameras from known points."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bench.cases import scenes
from bench.cases.case import Case, Peer, Sample, pose_error
from torchsfm import camera_p3p
from torchsfm.resection.camera_p3p import equations as p3p_equations


def rays_and_points(n: int) -> Callable[[str, int, torch.Generator, torch.dtype], tuple[Sample, Tensor]]:
    """Samples of n rays and the points they go to, and the pose."""

    def scene(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
        Y, X, P = scenes.camera(family, batch, n, generator)
        return (torch.nn.functional.normalize(Y, dim=-1).to(dtype), X.to(dtype)), P

    return scene


def poselib_p3p() -> Callable[..., Any]:
    import poselib

    return lambda d, X: [pose.Rt for pose in poselib.p3p(d, X)]


def opencv_p3p() -> Callable[..., Any]:
    import cv2

    eye, nothing = np.eye(3), np.zeros(4)

    def solve(d: Any, X: Any) -> Any:
        _, turns, shifts = cv2.solveP3P(X, d[:, :2] / d[:, 2:], eye, nothing, cv2.SOLVEPNP_AP3P)
        return [np.hstack((cv2.Rodrigues(w)[0], t)) for w, t in zip(turns, shifts, strict=True)]

    return solve


CASES: tuple[Case, ...] = (
    Case(
        "camera_p3p",
        size=3,
        slots=4,
        solve=camera_p3p,
        scene=rays_and_points(3),
        error=pose_error,
        equations=p3p_equations,
        families=("narrow view", "90 degree rotation", "far points", "sliver triangle", "centre near the plane"),
        degenerate=("repeated points", "collinear", "all at infinity", "pure rotation", "zero baseline"),
        peers={"PoseLib": Peer("poselib", poselib_p3p), "OpenCV": Peer("cv2", opencv_p3p)},
        published=4.5e6,
        compiled=True,
    ),
)
