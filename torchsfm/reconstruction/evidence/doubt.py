"""How well each camera of a finished model is known, and where it may be wrong altogether."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.bundle import bundle_covariance
from torchsfm.reconstruction.evidence.consistency import PairAgreement, excess_scatter, pair_agreement
from torchsfm.reconstruction.evidence.groups import hanging_groups, hinges, outvoted_groups
from torchsfm.reconstruction.evidence.missing import Conflicts, missing_correspondences
from torchsfm.reconstruction.mapping.adjust import LOSS, about_cameras
from torchsfm.reconstruction.mapping.calibration import FEW, HARDLY, measure_noise
from torchsfm.reconstruction.mapping.camera_prior import CameraPrior
from torchsfm.reconstruction.mapping.mapping import Mapping

WRONG_ANGLE = 5.0
"""Degrees by which a camera may be turned or displaced before it counts as wrong."""
DEVIATIONS = 3.0
"""So many standard deviations of a camera that is not doubtful stay below that: one chance in 370 to be wrong."""
EXPLAINED = 2 / 3
"""Share of the verified matches of a camera's pairs, and of those of all, that agree with a right model. Where things repeat
along the way, each pair has matches of several relations, and a model can agree with one of them only."""
GUESSED_FOCAL = 0.2
"""A focal length at least so uncertain, as a fraction, is a guess where the images do not determine it."""


@dataclass(frozen=True)
class Standing:
    """What a model knows of its cameras.

    Attributes:
        rotation_sigma: Standard deviation of each camera's rotation, degrees, in the gauge in which the cameras move least;
            infinite where it is not determined, and of images that are not registered. It
            grows with what the matches of a pair have in common, see `excess_scatter`.
        position_sigma: Standard deviation of each camera's place over the median depth of the points that it sees; likewise.
        doubt: Why each camera may be wrong; empty where nothing says so, and of images that are not registered.
        intrinsics: Covariance of the numbers of each distinct camera that were open, in the order of `intrinsics_covariance`,
            by the noise of the image points alone; None where it was not asked for.
        excess: By how much more than by that noise image points scatter together, as a ratio of variances.
    """

    rotation_sigma: Float[Tensor, "v"]
    position_sigma: Float[Tensor, "v"]
    doubt: tuple[str, ...]
    intrinsics: Float[Tensor, "g k k"] | None = None
    excess: float = 1.0


def examine(
    mapping: Mapping,
    *,
    open_numbers: Sequence[str],
    prior: CameraPrior,
    threshold: float,
    weights: Float[Tensor, "m"] | None = None,
    uncertain: Bool[Tensor, "v"] | None = None,
    conflicts: Conflicts | None = None,
    agreement: PairAgreement | None = None,
    elsewhere: Int[Tensor, "v"] | None = None,
    outvoted: Bool[Tensor, "v"] | None = None,
    flat: bool = False,
    rival: Float[Tensor, "v"] | None = None,
    judged: Bool[Tensor, "v"] | None = None,
) -> Standing:
    """Judge the cameras of a finished model by all that is known of its images.

    Args:
        mapping: The model.
        open_numbers: Intrinsic parameters that are not given, whether the images were found to determine them or not.
        prior: What was expected of the cameras before any image point was seen.
        threshold: Largest reprojection error of an observation, in pixels.
        weights: What the observations counted in the last adjustment, in their order; all alike when None.
        uncertain: Images that hang on a relation which may be one of like things, see `unfold`.
        conflicts: What missing correspondences say of this model where that is known; else it is found.
        agreement: How all pairs agree with this model where that is known; else it is found.
        elsewhere: How many verified matches each image has with images of other models.
        outvoted: Images that pairs which were given up contradict, see `outvoted_groups`.
        flat: Whether most pairs of images that seem to be cropped show little besides one plane, see `crops_of_one_plane`.
        rival: The focal length that explains each of few images nearly as well, in pixels; not a number where none does.
        judged: Images that are judged, all of whose pairs are known; the others stand as they were given. All when None.
    """
    v = len(mapping.registered)
    count = int(mapping.registered.sum())
    rotation, position, intrinsics = pose_deviations(mapping, open_numbers, prior, weights)
    excess = excess_scatter(mapping, threshold=threshold)
    rotation, position = rotation * excess**0.5, position * excess**0.5
    agreement = agreement or pair_agreement(mapping, threshold=threshold)
    one = torch.ones_like(agreement.matches)
    supporting, contradicting = (agreement.per_view(s, one, v) for s in (agreement.supports, agreement.contradicts))
    matches, agreeing = (agreement.per_view(one > 0, n, v) for n in (agreement.matches, agreement.agreeing))
    explained, verified = int(agreement.agreeing.sum()), int(agreement.matches.sum())
    misplaced = agreement.balance(v) < 0
    hinged = outvoted_groups(agreement, mapping.registered)
    hinged = hinged if outvoted is None else hinged | outvoted
    hanging = hanging_groups(agreement, mapping.registered, hinges(agreement, mapping))
    conflicts = conflicts or missing_correspondences(mapping)
    refuted, folded = conflicts.refuted, conflicts.folded
    guessed = prior.sigma["focal"][mapping.camera_index] >= GUESSED_FOCAL
    focal_sigma = torch.zeros_like(rotation)
    if "focal" in open_numbers:
        focal_sigma = (intrinsics[:, 0, 0].sqrt() / mapping.cameras.K[:, 0, 0])[mapping.camera_index]
    degrees = torch.atan(position).rad2deg()

    def doubt(i: int) -> str:
        if folded:
            own = (refuted == i).any(1)
            first, second = (mapping.graph.names[k] for k in refuted[int(own.long().argmax())].tolist())
            return f"things that look alike may be taken for one: {first} and {second} each miss what the other sees"
        if uncertain is not None and bool(uncertain[i]):
            return (
                "nothing that stands in one place alone connects it with the rest, and things that look alike stand in several"
            )
        if bool(misplaced[i]):
            return f"{int(contradicting[i])} pairs of images contradict its place, {int(supporting[i])} agree with it"
        if bool(hinged[i]):
            return (
                f"pairs of images contradict how it stands to most others, with {int(hinged.sum())} images of which this is so"
            )
        if int(agreeing[i]) < EXPLAINED * int(matches[i]):
            return f"{int(agreeing[i])} of the {int(matches[i])} matches of its pairs agree with its place, the others do not"
        if elsewhere is not None and int(elsewhere[i]) > int(matches[i]):
            return f"has {int(elsewhere[i])} matches with images of another model and {int(matches[i])} with those of its own"
        if explained < EXPLAINED * verified:
            return f"{explained} of the {verified} matches of all pairs agree with the model, the others do not"
        if count >= 3 and int(supporting[i]) < 2:
            return f"{('no pair', 'only one pair')[int(supporting[i])]} of images agrees with its place"
        if count >= 3 and int(hanging[i]) > 0:
            others = f", with {int(hanging[i]) - 1} more," if hanging[i] > 1 else ""
            return f"one pair of images alone holds it{others} to the rest, and says little of how it is turned"
        if count < 3 and bool(guessed[i]):
            return "two images alone, with a guessed focal length"
        if count <= FEW and bool(guessed[i]) and not focal_sigma[i] < HARDLY:
            return "few images, which hardly determine the focal length"
        if rival is not None and bool(rival[i].isfinite()):
            return f"few images, which a focal length of {rival[i]:.0f} px explains nearly as well"
        if flat:
            return "the images seem to be cropped, and most pairs of them show little besides one plane"
        if not DEVIATIONS * rotation[i] < WRONG_ANGLE:
            return f"its rotation is known to {rotation[i]:.1f} degrees only"
        if not DEVIATIONS * degrees[i] < WRONG_ANGLE:
            return f"its place is known to {100 * position[i]:.1f} % of its distance from the points only"
        return ""

    asked = (mapping.registered if judged is None else mapping.registered & judged).tolist()
    doubts = [doubt(i) if ask else "" for i, ask in enumerate(asked)]
    if 2 * sum(map(bool, doubts)) > count:
        # Which images are right is then not known: the others agree with too few.
        few = "most images of its model are doubtful"
        doubts = [known or few if ask else "" for known, ask in zip(doubts, asked, strict=True)]
    return Standing(rotation, position, tuple(doubts), intrinsics, excess)


def pose_deviations(
    mapping: Mapping, open_numbers: Sequence[str], prior: CameraPrior, weights: Float[Tensor, "m"] | None = None
) -> tuple[Float[Tensor, "v"], Float[Tensor, "v"], Float[Tensor, "g k k"]]:
    """Standard deviations of rotations (degrees) and of places (over the median depth), and intrinsics, as in `Standing`."""
    problem = mapping.problem()
    # A number that was held where it was expected is as uncertain as it was expected to be.
    uncertain = {name: torch.ones(len(mapping.cameras.K), dtype=torch.bool) for name in open_numbers}
    covariance = bundle_covariance(
        problem,
        weights=weights,
        loss=LOSS,
        sigma=measure_noise(mapping, LOSS, weights),
        points=False,
        joint=False,
        **about_cameras(mapping, uncertain, prior, weights),
    )
    view, depth = problem.view, problem.depths()
    seen = torch.bincount(view, minlength=len(mapping.registered))
    # The depths of each image in ascending order, those of one image together: the middle one of each.
    order = torch.argsort(depth, stable=True)
    order = order[torch.argsort(view[order], stable=True)]
    middle = (seen.cumsum(0) - seen + seen // 2).clamp(max=max(len(depth) - 1, 0))
    median = depth[order][middle] if len(depth) else depth.new_ones(len(seen))
    known = mapping.registered & (seen > 0)
    variance = covariance.poses.diagonal(dim1=-2, dim2=-1)
    rotation, position = variance[:, :3].sum(-1).sqrt().rad2deg(), variance[:, 3:].sum(-1).sqrt() / median
    return torch.where(known, rotation, torch.inf), torch.where(known, position, torch.inf), covariance.cameras
