"""Points that move along rays by their inverse distance, so that infinity is a place like any other."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import broadcast_shapes


@dataclass(frozen=True)
class RayPoint:
    """Points and where their rays begin, `(X, C)`: across the ray they move as usual, along it by the inverse of `|X - C|`.

    To first order a step is `X + delta`. A step outwards as long as the ray goes to infinity, a longer one comes back on the
    other side, behind C: image points are nearly linear in such steps however far a point is (Civera et al. 2008), where in
    plain coordinates one whose rays hardly meet, or meet behind the cameras, would run away for ever.
    """

    ambient: int = 6
    tangent: int = 3

    def retract(self, x: Float[Tensor, "*#b 6"], delta: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b 6"]:
        """The points moved; C stays."""
        X, C = x[..., :3], x[..., 3:]
        away = X - C
        outwards = (away * delta).sum(-1, keepdim=True) / away.square().sum(-1, keepdim=True).clamp_min(
            torch.finfo(x.dtype).tiny
        )
        moved = X + delta / (1 - outwards)
        return torch.cat((moved, C.expand(*broadcast_shapes(moved.shape[:-1], C.shape[:-1]), 3)), -1)


def ray_points(
    X: Float[Tensor, "n 3"],
    centre: Float[Tensor, "v 3"],
    view: Int[Tensor, "m"],
    point: Int[Tensor, "m"],
    counts: Bool[Tensor, "m"],
) -> Float[Tensor, "n 6"]:
    """Points with the centre of the nearest view that sees them, as far as observations count; zero where none does."""
    distance = torch.linalg.vector_norm((X[point] - centre[view]).detach().double(), dim=1)
    distance = torch.where(counts & distance.isfinite(), distance, torch.inf)
    least = distance.new_full((len(X),), torch.inf).scatter_reduce(0, point, distance, "amin")
    near = torch.where(distance.isfinite() & (distance == least[point]), view, len(centre))
    nearest = torch.full((len(X),), len(centre), device=view.device).scatter_reduce(0, point, near, "amin")
    centres = torch.cat((centre.detach().double(), centre.new_zeros((1, 3), dtype=torch.float64)))
    return torch.cat((X.double(), centres[nearest]), 1)
