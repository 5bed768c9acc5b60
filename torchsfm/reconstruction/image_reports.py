"""What became of each file of a folder."""

from collections.abc import Sequence

import torch

from torchsfm.reconstruction.evidence.doubt import Standing
from torchsfm.reconstruction.matching.view_graph import MIN_INLIERS, ViewGraph
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.report import ImageReport

MIN_FEATURES = 30
"""An image with fewer features shows nothing to match."""


def image_reports(
    graph: ViewGraph,
    found: Sequence[tuple[Reconstruction, Standing]],
    reasons: dict[int, str],
    failures: dict[str, str],
    order: Sequence[str],
) -> tuple[ImageReport, ...]:
    """What became of each file, in the order of the input.

    Args:
        graph: Image points and verified matches of the images that could be read.
        found: The models, and what is thought of their cameras.
        reasons: Why images are in none of them, by index.
        failures: Files that could not be read, with the reason.
        order: All files.
    """
    features = torch.bincount(graph.view, minlength=len(graph.names)).tolist()
    related = graph.pairs[torch.maximum(graph.fundamental_inliers, graph.homography_inliers) >= MIN_INLIERS].flatten()
    linked = torch.bincount(related, minlength=len(graph.names)).tolist()
    reports: list[ImageReport] = []
    position = 0
    for name in order:
        if name in failures:
            reports.append(ImageReport(name, None, failures[name]))
            continue
        i, position = position, position + 1
        model = next((k for k, (m, _) in enumerate(found) if bool(m.registered[i])), None)
        if model is not None:
            standing = found[model][1]
            sigma = {"rotation_sigma": float(standing.rotation_sigma[i]), "position_sigma": float(standing.position_sigma[i])}
            reports.append(ImageReport(name, model, "", features[i], doubt=standing.doubt[i], **sigma))
            continue
        if features[i] < MIN_FEATURES:
            reason = f"only {features[i]} features: nothing to match"
        elif not linked[i]:
            reason = "has too little in common with every other image"
        else:
            reason = reasons.get(i, "sees too few of the reconstructed points")
        reports.append(ImageReport(name, model, reason, features[i]))
    return tuple(reports)
