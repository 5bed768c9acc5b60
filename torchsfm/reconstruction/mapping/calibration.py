"""What the images of a model say of its cameras: which numbers they determine, how well, and in plain words.

A camera is a row of numbers: focal length, principal point, distortion. Each has a Gaussian prior, which stands for all cameras
ever made (`CameraPrior`); the images add what they know, with the poses and points eliminated.
"""

from collections.abc import Mapping as Dict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.bundle import intrinsics_covariance, match_weights, track_weights
from torchsfm.bundle.intrinsics import free_columns
from torchsfm.geometry import Distortion
from torchsfm.geometry.intrinsic_parameters import camera_from_row, intrinsic_labels, row_from_camera
from torchsfm.optim import Cauchy, loss_slope
from torchsfm.reconstruction.mapping.camera_prior import CameraPrior
from torchsfm.reconstruction.mapping.mapping import Adjustment, Mapping

LEAST_NOISE = 0.05
"""Image points are never better than this, in pixels."""
FEW = 6
"""Models of so few images are made from several starts, and are judged by fewer observations."""
ENOUGH, ENOUGH_OF_FEW, NEARLY_NONE = 100, 30, 0.01
"""Observations of long tracks that determine an image by themselves, and by which few images are judged, as little else
contradicts what is wrong there; what tracks of two views count beside so many."""
MIN_IMAGES = 3
"""Two images leave the cameras as they were expected."""
FAULTS = 3.0
"""Variance of the principal point that a photograph's own faults make it show, in units of that of the prior."""
HARDLY = 0.03
"""A focal length less certain than this fraction is hardly determined."""
RESTS = 0.7
"""Where the images leave this much of the uncertainty it had before, a number rests on its prior: they know less of it."""

Free = Dict[str, Bool[Tensor, "g"]]
"""By the names that `bundle_adjust` knows, the cameras in which a number is estimated."""


@dataclass(frozen=True)
class Calibration:
    """How the cameras of a model were found.

    Attributes:
        status: Of the last adjustment: `OK` where it reached the minimum, `NOT_CONVERGED` where its limit of steps came first.
        iterations: Steps of that adjustment.
        noise: Standard deviation of an image coordinate in pixels, as the robust cost counts it.
        names: The numbers of a camera: "focal", "aspect" where pixels were found not to be square, "cx", "cy" and the
            distortion parameters.
        values: The numbers of each camera, pixels for focal length and principal point.
        estimated: Which of them were estimated; the others were held where they were expected or given.
        deviation: Their standard deviations, as large as what matches of a pair have in common makes them (`excess_scatter`);
            zero where they were given.
        prior: Their standard deviations before any image point was seen; zero where they were given.
        cropped: Whether the images were found to be cut out of larger ones, so that principal points lie anywhere.
        alike: Whether they were found to be of one camera then, and have its focal length and distortion in common.
        strained: Whether a polynomial was prescribed for a lens that bends the corners of images strongly.
    """

    status: Status
    iterations: int
    noise: float
    names: tuple[str, ...]
    values: Float[Tensor, "g k"]
    estimated: Bool[Tensor, "g k"]
    deviation: Float[Tensor, "g k"]
    prior: Float[Tensor, "g k"]
    cropped: bool = False
    alike: bool = False
    strained: bool = False

    @property
    def remark(self) -> str:
        """What is unusual about the cameras, in plain words; empty where nothing is."""
        remarks = []
        if "aspect" in self.names:
            place = self.names.index("aspect")
            (seen,) = self.estimated[:, place].nonzero(as_tuple=True)
            aspect = self.values[seen if len(seen) else slice(None), place]
            kinds = [kind for kind in (aspect[aspect > 1], aspect[aspect < 1]) if len(kind)]
            stretched = [f"{float(kind.median()):.3f} times as much along y as along x" for kind in kinds]
            remarks += [f"the images seem to be stretched, {', others '.join(stretched)}"] if stretched else []
        if self.cropped:
            whose = "all of one camera, whose focal length they share" if self.alike else "of several cameras"
            text = f"the images seem to be cropped, {whose}: their principal points were looked for far from the middle, too"
            remarks.append(text)
        if self.strained:
            remarks.append("the lens bends the corners of the images strongly: if it is a fisheye, prescribe that")
        return "; ".join(remarks)

    def camera_doubts(self, camera: int) -> list[str]:
        """What should not be trusted in a camera, in plain words."""
        f, sigma, before = (float(t[camera, 0]) for t in (self.values, self.deviation, self.prior))
        if sigma > RESTS * before > 0:
            return [f"the focal length rests on its first guess, the images hardly determine it (+- {100 * sigma / f:.0f} %)"]
        return [f"the focal length is hardly determined (+- {100 * sigma / f:.0f} %)"] if sigma > HARDLY * f else []

    def doubts(self) -> list[str]:
        """What should not be trusted in the model's cameras, in plain words."""
        words = [] if self.status == Status.OK else [f"the last adjustment did not converge in {self.iterations} steps"]
        return words + [f"camera {k}: {text}" for k in range(len(self.values)) for text in self.camera_doubts(k)]


