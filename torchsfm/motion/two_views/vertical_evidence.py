"""Do the rays contradict the verticals, or lie on one line, so that an upright pose is not to be relied on?"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import line_and_plane_distances
from torchsfm.motion.two_views.estimate_essential import RelativePoseEstimator
from torchsfm.robust import constant_weights, ransac

_REACHES = (32, 16, 8, 4, 2, 1, 1, 1)
"""Distances in thresholds at which weights vanish, step by step."""
_SAMPLES = 1000
"""Most samples where there is no free pose nearby."""
_CLEAR = 25.0
"""By how many variances of the noise a free pose must fit better,"""
_GAIN, _FEW = 0.05, 3.0
"""by which part of the support, and by how many data,"""
_TILT = 0.03
"""and by which angle in radians it must be off the verticals: theirs may be wrong by less."""


def contradicts_verticals(
    model: Float[Tensor, "p 3 4"],
    d1: Float[Tensor, "p n 3"],
    d2: Float[Tensor, "p n 3"],
    gravity1: Float[Tensor, "p 3"],
    gravity2: Float[Tensor, "p 3"],
    counted: Bool[Tensor, "p n"],
    threshold: Float[Tensor, "p"],
    slack: Float[Tensor, "p"],
) -> Bool[Tensor, "p"]:
    """Whether a pose that does not turn one vertical to the other fits the rays clearly better.

    Args:
        model: The upright pose.
        d1: Rays of length 1.
        d2: Those of the second camera.
        gravity1: The vertical in the first camera, of length 1.
        gravity2: The vertical in the second camera.
        counted: Which of the rays count.
        threshold: Largest distance of an inlier.
        slack: See `RelativePoseEstimator`.
    """
    problem = _Problem(d1, d2, counted, threshold.square(), slack)
    free = problem.freed(model)
    own, other = problem.loss(model), problem.loss(free)
    # A free pose is at least as good, if it is found.
    lost = (other.sum(-1) > own.sum(-1)).nonzero()[:, 0]
    if len(lost):
        free = free.index_copy(0, lost, problem.take(lost).searched())
        other = problem.loss(free)
    inside = other < 1
    gain = (own - other).sum(-1)
    variance = torch.where(inside, other, 0.0).sum(-1) / (inside.sum(-1) - 5).clamp(min=1)
    support = (1 - own).sum(-1)
    tilt = 1 - ((free[..., :3] @ gravity1[..., None])[..., 0] * gravity2).sum(-1)
    better = (gain > _CLEAR * variance) & (gain > _FEW + _GAIN * support)
    wrong: Tensor = better & (tilt > 0.5 * _TILT**2) & torch.isfinite(free).all(-1).all(-1)
    return wrong


@dataclass(frozen=True)
class _Problem:
    """Rays of problems, those that count, the squared thresholds and how far rays must miss the front."""

    d1: Float[Tensor, "p n 3"]
    d2: Float[Tensor, "p n 3"]
    counted: Bool[Tensor, "p n"]
    limit: Float[Tensor, "p"]
    slack: Float[Tensor, "p"]

    def take(self, index: Tensor) -> "_Problem":
        """Some of the problems."""
        return _Problem(self.d1[index], self.d2[index], self.counted[index], self.limit[index], self.slack[index])

    def squared(self, pose: Float[Tensor, "p 3 4"]) -> Float[Tensor, "p n"]:
        """Squared distances over the squared threshold."""
        squared = RelativePoseEstimator(self.slack).squared_residual(pose, self.d1, self.d2) / self.limit[:, None]
        return torch.where(self.counted, squared, torch.inf).nan_to_num(torch.inf)

    def loss(self, pose: Float[Tensor, "p 3 4"]) -> Float[Tensor, "p n"]:
        """The same, at most 1."""
        return self.squared(pose).clamp(max=1)

    def freed(self, pose: Float[Tensor, "p 3 4"]) -> Float[Tensor, "p 3 4"]:
        """The free pose that fits best near an upright one."""
        estimator = RelativePoseEstimator(self.slack)
        for reach in _REACHES:
            weights = (1 - self.squared(pose) / reach**2).clamp(min=0)
            pose = estimator.step(pose, self.d1, self.d2, weigh=constant_weights(weights.square()))
        return pose

    def searched(self) -> Float[Tensor, "p 3 4"]:
        """The free pose of most support."""
        found = ransac(
            RelativePoseEstimator(self.slack), self.d1, self.d2, threshold=self.limit.sqrt(), mask=self.counted,
            generator=torch.Generator().manual_seed(0), max_iterations=_SAMPLES,
        )  # fmt: skip
        model: Tensor = found.model
        return model


def off_great_circle(
    d: Float[Tensor, "*batch n 3"], inliers: Bool[Tensor, "*batch n"], threshold: Float[Tensor, "*batch"]
) -> Int[Tensor, "*batch"]:
    """How many inliers are farther than twice the threshold from the great circle that most of them are near to."""
    both, twice = torch.cat((d, -d), -2), torch.cat((inliers, inliers), -1)
    away = line_and_plane_distances(both, twice)[1][..., : d.shape[-2]]
    return (inliers & (away > 2 * threshold[..., None])).sum(-1)
