"""Line segments: straight runs of edge points, with what their number and scatter say of their place."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm._types import check_options
from torchsfm.images.corners import to_gray
from torchsfm.images.edges import detect_edges
from torchsfm.images.false_alarms import aligned, log_tail
from torchsfm.images.slots import lay_in_slots
from torchsfm.images.step_fit import fit_steps
from torchsfm.images.straight_runs import Runs, axis, moments, straight_runs

_ROUNDED = 3
"""Edge points at each end that a corner may have bent."""
_BESIDE = 0.7
"""Distance in pixels up to which further points of the chain lengthen a segment."""


@dataclass(frozen=True)
class Segments:
    """Line segments of images, in slots of which the first ones are `valid`, the longest first; zero in empty slots.

    Example:
        >>> import torch, torchsfm
        >>> image = torch.zeros(1, 60, 80)
        >>> image[:, 20:40, 30:60] = 1.0  # a rectangle
        >>> found = torchsfm.detect_segments(image)
        >>> found.valid.sum(), found.length[found.valid].round(decimals=-1), bool(found.scatter[found.valid].max() < 0.1)
        (tensor(4), tensor([30., 30., 20., 20.]), True)
        >>> direction = found.ends[found.valid][:, 1] - found.ends[found.valid][:, 0]
        >>> direction.round(decimals=-1).abs()
        tensor([[30.,  0.],
                [30.,  0.],
                [ 0., 20.],
                [ 0., 20.]])
    """

    ends: Float[Tensor, "*batch n 2 2"]
    """End points in pixels; from the first to the second the brighter side is to the left, as seen on the screen."""
    line: Float[Tensor, "*batch n 3"]
    """The line with a normal of length 1, towards the brighter side."""
    support: Float[Tensor, "*batch n 2 2"]
    """The two points of the line that say where it is as all that it was fitted to does: edge points, their standard deviation
    from the middle away, or pixels."""
    length: Float[Tensor, "*batch n"]
    """Distance between the ends, in pixels."""
    count: Int[Tensor, "*batch n"]
    """Number of edge points."""
    scatter: Float[Tensor, "*batch n"]
    """Root-mean-square distance of the edge points from the line, in pixels."""
    sigma: Float[Tensor, "*batch n"]
    """Standard deviation of an edge point across the line: by the image's noise, or the scatter if that is larger."""
    independent: Float[Tensor, "*batch n"]
    """How many independent edge points tell as much as what the line was fitted to: smoothing ties neighbours together."""
    contrast: Float[Tensor, "*batch n"]
    """Mean gradient across the line, in image values per pixel."""
    log_nfa: Float[Tensor, "*batch n"]
    """Decimal logarithm of the number of as good segments to be expected in noise (Desolneux, Moisan and Morel 2000)."""
    valid: Bool[Tensor, "*batch n"]

    def fit_points(self) -> tuple[Float[Tensor, "*batch n 2 2"], Float[Tensor, "*batch n"]]:
        """Two points on each segment, and weights of their squared distances, that say all its edge points say of the line.

        They are its `support`, each with variance `2 sigma^2 / independent` across the line: what `triangulate_lines` takes.
        Empty slots have weight 0.
        """
        variance = 2 * self.sigma.square()
        return self.support, torch.where(self.valid, self.independent / torch.where(self.valid, variance, 1.0), 0.0)


