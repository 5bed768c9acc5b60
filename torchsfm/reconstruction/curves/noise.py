"""What edge points are worth: how far they are from the curves that they show, and how many along a curve are so alike."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm.bundle.track_weights import student_weights
from torchsfm.optim import GemanMcClure
from torchsfm.reconstruction.model.curves import Curves
from torchsfm.reconstruction.model.similarities import DEVIATION

LEAST_SCALE = 0.2
"""Distances smaller than this part of what edges' own variances say are no reason to weigh them more."""
LAGS = 64
"""Samples along a curve, the most, whose distances from edges may still be alike."""
ALIKE = 0.05
"""Correlation, the least, that is told from none."""
FINEST = 0.05
"""Least standard deviation of distances that is believed, in pixels."""
TRUSTED = 3.0
"""Standard deviations of a distance beyond which edges show something else: outlines of surfaces, highlights."""
_MOTIONS = 4
"""Ways in which the image of a curve is moved together: along both axes, turned, and larger or smaller."""
_ABSORBED = 0.9
"""What cameras take of these motions themselves, the most that is counted."""
_DOF = 4.0
"""Degrees of freedom of the distribution of all distances of a sample: the fewer, the faster weights of samples fall."""


def usual_distance(apart: Float[Tensor, "k"]) -> float:
    """The standard deviation of most distances, pixels."""
    known = apart[apart.isfinite()].abs()
    return max(FINEST, DEVIATION * float(known.median())) if len(known) else FINEST


def edge_loss(apart: Float[Tensor, "k"]) -> GemanMcClure:
    """Lets go of edges much farther away than most."""
    return GemanMcClure(TRUSTED * usual_distance(apart))


def weights_in_a_bundle(curves: Curves, apart: Float[Tensor, "k"], *, beside_points: bool = False) -> Curves:
    """The curves with edge points weighed by what is measured, and less where a sample fits badly as a whole.

    Arguments are those of `measured_weights`.
    """
    weighed = measured_weights(curves, apart, beside_points=beside_points)
    return replace(weighed, weight=weighed.weight * sample_weights(curves, apart))


def measured_weights(curves: Curves, apart: Float[Tensor, "k"], *, beside_points: bool = False) -> Curves:
    """The curves with edge points weighed so that they count as if each were independent of the others.

    Their own variances, scaled so that distances from them are as large as these say (of robust mean size: one distance an edge
    point, less the two numbers of each sample), and times how many along a curve are alike: what is wrong with an edge, its
    shadow or round corner, is wrong with a long piece of it.

    Args:
        curves: The curves.
        apart: Signed distances of samples from each edge point.
        beside_points: Count as alike what moves the image of a curve (`moved_alike`) instead of all that goes on along it
            (`alike`): where points hold the cameras, and edges only say where these turn.
    """
    sound = apart.isfinite()
    if not sound.any():
        return curves
    r, view, sample = (t[sound] for t in (apart * curves.weight.sqrt(), curves.view, curves.sample))
    redundancy = max(0.1, 1 - 2 * len(torch.unique(sample)) / len(r))
    scale = max(float(r.abs().median()) / 0.6745 / redundancy**0.5, LEAST_SCALE)
    number = moved_alike(curves, apart) if beside_points else alike(r, view, sample, curves.curve)
    return replace(curves, weight=curves.weight / (scale**2 * number))


