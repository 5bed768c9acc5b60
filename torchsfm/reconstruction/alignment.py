"""Into another world frame: that of another model, or of points that were measured."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import Similarity, similarity_from_points
from torchsfm.reconstruction.evaluation import align_poses
from torchsfm.reconstruction.reconstruction import Reconstruction
from torchsfm.triangulation import triangulate_points

OUTLYING = 4.0
"""Robust standard deviations beyond which a pair of positions does not count."""
DEVIATION = 1.4826
"""A normal distribution's standard deviation over its median absolute value."""


@dataclass(frozen=True)
class Alignment:
    """A similarity from the model's world to another, and how well it fits.

    Attributes:
        similarity: With its status: `TOO_FEW` or `DEGENERATE` where what is common does not determine it.
        names: The images or points that both have.
        distance: How far each is from its place after the similarity, in the other world's unit.
        used: Those that agree; the others are outliers, which the similarity leaves aside.
    """

    similarity: Similarity
    names: tuple[str, ...]
    distance: Float[Tensor, "n"]
    used: Bool[Tensor, "n"]

    def summary(self, what: str) -> str:
        """One line for people."""
        rms = float(self.distance[self.used].square().mean().sqrt())
        agree = f"{int(self.used.sum())} of {len(self.names)} {what} agree"
        return f"{agree}, {rms:.4g} apart (RMS), scale {float(self.similarity.scale):.6g}"

    def fault(self) -> str:
        """Why there is no similarity; empty where there is one."""
        match self.similarity.status:
            case None | Status.OK:
                return ""
            case Status.TOO_FEW:
                return f"only {len(self.names)} in common, which is too few"
            case _:
                return f"the {len(self.names)} in common are at one place or on one line"


def align_models(model: Reconstruction, other: Reconstruction) -> Alignment:
    """The similarity that carries the cameras of a model onto those that another has of the same images.

    Rotation, scale and place are each the one that most images agree on (medians), so that up to half of the images may be
    misplaced in one of the models; then the least squares over the camera centres that agree. Two images are enough, and
    centres on one line, too, as the rotations of the cameras tell the turn about it.

    Args:
        model: The model.
        other: The other one; images are the same that have the same name.
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


@dataclass(frozen=True)
class ControlPoints:
    """Points whose places were measured, and where images show them.

    Attributes:
        names: Names of the points.
        X: Their places.
        images: Name of the image of each observation.
        x: Where it is, pixels.
        point: Which point it shows.
    """

    names: tuple[str, ...]
    X: Float[Tensor, "n 3"]
    images: tuple[str, ...]
    x: Float[Tensor, "m 2"]
    point: Int[Tensor, "m"]


def align_to_points(model: Reconstruction, control: ControlPoints) -> Alignment:
    """The similarity that carries a model to where points of it were measured to be.

    The points are triangulated from the images that show them, two or more each, and the similarity is that of the least sum of
    squared distances. It takes three points that are not on one line; all are used, as they were measured on purpose.

    Args:
        model: The model; observations in images without a pose do not count.
        control: The measured points.
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
    target = control.X.double()[seen]
    similarity = similarity_from_points(found, target)
    used = torch.full((len(names),), bool(similarity.status == Status.OK))
    return Alignment(similarity, names, (similarity.transform(found) - target).norm(dim=-1), used)


def _nothing(names: tuple[str, ...], status: Status) -> Alignment:
    """No similarity."""
    one, eye = torch.ones((), dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    same = Similarity(one, eye, torch.zeros(3, dtype=torch.float64), torch.tensor(int(status), dtype=torch.int8))
    return Alignment(same, names, torch.zeros(len(names), dtype=torch.float64), torch.zeros(len(names), dtype=torch.bool))
