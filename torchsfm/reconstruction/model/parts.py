"""Some images of a model as a model of their own."""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from torchsfm.geometry import Pose
from torchsfm.reconstruction.model.reconstruction import Reconstruction

LEAST_VIEWS = 2
"""Images that must show what is kept of space."""


def part_of_model(model: Reconstruction, images: Bool[Tensor, "v"]) -> Reconstruction:
    """Some images of a model, with the points, lines, ellipses and samples of curves that two of them show at least.

    Args:
        model: The model.
        images: Which of its images to keep.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(8, 150, 800, generator=g).truth, "model.npz")
        >>> whole = torchsfm.read_model("model.npz")
        >>> part = torchsfm.reconstruction.part_of_model(whole, torch.arange(8) < 3)
        >>> part.num_registered, int(part.track_lengths().min()), part.num_points < whole.num_points
        (3, 2, True)
    """
    return shown_often(with_images(model, images))


def with_images(model: Reconstruction, keep: Bool[Tensor, "v"]) -> Reconstruction:
    """The model with some of its images; all of space stays, with what these images show of it."""
    number = keep.cumsum(0) - 1
    seen = keep[model.view]
    structure: dict[str, Any] = {
        name: replace(shown := some.seen_where(keep[some.view]), view=number[shown.view])
        for name, some in (("lines", model.lines), ("conics", model.conics), ("curves", model.curves))
        if some is not None
    }
    return replace(
        model,
        names=tuple(name for name, kept in zip(model.names, keep.tolist(), strict=True) if kept),
        image_size=model.image_size[keep],
        camera_index=model.camera_index[keep],
        poses=Pose(model.poses.R[keep], model.poses.t[keep]),
        registered=model.registered[keep],
        x=model.x[seen],
        view=number[model.view[seen]],
        point=model.point[seen],
        **structure,
    )


def shown_often(model: Reconstruction) -> Reconstruction:
    """The model without points, lines, ellipses and samples of curves that fewer than two registered images show."""
    sure = model.registered[model.view]
    often = torch.bincount(model.point[sure], minlength=model.num_points) >= LEAST_VIEWS
    kept = sure & often[model.point]
    lines, conics, curves = model.lines, model.conics, model.curves
    return replace(
        model,
        X=model.X[often],
        color=model.color[often],
        x=model.x[kept],
        view=model.view[kept],
        point=(often.cumsum(0) - 1)[model.point[kept]],
        lines=None if lines is None else lines.select(lines.support() >= LEAST_VIEWS),
        conics=None if conics is None else conics.select(conics.support() >= LEAST_VIEWS),
        curves=None if curves is None else curves.runs_where(curves.support() >= LEAST_VIEWS),
    )
