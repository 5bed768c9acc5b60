"""Edges beside peers: places on steps, discs and bars that are known, whole outlines of drawn scenes, and pixels a second.

`python -m bench.edges` prints the tables; `pytest bench/edges.py` times `detect_edges` with pytest-benchmark. scikit-image and
`subpixel-edges` take part where they are installed. A pixel is the mean over its square of what a lens with a Gaussian blur
shows. Steps, discs and bars have a contrast of 0.8, and noise is given over the contrast. Errors are distances from the true
edge in pixels, of all points within 3 px of it; on discs and bars positive outwards.
"""

import argparse
import math
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from bench.edge_peers import Array, Detect, bound, canny, peers
from bench.edge_scenes import BLUR, DrawnScene, directions, disc, draw_scene, shown, step
from torchsfm import detect_edges, read_image, render_sequence

F64 = torch.float64
LOW, HIGH = 0.02, 0.06
"""Gradients that are asked for, per pixel, where the contrast is 0.8."""
NEAR = 3.0
PHOTOGRAPHS = ("images/fountain-P11/images/0005.jpg", "images/castle-P19/images/0000.jpg")


def ours(image: Tensor, low: float, high: float) -> Array:
    """Ours."""
    found = detect_edges(image, low=low, high=high)
    return found.x[found.valid].double().numpy()


def sharper(image: Tensor, low: float, high: float) -> Array:
    """Ours with the least smoothing that one may ask for."""
    found = detect_edges(image, low=low, high=high, blur=0.5)
    return found.x[found.valid].double().numpy()


def straight(image: Tensor, low: float, high: float) -> Array:
    """Ours where edges are said to be straight."""
    found = detect_edges(image, low=low, high=high, straight=True)
    return found.x[found.valid].double().numpy()


def methods() -> dict[str, Detect]:
    """Ours and what is installed of the others."""
    return {"detect_edges": ours, **{name: detect for name, detect in peers().items() if detect is not None}}


def spread(errors: Array) -> str:
    """Mean, root mean square and largest."""
    if not len(errors):
        return "no points"
    return f"{errors.mean():8.4f}  {np.sqrt(np.square(errors).mean()):7.4f}  {np.abs(errors).max():7.4f}  {len(errors):6}"


def steps(count: int, generator: torch.Generator) -> None:
    """Straight steps."""
    print(f"\n{count} straight steps all around, or along the axes\n blur  noise  {'':23}      mean      rms    worst  points")
    middle = np.array([31.5, 31.5])
    cases = [(blur, noise, False) for noise in (0.0, 0.02) for blur in (0.6, 1.0)]
    cases += [(0.6, 0.0, True), (0.6, 0.02, True), (0.3, 0.0, False), (0.01, 0.0, False)]
    for blur, noise, axes in cases:
        edges = directions(count, generator, axes)
        images = [shown(step(a, o, blur), noise, generator) for a, o in edges]
        way = "axes" if axes else "all"
        for name, detect in {"detect_edges": ours, "straight=True": straight, **methods()}.items():
            errors = []
            for image, (angle, offset) in zip(images, edges, strict=True):
                away = (detect(image, LOW, HIGH) - middle) @ [math.cos(angle), math.sin(angle)] - offset
                errors.append(away[np.abs(away) < NEAR])
            print(f"{blur:5}  {noise:5}  {way:4}  {name:17}  {spread(np.concatenate(errors))}")
        if noise:
            print(f"{blur:5}  {noise:5}  {way:4}  {'Cramer-Rao':17}  {'':8}  {bound(noise, math.hypot(blur, 12**-0.5)):7.4f}")


def discs(count: int, generator: torch.Generator) -> None:
    """Bright and dark discs."""
    print(f"\n{count} discs a radius, bright and dark\nradius  noise  {'':18}      mean      rms    worst  points")
    for radius in (5.0, 10.0, 20.0, 50.0):
        size = int(2 * radius) + 24
        centres = [(size - 1) / 2 + torch.rand(2, generator=generator, dtype=F64) - 0.5 for _ in range(count)]
        shares = [disc(c, radius, size) for c in centres]
        shares = [1 - s if i % 2 else s for i, s in enumerate(shares)]
        for noise in (0.0, 0.02):
            images = [shown(s, noise, generator) for s in shares]
            for name, detect in methods().items():
                away = [
                    np.linalg.norm(detect(image, LOW, HIGH) - c.numpy(), axis=1) - radius
                    for image, c in zip(images, centres, strict=True)
                ]
                errors = np.concatenate(away)
                print(f"{radius:6}  {noise:5}  {name:18}  {spread(errors[np.abs(errors) < NEAR])}")


def circle(x: Array) -> Array:
    """The centre of the circle through points, by least squares of their distances from it."""
    centre, radius = x.mean(0), np.linalg.norm(x - x.mean(0), axis=1).mean()
    for _ in range(8):
        d = x - centre
        length = np.linalg.norm(d, axis=1)
        move = np.linalg.lstsq(np.column_stack((-d / length[:, None], -np.ones(len(x)))), radius - length, rcond=None)[0]
        centre, radius = centre + move[:2], radius + move[2]
    return centre


