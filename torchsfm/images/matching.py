"""Which points of two images look alike."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from threading import Lock
from time import perf_counter

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from torchsfm._types import check_one_problem, check_options
from torchsfm.images.features import Features, check_features
from torchsfm.linalg.portions import portions

_ROWS = 128
"""Rows of one block of similarities: 128 x 8192 integers stay in a processor's cache through all that is done with them."""

_WHOLE = 1 << 24
"""Below that float32 holds every whole number, so that sums of products of bytes are exact."""

_LOCK = Lock()

_SPREAD = 0.02
"""Integer descriptors whose lengths differ by a larger share are made unit vectors, which is slower."""


def match_features(
    features: Sequence[Features],
    pairs: Int[Tensor, "p 2"],
    *,
    ratio: float = 0.8,
    mutual: bool = True,
    max_distance: float = 0.7,
    progress: Callable[[int], None] | None = None,
) -> list[Int[Tensor, "k 2"]]:
    """Match the descriptors of pairs of images.

    On a CPU as many pairs are matched at a time as PyTorch has threads (`torch.get_num_threads`), each by one thread; meanwhile
    operations started elsewhere in the program may run on one thread too.

    Args:
        features: The features of every image.
        pairs: Which images to compare, as indices into `features`.
        ratio: The best distance must be below this share of the second best (Lowe's test); 1 switches the test off.
        mutual: Keep a match only where each point is the other's best, so that no point is matched twice.
        max_distance: The largest angle between two descriptors that still makes a match, in radians.
        progress: Called with the number of pairs done.

    Returns:
        One tensor for each pair: rows (index in the first image, index in the second), sorted by the first. What a pair gets
        does not depend on the other pairs.

    Raises:
        ValueError: As `match_descriptors`; or a pair names an image that is not there.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> image = torch.nn.functional.avg_pool2d(torch.rand(1, 120, 160, generator=g), 5, stride=1, padding=2)
        >>> features = [torchsfm.detect_features(image), torchsfm.detect_features(image[..., 10:])]  # ten columns cut off
        >>> (match,) = torchsfm.match_features(features, torch.tensor([[0, 1]]))
        >>> shift = features[0].x[match[:, 0]] - features[1].x[match[:, 1]]
        >>> len(match) > 10, shift.median(0).values.round()
        (True, tensor([10.,  0.]))
    """
    _check(ratio, mutual, max_distance)
    check_features(features)
    check_one_problem(pairs=(pairs, "p 2: int"))
    if pairs.numel() and not 0 <= int(pairs.min()) <= int(pairs.max()) < len(features):
        raise ValueError(f"pairs: wanted indices from 0 to {len(features) - 1}, got {int(pairs.min())} to {int(pairs.max())}")
    ready = {i: _prepare(features[i].descriptors) for i in sorted(set(pairs.flatten().tolist()))}

    def work(pair: list[int]) -> Tensor:
        return _match(ready[pair[0]], ready[pair[1]], ratio, mutual, max_distance)

    found = []
    with _single_threads() as count, ThreadPoolExecutor(count) as pool:
        for matches in pool.map(work, pairs.tolist()):
            found.append(matches)
            if progress is not None:
                progress(len(found))
    return found


