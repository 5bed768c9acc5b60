"""Images that were stretched along one side, where no one says so: resized to a square, or of pixels that are not square.

Cameras with square pixels fit what stretched images show by poses, focal length and points that are wrong together, and do so
well enough for nothing to be in doubt. One number more, the ratio of the focal lengths along y and x, tells it.
"""

import math
from typing import Any

from jaxtyping import Int
from torch import Tensor

from torchsfm.reconstruction.mappers.incremental import STANDING
from torchsfm.reconstruction.mapping.adjust import adjust
from torchsfm.reconstruction.mapping.calibration import images_of_cameras
from torchsfm.reconstruction.mapping.camera_prior import CameraPrior
from torchsfm.reconstruction.mapping.mapping import Mapping

ANY = 1.0
"""Standard deviation of a ratio of focal lengths of which nothing is known."""
STRETCHED, MUST_GAIN = 0.02, 0.04
"""A ratio off by less, or which lowers the cost by a smaller part, comes of other faults of a model as well."""
ENOUGH: dict[str, Any] = {"max_iterations": 20, "tolerance": 1e-3, "initial_damping": STANDING}
"""How far to adjust before the ratio is looked at."""
HINT: dict[str, Any] = {**ENOUGH, "tolerance": MUST_GAIN / 10}
"""And before that, to see whether it might gain so much."""


def apparent_aspect(mapping: Mapping, prior: CameraPrior) -> float | None:
    """About how many times as much as along x the images seem to be stretched along y; None where they do not seem so.

    Args:
        mapping: A finished model with square pixels.
        prior: What was expected of its cameras.
    """
    images, free = images_of_cameras(mapping), {} if mapping.adjustment is None else mapping.adjustment.free
    if "focal" not in free or not bool(free["focal"][images > 0].all()):
        # What does not tell the focal length tells no ratio of two: it would make up for one that is wrong.
        return None
    wide = prior.widened("aspect", ANY)
    open_: dict[str, Any] = {"free": {**free, "aspect": images > 0}, "prior": wide, **ENOUGH}
    trial = adjust(mapping, **open_ | HINT)
    if trial.adjustment is None or _gained(trial, trial.adjustment.initial_cost, images) is None:
        return None
    # Now both go as far, so that what they differ by is the ratio's.
    before = adjust(mapping, free=free, prior=wide, **ENOUGH)
    after = adjust(before, **open_)
    return None if before.adjustment is None else _gained(after, before.adjustment.cost, images)


def _gained(model: Mapping, cost: float, images: Int[Tensor, "g"]) -> float | None:
    """The ratio of a model in which it was free, if that is not near 1 and lowers a cost by enough."""
    K = model.cameras.K
    ratio = float((K[:, 1, 1] / K[:, 0, 0]).repeat_interleave(images).median())
    gained = model.adjustment is not None and model.adjustment.cost < (1 - MUST_GAIN) * cost
    return ratio if gained and abs(math.log(ratio)) > STRETCHED else None
