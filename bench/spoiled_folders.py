"""Folders of photographs as users have them: what is turned, cropped, marked, doubled or mixed up, and what comes of it.

    TORCHSFM_DATA=/path/to/data python -m bench.spoiled_folders [--set fountain] [--images 0:3] [--only watermark crops]

prints one markdown table. Photographs are at half size where they are larger than a thousand pixels; nothing is known of the
cameras. Duplicates count as images of their own; pairs of images from one place have no direction between them, and are left
out of the AUC. Strangers are images that do not belong to the set. `--set temple --only wall` puts a wall that stands still
behind an object that turns.
"""

import argparse
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from bench.real_data import SETS, data_folder
from torchsfm.geometry.poses import Pose
from torchsfm.reconstruction import reconstruct
from torchsfm.reconstruction.model.evaluation import pose_auc, pose_errors

Image = NDArray[np.uint8]
LARGE = 1000
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Of a turn of the image by a quarter, clockwise."""
Spoil = Callable[[Image, int, np.random.Generator], Image]


def watermark(image: Image, number: int, random: np.random.Generator) -> Image:
    """Two lines of text."""
    h, w = image.shape[:2]
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(image, "(C) Photographs 2009-06-12 14:33", (w - 430, h - 15), font, 0.7, (255, 255, 255), 2, cv2.LINE_AA)
    cv2.putText(image, "www.example.org/photographs", (10, 30), font, 0.8, (40, 40, 230), 2, cv2.LINE_AA)
    return image


def strip(image: Image, number: int, random: np.random.Generator) -> Image:
    """A tenth of the image is a texture, always the same."""
    h, w = image.shape[:2]
    texture = np.random.default_rng(5).integers(0, 255, (20, 60, 3)).astype(np.uint8)
    image[h - h // 5 :, w // 4 : w // 4 + w // 2] = cv2.resize(texture, (w // 2, h // 5), interpolation=cv2.INTER_NEAREST)
    return image


def sizes(image: Image, number: int, random: np.random.Generator) -> Image:
    """Three sizes."""
    scale = (1.0, 0.6, 1.3)[number % 3]
    return _image(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC))


def crops(image: Image, number: int, random: np.random.Generator, part: int = 6) -> Image:
    """Up to a sixth is cut from each side."""
    h, w = image.shape[:2]
    left, right, top, bottom = (int(random.integers(0, side // part)) for side in (w, w, h, h))
    return image[top : h - bottom, left : w - right]


def crops_less(image: Image, number: int, random: np.random.Generator) -> Image:
    """Up to a twelfth."""
    return crops(image, number, random, 12)


def crops_more(image: Image, number: int, random: np.random.Generator) -> Image:
    """Up to a fourth."""
    return crops(image, number, random, 4)


def zoom(image: Image, number: int, random: np.random.Generator) -> Image:
    """A zoom lens: the middle, up to 1.7 times as large, at the size of the image."""
    h, w = image.shape[:2]
    scale = float(random.uniform(1.0, 1.7))
    centre = np.array([w - 1, h - 1]) / 2
    map_ = np.array([[scale, 0, centre[0] * (1 - scale)], [0, scale, centre[1] * (1 - scale)]])
    return _image(cv2.warpAffine(image, map_, (w, h), flags=cv2.INTER_CUBIC))


def barrel(image: Image, number: int, random: np.random.Generator) -> Image:
    """As a wide lens of an action camera bends it: by 15 % in the corners."""
    h, w = image.shape[:2]
    f, bend = 0.9 * w, np.array([-0.3, 0.0, 0.0, 0.0])
    K = np.array([[f, 0, (w - 1) / 2], [0, f, (h - 1) / 2], [0, 0, 1]])
    grid = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 1, 2).astype(np.float64)
    source = cv2.undistortPoints(grid, K, bend, P=K).reshape(h, w, 2).astype(np.float32)
    return _image(cv2.remap(image, source, None, cv2.INTER_CUBIC))


def squares(image: Image, number: int, random: np.random.Generator) -> Image:
    """Resized to a square, as for networks."""
    return _image(cv2.resize(image, (640, 640), interpolation=cv2.INTER_AREA))


def shapes(image: Image, number: int, random: np.random.Generator) -> Image:
    """Upright and lying ones, all resized to a square."""
    return squares(turned(image, number, random), number, random)


def squeezed(image: Image, number: int, random: np.random.Generator) -> Image:
    """A tenth narrower, as films with pixels that are not square."""
    return _image(cv2.resize(image, None, fx=0.9, fy=1.0, interpolation=cv2.INTER_AREA))


def turned(image: Image, number: int, random: np.random.Generator) -> Image:
    """One in three by a quarter."""
    return _image(cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE)) if number % 3 == 1 else image


def exposure(image: Image, number: int, random: np.random.Generator) -> Image:
    """Right, too dark, too bright."""
    return np.clip(image * (1.0, 0.35, 1.9)[number % 3], 0, 255).astype(np.uint8)


def blur(image: Image, number: int, random: np.random.Generator) -> Image:
    """One in three moved by 15 pixels."""
    kernel = np.zeros((15, 15))
    kernel[7] = 1 / 15
    return _image(cv2.filter2D(image, -1, kernel)) if number % 3 == 2 else image


def vignette(image: Image, number: int, random: np.random.Generator) -> Image:
    """A black border around a disc."""
    h, w = image.shape[:2]
    disc = np.zeros((h, w), np.uint8)
    cv2.circle(disc, (w // 2, h // 2), int(w * 0.46), 1, -1)
    return image * disc[..., None]


def before_wall(image: Image, wall: Image, random: np.random.Generator) -> Image:
    """What stands on black, before something that stands still: an object on a turntable."""
    on = cv2.morphologyEx((image.max(-1) > 28).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((7, 7)))
    _, label, sizes, _ = cv2.connectedComponentsWithStats(on)
    share = cv2.GaussianBlur((label == 1 + sizes[1:, 4].argmax()).astype(np.float64), (0, 0), 1.0)[..., None]
    mixed = share * image + (1 - share) * cv2.resize(wall, image.shape[1::-1]) + random.normal(0, 2, image.shape)
    return np.clip(mixed, 0, 255).astype(np.uint8)


def plain(image: Image, number: int, random: np.random.Generator) -> Image:
    """As it is."""
    return image


SPOILS: tuple[Spoil, ...] = (
    plain, watermark, strip, sizes, crops, crops_less, crops_more, zoom, barrel, squares, shapes, squeezed, turned, exposure,
    blur, vignette,
)  # fmt: skip
FOLDERS = (*(spoil.__name__ for spoil in SPOILS), "gray", "jpeg", "duplicates", "again", "mirrored", "strangers")
WALL = "wall"
"""For photographs of an object on black."""


def folder(
    name: str, which: str, data: Path, out: Path, seed: int = 3, images: slice = slice(None)
) -> dict[str, NDArray[np.float64]]:
    """Write the photographs, or some of them; the true poses by name."""
    random, photographs = np.random.default_rng(seed), SETS[name](data)
    spoil = next((spoil for spoil in SPOILS if spoil.__name__ == which), plain)
    poses: dict[str, NDArray[np.float64]] = {}
    wall = _read(SETS["castle"](data).paths[3])

    def write(stem: str, image: Image, pose: NDArray[np.float64] | None, quality: int = 95) -> None:
        path = out / (f"{stem}.png" if image.dtype == np.uint16 else f"{stem}.jpg")
        cv2.imwrite(str(path), image, [] if path.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, quality])
        if pose is not None:
            poses[path.name] = pose

    for number, path in enumerate(photographs.paths[images]):
        pose = photographs.poses.get(path.name)
        image = spoil(_read(path), number, random)
        if which in ("turned", "shapes") and number % 3 == 1 and pose is not None:
            pose = QUARTER @ pose
        if which == WALL:
            image = before_wall(image, wall, random)
        if which == "gray":
            image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.uint16) * 257  # type: ignore[assignment]
        write(f"{number:03d}", image, pose, 25 if which == "jpeg" else 95)
        if which == "duplicates" and number % 2 == 0:
            write(f"{number:03d}_copy", image, pose)
        if which == "again" and number % 2 == 0:
            write(f"{number:03d}_again", _image(cv2.resize(image, None, fx=0.97, fy=0.97)), pose, 60)
        if which == "mirrored" and number % 4 == 1:
            write(f"{number:03d}_mirrored", image[:, ::-1], None)
    if which == "strangers":
        for other in ("temple", "house", "sceaux"):
            for path in SETS[other](data).paths[:3]:
                write(f"{other}_{path.stem}", _read(path), None)
    return poses


def row(name: str, which: str, data: Path, seed: int, images: slice) -> str:
    """One line of the table."""
    with tempfile.TemporaryDirectory() as scratch:
        poses = folder(name, which, data, Path(scratch), seed, images)
        result = reconstruct(scratch)
        number = len(list(Path(scratch).iterdir()))
    model = result.model
    names = [Path(own).name for own in model.names]
    truth = Pose.from_matrix(torch.from_numpy(np.array([poses.get(own, np.eye(3, 4)) for own in names])))
    known = torch.tensor([own in poses for own in names])
    errors = pose_errors(model.poses, truth, model.registered)
    pairs = torch.combinations(torch.arange(len(names)))
    apart = (truth.centre[pairs[:, 0]] - truth.centre[pairs[:, 1]]).norm(dim=-1) > 1e-6
    counted = errors.pose[known[pairs].all(-1) & apart]
    good = counted[torch.isfinite(counted)]
    doubtful = sum(bool(image.doubt) for image in result.report.images if image.model == 0)
    cells = [
        which,
        f"{int((model.registered & known).sum())}/{len(poses)}",
        f"{int((model.registered & ~known).sum())}/{number - len(poses)}",
        str(len(result.models)),
        str(doubtful),
        str(result.report.still),
        " / ".join(f"{area:.3f}" for area in pose_auc(counted).tolist()),
        f"{float(good.max()):.2f}" if len(good) else "",
    ]
    return "| " + " | ".join(cells) + " |"


def table(name: str, only: list[str], data: Path, seed: int, images: slice) -> Iterator[str]:
    """The lines, each as soon as it is known."""
    yield "| folder | registered | strangers | models | doubtful | matches left out | AUC 1 / 2 / 5 deg | largest error, deg |"
    yield "|---|---|---|---|---|---|---|---|"
    for which in only:
        yield row(name, which, data, seed, images)


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m bench.spoiled_folders", description="Folders as users have them.")
    parser.add_argument("--data", type=Path, default=data_folder(), help="folder of the data sets (default: $TORCHSFM_DATA)")
    parser.add_argument("--set", choices=sorted(SETS), default="fountain")
    parser.add_argument("--only", nargs="+", choices=(*FOLDERS, WALL), default=list(FOLDERS))
    parser.add_argument("--seed", type=int, default=3, help="of where photographs are cropped")
    parser.add_argument(
        "--images", default=":", metavar="A:B", help="those photographs of the set alone, from 0, B not included"
    )
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args(arguments)
    if options.data is None:
        parser.error("TORCHSFM_DATA does not name the folder of the data sets")
    torch.set_num_threads(options.threads)
    cv2.setNumThreads(options.threads)
    images = slice(*(int(end) if end else None for end in options.images.split(":")))
    for line in table(options.set, options.only, options.data, options.seed, images):
        print(line, flush=True)


def _read(path: Path) -> Image:
    """At half size where it is large."""
    image = _image(cv2.imread(str(path)))
    return image if image.shape[1] <= LARGE else _image(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))


def _image(image: object) -> Image:
    return np.asarray(image, dtype=np.uint8)


if __name__ == "__main__":
    main()
