"""Three and four views without calibration: cameras and multilinear tensors from points."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from bench.cases import scenes
from bench.cases.case import Case, Sample, up_to_scale
from bench.cases.scenes import K
from torchsfm import Solutions, Status, quadrifocal_6pt, trifocal_6pt, trifocal_7pt
from torchsfm.geometry import line_from_points
from torchsfm.motion import trifocal_4p3l
from torchsfm.motion.three_views.trifocal_4p3l import equations as equations_of_points_and_lines
from torchsfm.motion.three_views.trifocal_6pt import equations
from torchsfm.tensors import (
    quadrifocal_from_cameras,
    trifocal_from_cameras,
)

Scene = Callable[[str, int, torch.Generator, torch.dtype], tuple[Sample, Tensor]]
INVERSE = torch.linalg.inv(K)


def image_points(v: int, n: int) -> Scene:
    """Samples of n points in v images, and the cameras."""

    def scene(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
        X, R, t = scenes.views(family, batch, n, generator, count=v)
        x = scenes.pixels(X[:, None] @ R.mT + t[:, :, None])
        return (x.to(dtype),), K @ torch.cat((R, t[..., None]), -1)

    return scene


def points_and_lines(family: str, batch: int, generator: torch.Generator, dtype: torch.dtype) -> tuple[Sample, Tensor]:
    """Four points and three lines in three images, and the cameras."""
    (x,), P = image_points(3, 10)(family, batch, generator, torch.float64)
    l = line_from_points(x[..., 4:7, :], x[..., 7:, :])  # noqa: E741
    return (x[..., :4, :].to(dtype), l.to(dtype)), P


def tensor_error(models: Tensor, truth: Tensor) -> Tensor:
    """Distance of unit tensors of cameras, as they are for rays: in pixels one entry outweighs all others."""
    three = truth.shape[-3] == 3
    make: Callable[..., Tensor] = trifocal_from_cameras if three else quadrifocal_from_cameras
    found, right = (make(*(INVERSE @ P).unbind(-3)) for P in (models, truth))
    return up_to_scale(3 if three else 4)(found, right)


def cameras_of(door: Callable[[Tensor], Any]) -> Callable[..., Solutions[Tensor]]:
    """A fit of many points as a solver with one slot."""

    def solve(x: Tensor) -> Solutions[Tensor]:
        fit = door(x)
        return Solutions(fit.P[:, None], (fit.status == Status.OK)[:, None])

    return solve


FAMILIES = scenes.HARD

CASES: tuple[Case, ...] = (
    Case(
        "trifocal_4p3l",
        size=7,
        slots=3,
        solve=trifocal_4p3l,
        scene=points_and_lines,
        error=tensor_error,
        families=FAMILIES,
        equations=equations_of_points_and_lines,
    ),
    Case(
        "trifocal_6pt",
        size=6,
        slots=3,
        solve=trifocal_6pt,
        scene=image_points(3, 6),
        error=tensor_error,
        families=FAMILIES,
        equations=equations,
    ),
    Case(
        "trifocal_7pt",
        size=7,
        slots=1,
        solve=cameras_of(trifocal_7pt),
        scene=image_points(3, 7),
        error=tensor_error,
        families=FAMILIES,
    ),
    Case(
        "quadrifocal_6pt",
        size=6,
        slots=1,
        solve=cameras_of(quadrifocal_6pt),
        scene=image_points(4, 6),
        error=tensor_error,
        families=FAMILIES,
    ),
)
