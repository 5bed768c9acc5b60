"""How to hold a reconstruction: where its bulk is, and from where to look at it first."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.model.upright import up_direction


@dataclass(frozen=True)
class Framing:
    """A frame for showing: z is up, and a ball holds what matters."""

    R: Float[Tensor, "3 3"]
    """Rotation from the world of the model to that of the picture."""
    centre: Float[Tensor, "3"]
    """Middle of the bulk of the points, in the picture's world."""
    radius: float
    """Radius of the bulk and of the cameras near it; 1 where there is nothing to see."""
    direction: Float[Tensor, "3"]
    """From the centre to a good first viewpoint, in the picture's world; unit length."""


def frame(reconstruction: Reconstruction) -> Framing:
    """Choose a frame: up is up, the bulk of the points in the middle, seen from the cameras' side, a little from above."""
    X = reconstruction.X.to(torch.float64)
    device = X.device
    up = up_direction(reconstruction).to(device)
    X = X[torch.isfinite(X).all(-1)]
    centres = reconstruction.poses.centre[reconstruction.registered].to(torch.float64)
    # An arbitrary horizontal axis, then the first camera's right if that is usable.
    spare = torch.eye(3, dtype=torch.float64, device=device)[int(up.abs().argmin())]
    x_axis = torch.linalg.cross(up, spare)
    x_axis = x_axis / x_axis.norm()
    R = torch.stack((x_axis, torch.linalg.cross(up, x_axis), up))
    X, centres = X @ R.mT, centres @ R.mT
    sample = X[:: max(1, len(X) // 100_000)]
    if len(sample):
        centre = sample.median(0).values
        distance = (sample - centre).norm(dim=-1)
        radius = float(distance.quantile(0.85)) * 1.15
    elif len(centres):
        centre = centres.mean(0)
        radius = float((centres - centre).norm(dim=-1).max())
    else:
        centre, radius = torch.zeros(3, dtype=torch.float64, device=device), 1.0
    away = centres - centre
    if len(away) and radius > 0:
        reach = away.norm(dim=-1).quantile(0.9)
        radius = max(radius, min(float(reach), 2.5 * radius))
    direction = away.mean(0) if len(away) else centre.new_tensor([0.0, -1.0, 0.5])
    flat = direction[:2].norm()
    if len(away) and float(flat) < 0.2 * float(away[:, :2].norm(dim=-1).mean()):
        # Cameras all round (or right above): take the side of the first one.
        direction = away[0]
        flat = direction[:2].norm()
    if float(flat) < 1e-9 * max(radius, 1e-300):
        direction, flat = centre.new_tensor([0.0, -1.0, 0.0]), centre.new_tensor(1.0)
    rise = (direction[2] / flat).clamp(0.35, 1.2)
    direction = torch.cat((direction[:2] / flat, rise[None]))
    return Framing(R, centre, radius if radius > 0 else 1.0, direction / direction.norm())