def detect_segments(
    image: Float[Tensor, "*#batch c h w"],
    max_segments: int = 2000,
    *,
    min_length: float = 10.0,
    tolerance: float = 0.15,
    blur: float = 1.0,
    low: float = 0.01,
    high: float = 0.03,
    noise: float | None = None,
    mask: Bool[Tensor, "*#batch h w"] | None = None,
) -> Segments:
    """Line segments of each image, from linked edges (`detect_edges`).

    Chains are cut into straight runs, lines fitted by total least squares without the points that corners bend, and kept where
    that many edge points with gradients along one normal are not to be expected in noise. Where the pixels beside a segment
    are a blurred step and noise, nothing else, they say where it is, better than edge points do.

    Args:
        image: Grey (c = 1) or red, green, blue images.
        max_segments: The number of slots for each image, for the longest ones.
        min_length: Shortest segment, in pixels.
        tolerance: Root-mean-square deviation from straightness, in pixels, that is not noise but does no harm either.
        blur: As in `detect_edges`.
        low: As in `detect_edges`.
        high: As in `detect_edges`.
        noise: As in `detect_edges`.
        mask: Where edges may be.

    Returns:
        The segments. An image without any has none valid.

    Raises:
        ValueError: A shape or an option is wrong.

    Example:
        >>> import torch, torchsfm
        >>> image = torch.zeros(1, 60, 80)
        >>> image[:, 20:40, 30:60] = 1.0  # a rectangle
        >>> found = torchsfm.detect_segments(image)
        >>> found.valid.sum(), found.length[0].round(decimals=-1)
        (tensor(4), tensor(30.))
    """
    check_options(
        max_segments=(max_segments, "int >= 1"), min_length=(min_length, "float > 0"), tolerance=(tolerance, "float > 0")
    )
    edges = detect_edges(image, blur=blur, low=low, high=high, noise=noise, mask=mask, straight=True)
    batch, slots = edges.valid.shape[:-1], edges.valid.shape[-1]
    pixels = image.shape[-1] * image.shape[-2]
    place = edges.valid.flatten().nonzero()[:, 0]
    of_image = place // slots
    x, gradient = (v.reshape(-1, 2)[place] for v in (edges.x, edges.gradient))
    sigma, closed = edges.sigma.flatten()[place], edges.closed.flatten()[place]
    chain = edges.chain.flatten()[place] + of_image * (slots + 1)
    runs = straight_runs(x, sigma.square(), chain, closed, tolerance)
    found = _fit(x, gradient, sigma, runs, 2 * math.sqrt(math.pi) * blur)
    number = len(runs.sums)
    of_run = torch.zeros(number, dtype=torch.long, device=x.device).index_copy(0, runs.number, of_image)
    tests = 2.5 * math.log10(pixels)
    good = (found["length"] >= min_length) & (found["log_nfa"] + tests <= 0) & (found["count"] > 2)
    found["log_nfa"] = found["log_nfa"] + tests
    rows = good.nonzero()[:, 0]
    found, good = {name: values[rows] for name, values in found.items()}, good[rows]
    of_run = of_run[rows]
    wide = edges.width.reshape(-1)[place].double().square()
    wide = wide.new_zeros(number).index_add(0, runs.number, wide)[rows] / found["count"].clamp_min(1)
    gray = to_gray(image)[..., 0, :, :].expand(*batch, *image.shape[-2:]).reshape(-1, *image.shape[-2:])
    found |= _on_steps(found, gray, edges.noise.reshape(-1)[of_run], of_run, (wide - blur**2 - 1 / 3).clamp_min(0.1).sqrt())
    return Segments(**lay_in_slots(found, good, found["length"], of_run, batch, max_segments, image.dtype))


def _on_steps(found: dict[str, Tensor], gray: Tensor, level: Tensor, image: Tensor, spread: Tensor) -> dict[str, Tensor]:
    """Segments where they are steps of brightness and nothing else, placed by the pixels beside them."""
    ends = found["ends"]
    step = fit_steps(gray, level, image, ends, spread)
    along = ((ends - step.middle[:, None]) * step.direction[:, None]).sum(-1, keepdim=True)
    half = step.half[:, None] * step.direction
    normal = torch.stack((step.direction[:, 1], -step.direction[:, 0]), -1)
    new = {
        "ends": step.middle[:, None] + along * step.direction[:, None],
        "support": torch.stack((step.middle - half, step.middle + half), -2),
        "line": torch.cat((normal, -(normal * step.middle).sum(-1, keepdim=True)), -1),
        "independent": 2 * found["sigma"].square() / step.variance.clamp_min(1e-300),
    }
    return {name: torch.where(step.good.view(-1, *[1] * (v.ndim - 1)), v, found[name]) for name, v in new.items()}


