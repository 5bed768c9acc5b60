"""Whether what is called good is supported by the data it was made for, by formulas that are not the library's inner ones.

A robust model's inliers must be within its threshold, and more than a sample has. A minimal solver's model must meet its
sample: each equation to a small part of the product of the lengths in it, so that no scale of anything matters.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from bench.fuzz.promises import tensors
from torchsfm._types import tensor_map
from torchsfm.geometry import (
    cross_matrix,
    point_line_distance,
    project_lines,
    reprojection_distance,
    sampson_distance,
    to_homogeneous,
)
from torchsfm.motion import HomographyEstimator, TrifocalEstimator
from torchsfm.motion.three_views.line_reprojection import squared_line_distance

Arguments = Mapping[str, Any]
Judge = Callable[[Any, Arguments], Iterator[str]]
"""Of a result and the arguments, in float64, that it was made of: what is wrong with it."""
Distance = Callable[[Tensor, Arguments], Tensor]
"""Of a model and the arguments: the distances of all data, in the unit of the threshold."""

Equation = Callable[[Any, Arguments], Tensor]
"""Of models in slots after the batch and the sample: what each equation leaves, without unit; a datum in a place."""

_SLACK = 1.01
"""Models in single precision have their inliers a little farther away than the threshold."""
_ROUNDED = 1e-5
"""How far, relative to the size of a datum, rounding the entries of a model to single precision moves it."""
_ARRIVED = 30
"""Steps to the nearest line, also where they are short."""
_MET = {torch.float64: 1e-5, torch.float32: 1e-2}
"""What may be left of an equation."""


def robust(distance: Distance, sample_size: int) -> Judge:
    """Models called good and determined whose inliers are farther away than the threshold, or are no more than a sample."""

    def judge(result: Any, a: Arguments) -> Iterator[str]:
        good = (result.status == 0) & (result.degeneracy == 0)
        if not bool(good.any()):
            return
        measured = distance(result.model.double(), a)
        limit = _SLACK * result.threshold.double()[..., None]
        if result.model.dtype == torch.float32:
            limit = limit + _ROUNDED * _sizes(a, result.inliers)
        far = result.inliers & ~(measured <= limit)
        if bool(far[good].any()):
            yield f"unsupported model: inliers up to {float(measured[good & far.any(-1)].max()):.1e} away"
        if bool((result.inliers.sum(-1)[good] <= sample_size).any()):
            yield "unsupported model: called good with hardly an inlier"

    return judge


def _sizes(a: Arguments, inliers: Tensor) -> Tensor:
    """The largest coordinate of each datum."""
    data = [v for v in a.values() if isinstance(v, Tensor) and v.is_floating_point() and v.shape[:-1] == inliers.shape]
    if a.get("l") is not None and "X" not in a:
        # Of all views together.
        data = [torch.cat((a["x"].abs().amax((-3, -1)), a["l"].abs().amax((-4, -2, -1))), -1)[..., None]]
    elif a.get("l") is not None:
        parts = [[a["x"], a["X"]], [a["l"].flatten(-2), a["L"]]]
        data = [torch.cat([torch.cat(part, -1).abs().amax(-1) for part in parts], -1)[..., None]]
    return torch.cat(data, -1).abs().amax(-1) if data else torch.zeros_like(inliers, dtype=torch.float64)


def structures(distance: Distance, sample_size: int) -> Judge:
    """Structures most of whose members are farther away than the threshold, or that are no more than a sample."""

    def judge(result: Any, a: Arguments) -> Iterator[str]:
        for slot in range(result.valid.shape[-1]):
            measured = distance(result.model[..., slot, :, :].double(), a)
            member = (result.label == slot) & result.valid[..., slot, None]
            near = (member & (measured <= _SLACK * a["threshold"])).sum(-1)
            if bool((2 * near < member.sum(-1)).any()):
                yield "unsupported structure: most of its members are far away"
            if bool((result.valid[..., slot] & (member.sum(-1) <= sample_size)).any()):
                yield "unsupported structure: hardly a member"

    return judge


def triangulated(result: Any, a: Arguments) -> Iterator[str]:
    """Robust points whose inliers do not see them where they are."""
    distance = reprojection_distance(a["P"], result.model.double()[..., None, :, :], a["x"])
    far = (result.inliers & ~(distance <= _SLACK * a["threshold"])) & (result.status == 0)[..., None, :]
    if bool(far.any()):
        yield f"unsupported point: inliers up to {float(distance[far].max()):.1e} away"
    if bool(((result.status == 0) & (result.inliers.sum(-2) < 2)).any()):
        yield "unsupported point: called good with hardly an inlier"


def triangulated_lines(result: Any, a: Arguments) -> Iterator[str]:
    """Robust lines whose inliers do not see them where they are."""
    image = project_lines(a["P"], result.model.double()[..., None, :, :])
    distance = point_line_distance(a["l"], image[..., None, :]).norm(dim=-1)
    far = (result.inliers & ~(distance <= _SLACK * a["threshold"])) & (result.status == 0)[..., None, :]
    if bool(far.any()):
        yield f"unsupported line: inliers up to {float(distance[far].max()):.1e} away"
    if bool(((result.status == 0) & (result.inliers.sum(-2) < 2)).any()):
        yield "unsupported line: called good with hardly an inlier"


def solutions(*equations: Equation) -> Judge:
    """Models of a minimal solver, each in a slot after the batch, that do not meet their sample."""

    def judge(result: Any, a: Arguments) -> Iterator[str]:
        valid = result.valid
        met = _MET[next(t.dtype for _, t in tensors(result.model))]
        model = tensor_map(lambda t: t.double(), result.model)
        for equation in equations:
            left = equation(model, a).nan_to_num(torch.inf).flatten(valid.ndim).amax(-1)
            wrong = valid & ~(left < met)
            if bool(wrong.any()):
                yield f"unsolved: {equation.__name__} is left by {float(left[wrong].max()):.1e}"

    return judge


def _sampson(F: Tensor, a: Arguments) -> Tensor:
    return sampson_distance(F, a["x1"], a["x2"])


def _sampson_on_the_sphere(E: Tensor, a: Arguments) -> Tensor:
    """|e| over the length of its gradient along both spheres, e = d2' E d1 with unit rays."""
    d1, d2 = (_unit(a[name]) for name in ("d1", "d2"))
    l2, l1 = d1 @ E.mT, d2 @ E
    e = (d2 * l2).sum(-1)
    slope = (l1.square().sum(-1) + l2.square().sum(-1) - 2 * e.square()).clamp_min(0).sqrt()
    return e.abs() / slope


