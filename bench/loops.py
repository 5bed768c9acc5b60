"""A film around a block of houses: the drift of its end, and what is left of it where the loop closes.

    python -m bench.loops --frames 500 1000 2000 [--methods windows incremental global]

Simulated features: a camera goes around once, looks ahead and to the side, and comes back to where it started. Frames are
matched with those that follow; with `loops`, those at the end also with those at the beginning, which look alike. Points are
half a pixel off, one match of twenty is wrong, the focal length is first taken to be 3 % longer than it is. The table says how
far centres are off after the best similarity (root mean square and at the worst, in parts of a thousand of the way), and how
far the last frame is from where it should be if the first fifth of the frames is laid over the truth: the drift.
"""

import argparse
import math
import time
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsfm.geometry import Pose, similarity_from_points
from torchsfm.reconstruction import reconstruct_matches
from torchsfm.reconstruction.report import SfmResult

SIZE, FOCAL, GUESS = (640, 480), 500.0, 1.03
"""Of the images in pixels; the focal length, and how far off it is taken to be."""
STEP, WIDTH, NEAR, FAR = 0.5, 6.0, 1.5, 25.0
"""Metres from frame to frame, from the way to the walls, and to what is seen."""
SEEN, EACH = 0.8, 200
"""How often a point in sight is found, and about how many of each frame."""
OFF, WRONG = 0.5, 0.05
"""Errors in pixels; the part of matches that is wrong."""
ASIDE = math.radians(35)
"""How far from ahead the camera looks."""
FOLLOWING = (1, 2, 3, 4, 5, 6, 12)
"""With which of the next frames each is matched."""
ALIKE, RETURN = 4, 30
"""With how many of the frames at the other end, and how many frames are there for the second time."""


@dataclass(frozen=True)
class Film:
    """Features and matches of a film, and its truth."""

    x: list[Tensor]
    pairs: Tensor
    matches: list[Tensor]
    poses: Pose
    way: float


def circuit(s: Tensor, length: float) -> tuple[Tensor, Tensor]:
    """The place and direction of travel after so many metres around a block: a square whose corners are rounded."""
    side = length / (4 + 2 * math.pi / 3)  # a straight side, and corners a third of it in radius
    radius = side / 3
    leg = side + radius * math.pi / 2
    number, rest = (s / leg).floor(), s % leg
    turned = (rest - side).clamp(min=0) / radius
    place = torch.stack((rest.clamp(max=side) + radius * turned.sin(), radius * (1 - turned.cos())), -1)
    angle = number * math.pi / 2
    corner = torch.zeros(int(number.max()) + 1, 2, dtype=s.dtype)
    for k in range(len(corner) - 1):
        a = k * math.pi / 2
        forward, left = torch.tensor([math.cos(a), math.sin(a)]), torch.tensor([-math.sin(a), math.cos(a)])
        corner[k + 1] = corner[k] + (side + radius) * forward + radius * left
    R = torch.stack((torch.stack((angle.cos(), -angle.sin()), -1), torch.stack((angle.sin(), angle.cos()), -1)), -2)
    return corner[number.long()] + (R @ place[..., None])[..., 0], angle + turned


