"""Other detectors of edges, each as a function from an image (1, h, w) to points (n, 2), centre of the first pixel (0, 0).

All take the gradients that an edge point, and one point of every edge, must have, per pixel; contours only need a level.
"""

import math
import warnings
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label
from torch import Tensor

Array = NDArray[np.float64]
Detect = Callable[[Tensor, float, float], Array]
BLUR = 1.0
"""Of what smooths: the standard deviation, in pixels, for all detectors that let one choose."""


def devernay(image: Tensor, low: float, high: float) -> Array:
    """Devernay's edge points with the correction of Grompone von Gioi & Randall (IPOL 2017).

    A pixel whose gradient is longer than that of both neighbours along the axis that it is nearest to; the place is the top of
    the parabola through these three lengths. Kept by Canny's two thresholds, over pixels that touch.
    """
    smooth = gaussian_filter(image[0].numpy(), BLUR, mode="nearest")
    gx, gy = np.zeros_like(smooth), np.zeros_like(smooth)
    gx[:, 1:-1] = (smooth[:, 2:] - smooth[:, :-2]) / 2
    gy[1:-1] = (smooth[2:] - smooth[:-2]) / 2
    length = np.hypot(gx, gy)
    row, column = (length > low).nonzero()
    border = int(2 * BLUR) + 2
    h, w = length.shape
    inside = (row >= border) & (row < h - border) & (column >= border) & (column < w - border)
    row, column = row[inside], column[inside]
    flat = np.abs(gx[row, column]) >= np.abs(gy[row, column])
    dx, dy = flat.astype(int), (~flat).astype(int)
    a, b, c = length[row - dy, column - dx], length[row, column], length[row + dy, column + dx]
    top = (b > a) & (b >= c)
    row, column, dx, dy, a, b, c = (v[top] for v in (row, column, dx, dy, a, b, c))
    pixels = np.zeros(length.shape, dtype=bool)
    pixels[row, column] = True
    number, _ = label(pixels, np.ones((3, 3)))
    strong = np.unique(number[pixels & (length >= high)])
    offset = 0.5 * (a - c) / (a - 2 * b + c)
    x = np.stack((column + offset * dx, row + offset * dy), -1)
    return x[np.isin(number[row, column], strong)]


def canny(image: Tensor, low: float, high: float) -> Array:
    """OpenCV's, in whole pixels."""
    smooth = cv2.GaussianBlur(eight_bits(image), (0, 0), BLUR)
    # Sobel's masks make eight times the derivative of it.
    row, column = cv2.Canny(smooth, 8 * 255 * low, 8 * 255 * high, L2gradient=True).nonzero()
    return np.stack((column, row), -1).astype(np.float64)


def eight_bits(image: Tensor) -> NDArray[np.uint8]:
    """Grey values in whole numbers."""
    return np.clip(np.rint(image[0].numpy() * 255), 0, 255).astype(np.uint8)


def contours() -> Detect | None:
    """The lines of scikit-image's marching squares at the middle level; None if it is not installed."""
    try:
        from skimage.measure import find_contours
    except ImportError:
        return None

    def detect(image: Tensor, low: float, high: float) -> Array:
        lines = find_contours(image[0].numpy(), 0.5)
        return np.concatenate([np.zeros((0, 2)), *lines])[:, ::-1]

    return detect


def partial_area(iterations: int) -> Detect | None:
    """Trujillo-Pino's (`subpixel-edges`), from what share of a pixel is bright; None if it is not installed.

    Args:
        iterations: 0 for images without noise, 1 smooths a little.
    """
    # The package asks for a name that newer NumPy has no more.
    vars(np).setdefault("int", int)
    try:
        from subpixel_edges import subpixel_edges
    except ImportError:
        return None

    def detect(image: Tensor, low: float, high: float) -> Array:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            found = subpixel_edges(image[0].double().numpy() * 255, 255 * high, iterations, 2)
        x = np.stack((np.ravel(found.x), np.ravel(found.y)), -1)
        return x[np.isfinite(x).all(-1)]

    return detect


def peers() -> dict[str, Detect | None]:
    """All that find parts of pixels, None for what is not installed."""
    return {
        "IPOL formula": devernay,
        "skimage contours": contours(),
        "subpixel-edges, 0": partial_area(0),
        "subpixel-edges, 1": partial_area(1),
    }


def bound(noise: float, blur: float) -> float:
    """Cramer-Rao bound of a place along a straight edge, for what smoothing by `BLUR` averages, in pixels.

    Args:
        noise: Its standard deviation over the contrast.
        blur: Standard deviation of the edge's own profile, that of the pixel in it.
    """
    return noise * math.sqrt(blur / BLUR)
