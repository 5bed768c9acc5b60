"""The models of all images by one mapper, what is thought of them, and by which of two mappers they are better."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchsfm.geometry.rotations import rotation_angle
from torchsfm.linalg import nearest_rotation
from torchsfm.motion.many_views.components import components
from torchsfm.reconstruction.evidence.consistency import pair_agreement
from torchsfm.reconstruction.evidence.doubt import WRONG_ANGLE, Standing, examine
from torchsfm.reconstruction.evidence.groups import hinges
from torchsfm.reconstruction.lenses import FISHEYE, POLYNOMIALS, explains_better, may_be_fisheye
from torchsfm.reconstruction.mappers.cropped import crops_of_one_plane
from torchsfm.reconstruction.mappers.growth import Component, Given, Growth, Wanted
from torchsfm.reconstruction.mappers.unfold import hanging_on_copies, outvoted_by_rivals
from torchsfm.reconstruction.mapping.adjust import LOSS
from torchsfm.reconstruction.mapping.calibration import (
    ENOUGH,
    ENOUGH_OF_FEW,
    FEW,
    Calibration,
    calibration_of,
    observation_weights,
)
from torchsfm.reconstruction.mapping.mapping import Mapping
from torchsfm.reconstruction.matching.view_graph import MIN_INLIERS, ViewGraph
from torchsfm.reconstruction.resized import shapes_of_squares
from torchsfm.reconstruction.stretched import apparent_aspect

LEFT = 0.1
"""Models have fallen apart where a larger part of the images that hang together with the largest one is not in it."""


@dataclass(frozen=True)
class Attempt:
    """All models that one mapper made."""

    graph: ViewGraph
    wanted: Wanted
    growth: Growth
    components: tuple[Component, ...]
    judged: dict[int, tuple[Standing, Calibration]] = field(default_factory=dict)
    """What is thought of the components, by their identity."""

    @classmethod
    def of(cls, graph: ViewGraph, wanted: Wanted, growth: Growth) -> "Attempt":
        """Make them."""
        return cls(graph, wanted, growth, tuple(growth.components()))

    def judge(self, component: Component) -> tuple[Standing, Calibration]:
        """What is thought of a model's camera poses and intrinsics."""
        if not any(component is one for one in self.components):
            return self._judge(component)
        if id(component) not in self.judged:
            self.judged[id(component)] = self._judge(component)
        return self.judged[id(component)]

    def _judge(self, component: Component) -> tuple[Standing, Calibration]:
        model, options, threshold = component.model, component.options, self.growth.begun.options.reprojection
        others = self.growth.taken & ~model.registered
        uncertain = component.uncertain
        if uncertain is not None and bool(self.growth.given_up.any()):
            uncertain = uncertain | hanging_on_copies(self.graph, model, others, threshold=threshold)
        # Where nothing tells whether images are cropped, cameras are as uncertain as if they were.
        widest = replace(options, cropped=options.cropped or component.off_centre).prior(model)
        outvoted = None if model.graph is self.graph else outvoted_by_rivals(self.graph, model, threshold=threshold)
        # What few wrong matches of two views hold fast is not known: deviations are those that longer tracks leave.
        weights = observation_weights(model, LOSS, enough=ENOUGH_OF_FEW if int(model.registered.sum()) <= FEW else ENOUGH)
        standing = examine(
            model, open_numbers=self.wanted.free, prior=widest, threshold=threshold, weights=weights, uncertain=uncertain,
            conflicts=component.conflicts, agreement=component.agreement,
            elsewhere=matches_across(self.graph, model.registered, others), outvoted=outvoted,
            flat=crops_of_one_plane(model, options), rival=component.rival,
        )  # fmt: skip
        covariance = None if standing.intrinsics is None or component.off_centre else (self.wanted.free, standing.intrinsics)
        calibration = calibration_of(model, options.prior(model), loss=LOSS, weights=weights, covariance=covariance,
                                     excess=standing.excess)  # fmt: skip
        strained = self.wanted.camera in POLYNOMIALS and may_be_fisheye(model)
        return standing, replace(calibration, strained=strained)

    @property
    def largest(self) -> Mapping:
        """The model of most images."""
        return max((component.model for component in self.components), key=lambda model: int(model.registered.sum()))

    @property
    def registered(self) -> int:
        """How many images are in a model."""
        return sum(int(component.model.registered.sum()) for component in self.components)

    @property
    def undoubted(self) -> int:
        """How many of these are not doubtful."""
        return sum(int(self.sure(component).sum()) for component in self.components)

    def sure(self, component: Component) -> Bool[Tensor, "v"]:
        """Images of a model that are not doubtful."""
        return component.model.registered & ~torch.tensor([bool(doubt) for doubt in self.judge(component)[0].doubt])

    @property
    def hinged(self) -> bool:
        """Whether a single pair of images holds a part of a model, which may be turned anywhere then, to the rest."""
        threshold = self.growth.begun.options.reprojection
        agreements = ((one.model, one.agreement or pair_agreement(one.model, threshold=threshold)) for one in self.components)
        return any(bool(hinges(agreement, model).any()) for model, agreement in agreements)

    def bends(self, other: "Attempt") -> bool:
        """Whether images that are not doubtful in the other attempt are turned against each other by `WRONG_ANGLE` here."""
        for one in self.components:
            for known in other.components:
                both = one.model.registered & other.sure(known)
                turn = known.model.poses.R[both].mT @ one.model.poses.R[both]
                if len(turn) and float(rotation_angle(nearest_rotation(turn.sum(0)).mT @ turn).max().rad2deg()) > WRONG_ANGLE:
                    return True
        return False

    @property
    def fell_apart(self) -> bool:
        """Whether more than a few of the images that hang together with those of the largest model are not in it."""
        if not self.components:
            return False
        largest = self.largest.registered
        found = torch.maximum(self.graph.fundamental_inliers, self.graph.homography_inliers)
        label = components(self.graph.pairs[found >= MIN_INLIERS], len(largest))
        together = label == label[largest].mode().values
        return int((together & ~largest).sum()) > LEFT * int(together.sum())