def calibration_of(
    mapping: Mapping,
    prior: CameraPrior,
    *,
    loss: Cauchy,
    weights: Float[Tensor, "m"] | None = None,
    covariance: tuple[Sequence[str], Float[Tensor, "g k k"]] | None = None,
    excess: float = 1.0,
) -> Calibration:
    """How the cameras of an adjusted mapping were found.

    Args:
        mapping: The finished model.
        prior: What was expected of the cameras.
        loss: The loss of the adjustment.
        weights: What the observations counted in it.
        covariance: Numbers of cameras, and their covariance by the noise of the image points, where that is known.
        excess: By how much more the images' points scatter together than by their own noise, as a ratio of variances.
    """
    labels = intrinsic_labels(type(mapping.cameras.distortion))
    adjusted = mapping.adjustment or Adjustment(Status.OK, 0, {})
    names = tuple(name for name in labels if name not in {"aspect", "skew"} - set(adjusted.free))
    values = row_from_camera(mapping.cameras)[:, [labels.index(name) for name in names]]
    deviation, before, estimated = (
        torch.zeros_like(values),
        torch.zeros_like(values),
        torch.zeros_like(values, dtype=torch.bool),
    )
    noise = measure_noise(mapping, loss, weights)
    if adjusted.free:
        given = covariance[1] if covariance is not None and set(covariance[0]) == set(adjusted.free) else None
        known = _information(mapping, tuple(adjusted.free), prior, loss, given, weights, excess)
        chosen = torch.zeros(known.prior.shape, dtype=torch.bool)
        for name, mask in adjusted.free.items():
            chosen[:, known.places(name)] = mask[:, None]
        variance = known.covariance(chosen, open_ended=True).diagonal(dim1=-2, dim2=-1)
        places = [names.index(labels[column]) for column in known.columns]
        before[:, places], estimated[:, places] = known.prior.sqrt(), chosen
        deviation[:, places] = torch.where(chosen, variance, known.prior).sqrt().nan_to_num(torch.inf, torch.inf)
    found = Calibration(adjusted.status, adjusted.iterations, noise, names, values, estimated, deviation, before)
    return replace(found, cropped=prior.cropped, alike=prior.alike)


def observation_weights(mapping: Mapping, loss: Cauchy, *, enough: int | None = None) -> Float[Tensor, "m"]:
    """What the observations of a finished model count, in their order: less where the track as a whole fits badly.

    Tracks of two views count by how likely they are right. Wrong ones hide in cameras that had to fit them: if it is said how
    many observations of longer tracks are `enough`, those of cameras that have so many count next to nothing.
    """
    problem = mapping.problem()
    weights = track_weights(problem, loss=loss, least_noise=LEAST_NOISE)
    if enough is None:
        return weights * match_weights(problem, least_noise=LEAST_NOISE)
    length = torch.bincount(problem.point, minlength=len(problem.X))
    long = torch.bincount(problem.view[length[problem.point] > 2], minlength=len(problem.poses.R))
    need = (1 - long.to(weights.dtype) / enough).clamp(min=NEARLY_NONE)[problem.view]
    need = need.new_zeros(len(problem.X)).scatter_reduce(0, problem.point, need, "amax")
    return weights * torch.where(length == 2, need, 1.0)[problem.point]


