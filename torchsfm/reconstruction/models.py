"""From a view graph to finished models, with what is to be said of them."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import torch

from torchsfm.reconstruction.attempts import best_attempt
from torchsfm.reconstruction.curves.find_curves import FoundEdges, find_curves
from torchsfm.reconstruction.evidence.doubt import Standing
from torchsfm.reconstruction.image_reports import image_reports
from torchsfm.reconstruction.lines.find_lines import FoundSegments, find_lines
from torchsfm.reconstruction.mappers.growth import Component, Given, Growth, Wanted
from torchsfm.reconstruction.mappers.incremental import UNKNOWN_FOCAL
from torchsfm.reconstruction.mapping.calibration import Calibration
from torchsfm.reconstruction.matching.stages import Stages, one_thread
from torchsfm.reconstruction.matching.view_graph import ViewGraph
from torchsfm.reconstruction.messages import Progress
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.report import Report, SfmResult, pair_report

FEW_IMAGES = 60
"""Models of so few images have matrices too small to share between threads."""
Finished = tuple[Reconstruction, Standing, Calibration]
"""A model, what is thought of its camera poses, and what is known of its intrinsics."""


def build_models(
    given: Given,
    wanted: Wanted,
    *,
    order: Sequence[str],
    failures: dict[str, str] | None = None,
    generator: torch.Generator,
    stages: Stages,
    progress: Progress,
    segments: Callable[[], FoundSegments] | None = None,
    edges: Callable[[], FoundEdges] | None = None,
) -> SfmResult:
    """Reconstruct every component of a view graph.

    Args:
        given: Image points, verified matches, and what files say of the cameras.
        wanted: How models are to be made.
        order: All files in the order of the input.
        failures: Files that could not be read, with the reason.
        generator: Source of randomness.
        stages: Timing and saving.
        progress: Called as images are registered.
        segments: Finds the segments of all images where lines are wanted.
        edges: Finds the edges of all images where curves are wanted.
    """
    number = len(given.graph.names)
    with stages.timed("map"), one_thread() if number <= FEW_IMAGES else nullcontext():
        attempt = best_attempt(given, wanted, generator, lambda done, total: progress("map", done, total))
        made: list[tuple[Component, Reconstruction]] = []
        for component in attempt.components:
            made.append(_with_lines_and_curves(component, segments, edges, stages, progress))
            if stages.folder is not None:
                _save_model(made[-1][1], stages.folder, len(made) - 1)
        found = [(finished, *attempt.judge(component)) for component, finished in made]
        found.sort(key=lambda entry: (-entry[0].num_registered, -entry[0].num_points))
    progress("map", number, number)
    return SfmResult(
        tuple(model for model, _, _ in found), _report(attempt.growth, given.graph, found, order, failures or {}, stages)
    )


def _with_lines_and_curves(
    component: Component,
    segments: Callable[[], FoundSegments] | None,
    edges: Callable[[], FoundEdges] | None,
    stages: Stages,
    progress: Progress,
) -> tuple[Component, Reconstruction]:
    """The model with its lines and curves, where they are wanted; both move the cameras."""
    model, lines, curves = component.model, None, None
    if segments is not None:
        with stages.timed("lines"):
            model, lines = find_lines(model, segments(), component.options.prior(model))
    if edges is not None:
        with stages.timed("curves"):
            # Lines that have moved no camera are contradicted by points.
            agree, prior = model is not component.model, component.options.prior(model)
            threshold = component.options.reprojection
            model, lines, curves = find_curves(
                model, edges(), prior, progress, lines=lines, lines_agree=agree, threshold=threshold
            )
    return component.moved(model), replace(model.reconstruction(), lines=lines, curves=curves)


def _report(
    growth: Growth,
    graph: ViewGraph,
    found: Sequence[Finished],
    order: Sequence[str],
    failures: dict[str, str],
    stages: Stages,
) -> Report:
    """What became of each file, of the pairs and of the cameras."""
    empty, sigma = growth.begun.empty, growth.begun.options.focal_sigma
    unknown_focal = (sigma >= UNKNOWN_FOCAL)[empty.camera_index]
    verdict = graph.verdicts(empty.cameras.K[empty.camera_index], unknown_focal)
    return Report(
        image_reports(graph, [(model, standing) for model, standing, _ in found], growth.reasons, failures, order),
        pair_report(graph.pairs, graph.num_matches, graph.fundamental_inliers, graph.homography_inliers, verdict),
        dict(stages.seconds),
        growth.source,
        tuple(growth.autocalibration),
        calibrations=tuple(calibration for _, _, calibration in found),
        method=growth.method,
        still=graph.still,
    )


def _save_model(model: Reconstruction, folder: Path, number: int) -> None:
    (folder / "stages").mkdir(parents=True, exist_ok=True)
    model.save(folder / "stages" / f"model-{number}.npz")
