"""Projection with its derivatives, each formula once, for resection, triangulation, bundle adjustment and calibration.

There is one law: where `u = a q / c q` for rows a and c, its derivative by q is `(a - u c) / (c q)` (`quotient_slope`). With
the point for q, the rows are those of P; with the entries of P, they hold the point; with a point in the camera's frame, they
are unit vectors, and lens, pixels and pose follow by the chain rule (`PixelProjection`, `turn_slopes`).

Coordinates come first, so that each is one long row, and everything behind them broadcasts. Numbers are float64: the reciprocal
of a depth has a limit (`flatten`), behind which nothing overflows.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry.distortion_model import Distortion
from torchsfm.geometry.intrinsic_parameters import ASPECT, CX, CY, FOCAL, HEAD, SKEW


def quotient_slope(
    first: Float[Tensor, "*#n"], last: Float[Tensor, "*#n"], u: Float[Tensor, "*#n"], inverse: Float[Tensor, "*#n"]
) -> Float[Tensor, "*n"]:
    """The derivative of `u = first q / last q` by q, with `inverse = 1 / last q`; of any shape, all broadcasts."""
    return torch.addcmul(first, u, last, value=-1) * inverse


def point_slopes(
    P: Float[Tensor, "3 k *#n"], uv: Float[Tensor, "2 *#n"], inverse: Float[Tensor, "*#n"]
) -> Float[Tensor, "2 k *n"]:
    """The derivatives of image points by the points that cameras P show: homogeneous (k = 4), or of last coordinate 1 (3)."""
    return quotient_slope(P[:2], P[2], uv[:, None], inverse)


def camera_slopes(
    X: Float[Tensor, "4 *#n"], uv: Float[Tensor, "2 *#n"], inverse: Float[Tensor, "*#n"]
) -> Float[Tensor, "2 3 4 *n"]:
    """The derivatives of image points by the entries of the cameras: (h, 0, -u h) and (0, h, -v h) with h = X / depth."""
    h = X * inverse
    J = h.new_zeros(2, 3, *h.shape)
    J[0, 0] = J[1, 1] = h
    torch.mul(uv[:, None], -h, out=J[:, 2])
    return J


def turn_slopes(ray: Float[Tensor, "3 *n"], by_ray: Float[Tensor, "d 3 *n"], out: Float[Tensor, "d k *n"]) -> None:
    """Fill the first three of `out` with the derivatives by a turn: w moves a point Y by w x Y, so g by it becomes Y x g."""
    (X, Y, Z), (by_X, by_Y, by_Z) = ray, by_ray.unbind(1)
    by_x, by_y, by_z = out[:, :3].unbind(1)
    torch.mul(by_Z, Y, out=by_x).addcmul_(by_Y, Z, value=-1)
    torch.mul(by_X, Z, out=by_y).addcmul_(by_Z, X, value=-1)
    torch.mul(by_Y, X, out=by_z).addcmul_(by_X, Y, value=-1)


@dataclass(frozen=True)
class PixelProjection:
    """Pixels of points in the camera's frame, through the lens and K, for cameras that are rows of `intrinsic_parameters`."""

    model: type[Distortion]
    free: tuple[int, ...] = ()
    """Numbers of the row to differentiate by."""
    skew: bool = True
    """Whether any camera has skew; False saves time."""
    relative: bool = False
    """Whether the derivatives are by relative steps, or by additive ones."""

    def pixels(self, ray: Float[Tensor, "3 *n"], row: Float[Tensor, "k *#n"]) -> Float[Tensor, "2 *n"]:
        """Image points; finite for all finite rays, also behind the camera."""
        return self._pixels(self.model.image(ray, self._lens(row)), row, _focal(row))

    def linearize(
        self,
        ray: Float[Tensor, "3 *n"],
        row: Float[Tensor, "k *#n"],
        by_ray: Float[Tensor, "2 3 *n"],
        by_free: Float[Tensor, "2 q *n"] | None = None,
    ) -> Float[Tensor, "2 *n"]:
        """Image points; `by_ray` gets their derivatives by the ray, which are those by the translation, `by_free` by `free`."""
        uv, by_lens = self.model.linearize(ray, self._lens(row), by_ray)
        focal = _focal(row)
        pixels = self._pixels(uv, row, focal)
        shear = row[SKEW] * by_ray[1] if self.skew else None
        by_ray *= focal[:, None]
        if shear is not None:
            by_ray[0] += shear
        if by_free is not None:
            self._by_free(pixels, uv, row, focal, by_lens, by_free)
        return pixels

    def _lens(self, row: Tensor) -> Tensor:
        return row[HEAD : HEAD + self.model.num_parameters]

    def _pixels(self, uv: Tensor, row: Tensor, focal: Tensor) -> Tensor:
        pixels = torch.addcmul(row[CX:HEAD], focal, uv)
        if self.skew:
            pixels = torch.stack((torch.addcmul(pixels[0], row[SKEW], uv[1]), pixels[1]))
        return pixels

    def _by_free(self, pixels: Tensor, uv: Tensor, row: Tensor, focal: Tensor, by_lens: Sequence[Tensor], out: Tensor) -> None:
        u, v = uv
        for here, column in zip(out.unbind(1), self.free, strict=True):
            by_u, by_v = here
            if column == FOCAL and self.relative:
                torch.sub(pixels, row[CX:HEAD], out=here)
            elif column == FOCAL:
                by_u.copy_(u)
                torch.mul(row[ASPECT], v, out=by_v)
            elif column == ASPECT:
                by_u.zero_()
                torch.mul(focal[1] if self.relative else row[FOCAL], v, out=by_v)
            elif column == SKEW:
                by_u.copy_(row[FOCAL] * v if self.relative else v)
                by_v.zero_()
            elif column < HEAD:
                by_u.fill_(column == CX)
                by_v.fill_(column == CY)
            else:
                by = by_lens[column - HEAD]
                torch.mul(focal, by, out=here)
                if self.skew:
                    by_u.addcmul_(row[SKEW], by[1])


def _focal(row: Tensor) -> Tensor:
    return torch.stack((row[FOCAL], row[FOCAL] * row[ASPECT]))
