"""Two views."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from bench.cases import scenes
from bench.cases.case import Case, Peer, Sample, one_slot, up_to_scale
from bench.cases.scenes import F64, K
from torchsfm import essential_5pt, fundamental_7pt, fundamental_8pt, homography_4pt, homography_dlt
from torchsfm.geometry import cross_matrix
from torchsfm.motion.essential_5pt import equations as essential_equations
from torchsfm.motion.fundamental_7pt import equations as fundamental_equations
from torchsfm.motion.homography_4pt import equations as homography_equations

Scene = Callable[[str, int, torch.Generator, torch.dtype], tuple[Sample, Tensor]]


def rays(n: int) -> Scene:
    """Samples of n rays in two cameras, and E."""

    def scene(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
        X, R, t = scenes.views(family, batch, n, generator)
        X2 = X @ R[:, 1].mT + t[:, 1, None]
        d1, d2 = (torch.nn.functional.normalize(Y, dim=-1).to(dtype) for Y in (X, X2))
        return (d1, d2), cross_matrix(t[:, 1]) @ R[:, 1]

    return scene


def image_points(n: int) -> Scene:
    """Samples of n points in two images, and F."""

    def scene(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
        X, R, t = scenes.views(family, batch, n, generator)
        X2 = X @ R[:, 1].mT + t[:, 1, None]
        inverse = torch.linalg.inv(K)
        F = inverse.mT @ cross_matrix(t[:, 1]) @ R[:, 1] @ inverse
        return (scenes.pixels(X).to(dtype), scenes.pixels(X2).to(dtype)), F

    return scene


def plane_points(n: int) -> Scene:
    """Samples of n points of a plane in two images, and H."""

    def scene(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
        X, R, t, plane = scenes.plane_views(family, batch, n, generator)
        X2 = X @ R[:, 1].mT + t[:, 1, None]
        H = K @ (R[:, 1] + t[:, 1, :, None] * plane[:, None]) @ torch.linalg.inv(K)
        return (scenes.pixels(X).to(dtype), scenes.pixels(X2).to(dtype)), H

    return scene


def poselib_5pt() -> Callable[..., Any]:
    import poselib

    return poselib.essential_matrix_5pt


def opencv_7pt() -> Callable[..., Any]:
    import cv2

    cv2.setNumThreads(1)

    def solve(x1: Any, x2: Any) -> Any:
        F = cv2.findFundamentalMat(x1, x2, cv2.FM_7POINT)[0]
        return [] if F is None else F.reshape(-1, 3, 3)

    return solve


def opencv_5pt() -> Callable[..., Any]:
    import cv2

    cv2.setNumThreads(1)
    eye = torch.eye(3, dtype=F64).numpy()

    def solve(d1: Any, d2: Any) -> Any:
        # With five points every round of its RANSAC is the same solve; it returns all solutions.
        E = cv2.findEssentialMat(d1[:, :2] / d1[:, 2:], d2[:, :2] / d2[:, 2:], eye, cv2.RANSAC, 0.999, 1e-3)[0]
        return [] if E is None else E.reshape(-1, 3, 3)

    return solve


def opencv_4pt() -> Callable[..., Any]:
    import cv2

    cv2.setNumThreads(1)
    return lambda x1, x2: [cv2.getPerspectiveTransform(x1.astype("float32"), x2.astype("float32"))]


def kornia_5pt() -> Callable[..., Any]:
    from kornia.geometry.epipolar import find_essential

    return lambda d1, d2: find_essential(d1[..., :2] / d1[..., 2:], d2[..., :2] / d2[..., 2:])


def kornia_7pt() -> Callable[..., Any]:
    from kornia.geometry.epipolar import find_fundamental

    return lambda x1, x2: find_fundamental(x1, x2, method="7POINT")


def kornia_8pt() -> Callable[..., Any]:
    from kornia.geometry.epipolar import find_fundamental

    return lambda x1, x2: find_fundamental(x1, x2, method="8POINT")[:, None]


def kornia_homography() -> Callable[..., Any]:
    from kornia.geometry.homography import find_homography_dlt

    return lambda x1, x2: find_homography_dlt(x1, x2)[:, None]


PLANE = ("narrow view", "forward", "small baseline", "90 degree rotation", "far points", "near collinear")

CASES: tuple[Case, ...] = (
    Case(
        "essential_5pt",
        size=5,
        slots=10,
        solve=essential_5pt,
        scene=rays(5),
        error=up_to_scale(),
        equations=essential_equations,
        families=scenes.HARD,
        peers={
            "PoseLib": Peer("poselib", poselib_5pt),
            "OpenCV": Peer("cv2", opencv_5pt),
            "kornia": Peer("kornia", kornia_5pt, batched=True),
        },
        wanted=0.999,
        published=0.20e6,
    ),
    Case(
        "fundamental_7pt",
        size=7,
        slots=3,
        solve=fundamental_7pt,
        scene=image_points(7),
        error=up_to_scale(),
        equations=fundamental_equations,
        families=scenes.HARD,
        peers={
            "OpenCV": Peer("cv2", opencv_7pt),
            "kornia": Peer("kornia", kornia_7pt, batched=True),
        },
        published=0.68e6,
    ),
    Case(
        "homography_4pt",
        size=4,
        slots=1,
        solve=homography_4pt,
        scene=plane_points(4),
        error=up_to_scale(),
        equations=homography_equations,
        families=PLANE,
        peers={
            "OpenCV": Peer("cv2", opencv_4pt),
            "kornia": Peer("kornia", kornia_homography, batched=True),
        },
        published=23.2e6,
    ),
    Case(
        "fundamental_8pt",
        size=8,
        slots=1,
        solve=one_slot(fundamental_8pt),
        masked=False,
        scene=image_points(8),
        error=up_to_scale(),
        families=scenes.HARD,
        peers={"kornia": Peer("kornia", kornia_8pt, batched=True)},
    ),
    Case(
        "homography_dlt",
        size=8,
        slots=1,
        solve=one_slot(homography_dlt),
        masked=False,
        scene=plane_points(8),
        error=up_to_scale(),
        families=PLANE,
        peers={"kornia": Peer("kornia", kornia_homography, batched=True)},
    ),
)
