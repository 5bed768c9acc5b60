"""Calibration patterns in images: the corners of chessboards, the centres of circles in a grid."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchsfm._types import check_options, check_tensors
from torchsfm.geometry import Ellipse, conic_from_ellipse, dual_conic
from torchsfm.geometry.conics import shape_of_ellipse
from torchsfm.images.corners import to_gray
from torchsfm.images.ellipses import Ellipses, detect_ellipses
from torchsfm.images.plane_grids import grid_homography, grid_in_points

_WINDOW = 11
"""Largest half side of the square around a corner that says where it is, in pixels."""
_SIZE = math.log(1.25)
"""How far the logarithm of a radius may be from that of the known one."""
_ROUNDS = 4
"""Improvements of the vanishing line by the centres, and of the centres by the vanishing line."""


@dataclass(frozen=True)
class BoardPoints:
    """The points of a pattern with `columns` points in a row, row by row; zero where it is not `found`.

    On the board x turns to y as it does in the image: none is seen from behind. A pattern that looks the same when it is turned
    may be numbered from another of its ends.

    Example:
        >>> import torch, torchsfm
        >>> centre = torch.tensor([2.0, 1.5, -6.0], dtype=torch.float64)  # before the middle of the board
        >>> poses = torchsfm.Pose(torch.eye(3, dtype=centre.dtype)[None], -centre[None])
        >>> camera = torchsfm.Camera(torchsfm.intrinsics(torch.tensor(300.0), torch.tensor([149.5, 112.0])).double())
        >>> image = torchsfm.simulation.render_board(poses, camera, 5, 4, width=300, height=225)
        >>> found = torchsfm.images.detect_chessboard(torch.cat((image, torch.zeros_like(image))), 5, 4)
        >>> found.found, found.x[0, :2].round(decimals=1)  # nothing is in the second image
        (tensor([ True, False]), tensor([[49.5000, 37.0000],
                [99.5000, 37.0000]], dtype=torch.float64))
    """

    x: Float[Tensor, "*batch n 2"]
    """In pixels."""
    found: Bool[Tensor, "*batch"]
    outlines: Float[Tensor, "*batch n 2"] | None = None
    """Centres of the ellipses that fit the outlines of circles, of which `x` are the middles, but for what a lens bends."""
    radius: Float[Tensor, "*batch"] | None = None
    """Of circles, in units of the distance between neighbours."""


def detect_chessboard(image: Float[Tensor, "*batch c h w"], columns: int, rows: int) -> BoardPoints:
    """Find the inner corners of a chessboard (OpenCV's detector), to a fraction of a pixel by the gradients around them.

    Args:
        image: Grey (c = 1) or red, green, blue images.
        columns: Inner corners in a row.
        rows: Inner corners in a column.

    Returns:
        The corners, where all of them are seen.

    Raises:
        ValueError: A shape or an option is wrong.

    Example:
        >>> import torch, torchsfm
        >>> centre = torch.tensor([2.0, 1.5, -6.0], dtype=torch.float64)  # before the middle of the board
        >>> poses = torchsfm.Pose(torch.eye(3, dtype=centre.dtype)[None], -centre[None])
        >>> camera = torchsfm.Camera(torchsfm.intrinsics(torch.tensor(300.0), torch.tensor([149.5, 112.0])).double())
        >>> image = torchsfm.simulation.render_board(poses, camera, 5, 4, width=300, height=225)
        >>> found = torchsfm.images.detect_chessboard(image, 5, 4)
        >>> found.found, found.x.shape
        (tensor([True]), torch.Size([1, 20, 2]))
    """
    import cv2

    batch, flat = _gray(image, columns, rows, 3)
    x = torch.zeros(len(flat), rows * columns, 2, dtype=image.dtype, device=image.device)
    found = torch.zeros(len(flat), dtype=torch.bool, device=image.device)
    ending = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    for i, gray in enumerate(flat):
        pixels = (gray.nan_to_num().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        good, corners = cv2.findChessboardCorners(pixels, (columns, rows), flags=flags)
        if good:
            # Half of a square and no more has the edges of one corner alone.
            window = min(_WINDOW, max(2, int(0.5 * _least_distance(corners.reshape(rows, columns, 2)))))
            corners = cv2.cornerSubPix(pixels, corners, (window, window), (-1, -1), ending)
            x[i] = _seen_from_the_front(torch.from_numpy(corners.reshape(rows, columns, 2)).to(x)).reshape(-1, 2)
            found[i] = True
    return BoardPoints(x.reshape(*batch, rows * columns, 2), found.reshape(batch))


def detect_circles_grid(
    image: Float[Tensor, "*batch c h w"], columns: int, rows: int, *, ratio: float | None = None, max_ellipses: int = 400
) -> BoardPoints:
    """Find the centres of circles in a rectangular grid, all circles of one size.

    The ellipses of `detect_ellipses` are linked to a grid. An ellipse's centre is not where the circle's centre is: that is the
    pole of the vanishing line of the board, which the grid tells. How lenses bend within a circle is not taken into account;
    `calibrate_planes` does that, given `outlines` and `radius` of the result.

    Args:
        image: Grey (c = 1) or red, green, blue images.
        columns: Circles in a row.
        rows: Circles in a column.
        ratio: Radius of a circle in units of the distance between neighbours, if it is known; others then are not taken for it.
        max_ellipses: The most ellipses of an image that are looked at.

    Returns:
        The centres, where all circles are seen and nothing continues the grid; those of their outlines, and their radius.

    Raises:
        ValueError: A shape or an option is wrong.

    Example:
        >>> import torch, torchsfm
        >>> centre = torch.tensor([2.0, 1.5, -6.0], dtype=torch.float64)  # before the middle of the board
        >>> poses = torchsfm.Pose(torch.eye(3, dtype=centre.dtype)[None], -centre[None])
        >>> camera = torchsfm.Camera(torchsfm.intrinsics(torch.tensor(300.0), torch.tensor([149.5, 112.0])).double())
        >>> image = torchsfm.simulation.render_board(poses, camera, 5, 4, radius=0.3, width=300, height=225)
        >>> found = torchsfm.images.detect_circles_grid(image, 5, 4)
        >>> found.found, found.x.shape
        (tensor([True]), torch.Size([1, 20, 2]))
    """
    check_options(ratio=(ratio, "?0 < float < 1"), max_ellipses=(max_ellipses, "int >= 1"))
    batch, flat = _gray(image, columns, rows, 2)
    x = torch.zeros(len(flat), rows * columns, 2, dtype=image.dtype, device=image.device)
    found = torch.zeros(len(flat), dtype=torch.bool, device=image.device)
    outlines, radius = torch.zeros_like(x), torch.zeros_like(x[:, 0, 0])
    for i, gray in enumerate(flat):
        circles = _circles(detect_ellipses(gray[None], max_ellipses), columns, rows, ratio)
        if circles is not None:
            x[i], outlines[i], radius[i], found[i] = *(v.to(x) for v in circles), True
    shape = (*batch, rows * columns, 2)
    return BoardPoints(x.reshape(shape), found.reshape(batch), outlines.reshape(shape), radius.reshape(batch))


def _gray(image: Tensor, columns: int, rows: int, least: int) -> tuple[torch.Size, Tensor]:
    batch = check_tensors(image=(image, "c h>=8 w>=8"))
    check_options(columns=(columns, f"int >= {least}"), rows=(rows, f"int >= {least}"))
    if image.shape[-3] not in (1, 3):
        raise ValueError(f"image: wanted 1 or 3 channels, got {image.shape[-3]}")
    return batch, to_gray(image.detach().reshape(batch.numel(), *image.shape[-3:]))[:, 0]


def _least_distance(x: np.ndarray) -> float:
    """Of neighbours in a grid (rows, columns, 2)."""
    return min(float(np.linalg.norm(np.diff(x, axis=k), axis=-1).min()) for k in (0, 1))


def _circles(ellipses: Ellipses, columns: int, rows: int, ratio: float | None) -> tuple[Tensor, Tensor, Tensor] | None:
    """The middles of the circles and the centres of their outlines, row by row, and their median radius."""
    valid = ellipses.valid
    each = Ellipse(*(v[valid].double() for v in (ellipses.ellipse.centre, ellipses.ellipse.semi_axes, ellipses.ellipse.angle)))
    order = grid_in_points(each.centre, shape_of_ellipse(each), columns, rows)
    if order is None:
        return None
    chosen = Ellipse(each.centre[order], each.semi_axes[order], each.angle[order])
    C_dual, x = dual_conic(conic_from_ellipse(chosen)), chosen.centre
    for _ in range(_ROUNDS):
        H = grid_homography(x, columns)
        infinity = torch.linalg.inv_ex(H).inverse[2]
        pole = C_dual @ infinity
        x = pole[:, :2] / pole[:, 2:]
    if not bool(x.isfinite().all()):
        return None
    # On the board, in units of the distance between neighbours: H' C H.
    on_board = H.mT @ conic_from_ellipse(chosen) @ H
    radius = (on_board[:, :2, :2].det().clamp_min(1e-300).pow(-1.5) * -on_board.det()).clamp_min(0).sqrt()
    if ratio is not None and not bool(((radius / ratio).log().abs() < _SIZE).all()):
        return None
    both = torch.cat((x, chosen.centre), -1).reshape(rows, columns, 4)
    both = _seen_from_the_front(both).reshape(-1, 4)
    return both[:, :2], both[:, 2:], radius.median()


def _seen_from_the_front(x: Tensor) -> Tensor:
    """Rows and columns (rows, columns, k) so that x turns to y; the end that is nearer to the top left corner is the first.

    The place of each is in the first two of its numbers.
    """
    along, down = (end[:2] - x[0, 0, :2] for end in (x[0, -1], x[-1, 0]))
    if float(along[0] * down[1] - along[1] * down[0]) < 0:
        x = x.flip(1)
    return x if float(x[0, 0, :2].sum()) <= float(x[-1, -1, :2].sum()) else x.flip(0, 1)