def _sampson_of_pose(pose: Tensor, a: Arguments) -> Tensor:
    return _sampson_on_the_sphere(_essential(pose), a)


def _sampson_of_homography(H: Tensor, a: Arguments) -> Tensor:
    return HomographyEstimator().squared_residual(H, a["x1"], a["x2"]).sqrt()


def _three_views(P: Tensor, a: Arguments) -> Tensor:
    """Whatever the signs of the cameras, which the frame of `canonical_cameras` does not keep."""
    signs = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]], dtype=P.dtype)[..., None, None]
    x = [v[..., None, :, :] for v in a["x"].unbind(-3)]
    squared = TrifocalEstimator().squared_residual(signs * P[..., None, 1:, :, :], *x).amin(-2)
    if a.get("l") is not None:
        ends = [list(v.flatten(-2).unbind(-1)) for v in a["l"].unbind(-4)]
        squared = torch.cat((squared, squared_line_distance(P[..., 1:, :, :], ends, _ARRIVED)), -1)
    return squared.sqrt()


def _projections(P: Tensor, a: Arguments) -> Tensor:
    return reprojection_distance(P, a["X"], a["x"])


def _projections_with_intrinsics(P: Tensor, a: Arguments) -> Tensor:
    distance = reprojection_distance(a["K"] @ P, a["X"], a["x"])
    if a.get("l") is not None:
        away = point_line_distance(a["l"], project_lines(a["K"] @ P, a["L"])[..., None, :])
        distance = torch.cat((distance, away.norm(dim=-1)), -1)
    # What else stands in the last row of K than (0, 0, 1) is not looked at.
    proper = (a["K"][..., 2, :] == torch.tensor([0.0, 0.0, 1.0], dtype=P.dtype)).all(-1)
    return torch.where(proper[..., None], distance, 0.0)


