"""Control points in the bundle: a model that bends to points that were measured."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm._types import Status, check_options
from torchsfm.bundle import BundleCovariance, PointPrior, bundle_adjust_model, bundle_covariance
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.optim import Cauchy, Loss
from torchsfm.reconstruction.model.alignment import Alignment, ControlPoints, align_to_points
from torchsfm.reconstruction.model.reconstruction import Reconstruction

RAYLEIGH = 1.1774
"""Median distance of points whose coordinates have the standard deviation 1."""
LEAST_NOISE, MOST_NOISE = 0.05, 1.0
"""Between which the standard deviation of the model's image points, pixels, is taken to be."""
CONTRADICTS = 5.0
"""Standard deviations beyond which a measured point contradicts the model."""


@dataclass(frozen=True)
class ControlledModel:
    """A model adjusted to control points, and how well they fit.

    Attributes:
        model: In the frame of the control points, which are the last of its points.
        alignment: The similarity that came before, with how far off each point was.
        control: The control points that count: of two images with a pose or more.
        apart: How far each is from where it was measured to be, after the adjustment.
        deviation: The same, and how far its image points are from its projections, together in standard deviations (RMS).
        status: Of the adjustment.
        why: Why the model is not to be trusted; empty where it is.
        terms: What was adjusted, held and known, for the covariance; None where there was no adjustment.
        sigma: Standard deviation of the model's image points, pixels.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.reconstruction import ControlPoints, adjust_to_points
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(6, 60, 250, noise=0.0, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> row = (model.point < 6).nonzero()[:, 0]
        >>> images = tuple(model.names[i] for i in model.view[row].tolist())
        >>> known = ControlPoints(tuple("abcdef"), 3 * model.X[:6], images, model.x[row], model.point[row])
        >>> found = adjust_to_points(model, known, sigma=0.001)
        >>> found.status.name, bool(found.apart.norm(dim=-1).max() < 1e-3), found.alignment.similarity.scale
        ('OK', True, tensor(3.0000, dtype=torch.float64))
        >>> found.covariance().X.shape  # of all points, and of the control points after them
        torch.Size([66, 3, 3])
    """

    model: Reconstruction
    alignment: Alignment
    control: ControlPoints
    apart: Float[Tensor, "n 3"]
    deviation: Float[Tensor, "n"]
    status: Status
    why: str
    terms: dict[str, Any] | None = None
    sigma: float = 1.0

    def covariance(self) -> BundleCovariance:
        """How well poses, cameras and points are known in the frame of the control points.

        Raises:
            ValueError: There was no adjustment.
        """
        if self.terms is None:
            raise ValueError(f"covariance: wanted an adjusted model, got none ({self.why})")
        return bundle_covariance(self.model, sigma=self.sigma, **self.terms)

    def summary(self) -> str:
        """One line for people."""
        before, after = (float(d.square().mean().sqrt()) for d in (self.alignment.distance, self.apart.norm(dim=-1)))
        return f"{len(self.apart)} control points, {before:.4g} apart (RMS) before the adjustment, {after:.4g} after"

    def fault(self) -> str:
        """Why the model is not to be trusted; empty where it is."""
        return self.why