def measure_noise(mapping: Mapping, loss: Cauchy, weights: Float[Tensor, "m"] | None = None) -> float:
    """The standard deviation of an image coordinate for which weighted least squares would be as certain as the robust cost is.

    Huber's proposal for M-estimators: the mean square of the weighted residuals over the square of their mean derivative, times
    the mean weight, since covariances are computed with weighted normal equations (Huber 1981, 7.6). Where observations have
    weights, it is that of one which counts in full.
    """
    node = mapping.observations()
    if not len(node):
        return LEAST_NOISE
    x, _ = mapping.project(mapping.point[node], mapping.graph.view[node])
    # Fitted residuals are smaller than errors are, by the share of the unknowns that follow them: most in short tracks.
    length = torch.bincount(mapping.point[node], minlength=len(mapping.X))[mapping.point[node]]
    follow = 1 - 3 * int(mapping.registered.sum()) / len(node)
    redundancy = (1 - 1.5 / length.to(x.dtype)) * max(follow, 0.1)
    fitted = (x - mapping.graph.x[node]).square().sum(-1)
    s = (fitted / redundancy).detach().requires_grad_()
    with torch.enable_grad():
        slope = loss.slope(s)
        (bend,) = torch.autograd.grad(slope.sum(), s)
    s, slope, weights = s.detach(), slope.detach(), torch.ones_like(fitted) if weights is None else weights
    square = (weights.square() * slope.square() * s).mean() / 2
    curvature = (weights * (slope + bend * s)).mean().clamp_min(1e-6)
    return max(float((square * (weights * loss_slope(loss, fitted)).mean()).sqrt() / curvature), LEAST_NOISE)


def cameras_free(free: Free) -> dict[str, Any]:
    """What is free, in the words of `bundle_adjust`."""
    some = {name: mask for name, mask in free.items() if bool(mask.any())}
    held = {name: ~mask for name, mask in some.items() if not bool(mask.all())}
    return {"free": tuple(some), "fixed_intrinsics": held or None}


@dataclass(frozen=True)
class _Information:
    """What images and priors together say of each camera's numbers, poses, points and other cameras eliminated."""

    names: tuple[str, ...]
    columns: tuple[int, ...]
    model: type[Distortion]
    matrix: Float[Tensor, "g k k"]
    prior: Float[Tensor, "g k"]
    """Variances before any image point was seen."""

    def places(self, name: str) -> list[int]:
        """Where the numbers of a name stand."""
        return [self.columns.index(column) for column in free_columns((name,), self.model)]

    def covariance(self, chosen: Bool[Tensor, "g k"], *, open_ended: bool) -> Float[Tensor, "g k k"]:
        """The covariance of the numbers chosen, the others held; `open_ended` counts what the held ones may really be."""
        eye = torch.eye(len(self.columns), dtype=self.matrix.dtype)
        both = chosen[:, :, None] & chosen[:, None]
        noise = torch.where(both, torch.linalg.inv_ex(torch.where(both, self.matrix, eye))[0], 0.0)
        if not open_ended:
            return noise
        lean = noise @ torch.where(chosen[:, :, None] & ~chosen[:, None], self.matrix, 0.0)
        return noise + (lean * self.prior[:, None]) @ lean.mT


def _information(
    mapping: Mapping,
    names: Sequence[str],
    prior: CameraPrior,
    loss: Cauchy,
    covariance: Float[Tensor, "g k k"] | None = None,
    weights: Float[Tensor, "m"] | None = None,
    excess: float = 1.0,
) -> _Information:
    used = images_of_cameras(mapping) > 0
    model = type(mapping.cameras.distortion)
    columns = free_columns(names, model)
    if covariance is None:
        noise = measure_noise(mapping, loss, weights)
        covariance = noise**2 * intrinsics_covariance(
            mapping.problem(),
            free=names,
            weights=weights,
            loss=loss,
            **prior.terms(noise, names, used),
        )
    before = torch.zeros(len(used), len(columns), dtype=covariance.dtype)
    for name in names:
        scale = prior.mean.K[:, 0, 0] if name == "focal" else 1.0
        for column in free_columns((name,), model):
            before[:, columns.index(column)] = (prior.sigma[name] * scale).square()
    matrix = torch.linalg.inv_ex(torch.where(used[:, None, None], covariance, torch.diag_embed(before)))[0]
    # Errors in common are the images' alone: what was known before is not known less.
    known = torch.diag_embed(before.reciprocal())
    matrix = known + (matrix - known) / excess
    return _Information(tuple(names), columns, model, matrix, before)