def _unit(v: Tensor) -> Tensor:
    """Vectors along the last dimension of length 1, whatever their size."""
    size = v.abs().amax(-1, keepdim=True)
    v = v / torch.where((size > 0) & (size < torch.inf), size, 1)
    return v / v.norm(dim=-1, keepdim=True).clamp_min(1e-300)


def _essential(pose: Tensor) -> Tensor:
    return cross_matrix(pose[..., 3]) @ pose[..., :3]


def _bilinear(M: Tensor, h1: Tensor, h2: Tensor) -> Tensor:
    """h2' M h1 of unit vectors, for models in slots and a sample."""
    M = _unit(M.flatten(-2)).reshape(M.shape)[..., None, :, :]
    return (_unit(h2)[..., None, :] @ M @ _unit(h1)[..., :, None])[..., 0, 0].abs()


def _across(h: Tensor, y: Tensor, size: Tensor) -> Tensor:
    """|h x y| for a unit h and a sum y of what has this size."""
    return torch.linalg.cross(_unit(h), y).norm(dim=-1) / size


def _seen(P: Tensor, X: Tensor, h: Tensor, origin: Tensor | None = None) -> Tensor:
    """How far rays h from an origin miss `P (X, 1)`."""
    M, t, X = P[..., None, :, :3], P[..., None, :, 3], X[..., None, :, :]
    t = t if origin is None else t - origin[..., None, :, :]
    unit = torch.maximum(X.abs().amax((-2, -1), keepdim=True), t.abs().amax((-2, -1), keepdim=True)).clamp_min(1e-300)
    X, t = X / unit, t / unit
    y = (M @ X[..., None])[..., 0]
    return _across(h[..., None, :, :], y + t, M.norm(dim=(-2, -1)) * X.norm(dim=-1) + t.norm(dim=-1))


def fundamental(F: Tensor, a: Arguments) -> Tensor:
    """x2' F x1 = 0."""
    return _bilinear(F, *(to_homogeneous(a[x])[..., None, :, :] for x in ("x1", "x2")))


def essential(E: Tensor, a: Arguments) -> Tensor:
    """d2' E d1 = 0."""
    return _bilinear(E, *(a[d][..., None, :, :] for d in ("d1", "d2")))


def focal_motion(model: Any, a: Arguments) -> Tensor:
    """d2' E d1 = 0 for rays (x, f)."""
    f = model.f[..., None, None].expand(*model.f.shape, 6, 1)
    return _bilinear(model.E, *(torch.cat((a[x][..., None, :, :].expand(*f.shape[:-1], 2), f), -1) for x in ("x1", "x2")))


def singular_values(E: Tensor, _: Arguments) -> Tensor:
    """Of an essential matrix they are (1, 1, 0)."""
    return (torch.linalg.svdvals(E) - torch.tensor([1.0, 1.0, 0.0], dtype=E.dtype)).abs()


def relative_pose(pose: Tensor, a: Arguments) -> Tensor:
    """d2, t and R d1 are in a plane."""
    turned = (pose[..., None, :, :3] @ _unit(a["d1"])[..., None, :, :, None])[..., 0]
    size = torch.linalg.matrix_norm(pose[..., :3])[..., None]
    normal = torch.linalg.cross(_unit(pose[..., 3])[..., None, :].expand_as(turned), turned)
    return (normal * _unit(a["d2"])[..., None, :, :]).sum(-1).abs() / size


