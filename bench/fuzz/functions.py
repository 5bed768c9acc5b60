"""What each public function wants that a scene does not know by the names of its arguments."""

import importlib
import inspect
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

import torchsfm
from bench.fuzz.scene import SIZE, Scene
from torchsfm._types import tensor_map
from torchsfm.geometry import (
    Camera,
    Curve,
    Ellipse,
    Ellipsoid,
    Pose,
    Radial,
    Similarity,
    camera_from_krt,
    conic_from_ellipse,
    curve_from_samples,
    dual_quadric_from_ellipsoid,
    pluecker_from_points,
    project_points,
    project_quadric,
    rotation_from_rotvec,
    to_homogeneous,
    transform_conic,
)
from torchsfm.images import Edges, Features, detect_edges, detect_segments
from torchsfm.motion import FundamentalEstimator, HomographyEstimator
from torchsfm.optim import Block, Cauchy, Term
from torchsfm.reconstruction import ReconstructionError
from torchsfm.simulation import paint_shapes, random_bundle_problem
from torchsfm.tensors import fundamental_from_cameras


@dataclass(frozen=True)
class Function:
    """How to call a function."""

    given: Mapping[str, Any] = field(default_factory=dict)
    """Arguments as they are, or as functions of the scene."""
    sizes: Mapping[str, int] = field(default_factory=dict)
    """Of named dimensions."""
    planar: bool = False
    """Whether the points of the scene are to lie in a plane."""
    centred: bool = False
    """Whether the principal point is 0."""
    batched: bool = True
    """Whether the function takes batches of problems."""
    together: tuple[tuple[str, ...], ...] = ()
    """Optional arguments that come together or not at all."""
    raises: tuple[type[Exception], ...] = ()
    """What it says of data that are good for nothing."""
    half: bool = True
    """Whether single precision is tried too."""
    slow: bool = False
    """Whether a problem takes a good part of a second, so that batches are to be small."""
    homogeneous: bool = False
    """Whether rounding may choose the sign of its models."""


def _generator(_: Scene) -> torch.Generator:
    return torch.Generator().manual_seed(0)


def _of_observations(s: Scene) -> Tensor:
    return s.rand(s.size("v"), s.size("n"), low=0.2, high=1.0)


def _poses(s: Scene) -> Pose:
    _, R, t = s.parameters(4)
    return Pose(R, t)


def _place(s: Scene) -> Tensor:
    """Degrees and metres."""
    return s.rand(3, low=10.0, high=80.0)


def _lenses(s: Scene) -> Camera:
    K, _, _ = s.parameters(4)
    return Camera(K, Radial(s.rand(4, low=-0.1, high=0.1), s.rand(4, low=-0.02, high=0.02)))


