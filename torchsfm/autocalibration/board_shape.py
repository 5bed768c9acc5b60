"""Boards that are not what they are said to be: printed a little too long, or bent as paper is.

Five numbers move the points (x, y) of a plane, measured from the middle of the board in half its longer side, by
`(stretch x + shear y, 0, bend_xx x^2 + bend_xy x y + bend_yy y^2)`. What else is linear in x and y is a pose or a scale.
"""

import torch
from jaxtyping import Float
from torch import Tensor

BOARD = "board"
"""What frees them."""
NAMES = ("stretch", "shear", "bend_xx", "bend_xy", "bend_yy")


def shape_slopes(X: Float[Tensor, "*batch n 2"]) -> Float[Tensor, "5 3 *batch n"]:
    """Where each of the five numbers moves the points."""
    x, y = X.unbind(-1)
    zero = torch.zeros_like(x)
    slopes = ((x, zero, zero), (y, zero, zero), (zero, zero, x * x), (zero, zero, x * y), (zero, zero, y * y))
    return torch.stack([torch.stack(slope) for slope in slopes])


def shaped(X: Float[Tensor, "*batch n 2"], shape: Float[Tensor, "*batch 5"]) -> Float[Tensor, "*batch n 3"]:
    """The points of such a board in space."""
    x, y = X.unbind(-1)
    stretch, shear, xx, xy, yy = (s[..., None] for s in shape.unbind(-1))
    return torch.stack((x + stretch * x + shear * y, y, xx * x * x + xy * x * y + yy * y * y), -1)