def choose_free(
    mapping: Mapping, names: Sequence[str], prior: CameraPrior, *, loss: Cauchy, faultless: int = 0
) -> dict[str, Bool[Tensor, "g"]]:
    """Decide which numbers of which cameras to estimate, by the error to be expected of each.

    A number that is held is off by what cameras differ, its prior's width; estimated, by what the noise of the image points
    makes of it, and a principal point also by what each photograph's own faults (wrong matches, a bent structure) make it look
    like, which only other photographs of the same camera average out. The smaller of the two decides, for one number after
    the other: the ratio of focal lengths where pixels are not square, distortion from the lowest order up, then the principal
    point, each given those chosen before. The focal length is always estimated.

    Args:
        mapping: The model so far.
        names: Numbers that may be estimated.
        prior: What is expected of the cameras.
        loss: The loss of the adjustment.
        faultless: Cameras that took up to so many photographs are taken to be without such faults.
    """
    images = images_of_cameras(mapping)
    taken = prior.sum_of_body(images)
    order = ("focal", "aspect", *mapping.cameras.distortion.parameter_names, "principal_point")
    candidates = [name for name in order if name in names]
    if not candidates:
        return {}
    if int(mapping.registered.sum()) < MIN_IMAGES:
        return {name: torch.zeros_like(images, dtype=torch.bool) for name in candidates}
    known = _information(mapping, candidates, prior, loss)
    chosen = torch.zeros(known.prior.shape, dtype=torch.bool)
    free: dict[str, Tensor] = {}
    for name in candidates:
        own = known.places(name)
        trial = chosen.clone()
        trial[:, own] = True
        variance = known.covariance(trial, open_ended=False).diagonal(dim1=-2, dim2=-1)[:, own].amax(-1)
        before = known.prior[:, own].amax(-1)
        # The prior is counted in the variance; without it, the noise alone is left.
        noise = 1 / (1 / variance - 1 / before).clamp_min(1e-12 / before)
        sensor = name == "principal_point"
        faults = torch.where(sensor & (taken > faultless), FAULTS * before / taken.clamp(min=1), 0.0)
        free[name] = (images > 0) & ((noise + faults < before) | (name == "focal"))
        if sensor:
            # Those of one body are tied: one that is held would hold the others.
            free[name] = (images > 0) & (prior.sum_of_body(free[name].long()) > 0)
        chosen[:, own] |= free[name][:, None]
    return free


def as_expected(mapping: Mapping, free: Free, prior: CameraPrior) -> Mapping:
    """The mapping with those numbers of its cameras that could be free, and are not, back where they were expected."""
    model = type(mapping.cameras.distortion)
    rows, mean = row_from_camera(mapping.cameras), row_from_camera(prior.mean)
    for name, mask in free.items():
        for column in free_columns((name,), model):
            rows[:, column] = torch.where(mask, rows[:, column], mean[:, column])
    return replace(mapping, cameras=camera_from_row(rows, model))


def images_of_cameras(mapping: Mapping) -> Int[Tensor, "g"]:
    """How many registered images each camera took."""
    return torch.bincount(mapping.camera_index[mapping.registered], minlength=len(mapping.cameras.K))


def lone_cameras_plausible(mapping: Mapping, prior: CameraPrior) -> bool:
    """Whether the principal points of cameras that took one photograph each lie as principal points do.

    A single photograph has nothing to be held against: wrong matches and a bent structure move its principal point as well.
    Where they do, the points found scatter wider than those of cameras: beyond three standard deviations of the mean square.
    """
    shift = (mapping.cameras.K - prior.mean.K)[:, :2, 2] / prior.sigma["principal_point"][:, None]
    shift = shift[(prior.sum_of_body(images_of_cameras(mapping)) == 1) & (shift != 0).any(-1)]
    count = shift.numel()
    return count == 0 or float(shift.square().mean()) < 1 + 3 * (2 / count) ** 0.5


def folded_cameras(mapping: Mapping) -> Bool[Tensor, "g"]:
    """Cameras whose distortion does not grow outwards all over the image of theirs: no lens does that."""
    size = mapping.graph.image_size.to(mapping.X.dtype) - 0.5
    low = torch.full_like(size[:, 0], -0.5)
    x = torch.stack([torch.stack((u, v), -1) for u in (low, size[:, 0]) for v in (low, size[:, 1])], -2)
    folds = ~mapping.cameras[mapping.camera_index].unproject(x)[1].all(-1) & mapping.registered
    return torch.bincount(mapping.camera_index[folds], minlength=len(mapping.cameras.K)) > 0