def _small_lens(s: Scene) -> Camera:
    """Of a picture of 40 x 32 pixels."""
    K = torch.tensor([[40.0, 0.0, 19.5], [0.0, 42.0, 15.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return Camera(K.expand(*s.batch, 3, 3).clone(), Radial(s.rand(low=-0.1, high=0.1), s.rand(low=-0.02, high=0.02)))


def _board(s: Scene) -> tuple[Tensor, Tensor]:
    """Points of a plane in its own coordinates, and their images."""
    K, R, t = s.parameters(4)
    X = s.points(12)[..., :2]
    space = torch.cat((X, torch.zeros_like(X[..., :1])), -1)
    far = torch.tensor([0.0, 0.0, 7.0], dtype=torch.float64)
    return X, project_points(camera_from_krt(K, R, t + far), space[..., None, :, :])


def _ellipse(s: Scene) -> Ellipse:
    """In the middle of the image."""
    middle = torch.tensor([SIZE[0] / 2, SIZE[1] / 2], dtype=torch.float64)
    axes = torch.stack((s.rand(low=60.0, high=100.0), s.rand(low=30.0, high=50.0)), -1)
    return Ellipse(middle + s.rand(2, low=-30.0, high=30.0), axes, s.rand(low=-1.5, high=1.5))


def _outlines(s: Scene) -> Tensor:
    """Of two ellipsoids in four views."""
    e = _ellipsoid(s)
    two = Ellipsoid(torch.stack((e.centre, s.points(2)[..., 1, :]), -2), torch.stack((e.axes, e.axes), -3))
    return s.noisy_conics(
        project_quadric(s.cameras(4)[..., :, None, :, :], dual_quadric_from_ellipsoid(two)[..., None, :, :, :])
    )


def _tilted(s: Scene) -> tuple[Tensor, Tensor]:
    """Five ellipses of different planes in two views."""
    _, R, _ = s.parameters(4)
    lengths = torch.tensor([0.8, 0.5, 0.0], dtype=torch.float64)
    axes = lengths[:, None] * torch.cat((R, R[..., :1, :, :].mT @ R[..., 1:2, :, :].mT), -3)
    dual = dual_quadric_from_ellipsoid(Ellipsoid(s.points(5), axes))
    first, second = project_quadric(s.cameras(2)[..., :, None, :, :], dual[..., None, :, :, :]).unbind(-4)
    return s.noisy_conics(first), s.noisy_conics(second)


def _drawn(s: Scene) -> tuple[Tensor, Tensor]:
    """Three ellipses of a plane, seen from afar with a little noise, and as they are."""
    centre = torch.tensor([[0.0, 0.0], [2.0, 0.5], [-0.5, 1.8]], dtype=torch.float64)
    axes = torch.tensor([[0.9, 0.5], [0.7, 0.6], [0.5, 0.5]], dtype=torch.float64)
    drawn = conic_from_ellipse(Ellipse(centre, axes, torch.tensor([0.3, 1.0, 0.0], dtype=torch.float64)))
    R = rotation_from_rotvec(0.2 + 0.1 * s.randn(3))
    t = torch.tensor([0.3, -0.2, 6.0], dtype=torch.float64).expand(R[..., 0].shape)
    seen = transform_conic(torch.cat((R[..., :2], t[..., None]), -1)[..., None, :, :], drawn)
    return seen, drawn.expand(seen.shape)


def _edge_points(s: Scene) -> Tensor:
    """Around an ellipse."""
    return _ellipse(s).points(s.rand(24, high=6.3)) + 0.3 * s.randn(24, 2)


def _middle_lines(s: Scene) -> Tensor:
    """Lines through the middle of the image."""
    normal = s.randn(5, 2)
    return torch.cat((normal, -normal[..., :1] * SIZE[0] / 2 - normal[..., 1:] * SIZE[1] / 2), -1)


def _ellipsoid(s: Scene) -> Ellipsoid:
    """Amid the points."""
    _, R, _ = s.parameters(2)
    lengths = torch.stack([s.rand(low=low, high=low + 0.2) for low in (0.8, 0.5, 0.2)], -1)
    return Ellipsoid(s.points(1)[..., 0, :], lengths[..., None] * R[..., 1, :, :])


def _space_curve(s: Scene) -> Tensor:
    """A bent ring amid the points."""
    t = torch.arange(24, dtype=torch.float64) * (6.28318 / 24)
    ring = torch.stack((t.cos(), 0.6 * t.sin(), 0.2 * (2 * t).sin()), -1)
    return s.points(1) + 0.5 * ring + 0.001 * s.randn(24, 3)


def _image_curves(s: Scene) -> Curve:
    return curve_from_samples(project_points(s.cameras(4), _space_curve(s)[..., None, :, :]), closed=True)


def _image_curve(s: Scene) -> Curve:
    return tensor_map(lambda t: t[(*(slice(None),) * len(s.batch), 0)], _image_curves(s))


def _from_afar(s: Scene) -> Tensor:
    """Images of the points by cameras so far away that these are affine."""
    _, R, _ = s.parameters(4)
    return 120 * s.points(12)[..., None, :, :] @ R[..., :2, :].mT + 0.3 * s.randn(4, 12, 2)


def _rings(s: Scene) -> Tensor:
    """Three bent rings, always the same ones."""
    t = torch.arange(48, dtype=torch.float64) * (6.28318 / 48)
    waves = torch.stack((t.cos(), t.sin(), 0.2 * (2 * t).sin(), 0.2 * (2 * t).cos()), -1)
    bends = (s.points(15)[..., 3:, :] - s.points(15).mean(-2, keepdim=True)).unflatten(-2, (3, 4))
    return s.points(3)[..., None, :] + 0.4 * waves @ bends


def _images_of_curves(s: Scene) -> Curve:
    """The rings in all images."""
    images = project_points(s.cameras(4), _rings(s).flatten(-3, -2)[..., None, :, :])
    return curve_from_samples(images.unflatten(-2, (3, 48)), closed=True)


def _moving_edges(s: Scene) -> Edges:
    """Of a disc in three images."""
    place = s.rand(2, low=18.0, high=22.0)
    discs = [Ellipse(place + i, torch.tensor([11.0, 8.0]).to(place), torch.tensor(0.3).to(place)) for i in range(3)]
    images = [paint_shapes([disc], torch.tensor([0.2, 0.9]).to(place), width=48, height=44) for disc in discs]
    return detect_edges(torch.stack(images), max_edgels=200)


def _features(s: Scene) -> list[Features]:
    one = [s.rand(20, high=9.0) for _ in range(3)]
    return [Features(s.rand(20, 2, high=100.0), *one, s.rand(20, 128)) for _ in range(3)]


def _sight(s: Scene, n: int) -> tuple[Tensor, Tensor]:
    """Normals of planes of sight of the first camera, and the lines in them, away from the first points."""
    a, b = s.points(12)[..., 4 : 4 + n, :], s.points(12)[..., 8 : 8 + n, :]
    return torch.linalg.cross(a, b), pluecker_from_points(a, b)


def _sometimes_lines(make: Callable[[Scene], Any]) -> Callable[[Scene], Any]:
    """For half of the scenes, those with segments in the first view besides their points."""
    return lambda s: make(s) if s.generator.initial_seed() % 2 else None


def _segments(s: Scene) -> Tensor:
    """Of lines in the first view."""
    return torch.stack([project_points(s.cameras(1)[..., 0, :, :], X) for X in s.space_lines(12)], -2) + 0.3 * s.randn(12, 2, 2)


def _all_segments(s: Scene) -> Tensor:
    """Of lines in all views."""
    ends = torch.stack(s.space_lines(12), -2).flatten(-3, -2)
    seen = project_points(s.cameras(4), ends[..., None, :, :])
    return seen.unflatten(-2, (12, 2)) + 0.3 * s.randn(4, 12, 2, 2)


def _space_lines(s: Scene) -> Tensor:
    return pluecker_from_points(*s.space_lines(12))


def _of_each(s: Scene, n: int) -> Tensor:
    """Numbers for n points and, where there are any, the lines."""
    return s.rand(n + 12 * (s.generator.initial_seed() % 2), low=0.2, high=1.0)


def _round_picture(s: Scene) -> Tensor:
    """A bright disc with noise."""
    y, x = torch.meshgrid(torch.arange(32.0) - 15.3, torch.arange(40.0) - 19.6, indexing="ij")
    return s.rand(1, 32, 40, high=0.02) + 0.6 * (9.7 - (x * x + y * y).sqrt()).clamp(0, 1)


def _chessboard(s: Scene) -> Tensor:
    """Squares of eight pixels on white, with noise."""
    y, x = torch.meshgrid(torch.arange(48) // 8, torch.arange(56) // 8, indexing="ij")
    inside = (x > 0) & (x < 6) & (y > 0) & (y < 5)
    return 0.9 - 0.8 * (inside & ((x + y) % 2 == 0)) + s.rand(1, 48, 56, high=0.02)


def _circles(s: Scene) -> Tensor:
    """Three by two dark discs, with noise."""
    y, x = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    away = ((x - 12).remainder(20) - 10).square() + ((y - 14).remainder(20) - 10).square()
    inside = (6.3 - away.sqrt()).clamp(0, 1) * ((x > 2) & (x < 62) & (y > 4) & (y < 44))
    return 0.9 - 0.8 * inside + s.rand(1, 48, 64, high=0.02)


def _picture(s: Scene) -> Tensor:
    """A bright rectangle with noise."""
    image = s.rand(1, 32, 40, high=0.05)
    image[..., 8:24, 10:30] += 0.6
    return image


def _bundle(name: str) -> Callable[[Scene], Any]:
    return lambda s: getattr(random_bundle_problem(4, 20, 60, generator=_generator(s)).problem, name)


def _projective(s: Scene) -> Tensor:
    problem = random_bundle_problem(4, 20, 60, generator=_generator(s)).problem
    return camera_from_krt(problem.cameras.K[problem.camera_index], problem.poses.R, problem.poses.t)


def _fundamentals(P: Tensor) -> Tensor:
    first, second = PAIRS.unbind(-1)
    return fundamental_from_cameras(P[..., first, :, :], P[..., second, :, :])


def _relative_rotations(s: Scene) -> Tensor:
    _, R, _ = s.parameters(4)
    first, second = PAIRS.unbind(-1)
    return rotation_from_rotvec(0.01 * s.randn(6, 3)) @ R[second] @ R[first].mT


def _between(s: Scene) -> Similarity:
    """Similarities that agree but for a little."""
    R, t = _relative_rotations(s), s.randn(4, 3)
    first, second = PAIRS.unbind(-1)
    scale = s.rand(4, low=0.5, high=2.0)
    ratio = scale[first] / scale[second]
    # The world of the second model seen from the first.
    way = t[second] - ratio[:, None] * (R @ t[first][..., None])[..., 0]
    return Similarity(ratio, R, way)


def _fit(x: Tensor, a: Tensor, b: Tensor) -> Tensor:
    # Of any number of parameters: what a function of the user raises is the user's.
    return torch.stack((x[..., :1] * a - b, x[..., -1:] * a.exp() - 1), -1)


def _terms(s: Scene) -> list[Term]:
    index = torch.arange(12) % 4, torch.arange(12) % 3
    return [Term(lambda p, q, z: p - q - z, ("p", "q"), index, (s.randn(12, 1),), Cauchy(1.0))]


def _blocks(s: Scene) -> dict[str, Block]:
    fixed = torch.tensor([True, False, False, False])
    return {"p": Block(s.randn(4, 1), fixed=fixed), "q": Block(s.randn(3, 1))}


ROBUST = {"threshold": 2.0, "max_iterations": 64, "generator": _generator}
RAYS = ROBUST | {"threshold": 0.003}
SIZED = {"image_size": tuple(map(float, SIZE))}
CENTRED = {"c": lambda s: s.rand(2, low=-1.0, high=1.0)}
ADJUSTED = {"problem": lambda s: random_bundle_problem(4, 20, 60, generator=_generator(s)).problem}
PROJECTIVE = {
    "P": lambda s: _projective(s),
    "X": lambda s: torch.nn.functional.pad(_bundle("X")(s), (0, 1), value=1.0),
} | {name: _bundle(name) for name in ("x", "view", "point")}  # fmt: skip
PAIRS = torch.combinations(torch.arange(4, device="cpu"))
BUNDLE_SIZES = {"m": 60, "n": 20, "v": 4, "f": 4, "g": 1, "k": 1}
TWO_VIEWS = {"estimator": FundamentalEstimator(), "data": lambda s: tuple(s.images(2, 30).unbind(-3))}

FUNCTIONS: dict[str, Function] = {
    "autocalibration.autocalibrate_curves": Function(
        SIZED | {"X": lambda s: to_homogeneous(_rings(s)[..., ::3, :]), "curves": _images_of_curves}, {"v": 4, "c": 3, "m": 16},
        slow=True,
    ),
    "autocalibration.autocalibrate_points": Function(SIZED, {"n": 20}, slow=True),
    "autocalibration.calibrate_planes": Function({"X": lambda s: _board(s)[0], "x": lambda s: _board(s)[1]}),
    "autocalibration.calibrate_view_graph": Function(
        {
            "F": lambda s: _fundamentals(camera_from_krt(*s.parameters(4))),
            "cameras": lambda _: PAIRS, "c": lambda s: s.rand(4, 2, low=450.0, high=550.0),
            "focal": lambda s: s.rand(4, low=700.0, high=900.0), "sigma": lambda s: s.rand(4, low=0.3, high=0.6),
        },
        {"p": 6, "v": 4},
    ),
    "autocalibration.constant_intrinsics": Function(SIZED),
    "autocalibration.dual_quadric_linear": Function(SIZED),
    "autocalibration.intrinsics_from_kruppa": Function(SIZED, slow=True),
    "autocalibration.intrinsics_from_modulus": Function(SIZED, slow=True),
    "autocalibration.intrinsics_from_plane": Function(SIZED, planar=True),
    "autocalibration.intrinsics_from_rotations": Function(SIZED),
    "bundle.bundle_adjust": Function(ADJUSTED | {"max_iterations": 10}, BUNDLE_SIZES, batched=False),
    "bundle.bundle_adjust_projective": Function(PROJECTIVE | {"max_iterations": 10}, BUNDLE_SIZES, batched=False),
    "bundle.bundle_covariance": Function(ADJUSTED, BUNDLE_SIZES, batched=False),
    "bundle.intrinsics_covariance": Function(ADJUSTED, BUNDLE_SIZES, batched=False),
    "bundle.match_weights": Function(ADJUSTED, BUNDLE_SIZES, batched=False),
    "bundle.track_weights": Function(ADJUSTED, BUNDLE_SIZES, batched=False),
    "geometry.conic_distance": Function({"C": lambda s: conic_from_ellipse(_ellipse(s))}),
    "geometry.conic_from_ellipse": Function({"ellipse": _ellipse}),
    "geometry.curve_crossings": Function({"curve": _image_curve, "line": _middle_lines, "most": 3}),
    "geometry.curve_from_samples": Function({"x": _space_curve}),
    "geometry.fit_spline": Function({"curve": _image_curve, "controls": 6}),
    "geometry.foot_points": Function({"curve": _image_curve, "y": _edge_points}),
    "geometry.dual_quadric_from_ellipsoid": Function({"ellipsoid": _ellipsoid}),
    "geometry.ellipse_distance": Function({"ellipse": _ellipse}),
    "geometry.intersect_conics": Function({f"C{i}": lambda s: conic_from_ellipse(_ellipse(s)) for i in (1, 2)}),
    "geometry.intersect_line_conic": Function({"C": lambda s: conic_from_ellipse(_ellipse(s)), "l": _middle_lines}),
    "geometry.rotation_from_euler": Function({"axes": "xyz"}),
    "geometry.intersect_line_plane": Function({"L": lambda s: s.randn(6)}),
    "geometry.nearest_on_line": Function({"X": lambda s: s.randn(3), "L": lambda s: s.randn(6)}),
    "geometry.nearest_pluecker": Function({"L": lambda s: s.randn(6)}),
    "geometry.point_line_distance": Function({"x": lambda s: s.randn(2), "l": lambda s: s.randn(3)}),
    "geometry.point_to_line_distance": Function({"X": lambda s: s.randn(3), "L": lambda s: s.randn(6)}),
    "geometry.random_rotation": Function({"shape": (2,), "generator": _generator}),
    "images.describe_images": Function({"features": _features, "words": 4, "generator": _generator}, batched=False),
    "images.detect_chessboard": Function({"image": _chessboard, "columns": 4, "rows": 3}, {"h": 48, "w": 56}),
    "images.detect_circles_grid": Function({"image": _circles, "columns": 3, "rows": 2}, {"h": 48, "w": 64}, slow=True),
    "images.detect_corners": Function({"image": lambda s: s.rand(1, 32, 40)}, {"h": 32, "w": 40}),
    "images.detect_edges": Function({"image": lambda s: _picture(s), "max_edgels": 500}, {"h": 32, "w": 40}),
    "images.detect_ellipses": Function({"image": _round_picture, "max_ellipses": 3}, {"h": 32, "w": 40}),
    "images.detect_features": Function({"image": lambda s: s.rand(1, 32, 40)}, batched=False),
    "images.fit_ellipse": Function({"x": _edge_points}, {"n": 24}),
    "images.detect_motion": Function({"images": lambda s: [_picture(s) for _ in range(2)]}, batched=False, slow=True),
    "images.detect_segments": Function({"image": lambda s: _picture(s), "max_segments": 20}, {"h": 32, "w": 40}),
    "images.describe_segments": Function({"image": lambda s: _picture(s)}, batched=False),
    "images.hough_lines": Function({"image": lambda s: _picture(s), "max_lines": 8, "min_count": 12}, {"h": 32, "w": 40}),
    "images.match_segments": Function(
        {f"segments{i}": lambda s: detect_segments(_picture(s), 20) for i in (1, 2)}
        | {f"image{i}": lambda s: _picture(s) for i in (1, 2)},
        batched=False,
    ),
    "images.match_descriptors": Function({f"descriptors{i}": lambda s: s.rand(9, 16) for i in (1, 2)}, batched=False),
    "images.match_features": Function({"features": _features, "pairs": torch.tensor([[0, 1], [1, 2]])}, batched=False),
    "images.preview_matches": Function({"features": _features, "pairs": torch.tensor([[0, 1], [1, 2]])}, batched=False),
    "images.promising_pairs": Function(
        {"pairs": torch.tensor([[0, 1], [1, 2], [0, 2]]), "found": torch.tensor([9.0, 1.0, 0.5]).double(), "partners": 1},
        batched=False,
    ),
    "images.retrieve_pairs": Function(
        {"features": _features, "neighbours": 1, "words": 4, "generator": _generator}, batched=False
    ),
    "images.scale_image": Function({"image": lambda s: s.rand(32, 40)}),
    "images.track_curves": Function({"edges": _moving_edges}, batched=False),
    "images.track_points": Function(
        {"image1": lambda s: s.rand(1, 40, 40), "image2": lambda s: s.rand(1, 40, 40), "x1": lambda s: s.rand(6, 2, high=39.0)}
    ),
    "images.undistort_images": Function({
        "images": lambda s: s.rand(2, 32, 40), "cameras": _small_lens, "pinholes": lambda s: Camera(_small_lens(s).K),
        "size": (36, 30)}),
    "images.undistorted_cameras": Function({
        "cameras": _small_lens, "size": lambda s: torch.tensor([40, 32]).expand(*s.batch, 2).clone()}),
    "images.track_sequence": Function({"images": lambda s: list(s.rand(3, 1, 40, 40))}, batched=False),
    "linalg.nearest_rank": Function({"rank": 2}),
    "linalg.nullspace_rows": Function(batched=False),
    "linalg.usable": Function({"x": lambda s: s.randn(5)}),
    "linalg.null_vector": Function({"A": lambda s: s.randn(6, 4)}),
    "linalg.orthonormal_nullspace": Function({"A": lambda s: s.randn(3, 5)}),
    "motion.average_rotations": Function(
        {"R": _relative_rotations, "edges": PAIRS, "views": 4, "deviation": None, "weights": lambda s: s.rand(6, low=0.5)},
        {"e": 6},
        batched=False,
    ),
    "motion.average_similarities": Function(
        {"between": _between, "edges": PAIRS, "models": 4, "places": lambda s: s.randn(6, 4, 3),
         "deviation": lambda s: s.rand(6, low=0.5)},
        {"e": 6},
        batched=False,
    ),
    "motion.estimate_essential": Function(RAYS, {"n": 30}),
    "motion.estimate_fundamental": Function(ROBUST, {"n": 30}),
    "motion.estimate_fundamentals": Function({"threshold": 2.0, "generator": _generator, "slots": 2}, {"n": 30}),
    "motion.estimate_homographies": Function({"threshold": 2.0, "generator": _generator, "slots": 2}, {"n": 30}, planar=True),
    "motion.estimate_homography": Function(ROBUST, {"n": 30}, planar=True),
    "motion.estimate_trifocal": Function(
        ROBUST
        | {"l": _sometimes_lines(lambda s: _all_segments(s)[..., :3, :, :, :])}
        | {"mask": lambda s: _of_each(s, 30) < 0.95, "weights": lambda s: _of_each(s, 30)}
        | {"quality": lambda s: None if s.generator.initial_seed() % 3 else _of_each(s, 30)},
        {"n": 30},
    ),
    "motion.estimate_upright": Function(RAYS, {"n": 30}),
    "motion.factorize_affine": Function({"x": _from_afar, "max_iterations": 20}),
    "motion.factorize_curves": Function(
        {"curves": _images_of_curves, "samples": 16, "oriented": True, "aligned": True}, slow=True
    ),
    "motion.factorize_points": Function({"max_iterations": 20}),
    "motion.fundamental_from_conics": Function(
        {f"C{i + 1}": lambda s, i=i: _tilted(s)[i] for i in range(2)}
        | {f"x{i + 1}": lambda s, i=i: s.images(2, 12)[..., i, :, :] for i in range(2)}
        | {"starts": 2, "max_iterations": 9, "generator": _generator},
        {"m": 5},
    ),
    "motion.homography_4pt": Function(planar=True),
    "motion.homography_dlt": Function(planar=True),
    "motion.position_globally": Function(
        {
            "d": lambda s: torch.cat([s.rays(k, 12) for k in range(4)]), "view": torch.arange(48) // 12,
            "point": torch.arange(48) % 12, "R": lambda s: s.parameters(4)[1], "points": 12,
            "weights": lambda s: s.rand(48, low=0.5),
        },
        {"m": 48, "v": 4},
        batched=False,
    ),
    "motion.relative_6pt_focal": Function(centred=True),
    "motion.trifocal_7pt": Function(together=(("l", "ends", "line_weights"),)),
    "optim.attach_implicit": Function(
        {"equations": lambda _: lambda y, a: y * y - a, "y": lambda s: s.rand(2).sqrt(), "inputs": lambda s: (s.rand(2),)}
    ),
    "optim.attach_optimum": Function(
        {"objective": lambda _: lambda y, a: ((y - a) ** 2).sum(-1), "y": lambda s: s.rand(2), "inputs": lambda s: (s.rand(2),)}
    ),
    "optim.levenberg_marquardt": Function(
        {"residual": lambda _: _fit, "x0": lambda s: s.randn(2), "data": lambda s: (s.randn(12), s.randn(12))}
    ),
    "optim.loss_slope": Function({"loss": Cauchy(1.0), "s": lambda s: s.rand(5)}),
    "optim.marginal_covariance": Function({"blocks": _blocks, "terms": _terms, "name": "p"}, batched=False),
    "optim.pair_covariance": Function(
        {"blocks": _blocks, "terms": _terms, "name": "p", "pairs": torch.zeros((1, 2), dtype=torch.long)}, batched=False
    ),
    "optim.sparse_covariance": Function({"blocks": _blocks, "terms": _terms}, batched=False),
    "optim.sparse_levenberg_marquardt": Function({"blocks": _blocks, "terms": _terms}, batched=False),
    "reconstruction.reconstruct_tracks": Function(
        {
            "x": lambda s: s.images(4, 60).flatten(0, 1), "view": torch.arange(240) // 60, "track": torch.arange(240) % 60,
            "image_size": torch.tensor([SIZE] * 4),
        },
        {"n": 60},
        batched=False,
        raises=(ReconstructionError,),
    ),
    "resection.camera_1p2l": Function({"l": lambda s: _sight(s, 2)[0], "L": lambda s: _sight(s, 2)[1]}),
    "resection.camera_2p1l": Function({"l": lambda s: _sight(s, 1)[0], "L": lambda s: _sight(s, 1)[1]}),
    "resection.camera_3l": Function({"l": lambda s: _sight(s, 3)[0], "L": lambda s: _sight(s, 3)[1]}),
    "resection.camera_circle": Function(
        {
            "C": lambda s: torch.diag(torch.tensor([1.0, 1.3, -0.2])) + 0.02 * (lambda A: A + A.mT)(s.randn(3, 3)),
            "radius": lambda s: s.rand(low=0.5, high=2.0),
        }
    ),
    "resection.camera_conics": Function({"C": lambda s: _drawn(s)[0], "C_plane": lambda s: _drawn(s)[1]}, {"m": 3}),
    "resection.camera_dlt": Function(together=(("l", "L", "line_weights"),)),
    "resection.camera_gp3p": Function({"p": lambda s: s.points(3) - 5 * s.rays(0, 3) - 0.1, "d": lambda s: s.rays(0, 3)}),
    "resection.camera_p4pf": Function(centred=True),
    "resection.camera_p35pf": Function(centred=True),
    "resection.camera_planar": Function(planar=True),
    "resection.estimate_camera": Function(
        ROBUST
        | {"l": _sometimes_lines(_segments), "L": _sometimes_lines(_space_lines)}
        | {"mask": lambda s: _of_each(s, 20) < 0.95, "weights": lambda s: _of_each(s, 20)}
        | {"quality": lambda s: None if s.generator.initial_seed() % 3 else _of_each(s, 20)},
        {"n": 20},
    ),
    "resection.estimate_camera_focal": Function(ROBUST, {"n": 20}),
    "resection.estimate_camera_projective": Function(ROBUST, {"n": 20}),
    "resection.refine_camera": Function(
        {"pose": lambda s: _poses(s)[..., 0], "camera": lambda s: Camera(s.parameters(1)[0][..., 0, :, :])}
        | {"l": _sometimes_lines(_segments), "L": _sometimes_lines(_space_lines), "weights": lambda s: _of_each(s, 12)}
    ),
    "resection.resect_cameras": Function(
        {"max_iterations": 64, "generator": _generator, "K": _sometimes_lines(lambda s: s.parameters(4)[0])}
        | {"l": _sometimes_lines(_all_segments), "L": _sometimes_lines(_space_lines)}
        | {"visible": lambda s: torch.stack([_of_each(s, 20) < 0.95 for _ in range(4)], -2)},
        {"n": 20},
    ),
    "robust.find_structures": Function(
        TWO_VIEWS | {"estimator": HomographyEstimator(), "threshold": 2.0, "generator": _generator, "slots": 2},
        {"n": 30},
        planar=True,
    ),
    "robust.ransac": Function(TWO_VIEWS | ROBUST, {"n": 30}, homogeneous=True),
    "robust.soft_ransac": Function(TWO_VIEWS | {"threshold": 2.0, "generator": _generator}, {"n": 30}),
    "simulation.look_at": Function(),
    "simulation.orbit_poses": Function({"views": 3}),
    "simulation.random_bundle_problem": Function(
        {"num_cameras": 3, "num_points": 8, "num_observations": 16, "generator": _generator}
    ),
    "simulation.paint_shapes": Function(
        {
            "shapes": lambda s: [s.rand(1, 2, high=30.0) + torch.tensor([[0.0, 0], [9, 0], [0, 9]])], "width": 32, "height": 24,
            "levels": lambda s: s.rand(2),
        },
        batched=False,
    ),
    "simulation.render_board": Function(
        {
            "poses": lambda s: Pose(torch.eye(3).expand(1, 3, 3), torch.tensor([[-1.0, -0.5, 4.0]])),
            "camera": lambda s: Camera(torch.tensor([[30.0, 0, 15.5], [0, 30, 11.5], [0, 0, 1]])),
            "columns": 3, "rows": 2, "width": 32, "height": 24, "fine": 2, "generator": _generator,
        },
        batched=False,
    ),
    "simulation.render_shapes": Function(
        {"shape": (2,), "ellipses": 3, "polygons": 1, "width": 32, "height": 24, "fine": 2, "generator": _generator}
    ),
    "simulation.random_intrinsics": Function({"shape": (2,), "generator": _generator}),
    "simulation.random_points": Function({"shape": (2,), "generator": _generator}),
    "simulation.random_poses": Function({"shape": (2,), "generator": _generator}),
    "simulation.simulate_images": Function({"poses": _poses, "cameras": _lenses, "generator": _generator}),
    "geometry.enu_from_geodetic": Function({"place": _place, "origin": _place}),
    "geometry.geodetic_from_enu": Function({"X": _place, "origin": _place}),
    "tensors.reordered_trifocal": Function({"views": (1, 0, 2)}),
    "simulation.simulate_segments": Function(
        {"X": lambda s: s.points(16).reshape(*s.batch, 8, 2, 3), "poses": _poses, "cameras": _lenses, "generator": _generator}
    ),
    "simulation.simulate_conics": Function({"shape": (2,), "generator": _generator}),
    "triangulation.triangulate_curves": Function({"curves": _image_curves, "P": lambda s: s.cameras(4), "samples": 12}),
    "triangulation.triangulate_conics": Function(sizes={"n": 2, "k": 12}, together=(("x", "weights"),)),
    "triangulation.triangulate_quadrics": Function({"C": _outlines}, {"n": 2, "k": 12}, together=(("x", "weights"),)),
    "triangulation.triangulate_lines_robust": Function(
        {"l": _all_segments, "threshold": 2.0, "generator": _generator}
        | {"weights": _of_observations, "quality": _of_observations}
    ),
    "triangulation.triangulate_points_robust": Function(
        {"threshold": 2.0, "generator": _generator, "weights": _of_observations, "quality": _of_observations}
    ),
}  # fmt: skip
"""The others are called with what the scene knows."""

FILES = "reads or writes files, which `bench.fuzz.files` spoils"
EXCEPTIONS: dict[str, str] = {
    "bundle.bundle_adjust_model": "hands a model to bundle_adjust",
    "cli.main": "a program; its options and files are tested in tests/test_cli.py",
    **{f"formats.read_{name}": FILES for name in (
        "bal", "bundler", "colmap", "database", "features", "hloc", "kapture", "libmv", "model", "nerfstudio", "nvm", "openmvg",
        "opensfm", "ply", "vgg")},
    **{f"formats.write_{name}": FILES for name in (
        "bal", "bundler", "colmap", "curves", "database", "gltf", "kapture", "kitti", "model", "nerfstudio", "nvm",
        "openmvg", "opensfm", "ply", "tum")},
    **{f"formats.{name}_{what}": FILES for name in ("read", "write") for what in ("lines", "conics")},
    "formats.export_model": FILES,
    **{f"formats.{one}": "rearranges numbers; tests/formats/test_objects.py" for name in (
        "kornia", "nerfstudio", "opencv", "pytorch3d") for one in (f"camera_from_{name}", f"{name}_from_camera")},
    "formats.model_from_pycolmap": FILES,
    "formats.pycolmap_from_model": FILES,
    "formats.undistorted_model": "hands a model to undistorted_cameras",
    **{f"images.{name}": FILES for name in ("list_images", "list_skipped", "load_detector", "load_matcher")},
    **{f"images.{name}": FILES for name in ("extract_frames", "parse_exif", "read_image", "save_image")},
    "optim.for_slots": "a view of a tensor, not its values",
    "optim.wants_derivative": "a question about tensors, not their values",
    **{f"reconstruction.{name}": "takes a whole model; tests of models spoil it" for name in (
        "adjust_to_points", "align_models", "align_to_gps", "align_to_ground", "align_to_points", "align_to_positions",
        "align_upright", "merge_models", "part_of_model", "up_direction")},
    "reconstruction.check_poses": "photographs one after another, and seconds",
    "reconstruction.reconstruct_curves": "photographs one after another, and seconds",
    "reconstruction.reconstruct": "photographs; its stages are tried by reconstruct_tracks",
    "reconstruction.register_photographs": "photographs; tests/test_register.py spoils them",
    "reconstruction.saved_features": FILES,
    "reconstruction.triangulate_photographs": "photographs; its stages are tried by reconstruct_tracks",
    "reconstruction.reconstruct_matches": "lists of tensors; its stages are tried by reconstruct_tracks",
    **{f"robust.{name}": "what doors have in common; each door is tried" for name in (
        "check_counts", "check_door", "estimate_robustly")},
    "simulation.courtyard_scene": "takes no data, and seconds",
    "simulation.render_sequence": "takes no data, and seconds",
    **{f"plot.plot_{name}": "draws" for name in (
        "cameras", "epipolar_lines", "lines_3d", "matches", "points_2d", "points_3d", "residuals", "tracks")},
    **{f"plot.{name}": "draws" for name in ("show_image", "show_scaled", "write_page")},
}  # fmt: skip
"""Public functions that are not tried, and why."""

INNER = {
    "geometry.curve_crossings", "geometry.curve_from_samples", "geometry.foot_points", "geometry.least_number_off",
    "geometry.line_and_plane_distances", "images.describe_images", "images.describe_segments", "images.list_skipped",
    "optim.for_slots",
    "images.parse_exif", "optim.loss_slope", "optim.marginal_covariance", "optim.pair_covariance",
    "optim.rotation_exponential", "optim.wants_derivative", "robust.check_counts", "robust.check_door",
    "robust.constant_weights", "robust.estimate_robustly",
}  # fmt: skip
"""Functions that rooms export for each other, as all of `linalg`: they know what they pass."""


def public_functions() -> dict[str, Callable[..., Any]]:
    """All functions that rooms export, by room and name."""
    found = {}
    for module in pkgutil.iter_modules(torchsfm.__path__):
        if module.ispkg:
            room = importlib.import_module(f"torchsfm.{module.name}")
            names = (name for name in room.__all__ if inspect.isfunction(getattr(room, name)))
            found |= {f"{module.name}.{name}": getattr(room, name) for name in names}
    return found
