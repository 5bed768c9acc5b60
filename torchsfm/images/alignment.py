"""Small pieces of an image found again in another, up to an affine warp, gain and offset.

The inverse compositional form of Lucas and Kanade (Baker and Matthews, IJCV 2004): the derivatives are those of the template,
so that the normal equations are solved once for each template.
"""

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Template:
    """Square pieces of images of `2 radius + 1` pixels, normalised to mean 0 and norm 1 under a Gaussian weight."""

    values: Float[Tensor, "n p"]
    step: Float[Tensor, "n 6 p"]
    """What a difference in each pixel says about the warp."""
    warp: Float[Tensor, "n 2 2"]
    """The last known affine map from template to image."""
    valid: Bool[Tensor, " n"]
    """Where there is enough texture to align by."""

    def __getitem__(self, index: Int[Tensor, " k"]) -> "Template":
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def join(self, other: "Template") -> "Template":
        """The templates of both, one after the other."""
        return replace(self, **{f.name: torch.cat([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)})

    def replaced(self, where: Bool[Tensor, " n"], others: "Template") -> "Template":
        """These, with the others in order in the places named."""
        chosen = {}
        for field in fields(self):
            chosen[field.name] = getattr(self, field.name).clone()
            chosen[field.name][where] = getattr(others, field.name)
        return replace(self, **chosen)

    def turned(self, warp: Float[Tensor, "n 2 2"]) -> "Template":
        """The same with another affine map."""
        return replace(self, warp=warp)


@dataclass(frozen=True)
class Alignment:
    """Where templates are in an image."""

    x: Float[Tensor, "n 2"]
    warp: Float[Tensor, "n 2 2"]
    similarity: Float[Tensor, " n"]
    """Weighted correlation of template and image, in [-1, 1]; 0 where the image is flat."""
    valid: Bool[Tensor, " n"]
    """Where the warp converged to a sane one inside the image."""


def cut_templates(gray: Float[Tensor, "h w"], x: Float[Tensor, "n 2"], radius: int) -> Template:
    """Templates around points of an image."""
    grid = _grid(radius + 1, gray)
    size = 2 * radius + 3
    piece = _sample(gray, x[:, None] + grid).reshape(-1, size, size)
    gx = (0.5 * (piece[:, 1:-1, 2:] - piece[:, 1:-1, :-2])).flatten(1)
    gy = (0.5 * (piece[:, 2:, 1:-1] - piece[:, :-2, 1:-1])).flatten(1)
    weight = _weight(radius, gray)
    values, norm = _normalise(piece[:, 1:-1, 1:-1].flatten(1), weight)
    u, v = _grid(radius, gray).unbind(-1)
    jacobian = torch.stack([gx, gy, u * gx, v * gx, u * gy, v * gy], 1) / norm[:, None, None].clamp_min(1e-12)
    # The parts of the derivatives that gain and offset explain say nothing about the warp.
    jacobian = jacobian - (jacobian * weight).sum(-1, keepdim=True)
    jacobian = jacobian - (jacobian * (weight * values)[:, None]).sum(-1, keepdim=True) * values[:, None]
    weighted = jacobian * weight
    hessian = weighted.double() @ jacobian.double().mT
    scale = torch.tensor([1, 1, radius, radius, radius, radius], dtype=torch.float64, device=gray.device)
    hessian = hessian / (scale[:, None] * scale)
    diagonal = hessian.diagonal(dim1=-2, dim2=-1)
    damping = 1e-3 * diagonal.mean(-1)[:, None, None] * torch.eye(6, dtype=torch.float64, device=gray.device)
    inverse, info = torch.linalg.inv_ex(hessian + damping + 1e-12 * torch.eye(6, dtype=torch.float64, device=gray.device))
    step = (inverse / (scale[:, None] * scale)) @ weighted.double()
    valid = (info == 0) & (norm > 1e-3) & torch.isfinite(step).all(-1).all(-1)
    step = torch.where(valid[:, None, None], step, 0.0).to(gray.dtype)
    return Template(values, step, torch.eye(2, dtype=gray.dtype, device=gray.device).expand(len(x), 2, 2), valid)


def align(gray: Float[Tensor, "h w"], template: Template, x: Float[Tensor, "n 2"], *, rounds: int = 10) -> Alignment:
    """Find templates in an image, starting at `x` with the templates' own warps."""
    radius = (int(template.values.shape[1] ** 0.5) - 1) // 2
    grid, weight = _grid(radius, gray), _weight(radius, gray)
    warp, start = template.warp, x
    moved = torch.zeros(len(x), dtype=gray.dtype, device=gray.device)
    for _ in range(rounds):
        values, _ = _normalise(_sample(gray, x[:, None] + grid @ warp.mT), weight)
        # Flat pieces of the image come out as 0 and so move nothing.
        delta = (template.step @ (values - template.values)[..., None])[..., 0]
        shift, change = delta[:, :2], delta[:, 2:].reshape(-1, 2, 2)
        a, b, c, d = (1 + change[:, 0, 0]), change[:, 0, 1], change[:, 1, 0], (1 + change[:, 1, 1])
        det = (a * d - b * c).clamp_min(0.25)
        inverse = torch.stack([d, -b, -c, a], -1).reshape(-1, 2, 2) / det[:, None, None]
        warp = (warp @ inverse).clamp(-4, 4)
        step = (warp @ shift[..., None])[..., 0]
        x = x - step.clamp(-2, 2)
        moved = step.norm(dim=-1)
    values, _ = _normalise(_sample(gray, x[:, None] + grid @ warp.mT), weight)
    similarity = (values * template.values * weight).sum(-1)
    det = warp[:, 0, 0] * warp[:, 1, 1] - warp[:, 0, 1] * warp[:, 1, 0]
    stretch = warp.square().sum((-2, -1))  # sum of the squared singular values
    sane = (det > 0.1) & (stretch < 8) & (stretch < 10 * det)
    inside = (x >= 0).all(-1) & (x[:, 0] <= gray.shape[1] - 1) & (x[:, 1] <= gray.shape[0] - 1)
    valid = template.valid & sane & inside & (moved < 0.05)
    return Alignment(
        torch.where(valid[:, None], x, start), torch.where(valid[:, None, None], warp, template.warp), similarity, valid
    )


def _grid(radius: int, like: Tensor) -> Tensor:
    """Offsets (p, 2), rows first."""
    steps = torch.arange(-radius, radius + 1, dtype=like.dtype, device=like.device)
    return torch.stack([steps.repeat(len(steps)), steps.repeat_interleave(len(steps))], -1)


def _weight(radius: int, like: Tensor) -> Tensor:
    weight = torch.exp(-0.5 * _grid(radius, like).square().sum(-1) / (0.6 * radius) ** 2)
    return weight / weight.sum()


def _normalise(values: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    values = values - (values * weight).sum(-1, keepdim=True)
    norm = (values.square() * weight).sum(-1).sqrt()
    return torch.where((norm > 1e-6)[:, None], values / norm.clamp_min(1e-6)[:, None], 0.0), norm


def _sample(gray: Tensor, points: Tensor) -> Tensor:
    """Bilinear values (n, p) at points (n, p, 2); beyond the border the nearest pixel's."""
    size = torch.tensor([gray.shape[1] - 1, gray.shape[0] - 1], dtype=gray.dtype, device=gray.device)
    grid = (points / size.clamp_min(1) * 2 - 1)[None]
    return torch.nn.functional.grid_sample(gray[None, None], grid, padding_mode="border", align_corners=True)[0, 0]
