"""Good arguments for every function, by their names: one scene whose cameras, points, lines and tensors belong together."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchsfm.geometry import (
    Ellipse,
    Ellipsoid,
    camera_from_krt,
    conic_from_ellipse,
    dual_conic,
    dual_quadric_from_ellipsoid,
    ellipse_from_conic,
    project_points,
    project_quadric,
    quaternion_wxyz_from_rotation,
    random_rotation,
    rotation_from_rotvec,
    to_homogeneous,
)
from torchsfm.linalg import adjugate_4x4
from torchsfm.tensors import (
    essential_from_pose,
    fundamental_from_cameras,
    quadrifocal_from_cameras,
    trifocal_from_cameras,
)

FOCAL = 800.0
SIZE = (1000, 750)
F64 = torch.float64


@dataclass(frozen=True)
class Scene:
    """Cameras that look at points, and the names of the library for what there is to know about them. In float64.

    The first camera is `K [I | 0]`. Where `planar`, all points lie in a plane. The principal point is the image's middle, or 0
    where `centred`.
    """

    generator: torch.Generator
    batch: tuple[int, ...] = ()
    sizes: tuple[tuple[str, int], ...] = ()
    """Of named dimensions: `n` points, `v` views, `d` coordinates ..."""
    planar: bool = False
    centred: bool = False

    def size(self, name: str) -> int:
        """Of a dimension, by name or as written."""
        name = name.removeprefix("#")
        if name.isdigit():
            return int(name)
        return dict(self.sizes).get(name, {"n": 12, "v": 4, "d": 3, "h": 4, "batch": 5}.get(name, 4))

    def rand(self, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        """Uniform numbers."""
        return low + (high - low) * torch.rand((*self.batch, *shape), generator=self.generator, dtype=F64)

    def randn(self, *shape: int) -> Tensor:
        """Normal numbers."""
        return torch.randn((*self.batch, *shape), generator=self.generator, dtype=F64)

    def value(self, name: str, dims: tuple[str, ...]) -> Tensor | None:
        """What a parameter of this name and these trailing dimensions wants; None where the scene does not know."""
        make = _VALUES.get(f"{name} {' '.join(dims)}") or _VALUES.get(name)
        return None if make is None else make(self, tuple(self.size(dim) for dim in dims))

    def parameters(self, views: int) -> tuple[Tensor, Tensor, Tensor]:
        """Intrinsics, rotations and translations."""
        K, R, t = self._cameras
        return K[..., :views, :, :], R[..., :views, :, :], t[..., :views, :]

    @cached_property
    def _cameras(self) -> tuple[Tensor, Tensor, Tensor]:
        v = max(self.size("v"), 4)
        K = torch.zeros(*self.batch, v, 3, 3, dtype=F64)
        K[..., 0, 0] = K[..., 1, 1] = FOCAL
        K[..., 2, 2] = 1
        if not self.centred:
            K[..., 0, 2], K[..., 1, 2] = (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2
        R = rotation_from_rotvec(self.rand(v, 3, low=-0.3, high=0.3))
        centre = self.rand(v, 3, low=-2.0, high=2.0)
        R[..., 0, :, :], centre[..., 0, :] = torch.eye(3, dtype=F64), 0
        return K, R, -(R @ centre[..., None])[..., 0]

    def cameras(self, views: int) -> Tensor:
        """Cameras (*batch, views, 3, 4)."""
        return camera_from_krt(*self.parameters(views))

    def plane(self) -> Tensor:
        """`n / d` of the plane `n'X = d` that points lie in where they do."""
        return torch.tensor([0.05, -0.1, 0.15], dtype=F64).expand(*self.batch, 3)

    def points(self, n: int) -> Tensor:
        """Points (*batch, n, 3) in front of all cameras; always the same first ones."""
        return self._points[..., :n, :]

    @cached_property
    def _points(self) -> Tensor:
        return self._scattered(max(self.size("n"), 16))

    def _scattered(self, n: int) -> Tensor:
        X = self.rand(n, 3, low=-2.0, high=2.0) + torch.tensor([0.0, 0.0, 7.0], dtype=F64)
        if self.planar:
            plane = self.plane()[..., None, :]
            X = torch.cat((X[..., :2], (1 - (X[..., :2] * plane[..., :2]).sum(-1, keepdim=True)) / plane[..., 2:]), -1)
        return X

    def images(self, views: int, n: int) -> Tensor:
        """Image points (*batch, views, n, 2), a little noisy."""
        exact = project_points(self.cameras(views), self.points(n)[..., None, :, :])
        return exact + 0.3 * self._noise[..., :views, :n, :]

    @cached_property
    def _noise(self) -> Tensor:
        return self.randn(max(self.size("v"), 4), max(self.size("n"), 16), 2)

    def rays(self, view: int, n: int) -> Tensor:
        """Unit rays of one camera to the points."""
        _, R, t = self._cameras
        d = self.points(n) @ R[..., view, :, :].mT + t[..., view, None, :]
        return d / d.norm(dim=-1, keepdim=True)

    def space_lines(self, n: int) -> tuple[Tensor, Tensor]:
        """Two points on each of n lines in space; always the same first ones."""
        a, b = self._line_points
        return a[..., :n, :], b[..., :n, :]

    @cached_property
    def _line_points(self) -> tuple[Tensor, Tensor]:
        n = max(self.size("n"), 16)
        return self._scattered(n), self._scattered(n)

    def lines(self, view: int, n: int) -> Tensor:
        """Image lines in one view."""
        P = self.cameras(view + 1)[..., view, :, :]
        a, b = (to_homogeneous(project_points(P, X)) for X in self.space_lines(n))
        line = torch.linalg.cross(a, b)
        return line / line[..., :2].norm(dim=-1, keepdim=True)

    def noisy_conics(self, dual: Tensor) -> Tensor:
        """Ellipses given by their duals, fitted to a few edge points."""
        e, _ = ellipse_from_conic(dual_conic(dual))
        axes = e.semi_axes * (1 + 0.01 * self.randn(*e.semi_axes.shape[len(self.batch) :]))
        return conic_from_ellipse(Ellipse(e.centre + 0.1 * self.randn(*e.centre.shape[len(self.batch) :]), axes, e.angle))

    def homography(self, view: int) -> Tensor:
        """From the first image to another, by the plane."""
        K, R, t = self._cameras
        M = R[..., view, :, :] + t[..., view, :, None] * self.plane()[..., None, :]
        return K[..., view, :, :] @ M @ torch.linalg.inv(K[..., 0, :, :])


def _camera(view: int) -> Callable[[Scene, tuple[int, ...]], Tensor]:
    return lambda s, _: s.cameras(view + 1)[..., view, :, :]


def _line(view: int) -> Callable[[Scene, tuple[int, ...]], Tensor]:
    return lambda s, shape: s.lines(view, shape[0])


def _image(view: int) -> Callable[[Scene, tuple[int, ...]], Tensor]:
    return lambda s, shape: s.images(view + 1, shape[0])[..., view, :, :]


def _pairs(s: Scene, count: int, of_pair: Callable[[int], Tensor]) -> Tensor:
    """Something of each of several pairs of views, all with the first."""
    return torch.stack([of_pair(1 + i % 3) for i in range(count)], -3)


def _fundamental(s: Scene, i: int, j: int) -> Tensor:
    P = s.cameras(4)
    return fundamental_from_cameras(P[..., i, :, :], P[..., j, :, :])


def _trifocal(s: Scene, *views: int) -> Tensor:
    P = s.cameras(4)
    return trifocal_from_cameras(*(P[..., i, :, :] for i in views))


def _polynomial(s: Scene, size: int) -> Tensor:
    """Coefficients, lowest power first, of a polynomial that is zero somewhere: negative at 0, positive far away."""
    c = s.randn(size)
    return torch.cat((-c[..., :1].abs() - 0.1, c[..., 1:-1], c[..., -1:].abs() + 0.1), -1)


def _symmetric(s: Scene, n: int) -> Tensor:
    A = s.randn(n, n)
    return A + A.mT


def _turn(s: Scene, view: int) -> Tensor:
    K, R, _ = s._cameras
    return K[..., view, :, :] @ R[..., view, :, :] @ torch.linalg.inv(K[..., 0, :, :])


def _up(s: Scene, view: int) -> Tensor:
    """Gravity in the frame of a camera."""
    _, R, _ = s._cameras
    return R[..., view, :, 1]


def _intrinsics(view: int) -> Callable[[Scene, tuple[int, ...]], Tensor]:
    return lambda s, _: s.parameters(view + 1)[0][..., view, :, :]


def _quadrics(s: Scene, n: int) -> Tensor:
    """The duals of flat ellipsoids amid the points."""
    _, R, _ = s._cameras
    lengths = torch.tensor([0.8, 0.5, 0.0], dtype=F64)
    axes = lengths[:, None] * R[..., None, 1, :, :]
    X = s.points(n)
    return dual_quadric_from_ellipsoid(Ellipsoid(X, axes.expand(*X.shape, 3)))


def _conics(s: Scene, n: int) -> Tensor:
    """Their images in the first view."""
    return dual_conic(project_quadric(s.cameras(1), _quadrics(s, n)))


def _all_conics(s: Scene, shape: tuple[int, ...]) -> Tensor:
    """In several views, a little noisy."""
    return s.noisy_conics(project_quadric(s.cameras(shape[0])[..., :, None, :, :], _quadrics(s, shape[1])[..., None, :, :, :]))


def _edge_points(s: Scene, shape: tuple[int, ...]) -> Tensor:
    """On conics in several views, a little noisy."""
    v, n, k, _ = shape
    ellipses, _ = ellipse_from_conic(_all_conics(s, (v, n)))
    return ellipses.points(torch.arange(k, dtype=F64) * 6.28 / k) + 0.3 * s.randn(v, n, k, 2)


def _index(s: Scene, shape: tuple[int, ...]) -> Tensor:
    return torch.stack([torch.randperm(4, generator=s.generator)[: shape[1]] for _ in range(shape[0])])


def _weights(s: Scene, shape: tuple[int, ...]) -> Tensor:
    return s.rand(*shape, low=0.2, high=1.0)


def _mask(s: Scene, shape: tuple[int, ...]) -> Tensor:
    return s.rand(*shape) < 0.95


def _plucker(s: Scene, shape: tuple[int, ...]) -> Tensor:
    a, b = s.space_lines(shape[0])
    return torch.cat((b - a, torch.linalg.cross(a, b)), -1)


def _line_ends(s: Scene, shape: tuple[int, ...]) -> Tensor:
    P = s.cameras(1)[..., 0, :, :]
    return torch.stack([project_points(P, X) for X in s.space_lines(shape[0])], -2)


def _all_lines(s: Scene, shape: tuple[int, ...]) -> Tensor:
    return torch.stack([s.lines(i, shape[1]) for i in range(shape[0])], -3)


_VALUES: dict[str, Callable[[Scene, tuple[int, ...]], Tensor]] = {
    "A": lambda s, shape: _symmetric(s, shape[0]) if shape[0] == shape[1] else s.randn(*shape),
    "A k k": lambda s, shape: (lambda M: M @ M.mT)(s.randn(shape[0], shape[0] + 2)),
    "B": lambda s, shape: s.randn(*shape),
    "C v n 3 3": _all_conics,
    **{f"C{i + 1}": lambda s, _, i=i: _all_conics(s, (2, 1))[..., i, 0, :, :] for i in range(2)},
    "C 3 3": lambda s, _: _conics(s, 1)[..., 0, :, :],
    "E": lambda s, _: essential_from_pose(s._cameras[1][..., 1, :, :], s._cameras[2][..., 1, :]),
    "F 3 3": lambda s, _: _fundamental(s, 0, 1),
    "F m 3 3": lambda s, shape: _pairs(s, shape[0], lambda j: _fundamental(s, 0, j)),
    "F p 3 3": lambda s, shape: _pairs(s, shape[0], lambda j: _fundamental(s, 0, j)),
    "F12": lambda s, _: _fundamental(s, 0, 1),
    "F13": lambda s, _: _fundamental(s, 0, 2),
    "F23": lambda s, _: _fundamental(s, 1, 2),
    "G": lambda s, _: torch.tensor([0.0, 1.0, 0.0], dtype=F64).expand(*s.batch, 3),
    "H 3 3": lambda s, _: s.homography(1),
    "H 4 4": lambda s, _: torch.eye(4, dtype=F64) + 0.1 * s.randn(4, 4),
    "H h h": lambda s, shape: torch.eye(shape[0], dtype=F64) + 0.1 * s.randn(*shape),
    "H m 3 3": lambda s, shape: _pairs(s, shape[0], s.homography if s.planar else lambda j: _turn(s, j)),
    **{f"H{i}": lambda s, _: torch.eye(3, dtype=F64) + 0.1 * s.randn(3, 3) for i in range(1, 5)},
    "K 3 3": _intrinsics(0),
    "K v 3 3": lambda s, shape: s.parameters(shape[0])[0],
    "K #v 3 3": lambda s, _: s.parameters(1)[0],
    "K1": _intrinsics(0),
    "K2": _intrinsics(1),
    "L": _plucker,
    "L1": lambda s, _: _plucker(s, (4, 6)),
    "L2": lambda s, _: _plucker(s, (4, 6)).roll(1, -2),
    "P 3 4": _camera(0),
    "P v 3 4": lambda s, shape: s.cameras(shape[0]),
    **{f"P{i + 1}": _camera(i) for i in range(4)},
    "Q": lambda s, _: quadrifocal_from_cameras(*s.cameras(4).unbind(-3)),
    "Q 4 4": lambda s, _: adjugate_4x4(_quadrics(s, 1)[..., 0, :, :]),
    "Q_dual 4 4": lambda s, _: _quadrics(s, 1)[..., 0, :, :],
    "R 3 3": lambda s, _: s.parameters(2)[1][..., 1, :, :],
    "R v 3 3": lambda s, shape: s.parameters(shape[0])[1],
    "T": lambda s, _: _trifocal(s, 0, 1, 2),
    "T123": lambda s, _: _trifocal(s, 0, 1, 2),
    "T124": lambda s, _: _trifocal(s, 0, 1, 3),
    "X": lambda s, shape: s.points(shape[0])[..., : shape[1]],
    "X n 4": lambda s, shape: to_homogeneous(s.points(shape[0])),
    "X1": lambda s, _: s.space_lines(5)[0],
    "X2": lambda s, _: s.space_lines(5)[1],
    "Y": lambda s, shape: 2 * s.points(shape[0]) @ random_rotation(generator=s.generator, dtype=F64),
    "a": lambda s, shape: s.randn(*shape),
    "a m n batch": lambda s, shape: s.randn(3, 5, shape[2]),
    "angles": lambda s, shape: s.rand(3, low=-3.0, high=3.0),
    "aspect": lambda s, _: s.rand(low=0.9, high=1.1),
    "b": lambda s, shape: s.randn(*shape),
    "c": lambda s, shape: _polynomial(s, shape[0]),
    "c 2": lambda s, _: s.parameters(1)[0][..., 0, :2, 2],
    "c1 2": lambda s, _: s.parameters(1)[0][..., 0, :2, 2],
    "c2 2": lambda s, _: s.parameters(2)[0][..., 1, :2, 2],
    "c1 p 2": lambda s, shape: s.parameters(1)[0][..., :2, 2].expand(*s.batch, shape[0], 2),
    "c2 p 2": lambda s, shape: s.parameters(1)[0][..., :2, 2].expand(*s.batch, shape[0], 2),
    "centre": lambda s, shape: s.rand(*shape, low=-2.0, high=2.0),
    "d": lambda s, shape: s.rays(0, shape[0]),
    "d1": lambda s, shape: s.rays(0, shape[0]),
    "d2": lambda s, shape: s.rays(1, shape[0]),
    "depths": _weights,
    "ends": _line_ends,
    "f": lambda s, _: s.rand(low=500.0, high=1000.0),
    "g": lambda s, _: _up(s, 0),
    "gravity1": lambda s, _: _up(s, 0),
    "gravity2": lambda s, _: _up(s, 1),
    "image_size 2": lambda s, _: torch.tensor(SIZE, dtype=F64).expand(*s.batch, 2),
    "image_size #v 2": lambda s, _: torch.tensor(SIZE, dtype=F64).expand(*s.batch, 1, 2),
    "index": _index,
    "l": lambda s, shape: _all_lines(s, shape) if len(shape) == 3 else s.lines(0, shape[0]),
    **{f"l{i + 1}": _line(i) for i in range(4)},
    "line_weights": _weights,
    "logits": lambda s, shape: s.randn(*shape),
    "mask": _mask,
    "p": lambda s, _: 0.1 * s.randn(3),
    "plane 4": lambda s, _: s.randn(4),
    "plane1": lambda s, _: s.randn(4),
    "plane2": lambda s, _: s.randn(4),
    "present": _mask,
    "q": lambda s, _: quaternion_wxyz_from_rotation(s.parameters(2)[1][..., 1, :, :]),
    "quality": _weights,
    "scores": _weights,
    "skew": lambda s, _: s.rand(low=-0.1, high=0.1),
    "t": lambda s, _: s.parameters(2)[2][..., 1, :],
    "target": lambda s, _: s.rand(3, low=-1.0, high=1.0) + 5,
    "tolerance": lambda s, shape: s.rand(*shape, low=0.01, high=0.1),
    "up": lambda s, _: torch.tensor([0.0, -1.0, 0.0], dtype=F64).expand(*s.batch, 3),
    "v": lambda s, _: s.randn(3),
    "visible": _mask,
    "w": lambda s, _: s.randn(3),
    "weights": _weights,
    "x v n k 2": _edge_points,
    "x n 2": lambda s, shape: s.images(1, shape[0])[..., 0, :, :],
    "x 4 2": lambda s, shape: s.images(1, 4)[..., 0, :, :],
    "x n d": lambda s, shape: s.points(shape[0])[..., : shape[1]],
    "x d": lambda s, shape: s.randn(*shape),
    "x k": lambda s, shape: s.randn(*shape),
    **{f"x {dims}": lambda s, shape: s.images(*shape[:2]) for dims in ("v n 2", "3 n 2", "4 n 2", "3 4 2", "3 6 2", "4 4 2")},
    **{f"x{i + 1}": _image(i) for i in range(4)},
}  # fmt: skip