def match_descriptors(
    descriptors1: Shaped[Tensor, "n d"],
    descriptors2: Shaped[Tensor, "m d"],
    *,
    ratio: float = 0.8,
    mutual: bool = True,
    max_distance: float = 0.7,
) -> Int[Tensor, "k 2"]:
    """Match two sets of descriptors by the angle between them, all against all.

    Integer descriptors of values up to 127 (those of `detect_features`) are compared in exact integer arithmetic, so that the
    answer is the same on every machine.

    Args:
        descriptors1: One row for each point of the first image, integer or floating point, of any length but zero.
        descriptors2: The same for the second image.
        ratio: The best distance must be below this share of the second best (Lowe's test); 1 switches the test off.
        mutual: Keep a match only where each point is the other's best, so that no point is matched twice.
        max_distance: The largest angle that still makes a match, in radians.

    Returns:
        Rows (index in the first set, index in the second), sorted by the first.

    Raises:
        ValueError: Descriptors of two lengths or two precisions, or an option is wrong.

    Example:
        >>> import torch, torchsfm
        >>> d1 = torch.eye(5)
        >>> torchsfm.images.match_descriptors(d1, d1[[2, 0, 4]])
        tensor([[0, 1],
                [2, 0],
                [4, 2]])
    """
    _check(ratio, mutual, max_distance)
    for name, descriptors in (("descriptors1", descriptors1), ("descriptors2", descriptors2)):
        check_options(**{name: (descriptors, Tensor)})
        if descriptors.ndim != 2 or descriptors.is_complex():
            raise ValueError(f"{name}: wanted shape (n, d) of real numbers, got {tuple(descriptors.shape)} {descriptors.dtype}")
    kinds = [(d.shape[1], d.dtype if d.is_floating_point() else torch.float32, d.device) for d in (descriptors1, descriptors2)]
    if kinds[0] != kinds[1]:
        first, second = (f"{tuple(d.shape)} {d.dtype} {d.device}" for d in (descriptors1, descriptors2))
        raise ValueError(f"descriptors1, descriptors2: wanted one length, precision and device, got {first} and {second}")
    return _match(_prepare(descriptors1), _prepare(descriptors2), ratio, mutual, max_distance)


@contextmanager
def _single_threads() -> Iterator[int]:
    """Let threads begun inside run each operation by themselves; gives how many to begin.

    The blocks are small, and threads that wait for one another after each would spend most of their time on it, above all on a
    machine that has other work. The number of threads is a setting of the process: it is put back at the end.
    """
    with _LOCK:
        count = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            yield count
        finally:
            torch.set_num_threads(count)


def _check(ratio: float, mutual: bool, max_distance: float) -> None:
    check_options(ratio=(ratio, "float > 0"), mutual=(mutual, bool), max_distance=(max_distance, "0 < float <= 3.15 radians"))


def unit_descriptors(descriptors: Shaped[Tensor, "n d"]) -> Float[Tensor, "n d"]:
    """Descriptors as floating point vectors of length 1; those of length 0, or with NaN, as zeros."""
    values: Tensor = descriptors if descriptors.is_floating_point() else descriptors.float()
    values = values / values.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    return torch.where(values.isfinite().all(-1, keepdim=True), values, 0.0)


def _prepare(descriptors: Tensor) -> tuple[Tensor, Tensor]:
    """Descriptors as int8 with their norms, or as unit vectors with norms of one."""
    if descriptors.ndim != 2:
        raise ValueError(f"descriptors: wanted shape (n, d), got {tuple(descriptors.shape)}")
    if not descriptors.is_floating_point() and descriptors.numel():
        low, high = (int(v) for v in descriptors.aminmax())
        norm = descriptors.double().norm(dim=-1)
        # Products rank as angles do where all lengths are equal; zeros are nobody's best either way.
        shortest = torch.where(norm > 0, norm, torch.inf).min()
        if low >= -127 and high <= 127 and bool(norm.max() <= shortest * (1 + _SPREAD)):
            return descriptors.to(torch.int8), norm.clamp_min(1e-12)
    unit = unit_descriptors(descriptors)
    return unit, torch.ones(unit.shape[0], dtype=torch.float64, device=unit.device)


def _match(first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor], ratio: float, mutual: bool, limit: float) -> Tensor:
    if torch.int8 in (first[0].dtype, second[0].dtype) and first[0].dtype != second[0].dtype:
        first, second = (_prepare(unit_descriptors(d)) for d, _ in (first, second))
    (d1, norm1), (d2, norm2) = first, second
    if d1.shape[1] != d2.shape[1] or d1.dtype != d2.dtype:
        raise ValueError(f"descriptors2: wanted {d1.shape[1]} values of {d1.dtype}, got {d2.shape[1]} of {d2.dtype}")
    n, m = d1.shape[0], d2.shape[0]
    if n == 0 or m == 0:
        return torch.zeros(0, 2, dtype=torch.long, device=d1.device)
    value, index = _top_two(d1, d2)
    cosine = value.double() / (norm1[:, None] * norm2[index])
    angle = cosine.clamp(-1, 1).arccos()
    keep = angle[:, 0] <= limit
    if ratio < 1 and m > 1:
        keep &= angle[:, 0] < ratio * angle[:, 1]
    rows = keep.nonzero()[:, 0]
    best = index[rows, 0]
    if mutual and len(rows):
        # Few rows pass the tests above: looking back from their partners alone is cheaper than a maximum of every column.
        columns, where = torch.unique(best, return_inverse=True)
        back = _top_two(d2[columns], d1)[1][:, 0]
        keep = back[where] == rows
        rows, best = rows[keep], best[keep]
    return torch.stack([rows, best], 1)