def moves(generator: torch.Generator) -> None:
    """A disc of 10 px that moves by hundredths of a pixel: what the fitted circle and the points in front do."""
    print("\na disc moved by 0.01 px, 100 times: slope, and the largest deviation from the truth once the mean is off, px")
    print(f"{'':18}  centre: slope  deviation   foremost points: slope  deviation")
    count, size, radius = 101, 44, 10.0
    angle = float(2 * math.pi * torch.rand(1, generator=generator, dtype=F64))
    ahead = np.array([math.cos(angle), math.sin(angle)])
    true = 0.01 * np.arange(count)
    start = (size - 1) / 2 + torch.rand(2, generator=generator, dtype=F64) - 0.5
    centres = [start + torch.from_numpy(s * ahead) for s in true]
    images = [shown(disc(c, radius, size), 0.0, generator) for c in centres]
    for name, detect in methods().items():
        found = []
        for image, c in zip(images, centres, strict=True):
            x = detect(image, LOW, HIGH)
            d = x - c.numpy()
            length = np.linalg.norm(d, axis=1)
            near = np.abs(length - radius) < NEAR
            front = near & (d @ ahead > length * math.cos(math.radians(20)))
            found.append((circle(x[near]) @ ahead, (length[front] - radius).mean() + c.numpy() @ ahead))
        cells = []
        for places in np.array(found).T:
            off = places - true
            cells += [np.polyfit(true, places, 1)[0], np.abs(off - off.mean()).max()]
        print("{:18}  {:13.4f}  {:9.4f}  {:23.4f}  {:9.4f}".format(name, *cells))


def bars(count: int, generator: torch.Generator) -> None:
    """Thin bright bars: smoothing draws their sides apart."""
    print(f"\n{count} bright bars\nwidth  {'':22}      mean      rms    worst  points")
    middle = np.array([31.5, 31.5])
    for width in (6.0, 4.0, 3.0, 2.0):
        edges = directions(count, generator)
        images = [shown(step(a, o - width / 2, BLUR) - step(a, o + width / 2, BLUR), 0.0, generator) for a, o in edges]
        for name, detect in {"detect_edges": ours, "detect_edges, blur 0.5": sharper, **methods()}.items():
            errors = []
            for image, (angle, offset) in zip(images, edges, strict=True):
                away = (detect(image, LOW, HIGH) - middle) @ [math.cos(angle), math.sin(angle)] - offset
                out = np.abs(away) - width / 2
                errors.append(out[np.abs(out) < NEAR])
            print(f"{width:5}  {name:22}  {spread(np.concatenate(errors))}")


def nearest_right(x: Array, scene: DrawnScene) -> tuple[Array, Array]:
    """For each point the true sample that is nearest, -1 beyond 1 px, and how far the point is across the outline there."""
    distance, index = cKDTree(scene.x).query(x) if len(x) else (np.zeros(0), np.zeros(0, dtype=int))
    away = np.abs(((x - scene.x[index]) * scene.normal[index]).sum(-1))
    return np.where(distance < 1, index, -1), away


def drawn(count: int, generator: torch.Generator) -> None:
    """Outlines in drawn scenes: which points are right, what is found, and how well it hangs together."""
    print(
        f"\n{count} drawn scenes a row, 1 px\nnoise  {'':20}  precision  recall      F   median  90 %, px   recall of "
        "contrast <= 0.1, 0.2, more"
    )
    flat = {name: detect for name, detect in peers().items() if detect is not None and "skimage" not in name}
    clean = [draw_scene(generator) for _ in range(count)]
    for noise in (0.0, 0.01, 0.03):
        grain = [noise * torch.randn(scene.image.shape, generator=generator, dtype=F64) for scene in clean]
        scenes = [replace(scene, image=scene.image + g) for scene, g in zip(clean, grain, strict=True)]
        # About what `detect_edges` makes of noise by itself: four and six times the noise of gradients after that blur.
        low, high = max(0.01, 0.7 * noise), max(0.03, noise)
        for name, detect in {"detect_edges": ours, **flat, "OpenCV Canny": canny}.items():
            if noise and name.endswith(", 0"):
                continue
            right, found, errors, seen = 0, 0, [], []
            for scene in scenes:
                x = inside(detect(scene.image, low, high), scene)
                index, away = nearest_right(x, scene)
                right, found = right + int((index >= 0).sum()), found + len(x)
                errors.append(away[index >= 0])
                near = cKDTree(x).query(scene.x)[0] < 1
                seen.append(np.stack((near, scene.contrast), -1))
            precision, hit = right / max(1, found), np.concatenate(seen)
            recall = hit[:, 0].mean()
            classes = [hit[(hit[:, 1] > a) & (hit[:, 1] <= b), 0].mean() for a, b in ((0, 0.15), (0.15, 0.25), (0.25, 1))]
            median, most = np.quantile(np.concatenate(errors), [0.5, 0.9])
            print(
                f"{noise:5}  {name:20}  {precision:9.4f}  {recall:6.4f}  {2 * precision * recall / (precision + recall):5.3f}  "
                f"{median:7.4f}  {most:8.4f}   {'  '.join(f'{c:.4f}' for c in classes)}"
            )
        chains(noise, scenes)


