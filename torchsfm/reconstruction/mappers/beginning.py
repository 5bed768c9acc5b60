"""What models grow from: an empty mapping with first cameras, and how it is to be made."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.reconstruction.mappers.global_start import global_start
from torchsfm.reconstruction.mappers.incremental import MappingOptions, extend_model, grow_model
from torchsfm.reconstruction.mappers.windows import window_start
from torchsfm.reconstruction.mapping.cameras import focal_uncertainty, guess_cameras
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.matching.view_graph import ViewGraph

Grown = tuple[Mapping, dict[int, str]]
"""A model, and why images that were tried do not fit."""


@dataclass(frozen=True)
class Beginning:
    """A mapping before anything is registered."""

    empty: Mapping
    options: MappingOptions
    source: tuple[str, ...]
    """Where each camera's first focal length comes from."""

    @classmethod
    def of(
        cls,
        graph: ViewGraph,
        track: Int[Tensor, "n"],
        camera_index: Int[Tensor, "v"],
        *,
        model: str,
        K: Float[Tensor, "3 3"] | None,
        exif_focal: Sequence[float | None],
        free: tuple[str, ...],
        generator: torch.Generator,
        aspect: Float[Tensor, "v"] | None = None,
        body: Int[Tensor, "v"] | None = None,
    ) -> "Beginning":
        """With the best guess of the cameras; see `guess_cameras` and `MappingOptions`, of the `body` that took each image."""
        cameras, source = guess_cameras(graph, camera_index, model=model, K=K, exif_focal=exif_focal, aspect=aspect)
        options = MappingOptions(free=free, expected=cameras, focal_sigma=focal_uncertainty(source), generator=generator)
        if body is not None:
            options = replace(options, body=torch.zeros(len(cameras.K), dtype=torch.long).index_copy(0, camera_index, body))
        return cls(Mapping.start(graph, track, cameras, camera_index), options, source)


def grow_by(method: str, mapping: Mapping, options: MappingOptions, progress: Callable[[int, int], None]) -> Grown | None:
    """A model as one of the mappers makes it that start from known or guessed cameras.

    Args:
        method: "global", "windows", or else one by one.
        mapping: The cameras to start from, and images that belong to other models and are left alone: those registered.
        options: How models are made.
        progress: Called with the number of registered images and of all.

    Returns:
        The model, and for each image that was tried and did not fit the reason; None where there is no start.
    """
    if method not in ("global", "windows"):
        return grow_model(mapping, options, progress)
    placed = (global_start if method == "global" else window_start)(mapping, ~mapping.registered, options)
    return None if placed is None else extend_model(placed, mapping.registered, options, progress)
