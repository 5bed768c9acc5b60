"""How to hold a reconstruction: which way is up, where its bulk is, and from where to look at it first."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.linalg import eigh, eigvalsh
from torchsfm.reconstruction.reconstruction import Reconstruction


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


def up_direction(reconstruction: Reconstruction) -> Float[Tensor, "3"]:
    """Which way is up, judging by how people hold cameras; the world's z axis where nothing can be said.

    The mean of the cameras' up directions, made perpendicular to their horizontal axes where these span a plane (then it
    does not matter how far the cameras look down). Where the up directions cancel but all cameras look the same way, as from
    an aeroplane, up is against the view. Where the horizontal axes are all parallel and the up directions are not, the images
    lie on their side, and up is the end of that axis from which the cameras look down.

    Args:
        reconstruction: The model, of whose images only the poses are looked at.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> torchsfm.plot.up_direction(torchsfm.read_model("model.npz")).norm()
        tensor(1.0000, dtype=torch.float64)
    """
    rows = reconstruction.poses.R[reconstruction.registered].to(torch.float64)
    z_axis = rows.new_tensor([0.0, 0.0, 1.0])
    if not len(rows):
        return z_axis
    right, up, forward = rows[:, 0], -rows[:, 1], rows[:, 2]
    mean, view = up.mean(0), forward.mean(0)
    values, vectors, _ = eigh(right.mT @ right / len(right))
    steadiness = eigvalsh(up.mT @ up / len(up))[0][2]
    if float(values[2]) > 0.9 and float(steadiness) < 0.7:
        aside: Tensor = vectors[:, 2] * -torch.sign(vectors[:, 2] @ view - 1e-12)
        return aside
    # The direction that the horizontal axes avoid.
    avoided: Tensor = vectors[:, 0] * torch.sign(vectors[:, 0] @ mean + 1e-12)
    if float(mean.norm()) >= 0.3:
        mean = mean / mean.norm()
        spanned = float(values[1]) > 0.02 and float(values[0]) < 0.1 * float(values[1])
        return avoided if spanned and float(avoided @ mean) > 0.8 else mean
    aerial: Tensor = -view / view.norm()
    return aerial if float(view.norm()) > 0.7 else avoided


def frame(reconstruction: Reconstruction) -> Framing:
    """Choose a frame: up is up, the bulk of the points in the middle, seen from the cameras' side, a little from above."""
    up = up_direction(reconstruction)
    device = up.device
    X = reconstruction.X.to(torch.float64)
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
