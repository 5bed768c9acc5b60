"""What is assumed of the intrinsics: which are free, which differ from view to view.

The unknowns of a view are its five relative numbers (`torchsfm.geometry.intrinsic_parameters`), in images of unit size.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry.intrinsic_parameters import HEAD, INTRINSICS, intrinsic_columns, intrinsic_labels


@dataclass(frozen=True)
class Assumption:
    """Which intrinsics are estimated, and which of those differ from view to view.

    What is not `free` is known: aspect 1, skew 0 and the principal point in the middle of the image, unless `K` is given to the
    function that takes the assumption. What is free but not `varying` is the same in all views. A free principal point is
    expected within `principal_point_sigma` (a standard deviation, over the longer side of the image) of that place; None
    expects nothing.

    Example:
        >>> from torchsfm.autocalibration import Assumption
        >>> print(Assumption(free=("focal",), varying=("focal",)))
        focal length different in each view; aspect, skew, principal point known
    """

    free: tuple[str, ...] = ("focal", "principal_point")
    varying: tuple[str, ...] = ()
    principal_point_sigma: float | None = 0.02

    def __post_init__(self) -> None:
        for argument in ("free", "varying"):
            intrinsic_columns(getattr(self, argument), argument=argument)
        if "focal" not in self.free:
            raise ValueError("free: wanted 'focal' among the free parameters")
        if not set(self.varying) <= set(self.free):
            raise ValueError(f"varying: wanted some of {self.free}, got {self.varying}")
        if self.principal_point_sigma is not None and not self.principal_point_sigma > 0:
            raise ValueError(f"principal_point_sigma: wanted a positive number or None, got {self.principal_point_sigma}")

    def __str__(self) -> str:
        """In words."""
        same = [INTRINSICS[name].words for name in self.free if name not in self.varying]
        differ = [INTRINSICS[name].words for name in self.varying]
        known = [intrinsic.words for name, intrinsic in INTRINSICS.items() if name not in self.free]
        parts = [
            (", ".join(same), "the same in all views"),
            (", ".join(differ), "different in each view"),
            (", ".join(known), "known"),
        ]
        return "; ".join(f"{what} {how}" for what, how in parts if what)

    def columns(self, v: int) -> list[tuple[int, int | None]]:
        """The unknowns as (parameter, view), view None where they are common to all."""
        found: list[tuple[int, int | None]] = []
        for name in (name for name in INTRINSICS if name in self.free):
            for parameter in INTRINSICS[name].columns:
                found += [(parameter, i) for i in range(v)] if name in self.varying else [(parameter, None)]
        return found

    def names(self, v: int) -> tuple[str, ...]:
        """The unknowns in words."""
        labels = intrinsic_labels()
        return tuple(labels[p] + ("" if i is None else f" {i}") for p, i in self.columns(v))

    def spread(self, v: int, like: Tensor) -> Float[Tensor, "v 5 q"]:
        """The matrix that takes the unknowns to the five parameters of every view."""
        columns = self.columns(v)
        S = like.new_zeros(v, HEAD, len(columns))
        for k, (parameter, view) in enumerate(columns):
            S[slice(None) if view is None else view, parameter, k] = 1
        return S

    def precision(self, v: int, like: Tensor) -> Float[Tensor, " q"]:
        """One over the standard deviation of each unknown before any image was seen; 0 where nothing is known.

        Aspects are expected within 5 % and skews within 0.05 of a focal length where they are free.
        """
        known = [0.0, 20.0, 20.0, *([0.0 if self.principal_point_sigma is None else 1 / self.principal_point_sigma] * 2)]
        return like.new_tensor([known[parameter] for parameter, _ in self.columns(v)])


CONSTANT = Assumption()
VARYING_FOCAL = Assumption(varying=("focal",))


def inverse_intrinsics(K: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The inverse of upper triangular K with last row (0, 0, 1)."""
    a, s, c, b, d = K[..., 0, 0], K[..., 0, 1], K[..., 0, 2], K[..., 1, 1], K[..., 1, 2]
    zero, one = torch.zeros_like(a), torch.ones_like(a)
    rows = (1 / a, -s / (a * b), (s * d - c * b) / (a * b), zero, 1 / b, -d / b, zero, zero, one)
    return torch.stack(rows, -1).reshape(*a.shape, 3, 3)
