"""Which segment of one image is which of another? By what is beside them, and by the epipolar geometry where it is known."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchsfm._types import check_options, check_tensors
from torchsfm.images.corners import to_gray
from torchsfm.images.segments import Segments

_ALONG = 24
"""Samples along a segment."""
_REACH = 10
"""Pixels to each side that are looked at."""


def describe_segments(image: Float[Tensor, "c h w"], ends: Float[Tensor, "n 2 2"]) -> Float[Tensor, "n d"]:
    """What is beside segments, as vectors of length 1 (mean-standard deviation descriptors, Wang, Wu and Hu 2009).

    Gradients across and along the segment, sampled on a grid beside it, give for each distance from it their mean and their
    standard deviation along it. The direction from the first end to the second counts; length and contrast do not.

    Args:
        image: A grey (c = 1) or red, green, blue image.
        ends: End points of its segments, in pixels.

    Returns:
        Descriptors; zero where the image does not change.

    Raises:
        ValueError: A shape is wrong.

    Example:
        >>> import torch, torchsfm
        >>> image = torch.zeros(1, 60, 80)
        >>> image[:, 20:40, 30:60] = 1.0  # a rectangle
        >>> d = torchsfm.images.describe_segments(image, torchsfm.detect_segments(image, 4).ends)
        >>> d.norm(dim=-1)
        tensor([1.0000, 1.0000, 1.0000, 1.0000])
    """
    check_tensors(image=(image, "c h>=8 w>=8"), ends=(ends, "n 2 2"))
    gray = to_gray(image)
    height, width = gray.shape[-2:]
    share = (torch.arange(_ALONG, device=image.device, dtype=image.dtype) + 0.5) / _ALONG
    across = torch.arange(-_REACH - 1, _REACH + 2, device=image.device, dtype=image.dtype)
    d = ends[:, 1] - ends[:, 0]
    length = d.square().sum(-1, keepdim=True).sqrt().clamp_min(1e-6)
    normal = torch.stack((d[:, 1], -d[:, 0]), -1) / length
    x = ends[:, 0, None, None] + share[:, None, None] * d[:, None, None] + across[:, None] * normal[:, None, None]
    scale = torch.tensor([width - 1, height - 1], device=image.device, dtype=image.dtype)
    values = torch.nn.functional.grid_sample(
        gray[None], (2 * x / scale - 1).flatten(0, 1)[None], mode="bilinear", padding_mode="border", align_corners=True
    )[0, 0].reshape(len(ends), _ALONG, len(across))
    over = 0.5 * (values[..., 2:] - values[..., :-2])
    step = (length / _ALONG)[..., None]
    ahead = (values[:, 1:, 1:-1] - values[:, :-1, 1:-1]) / step
    # Rows farther away say less.
    weight = torch.exp(-0.5 * (across[1:-1] / (0.6 * _REACH)).square())
    parts = [v for g in (over, ahead) for v in (g.mean(1) * weight, (g.var(1, correction=0) + 1e-20).sqrt() * weight)]
    means, spreads = torch.cat(parts[::2], -1), torch.cat(parts[1::2], -1)
    both = torch.cat([v / v.square().sum(-1, keepdim=True).sqrt().clamp_min(1e-6) for v in (means, spreads)], -1)
    # Of an exact image the one or the other may be rounding alone.
    size = both.square().sum(-1, keepdim=True).sqrt()
    return torch.where(both.isfinite().all(-1, keepdim=True) & (size > 0.5), both / size, 0.0)


def match_segments(
    segments1: Segments,
    segments2: Segments,
    image1: Float[Tensor, "c h w"],
    image2: Float[Tensor, "c h2 w2"],
    *,
    F: Float[Tensor, "3 3"] | None = None,
    min_overlap: float = 0.3,
    min_similarity: float = 0.8,
    ratio: float = 0.9,
) -> tuple[Int[Tensor, "m 2"], Float[Tensor, " m"]]:
    """Pairs of segments of two images that look alike beside them and are each other's best.

    Args:
        segments1: Of the first image, without batch dimensions.
        segments2: Of the second.
        image1: The first image.
        image2: The second.
        F: The fundamental matrix, `x2' F x1 = 0`. Where it is given, segments must overlap along the line in the second image
            as the epipolar lines of the first one's ends cut it.
        min_overlap: Shortest common part, over the part that both cover together.
        min_similarity: Smallest cosine of the descriptors.
        ratio: Largest distance of the descriptors over that of the second best.

    Returns:
        Slots in `segments1` and `segments2`, and the similarity of each pair, in the order of the first slots.

    Raises:
        ValueError: A shape or an option is wrong.

    Example:
        >>> import torch, torchsfm
        >>> image = torch.zeros(1, 60, 80)
        >>> image[:, 20:40, 30:60] = torch.linspace(0.3, 1.0, 30)  # a rectangle, brighter to the right
        >>> segments, moved = torchsfm.detect_segments(image, 4), torchsfm.detect_segments(image.roll(5, -1), 4)
        >>> pairs, similarity = torchsfm.match_segments(segments, moved, image, image.roll(5, -1))
        >>> shift = moved.ends[pairs[:, 1]] - segments.ends[pairs[:, 0]]
        >>> len(pairs) >= 2, shift.mean((0, 1)).round()
        (True, tensor([5., 0.]))
    """
    check_options(
        segments1=(segments1, Segments), segments2=(segments2, Segments), min_overlap=(min_overlap, "0 <= float <= 1"),
        min_similarity=(min_similarity, "-1 <= float <= 1"), ratio=(ratio, "0 < float <= 1"),
    )  # fmt: skip
    check_tensors(image1=(image1, "c h>=8 w>=8"), image2=(image2, "c h2>=8 w2>=8"), F=(F, "?3 3"))
    for name, segments in (("segments1", segments1), ("segments2", segments2)):
        if segments.valid.ndim != 1:
            raise ValueError(f"{name}: wanted segments of one image, got batch dimensions {tuple(segments.valid.shape[:-1])}")
    if F is not None and F.ndim != 2:
        raise ValueError(f"F: wanted one matrix (3, 3), got batch dimensions {tuple(F.shape[:-2])}")
    for name, image in (("image1", image1), ("image2", image2)):
        if image.ndim != 3:
            raise ValueError(f"{name}: wanted one image (c, h, w), got batch dimensions {tuple(image.shape[:-3])}")
    pairs = segments1.valid[:, None] & segments2.valid
    similarity = describe_segments(image1, segments1.ends) @ describe_segments(image2, segments2.ends).mT
    if F is not None:
        pairs = pairs & (epipolar_overlap(segments1.ends, segments2.ends, F) >= min_overlap)
    similarity = torch.where(pairs, similarity, -2.0)
    if not similarity.numel():
        return torch.zeros(0, 2, dtype=torch.long, device=image1.device), similarity.new_zeros(0)
    best, there = similarity.max(1)
    back = similarity.argmax(0)
    own = torch.arange(len(best), device=best.device)
    others = similarity.scatter(1, there[:, None], -2.0)
    second = torch.maximum(others.amax(1), similarity.index_put((own, there), best.new_tensor(-2.0)).amax(0)[there])
    distinct = (1 - best).clamp_min(0) <= ratio**2 * (1 - second)
    keep = ((best >= min_similarity) & (back[there] == own) & distinct).nonzero()[:, 0]
    return torch.stack((keep, there[keep]), -1), best[keep]


def epipolar_overlap(
    ends1: Float[Tensor, "n 2 2"], ends2: Float[Tensor, "m 2 2"], F: Float[Tensor, "3 3"]
) -> Float[Tensor, "n m"]:
    """How much of a segment in image 2 is between the epipolar lines of the ends of one in image 1, over both together.

    Zero also for segments along epipolar lines, of which nothing can be said.
    """
    check_tensors(ends1=(ends1, "n 2 2"), ends2=(ends2, "m 2 2"), F=(F, "3 3"))
    h = torch.nn.functional.pad(ends1, (0, 1), value=1.0)
    epipolar = h @ F.mT
    normal, offset = epipolar[..., :2], epipolar[..., 2:]
    start, d = ends2[:, 0], ends2[:, 1] - ends2[:, 0]
    slope = normal @ d.mT
    size = normal.square().sum(-1, keepdim=True).sqrt() * d.square().sum(-1).sqrt()
    # Less than three degrees: where they meet is chance.
    steep = slope.abs() > 0.05 * size
    at = -(normal @ start.mT + offset) / torch.where(steep, slope, 1.0)
    low, high = at.amin(1), at.amax(1)
    common = (high.clamp_max(1) - low.clamp_min(0)).clamp_min(0)
    whole = high.clamp_min(1) - low.clamp_max(0)
    return torch.where(steep.all(1), common / whole, 0.0)
