"""Few images that another focal length explains nearly as well as theirs: which one is right, they do not tell."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.reconstruction.mappers.incremental import OTHER_FOCAL, UNKNOWN_FOCAL, MappingOptions, extend_model, starts
from torchsfm.reconstruction.mapping.adjust import support
from torchsfm.reconstruction.mapping.calibration import FEW
from torchsfm.reconstruction.mapping.mapping import Mapping

NEARLY = 0.96
"""A model is a rival that explains at least this part of what the other does: matches that are wrong alike, and points of a
plane, fit either by some per cent better."""
APART = 1.15
"""Focal lengths that differ by less are one."""


def rival_focal(empty: Mapping, model: Mapping, options: MappingOptions) -> Float[Tensor, "v"] | None:
    """The focal length that explains the images of a small model nearly as well, where it was guessed and there is one.

    Which minimum is found depends on where the search begins, and deviations tell of one alone. So the images are mapped again
    from a shorter and from a longer focal length than the one that was guessed.

    Args:
        empty: The mapping before anything was registered, with the first cameras.
        model: The finished model.
        options: How it was made.

    Returns:
        In pixels, of each image; not a number where no other focal length comes near. None where models were not compared: of
        more images, or where focal lengths were not guessed.
    """
    unknown = options.focal_sigma >= UNKNOWN_FOCAL
    guessed = model.registered & unknown[model.camera_index]
    if int(model.registered.sum()) > FEW or not bool(guessed.any()):
        return None
    focal = model.cameras.K[model.camera_index, 0, 0]
    rival, bar = torch.full_like(focal, torch.nan), NEARLY * support(model, options.reprojection)
    for times in OTHER_FOCAL[1:]:
        begun = next(starts(replace(empty, registered=~model.registered), unknown, options, times), None)
        if begun is None:
            continue
        other, _ = extend_model(begun[0], ~model.registered, options, lambda done, total: None)
        found = other.cameras.K[other.camera_index, 0, 0]
        if bool((other.registered == model.registered).all()) and support(other, options.reprojection) >= bar:
            differs = guessed & ((found / focal).log().abs() > math.log(APART))
            rival = torch.where(differs, found, rival)
    return rival
