"""Grow a model from two images to all that fit (incremental structure from motion).

The order of work follows Schönberger & Frahm, Structure-from-Motion Revisited, 2016; images are registered, and tracks
triangulated, many at a time.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.geometry import Camera
from torchsfm.reconstruction.mapping.adjust import adjust, adjust_all, adjust_by_tracks, neighbourhood, support
from torchsfm.reconstruction.mapping.calibration import FEW, images_of_cameras, lone_cameras_plausible
from torchsfm.reconstruction.mapping.camera_prior import CameraPrior
from torchsfm.reconstruction.mapping.initialize import MIN_POINTS, place_start, starting_pairs
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.mapping.register import MIN_VISIBLE, SEARCHED, register_images, visibility_scores
from torchsfm.reconstruction.mapping.structure import complete_tracks, filter_points, merge_points, triangulate_tracks

MAX_STARTS = 5
"""Starting pairs tried before a set of images is given up."""
SEVERAL = 12
"""Of `FEW` images a model is made from several starts, as what one got wrong the others do not put right: a plane seen from the
wrong side, another focal length. So it is of so many where the focal length is guessed."""
SAME, AGREED, AGREED_OF_FEW = 0.01, 2, 3
"""Models of starts are one where what they explain differs by this part. Starts of several images, and those from focal lengths
that are known a little for each image alone, are tried until two come to the best there is, of few images until three do."""
OTHER_FOCAL = 1.0, 0.7, 1.4
"""Where these do not come to the same, few images are begun with focal lengths of so much times those that were guessed too."""
GLOBAL_GROWTH = 1.1
"""A model this much larger than at its last global adjustment gets another."""
SMALL = 20
"""Models of up to this many images are adjusted as a whole every time."""
UNKNOWN_FOCAL = 0.4
"""Focal lengths more uncertain than this fraction are guesses, by which no pair of images is judged."""
LAST_ITERATIONS, LAST_TOLERANCE = 300, 1e-7
"""The last adjustment goes to the minimum, to a small part of the standard deviations; there it is given up."""
SETTLED, HARDLY = 0.01, 0.05
"""A model is settled where a smaller part of its observations came or went than the first; the second does not change which
numbers of its cameras are determined."""
ROUGHLY: dict[str, Any] = {"max_iterations": 20, "tolerance": 1e-4}
"""How far principal points of lone cameras go before they are looked at."""
STANDING = 1e-6
"""Damping of the first step of an adjustment of cameras that stand about where they should: more would only hold back what is
left, long rows of cameras that bend as a whole."""

FIRST: dict[str, Any] = {"max_iterations": 20, "tolerance": 3e-4, "initial_damping": STANDING}
NEARLY: dict[str, Any] = {"max_iterations": LAST_ITERATIONS, "tolerance": 3e-5, "initial_damping": STANDING}
"""How far to adjust before observations are looked for once more, at first, and then: about to the minimum, as what is asked of
a model does not tell it from one there, and `finish` goes on to another one."""


@dataclass(frozen=True)
class MappingOptions:
    """How a model is grown; distances in pixels, angles in radians.

    Attributes:
        free: Intrinsic parameters to estimate.
        expected: The cameras before any image point was seen; see `CameraPrior`.
        focal_sigma: How uncertain the expected focal lengths are, as a fraction.
        reprojection: Largest reprojection error of an observation.
        registration: Largest reprojection error of an inlier when an image is registered.
        min_angle: Smallest angle between the rays of a point.
        generator: Source of randomness.
        cropped: Whether images may have been cut out of larger ones, so that their principal points lie anywhere.
        alike: Whether one camera took them all; see `CameraPrior`.
        body: Cameras that are one with a zoom lens; see `CameraPrior`.
    """

    free: tuple[str, ...]
    expected: Camera
    focal_sigma: Float[Tensor, "g"]
    reprojection: float = 4.0
    registration: float = 8.0
    min_angle: float = 0.026
    generator: torch.Generator | None = None
    cropped: bool = False
    alike: bool = False
    body: Int[Tensor, "g"] | None = None

    def prior(self, model: Mapping) -> CameraPrior:
        """What to expect of the cameras, as `adjust` takes it."""
        kind: dict[str, Any] = {"cropped": self.cropped, "alike": self.alike, "body": self.body}
        return CameraPrior.of(model, self.expected, self.focal_sigma, **kind)

    def adjust(self, model: Mapping, *, last: bool = False, lone: bool = False, **limits: Any) -> Mapping:
        """Adjust all of a model, with those numbers of its cameras free that its images determine.

        The principal point, which other errors pass for most easily, waits for the `last` adjustments, when all images are in.
        Where it may lie anywhere it passes for other errors, and does not wait.
        """
        names = [name for name in self.free if last or self.cropped or name != "principal_point"]
        faultless = len(model.registered) if self.cropped else int(lone)
        return adjust_all(model, names, self.prior(model), faultless=faultless, **limits)


def grow_model(
    mapping: Mapping, options: MappingOptions, progress: Callable[[int, int], None]
) -> tuple[Mapping, dict[int, str]] | None:
    """Reconstruct one component from the images not registered yet.

    Args:
        mapping: A mapping whose registered images belong to other models and are left alone.
        options: How the model is grown.
        progress: Called with the number of registered images and of all.

    Returns:
        A mapping of this component alone, and for each image that was tried and did not fit the reason; None if no pair of
        images was a start.
    """
    best: tuple[Mapping, dict[int, str]] | None = None
    explained: list[float] = []
    available = int((~mapping.registered).sum())
    alone = torch.bincount(mapping.camera_index, minlength=len(options.focal_sigma)) == 1
    guessed = options.focal_sigma >= UNKNOWN_FOCAL
    uncertain = (alone & (options.focal_sigma > SEARCHED)) | (guessed & (available <= SEVERAL))
    few = available <= FEW
    focals = OTHER_FOCAL if few and bool(guessed.any()) else OTHER_FOCAL[:1]
    for model, pair in chain.from_iterable(starts(mapping, guessed, options, times) for times in focals):
        grown = extend_model(model, mapping.registered, options, progress)
        explained.append(support(grown[0], options.reprojection))
        most = max(explained)
        best = grown if explained[-1] == most else best
        same = sum(value > (1 - SAME) * most for value in explained)
        enough = AGREED_OF_FEW if few else AGREED if bool(uncertain[mapping.camera_index[pair]].any()) else 1
        if same >= enough and (few or int(grown[0].registered.sum()) > 0.5 * available):
            break
    return best


def starts(
    mapping: Mapping, unknown: Bool[Tensor, "g"], options: MappingOptions, times: float = 1.0
) -> Iterator[tuple[Mapping, Int[Tensor, "2"]]]:
    """Models of two images, and these, the best first, from so many `times` the focal length where that is `unknown`."""
    K = mapping.cameras.K.clone()
    K[unknown, :2, :2] *= times
    begun = replace(mapping, cameras=replace(mapping.cameras, K=K))
    empty = Mapping.start(begun.graph, begun.track, begun.cameras, begun.camera_index)
    pairs = starting_pairs(begun, unknown[mapping.camera_index], threshold=options.reprojection, generator=options.generator)
    for start in pairs[:MAX_STARTS]:
        model = place_start(empty, start, threshold=options.reprojection)
        model = adjust(model, tolerance=1e-4)
        model = filter_points(model, threshold=options.reprojection, min_angle=options.min_angle)
        if len(model.X) >= MIN_POINTS:
            yield model, start.pair


def extend_model(
    model: Mapping, elsewhere: Bool[Tensor, "v"], options: MappingOptions, progress: Callable[[int, int], None]
) -> tuple[Mapping, dict[int, str]]:
    """Register all images that fit, and refine the whole.

    Args:
        model: A mapping of at least two registered images, with points.
        elsewhere: Images that belong to other models and are left alone.
        options: How the model is grown.
        progress: Called with the number of registered images and of all.

    Returns:
        The mapping, and for each image that was tried and did not fit the reason.
    """
    v = len(model.registered)
    sigma = options.focal_sigma.index_fill(0, model.camera_index[model.registered], 0.0)
    failed: dict[int, str] = {}
    adjusted_at = int(model.registered.sum())
    second_try = False
    while True:
        images = next_images(model, elsewhere, failed)
        if not len(images):
            # What failed against fewer points, or before the cameras were refined, is tried once more.
            if second_try or not failed:
                break
            second_try = True
            failed = {}
            model = _refine(model, options)
            continue
        before = model.registered
        model, count, inliers = register_images(
            model, images, threshold=options.registration, focal_sigma=sigma, generator=options.generator
        )
        new = model.registered & ~before
        for i, n, k in zip(images.tolist(), count.tolist(), inliers.tolist(), strict=True):
            if not new[i]:
                failed[i] = f"a pose fits only {k} of the {n} points it sees"
        if not bool(new.any()):
            continue
        second_try = False
        sigma = sigma.index_fill(0, model.camera_index[new], 0.0)
        model = triangulate_tracks(model, threshold=options.reprojection, min_angle=options.min_angle)
        model = complete_tracks(model, threshold=options.reprojection)
        registered = int(model.registered.sum())
        progress(registered, v)
        if registered <= SMALL or registered >= GLOBAL_GROWTH * adjusted_at:
            model = options.adjust(model, max_iterations=8, tolerance=1e-3)
            adjusted_at = registered
            failed = {}
        else:
            model = adjust(model, moving=neighbourhood(model, new), max_iterations=8, tolerance=1e-3)
        model = filter_points(model, threshold=options.reprojection, min_angle=options.min_angle)
        model = _drop_unsupported(model, failed)
    return _refine(model, options), failed


def next_images(model: Mapping, elsewhere: Bool[Tensor, "v"], failed: dict[int, str]) -> Int[Tensor, "k"]:
    """The unregistered images that see the model best: those with at least half the best score, at most eight."""
    count, score = visibility_scores(model)
    able = ~model.registered & ~elsewhere & (count >= MIN_VISIBLE)
    able[list(failed)] = False
    if not bool(able.any()):
        return torch.zeros(0, dtype=torch.long)
    score = torch.where(able, score, -1.0)
    order = torch.argsort(score, descending=True, stable=True)[:8]
    return order[score[order] >= 0.5 * score[order[0]]].sort().values


def _drop_unsupported(model: Mapping, failed: dict[int, str]) -> Mapping:
    """Take out images that lost nearly all their observations: their pose is not supported by the structure."""
    node = model.observations()
    count = torch.bincount(model.graph.view[node], minlength=len(model.registered))
    lost = model.registered & (count < 10)
    if not bool(lost.any()) or int((model.registered & ~lost).sum()) < 2:
        return model
    for i in lost.nonzero()[:, 0].tolist():
        failed[i] = f"only {int(count[i])} of its points fit the model after bundle adjustment"
    model = model.without(node[lost[model.graph.view[node]]])
    return replace(model, registered=model.registered & ~lost)


def _refine(model: Mapping, options: MappingOptions) -> Mapping:
    """Alternate global bundle adjustment with filtering, merging, completion and re-triangulation until little changes."""
    # What few observations determine of the cameras, more do.
    changed, limits, rough = 0.0, FIRST, True
    for _ in range(4):
        model = options.adjust(model, last=True, settled=changed <= HARDLY, **limits)
        before = model.point
        model = filter_points(model, threshold=options.reprojection, min_angle=options.min_angle)
        model = merge_points(model, threshold=options.reprojection)
        model = complete_tracks(model, threshold=options.reprojection)
        model = triangulate_tracks(model, threshold=options.reprojection, min_angle=options.min_angle)
        changed = int(((before >= 0) != (model.point >= 0)).sum()) / max(1, int((before >= 0).sum()))
        rough, limits = limits is FIRST, NEARLY
        if changed <= SETTLED:
            break
    if rough or changed > SETTLED:
        model = options.adjust(model, last=True, settled=changed <= HARDLY, **limits)
    lone = not options.cropped and bool((options.prior(model).sum_of_body(images_of_cameras(model)) == 1).any())
    if lone and "principal_point" in options.free:
        freed = model
        # Where that is not plausible soon, it is not worth the way to its minimum.
        for limits in (ROUGHLY, {"max_iterations": LAST_ITERATIONS, "tolerance": LAST_TOLERANCE}):
            freed = options.adjust(freed, last=True, lone=True, **limits)
            if not lone_cameras_plausible(freed, options.prior(freed)):
                break
        else:
            model = freed
    return filter_points(model, threshold=options.reprojection, min_angle=options.min_angle)


def finish(model: Mapping, options: MappingOptions) -> Mapping:
    """A model that stays as it is but for noise: what is no point in the world no longer moves its cameras."""
    limits: dict[str, Any] = {"max_iterations": LAST_ITERATIONS, "tolerance": LAST_TOLERANCE, "initial_damping": STANDING}
    model = adjust_by_tracks(model, options.prior(model), **limits)
    return filter_points(model, threshold=options.reprojection, min_angle=options.min_angle)
