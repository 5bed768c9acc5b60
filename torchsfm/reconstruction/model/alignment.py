"""Into another world frame: that of another model, of camera positions (GPS), or of points that were measured."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status, check_one_problem
from torchsfm.geometry import Similarity
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.evaluation import align_poses
from torchsfm.reconstruction.model.reconstruction import Reconstruction
from torchsfm.reconstruction.model.similarities import (
    DEVIATION,
    MOST_SCALE,
    MOST_TURN,
    OUTLYING,
    Certainty,
    certainty,
    robust_similarity,
)
from torchsfm.triangulation import triangulate_points


@dataclass(frozen=True)
class Alignment:
    """A similarity from the model's world to another, and how well it fits.

    Attributes:
        similarity: With its status: `TOO_FEW` or `DEGENERATE` where what is common does not determine it.
        names: The images or points that both have.
        distance: How far each is from its place after the similarity, in the other world's unit.
        used: Those that agree; the others are outliers, which the similarity leaves aside.
        apart: The same as vectors, along the axes of the other world.
        known: How well places that were measured with errors determine the similarity; None where the poses are compared.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(8, 20, 100, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> measured = 10 * model.poses.centre + 0.01 * torch.randn(8, 3, generator=g)  # metres
        >>> measured[3] += 1000
        >>> found = torchsfm.reconstruction.align_to_positions(model, model.names, measured)
        >>> found.used.tolist().index(False), bool(found.distance[found.used].max() < 0.1)
        (3, True)
        >>> metric = model.transform(found.similarity)
        >>> bool((metric.poses.centre - measured)[found.used].norm(dim=-1).max() < 0.1)
        True
    """

    similarity: Similarity
    names: tuple[str, ...]
    distance: Float[Tensor, "n"]
    used: Bool[Tensor, "n"]
    apart: Float[Tensor, "n 3"] | None = None
    known: Certainty | None = None

    def summary(self, what: str) -> str:
        """One line for people."""
        rms = float(self.distance[self.used].square().mean().sqrt())
        agree = f"{int(self.used.sum())} of {len(self.names)} {what} agree"
        text = f"{agree}, {rms:.4g} apart (RMS)"
        if self.apart is not None:
            along, height = (self.apart[self.used][:, axes].square().sum(-1).mean().sqrt() for axes in (slice(2), slice(2, 3)))
            text += f", {float(along):.4g} along the ground and {float(height):.4g} in height"
        text += f", scale {float(self.similarity.scale):.6g}"
        return text if self.known is None else f"{text}, known to {100 * self.known.scale:.2g} %"

    def fault(self) -> str:
        """Why there is no similarity; empty where there is one."""
        match self.similarity.status:
            case None | Status.OK:
                return self._doubt()
            case Status.TOO_FEW:
                return f"only {len(self.names)} in common, which is too few"
            case _:
                return f"the {len(self.names)} in common are at one place or on one line"

    def _doubt(self) -> str:
        """Why a similarity that fits best is not good enough all the same."""
        if self.known is None or (self.known.turn <= MOST_TURN and self.known.scale <= MOST_SCALE):
            return ""
        off = f"the {len(self.names)} positions are {self.known.sigma:.3g} off"
        if self.known.scale > MOST_SCALE:
            return f"{off}, too far to tell the scale: they contradict the model, or are too near each other"
        return f"{off} and nearly on one line, about which the turn is open by {math.degrees(self.known.turn):.2g} degrees"


@on_the_cpu
def align_models(model: Reconstruction, other: Reconstruction) -> Alignment:
    """The similarity that carries the cameras of a model onto those that another has of the same images.

    Rotation, scale and place are each the one that most images agree on (medians), so that up to half of the images may be
    misplaced in one of the models; then the least squares over the camera centres that agree. Two images are enough, and
    centres on one line, too, as the rotations of the cameras tell the turn about it.

    Args:
        model: The model.
        other: The other one; images are the same that have the same name.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(4, 20, 60, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> double = torchsfm.Similarity(torch.tensor(2.0).double(), torch.eye(3).double(), torch.ones(3).double())
        >>> found = torchsfm.reconstruction.align_models(model, model.transform(double))
        >>> round(float(found.similarity.scale), 6), found.fault()
        (2.0, '')
    """
    places = {name: i for i, name in enumerate(other.names) if bool(other.registered[i])}
    common = [(i, places[name]) for i, name in enumerate(model.names) if bool(model.registered[i]) and name in places]
    names = tuple(model.names[i] for i, _ in common)
    mine, theirs = (torch.tensor([pair[k] for pair in common], dtype=torch.long) for k in range(2))
    a, b = model.to("cpu", torch.float64).poses[mine], other.to("cpu", torch.float64).poses[theirs]
    if len(common) < 2:
        return _nothing(names, Status.TOO_FEW)
    turns = b.R.mT @ a.R
    # The angle between two of them grows with the distance of the matrices.
    gaps = (turns[:, None] - turns).flatten(-2).norm(dim=-1)
    R = turns[gaps.median(dim=-1).values.argmin()]
    far, wide = (torch.cdist(c, c, compute_mode="donot_use_mm_for_euclid_dist") for c in (a.centre, b.centre))
    # Of each image the median over the others, then the median over images: right while half of them are.
    ratio = torch.where((far > 0) & (wide > 0), wide / torch.where(far > 0, far, 1.0), torch.nan)
    scale = ratio.nanmedian(dim=-1).values.nanmedian()
    if not bool(scale.isfinite()):
        return _nothing(names, Status.DEGENERATE)
    t = (b.centre - scale * (a.centre @ R.mT)).median(dim=0).values
    distance = (scale * (a.centre @ R.mT) + t - b.centre).norm(dim=-1)
    # Exact models differ by rounding.
    used = distance <= OUTLYING * DEVIATION * distance.median() + 1e-9 * wide.max()
    fine = align_poses(a, b, used)
    distance = (fine.transform(a.centre) - b.centre).norm(dim=-1)
    return Alignment(fine, names, distance, used)


@on_the_cpu
def align_to_positions(
    model: Reconstruction,
    names: Sequence[str],
    positions: Float[Tensor, "k 3"],
    *,
    generator: torch.Generator | None = None,
) -> Alignment:
    """The similarity that carries the camera centres of a model onto positions that were measured: GPS, a survey, a tracker.

    Up to two fifths of seven positions or more may be wrong; the similarity is that of the least squared distances over those
    that agree. Three positions not on a line are the least. Where they determine the scale to no better than a tenth, or leave
    the turn about their line open, for as far off as they are, `fault` says so.

    Args:
        model: The model, of which images without a pose do not count.
        names: Images of which the position is known; those that the model does not have are passed over.
        positions: Where their cameras were, in a frame in metres, say: see `enu_from_geodetic` for latitude and longitude.
        generator: Source of the samples that are tried; the same ones each time if not given.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(8, 20, 100, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> measured = 10 * model.poses.centre + 1
        >>> measured[3] += 1000
        >>> found = torchsfm.reconstruction.align_to_positions(model, model.names, measured)
        >>> round(float(found.similarity.scale), 6), found.used.tolist().index(False), found.fault()
        (10.0, 3, '')
    """
    check_one_problem(positions=(positions, "k 3"))
    if len(names) != len(positions):
        raise ValueError(f"names: wanted {len(positions)}, one for each position, got {len(names)}")
    model = model.to("cpu", torch.float64)
    place = {name: i for i, name in enumerate(model.names) if bool(model.registered[i])}
    finite = positions.isfinite().all(-1).tolist()
    rows = [k for k, name in enumerate(names) if name in place and finite[k]]
    both = tuple(names[k] for k in rows)
    if len(both) < 3:
        return _nothing(both, Status.TOO_FEW)
    X = model.poses.centre[[place[name] for name in both]]
    Y = positions.detach().to("cpu", torch.float64)[rows]
    return _fit(both, X, Y, generator)


@dataclass(frozen=True)
class ControlPoints:
    """Points whose places were measured, and where images show them.

    Attributes:
        names: Names of the points.
        X: Their places.
        images: Name of the image of each observation.
        x: Where it is, pixels.
        point: Which point it shows.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.reconstruction import ControlPoints, align_to_points
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(6, 60, 250, noise=0.0, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> row = (model.point < 4).nonzero()[:, 0]  # where images show the first four points
        >>> images = tuple(model.names[i] for i in model.view[row].tolist())
        >>> known = ControlPoints(("door", "gable", "lamp", "step"), 3 * model.X[:4], images, model.x[row], model.point[row])
        >>> found = align_to_points(model, known)
        >>> found.names, found.similarity.scale
        (('door', 'gable', 'lamp', 'step'), tensor(3.0000, dtype=torch.float64))
    """

    names: tuple[str, ...]
    X: Float[Tensor, "n 3"]
    images: tuple[str, ...]
    x: Float[Tensor, "m 2"]
    point: Int[Tensor, "m"]


@on_the_cpu
def align_to_points(model: Reconstruction, control: ControlPoints) -> Alignment:
    """The similarity that carries a model to where points of it were measured to be.

    The points are triangulated from the images that show them, two or more each, and the similarity is that of the least sum of
    squared distances. It takes three points that are not on one line; all are used, as they were measured on purpose.

    Args:
        model: The model; observations in images without a pose do not count.
        control: The measured points.

    `adjust_to_points` also bends the model to them.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.reconstruction import ControlPoints, align_to_points
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(6, 60, 250, noise=0.0, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> row = (model.point < 6).nonzero()[:, 0]
        >>> images = tuple(model.names[i] for i in model.view[row].tolist())
        >>> known = ControlPoints(tuple("abcdef"), 3 * model.X[:6], images, model.x[row], model.point[row])
        >>> found = align_to_points(model, known)
        >>> found.fault(), found.similarity.scale
        ('', tensor(3.0000, dtype=torch.float64))
    """
    model = model.to("cpu", torch.float64)
    place = {name: i for i, name in enumerate(model.names) if bool(model.registered[i])}
    view = torch.tensor([place.get(name, -1) for name in control.images], dtype=torch.long)
    known = view >= 0
    view, point = view[known], control.point[known]
    x = control.x.double()[known, None]
    d, valid = model.cameras[model.camera_index[view]].unproject(x)
    valid = valid[:, 0] & (d[:, 0, 2] > 0)
    flat = model.X.new_zeros(len(model.names), len(control.names), 2)
    visible = torch.zeros(flat.shape[:-1], dtype=torch.bool)
    flat[view[valid], point[valid]] = d[valid, 0, :2] / d[valid, 0, 2:]
    visible[view[valid], point[valid]] = True
    seen = visible.sum(0) >= 2
    names = tuple(name for name, good in zip(control.names, seen.tolist(), strict=True) if good)
    if len(names) < 3:
        return _nothing(names, Status.TOO_FEW)
    found = triangulate_points(flat[:, seen], model.poses.matrix(), visible=visible[:, seen]).model
    return _fit(names, found, control.X.to("cpu", torch.float64)[seen], None)


def _fit(
    names: tuple[str, ...], X: Float[Tensor, "n 3"], Y: Float[Tensor, "n 3"], generator: torch.Generator | None
) -> Alignment:
    """The similarity from places of the model to measured ones."""
    similarity, used = robust_similarity(X, Y, generator)
    apart = similarity.transform(X) - Y
    used = used & (similarity.status == Status.OK)
    return Alignment(similarity, names, apart.norm(dim=-1), used, apart, certainty(similarity, X, Y, used))


def _nothing(names: tuple[str, ...], status: Status) -> Alignment:
    """No similarity."""
    one, eye = torch.ones((), dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    same = Similarity(one, eye, torch.zeros(3, dtype=torch.float64), torch.tensor(int(status), dtype=torch.int8))
    return Alignment(same, names, torch.zeros(len(names), dtype=torch.float64), torch.zeros(len(names), dtype=torch.bool))