def sample_weights(curves: Curves, apart: Float[Tensor, "k"]) -> Float[Tensor, "k"]:
    """How much the edge points of each sample count, by how well all of them fit one place: factors of their weights.

    Outlines of what is smooth, and highlights, move over the scene as the camera does. From a frame to the next they hardly do,
    so that most of their edges are as near to a sample as others are, and no loss of single distances tells; what tells is all
    of a sample, over many frames. With Student's distribution of all its distances at once, a sample of m edge points, of which
    d = m - 2 are left over, with the sum S of squared distances weighs (dof + d) / (dof + S / s^2), at most 1, as a track of
    points does (`track_weights`). The noise s is that of the sample in the middle, counted by edge points left over.

    Args:
        curves: The curves.
        apart: Signed distances of samples from each edge point, also of those much farther away than most.
    """
    sound = apart.isfinite()
    r = torch.where(sound, apart * curves.weight.sqrt(), 0.0)
    zero = r.new_zeros(len(curves.X))
    number = zero.index_add(0, curves.sample, sound.to(r.dtype))
    total = zero.index_add(0, curves.sample, r.square())
    left = (number - 2).clamp(min=0)
    weights = student_weights(total, left.clamp(min=1), left, _DOF, LEAST_SCALE)
    return torch.where(left > 0, weights, 1.0)[curves.sample]


def alike(r: Float[Tensor, "k"], view: Int[Tensor, "k"], sample: Int[Tensor, "k"], curve: Int[Tensor, "n"]) -> float:
    """How many neighbours along curves have distances from edges that say together what one would: at least 1.

    The sum of the correlations of distances in one image, as normal numbers have them whose signs agree as often, up to the
    first that is none.

    Args:
        r: Distances.
        view: Image of each.
        sample: Sample of each, no two the same in one image.
        curve: Curve of each sample.
    """
    size = len(curve)
    key, order = (view * size + sample).sort()
    sign, own, total = r[order].sign(), sample[order], 1.0
    for lag in range(1, LAGS + 1):
        place = torch.searchsorted(key, key + lag).clamp(max=len(key) - 1)
        after = (own + lag).clamp(max=size - 1)
        both = (key[place] == key + lag) & (own + lag < size) & (curve[after] == curve[own])
        if not both.any():
            break
        correlation = math.sin(math.pi / 2 * float((sign * sign[place])[both].mean()))
        if correlation < ALIKE:
            break
        total += 2 * correlation
    return total


def moved_alike(curves: Curves, apart: Float[Tensor, "k"]) -> float:
    """How many edges of a curve say together where its image belongs, as if they were one: at least 1.

    What is wrong with an edge is wrong with a long piece of it, but which way it pulls an image changes as the curve bends, and
    most of it cancels. So it is measured how far the edges of each curve in each image want that image to be moved, along both
    axes, turned and scaled, over what independent ones would: the scatter of least squares by clusters (Liang & Zeger 1986).
    Cameras are such motions, and have taken what is common to the curves of an image; edges much farther away than most count
    for nothing, as in the adjustment.

    Args:
        curves: The curves.
        apart: Signed distances of samples from each edge point.
    """
    r = apart * curves.weight.sqrt()
    r = torch.where(r.isfinite(), r, torch.inf)
    known = r.abs() < TRUSTED * DEVIATION * r.abs().median()
    if not known.any():
        return 1.0
    r, x, normal, view = r[known], curves.x[known].double(), curves.normal[known].double(), curves.view[known]
    _, of = torch.unique(torch.stack((curves.curve[curves.sample[known]], view)), dim=1, return_inverse=True)
    number = torch.bincount(of).double()

    def mean(values: Tensor) -> Tensor:
        total = values.new_zeros(len(number), *values.shape[1:]).index_add(0, of, values)
        return total / number.view(-1, *[1] * (values.ndim - 1))

    away = x - mean(x)[of]
    away = away / mean(away.square().sum(-1)).sqrt().clamp_min(1.0)[of, None]
    turn = normal[:, 1] * away[:, 0] - normal[:, 0] * away[:, 1]
    slopes = torch.stack((*normal.T, turn, (normal * away).sum(-1)), -1)
    pull = slopes.new_zeros(len(number), _MOTIONS).index_add(0, of, slopes * r[:, None])
    curved = float(number.sum() ** 2 / number.square().sum())
    absorbed = min(6 * len(torch.unique(view)) / (_MOTIONS * curved), _ABSORBED)
    independent = float(slopes.square().sum() * r.square().mean()) * (1 - absorbed)
    return max(float(pull.square().sum()) / max(independent, 1e-300), 1.0)