def _fit(x: Tensor, gradient: Tensor, sigma: Tensor, runs: Runs, tied: float) -> dict[str, Tensor]:
    """Lines of the runs, one row each, in double precision."""
    number, n = runs.number, len(runs.sums)
    x, gradient, sigma = x.double(), gradient.double(), sigma.double()
    middle, direction, _ = axis(runs.sums)

    def total(values: Tensor) -> Tensor:
        return values.new_zeros((n, *values.shape[1:])).index_add(0, number, values)

    def turned(direction: Tensor) -> Tensor:
        """The direction with the gradients to its left, (y, -x)."""
        mean = total(gradient)
        side = direction[:, 1] * mean[:, 0] - direction[:, 0] * mean[:, 1]
        return torch.where(side[:, None] < 0, -direction, direction)

    direction = turned(direction)
    along = ((x - middle[number]) * direction[number]).sum(-1)

    def span(along: Tensor, number: Tensor) -> tuple[Tensor, Tensor]:
        low = along.new_full((n,), torch.inf).scatter_reduce(0, number, along, "amin")
        high = along.new_full((n,), -torch.inf).scatter_reduce(0, number, along, "amax")
        return low, high

    low, high = span(along, number)
    # Points next to corners are left out of long runs.
    bent = torch.where(runs.sums[:, 0] > 6 * _ROUNDED, float(_ROUNDED), 0.0)
    inner = (along >= (low + bent)[number]) & (along <= (high - bent)[number])
    sums = moments(x, number, n, inner)
    middle, direction, square = axis(sums)
    direction = turned(direction)
    normal = torch.stack((direction[:, 1], -direction[:, 0]), -1)
    count = sums[:, 0].clamp_min(1)
    scatter = (square / count).sqrt()
    across = (gradient * normal[number]).sum(-1)
    k = total(aligned(across, gradient).double())
    members = runs.sums[:, 0]
    # Further points of the chain, up to a corner, that lie on the line.
    low, high = span(((x - middle[number]) * direction[number]).sum(-1), number)
    for neighbour in (runs.before, runs.after):
        host = neighbour[number]
        larger = (members[host] > members[number]) & (host != number)
        away = ((x - middle[host]) * normal[host]).sum(-1).abs()
        slope = aligned((gradient * normal[host]).sum(-1), gradient)
        joins = larger & (away <= _BESIDE) & slope
        more = span(((x[joins] - middle[host[joins]]) * direction[host[joins]]).sum(-1), host[joins])
        near = float(3 * _ROUNDED)
        low = torch.where((more[0] < low) & (more[0] > low - near), more[0], low)
        high = torch.where((more[1] > high) & (more[1] < high + near), more[1], high)
    there = members > 0
    low, high = torch.where(there, low, 0.0), torch.where(there, high, 0.0)
    ends = middle[:, None] + torch.stack((low, high), -1)[..., None] * direction[:, None]
    noise = (total(sigma.square()) / members.clamp_min(1)).sqrt()
    a, b, aa, ab, bb = (v / count for v in sums[:, 1:].unbind(-1))
    u, v = direction.unbind(-1)
    spread = (u * u * (aa - a * a) + 2 * u * v * (ab - a * b) + v * v * (bb - b * b)).clamp_min(0).sqrt()
    half = spread[:, None] * direction
    return {
        "ends": ends,
        "support": torch.stack((middle - half, middle + half), -2),
        "line": torch.cat((normal, -(normal * middle).sum(-1, keepdim=True)), -1),
        "length": high - low,
        "count": members.long(),
        "scatter": scatter,
        "sigma": torch.maximum(scatter * (count / (count - 2).clamp_min(1)).sqrt(), noise),
        "independent": (count / tied).clamp_min(1.0),
        "contrast": total(across) / members.clamp_min(1),
        "log_nfa": log_tail(k, members),
    }
