"""Ellipses in space of a model, and the ellipses of images that show them."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_index, check_options, check_tensors, tensor_map
from torchsfm.bundle import BundleConics
from torchsfm.geometry import Ellipse, Ellipsoid, Similarity
from torchsfm.optim import Loss


@dataclass(frozen=True)
class Conics:
    """Ellipses in space and their tracks: what images show of them, as `detect_ellipses` and `fit_ellipse` measure it.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> scene = torchsfm.simulation.simulate_conics((), conics=2, views=3, generator=g)
        >>> seen = torchsfm.geometry.ellipse_from_conic(scene.C)[0]
        >>> seen = torchsfm.Ellipse(seen.centre.flatten(0, 1), seen.semi_axes.flatten(0, 1), seen.angle.flatten())
        >>> view, conic = torch.arange(3).repeat_interleave(2), torch.arange(2).repeat(3)
        >>> conics = torchsfm.reconstruction.Conics.of(scene.model, seen, torch.eye(5).double().expand(6, 5, 5), view, conic)
        >>> len(conics), conics.support(), conics.outlines(100).shape  # how many images show each, and points to draw
        (2, tensor([3, 3]), torch.Size([2, 100, 3]))
    """

    centre: Float[Tensor, "n 3"]
    """In the world."""
    axes: Float[Tensor, "n 2 3"]
    """Semi-axes as rows, perpendicular to each other, the longer first."""
    color: Float[Tensor, "n 3"]
    """Red, green, blue in [0, 1]."""
    x: Float[Tensor, "k 5"]
    """Measured centres, semi-axes and angles, pixels and radians."""
    covariance: Float[Tensor, "k 5 5"]
    """Of these."""
    view: Int[Tensor, "k"]
    """Image of each measured ellipse."""
    conic: Int[Tensor, "k"]
    """The ellipse in space that it shows."""

    def __post_init__(self) -> None:
        check_tensors(
            centre=(self.centre, "n 3"), axes=(self.axes, "n 2 3"), color=(self.color, "n 3"), x=(self.x, "k 5"),
            covariance=(self.covariance, "k 5 5"), view=(self.view, "k: int"), conic=(self.conic, "k: int"),
        )  # fmt: skip
        check_index(conic=(self.conic, len(self.centre)))

    def __len__(self) -> int:
        """Number of ellipses in space."""
        return len(self.centre)

    @classmethod
    def of(
        cls,
        model: Ellipsoid,
        ellipse: Ellipse,
        covariance: Float[Tensor, "k 5 5"],
        view: Int[Tensor, "k"],
        conic: Int[Tensor, "k"],
        color: Float[Tensor, "n 3"] | None = None,
    ) -> "Conics":
        """From ellipses in space, as `triangulate_conics` gives them, and measured ones; grey where no colours are given."""
        check_options(model=(model, Ellipsoid), ellipse=(ellipse, Ellipse))
        color = torch.full_like(model.centre, 0.5) if color is None else color
        x = torch.cat((ellipse.centre, ellipse.semi_axes, ellipse.angle[:, None]), -1)
        return cls(model.centre, model.axes[:, :2], color, x, covariance, view, conic)

    @property
    def model(self) -> Ellipsoid:
        """The ellipses in space, flat ellipsoids."""
        return Ellipsoid(self.centre, torch.nn.functional.pad(self.axes, (0, 0, 0, 1)))

    @property
    def ellipse(self) -> Ellipse:
        """The measured ellipses."""
        return Ellipse(self.x[:, :2], self.x[:, 2:4], self.x[:, 4])

    def support(self) -> Int[Tensor, "n"]:
        """Number of images that show each ellipse."""
        pairs = torch.unique(torch.stack((self.conic, self.view)), dim=1)
        return torch.bincount(pairs[0], minlength=len(self))

    def outlines(self, count: int = 64) -> Float[Tensor, "n c 3"]:
        """Points around each ellipse, evenly spread by its parameter."""
        check_options(count=(count, "int >= 3"))
        t = torch.arange(count, dtype=self.axes.dtype, device=self.axes.device) * (2 * math.pi / count)
        return self.centre[:, None] + torch.stack((t.cos(), t.sin()), -1) @ self.axes

    def chords(self, count: int = 64) -> Float[Tensor, "nc 2 3"]:
        """The outlines as pieces of straight lines, those of each ellipse after those of the one before."""
        x = self.outlines(count)
        return torch.stack((x, x.roll(-1, 1)), 2).flatten(0, 1)

    def select(self, keep: Bool[Tensor, "n"]) -> "Conics":
        """Some of the ellipses, with what images show of them."""
        seen, number = self.seen_where(keep[self.conic]), keep.cumsum(0) - 1
        return replace(seen, centre=self.centre[keep], axes=self.axes[keep], color=self.color[keep], conic=number[seen.conic])

    def seen_where(self, keep: Bool[Tensor, "k"]) -> "Conics":
        """All ellipses, with some of the measured ones."""
        x, covariance, view, conic = (t[keep] for t in (self.x, self.covariance, self.view, self.conic))
        return Conics(self.centre, self.axes, self.color, x, covariance, view, conic)

    def detached(self) -> "Conics":
        """The same as plain numbers on the CPU."""
        return tensor_map(lambda t: t.detach().cpu(), self)

    def transform(self, similarity: Similarity) -> "Conics":
        """The same in another world frame."""
        return self.moved_to(self.model.transform(similarity))

    def bundle(self, *, unit: float = 1.0, loss: Loss | None = None) -> BundleConics:
        """As a part of a bundle in which an observation of a point has the standard deviation `unit`, pixels."""
        return BundleConics(self.model, self.ellipse, self.view, self.conic, self.covariance / unit**2, loss=loss)

    def adjusted(self, structure: BundleConics) -> "Conics":
        """The same where that part of a bundle was moved to."""
        return self.moved_to(structure.model)

    def moved_to(self, model: Ellipsoid) -> "Conics":
        """The same where they were adjusted to."""
        return replace(self, centre=model.centre, axes=model.axes[:, :2])
