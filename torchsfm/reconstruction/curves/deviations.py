"""How well cameras of a sequence are known by its curves: by edges, and by what the camera's own numbers may be off."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Status
from torchsfm.bundle.intrinsics import free_columns
from torchsfm.geometry.intrinsic_parameters import intrinsic_labels, row_from_camera
from torchsfm.linalg import inverse
from torchsfm.reconstruction.curves.find_curves import scaled
from torchsfm.reconstruction.curves.mapping import CurveMapping, covariance, distances
from torchsfm.reconstruction.curves.sequence import FINE, OPTIMISM, Expected, Settled
from torchsfm.reconstruction.mapping.calibration import Calibration


class Deviations(NamedTuple):
    """Standard deviations."""

    rotation: Float[Tensor, "v"]
    """Of each frame's camera, degrees."""
    position: Float[Tensor, "v"]
    """Of each frame's camera, units of the world."""
    numbers: dict[str, float]
    """Of the numbers of all cameras, the focal length's as a part of it."""


def deviations(mapping: CurveMapping, known: Expected) -> Deviations:
    """How well the cameras are known.

    What is wrong with the camera's own numbers, the place of the principal point too, which is held, is wrong in all frames,
    and turns and moves cameras along. All edges together say more of these numbers than they are worth (`OPTIMISM`). So each
    number counts as known by that much less than edges say, or as it was known beforehand where that is better, and cameras as
    they are where it is known, and turned and moved by its deviation.

    Args:
        mapping: The model, at its minimum.
        known: What was known of the camera before all frames were adjusted.
    """
    names = (*known.free, *known.held)
    sigma = {name: known.sigma[name] for name in names}
    found = covariance(mapping, known.terms() | {"free": names, "intrinsics_sigma": sigma})
    rest = found.poses.diagonal(dim1=-2, dim2=-1)
    lens, numbers = type(mapping.camera.distortion), dict[str, float]()
    if names:
        own, poses = found.everything.columns["camera"][0], found.everything.columns["pose"]
        joint = found.everything.joint
        among, across = joint[own[:, None], own], joint[own][:, poses.flatten()]
        # How cameras go with the numbers, and what is left where these are known.
        slope = inverse(among)[0] @ across
        rest = rest - torch.where(rest.isfinite(), (slope * across).sum(0).view_as(rest), 0)
        for name in names:
            place = [free_columns(names, lens).index(column) for column in free_columns((name,), lens)]
            unit = float(mapping.camera.K[0, 0]) if name == "focal" else 1.0
            before, variance = (unit * sigma[name]) ** 2, among.diagonal()[place]
            edges = OPTIMISM**2 / (1 / variance - 1 / before).clamp_min(1e-300)
            square = edges.clamp(max=before)
            numbers[name] = float(square.mean().sqrt()) / unit
            along = (slope[place].square() * square[:, None]).sum(0).view_as(rest)
            rest = rest + torch.where(rest.isfinite(), along, 0)
    return Deviations(rest[:, :3].sum(-1).sqrt().rad2deg(), rest[:, 3:].sum(-1).sqrt(), numbers)


def calibration(settled: Settled, known: Deviations, expected: Expected, zoom: Float[Tensor, "2"]) -> Calibration:
    """How the camera was found, in pixels of the whole frames.

    Args:
        settled: The model.
        known: How well its cameras are known.
        expected: What was known of the camera before any frame was seen.
        zoom: Pixels of the whole frames to one of those that were looked at.
    """
    mapping, told = settled.mapping, settled.told
    camera = scaled(mapping.camera[(None,)], zoom[None])
    labels = intrinsic_labels(type(camera.distortion))
    values, names = row_from_camera(camera), tuple(name for name in labels if name not in ("aspect", "skew"))
    f = float(camera.K[0, 0, 0])
    unit = {"focal": f, "cx": float(zoom[0]), "cy": float(zoom[1])}
    point = dict.fromkeys(("cx", "cy"), "principal_point")

    def row(numbers: dict[str, float]) -> Tensor:
        return values.new_tensor([[unit.get(name, 1.0) * numbers.get(point.get(name, name), 0.0) for name in names]])

    before = {name: expected.sigma[name] for name in (*expected.free, *expected.held)}
    estimated = torch.tensor([[name in told.free for name in names]])
    values = values[:, [labels.index(name) for name in names]]
    status, noise = Status.OK if settled.still else Status.NOT_CONVERGED, distances(mapping)[1]
    return Calibration(status, FINE, noise, names, values, estimated, row(known.numbers), row(before))
