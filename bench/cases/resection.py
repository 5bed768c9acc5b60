"""Cameras from known points."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bench.cases import scenes
from bench.cases.case import Case, Peer, Sample, pose_error
from bench.cases.scenes import F64
from torchsfm import (
    Solutions,
    Status,
    camera_1p2l,
    camera_2p1l,
    camera_3l,
    camera_circle,
    camera_conics,
    camera_dlt,
    camera_epnp,
    camera_gp3p,
    camera_p3p,
    camera_p4pf,
    camera_p35pf,
    camera_planar,
    camera_pnp,
    camera_up2p,
)
from torchsfm.geometry import Ellipse, conic_from_ellipse, pluecker_from_points, rotation_from_rotvec, transform_conic
from torchsfm.resection.camera_gp3p import equations as gp3p_equations
from torchsfm.resection.camera_p3p import equations as p3p_equations
from torchsfm.resection.camera_p4pf import equations as p4pf_equations
from torchsfm.resection.camera_p35pf import equations as p35pf_equations
from torchsfm.resection.camera_up2p import equations as up2p_equations


def rays_and_points(n: int) -> Callable[[str, int, torch.Generator, torch.dtype], tuple[Sample, Tensor]]:
    """Samples of n rays and the points they go to, and the pose."""

    def scene(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
        Y, X, P = scenes.camera(family, batch, n, generator)
        return (torch.nn.functional.normalize(Y, dim=-1).to(dtype), X.to(dtype)), P

    return scene


def sights(points: int) -> Callable[[str, int, torch.Generator, torch.dtype], tuple[Sample, Tensor]]:
    """Samples of three rays and planes of sight, and what they go to: so many points, and lines; and the pose."""

    def scene(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
        Y, X, P = scenes.camera(family, batch, 6, generator)
        l = torch.linalg.cross(Y[:, points:3], Y[:, points + 3 :])  # noqa: E741
        L = pluecker_from_points(X[:, points:3], X[:, points + 3 :])
        rays = torch.nn.functional.normalize(Y[:, :points], dim=-1)
        return tuple(v.to(dtype) for v in ((rays, X[:, :points]) if points else ()) + (l, L)), P

    return scene


def poselib_lines(name: str) -> Callable[[], Callable[..., Any]]:
    """PoseLib's solver for rays and points, image lines and lines by a point and a direction."""

    def make() -> Callable[..., Any]:
        import poselib

        def solve(*sample: Any) -> Any:
            *rest, l, L = sample  # noqa: E741
            length = np.linalg.norm(L[:, :3], axis=-1, keepdims=True)
            V = L[:, :3] / length
            l = l / np.linalg.norm(l, axis=-1, keepdims=True)  # noqa: E741
            return [pose.Rt for pose in getattr(poselib, name)(*rest, l, np.cross(V, L[:, 3:] / length), V)]

        return solve

    return make


