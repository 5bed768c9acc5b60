"""Two views."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from bench.cases import scenes
from bench.cases.case import Case, Peer, Sample, one_slot, pose_error, up_to_scale
from bench.cases.scenes import F64, K
from torchsfm import (
    Solutions,
    essential_5pt,
    essential_6pt,
    fundamental_7pt,
    fundamental_8pt,
    fundamental_affine_4pt,
    homography_4pt,
    homography_dlt,
    motions_from_homography,
    relative_6pt_focal,
    relative_known_rotation_2pt,
    relative_upright_3pt,
)
from torchsfm.geometry import cross_matrix
from torchsfm.motion.two_views.essential_5pt import equations as essential_equations
from torchsfm.motion.two_views.essential_6pt import equations as essential_6pt_equations
from torchsfm.motion.two_views.fundamental_7pt import equations as fundamental_equations
from torchsfm.motion.two_views.fundamental_affine_4pt import equations as affine_equations
from torchsfm.motion.two_views.homography_4pt import equations as homography_equations
from torchsfm.motion.two_views.relative_6pt_focal import equations as focal_equations
from torchsfm.motion.two_views.relative_upright_3pt import equations as upright_equations

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


def focal_points(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
    """Samples of six points in two images of one focal length between 0.5 and 2, and E and f as ten numbers."""
    X, R, t = scenes.views(family, batch, 6, generator)
    X2 = X @ R[:, 1].mT + t[:, 1, None]
    f = 0.5 * 4 ** scenes.uniform(generator, batch)
    x1, x2 = ((f[:, None, None] * Y[..., :2] / Y[..., 2:]).to(dtype) for Y in (X, X2))
    E = (cross_matrix(t[:, 1]) @ R[:, 1]).flatten(-2)
    return (x1, x2), torch.cat((E, f[:, None]), -1)


def focal_solve(x1: Tensor, x2: Tensor) -> Solutions[Tensor]:
    """E and f as ten numbers."""
    solutions = relative_6pt_focal(x1, x2)
    return Solutions(torch.cat((solutions.model.E.flatten(-2), solutions.model.f[..., None]), -1), solutions.valid)


def focal_error(models: Tensor, truth: Tensor) -> Tensor:
    """The larger of the distance of E and the relative one of f."""
    turned = up_to_scale(1)(models[..., :9], truth[..., :9])
    return torch.maximum(turned, (models[..., 9] / truth[:, None, 9] - 1).abs())


def known_rotation_rays(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
    """Samples of two rays in two cameras and their relative rotation; and [R | t] with |t| = 1."""
    X, R, t = scenes.views(family, batch, 2, generator)
    d1, d2 = (torch.nn.functional.normalize(Y, dim=-1) for Y in (X, X @ R[:, 1].mT + t[:, 1, None]))
    pose = torch.cat((R[:, 1], torch.nn.functional.normalize(t[:, 1], dim=-1)[..., None]), -1)
    return (d1.to(dtype), d2.to(dtype), R[:, 1].to(dtype)), pose


def upright_rays(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
    """Samples of three rays in two cameras and the vertical, which is the second axis of both; and [R | t] with |t| = 1."""
    X, R, t = scenes.views(family, batch, 3, generator)
    R, t = R[:, 1], t[:, 1]
    d1, d2 = (torch.nn.functional.normalize(Y, dim=-1) for Y in (X, X @ R.mT + t[:, None]))
    up = scenes.directions(generator, batch)
    A, B = upright_frame(up), upright_frame((R @ up[..., None])[..., 0])
    turned = torch.nn.functional.normalize((B @ t[..., None])[..., 0], dim=-1)
    vertical = torch.tensor([0.0, 1, 0], dtype=dtype).expand(batch, 3)
    sample = ((d1 @ A.mT).to(dtype), (d2 @ B.mT).to(dtype), vertical, vertical)
    return sample, torch.cat((B @ R @ A.mT, turned[..., None]), -1)


def upright_frame(up: Tensor) -> Tensor:
    """Rotations that turn a direction into the second axis."""
    side = torch.nn.functional.normalize(torch.linalg.cross(up, up.roll(1, -1) + 0.3), dim=-1)
    return torch.stack((side, up, torch.linalg.cross(side, up)), -2)


def affine_points(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
    """Samples of four points in two affine images, and F."""
    X, _, _ = scenes.views(family, batch, 4, generator)
    A = scenes.normal(generator, batch, 4, 3)
    z = X @ A.mT / X.abs().amax((-2, -1), keepdim=True)
    normal = torch.linalg.svd(A.mT)[2][..., 3, :]
    zero = torch.zeros(batch, dtype=F64)
    F = torch.stack((zero, zero, normal[:, 0], zero, zero, normal[:, 1], normal[:, 2], normal[:, 3], zero), -1)
    return (z[..., 2:].to(dtype), z[..., :2].to(dtype)), F.reshape(batch, 3, 3)


def plane_motions(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
    """Homographies between rays, and R, t and the normal as fifteen numbers."""
    _, R, t, plane = scenes.plane_views(family, batch, 4, generator)
    distance = plane.norm(dim=-1, keepdim=True)
    # The plane is in front on the optical axis.
    sign = torch.where(plane[:, 2:] < 0, -1.0, 1.0).to(F64)
    truth = torch.cat((R[:, 1].flatten(-2), sign * t[:, 1] * distance, sign * plane / distance), -1)
    return ((R[:, 1] + t[:, 1, :, None] * plane[:, None]).to(dtype),), truth


def plane_motions_solve(H: Tensor) -> Solutions[Tensor]:
    """R, t and the normal as fifteen numbers."""
    solutions = motions_from_homography(H)
    m = solutions.model
    return Solutions(torch.cat((m.R.flatten(-2), m.t, m.normal), -1), solutions.valid)


def poselib_upright() -> Callable[..., Any]:
    import numpy as np
    import poselib

    def solve(d1: Any, d2: Any, up1: Any, up2: Any) -> Any:
        return [np.column_stack((p.R, p.t / np.linalg.norm(p.t))) for p in poselib.relpose_upright_3pt(d1, d2)]

    return solve


def poselib_focal() -> Callable[..., Any]:
    import numpy as np
    import poselib

    def solve(x1: Any, x2: Any) -> Any:
        h1, h2 = np.ones((6, 3)), np.ones((6, 3))
        h1[:, :2], h2[:, :2] = x1, x2
        models = []
        for pair in poselib.shared_focal_relpose_6pt(h1, h2):
            x, y, z = pair.pose.t
            E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ pair.pose.R
            models.append(np.append(E, pair.camera1.focal()))
        return models

    return solve


def poselib_motions() -> Callable[..., Any]:
    import numpy as np
    import poselib

    def solve(H: Any) -> Any:
        poses, normals = poselib.motion_from_homography(H)
        return [np.concatenate((p.R.ravel(), p.t, n)) for p, n in zip(poses, np.asarray(normals).reshape(-1, 3), strict=True)]

    return solve


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
    Case(
        "essential_6pt",
        size=6,
        slots=1,
        solve=essential_6pt,
        scene=rays(6),
        error=up_to_scale(),
        equations=essential_6pt_equations,
        families=scenes.HARD,
    ),
    Case(
        "relative_6pt_focal",
        size=6,
        slots=15,
        solve=focal_solve,
        scene=focal_points,
        error=focal_error,
        equations=focal_equations,
        # Turning about the optical axis is critical; forward motion, here turning by about 2 degrees, nearly so.
        families=tuple(f for f in scenes.HARD if f != "90 degree rotation"),
        peers={"PoseLib": Peer("poselib", poselib_focal)},
    ),
    Case(
        "relative_upright_3pt",
        size=3,
        slots=4,
        solve=relative_upright_3pt,
        scene=upright_rays,
        error=pose_error,
        equations=upright_equations,
        families=scenes.HARD,
        peers={"PoseLib": Peer("poselib", poselib_upright)},
    ),
    Case(
        "relative_known_rotation_2pt",
        size=2,
        slots=1,
        solve=relative_known_rotation_2pt,
        scene=known_rotation_rays,
        error=pose_error,
        families=scenes.HARD,
    ),
    Case(
        "fundamental_affine_4pt",
        size=4,
        slots=1,
        solve=fundamental_affine_4pt,
        scene=affine_points,
        error=up_to_scale(),
        equations=affine_equations,
        families=("near planar",),
        degenerate=("repeated points", "collinear", "coplanar"),
    ),
    Case(
        "motions_from_homography",
        size=1,
        slots=2,
        solve=plane_motions_solve,
        scene=plane_motions,
        error=lambda models, truth: (models - truth[:, None]).norm(dim=-1),
        # Turned by 90 degrees, some cameras see the plane from behind.
        families=("narrow view", "forward", "small baseline"),
        degenerate=("pure rotation",),
        peers={"PoseLib": Peer("poselib", poselib_motions)},
    ),
)
