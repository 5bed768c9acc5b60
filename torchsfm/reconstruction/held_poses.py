"""Points and cameras of a mapping of which most poses are held."""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from torchsfm._types import Status
from torchsfm.bundle import bundle_adjust
from torchsfm.reconstruction.mappers.incremental import LAST_ITERATIONS, LAST_TOLERANCE, MappingOptions
from torchsfm.reconstruction.mapping.adjust import LOSS
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.structure import complete_tracks, filter_points, merge_points, triangulate_tracks

ROUNDS = 4
"""Of triangulation, completion and adjustment; little changes after the second."""


def structure_of_held(mapping: Mapping, options: MappingOptions) -> Mapping:
    """Points of all tracks, with the poses and cameras as they are."""
    for _ in range(ROUNDS):
        before = mapping.point
        mapping = triangulate_tracks(mapping, threshold=options.reprojection, min_angle=options.min_angle)
        mapping = complete_tracks(mapping, threshold=options.reprojection)
        mapping = merge_points(mapping, threshold=options.reprojection)
        mapping = filter_points(mapping, threshold=options.reprojection, min_angle=options.min_angle)
        mapping = adjust_held(mapping, moving=torch.zeros_like(mapping.registered))
        mapping = filter_points(mapping, threshold=options.reprojection, min_angle=options.min_angle)
        if int(((before >= 0) != (mapping.point >= 0)).sum()) <= 0.01 * int((before >= 0).sum()):
            break
    return mapping


def adjust_held(mapping: Mapping, *, moving: Bool[Tensor, "v"], cameras: dict[str, Any] | None = None) -> Mapping:
    """Move all points, some of the poses, and of the cameras what is free, as `bundle_adjust` takes it; nothing when None."""
    if not len(mapping.observations()):
        return mapping
    result = bundle_adjust(
        mapping.problem(),
        fixed_poses=~moving,
        loss=LOSS,
        max_iterations=LAST_ITERATIONS,
        tolerance=LAST_TOLERANCE,
        **({"free": ()} | (cameras or {})),
    )
    if result.status == Status.INTERRUPTED:
        raise KeyboardInterrupt
    return replace(mapping, poses=result.poses, cameras=result.cameras, X=result.X)
