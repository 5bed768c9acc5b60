"""Cameras by points, lines and curves together: edge points count by what is measured of them, and only where points agree."""

from dataclasses import replace
from typing import NamedTuple

import torch

from torchsfm.bundle import BundleCurves, bundle_adjust
from torchsfm.bundle.curves import edge_distances
from torchsfm.reconstruction.curves.noise import edge_loss, weights_in_a_bundle
from torchsfm.reconstruction.lines.find_lines import lines_in_a_bundle
from torchsfm.reconstruction.mapping.adjust import LOSS, about_cameras, as_adjusted, points_agree
from torchsfm.reconstruction.mapping.calibration import measure_noise, observation_weights
from torchsfm.reconstruction.mapping.camera_prior import CameraPrior
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.model.curves import Curves
from torchsfm.reconstruction.model.lines import Lines

TOLERANCE = 1e-5
"""Relative decrease of the cost at which an adjustment ends,"""
MOST_STEPS = 4
"""and its steps, the most: images that go on along their curves leave edges behind that show samples, and weights change."""
_AROUND = 4
"""Samples on either side that tell how a sample moves where its edges hardly do,"""
_ASIDE = 2.0
"""that is, where it would move by more pixels otherwise."""


class WithCurves(NamedTuple):
    """A model, its lines and its curves, adjusted together."""

    mapping: Mapping
    lines: Lines | None
    curves: Curves


def adjust_with_curves(
    mapping: Mapping,
    curves: Curves,
    prior: CameraPrior | None,
    lines: Lines | None = None,
    *,
    alone: Mapping | None = None,
    excess: float = 1.0,
) -> WithCurves | None:
    """Adjust cameras, points, lines and curves together; of the cameras what the last adjustment of points did.

    Edge points count by how far they are from the curves, and by how many of a curve move its image alike: along a straight
    edge of a building an image has one error, not one a pixel. So curves say little beside thousands of points, and much
    beside few. A few steps are taken: then edges are to be looked for and both to be measured again, as what cameras are off
    passes for noise of edges.

    Args:
        mapping: The model.
        curves: Its curves, with edge points in pixels of its images.
        prior: What is expected of its cameras, where something of them is estimated.
        lines: Its lines, if it has any.
        alone: The model at the minimum of its points, without curves; `mapping` if not given.
        excess: By how much more its points scatter together than by their own noise, as a ratio of variances.

    Returns:
        All of them after the adjustment; None where no edge shows a curve, or where points contradict the cameras
        (`points_agree`): curves are off then in a way that their own noise does not tell, as outlines of what is round are.
    """
    if not len(curves.x):
        return None
    moved = _adjusted(WithCurves(mapping, lines, curves), prior)
    return moved if points_agree(alone or mapping, moved.mapping, excess) else None


def _adjusted(model: WithCurves, prior: CameraPrior | None) -> WithCurves:
    mapping, lines, curves = model
    free = None if mapping.adjustment is None else mapping.adjustment.free
    weights = observation_weights(mapping, LOSS)
    noise = measure_noise(mapping, LOSS, weights)
    apart = edge_distances(mapping.poses, mapping.cameras[mapping.camera_index], curves.bundle())
    edges = weights_in_a_bundle(curves, apart, beside_points=True).bundle(unit=noise, loss=edge_loss(apart))
    result = bundle_adjust(
        mapping.problem(),
        structure=[edges] if lines is None or not len(lines) else [edges, lines_in_a_bundle(mapping, lines, noise)],
        weights=weights,
        loss=LOSS,
        max_iterations=MOST_STEPS,
        tolerance=TOLERANCE,
        **about_cameras(mapping, free, prior, weights),
    )
    samples, *others = result.structure
    assert isinstance(samples, BundleCurves), "given"
    if lines is not None and others:
        lines = lines.adjusted(others[0])  # type: ignore[arg-type]
    return WithCurves(as_adjusted(mapping, result, free, prior), lines, _together(curves, curves.adjusted(samples)))


def _together(before: Curves, after: Curves) -> Curves:
    """The curves after an adjustment, with samples that few edges hold moved as those beside them.

    By themselves they fly off along what holds them in no image, and leave spikes.
    """
    own = torch.arange(len(before.X), device=before.X.device)
    beside = (own[:, None] + torch.arange(-_AROUND, _AROUND + 1, device=own.device)).clamp(0, max(len(own) - 1, 0))
    same = before.curve[beside] == before.curve[:, None]
    move = after.X - before.X
    around = torch.where(same[..., None], move[beside], torch.nan).nanmedian(1).values
    aside = torch.linalg.vector_norm(move - around, dim=-1) > _ASIDE * before.sigma
    return replace(after, X=torch.where(aside[:, None], before.X + around, after.X))
