"""What is expected of cameras before any image point was seen."""

from collections.abc import Iterable, Iterator
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
from torchsfm.reconstruction.mapping.mapping import Mapping

PRINCIPAL_POINT_SIGMA = 0.01
"""How far principal points lie from the middle of the image, as a fraction of its longer side."""
CROPPED_SIGMA = 0.1
"""The same where images may have been cut out of larger ones."""
ONE_BODY = 0.002
"""How far apart, in the same unit, those of one camera lie as its lens zooms."""
ASPECT_SIGMA = 0.01
"""By how much the shape of pixels may differ from what it was found to be, as a ratio of sides."""
RADIAL_SIGMA = 0.3
TANGENTIAL_SIGMA = 0.01
"""How large the distortion parameters of lenses are."""
NOT_KNOWN = 1e6
"""Times the width of a prior that says nothing."""
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
        body: Cameras of the same number are one with a zoom lens, unless images were cropped: its sensor keeps its place, and
            their principal points lie off the middle by about the same. Each by itself where None.
    """

    mean: Camera
    sigma: Dict[str, Float[Tensor, "g"]]
    cropped: bool = False
    alike: bool = False
    body: Int[Tensor, "g"] | None = None

    @classmethod
    def of(
        cls,
        mapping: Mapping,
        mean: Camera,
        focal_sigma: Float[Tensor, "g"],
        *,
        cropped: bool = False,
        alike: bool = False,
        body: Int[Tensor, "g"] | None = None,
    ) -> "CameraPrior":
        """The prior of the cameras of a mapping: principal points about the middle, pixels as they are, no distortion."""
        g = len(mean.K)
        size = mapping.graph.image_size.max(-1).values.to(mean.K.dtype)
        side = torch.ones_like(focal_sigma).scatter_reduce(0, mapping.camera_index, size, "amax")
        off = CROPPED_SIGMA if cropped else PRINCIPAL_POINT_SIGMA
        sigma = {"focal": focal_sigma, "aspect": torch.full_like(focal_sigma, ASPECT_SIGMA), "principal_point": off * side}
        for name in mean.distortion.parameter_names:
            width = TANGENTIAL_SIGMA if name in ("p1", "p2") else RADIAL_SIGMA
            sigma[name] = torch.full((g,), width, dtype=mean.K.dtype)
        return cls(mean, sigma, cropped, alike, None if cropped else body)

    def terms(self, noise: float, names: Iterable[str], used: Bool[Tensor, "g"]) -> dict[str, Any]:
        """The prior in the words of `bundle_adjust`, for a cost that takes the image points' noise to be one pixel.

        Args:
            noise: That noise in pixels.
            names: Numbers that are free in some camera.
            used: Cameras of registered images.
        """
        known = {name: self.sigma[name] / noise for name in names}
        terms: dict[str, Any] = {"intrinsics_sigma": known, "intrinsics_mean": self.mean}
        ties = list(self._one_lens(known, used))
        first = self._first_of_body(used)
        others = (first != torch.arange(len(used))).nonzero()[:, 0]
        if "principal_point" in known and len(others):
            # The first of a body lies as principal points do, the others where the first does.
            width, columns = known["principal_point"], free_columns(("principal_point",), type(self.mean.distortion))
            known["principal_point"] = width.index_fill(0, others, NOT_KNOWN * float(width.amax()))
            apart = ONE_BODY / PRINCIPAL_POINT_SIGMA * width[others]
            ties.append(_Alike(first[others], others, torch.tensor(columns), apart[:, None].expand(-1, len(columns))))
        return terms | {"priors": tuple(ties)} if ties else terms

    def _one_lens(self, known: dict[str, Float[Tensor, "g"]], used: Bool[Tensor, "g"]) -> Iterator["_Alike"]:
        """All but the principal points, where all cameras are one."""
        model, index = type(self.mean.distortion), used.nonzero()[:, 0]
        lens = [name for name in known if name != "principal_point"]
        if self.alike and lens and len(index) > 1:
            columns = free_columns(lens, model)
            width = {c: self.sigma[name].amin() for name in lens for c in free_columns((name,), model)}
            scale = [ALIKE * width[c] * (self.mean.K[index, 0, 0].mean() if c == FOCAL else 1.0) for c in columns]
            first, others = index[:1].expand(len(index) - 1), index[1:]
            yield _Alike(first, others, torch.tensor(columns), torch.stack(scale).expand(len(others), -1))

    def sum_of_body(self, count: Int[Tensor, "g"]) -> Int[Tensor, "g"]:
        """For each camera, what all cameras of its body have of something: images, say."""
        return count if self.body is None else torch.zeros_like(count).index_add(0, self.body, count)[self.body]

    def _first_of_body(self, used: Bool[Tensor, "g"]) -> Int[Tensor, "g"]:
        """For each camera in use the first one in use of its body; itself for others."""
        own = torch.arange(len(used))
        if self.body is None:
            return own
        first = torch.full_like(own, len(used)).scatter_reduce(0, self.body[used], own[used], "amin")
        return torch.where(used, first[self.body], own)

    def against(self, excess: float) -> "CameraPrior":
        """The prior with more weight, for image points that say less than their noise lets them, by a variance ratio."""
        return replace(self, sigma={name: width / excess**0.5 for name, width in self.sigma.items()})

    def widened(self, name: str, sigma: float) -> "CameraPrior":
        """The prior that says so little of one of the numbers."""
        return replace(self, sigma={**self.sigma, name: torch.full_like(self.sigma[name], sigma)})

    def made_alike(self, cameras: Camera, used: Bool[Tensor, "g"]) -> Camera:
        """The cameras with the lens that those in use have on average, if all are one."""
        if not self.alike or not bool(used.any()):
            return cameras
        rows = row_from_camera(cameras)
        lens = list(free_columns(("focal", "aspect", *cameras.distortion.parameter_names), type(cameras.distortion)))
        rows[:, lens] = rows[used][:, lens].mean(0)
        return camera_from_row(rows, type(cameras.distortion))


@dataclass(frozen=True)
class _Alike:
    """Some numbers are about the same in pairs of cameras."""

    first: Int[Tensor, "k"]
    index: Int[Tensor, "k"]
    columns: Int[Tensor, "c"]
    sigma: Float[Tensor, "k c"]
    block = "camera"

    def term(self) -> Term:
        """The prior as a term of the optimiser."""

        def residual(first: Tensor, other: Tensor, sigma: Tensor) -> Tensor:
            return (other[:, self.columns] - first[:, self.columns]) / sigma

        return Term(residual, ("camera", "camera"), (self.first, self.index), (self.sigma,))
