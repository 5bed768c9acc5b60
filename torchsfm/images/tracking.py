"""The same points through a sequence of images."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from torchsfm._types import broadcast_shapes, check_one_problem, check_options, check_tensors
from torchsfm.images.alignment import align, cut_templates
from torchsfm.images.corners import box_maximum, detect_corners, to_gray
from torchsfm.images.reading import Photograph, pixels_of
from torchsfm.linalg.devices import on_the_cpu


@dataclass(frozen=True)
class TrackedPoints:
    """Where points of one image are in another.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> image = torch.nn.functional.avg_pool2d(torch.rand(1, 120, 160, generator=g), 5, stride=1, padding=2)
        >>> moved = image.roll(3, -1)
        >>> moved[:, 40:60, 30:60] = 0.5  # something hides the second point
        >>> found = torchsfm.track_points(image, moved, torch.tensor([[80.0, 80.0], [40.0, 50.0]]))
        >>> found.valid, found.x[0].round(), found.error.shape
        (tensor([ True, False]), tensor([83., 80.]), torch.Size([2]))
    """

    x: Float[Tensor, "*batch n 2"]
    """Pixel positions in the second image; where not valid, finite without meaning."""
    valid: Bool[Tensor, "*batch n"]
    """Which points were found again."""
    error: Float[Tensor, "*batch n"]
    """Distance in pixels between the point and what tracking its image back gives; 0 where not valid."""


@dataclass(frozen=True)
class Tracks:
    """Points followed through frames: one row for each sighting, sorted by track, then frame.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> image = torch.nn.functional.avg_pool2d(torch.rand(1, 120, 160, generator=g), 5, stride=1, padding=2)
        >>> tracks = torchsfm.track_sequence([image.roll(3 * i, -1) for i in range(4)], max_points=50)
        >>> longest = tracks.track.bincount().argmax()
        >>> path = tracks.x[tracks.track == longest]
        >>> len(path), path.diff(dim=0).round()[0]  # in all four frames, three columns in each step
        (4, tensor([3., 0.]))
    """

    frame: Int[Tensor, " m"]
    track: Int[Tensor, " m"]
    """Numbers from 0 without gaps, in the order in which the tracks begin."""
    x: Float[Tensor, "m 2"]
    """Pixel positions."""

    def __len__(self) -> int:
        """The number of tracks."""
        return int(self.track[-1]) + 1 if self.track.numel() else 0


@on_the_cpu
def track_points(
    image1: Float[Tensor, "*#batch c h w"],
    image2: Float[Tensor, "*#batch c h w"],
    x1: Float[Tensor, "*#batch n 2"],
    *,
    guess: Float[Tensor, "*#batch n 2"] | None = None,
    window: int = 15,
    levels: int = 4,
    max_error: float = 0.5,
) -> TrackedPoints:
    """Follow points from one image to another (Lucas and Kanade 1981, in a pyramid as Bouguet 2001 has it).

    Each point is tracked to the second image and back (Kalal et al., ICPR 2010); it is valid where it returns to itself. The
    tracking is OpenCV's, on the CPU and without derivatives: some thirty times faster than the same in tensor operations.

    Args:
        image1: Images, grey or red, green, blue, values in [0, 1].
        image2: Images of the same size.
        x1: Pixel positions in `image1`.
        guess: Where the points may be in `image2`, a few pixels off at most at the coarsest level; `x1` where not given.
        window: Side of the square that is compared, in pixels.
        levels: Height of the pyramid; a motion of some `window / 2 * 2 ** (levels - 1)` pixels can be followed.
        max_error: Largest distance in pixels between a point and its way there and back.

    Returns:
        The points in `image2`. Points that are not finite, outside the image or lost are not valid.

    Raises:
        ValueError: A shape or an option is wrong.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> image = torch.nn.functional.avg_pool2d(torch.rand(1, 120, 160, generator=g), 5, stride=1, padding=2)
        >>> x = torch.tensor([[80.0, 60.0], [40.0, 50.0]])
        >>> found = torchsfm.track_points(image, image.roll(3, -1), x)  # all moved by three columns
        >>> found.x[found.valid].round()
        tensor([[83., 60.],
                [43., 50.]])
    """
    places = check_tensors(x1=(x1, "n 2"), guess=(guess, "?n 2"))
    pictures = check_tensors(image1=(image1, "c h>=1 w>=1"), image2=(image2, "c h w"))
    if x1.device != image1.device:
        raise ValueError(f"x1: wanted device {image1.device} as image1 has, got {x1.device}")
    try:
        batch = broadcast_shapes(pictures, places)
    except ValueError:
        raise ValueError(f"x1, guess: wanted batch dimensions {tuple(pictures)} of the images, got {tuple(places)}") from None
    _check_tracking(window, levels, max_error)
    start = x1 if guess is None else guess
    n, count = x1.shape[-2], batch.numel()
    first, second = (_bytes(to_gray(i)).expand(*batch, *i.shape[-2:]).reshape(count, *i.shape[-2:]) for i in (image1, image2))
    points, starts = (p.expand(*batch, n, 2).reshape(count, n, 2) for p in (x1, start))
    results = [
        _there_and_back(a.numpy(), b.numpy(), p, s, window, levels)
        for a, b, p, s in zip(first, second, points, starts, strict=True)
    ]
    x = torch.stack([r[0] for r in results]) if results else points
    error = torch.stack([r[1] for r in results]) if results else points[..., 0]
    x, error = x.reshape(*batch, n, 2).to(x1), error.reshape(*batch, n).to(x1)
    valid = error <= max_error
    return TrackedPoints(x, valid, torch.where(valid, error, 0.0))


def _check_tracking(window: int, levels: int, max_error: float) -> None:
    check_options(window=(window, "int >= 3"), levels=(levels, "int >= 1"), max_error=(max_error, "float >= 0"))


@on_the_cpu
def track_sequence(
    images: Iterable[Photograph | Float[Tensor, "c h w"]],
    *,
    max_points: int = 2000,
    min_distance: int = 5,
    quality: float = 0.005,
    window: int = 15,
    levels: int = 4,
    max_error: float = 0.5,
    min_similarity: float = 0.8,
    min_survival: float = 0.1,
    min_length: int = 3,
    progress: Callable[[int], None] | None = None,
) -> Tracks:
    """Follow corners through the frames of a video, a turntable or a walk around.

    From frame to frame points are followed by `track_points`, starting from where their last motion would bring them where that
    looks better. Then each is aligned, by an affine warp with gain and offset, to what it looked like where it was first seen,
    so that errors do not add up (Shi and Tomasi, CVPR 1994; Matthews et al., PAMI 2004). Where the look has changed too much
    for that, but not from the last frame to this, the look in this frame takes the place of the first. Lost points are replaced
    by new corners where there are none.

    Args:
        images: Frames in order, all of the same size; read one by one, so that a generator keeps memory small.
        max_points: How many points are followed at a time.
        min_distance: New corners keep this many pixels from points that are being followed, and from one another.
        quality: Smallest response of a new corner, as a share of the strongest in its frame.
        window: Side of the square that is compared, in pixels.
        levels: Height of the pyramid for `track_points`.
        max_error: Largest distance in pixels between a point and its way there and back.
        min_similarity: Smallest correlation between a point's look now and the one it is compared with, in [0, 1].
        min_survival: Where a smaller share of the points is found again, the frame is taken for a cut and all tracks end.
        min_length: Shorter tracks are left out.
        progress: Called with the number of frames done.

    Returns:
        The tracks, on the CPU; always the same for the same frames.

    Raises:
        ValueError: Frames of different sizes, or an option is wrong.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> image = torch.nn.functional.avg_pool2d(torch.rand(1, 120, 160, generator=g), 5, stride=1, padding=2)
        >>> tracks = torchsfm.track_sequence([image.roll(3 * i, -1) for i in range(4)], max_points=50)
        >>> len(tracks) > 10, tracks.frame.max()
        (True, tensor(3))
    """
    check_options(
        images=(images, Iterable), max_points=(max_points, "int >= 1"), min_distance=(min_distance, "int >= 1"),
        quality=(quality, "float >= 0"), min_similarity=(min_similarity, "float"), min_survival=(min_survival, "float"),
        min_length=(min_length, "int >= 1"),
    )  # fmt: skip
    _check_tracking(window, levels, max_error)
    follower: _Follower | None = None
    for number, image in enumerate(images):
        pixels = pixels_of(image)
        check_one_problem(images=(pixels, "c h>=1 w>=1"))
        gray = to_gray(pixels.detach().to("cpu", torch.float32))[0]
        if follower is None:
            follower = _Follower(
                gray, max_points, min_distance, quality, window, levels, max_error, min_similarity, min_survival
            )
        elif gray.shape != follower.gray.shape:
            raise ValueError(f"images: frame {number} has size {tuple(gray.shape)}, the first {tuple(follower.gray.shape)}")
        else:
            follower.follow(number, gray)
        follower.replenish(number)
        if progress is not None:
            progress(number + 1)
    if follower is None:
        return Tracks(
            torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.long), torch.zeros(0, 2, dtype=torch.float32)
        )
    return follower.tracks(min_length)


class _Follower:
    """The points being followed, and the sightings so far."""

    def __init__(
        self,
        gray: Tensor,
        max_points: int,
        min_distance: int,
        quality: float,
        window: int,
        levels: int,
        max_error: float,
        min_similarity: float,
        min_survival: float,
    ) -> None:
        self.max_points, self.min_distance, self.quality = max_points, min_distance, quality
        self.window, self.levels, self.max_error = window, levels, max_error
        self.min_similarity, self.min_survival = min_similarity, min_survival
        self.radius = window // 2
        self.gray = gray
        self.bytes = _bytes(gray).numpy()
        self.x = torch.zeros(0, 2, dtype=torch.float32)
        self.motion = torch.zeros_like(self.x)
        self.track = torch.zeros(0, dtype=torch.long)
        self.template = cut_templates(gray, self.x, self.radius)
        self.begun = 0
        self.sightings: list[tuple[Tensor, Tensor, Tensor]] = []

    def follow(self, frame: int, gray: Tensor) -> None:
        image = _bytes(gray).numpy()
        arguments = (self.bytes, image, self.x)
        x, error = _there_and_back(*arguments, self.x, self.window, self.levels)
        guessed, guessed_error = _there_and_back(*arguments, self.x + self.motion, self.window, self.levels)
        last = cut_templates(self.gray, self.x, self.radius)
        # Two answers may differ where a texture repeats; the one that looks more like the point is taken.
        alike, guessed_alike = (align(gray, last, p, rounds=0).similarity for p in (x, guessed))
        better = (guessed_error <= self.max_error) & ((error > self.max_error) | (guessed_alike > alike))
        x = torch.where(better[:, None], guessed, x)
        error, alike = torch.where(better, guessed_error, error), torch.where(better, guessed_alike, alike)
        found = (error <= self.max_error) & (alike >= self.min_similarity)
        found &= found.sum() >= self.min_survival * len(found)
        kept = found.nonzero()[:, 0]
        x, motion, template = x[kept], x[kept] - self.x[kept], self.template[kept]
        aligned = align(gray, template, x)
        same = aligned.valid & (aligned.similarity >= self.min_similarity) & ((aligned.x - x).norm(dim=-1) <= 2.0)
        x = torch.where(same[:, None], aligned.x, x)
        self.template = template.turned(aligned.warp).replaced(~same, cut_templates(gray, x[~same], self.radius))
        self.gray, self.bytes, self.x, self.motion, self.track = gray, image, x, motion, self.track[kept]
        self.sightings.append((torch.full_like(self.track, frame), self.track, x))

    def replenish(self, frame: int) -> None:
        wanted = self.max_points - len(self.x)
        if wanted <= 0:
            return
        taken = torch.zeros_like(self.gray)
        place = self.x.round().long()
        taken[place[:, 1].clamp(0, taken.shape[0] - 1), place[:, 0].clamp(0, taken.shape[1] - 1)] = 1
        free = box_maximum(taken, self.min_distance) == 0
        border = self.radius + 2
        corners = detect_corners(
            self.gray[None], wanted, quality=self.quality, min_distance=self.min_distance, border=border, mask=free
        )
        x = corners.x[corners.valid]
        track = torch.arange(self.begun, self.begun + len(x))
        self.begun += len(x)
        self.x, self.track = torch.cat([self.x, x]), torch.cat([self.track, track])
        self.motion = torch.cat([self.motion, torch.zeros_like(x)])
        self.template = self.template.join(cut_templates(self.gray, x, self.radius))
        self.sightings.append((torch.full_like(track, frame), track, x))

    def tracks(self, min_length: int) -> Tracks:
        frame, track, x = (torch.cat(parts) for parts in zip(*self.sightings, strict=True))
        long = torch.bincount(track, minlength=self.begun) >= min_length
        number = torch.cumsum(long, 0) - 1
        keep = long[track]
        frame, track, x = frame[keep], number[track[keep]], x[keep]
        order = torch.argsort(track, stable=True)
        return Tracks(frame[order], track[order], x[order])


def _bytes(gray: Tensor) -> Tensor:
    values = gray.detach().to("cpu", torch.float32).nan_to_num().clamp(0, 1).mul(255).round_().to(torch.uint8)
    return values.reshape(*values.shape[:-3], *values.shape[-2:]) if values.ndim > 2 else values


def _there_and_back(
    first: NDArray[np.uint8], second: NDArray[np.uint8], x: Tensor, start: Tensor, window: int, levels: int
) -> tuple[Tensor, Tensor]:
    """Positions (n, 2) and the distance after the way back, infinite where lost."""
    import cv2

    height, width = first.shape
    inside = (x.isfinite() & start.isfinite()).all(-1) & (x >= 0).all(-1) & (x[:, 0] <= width - 1) & (x[:, 1] <= height - 1)
    index = inside.nonzero()[:, 0]
    out, error = torch.where(x.isfinite(), x, 0.0).float(), torch.full(x.shape[:1], torch.inf, dtype=torch.float32)
    if len(index) == 0:
        return out, error
    p1, p2 = (p.detach().to("cpu", torch.float32)[index.cpu()].numpy()[:, None] for p in (x, start))
    side, top = (window, window), levels - 1
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 0.005)
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        first, second, p1, p2.copy(), winSize=side, maxLevel=top, criteria=stop, flags=flags
    )
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(
        second, first, moved, moved + p1 - p2, winSize=side, maxLevel=top, criteria=stop, flags=flags
    )
    distance = np.linalg.norm(back - p1, axis=2)[:, 0]
    inside_second = (moved >= 0).all((1, 2)) & (moved[:, 0, 0] <= width - 1) & (moved[:, 0, 1] <= height - 1)
    good = (found[:, 0] == 1) & (found_back[:, 0] == 1) & inside_second & np.isfinite(distance)
    error[index.cpu()] = torch.from_numpy(np.where(good, distance, np.inf)).float()
    out[index.cpu()] = torch.from_numpy(np.where(good[:, None], moved[:, 0], p1[:, 0])).float()
    return out, error
