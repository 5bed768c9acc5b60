"""Cubic B-splines: smooth curves of few numbers, fitted to samples (de Boor 1978)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_options, check_tensors
from torchsfm.geometry.curves import Curve
from torchsfm.linalg import solve

_STIFF = 1e-6
"""Weight of second differences of control points, as a share of a sample's: where there are few samples they still tell."""


@dataclass(frozen=True)
class Spline:
    """Uniform cubic B-splines over [0, 1]: open ones begin and end at their first and last control point (clamped).

    Example:
        >>> import torch, torchsfm
        >>> control = torch.tensor([[0.0, 0.0], [1.0, 2.0], [3.0, 2.0], [4.0, 0.0]])
        >>> torchsfm.geometry.Spline(control, closed=False).at(torch.tensor([0.0, 0.5, 1.0]))
        tensor([[0.0000, 0.0000],
                [2.0000, 1.5000],
                [4.0000, 0.0000]])
    """

    control: Float[Tensor, "*batch k d"]
    """Control points; a closed spline does not repeat its first ones."""
    closed: bool

    def knots(self) -> Float[Tensor, "n"]:
        """The knots: k + 4 of open splines, the outer ones four times; k + 7 of closed ones.

        A closed spline has its first three control points once more at the end.
        """
        k = self.control.shape[-2]
        if self.closed:
            return torch.arange(-3, k + 4, device=self.control.device).to(self.control) / k
        inner = torch.arange(k - 2, device=self.control.device).to(self.control) / (k - 3)
        return torch.cat((inner[:1].expand(3), inner, inner[-1:].expand(3)))

    def at(self, t: Float[Tensor, "*#batch m"]) -> Float[Tensor, "*batch m d"]:
        """The points of parameters in [0, 1]."""
        check_tensors(t=(t, "m"), control=(self.control, "k d"))
        return self.weights(t) @ self.control

    def weights(self, t: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m k"]:
        """How much each control point counts at parameters in [0, 1]: not less than 0, and 1 in all."""
        knots, k = self.knots(), self.control.shape[-2]
        t = t.clamp(0, 1)[..., None]
        last = len(knots) - 5
        index = torch.searchsorted(knots, t.contiguous(), right=True).clamp(max=last + 1) - 1
        slots = torch.arange(len(knots) - 1, device=t.device)
        basis = (index == slots).to(knots.dtype)
        for degree in (1, 2, 3):
            n = len(knots) - 1 - degree
            rise, fall = knots[degree : degree + n] - knots[:n], knots[degree + 1 :] - knots[1 : n + 1]
            up = (t - knots[:n]) / torch.where(rise > 0, rise, 1) * (rise > 0)
            down = (knots[degree + 1 :] - t) / torch.where(fall > 0, fall, 1) * (fall > 0)
            basis = up * basis[..., :n] + down * basis[..., 1 : n + 1]
        if not self.closed:
            return basis
        return torch.cat((basis[..., :3] + basis[..., k:], basis[..., 3:k]), -1)


def fit_spline(curve: Curve, controls: int, *, closed: bool = False) -> tuple[Spline, Float[Tensor, "*batch n"]]:
    """The cubic B-splines nearest to samples in the sense of least squares, at parameters as the chords are long.

    Args:
        curve: The curves.
        controls: Control points of each spline.
        closed: Whether the splines go around; for all curves, whatever `curve.closed` says.

    Returns:
        The splines and the distance of each sample from the point at its parameter; 0 in empty slots, inf of all samples of a
        curve that has no two different ones.

    Raises:
        ValueError: Wrong shape, dtype, device or option.

    Example:
        >>> import torch, torchsfm
        >>> t = torch.linspace(0, torch.pi, 50)
        >>> arc = torchsfm.geometry.curve_from_samples(torch.stack((t.cos(), t.sin()), -1))
        >>> spline, distance = torchsfm.geometry.fit_spline(arc, 8)
        >>> spline.control.shape, bool(distance.max() < 1e-3)
        (torch.Size([8, 2]), True)
    """
    check_options(curve=(curve, Curve))
    check_tensors(x=(curve.x, "n>=2 d>=2"), valid=(curve.valid, "n: bool"))
    check_options(controls=(controls, "int >= 4"), closed=(closed, bool))
    good: Bool[Tensor, ...] = curve.valid & (torch.isfinite(curve.x).all(-1) | ~curve.valid).all(-1, keepdim=True)
    x = torch.where(good[..., None], curve.x, 0)
    step = torch.linalg.vector_norm(x[..., 1:, :] - x[..., :-1, :], dim=-1) * good[..., 1:]
    place = torch.nn.functional.pad(step.cumsum(-1), (1, 0))
    total = place[..., -1:]
    if closed:
        last = x.gather(-2, (good.sum(-1, keepdim=True) - 1).clamp(min=0)[..., None].expand(*x.shape[:-2], 1, x.shape[-1]))
        total = total + torch.linalg.vector_norm(last - x[..., :1, :], dim=-1)
    long = (total > 0) & (total < torch.inf)
    t = place / torch.where(long, total, 1)
    shape = Spline(x.new_zeros(*x.shape[:-2], controls, x.shape[-1]), closed)
    B = shape.weights(t) * good[..., None]
    eye = torch.eye(controls, dtype=x.dtype, device=x.device)
    bend = eye.roll(-1, -1) - 2 * eye + eye.roll(1, -1)
    bend = bend if closed else bend[1:-1]
    A = B.mT @ B + _STIFF * bend.mT @ bend
    # Relative to the first sample, so that what holds a curve together is not lost far from the origin.
    origin = x[..., :1, :]
    rest = (x - origin) * good[..., None]
    control, ok = solve(A + 1e-12 * eye, B.mT @ rest)
    spline = Spline(torch.where((long & ok[..., None])[..., None], control, 0) + origin, closed)
    gap = torch.linalg.vector_norm(spline.weights(t) @ spline.control - x, dim=-1)
    return spline, torch.where(long & ok[..., None], torch.where(good, gap, 0), torch.inf)
