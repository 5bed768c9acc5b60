"""Poses: rigid motions from world to camera coordinates."""

from collections.abc import Sequence
from dataclasses import dataclass
from types import EllipsisType
from typing import Any, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import check_tensors, tensor_map
from torchsfm.geometry.rotations import rotation_from_rotvec

Index: TypeAlias = int | slice | EllipsisType | Tensor | list[int] | None


def index_batch(tensor: Tensor, index: Index | tuple[Index, ...], trailing: int) -> Tensor:
    """Index the leading dimensions of a tensor, all but the last `trailing` ones."""
    items: tuple[Any, ...] = index if isinstance(index, tuple) else (index,)
    return tensor[(*items, *(slice(None),) * trailing)]


def check_alike(name: str, matrices: Sequence[Float[Tensor, "*_ 3 3"]]) -> None:
    """Check that there are some, of one batch shape, dtype and device.

    Raises:
        ValueError: They are not.
    """
    if not matrices:
        raise ValueError(f"{name}: wanted at least one, got none")
    check_tensors(**{f"{name}[{i}]": (matrix, "3 3") for i, matrix in enumerate(matrices)})
    wanted = tuple(matrices[0].shape[:-2])
    for i, matrix in enumerate(matrices):
        if matrix.shape[:-2] != wanted:
            raise ValueError(f"{name}[{i}]: wanted batch dimensions {wanted} as {name}[0] has, got {tuple(matrix.shape[:-2])}")


@dataclass(frozen=True)
class Pose:
    """Rigid motion `X_cam = R X + t`, camera from world, with any leading batch dimensions.

    Compose with `@` (`cam2_from_cam1 @ cam1_from_world`), index the batch with `pose[i]`.

    Example:
        >>> import torch, torchsfm
        >>> R = torchsfm.geometry.rotation_from_rotvec(torch.tensor([0.0, 0.0, torch.pi / 2]))
        >>> pose = torchsfm.Pose(R, torch.tensor([0.0, 0.0, 2.0]))
        >>> pose.transform(torch.tensor([[1.0, 0.0, 3.0]])).round(decimals=3).abs()
        tensor([[0., 1., 5.]])
        >>> bool((pose.inverse() @ pose).R.allclose(torch.eye(3), atol=1e-6))
        True
    """

    R: Float[Tensor, "*batch 3 3"]
    """Rotation matrix."""
    t: Float[Tensor, "*batch 3"]
    """Translation: the origin of the world in the camera's frame."""

    def __post_init__(self) -> None:
        check_tensors(R=(self.R, "3 3"), t=(self.t, "3"))
        if self.R.shape[:-2] != self.t.shape[:-1]:
            raise ValueError(f"t: wanted shape {(*self.R.shape[:-2], 3)} as R has batch, got {tuple(self.t.shape)}")

    @classmethod
    def identity(cls, *shape: int, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> "Pose":
        """Make poses that change nothing, with batch dimensions `shape`."""
        eye = torch.eye(3, dtype=dtype, device=device)
        return cls(eye.repeat(*shape, 1, 1), torch.zeros(*shape, 3, dtype=dtype, device=device))

    @classmethod
    def from_matrix(cls, Rt: Float[Tensor, "*batch rows 4"]) -> "Pose":
        """Split `[R | t]`, 3x4 or 4x4 with last row (0, 0, 0, 1), without looking at the values."""
        check_tensors(Rt=(Rt, "rows>=3 4"))
        return cls(Rt[..., :3, :3], Rt[..., :3, 3])

    @property
    def shape(self) -> torch.Size:
        """The batch dimensions."""
        return self.t.shape[:-1]

    @property
    def centre(self) -> Float[Tensor, "*batch 3"]:
        """The centre of the camera in the world, -R't."""
        return -(self.R.mT @ self.t[..., None]).squeeze(-1)

    def matrix(self) -> Float[Tensor, "*batch 3 4"]:
        """Join `[R | t]`, the camera matrix of a calibrated camera."""
        return torch.cat([self.R, self.t[..., None]], -1)

    def inverse(self) -> "Pose":
        """Exchange the two frames: world from camera."""
        return Pose(self.R.mT, self.centre)

    def __matmul__(self, other: "Pose") -> "Pose":
        """Apply `other` first, then this one; batches broadcast."""
        R = self.R @ other.R
        t = (self.R @ other.t[..., None]).squeeze(-1) + self.t
        return Pose(R, t.expand(*R.shape[:-2], 3))

    def transform(self, X: Float[Tensor, "*#batch n 3"]) -> Float[Tensor, "*#batch n 3"]:
        """Move points from world to camera coordinates; batches broadcast."""
        check_tensors(X=(X, "n 3"), R=(self.R, "3 3"))
        return X @ self.R.mT + self.t[..., None, :]

    def retract(self, delta: Float[Tensor, "*#batch 6"]) -> "Pose":
        """Perturb on the left, in the camera's frame: with delta = (w, v), R becomes exp(w) R and t becomes exp(w) t + v."""
        check_tensors(delta=(delta, "6"), R=(self.R, "3 3"))
        turn = rotation_from_rotvec(delta[..., :3])
        R = turn @ self.R
        t = (turn @ self.t[..., None]).squeeze(-1) + delta[..., 3:]
        return Pose(R, t)

    def to(self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> "Pose":
        """The poses in another dtype or on another device."""
        return tensor_map(lambda t: t.to(dtype=dtype, device=device), self)

    @classmethod
    def stack(cls, poses: Sequence["Pose"]) -> "Pose":
        """Put poses of equal batch dimensions along a new first one; `pose[i]` takes them out again."""
        check_alike("poses", [pose.R for pose in poses])
        return cls(torch.stack([pose.R for pose in poses]), torch.stack([pose.t for pose in poses]))

    def __getitem__(self, index: Index | tuple[Index, ...]) -> "Pose":
        """Index the batch dimensions."""
        return Pose(index_batch(self.R, index, 2), index_batch(self.t, index, 1))