def rotation(pose: Tensor, _: Arguments) -> Tensor:
    """R'R = I."""
    R = pose[..., :3]
    return R.mT @ R - torch.eye(3, dtype=R.dtype)


def homography(H: Tensor, a: Arguments) -> Tensor:
    """x2 ~ H x1."""
    h1, h2 = (_unit(to_homogeneous(a[x]))[..., None, :, :] for x in ("x1", "x2"))
    y = h1 @ H.mT
    return _across(h2, y, torch.linalg.matrix_norm(H)[..., None])


def pose_sees_rays(pose: Tensor, a: Arguments) -> Tensor:
    """R X + t along d, from p where there is one."""
    return _seen(pose, a["X"], a["d"], a.get("p"))


def pose_sees_lines(pose: Tensor, a: Arguments) -> Tensor:
    """The direction R d, and the moment R m + t x R d, of each line: the latter along l, the former across it."""
    R, t = pose[..., None, :, :3], pose[..., None, :, 3]
    d, m = _unit(a["L"][..., :3]), a["L"][..., 3:] / a["L"][..., :3].norm(dim=-1, keepdim=True).clamp_min(1e-300)
    turned = (R @ d[..., None, :, :, None])[..., 0]
    l = _unit(a["l"])[..., None, :, :]  # noqa: E741
    moment = (R @ m[..., None, :, :, None])[..., 0] + torch.linalg.cross(t.expand_as(turned), turned)
    size = m.norm(dim=-1)[..., None, :] + t.norm(dim=-1)
    return torch.stack(((turned * l).sum(-1).abs(), torch.linalg.cross(l.expand_as(moment), moment).norm(dim=-1) / size), -1)


def vertical(pose: Tensor, a: Arguments) -> Tensor:
    """R G along g."""
    world, camera = (a["G"], a["g"]) if "G" in a else (a["gravity1"], a["gravity2"])
    y = (pose[..., :3] @ _unit(world)[..., None, :, None])[..., 0]
    return _across(camera[..., None, :], y, torch.ones_like(y[..., 0]))[..., None]


JUDGES: dict[str, Judge] = {
    "motion.essential_5pt": solutions(essential, singular_values),
    "motion.essential_6pt": solutions(singular_values),
    "motion.estimate_essential": robust(_sampson_on_the_sphere, 5),
    "motion.estimate_fundamental": robust(_sampson, 7),
    "motion.estimate_fundamentals": structures(_sampson, 7),
    "motion.estimate_homographies": structures(_sampson_of_homography, 4),
    "motion.estimate_homography": robust(_sampson_of_homography, 4),
    "motion.estimate_trifocal": robust(_three_views, 6),
    "motion.estimate_upright": robust(_sampson_of_pose, 3),
    "motion.fundamental_7pt": solutions(fundamental),
    "motion.homography_4pt": solutions(homography),
    "motion.relative_6pt_focal": solutions(focal_motion),
    "motion.relative_known_rotation_2pt": solutions(relative_pose),
    "motion.relative_upright_3pt": solutions(relative_pose, rotation, vertical),
    "resection.camera_1p2l": solutions(pose_sees_rays, pose_sees_lines, rotation),
    "resection.camera_2p1l": solutions(pose_sees_rays, pose_sees_lines, rotation),
    "resection.camera_3l": solutions(pose_sees_lines, rotation),
    "resection.camera_gp3p": solutions(pose_sees_rays, rotation),
    "resection.camera_p3p": solutions(pose_sees_rays, rotation),
    "resection.camera_up2p": solutions(pose_sees_rays, rotation, vertical),
    "resection.estimate_camera": robust(_projections_with_intrinsics, 3),
    "resection.estimate_camera_focal": robust(_projections, 4),
    "resection.estimate_camera_projective": robust(_projections, 6),
    "triangulation.triangulate_lines_robust": triangulated_lines,
    "triangulation.triangulate_points_robust": triangulated,
}
"""Of functions of which there is more to say than that what is good is finite."""