def film(frames: int, loops: bool, generator: torch.Generator) -> Film:
    """The film of so many frames."""
    way = STEP * (frames - RETURN)
    place, heading = circuit(STEP * torch.arange(frames, dtype=torch.float64), way)
    wobble = 0.05 * torch.randn(frames, generator=generator, dtype=torch.float64)
    centre = torch.cat((place, 0.1 * wobble[:, None]), -1)
    gaze = heading - ASIDE + wobble
    z = torch.stack((gaze.cos(), gaze.sin(), torch.zeros_like(gaze)), -1)
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand_as(z)
    R = torch.stack((torch.linalg.cross(down, z), down, z), -2)
    poses = Pose(R, -(R @ centre[..., None])[..., 0])
    # Points of both walls, so many a metre that each frame sees enough.
    count = int(EACH / SEEN * way / 12)
    s = way * torch.rand(count, generator=generator, dtype=torch.float64)
    base, along = circuit(s, way)
    side = torch.where(torch.rand(count, generator=generator) < 0.7, -1.0, 1.0) * WIDTH
    side = side * (1 + 0.3 * torch.rand(count, generator=generator, dtype=torch.float64))
    height = -1.5 + 6 * torch.rand(count, generator=generator, dtype=torch.float64)
    X = torch.cat((base + side[:, None] * torch.stack((-along.sin(), along.cos()), -1), height[:, None]), -1)
    x, points = [], []
    for i in range(frames):
        seen = poses[i].transform(X)
        at = FOCAL * seen[:, :2] / seen[:, 2:].clamp(min=1e-3) + torch.tensor(SIZE) / 2
        inside = (seen[:, 2] > NEAR) & (seen[:, 2] < FAR) & (at > 0).all(-1) & (at < torch.tensor(SIZE)).all(-1)
        inside &= torch.rand(count, generator=generator) < SEEN
        # What is on the far side of the block is hidden.
        points.append(inside.nonzero()[:, 0])
        x.append(at[inside] + OFF * torch.randn(len(points[-1]), 2, generator=generator, dtype=torch.float64))
    pairs = [(i, i + k) for i in range(frames) for k in FOLLOWING if i + k < frames]
    if loops:
        apart = torch.cdist(centre[:, :2], centre[:, :2]) + 5 * (1 - z @ z.T)
        i = torch.arange(frames)
        apart[(i[:, None] - i).abs() < frames // 2] = torch.inf
        near = apart.topk(ALIKE, largest=False)
        for a in range(frames):
            pairs += [(a, int(b)) for d, b in zip(near.values[a], near.indices[a], strict=True) if d < 2 and a < int(b)]
    number = torch.full((count,), -1)
    matches = []
    for a, b in pairs:
        number[points[b]] = torch.arange(len(points[b]))
        other = number[points[a]]
        number[points[b]] = -1
        both = torch.stack((torch.arange(len(other)), other), -1)[other >= 0]
        wrong = torch.rand(len(both), generator=generator) < WRONG
        some = torch.randint(0, max(len(points[b]), 1), (int(wrong.sum()),), generator=generator)
        both[wrong, 1] = some
        matches.append(both)
    return Film(x, torch.tensor(pairs), matches, poses, way)


def mapped(given: Film, method: str) -> tuple[SfmResult, float]:
    """The model, and the seconds of a processor core that it takes."""
    start = time.process_time()
    frames = len(given.x)
    size = torch.tensor(SIZE).expand(frames, 2)
    found = reconstruct_matches(given.x, given.pairs, given.matches, size, focal=GUESS * FOCAL, method=method)
    return found, time.process_time() - start


def off(model_centre: Tensor, truth: Tensor, way: float) -> tuple[float, float, float]:
    """Root mean square and largest distance after the best similarity, and the drift of the last; thousandths of the way."""
    apart = (similarity_from_points(model_centre, truth).transform(model_centre) - truth).norm(dim=-1)
    first = len(truth) // 5
    drift = (similarity_from_points(model_centre[:first], truth[:first]).transform(model_centre[-1:]) - truth[-1:]).norm()
    return tuple(1000 * float(d) / way for d in (apart.square().mean().sqrt(), apart.max(), drift))


def main(arguments: list[str] | None = None) -> None:
    """Print the table, a line as soon as it is known."""
    parser = argparse.ArgumentParser(prog="python -m bench.loops", description="How far a film around a block drifts.")
    parser.add_argument("--frames", type=int, nargs="+", default=[500, 1000, 2000])
    parser.add_argument("--methods", nargs="+", default=["incremental", "windows"])
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    print(
        "| frames | loop matched | method | registered | focal length / true | off, thousandths: RMS / largest | drift "
        "of the end | core-seconds |",
        "|---" * 8 + "|",
        sep="\n",
    )
    for frames in options.frames:
        for loops in (False, True):
            given = film(frames, loops, torch.Generator().manual_seed(0))
            for method in options.methods:
                result, seconds = mapped(given, method)
                model = result.models[0]
                centre, truth = model.poses.centre[model.registered], given.poses.centre[model.registered]
                rms, most, drift = off(centre, truth, given.way)
                focal = float(model.cameras.K[0, 0, 0]) / FOCAL
                cells = [
                    f"{frames}",
                    "yes" if loops else "no",
                    method,
                    f"{model.num_registered}/{frames}",
                    f"{focal:.4f}",
                    f"{rms:.2f} / {most:.2f}",
                    f"{drift:.2f}",
                    f"{seconds:.0f}",
                ]
                print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
