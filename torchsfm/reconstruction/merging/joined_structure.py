"""Lines, ellipses and curves of two models in one world as those of one model."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.bundle import bundle_adjust_model
from torchsfm.optim import Loss
from torchsfm.reconstruction.curves.fusion import fuse_pieces, nearest_fused
from torchsfm.reconstruction.curves.pieces import Pieces
from torchsfm.reconstruction.mapping.mapping import first_of_each
from torchsfm.reconstruction.model.conics import Conics
from torchsfm.reconstruction.model.curves import TRACKS, Curves
from torchsfm.reconstruction.model.lines import Lines
from torchsfm.reconstruction.model.parts import LEAST_VIEWS
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.model.same_observations import (
    ellipse_places,
    joined_numbers,
    same_observations,
    segment_places,
)

SHORTEST = 4
"""Samples of the shortest piece of a curve that is left beside another one."""


def with_structure(
    model: Reconstruction,
    a: Reconstruction,
    b: Reconstruction,
    view_of: Int[Tensor, "v"],
    *,
    threshold: float,
    loss: Loss,
) -> Reconstruction:
    """The joined model with the lines, ellipses and curves of both, at their least distances for its cameras.

    Lines and ellipses are one that images of both show at the same places; curves where they run along each other.

    Args:
        model: The joined cameras and points.
        a: The first model, whose images have the same numbers in the joined one.
        b: The second one in its world.
        view_of: The numbers of its images in the joined one.
        threshold: Pixels beyond which observations are left out in the end, and with them what fewer than two images show.
        loss: Robust loss of the distances.
    """
    shared = [(i, i) for i in view_of.tolist() if i < len(a.names)]

    def both(name: str, join: Callable[[Any, Any], Any]) -> Any:
        mine, theirs = getattr(a, name), getattr(b, name)
        if theirs is None:
            return mine
        theirs = replace(theirs, view=view_of[theirs.view])
        return theirs if mine is None else join(mine, theirs)

    whole = replace(
        model,
        lines=both("lines", partial(joined_lines, shared=shared)),
        conics=both("conics", partial(joined_conics, shared=shared)),
        curves=both("curves", partial(joined_curves, model)),
    )
    if not any((whole.lines, whole.conics, whole.curves)):
        return whole
    poses, points = torch.ones_like(model.registered), torch.ones(model.num_points, dtype=torch.bool)
    whole = bundle_adjust_model(whole, free=(), fixed_poses=poses, fixed_points=points, loss=loss).model
    return _fitting(whole, threshold)


def joined_lines(a: Lines, b: Lines, shared: list[tuple[int, int]]) -> Lines:
    """The lines of both, those that share segments as one that reaches as far as either."""
    same = same_observations(segment_places(a.x), a.view, segment_places(b.x), b.view, shared)
    target = joined_numbers(a.line[same[:, 0]], b.line[same[:, 1]], len(a), len(b))
    new, own = target >= len(a), torch.ones_like(b.line, dtype=torch.bool).index_fill(0, same[:, 1], value=False)
    one = target[~new]
    start, along = a.ends[one, :1], a.ends[one, 1:] - a.ends[one, :1]
    place = ((b.ends[~new] - start) * along).sum(-1) / along.square().sum(-1).clamp_min(1e-300)
    reach = a.ends.new_tensor([0.0, 1.0]).repeat(len(a), 1)
    low = reach[:, 0].scatter_reduce(0, one, place.amin(-1), "amin")
    high = reach[:, 1].scatter_reduce(0, one, place.amax(-1), "amax")
    ends = torch.lerp(a.ends[:, :1], a.ends[:, 1:], torch.stack((low, high), -1)[..., None])
    line = torch.cat((a.line, target[b.line[own]]))
    order = line.argsort(stable=True)
    x, weight, view = (torch.cat((getattr(a, k), getattr(b, k)[own]))[order] for k in ("x", "weight", "view"))
    return Lines(torch.cat((ends, b.ends[new])), torch.cat((a.color, b.color[new])), x, weight, view, line[order])


def joined_conics(a: Conics, b: Conics, shared: list[tuple[int, int]]) -> Conics:
    """The ellipses of both, those that share measured ones as one."""
    same = same_observations(ellipse_places(a.x), a.view, ellipse_places(b.x), b.view, shared)
    target = joined_numbers(a.conic[same[:, 0]], b.conic[same[:, 1]], len(a), len(b))
    new, own = target >= len(a), torch.ones_like(b.conic, dtype=torch.bool).index_fill(0, same[:, 1], value=False)
    centre, axes, color = (torch.cat((getattr(a, k), getattr(b, k)[new])) for k in ("centre", "axes", "color"))
    x, covariance, view = (torch.cat((getattr(a, k), getattr(b, k)[own])) for k in ("x", "covariance", "view"))
    return Conics(centre, axes, color, x, covariance, view, torch.cat((a.conic, target[b.conic[own]])))


def joined_curves(model: Reconstruction, a: Curves, b: Curves) -> Curves:
    """The curves of both: averaged where they run along each other, linked where one goes on in the other."""
    X, sigma = torch.cat((a.X, b.X)), torch.cat((a.sigma, b.sigma))
    view, sample = torch.cat((a.view, b.view)), torch.cat((a.sample, len(a.X) + b.sample))
    piece, color = torch.cat((a.curve, len(a) + b.curve)), torch.cat((a.color, b.color))
    of = (torch.arange(len(X)) >= len(a.X)).long()
    pieces = Pieces(X, piece, of, torch.arange(len(X)), sigma, _pixels(model, X, view, sample))
    fused = fuse_pieces(pieces, least_images=1, shortest=SHORTEST)
    number = nearest_fused(pieces, fused)[sample]
    # One edge point for each sample in an image: its own, or that of the nearest sample that it stands for.
    distance = torch.where(number >= 0, (X[sample] - X[fused.source[number]]).norm(dim=-1), torch.inf)
    order = distance.argsort(stable=True)
    order = order[number[order] >= 0]
    order = order[first_of_each(number[order] * len(model.names) + view[order])]
    order = order[number[order].argsort(stable=True)]
    tracks = {name: torch.cat((getattr(a, name), getattr(b, name)))[order] for name in TRACKS} | {"view": view[order]}
    return Curves(
        X=fused.X, curve=fused.curve, closed=fused.closed, color=color[fused.source], sigma=fused.sigma,
        **tracks | {"sample": number[order]},
    )  # fmt: skip


def _pixels(
    model: Reconstruction, X: Float[Tensor, "n 3"], view: Int[Tensor, "k"], sample: Int[Tensor, "k"]
) -> Float[Tensor, "n"]:
    """How large a pixel is at samples, on the mean of the images that show them; of those that none does, as usual."""
    depth = model.poses[view].transform(X[sample, None])[:, 0, 2]
    size = depth / model.cameras.K[model.camera_index[view], 0, 0]
    count = torch.bincount(sample, minlength=len(X))
    mean = X.new_zeros(len(X)).index_add(0, sample, size) / count.clamp(min=1)
    usual = mean[count > 0].median() if bool((count > 0).any()) else mean.new_ones(())
    return torch.where(count > 0, mean, usual)


def _fitting(model: Reconstruction, threshold: float) -> Reconstruction:
    """The model with what of its lines, ellipses and curves the images bear out."""
    lines, conics, curves = model.lines, model.conics, model.curves
    if lines is not None:
        lines = lines.seen_where(model.line_residuals().amax(-1) <= threshold)
        lines = lines.select(lines.support() >= LEAST_VIEWS)
    if conics is not None:
        conics = conics.seen_where(model.conic_residuals() <= threshold)
        conics = conics.select(conics.support() >= LEAST_VIEWS)
    if curves is not None:
        curves = curves.seen_where(model.curve_residuals() <= threshold)
        curves = curves.runs_where(curves.support() >= LEAST_VIEWS)
    return replace(model, lines=lines, conics=conics, curves=curves)