def focal_points(n: int) -> Callable[[str, int, torch.Generator, torch.dtype], tuple[Sample, Tensor]]:
    """Samples of n points in an image of a focal length between 500 and 2000, and `diag(f, f, 1) [R | t]`."""

    def scene(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
        Y, X, P = scenes.camera(family, batch, n, generator)
        f = 500 * 4 ** scenes.uniform(generator, batch, 1, 1)
        x = f * Y[..., :2] / Y[..., 2:]
        return (x.to(dtype), X.to(dtype)), torch.cat((f, f, torch.ones_like(f)), 1) * P

    return scene


def rig_rays(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
    """Samples of three rays from centres about 1 from each other, and the pose of the rig."""
    Y, X, P = scenes.camera(family, batch, 3, generator)
    p = scenes.normal(generator, batch, 3, 3) * (0.01 if family == "small baseline" else 1)
    d = torch.nn.functional.normalize(Y - p, dim=-1)
    return (p.to(dtype), d.to(dtype), X.to(dtype)), P


def upright_rays(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
    """Samples of two rays and their points, with the vertical in the camera and in the world; and the pose."""
    Y, X, P = scenes.camera(family, batch, 3, generator)
    Y, X = Y[:, :2], X[:, :2]
    G = scenes.directions(generator, batch)
    g = (P[..., :3] @ G[..., None])[..., 0]
    d = torch.nn.functional.normalize(Y, dim=-1)
    return (d.to(dtype), X.to(dtype), g.to(dtype), G.to(dtype)), P


def plane_rays(n: int) -> Callable[[str, int, torch.Generator, torch.dtype], tuple[Sample, Tensor]]:
    """Samples of n rays and points of a plane, and the pose."""

    def scene(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
        Y, _, P = scenes.camera(family, batch, n, generator)
        normal = torch.tensor([0.3, -0.2, 1.0], dtype=scenes.F64)
        middle = Y.mean(1, keepdim=True)
        Y = Y * ((middle @ normal) / (Y @ normal))[..., None]
        X = (Y - P[:, None, :, 3]) @ P[..., :3]
        return (torch.nn.functional.normalize(Y, dim=-1).to(dtype), X.to(dtype)), P

    return scene


def camera_error(models: Tensor, truth: Tensor) -> Tensor:
    """The distance of cameras relative to the true one, whose third row has length 1."""
    truth = truth[:, None]
    return (models - truth).norm(dim=(-2, -1)) / truth.norm(dim=(-2, -1))


def solved(door: Callable[..., Any]) -> Callable[..., Solutions[Tensor]]:
    """A door that returns one model and a status, as a solver with one slot."""

    def solve(*sample: Tensor) -> Solutions[Tensor]:
        found = door(*sample)
        return Solutions(found.model.unsqueeze(-3), (found.status == Status.OK).unsqueeze(-1))

    return solve


def both_planar(d: Tensor, X: Tensor) -> Solutions[Tensor]:
    """Both poses of a plane."""
    found = camera_planar(d, X)
    return Solutions(found.model, found.valid)


def poselib_gp3p() -> Callable[..., Any]:
    import poselib

    return lambda p, d, X: [pose.Rt for pose in poselib.gp3p(p, d, X)]


def poselib_p4pf() -> Callable[..., Any]:
    import poselib

    def solve(x: Any, X: Any) -> Any:
        return [np.diag([f, f, 1]) @ pose.Rt for pose, f in zip(*poselib.p4pf(x, X, True), strict=True)]

    return solve


def poselib_up2p() -> Callable[..., Any]:
    import poselib

    def frame(v: Any) -> Any:
        """A rotation that takes v to PoseLib's vertical, the second axis."""
        v = v / np.linalg.norm(v)
        a = np.cross(v, np.eye(3)[np.abs(v).argmin()])
        a /= np.linalg.norm(a)
        return np.stack((a, v, np.cross(a, v)))

    def solve(d: Any, X: Any, g: Any, G: Any) -> Any:
        A, B = frame(g), frame(G)
        poses = poselib.up2p(np.ascontiguousarray(d @ A.T), np.ascontiguousarray(X @ B.T))
        return [A.T @ np.hstack((pose.R @ B, pose.t[:, None])) for pose in poses]

    return solve


def opencv_pnp(method: str) -> Callable[[], Callable[..., Any]]:
    """OpenCV's door with one of its methods."""

    def make() -> Callable[..., Any]:
        import cv2

        flag, eye = getattr(cv2, method), np.eye(3)

        def solve(d: Any, X: Any) -> Any:
            _, turns, shifts, _ = cv2.solvePnPGeneric(X, np.ascontiguousarray(d[:, :2] / d[:, 2:]), eye, None, flags=flag)
            return [np.hstack((cv2.Rodrigues(w)[0], t)) for w, t in zip(turns, shifts, strict=True)]

        return solve

    return make


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


def circle_rays(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
    """Samples of a circle's cone of rays and its radius; and [R | t] up to a turn about the axis."""
    turn = 0.9 * (2 * scenes.uniform(generator, batch, 3) - 1)
    R, t = (
        rotation_from_rotvec(turn),
        torch.cat((scenes.normal(generator, batch, 2), torch.full((batch, 1), 6.0, dtype=F64)), -1),
    )
    radius = 0.3 + scenes.uniform(generator, batch)
    H = torch.linalg.inv(torch.cat((R[..., :2], t[..., None]), -1))
    circle = torch.diag_embed(torch.stack((torch.ones_like(radius), torch.ones_like(radius), -radius.square()), -1))
    return ((H.mT @ circle @ H).to(dtype), radius.to(dtype)), torch.cat((R, t[..., None]), -1)


def circle_error(models: Tensor, truth: Tensor) -> Tensor:
    """The larger of the differences of the circle's normal, of either side, and of its centre relative to its distance."""
    n, centre = models[..., 2], models[..., 3]
    normal, place = truth[:, None, :, 2], truth[:, None, :, 3]
    turned = torch.minimum((n - normal).norm(dim=-1), (n + normal).norm(dim=-1))
    return torch.maximum(turned, (centre - place).norm(dim=-1) / place.norm(dim=-1))


def coplanar_conics(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
    """Samples of the images of two ellipses of the plane z = 0, seen from either side, and the ellipses; and the pose."""
    tilt, spin = 1.1 * scenes.uniform(generator, batch), 6.3 * scenes.uniform(generator, batch, 2)
    side = torch.pi * (scenes.uniform(generator, batch) < 0.5)
    zero = torch.zeros_like(tilt)
    turns = (
        (tilt * spin[:, 0].cos(), tilt * spin[:, 0].sin(), zero), (side, zero, zero), (zero, zero, spin[:, 1])
    )  # fmt: skip
    leant, flipped, spun = (rotation_from_rotvec(torch.stack(turn, -1)) for turn in turns)
    depth = torch.full((batch, 1), 40.0 if family == "narrow view" else 6.0, dtype=F64)
    P = torch.cat((leant @ flipped @ spun, torch.cat((scenes.normal(generator, batch, 2), depth), -1)[..., None]), -1)
    centre, axes = scenes.normal(generator, batch, 2, 2), 0.2 + 0.8 * scenes.uniform(generator, batch, 2, 2)
    axes = axes[..., :1].expand_as(axes) if family == "circles" else axes
    if family == "repeated conics":
        centre, axes = centre[:, :1].expand_as(centre), axes[:, :1].expand_as(axes)
    if family == "circles about one centre":
        centre, axes = centre[:, :1].expand_as(centre), axes[..., :1].expand_as(axes)
    angle = 3 * scenes.uniform(generator, batch, 1).expand(batch, 2)
    drawn = conic_from_ellipse(Ellipse(centre, axes, angle))
    return (transform_conic(P[:, None][..., [0, 1, 3]], drawn).to(dtype), drawn.to(dtype)), P


def all_conics(C: Tensor, C_plane: Tensor) -> Solutions[Tensor]:
    """All poses from coplanar conics."""
    found = camera_conics(C, C_plane)
    return Solutions(found.model, found.valid)


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
    ),
    *(
        Case(
            name,
            size=3,
            slots=slots,
            solve=solve,
            scene=sights(points),
            error=pose_error,
            families=("near planar", "coplanar", "narrow view", "90 degree rotation", "far points"),
            degenerate=("repeated points", "collinear", "all at infinity", "pure rotation", "zero baseline"),
            peers={"PoseLib": Peer("poselib", poselib_lines(peer))},
        )
        for name, solve, points, slots, peer in (
            ("camera_2p1l", camera_2p1l, 2, 2, "p2p1ll"),
            ("camera_1p2l", camera_1p2l, 1, 4, "p1p2ll"),
            ("camera_3l", camera_3l, 0, 8, "p3ll"),
        )
    ),
    Case(
        "camera_circle",
        size=1,
        slots=2,
        solve=camera_circle,
        scene=circle_rays,
        error=circle_error,
        families=(),
        degenerate=(),
    ),
    Case(
        "camera_up2p",
        size=2,
        slots=2,
        solve=camera_up2p,
        scene=upright_rays,
        error=pose_error,
        equations=up2p_equations,
        families=("narrow view", "90 degree rotation", "far points", "centre near the plane"),
        degenerate=("repeated points", "all at infinity", "pure rotation", "zero baseline"),
        peers={"PoseLib": Peer("poselib", poselib_up2p)},
    ),
    Case(
        "camera_p35pf",
        size=4,
        slots=10,
        solve=camera_p35pf,
        scene=focal_points(4),
        error=camera_error,
        equations=p35pf_equations,
        families=("near planar", "narrow view", "90 degree rotation", "centre near the plane"),
        degenerate=("repeated points", "collinear", "coplanar", "all at infinity", "pure rotation", "zero baseline"),
    ),
    Case(
        "camera_p4pf",
        size=4,
        slots=1,
        solve=camera_p4pf,
        scene=focal_points(4),
        error=camera_error,
        equations=p4pf_equations,
        families=("near planar", "narrow view", "90 degree rotation", "centre near the plane"),
        degenerate=("repeated points", "collinear", "coplanar", "all at infinity", "pure rotation", "zero baseline"),
        peers={"PoseLib": Peer("poselib", poselib_p4pf)},
    ),
    Case(
        "camera_gp3p",
        size=3,
        slots=8,
        solve=camera_gp3p,
        scene=rig_rays,
        error=pose_error,
        equations=gp3p_equations,
        families=("narrow view", "90 degree rotation", "far points", "sliver triangle", "small baseline"),
        degenerate=("repeated points", "collinear", "all at infinity", "pure rotation", "zero baseline"),
        peers={"PoseLib": Peer("poselib", poselib_gp3p)},
    ),
    Case(
        "camera_dlt",
        size=6,
        slots=1,
        solve=solved(camera_dlt),
        scene=focal_points(6),
        error=camera_error,
        families=("near planar", "narrow view", "90 degree rotation"),
        degenerate=("repeated points", "collinear", "coplanar", "all at infinity"),
    ),
    Case(
        "camera_pnp",
        size=6,
        slots=1,
        solve=solved(camera_pnp),
        scene=rays_and_points(6),
        error=pose_error,
        families=("near planar", "coplanar", "narrow view", "90 degree rotation", "centre near the plane"),
        degenerate=("repeated points", "collinear", "all at infinity", "pure rotation", "zero baseline"),
        peers={"OpenCV": Peer("cv2", opencv_pnp("SOLVEPNP_SQPNP"))},
    ),
    Case(
        "camera_epnp",
        size=6,
        slots=1,
        solve=solved(camera_epnp),
        scene=rays_and_points(6),
        error=pose_error,
        families=("near planar", "coplanar", "narrow view", "90 degree rotation", "centre near the plane"),
        degenerate=("repeated points", "collinear", "all at infinity", "pure rotation", "zero baseline"),
        peers={"OpenCV": Peer("cv2", opencv_pnp("SOLVEPNP_EPNP"))},
    ),
    Case(
        "camera_conics",
        size=2,
        slots=4,
        solve=all_conics,
        scene=coplanar_conics,
        error=pose_error,
        families=("narrow view", "circles"),
        degenerate=("repeated conics", "circles about one centre"),
    ),
    Case(
        "camera_planar",
        size=4,
        slots=2,
        solve=both_planar,
        scene=plane_rays(4),
        error=pose_error,
        families=("narrow view", "90 degree rotation"),
        degenerate=("repeated points", "collinear", "all at infinity", "pure rotation", "zero baseline"),
        peers={"OpenCV": Peer("cv2", opencv_pnp("SOLVEPNP_IPPE"))},
    ),
)
