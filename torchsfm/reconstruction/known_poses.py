"""Photographs of which the poses are known: points for them, and poses for further photographs of the same scene."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Pose, similarity_from_points
from torchsfm.images import MAX_PIXELS
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.evidence.doubt import examine
from torchsfm.reconstruction.held_poses import structure_of_held
from torchsfm.reconstruction.image_reports import image_reports
from torchsfm.reconstruction.mappers.incremental import LAST_ITERATIONS, LAST_TOLERANCE, MappingOptions
from torchsfm.reconstruction.mapping.adjust import adjust
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.matching.sources import Source
from torchsfm.reconstruction.messages import Progress, ReconstructionError
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.new_images import NewCameras, place_images, start_mapping
from torchsfm.reconstruction.photographs import NEIGHBOURS, MatchedPhotographs, match_photographs
from torchsfm.reconstruction.report import Report, SfmResult, pair_report


@on_the_cpu
def triangulate_photographs(
    images: Source,
    poses: Reconstruction,
    *,
    refine_poses: bool = False,
    register: bool = False,
    sequence: bool = False,
    masks: str | Path | None = None,
    max_features: int = 8192,
    max_pixels: int = MAX_PIXELS,
    neighbours: int = NEIGHBOURS,
    seed: int = 0,
    out: str | Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> SfmResult:
    """Find the points that photographs with known cameras and poses show, and place further photographs among them.

    Features are matched as `reconstruct` does; tracks are triangulated with the poses given, and points moved to the least
    robust reprojection error. World frame and scale stay those of the poses.

    Args:
        images: A folder or image files, see `reconstruct`.
        poses: A model with the poses and cameras of these photographs, by their names; its points are not used.
        refine_poses: Adjust the poses together with the points, the cameras held; the result is moved back to where the camera
            centres fit those given best.
        register: Also place the photographs that are not in the model, in the frame that the others make. Those that the files
            say the same camera took as others of the model get its intrinsics, and where files say nothing those of the same
            size, unless another focal length explains them clearly better; the intrinsics of other cameras are estimated, as
            `register_photographs` does. The poses and cameras given stay as they are.
        sequence: The images are consecutive frames of a video.
        masks: Folder of masks, see `reconstruct`.
        max_features: Features per image.
        max_pixels: Larger images are left out.
        neighbours: Images each one is matched with when there are many.
        seed: The same seed gives the same model.
        out: Folder in which finished stages are saved.
        resume: Use the stages that an earlier run with the same images and options saved there.
        progress: Called as the work goes on.

    Returns:
        One model of all photographs, unless nothing could be triangulated, and a report.

    Raises:
        ReconstructionError: Wrong input: no such folder, fewer than two photographs that the model has poses for, or
            photographs of other sizes than the model says.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> files = torchsfm.render_sequence(views=4, width=320, height=240, generator=g).save("photos")
        >>> poses = torchsfm.reconstruct("photos").model  # or `torchsfm.read_model` of any program's
        >>> result = torchsfm.triangulate_photographs("photos", poses)
        >>> len(result.model.X) > 100
        True
    """
    report = progress or (lambda stage, done, total: None)
    generator = torch.Generator().manual_seed(seed)
    seen = match_photographs(
        images, sequence=sequence, max_features=max_features, max_pixels=max_pixels, neighbours=neighbours, out=out,
        resume=resume, seed=seed, progress=report, masks=masks,
    )  # fmt: skip
    place = _places(seen, poses)
    reasons = dict.fromkeys((place < 0).nonzero()[:, 0].tolist(), "has no pose in the given model")
    with seen.stages.timed("map"):
        report("map", 0, len(place))
        mapping, options, new = start_mapping(
            seen.graph, seen.points.labels, seen.points.focal, poses.to("cpu", torch.float64), place, generator
        )
        given = mapping
        mapping = structure_of_held(mapping, options)
        if refine_poses:
            for _ in range(2):
                mapping = structure_of_held(adjust(mapping, max_iterations=LAST_ITERATIONS, tolerance=LAST_TOLERANCE), options)
            mapping = _moved_back(mapping, given)
        if register and len(mapping.X):
            mapping, options, new, reasons = place_images(mapping, options, new, report)
        report("map", int(mapping.registered.sum()), len(place))
        result = result_of(mapping, options, new, reasons, seen.points.failures, seen.names)
    course = replace(result.report, seconds=dict(seen.stages.seconds), skipped=seen.skipped)
    return replace(result, report=course)


def result_of(
    mapping: Mapping,
    options: MappingOptions,
    new: NewCameras,
    reasons: dict[int, str],
    failures: dict[str, str],
    order: Sequence[str],
    judged: Bool[Tensor, "v"] | None = None,
) -> SfmResult:
    """The finished model with what is thought of it.

    Args:
        mapping: The model.
        options: How it was made.
        new: What was found of cameras that are not the model's.
        reasons: Why images have no pose, by index.
        failures: Files that could not be read, with the reason.
        order: All files in the order of the input.
        judged: Images all of whose pairs were compared; see `examine`.
    """
    graph = mapping.graph
    numbers = (*new.open_numbers, *mapping.cameras.distortion.parameter_names) if bool(new.own.any()) else ()
    standing = examine(mapping, open_numbers=numbers, prior=new.prior(mapping, options), threshold=options.reprojection,
                       judged=judged)  # fmt: skip
    found = [(mapping.reconstruction(), standing)] if len(mapping.X) else []
    known = torch.zeros(len(graph.names), dtype=torch.bool)
    verdict = graph.verdicts(mapping.cameras.K[mapping.camera_index], known)
    pairs = pair_report(graph.pairs, graph.num_matches, graph.fundamental_inliers, graph.homography_inliers, verdict)
    reports = image_reports(graph, found, reasons, failures, order)
    return SfmResult(tuple(model for model, _ in found), Report(reports, pairs, {}))


def _places(seen: MatchedPhotographs, poses: Reconstruction) -> Int[Tensor, "v"]:
    """Which image of the model each photograph is, or -1; of the model's only those with a pose count.

    Raises:
        ReconstructionError: Fewer than two are there, or one has another size.
    """
    posed = {name: i for i, name in enumerate(poses.names) if bool(poses.registered[i])}
    place = torch.tensor([posed.get(name, -1) for name in seen.points.names], dtype=torch.long)
    for i, name in enumerate(seen.points.names):
        size, wanted = seen.points.image_size[i].tolist(), poses.image_size[place[i]].tolist()
        if place[i] >= 0 and size != wanted:
            sizes = f"{size[0]} x {size[1]} pixels, in the model of the poses {wanted[0]} x {wanted[1]}"
            raise ReconstructionError(f"{name}: {sizes}")
    if int((place >= 0).sum()) < 2:
        first = next(iter(posed), "none")
        raise ReconstructionError(
            f"{int((place >= 0).sum())} of {len(place)} photographs have a pose in the model, two are the least"
            f" (the model has {first!r}, the photographs {seen.points.names[0]!r})"
        )
    return place


def _moved_back(mapping: Mapping, given: Mapping) -> Mapping:
    """The mapping where its camera centres fit the given ones best; as it is where these do not tell."""
    keep = mapping.registered
    back = similarity_from_points(mapping.poses.centre[keep], given.poses.centre[keep])
    if back.status != Status.OK:
        return mapping
    poses = back.transform_pose(mapping.poses)
    R = torch.where(keep[:, None, None], poses.R, mapping.poses.R)
    return replace(mapping, X=back.transform(mapping.X), poses=Pose(R, torch.where(keep[:, None], poses.t, mapping.poses.t)))
