"""Curves of images as drawings: SVG, a path for each curve, in the pixels of the image."""

import html
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm.geometry import Curve
from torchsfm.reconstruction.messages import printable
from torchsfm.reconstruction.model.reconstruction import Reconstruction

SAME_RAY = 1e-4
"""Sine of the angle within which the ray that comes back from its image is the same: lenses fold over far outside of it."""


def draw_curves(curves: Curve) -> str:
    """Curves of an image, in black, on a page that just holds them.

    Args:
        curves: In pixels, the centre of the top-left one at (0, 0), with any batch dimensions.

    Raises:
        ValueError: They are no curves of an image.
    """
    if curves.x.shape[-1] != 2:
        raise ValueError(f"curves: wanted ones of an image for a drawing, with 2 coordinates, got {curves.x.shape[-1]}")
    rows = [
        (own[there & own.isfinite().all(-1)].detach().cpu(), bool(around))
        for own, there, around in zip(
            curves.x.reshape(-1, *curves.x.shape[-2:]), curves.valid.reshape(-1, curves.valid.shape[-1]),
            curves.closed.reshape(-1), strict=True,
        )
    ]  # fmt: skip
    rows = [(own, around) for own, around in rows if len(own)]
    every = torch.cat([curves.x.new_zeros(0, 2).cpu(), *(own for own, _ in rows)])
    low, high = (every.amin(0).floor(), every.amax(0).ceil()) if len(every) else (every.new_zeros(2), every.new_zeros(2))
    return _page(low, high - low + 1, [_path(own, around, every.new_zeros(3)) for own, around in rows], "")


def draw_model_curves(model: Reconstruction, image: str | int) -> str:
    """The curves in space of a model where one of its images would show them, each in its colour.

    What hides them is not known: curves behind surfaces are drawn, too.

    Args:
        model: A model with curves.
        image: Name or number of one of its images that has a pose.

    Raises:
        ValueError: There is no such image, or it has no pose.
    """
    view = image if isinstance(image, int) else model.names.index(image) if image in model.names else -1
    if not 0 <= view < len(model.names) or not bool(model.registered[view]):
        raise ValueError(f"image: wanted one of the model that has a pose, got {image!r}")
    model = model.to("cpu", torch.float64)
    assert model.curves is not None, "a model with curves"
    x, seen = _seen(model, model.curves.X, view)
    shown = replace(model.curves, X=torch.nn.functional.pad(x, (0, 1))).runs_where(seen)
    paths = [
        _path(shown.X[shown.curve == k, :2], around, shown.color[shown.curve == k].mean(0))
        for k, around in enumerate(shown.closed.tolist())
    ]
    return _page(x.new_zeros(2), model.image_size[view].double(), paths, model.names[view])


def _seen(model: Reconstruction, X: Float[Tensor, "n 3"], view: int) -> tuple[Float[Tensor, "n 2"], Bool[Tensor, "n"]]:
    """Where points come to lie in an image, and which of them are within it."""
    camera = model.cameras[model.camera_index[view]]
    d = model.poses[view].transform(X)
    x = camera.project(d)
    back, valid = camera.unproject(x)
    turned = torch.linalg.vector_norm(torch.linalg.cross(d, back), dim=-1)
    same = turned < SAME_RAY * torch.linalg.vector_norm(d, dim=-1) * torch.linalg.vector_norm(back, dim=-1)
    within = ((x >= -0.5) & (x <= model.image_size[view] - 0.5)).all(-1)
    return x, within & valid & same & ((d * back).sum(-1) > 0)


def _page(low: Float[Tensor, "2"], size: Float[Tensor, "2"], paths: list[str], title: str) -> str:
    """A drawing whose corner is the outer corner of a pixel, as an image viewer would lay it over the image."""
    (x, y), (width, height) = low.tolist(), size.tolist()
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{x:g} {y:g} {width:.10g} {height:.10g}"'
    head += f' width="{width:.10g}" height="{height:.10g}">'
    style = '<g transform="translate(0.5 0.5)" fill="none" stroke-width="1" stroke-linejoin="round" stroke-linecap="round">'
    named = [f"<title>{html.escape(printable(title))}</title>"] if title else []
    return "\n".join([head, *named, style, *paths, "</g>", "</svg>", ""])


def _path(x: Float[Tensor, "n 2"], closed: bool, color: Float[Tensor, "3"]) -> str:
    red, green, blue = (color.nan_to_num(0).clamp(0, 1) * 255).round().int().tolist()
    points = " ".join(f"{u:.3f},{v:.3f}" for u, v in x.tolist())
    return f'<path stroke="#{red:02x}{green:02x}{blue:02x}" d="M {points}{" Z" if closed else ""}"/>'
