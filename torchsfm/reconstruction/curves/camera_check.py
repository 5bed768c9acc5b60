"""Would another focal length fit the edges of known poses better? Curves and it at their least squares, poses held."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.bundle.curves import edge_distances
from torchsfm.geometry import Camera, Pose
from torchsfm.linalg import solve
from torchsfm.linalg.vectors import across
from torchsfm.reconstruction.curves.foretold_edges import runs_of
from torchsfm.reconstruction.curves.noise import TRUSTED, usual_distance
from torchsfm.reconstruction.model.curves import Curves

_ROUNDS = 3
_STEP = 1e-4
"""Part of a focal length by which its derivative is found,"""
_ACROSS = 0.05
"""and pixels by which those of samples are."""
_WEAK = 1e-9
"""Holds samples that images leave open, 1 / pixel^2."""
_MOST = 0.3
"""Step of a round, at most."""
_OFF = 0.01
"""A focal length, or a ratio of both, that is less off is right: those of careful calibrations are to a half of it."""
_SURE = 5.0
"""Standard deviations that are no chance."""
_FEWEST = 8
"""Runs of samples that tell a camera."""


@dataclass(frozen=True)
class OtherCamera:
    """By which factors other focal lengths of all images would fit edges better, with poses as they are.

    Curves were found with the cameras given, and lie as these say: where focal lengths are far off, better ones are farther.
    """

    focal: float
    """Of both focal lengths."""
    stretch: float
    """Of the one along y over the one along x."""
    focal_sigma: float
    """Standard deviation, where runs of samples count as one measurement."""
    stretch_sigma: float

    def doubts(self) -> list[str]:
        """What is to be told of the cameras; nothing where they are right to a hundredth."""
        if abs(self.stretch - 1) > max(_OFF, _SURE * self.stretch_sigma):
            said = f"edges fit better where the focal length along y is {self.stretch:.3f} times as long beside that along x"
            return [f"the photographs may be stretched: {said}"]
        if abs(self.focal - 1) > max(_OFF, _SURE * self.focal_sigma):
            longer = "longer" if self.focal > 1 else "shorter"
            return [f"the focal lengths do not fit the poses: edges fit better with {longer} ones ({self.focal:.3f} times)"]
        return []


def other_camera(curves: Curves, cameras: Camera, poses: Pose) -> OtherCamera | None:
    """The camera that fits the edges of curves best; None where these are too few to tell.

    Args:
        curves: What `reconstruct_curves` found.
        cameras: Of each image (v).
        poses: Of each image (v).
    """
    run = runs_of(curves.curve)
    if not len(run) or int(run[-1]) + 1 < _FEWEST:
        return None
    poses, cameras = Pose(poses.R.double(), poses.t.double()), _in_double(cameras)
    first, second = (t.mT for t in across(curves.tangents().double().mT))
    X, pixel, sample = curves.X.double(), curves.sigma.double()[:, None], curves.sample
    change = torch.zeros(2, dtype=torch.float64)
    covariance = torch.eye(2, dtype=torch.float64)

    def off(X: Tensor, change: Tensor) -> Float[Tensor, "k"]:
        return edge_distances(poses, _changed(cameras, change), replace(curves, X=X.to(curves.X)).bundle()).double()

    def summed(values: Tensor) -> Tensor:
        return values.new_zeros(len(X), *values.shape[1:]).index_add(0, sample, values)

    for _ in range(_ROUNDS):
        r = off(X, change)
        own = torch.stack([off(X + _ACROSS * pixel * d, change) - r for d in (first, second)], -1) / _ACROSS
        step = _STEP * torch.eye(2, dtype=torch.float64)
        all_alike = torch.stack([off(X, change + row) - r for row in step], -1) / _STEP
        sound = r.isfinite() & own.isfinite().all(-1) & all_alike.isfinite().all(-1)
        weight = sound / (1 + (r / (TRUSTED * usual_distance(r))).square()).square()
        weight = torch.where(sound, weight, 0)
        r, own, all_alike = (torch.where(sound.view(-1, *[1] * (t.ndim - 1)), t, 0) for t in (r, own, all_alike))
        # Samples are eliminated: what of the change they take up themselves tells nothing.
        weighed = (weight[:, None] * own)[..., None]
        A = summed(weighed * own[:, None]) + _WEAK * torch.eye(2, dtype=torch.float64)
        B = summed(weighed * torch.cat((all_alike, r[:, None]), -1)[:, None])
        taken, _ = solve(A, B)
        left = torch.cat((all_alike, r[:, None]), -1) - (own[..., None] * taken[sample]).sum(1)
        G, r = left[:, :2], left[:, 2]
        inverse, solved = solve((weight[:, None, None] * G[:, :, None] * G[:, None]).sum(0), torch.eye(2, dtype=torch.float64))
        pull = weight[:, None] * G * r[:, None]
        move = -(inverse @ pull.sum(0)).clamp(-_MOST, _MOST)
        if not bool(solved) or not bool(move.isfinite().all()):
            return None
        by_run = pull.new_zeros(int(run[-1]) + 1, 2).index_add(0, run[sample], pull)
        covariance = inverse @ (by_run.mT @ by_run) @ inverse
        aside = -(taken[..., 2] + (taken[..., :2] * move).sum(-1)) * pixel
        X, change = X + aside[:, :1] * first + aside[:, 1:] * second, change + move
    focal, stretch = change.exp().tolist()
    sigma = covariance.diagonal().clamp_min(0).sqrt().tolist()
    return OtherCamera(focal, stretch, focal * sigma[0], stretch * sigma[1])


def _in_double(cameras: Camera) -> Camera:
    """The cameras in double precision, in which small steps are told."""
    return replace(cameras, K=cameras.K.double())


def _changed(cameras: Camera, change: Float[Tensor, "2"]) -> Camera:
    """Cameras with other focal lengths: logarithms of the factor of both, and of their ratio."""
    x, y = (change[0] - change[1] / 2).exp(), (change[0] + change[1] / 2).exp()
    K = cameras.K.clone()
    K[:, 0, :2] *= x
    K[:, 1, 1] *= y
    return replace(cameras, K=K)
