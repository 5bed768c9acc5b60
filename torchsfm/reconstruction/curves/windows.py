"""What few neighbouring frames at a time say of their cameras, by themselves."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchsfm.bundle import RelativePosePrior
from torchsfm.geometry import Curve, Pose, rotation_angle
from torchsfm.images import Edges, track_curves
from torchsfm.optim import GemanMcClure
from torchsfm.reconstruction.curves.frames import Frames
from torchsfm.reconstruction.curves.image_edges import ImageEdges
from torchsfm.reconstruction.curves.start import APART, FirstCameras, first_cameras
from torchsfm.reconstruction.messages import Progress
from torchsfm.reconstruction.model.similarities import DEVIATION

WIDTH = 5
"""Frames of a window."""
_NEXT = 2
"""Frames from one window to the next."""
_LENGTH = 30.0
"""Shortest curves that are followed, in pixels."""
_CURVES = 100
"""Most of them."""
_LINKED = 2.0
"""Pixels between the ends of a closed chain, the most."""
_SURE = 0.02
"""Standard deviation of a focal length, as a part of it, that is given to windows, and the least that they tell."""
_SURE_TURN = 0.3
"""Degrees, the least, to which windows tell how cameras are turned: what misleads one misleads those that overlap it."""
_WRONG = 4.0
"""Standard deviations by which what a window says may be off and still count."""
_TELLING = 6
"""Curves that a frame must show: a camera is six numbers, and one may be wrong with a curve as a whole,"""
_LEAST = 3
"""and frames that show so many, of a window."""
ONE_TURN = 1.0
"""Degrees by which rotations from one window to another may differ, from one shared frame to the other."""


@dataclass(frozen=True)
class Window:
    """A few consecutive frames, and what their curves say of the cameras."""

    views: Int[Tensor, "w"]
    found: FirstCameras
    reference: int | None = None
    """Rank of the frame whose camera is the world; that of the middle one if not given."""

    @property
    def middle(self) -> int:
        """The frame whose camera is the world."""
        return int(self.views[len(self.views) // 2 if self.reference is None else self.reference])


def window_at(frames: Frames, first: int, K: Float[Tensor, "3 3"], sigma: float = _SURE, begun: Window | None = None) -> Window:
    """Cameras of a few frames by what is followed through them.

    Args:
        frames: Those of the sequence.
        first: The first frame that is looked at.
        K: Calibration to expect; the focal length is found,
        sigma: known to such a part of it.
        begun: The same frames' cameras, from which alone it is begun, as they are with another focal length.
    """
    views = torch.arange(first, min(first + WIDTH, len(frames.edges)))
    motion = frames.motion[first : first + len(views) - 1] if frames.motion else None
    edges = as_edges([frames.edges[i] for i in views.tolist()])
    tracked = track_curves(edges, min_length=_LENGTH, max_curves=_CURVES, motion=motion).curves
    curves = Curve(tracked.x.double(), tracked.valid, tracked.closed)
    low, high = telling(curves.valid.any(-1).sum(1).tolist())
    views, own, reference = views[low:high], slice(low, high), len(views) // 2 - low
    curves = Curve(curves.x[own], curves.valid[own], curves.closed[own])
    starts = frames.starts(views) if begun is None else begun.found.poses.R[None]
    found = first_cameras(curves, reference, K[0, 0], K[:2, 2], sigma, starts, alone=begun is not None)
    return Window(views, found, reference)


def telling(shown: Sequence[int]) -> tuple[int, int]:
    """The first of the frames, and the one after the last, that show curves enough to tell where their cameras are."""
    low = high = len(shown) // 2
    while low > 0 and shown[low - 1] >= _TELLING:
        low -= 1
    while high + 1 < len(shown) and shown[high + 1] >= _TELLING:
        high += 1
    return (low, high + 1) if high - low + 1 >= _LEAST else (0, len(shown))


def all_windows(frames: Frames, K: Float[Tensor, "3 3"], sigma: float, progress: Progress) -> list[Window]:
    """Windows that overlap from end to end; next to those that tell nothing, or of fewer frames, there are two more.

    Args:
        frames: Those of the sequence.
        K: Calibration to expect.
        sigma: Standard deviation of its focal length, as a part of it.
        progress: Called as the work goes on.
    """
    found = dict[int, Window]()

    def add(firsts: Iterable[int]) -> None:
        waiting = sorted({*firsts} - found.keys())
        for k, first in enumerate(waiting):
            progress("follow", k, len(waiting))
            found[first] = window_at(frames, first, K, sigma)
        progress("follow", len(waiting), len(waiting))

    add(_firsts(frames, _NEXT))
    last = _firsts(frames, 1)[-1]
    short = [k for k, one in found.items() if one.found.refusal or len(one.views) < min(WIDTH, len(frames.edges))]
    add(first + step for first in short for step in (-1, 1) if 0 <= first + step <= last)
    return [found[first] for first in sorted(found)]


def with_one_focal(frames: Frames, windows: Sequence[Window], K: Float[Tensor, "3 3"], progress: Progress) -> list[Window]:
    """The windows with about the focal length that all have in common; each stays as it is where it ends in another motion.

    Turns, translations and depths go with the focal length that a window has found: with another one they are wrong together,
    and a model that is begun so can end in another minimum.
    """
    alike, before = [], min(WIDTH, len(frames.edges)) // 2
    for k, window in enumerate(windows):
        progress("follow", k, len(windows))
        anew = window_at(frames, window.middle - before, K, begun=window)
        apart = rotation_angle(anew.found.poses.R @ window.found.poses.R.mT).rad2deg().amax()
        alike.append(anew if not anew.found.refusal and apart < APART else window)
    progress("follow", len(windows), len(windows))
    return alike


def windows_by_themselves(frames: Frames, K: Float[Tensor, "3 3"]) -> list[Window]:
    """Windows from end to end, each sharing its last frame with the next, with a focal length that is known."""
    return [window_at(frames, first, K) for first in _firsts(frames, WIDTH - 1)]


def _firsts(frames: Frames, step: int) -> list[int]:
    """First frames of windows, so many frames apart, up to the end."""
    last = max(len(frames.edges) - WIDTH, 0)
    return sorted({*range(0, last + 1, step), last})


def focal_of(windows: Sequence[Window]) -> tuple[Float[Tensor, ""], float]:
    """The focal length that windows agree on, and its standard deviation as a part of it."""
    focal = torch.stack([window.found.focal for window in windows])
    middle = focal.quantile(0.5)
    # Windows that overlap are not independent.
    number = len(focal) * min(1.0, _NEXT / WIDTH) if len(focal) > 1 else 1
    scatter = DEVIATION * float((focal / middle).log().abs().median())
    return middle, max(_SURE, scatter / math.sqrt(number))


def turns_of(windows: Sequence[Window]) -> RelativePosePrior:
    """How cameras are turned against the one in the middle of their window, as precise as windows that overlap agree on it."""
    pairs, turns = [], []
    for window in windows:
        R = window.found.poses.R
        middle = int((window.views == window.middle).nonzero()[0, 0])
        others = [k for k in range(len(R)) if k != middle]
        pairs += [(window.middle, int(window.views[k])) for k in others]
        turns += [R[k] @ R[middle].mT for k in others]
    off = [
        r for k, window in enumerate(windows) for before in windows[max(k - WIDTH, 0) : k] for r in _differences(window, before)
    ]
    # The median of the length of three normal numbers, and of two windows.
    sigma = float(torch.tensor(off).median()) / (1.54 * math.sqrt(2)) if off else math.inf
    sigma = min(max(sigma, math.radians(_SURE_TURN)), math.radians(ONE_TURN))
    R = torch.stack(turns)
    known = Pose(R, R.new_zeros(len(R), 3))
    return RelativePosePrior(torch.tensor(pairs), known, R.new_tensor([sigma] * 3 + [math.inf] * 3), loss=GemanMcClure(_WRONG))


def _differences(window: Window, before: Window) -> list[float]:
    """Angles between what two windows say of how the frames that both have are turned from one to the next."""
    a, b = shared_poses(window, before)
    return rotation_angle((a.R[1:] @ a.R[:-1].mT) @ (b.R[1:] @ b.R[:-1].mT).mT).tolist()


def shared_poses(window: Window, before: Window) -> tuple[Pose, Pose]:
    """The frames that two windows share, as each sees them."""
    own, other = torch.isin(window.views, before.views), torch.isin(before.views, window.views)
    return window.found.poses[own], before.found.poses[other]


def contradictions(windows: Iterable[Window], poses: Pose, registered: Bool[Tensor, "v"]) -> Float[Tensor, "v"]:
    """Degrees by which windows see cameras turned otherwise than a model has them; infinite for frames that none tells of."""
    apart = torch.full_like(poses.t[:, 0], torch.inf)
    for window in windows:
        views = window.views
        if window.found.refusal or not bool(registered[views].all()):
            continue
        R = poses.R[views]
        middle = poses.R[window.middle]
        off = rotation_angle(window.found.poses.R @ (R @ middle.mT).mT).rad2deg().amax()
        before = apart[views]
        apart[views] = torch.where(before.isfinite(), torch.maximum(before, off), off)
    return apart


def as_edges(found: Sequence[ImageEdges]) -> Edges:
    """The edges of frames as `track_curves` takes them."""
    n = max(1, *(len(own) for own in found))

    def slots(rows: Iterable[Tensor], empty: int = 0) -> Tensor:
        return torch.stack([torch.cat((r, r.new_full((n - len(r), *r.shape[1:]), empty))) for r in rows])

    x, normal, sigma, curvature = (slots(getattr(own, name) for own in found) for name in ("x", "normal", "sigma", "curvature"))
    chain, closed = slots((own.chain for own in found), -1), slots(_closed(own) for own in found)
    none = sigma.new_zeros(len(found))
    return Edges(x, -normal, sigma, torch.zeros_like(sigma), curvature, chain, closed, chain >= 0, none, none.long())


def _closed(own: ImageEdges) -> Bool[Tensor, "n"]:
    """Whether each edge point's chain ends next to where it begins."""
    if not len(own):
        return own.chain > 0
    _, index, number = torch.unique_consecutive(own.chain, return_inverse=True, return_counts=True)
    last = number.cumsum(0) - 1
    gap = torch.linalg.vector_norm(own.x[last] - own.x[last - number + 1], dim=-1)
    closed: Tensor = (gap < _LINKED) & (number > 2 * _LINKED)
    return closed[index]