@on_the_cpu
def adjust_to_points(
    model: Reconstruction,
    control: ControlPoints,
    *,
    sigma: float | Tensor = 0.01,
    image_sigma: float = 1.0,
    free: Sequence[str] | None = None,
    loss: Loss | None = None,
    max_iterations: int = 50,
) -> ControlledModel:
    """Adjust a model with control points in the bundle, so that it bends to where they were measured to be.

    The model is carried to them first (`align_to_points`); then their image points are observations as others are, and their
    places are known with a standard deviation (`PointPrior`). Image points of the model count by the noise that its residuals
    show. Points that contradict the model, by more than five standard deviations in space and images together, make it bad:
    `fault` names the worst.

    Args:
        model: The model, with points and observations.
        control: Points in three dimensions and the images that show them; see `ControlPoints`.
        sigma: Standard deviation of their places in the unit of these: one number, or one a coordinate.
        image_sigma: That of their image points, pixels.
        free: Intrinsics to adjust, as in `bundle_adjust`; by default focal length and distortion, none to hold them.
        loss: Robust loss of the distances of image points; by default Cauchy's at one pixel.
        max_iterations: Most steps of the adjustment.

    Example:
        >>> import torch, torchsfm
        >>> from torchsfm.reconstruction import ControlPoints, adjust_to_points
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(6, 60, 250, noise=0.0, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> row = (model.point < 6).nonzero()[:, 0]
        >>> images = tuple(model.names[i] for i in model.view[row].tolist())
        >>> known = ControlPoints(tuple("abcdef"), 3 * model.X[:6], images, model.x[row], model.point[row])
        >>> found = adjust_to_points(model, known, sigma=0.001)
        >>> found.fault(), bool(found.apart.norm(dim=-1).max() < 1e-3)
        ('', True)
    """
    check_options(image_sigma=(image_sigma, "float > 0"), max_iterations=(max_iterations, "int >= 0"))
    spread = torch.as_tensor(sigma, dtype=torch.float64)
    if spread.ndim not in (0, 2) or (spread.ndim == 2 and spread.shape != control.X.shape) or not bool((spread > 0).all()):
        raise ValueError(f"sigma: wanted a positive number, or one for each coordinate, got {tuple(spread.shape)}")
    alignment = align_to_points(model, control)
    chosen = _only(model, control, alignment.names)
    model = model.to("cpu", torch.float64)
    n, k = len(model.X), len(chosen.names)
    zero = torch.zeros(k, 3, dtype=torch.float64)
    why = alignment.fault() or ("" if n else "the model has no points that could hold it together")
    if why:
        return ControlledModel(model, alignment, chosen, zero, zero[:, 0], Status.DEGENERATE, why)
    moved = model.transform(alignment.similarity)
    apart = moved.residuals()
    noise = min(max(float(apart[apart.isfinite()].median()) / RAYLEIGH, LEAST_NOISE), MOST_NOISE)
    place = {name: i for i, name in enumerate(model.names)}
    view = torch.tensor([place[name] for name in chosen.images], dtype=torch.long)
    order = torch.argsort(chosen.point * len(model.names) + view, stable=True)
    whole = replace(
        moved,
        X=torch.cat((moved.X, chosen.X)),
        color=torch.cat((moved.color, moved.color.new_tensor([1.0, 0.0, 0.0]).expand(k, 3))),
        x=torch.cat((moved.x, chosen.x[order])),
        view=torch.cat((moved.view, view[order])),
        point=torch.cat((moved.point, n + chosen.point[order])),
    )
    # All in units of the noise of the model's own image points, as lines and conics of the model have it.
    own = torch.ones(len(moved.x), dtype=torch.float64)
    weights = torch.cat((own, own.new_full((len(order),), (noise / image_sigma) ** 2)))
    if spread.ndim:
        spread = spread[[control.names.index(name) for name in chosen.names]]
    prior = PointPrior(n + torch.arange(k), chosen.X, sigma=spread / noise)
    names = ("focal", *model.cameras.distortion.parameter_names) if free is None else tuple(free)
    terms: dict[str, Any] = {"free": names, "weights": weights, "priors": (prior,), "loss": loss or Cauchy(1.0)}
    adjusted = bundle_adjust_model(whole, max_iterations=max_iterations, **terms)
    result = adjusted.model
    off = result.X[n:] - chosen.X
    squared = (off / spread).square().sum(-1)
    pixels = (result.residuals()[len(moved.x) :] / image_sigma).square()
    squared = squared.index_add(0, result.point[len(moved.x) :] - n, pixels)
    numbers = 3 + 2 * torch.bincount(chosen.point, minlength=k)
    deviation = (squared / numbers).sqrt()
    return ControlledModel(
        result, alignment, chosen, off, deviation, adjusted.result.status,
        _contradiction(alignment, chosen.names, deviation, adjusted.result.status), terms, noise,
    )  # fmt: skip


def _only(model: Reconstruction, control: ControlPoints, names: tuple[str, ...]) -> ControlPoints:
    """Control points of these names alone, with their observations in images that have a pose, in double precision."""
    posed = {name for name, there in zip(model.names, model.registered.tolist(), strict=True) if there}
    number = torch.tensor([names.index(name) if name in names else -1 for name in control.names], dtype=torch.long)
    rows = [
        i for i, (image, p) in enumerate(zip(control.images, control.point.tolist(), strict=True))
        if image in posed and number[p] >= 0
    ]  # fmt: skip
    X = control.X.to("cpu", torch.float64)[number >= 0]
    x = control.x.to("cpu", torch.float64)[rows]
    return ControlPoints(names, X, tuple(control.images[i] for i in rows), x, number[control.point[rows]])


def _contradiction(alignment: Alignment, names: tuple[str, ...], deviation: Float[Tensor, "n"], status: Status) -> str:
    """Which point contradicts the model, if one does."""
    if status not in (Status.OK, Status.NOT_CONVERGED):
        return f"the adjustment ended with {status.name}"
    # What the similarity left aside may be right: the model bends to it.
    worst = int(deviation.argmax())
    if float(deviation[worst]) <= CONTRADICTS:
        return ""
    off = (
        f"{float(alignment.distance[worst]):.3g} off by the similarity, {float(deviation[worst]):.3g} standard deviations after"
    )
    return f"the control point {names[worst]} contradicts the others ({off})"