def _top_two(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """The two largest products of each row of `a` with the rows of `b`, and which rows of `b` those are."""
    if a.dtype != torch.int8:
        return _top_two_float(a, b)
    # A product and the index of its column share one 32 bit number, so that a plain maximum finds both: several times faster
    # than a maximum with index. The number of columns that fit depends on the largest product, by Cauchy and Schwarz.
    bound = int(a.float().norm(dim=-1).max().item() * b.float().norm(dim=-1).max().item()) + 1
    bits = 30 - bound.bit_length()
    width = 1 << bits
    counter = torch.arange(width - 1, -1, -1, dtype=torch.int32, device=a.device)
    values, indices = [], []
    for left in range(0, b.shape[0], width):
        part = b[left : left + width]
        columns = part.shape[0]
        packed = torch.empty(a.shape[0], min(2, columns), dtype=torch.int32, device=a.device)
        for some in portions(a.shape[0], _ROWS, a.device):
            block = _products(a[some], part, bound)
            torch.add(counter[:columns], block, alpha=width, out=block)  # among equal products the first column is the largest
            top = block.amax(1)
            packed[some, 0] = top
            if columns > 1:
                block.scatter_(1, (width - 1 - (top & (width - 1))).long()[:, None], torch.iinfo(torch.int32).min)
                packed[some, 1] = block.amax(1)
        values.append(packed >> bits)
        indices.append(width - 1 - (packed & (width - 1)).long() + left)
    return _merge(values, indices)


def _top_two_float(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    width = 1 << 14
    values, indices = [], []
    for left in range(0, b.shape[0], width):
        part = b[left : left + width].mT
        value, index = [], []
        for some in portions(a.shape[0], _ROWS, a.device):
            block = a[some] @ part
            first, where = block.max(1, keepdim=True)
            value.append(first)
            index.append(where)
            if part.shape[1] > 1:
                second, where = block.scatter_(1, where, -torch.inf).max(1, keepdim=True)
                value[-1] = torch.cat([first, second], 1)
                index[-1] = torch.cat([index[-1], where], 1)
        values.append(torch.cat(value))
        indices.append(torch.cat(index) + left)
    return _merge(values, indices)


def _merge(values: list[Tensor], indices: list[Tensor]) -> tuple[Tensor, Tensor]:
    value, index = values[0], indices[0]
    if len(values) > 1:
        value, index = torch.cat(values, 1), torch.cat(indices, 1)
        value, order = value.sort(dim=1, descending=True, stable=True)
        value, index = value[:, :2], index.gather(1, order[:, :2])
    return value, index


def _products(a: Tensor, b: Tensor, bound: int) -> Tensor:
    """Products of rows of bytes, none of which is larger than the bound.

    PyTorch has no public product of bytes that is exact. Its private one makes matching 4 to 5 times as fast; a version without
    it gives the same answers, more slowly.
    """
    if a.device.type == "cpu" and _bytes_pay():
        return torch._int_mm(a, b.mT)
    exact = torch.float32 if bound < _WHOLE else torch.float64
    return (a.to(exact) @ b.to(exact).mT).to(torch.int32)


@cache
def _bytes_pay() -> bool:
    """Whether this processor multiplies bytes exactly (those without VNNI may saturate) and faster than floats.

    Both ways give the same integers, so that the choice never shows in an answer.
    """
    a = torch.full((_ROWS, 128), 127, dtype=torch.int8)
    a[::2, ::2] = -127
    b = a.repeat(16, 1).mT

    def fastest(product: Callable[[], Tensor]) -> float:
        seconds = []
        for _ in range(4):
            start = perf_counter()
            product()
            seconds.append(perf_counter() - start)
        return min(seconds)

    try:
        exact = bool((torch._int_mm(a, b) == a.float() @ b.float()).all())
        return exact and fastest(lambda: torch._int_mm(a, b)) < fastest(lambda: a.float() @ b.float())
    except (AttributeError, RuntimeError):
        return False
