"""Cameras: intrinsics with distortion, and 3x4 camera matrices."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import broadcast_shapes, check_options, check_tensors, tensor_map
from torchsfm.geometry.distortion import NoDistortion
from torchsfm.geometry.distortion_model import Distortion
from torchsfm.geometry.homogeneous import divide_safely, finite_or_zero
from torchsfm.geometry.poses import Index, Pose, check_alike, index_batch
from torchsfm.linalg.magnitude import all_below


@dataclass(frozen=True)
class Camera:
    """The inside of a camera: intrinsics K and lens distortion, with any leading batch dimensions.

    Index the batch with `camera[i]`; so `camera[camera_index]` gives every view its camera.

    Example:
        >>> import torch, torchsfm
        >>> camera = torchsfm.Camera(torchsfm.intrinsics(torch.tensor(800.0), torch.tensor([320.0, 240.0])))
        >>> camera.project(torch.tensor([[0.0, 0.0, 2.0], [1.0, -0.5, 4.0]]))
        tensor([[320., 240.],
                [520., 140.]])
        >>> d, valid = camera.unproject(torch.tensor([[520.0, 140.0]]))
        >>> d
        tensor([[ 0.2500, -0.1250,  1.0000]])
    """

    K: Float[Tensor, "*batch 3 3"]
    """Upper triangular, last row (0, 0, 1), in pixels."""
    distortion: Distortion = field(default_factory=NoDistortion)

    def __post_init__(self) -> None:
        check_tensors(K=(self.K, "3 3"))
        for name in self.distortion.parameter_names:
            parameter = getattr(self.distortion, name)
            check_tensors(K=(self.K, "3 3"), **{f"distortion.{name}": (parameter, "")})
            if parameter.shape != self.K.shape[:-2]:
                raise ValueError(
                    f"distortion.{name}: wanted shape {tuple(self.K.shape[:-2])} as K has batch, got {tuple(parameter.shape)}"
                )

    @property
    def shape(self) -> torch.Size:
        """The batch dimensions."""
        return self.K.shape[:-2]

    def project(self, X_cam: Float[Tensor, "*#batch n 3"]) -> Float[Tensor, "*#batch n 2"]:
        """Project points in camera coordinates to pixels.

        Args:
            X_cam: Points in camera coordinates, or rays.

        Returns:
            Pixels, finite always; see `in_domain` for which of the points a real camera could show.
        """
        u = self.distortion.project(X_cam)
        return u @ self.K[..., :2, :2].mT + self.K[..., None, :2, 2]

    def unproject(self, x: Float[Tensor, "*#batch n 2"]) -> tuple[Float[Tensor, "*#batch n 3"], Bool[Tensor, "*#batch n"]]:
        """Find the ray of each pixel, K and distortion removed.

        Args:
            x: Pixels.

        Returns:
            Rays in camera coordinates, third coordinate 1 where possible (fisheye: unit length beyond 89.9 degrees off the
            axis), and the mask of those that exist: the pixel is finite, within the image of the distortion's valid radius,
            and K is regular.
        """
        check_tensors(x=(x, "n 2"), K=(self.K, "3 3"))
        K = self.K
        fx, fy, skew = K[..., 0, 0], K[..., 1, 1], K[..., 0, 1]
        regular = (fx != 0) & (fy != 0) & torch.isfinite(K).all((-2, -1))
        fx, fy = torch.where(regular, fx, 1.0), torch.where(regular, fy, 1.0)
        skew = torch.where(regular, skew, 0.0)
        centre = torch.where(regular[..., None], K[..., :2, 2], 0.0)
        known = all_below(x, torch.finfo(x.dtype).max / 4, 1)
        x = finite_or_zero(x)
        v = (x[..., 1] - centre[..., None, 1]) / fy[..., None]
        u = (x[..., 0] - centre[..., None, 0] - skew[..., None] * v) / fx[..., None]
        d, valid = self.distortion.unproject(torch.stack([u, v], -1))
        return d, valid & regular[..., None] & known

    def in_domain(self, X_cam: Float[Tensor, "*#batch n 3"]) -> Bool[Tensor, "*#batch n"]:
        """Tell which points lie in front of the camera and within the valid radius of its distortion."""
        return self.distortion.in_domain(X_cam)

    def to(self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> "Camera":
        """The cameras in another dtype or on another device."""
        return tensor_map(lambda t: t.to(dtype=dtype, device=device), self)

    @classmethod
    def stack(cls, cameras: Sequence["Camera"]) -> "Camera":
        """Put cameras of equal batch dimensions and one kind of distortion along a new first dimension.

        Raises:
            ValueError: There are none, or their shapes or kinds differ.
        """
        check_alike("cameras", [camera.K for camera in cameras])
        lenses = [camera.distortion for camera in cameras]
        kind = type(lenses[0])
        for i, lens in enumerate(lenses):
            if type(lens) is not kind:
                wanted = kind.__name__
                raise ValueError(f"cameras[{i}]: wanted distortion {wanted} as cameras[0] has, got {type(lens).__name__}")
        parameters = {name: torch.stack([getattr(lens, name) for lens in lenses]) for name in kind.parameter_names}
        return cls(torch.stack([camera.K for camera in cameras]), kind(**parameters))

    def __getitem__(self, index: Index | tuple[Index, ...]) -> "Camera":
        """Index the batch dimensions."""
        distortion = tensor_map(lambda parameter: index_batch(parameter, index, 0), self.distortion)
        return Camera(index_batch(self.K, index, 2), distortion)


def intrinsics(
    f: Float[Tensor, "*#batch"],
    c: Float[Tensor, "*#batch 2"],
    aspect: Float[Tensor, "*#batch"] | float = 1.0,
    skew: Float[Tensor, "*#batch"] | float = 0.0,
) -> Float[Tensor, "*batch 3 3"]:
    """Put together the intrinsic matrix.

    Args:
        f: Focal length along x, pixels.
        c: Principal point, pixels.
        aspect: Focal length along y divided by that along x.
        skew: Second entry of the first row, pixels.

    Returns:
        K, upper triangular.

    Example:
        >>> import torch, torchsfm
        >>> torchsfm.intrinsics(torch.tensor(800.0), torch.tensor([320.0, 240.0]))
        tensor([[800.,   0., 320.],
                [  0., 800., 240.],
                [  0.,   0.,   1.]])
    """
    batch = check_tensors(
        f=(f, ""),
        c=(c, "2"),
        aspect=(aspect if isinstance(aspect, Tensor) else None, "?"),
        skew=(skew if isinstance(skew, Tensor) else None, "?"),
    )
    numbers = (("aspect", aspect), ("skew", skew))
    check_options(**{name: (value, "float") for name, value in numbers if not isinstance(value, Tensor)})
    zero = torch.zeros_like(f)
    entries = [f, zero + skew, c[..., 0], zero, f * aspect, c[..., 1], zero, zero, zero + 1]
    return torch.stack([entry.expand(batch) for entry in entries], -1).reshape(*batch, 3, 3)


def camera_from_krt(
    K: Float[Tensor, "*#batch 3 3"], R: Float[Tensor, "*#batch 3 3"], t: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3 4"]:
    """Multiply out `P = K [R | t]`.

    Args:
        K: Intrinsics in pixels.
        R: Rotations from world to camera.
        t: The world's origin in the camera's frame.

    Example:
        >>> import torch, torchsfm
        >>> K = torchsfm.intrinsics(torch.tensor(500.0), torch.tensor([320.0, 240.0]))
        >>> torchsfm.geometry.camera_from_krt(K, torch.eye(3), torch.tensor([0.0, 0.0, 2.0]))
        tensor([[500.,   0., 320., 640.],
                [  0., 500., 240., 480.],
                [  0.,   0.,   1.,   2.]])
    """
    check_tensors(K=(K, "3 3"), R=(R, "3 3"), t=(t, "3"))
    left, right = K @ R, K @ t[..., None]
    batch = broadcast_shapes(left.shape[:-2], right.shape[:-2])
    return torch.cat([left.expand(*batch, 3, 3), right.expand(*batch, 3, 1)], -1)


def krt_from_camera(
    P: Float[Tensor, "*batch 3 4"],
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3"]]:
    """Take a finite camera apart: `P ~ K [R | t]` (HZ 6.2.4).

    The rows of the left 3x3 block are orthogonalised from the last upwards. Differentiable wherever the camera is finite.

    Args:
        P: Camera matrix, up to scale and sign.

    Returns:
        K with positive diagonal and last entry 1, R with determinant +1, and t. A camera whose centre is at infinity has no
        such decomposition (`camera_centre(P, homogeneous=True)` tells): there K and R are identities and t is zero.

    Example:
        >>> import torch, torchsfm
        >>> K = torchsfm.intrinsics(torch.tensor(800.0), torch.tensor([320.0, 240.0]))
        >>> P = torchsfm.geometry.camera_from_krt(K, torch.eye(3), torch.tensor([0.0, 0.0, 2.0]))
        >>> K_found, R, t = torchsfm.geometry.krt_from_camera(-5 * P)  # whatever the scale and sign
        >>> bool(K_found.allclose(K)), bool(t.allclose(torch.tensor([0.0, 0.0, 2.0])))
        (True, True)
    """
    check_tensors(P=(P, "3 4"))
    scale = P.detach().abs().amax((-2, -1), keepdim=True)
    usable = (scale > 0) & torch.isfinite(scale)
    P = torch.where(usable, P, 0.0) / torch.where(usable, scale, 1.0)
    determinant = _determinant(P[..., :3].detach())
    lengths = P[..., :3].detach().norm(dim=-1).prod(-1)
    finite = determinant.abs() > 32 * torch.finfo(P.dtype).eps * lengths
    eye = torch.eye(3, 4, dtype=P.dtype, device=P.device)
    P = torch.where(finite[..., None, None], P * torch.sign(determinant)[..., None, None], eye)
    m1, m2, m3 = P[..., :3].unbind(-2)
    k33 = _length(m3)
    r3 = m3 / k33
    k23 = _dot(m2, r3)
    rest = m2 - k23 * r3
    rest = rest - _dot(rest, r3) * r3  # once more, against rounding where rows are nearly parallel
    k22 = _length(rest)
    r2 = rest / k22
    r1 = torch.linalg.cross(r2, r3, dim=-1)
    k11, k12, k13 = _dot(m1, r1), _dot(m1, r2), _dot(m1, r3)
    zero, one = torch.zeros_like(k33), torch.ones_like(k33)
    entries = [k11 / k33, k12 / k33, k13 / k33, zero, k22 / k33, k23 / k33, zero, zero, one]
    K = torch.cat(entries, -1).reshape(*P.shape[:-2], 3, 3)
    p1, p2, p3 = P[..., 0, 3:], P[..., 1, 3:], P[..., 2, 3:]
    t3 = p3 / k33
    t2 = (p2 - k23 * t3) / k22
    t1 = (p1 - k12 * t2 - k13 * t3) / k11
    return K, torch.stack([r1, r2, r3], -2), torch.cat([t1, t2, t3], -1)


def camera_centre(P: Float[Tensor, "*batch 3 4"], *, homogeneous: bool = False) -> Float[Tensor, "*batch c"]:
    """Find the centre of cameras, the null vector of P, as its signed 3x3 minors (HZ 6.2.4).

    Args:
        P: Camera matrix, up to scale.
        homogeneous: Return the four coordinates, of unit length, which also tell cameras at infinity (the last one is zero).

    Returns:
        The centre (*batch, 3), very far away for a camera at infinity; or (*batch, 4).

    Example:
        >>> import torch, torchsfm
        >>> P = torch.tensor([[1.0, 0.0, 0.0, -3.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 5.0]])
        >>> torchsfm.geometry.camera_centre(P).tolist()
        [3.0, 0.0, -5.0]
    """
    check_tensors(P=(P, "3 4"))
    p1, p2, p3, p4 = P.unbind(-1)
    centre = torch.stack(
        [_triple(p2, p3, p4), -_triple(p1, p3, p4), _triple(p1, p2, p4), -_triple(p1, p2, p3)],
        -1,
    )
    if homogeneous:
        length = torch.linalg.vector_norm(centre, dim=-1, keepdim=True)
        return centre / torch.where(length > 0, length, 1.0)
    return divide_safely(centre[..., :3], centre[..., 3])


def project_points(
    P: Float[Tensor, "*#batch 3 4"] | Pose, X: Float[Tensor, "*#batch n 3"], camera: Camera | None = None
) -> Float[Tensor, "*batch n 2"]:
    """Project points by camera matrices, or by poses and what is inside the cameras.

    Args:
        P: Camera matrix; or a pose, `Pose` or `[R | t]`, if there is a `camera`.
        X: Points as rows.
        camera: Intrinsics and lens of the camera at the pose; that of the matrix `[I | 0]` if not given.

    Returns:
        Image points, finite always: a point in the focal plane is returned very far away in its own direction (about 1 /
        machine epsilon), and one with NaN or inf as the image of the origin.

    Example:
        >>> import torch, torchsfm
        >>> X = torch.tensor([[1.0, 2.0, 4.0]])
        >>> torchsfm.project_points(torch.eye(3, 4), X)
        tensor([[0.2500, 0.5000]])
        >>> camera = torchsfm.Camera(torchsfm.intrinsics(torch.tensor(800.0), torch.tensor([320.0, 240.0])))
        >>> torchsfm.project_points(torchsfm.Pose.identity(), X, camera)
        tensor([[520., 640.]])
    """
    matrix = P.matrix() if isinstance(P, Pose) else P
    check_tensors(P=(matrix, "3 4"), X=(X, "n 3"))
    y = finite_or_zero(X) @ matrix[..., :3].mT + matrix[..., None, :, 3]
    if camera is None:
        return divide_safely(y[..., :2], y[..., 2])
    check_options(camera=(camera, Camera))
    check_tensors(P=(matrix, "3 4"), X=(X, "n 3"), camera=(camera.K, "3 3"))
    return camera.project(y)


def point_depths(P: Float[Tensor, "*#batch 3 4"], X: Float[Tensor, "*#batch n 3"]) -> Float[Tensor, "*batch n"]:
    """Measure signed depths of points in front of cameras, in the unit of X (HZ 6.15).

    Args:
        P: Camera matrix, up to scale and sign.
        X: Points as rows.

    Returns:
        The distance from the focal plane, positive in front; 0 for cameras at infinity, which have none.

    Example:
        >>> import torch, torchsfm
        >>> P = torch.eye(3, 4)
        >>> torchsfm.geometry.point_depths(P, torch.tensor([[1.0, 2.0, 5.0], [0.0, 0.0, -3.0]]))
        tensor([ 5., -3.])
    """
    check_tensors(P=(P, "3 4"), X=(X, "n 3"))
    w = (X * P[..., None, 2, :3]).sum(-1) + P[..., 2:, 3]
    length = torch.linalg.vector_norm(P[..., 2, :3], dim=-1)
    sign = torch.sign(_determinant(P[..., :3].detach()))
    return w * (sign / torch.where(length > 0, length, 1.0))[..., None]


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1, keepdim=True)


def _length(a: Tensor) -> Tensor:
    length: Tensor = torch.linalg.vector_norm(a, dim=-1, keepdim=True)
    return length


def _triple(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    product: Tensor = (a * torch.linalg.cross(b, c, dim=-1)).sum(-1)
    return product


def _determinant(M: Tensor) -> Tensor:
    return _triple(M[..., 0], M[..., 1], M[..., 2])
