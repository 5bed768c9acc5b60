"""How many samples of curves lie next to edges of images, and how many would by chance?"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.reconstruction.curves.edge_maps import EdgeMap, EdgeMaps

_NEAR = 1.0
"""Pixels between a sample and an edge next to it."""
_ALONG = 0.85
"""Least cosine of the angle between an edge and the image of a curve."""
_ASIDE = (6.0, 9.0, 13.0, 17.0)
"""Pixels by which samples are moved across their curve, to both sides, to count edges that chance puts there."""
_CHANCE = 0.02
"""Hits by chance that are expected of a sample, at least."""
_RUN = 24
"""Samples of a curve that are as good as one: what is wrong with one of them is with all."""


@dataclass(frozen=True)
class Foretold:
    """Samples that are looked for in images, of each image."""

    samples: Float[Tensor, "f"]
    """Those that fall into it."""
    hits: Float[Tensor, "f"]
    """Of these, those next to an edge that runs as they do."""
    chance: Float[Tensor, "f"]
    """As many as are so some pixels aside."""
    runs: Float[Tensor, "f"]
    """Sum of the squares of how many samples each run of them has."""

    @classmethod
    def none(cls, images: int) -> "Foretold":
        """Nothing, in so many images."""
        return cls(*(torch.zeros(images, dtype=torch.float64) for _ in fields(cls)))

    @classmethod
    def cat(cls, parts: Sequence["Foretold"]) -> "Foretold":
        """Those of more images."""
        return cls(*(torch.cat([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    def total(self) -> "Foretold":
        """All images as one."""
        return Foretold(*(getattr(self, field.name).sum(0, keepdim=True) for field in fields(self)))

    @property
    def agreement(self) -> Float[Tensor, "f"]:
        """The share of samples that are there beyond chance: 0 with wrong poses, 1 if all are. 0 where nothing was asked."""
        return (self.hits - self.chance) / (self.samples - self.chance).clamp_min(1.0)

    @property
    def sigma(self) -> Float[Tensor, "f"]:
        """Standard deviation of hits by chance, at least 1: runs hit as a whole."""
        share = (self.chance / self.samples.clamp_min(1.0)).clamp(_CHANCE, 0.5)
        return (self.runs * share * (1 - share)).sqrt().clamp_min(1.0)

    @property
    def excess(self) -> Float[Tensor, "f"]:
        """Hits beyond chance, in standard deviations of chance."""
        return (self.hits - self.chance) / self.sigma


def foretold_edges(
    X: Float[Tensor, "n 3"],
    tangent: Float[Tensor, "n 3"],
    run: Int[Tensor, "n"],
    maps: Sequence[EdgeMap],
    P: Float[Tensor, "f 3 4"],
    size: tuple[int, int],
) -> Foretold:
    """Look for samples of curves in images.

    Args:
        X: The samples.
        tangent: Which way their curves run.
        run: Neighbours on one curve, that hit together, have one number; ascending.
        maps: The edges of the images.
        P: Their cameras.
        size: Height and width.
    """
    edges = EdgeMaps.of(maps)
    y = X @ P[..., :3].mT + P[:, None, :, 3]
    depth = y[..., 2:]
    y = y[..., :2] / torch.where(depth > 0, depth, torch.nan)
    along = torch.nn.functional.normalize(tangent @ P[:, :2, :3].mT - y * (tangent @ P[:, 2, :3, None]), dim=-1)
    across = torch.stack((-along[..., 1], along[..., 0]), -1)
    inside = ((y > -0.5) & (y < y.new_tensor([size[1], size[0]]) - 0.5)).all(-1)

    def beside(aside: float) -> Float[Tensor, "f n"]:
        near = edges.near(y + aside * across)
        runs = (near.tangent * along).sum(-1).abs() > _ALONG
        return (inside & runs & (near.r.abs() < _NEAR)).double()

    chance = torch.stack([beside(sign * aside) for aside in _ASIDE for sign in (-1, 1)]).mean(0)
    _, run = torch.unique_consecutive(run, return_inverse=True)
    seen = inside.double()
    number = seen.new_zeros(len(P), int(run.amax()) + 1 if len(run) else 0).index_add(1, run, seen)
    return Foretold(seen.sum(1), beside(0.0).sum(1), chance.sum(1), number.square().sum(1))


def runs_of(curve: Int[Tensor, "n"], length: int = _RUN) -> Int[Tensor, "n"]:
    """Numbers of runs of so many neighbours, of samples in the order of their curves."""
    rank = torch.arange(len(curve), device=curve.device) - torch.searchsorted(curve, curve)
    runs: Tensor = torch.unique_consecutive(torch.stack((curve, rank // length)), dim=1, return_inverse=True)[1]
    return runs