def inside(x: Array, scene: DrawnScene) -> Array:
    """Those points that are not next to the border, where no outline is called seen."""
    h, w = scene.image.shape[-2:]
    return x[((x > scene.margin) & (x < np.array([w, h]) - 1 - scene.margin)).all(-1)]


def chains(noise: float, scenes: list[DrawnScene]) -> None:
    """How much of a piece of outline its best chain covers, in how many chains it is, and whether chains keep to one shape."""
    cover, parts, pure, joined = [], [], [], []
    for scene in scenes:
        edges = detect_edges(scene.image)
        x, chain = edges.x[edges.valid].numpy(), edges.chain[edges.valid].numpy()
        distance, index = cKDTree(x).query(scene.x)
        owner = np.where(distance < 1, chain[index], -1)
        for piece in range(int(scene.piece.max()) + 1):
            mine = owner[scene.piece == piece]
            if len(mine) * scene.spacing < 20:
                continue
            number = np.bincount(mine[mine >= 0]) if (mine >= 0).any() else np.zeros(1)
            cover.append(number.max() / len(mine))
            parts.append((number * scene.spacing > 2).sum())
        near, _ = nearest_right(x, scene)
        for k in range(int(chain.max()) + 1):
            shapes = np.bincount(scene.shape[near[(chain == k) & (near >= 0)]], minlength=1)
            pure.append(shapes.max() / max(1, shapes.sum()))
            joined.append(shapes.sum())
    pure_mean = np.average(pure, weights=joined)
    print(
        f"{noise:5}  chains: of {len(cover)} pieces of 20 px and more the best one covers {100 * np.mean(cover):.1f} %, "
        f"{np.mean(parts):.2f} chains a piece; {100 * pure_mean:.1f} % of a chain's points are of one shape"
    )


def photographs() -> dict[str, Tensor]:
    """Grey images to be timed on: photographs where TORCHSFM_DATA names them, and a rendered one."""
    scene = render_sequence(views=1, width=1280, height=960, generator=torch.Generator().manual_seed(0))
    images = {"rendered courtyard": scene.images[0].mean(0, keepdim=True)}
    folder = os.environ.get("TORCHSFM_DATA")
    if folder:
        for path in PHOTOGRAPHS:
            images[path.split("/")[1]] = read_image(Path(folder) / path).pixels.mean(0, keepdim=True)
    return images


def speed(repeats: int) -> None:
    """Megapixels a CPU second; the best of so many runs, the methods in turn."""
    print("\nmegapixels a CPU second, and points")
    found = {**methods(), "OpenCV Canny": canny}
    for title, image in photographs().items():
        best: dict[str, tuple[float, int]] = {}
        for _ in range(repeats + 1):
            for name, detect in found.items():
                start = time.process_time()
                points = len(detect(image, 0.01, 0.03))
                seconds = time.process_time() - start
                best[name] = min(best.get(name, (math.inf, 0)), (seconds, points))
        h, w = image.shape[-2:]
        for name, (seconds, points) in best.items():
            print(f"{title:18}  {w} x {h}  {name:18}  {h * w / 1e6 / seconds:7.2f}  {points:7}")


def main(arguments: list[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m bench.edges", description=__doc__)
    parts = ("steps", "discs", "moves", "bars", "drawn", "speed")
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    parser.add_argument("--count", type=int, default=200, help="steps a row, and bars: a fifth")
    parser.add_argument("--discs", type=int, default=8, help="a radius")
    parser.add_argument("--scenes", type=int, default=10, help="drawn scenes a row")
    parser.add_argument("--repeats", type=int, default=3, help="runs that are timed")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    missing = [name for name, detect in peers().items() if detect is None]
    if missing:
        print(f"not installed: {', '.join(missing)}")
    makers: dict[str, Callable[[torch.Generator], None]] = {
        "steps": lambda g: steps(options.count, g),
        "discs": lambda g: discs(options.discs, g),
        "moves": moves,
        "bars": lambda g: bars(options.count // 5, g),
        "drawn": lambda g: drawn(options.scenes, g),
        "speed": lambda _: speed(options.repeats),
    }
    for part in options.parts:
        makers[part](torch.Generator().manual_seed(options.seed))


def test_a_megapixel(benchmark: Any) -> None:
    torch.set_num_threads(1)
    scene = render_sequence(views=1, width=1280, height=960, generator=torch.Generator().manual_seed(0))
    found = benchmark.pedantic(lambda: detect_edges(scene.images[0]), rounds=3, warmup_rounds=1)
    assert int(found.valid.sum()) > 10_000


if __name__ == "__main__":
    main()
