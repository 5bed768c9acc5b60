"""New photographs into a model whose own photographs are not at hand, by the features that were kept of these."""

from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Int
from torch import Tensor

from torchsfm.images import MAX_PIXELS, Features, match_features, retrieve_pairs
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.known_poses import result_of
from torchsfm.reconstruction.matching.image_points import detect_all
from torchsfm.reconstruction.matching.known_features import KnownFeatures, observed_features
from torchsfm.reconstruction.matching.masks import Masks
from torchsfm.reconstruction.matching.match_all import MAX_IMAGES_ALL_PAIRS
from torchsfm.reconstruction.matching.sources import Source, Sources
from torchsfm.reconstruction.matching.stages import Stages, fingerprint, one_thread
from torchsfm.reconstruction.matching.view_graph import verify_pairs
from torchsfm.reconstruction.messages import Progress, ReconstructionError
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.new_images import place_images, start_mapping
from torchsfm.reconstruction.photographs import NEIGHBOURS
from torchsfm.reconstruction.report import SfmResult


@on_the_cpu
def register_photographs(
    images: Source,
    model: Reconstruction,
    features: KnownFeatures,
    *,
    masks: str | Path | None = None,
    max_features: int = 8192,
    max_pixels: int = MAX_PIXELS,
    neighbours: int = NEIGHBOURS,
    seed: int = 0,
    out: str | Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> SfmResult:
    """Place new photographs in an old model by the features that were kept of its own, which need not be at hand.

    The features of the new photographs are matched with those of the old ones and of each other; poses are estimated robustly
    from the points that these show, and the new photographs are added with new points. The poses and cameras of the model
    stay as they are, as does its world frame. A photograph that the files say the same camera took as others of the model gets
    its intrinsics, and where they say nothing one of the same size, unless other numbers explain it clearly better: another
    focal length, the ratio of both where it was stretched along one side, the principal point where it was cropped. Those of
    other cameras are estimated; photographs of which files do not say that two took them share them where that explains none of
    them clearly worse. The report judges the new photographs.

    Args:
        images: A folder or image files, also a single one; those that the model has poses for are passed over.
        model: The model.
        features: Those of its images, in which its observations are found.
        masks: Folder of masks, see `reconstruct`.
        max_features: Features per image.
        max_pixels: Larger images are left out.
        neighbours: Images each one is matched with when there are many.
        seed: The same seed gives the same poses.
        out: Folder in which the features of the new photographs are saved.
        resume: Use those that an earlier run with the same photographs and options saved there.
        progress: Called as the work goes on.

    Returns:
        The model with the new photographs that found a pose, its own images first, and a report, which says why others did not.

    Raises:
        ReconstructionError: Wrong input: no new photographs, features of other photographs, a model without points.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> photos = torchsfm.render_sequence(views=6, width=320, height=240, generator=g).save("photos")
        >>> model = torchsfm.reconstruct(photos[:5], out="run").model
        >>> known = torchsfm.reconstruction.saved_features("run", model)
        >>> result = torchsfm.reconstruction.register_photographs(photos[5], model, known)
        >>> int(result.model.registered.sum())
        6
    """
    report = progress or (lambda stage, done, total: None)
    generator = torch.Generator().manual_seed(seed)
    model = model.to("cpu", torch.float64)
    sources = _new_sources(images, model, [folder for folder in (out, masks) if folder is not None])
    old_x, old_descriptors, old_labels = _of_model(features, model)
    observed = observed_features(model, old_x)
    if not len(observed):
        raise ReconstructionError("the model has no points, by which photographs could be placed")
    admitted = None if masks is None else Masks.of(masks, sources)
    options = {"features": max_features, "pixels": max_pixels, "names": sources.names}
    stages = Stages(None if out is None else Path(out), resume, fingerprint(list(sources.files), options))
    new = detect_all(sources.files, sources.names, stages, max_features, max_pixels, report, admitted, least=1)
    old = len(model.names)
    count = old + len(new.names)
    x = [*(a.double() for a in old_x), *(a.double() for a in new.x)]
    of_old = [Features(a, a[:, 0], a[:, 0], a[:, 0], d) for a, d in zip(old_x, old_descriptors, strict=True)]
    everything = [*of_old, *(new.features[k] for k in range(len(new.names)))]
    with stages.timed("match"):
        report("match", 0, 1)
        pairs = torch.combinations(torch.arange(count))
        if count > MAX_IMAGES_ALL_PAIRS:
            pairs = retrieve_pairs(everything, neighbours=neighbours)
        # An image without a pose is none of the old ones; what these have in common the model knows.
        posed = torch.cat((model.registered, torch.ones(len(new.names), dtype=torch.bool)))
        pairs = pairs[(pairs[:, 1] >= old) & posed[pairs].all(-1)]
        matches = match_features(everything, pairs)
        report("match", 1, 1)
    size = torch.cat((model.image_size, new.image_size))
    with stages.timed("verify"), one_thread():
        matches = [_on_observed(m, i, model, observed, old_x) for m, (i, _) in zip(matches, pairs.tolist(), strict=True)]
        verified = verify_pairs(size, x, pairs, matches, generator=torch.Generator().manual_seed(seed))
    color = [torch.full((len(a), 3), 0.5, dtype=torch.float64) for a in old_x]
    offset = torch.tensor([0, *(len(a) for a in x)]).cumsum(0)
    graph = verified.graph((*model.names, *new.names), size, x, [*color, *(c.double() for c in new.color)], pairs)
    whole = graph.color
    there = observed >= 0
    node = offset[model.view[there]] + observed[there]
    whole[node] = model.color[model.point[there]].double()
    place = torch.cat((torch.where(model.registered, torch.arange(old), -1), torch.full((len(new.names),), -1)))
    with stages.timed("map"):
        report("map", int(model.registered.sum()), count)
        labels, focal = (*old_labels, *new.labels), (*(None for _ in range(old)), *new.focal)
        mapping, choices, cameras = start_mapping(graph, labels, focal, model, place, generator)
        point = mapping.point.clone()
        point[node] = model.point[there]
        mapping = replace(mapping, X=model.X, point=point).compacted()
        absent = ~posed
        before = mapping.registered
        mapping = replace(mapping, registered=before | absent)
        mapping, choices, cameras, reasons = place_images(mapping, choices, cameras, report)
        mapping = replace(mapping, registered=mapping.registered & ~absent)
        # Of the old images only pairs with new ones are known here, which say little of them.
        everyone = (*model.names, *sources.names)
        result = result_of(mapping, choices, cameras, reasons, new.failures, everyone, judged=place < 0)
    course = replace(result.report, seconds=dict(stages.seconds), skipped=sources.skipped)
    models = tuple(replace(found, lines=model.lines, conics=model.conics, curves=model.curves) for found in result.models)
    return SfmResult(models, course)


def _new_sources(images: Source, model: Reconstruction, without: list[str | Path]) -> Sources:
    """The photographs that the model has no poses for.

    Raises:
        ReconstructionError: There are none.
    """
    sources = Sources.of(images, without, least=1)
    posed = {name for name, there in zip(model.names, model.registered.tolist(), strict=True) if there}
    chosen = [k for k, name in enumerate(sources.names) if name not in posed]
    if not chosen:
        raise ReconstructionError("the model has poses for all of the photographs: nothing is new")
    files, names = tuple(sources.files[k] for k in chosen), tuple(sources.names[k] for k in chosen)
    return replace(sources, files=files, names=names)


def _of_model(features: KnownFeatures, model: Reconstruction) -> tuple[list[Tensor], list[Tensor], list[str]]:
    """Places, descriptors and labels of the model's images in their order; none for those that the features lack.

    Raises:
        ReconstructionError: They lack an image with a pose.
    """
    number = {name: k for k, name in enumerate(features.names)}
    missing = [name for name, there in zip(model.names, model.registered.tolist(), strict=True) if there and name not in number]
    if missing:
        raise ReconstructionError(f"there are no features of {missing[0]}, and {len(missing)} images of the model lack them")
    width = features.descriptors[0].shape[-1] if features.descriptors else 128
    nothing = (torch.zeros(0, 2), torch.zeros(0, width, dtype=torch.uint8), "")
    rows = [
        (features.x[number[name]], features.descriptors[number[name]], features.labels[number[name]])
        if name in number else nothing for name in model.names
    ]  # fmt: skip
    return [x for x, _, _ in rows], [d for _, d, _ in rows], [label for _, _, label in rows]


def _on_observed(
    match: Int[Tensor, "k 2"], image: int, model: Reconstruction, observed: Int[Tensor, "m"], x: list[Tensor]
) -> Int[Tensor, "_ 2"]:
    """Matches of an old image, where of several features at one place the one counts that the model has observed.

    Points with several directions are found once for each.
    """
    if image >= len(model.names):
        return match
    _, group = torch.unique(x[image], dim=0, return_inverse=True)
    chosen = torch.full((int(group.max()) + 1 if len(group) else 0,), -1, dtype=torch.long)
    mine = observed[(model.view == image) & (observed >= 0)]
    chosen[group[mine]] = mine
    better = chosen[group[match[:, 0]]]
    old = torch.where(better >= 0, better, match[:, 0])
    once: Tensor = torch.unique(torch.stack((old, match[:, 1]), 1), dim=0)
    return once
