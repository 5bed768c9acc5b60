"""What is expected of cameras before any image point was seen."""

from collections.abc import Iterable
from collections.abc import Mapping as Dict
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.bundle.intrinsics import free_columns
from torchsfm.geometry import Camera
from torchsfm.geometry.intrinsic_parameters import FOCAL, camera_from_row, row_from_camera
from torchsfm.optim import Term
from torchsfm.reconstruction.mapping import Mapping

PRINCIPAL_POINT_SIGMA = 0.01
"""How far principal points lie from the middle of the image, as a fraction of its longer side."""
CROPPED_SIGMA = 0.1
"""The same where images may have been cut out of larger ones."""
RADIAL_SIGMA = 0.3
TANGENTIAL_SIGMA = 0.01
"""How large the distortion parameters of lenses are."""
ALIKE = 1e-3
"""By how much the numbers of one camera may differ, as a fraction of how uncertain they were: a tie that steps can follow."""


@dataclass(frozen=True)
class CameraPrior:
    """What is expected of the cameras before any image point was seen.

    Attributes:
        mean: The cameras expected.
        sigma: Standard deviations by the names `bundle_adjust` knows: of "focal" as a fraction, of others in their own unit.
        cropped: Whether images may have been cut out of larger ones.
        alike: Whether all are one camera then: principal points alone differ.
    """

    mean: Camera
    sigma: Dict[str, Float[Tensor, "g"]]
    cropped: bool = False
    alike: bool = False

    @classmethod
    def of(
        cls, mapping: Mapping, mean: Camera, focal_sigma: Float[Tensor, "g"], *, cropped: bool = False, alike: bool = False
    ) -> "CameraPrior":
        """The prior of the cameras of a mapping: principal points about the middle, no distortion."""
        g = len(mean.K)
        size = mapping.graph.image_size.max(-1).values.to(mean.K.dtype)
        side = torch.ones_like(focal_sigma).scatter_reduce(0, mapping.camera_index, size, "amax")
        off = CROPPED_SIGMA if cropped else PRINCIPAL_POINT_SIGMA
        sigma = {"focal": focal_sigma, "principal_point": off * side}
        for name in mean.distortion.parameter_names:
            width = TANGENTIAL_SIGMA if name in ("p1", "p2") else RADIAL_SIGMA
            sigma[name] = torch.full((g,), width, dtype=mean.K.dtype)
        return cls(mean, sigma, cropped, alike)

    def terms(self, noise: float, names: Iterable[str], used: Bool[Tensor, "g"]) -> dict[str, Any]:
        """The prior in the words of `bundle_adjust`, for a cost that takes the image points' noise to be one pixel.

        Args:
            noise: That noise in pixels.
            names: Numbers that are free in some camera.
            used: Cameras of registered images.
        """
        known = {name: self.sigma[name] / noise for name in names}
        terms: dict[str, Any] = {"intrinsics_sigma": known, "intrinsics_mean": self.mean}
        lens = [name for name in known if name != "principal_point"]
        index = used.nonzero()[:, 0]
        if self.alike and lens and len(index) > 1:
            columns = free_columns(lens, type(self.mean.distortion))
            width = {c: self.sigma[name].amin() for name in lens for c in free_columns((name,), type(self.mean.distortion))}
            scale = [ALIKE * width[c] * (self.mean.K[index, 0, 0].mean() if c == FOCAL else 1.0) for c in columns]
            terms["priors"] = (_Alike(index, torch.tensor(columns), torch.stack(scale)),)
        return terms

    def against(self, excess: float) -> "CameraPrior":
        """The prior with more weight, for image points that say less than their noise lets them, by a variance ratio."""
        return replace(self, sigma={name: width / excess**0.5 for name, width in self.sigma.items()})

    def made_alike(self, cameras: Camera, used: Bool[Tensor, "g"]) -> Camera:
        """The cameras with the lens that those in use have on average, if all are one."""
        if not self.alike or not bool(used.any()):
            return cameras
        rows = row_from_camera(cameras)
        lens = list(free_columns(("focal", *cameras.distortion.parameter_names), type(cameras.distortion)))
        rows[:, lens] = rows[used][:, lens].mean(0)
        return camera_from_row(rows, type(cameras.distortion))


@dataclass(frozen=True)
class _Alike:
    """Some numbers are the same in all of some cameras: each is held to the first."""

    index: Int[Tensor, "k"]
    columns: Int[Tensor, "c"]
    sigma: Float[Tensor, "c"]
    block = "camera"

    def term(self) -> Term:
        """The prior as a term of the optimiser."""

        def residual(first: Tensor, other: Tensor, sigma: Tensor) -> Tensor:
            return (other[:, self.columns] - first[:, self.columns]) / sigma

        first, others = self.index[:1].expand(len(self.index) - 1), self.index[1:]
        return Term(residual, ("camera", "camera"), (first, others), (self.sigma.expand(len(others), -1),))