def best_attempt(given: Given, wanted: Wanted, generator: torch.Generator, progress: Callable[[int, int], None]) -> Attempt:
    """The models of all images; where camera or mapper are not prescribed, those by another one if these leave it open.

    Images that are placed one by one need many points in common with those before. To place all at once takes less, and goes
    wrong more often: a part that is turned about its only relation bends the rest, and the focal length gives way. So what is
    placed at once must not bend what was placed one by one and is not in doubt, nor hang on a hinge, and fewer images must be
    in doubt.
    """

    def made(wanted: Wanted) -> Attempt:
        return Attempt.of(given.graph, wanted, Growth.of(given, wanted, generator, progress))

    attempt = _of_all_shapes(given.graph, wanted, made)
    for question in (_stretched, _fisheye):
        another = question(attempt) if attempt.components else None
        trial = None if another is None else made(another)
        attempt = attempt if trial is None or not _is_better(trial, attempt) else trial
    if wanted.method != "auto" or attempt.growth.method != "incremental":
        return attempt
    if 2 * attempt.undoubted >= attempt.registered and not attempt.fell_apart:
        return attempt
    other = Attempt.of(given.graph, attempt.wanted, attempt.growth.by("global"))
    if other.bends(attempt) or other.hinged:
        return attempt
    return max(attempt, other, key=lambda one: (one.undoubted, one.registered))


def _of_all_shapes(graph: ViewGraph, wanted: Wanted, made: Callable[[Wanted], Attempt]) -> Attempt:
    """Models of images as they are, or of square ones as they were before, upright and lying, where pairs say so.

    Where they do not say so clearly, both are made. Ratios are estimated, and come to one where images were square.
    """
    told = shapes_of_squares(graph) if wanted.pixels_are_open else None
    if told is None:
        return made(wanted)
    shaped = made(replace(wanted, aspect=told.aspect))
    if told.clear and shaped.components and not shaped.fell_apart:
        return shaped
    plain = made(wanted)
    return shaped if _is_better(shaped, plain) else plain


def _is_better(trial: Attempt, attempt: Attempt) -> bool:
    """Whether models with other cameras have hardly fewer images, and explain them better than by chance."""
    if not attempt.components or not trial.components:
        return bool(trial.components)
    return trial.registered > (1 - LEFT) * attempt.registered and explains_better(attempt.largest, trial.largest)


def _stretched(attempt: Attempt) -> Wanted | None:
    """The same with pixels that are not square, where they are open and seem so."""
    model, wanted = attempt.largest, attempt.wanted
    (options,) = (component.options for component in attempt.components if component.model is model)
    open_ = wanted.pixels_are_open and wanted.aspect is None
    ratio = apparent_aspect(model, options.prior(model)) if open_ else None
    return None if ratio is None else replace(wanted, aspect=torch.full((len(model.registered),), ratio, dtype=torch.float64))


def _fisheye(attempt: Attempt) -> Wanted | None:
    """The same with a fisheye, where the lens is open and may be one."""
    if not attempt.wanted.lens_is_open or not may_be_fisheye(attempt.largest):
        return None
    return replace(attempt.wanted, camera=FISHEYE)


def matches_across(graph: ViewGraph, registered: Bool[Tensor, "v"], others: Bool[Tensor, "v"]) -> Int[Tensor, "v"]:
    """How many verified matches each image of a model has with images of others."""
    total = torch.zeros(len(registered), dtype=torch.long)
    for own, other in (graph.pairs.unbind(1), graph.pairs.flip(1).unbind(1)):
        across = registered[own] & others[other]
        total.index_add_(0, own[across], graph.fundamental_inliers[across])
    return total
