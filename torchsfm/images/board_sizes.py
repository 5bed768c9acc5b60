"""Of how many points a board is that an image shows, where the size that was said is not found."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchsfm.geometry import Ellipse
from torchsfm.geometry.conics import shape_of_ellipse
from torchsfm.images.boards import detect_chessboard
from torchsfm.images.corners import to_gray
from torchsfm.images.ellipses import detect_ellipses
from torchsfm.images.plane_grids import grid_size

_LEAST = 3


def chessboard_size(image: Float[Tensor, "c h w"]) -> tuple[int, int] | None:
    """Inner corners in a row and in a column, the larger number first; None where no chessboard is seen from end to end."""
    import cv2

    gray = to_gray(image.detach())[0]
    pixels = (gray.nan_to_num().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_ACCURACY
    found, _, labels = cv2.findChessboardCornersSBWithMeta(pixels, (_LEAST, _LEAST), flags)
    if not found or labels is None:
        return None
    rows, columns = sorted(labels.shape[:2])
    # That detector ends where it loses sight of the board; the other one wants to see its edge.
    return (columns, rows) if bool(detect_chessboard(image, columns, rows).found) else None


def circles_grid_size(image: Float[Tensor, "c h w"]) -> tuple[int, int] | None:
    """Circles in a row and in a column, the larger number first; None where no full grid is seen."""
    seen = detect_ellipses(to_gray(image.detach()))
    one = seen.ellipse
    each = Ellipse(*(v[seen.valid].double() for v in (one.centre, one.semi_axes, one.angle)))
    return grid_size(each.centre, shape_of_ellipse(each), _LEAST)
