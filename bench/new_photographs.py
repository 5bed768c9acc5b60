"""Photographs that were zoomed, cropped, stretched or spoilt otherwise, registered in a model of the others.

    TORCHSFM_DATA=/path/to/data python -m bench.new_photographs [--set castle] [--new 3,9,15] [--only corner zoomed]

reconstructs the photographs but the new ones, and registers these, one by one (`--together`: all at once, which makes a
difference where they have one size). It prints by how many degrees their rotation is off, taken against each photograph of the
model (the median), and how far their centre is, in the unit of the truth (castle-P19, fountain-P11 and entry-P10: metres) after
the similarity between the centres of the model's; and what the report says of them.
"""

import argparse
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from bench.real_data import SETS, PhotographSet, data_folder
from torchsfm.geometry import Pose, rotation_angle, similarity_from_points
from torchsfm.reconstruction import Reconstruction, SfmResult, reconstruct, register_photographs, saved_features

Image = NDArray[np.uint8]
PART = 0.7
"""Share of the width and of the height that is left of a corner."""


def resized(image: Image, along_x: float, along_y: float, *, cropped: bool = False) -> Image:
    """The image stretched; its middle, of its size, if `cropped`."""
    h, w = image.shape[:2]
    out = cv2.resize(image, (round(w * along_x), round(h * along_y)), interpolation=cv2.INTER_AREA)
    top, left = ((out.shape[k] - (h, w)[k]) // 2 for k in range(2))
    return np.asarray(out[top : top + h, left : left + w] if cropped else out, dtype=np.uint8)


def corner(image: Image, number: int) -> Image:
    """One of three corners."""
    h, w = image.shape[:2]
    a, b = int(PART * h), int(PART * w)
    top, left = ((0, 0), (h - a, w - b), (h - a, 0))[number % 3]
    return image[top : top + a, left : left + b]


def zoomed(image: Image, number: int) -> Image:
    """The middle, magnified by 1, 1.25 or 1.67, and half as large as the photograph."""
    h, w = image.shape[:2]
    share = (0.6, 0.8, 1.0)[number % 3]
    part = image[int(h * (1 - share) / 2) : int(h * (1 + share) / 2), int(w * (1 - share) / 2) : int(w * (1 + share) / 2)]
    return np.asarray(cv2.resize(part, (w // 2, h // 2), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def covered(image: Image) -> Image:
    """Black but for the left half."""
    out = image.copy()
    out[:, image.shape[1] // 2 :] = 0
    return out


SPOILS: dict[str, Callable[[Image, int], Image]] = {
    "as it is": lambda image, n: image,
    "y stretched by 1.1, cropped": lambda image, n: resized(image, 1, 1.1, cropped=True),
    "x stretched by 1.1, cropped": lambda image, n: resized(image, 1.1, 1, cropped=True),
    "y stretched by 1.03, cropped": lambda image, n: resized(image, 1, 1.03, cropped=True),
    "resized to a square": lambda image, n: resized(image, 768 / image.shape[1], 768 / image.shape[0]),
    "zoomed by 1.2": lambda image, n: resized(image, 1.2, 1.2, cropped=True),
    "corner, the same": lambda image, n: corner(image, 1),
    "corner, another each": corner,
    "zoomed, another each": zoomed,
    "half as large": lambda image, n: resized(image, 0.5, 0.5),
    "five times smaller": lambda image, n: resized(image, 0.2, 0.2),
    "upside down": lambda image, n: image[::-1, ::-1],
    "mirrored": lambda image, n: image[:, ::-1],
    "dark": lambda image, n: (image * 0.15).astype(np.uint8),
    "blurred": lambda image, n: np.asarray(cv2.blur(image, (9, 1)), dtype=np.uint8),
    "half covered": lambda image, n: np.where(np.arange(image.shape[1])[:, None] < image.shape[1] // 2, image, 0).astype(
        np.uint8
    ),
}
TURNED = {"upside down": np.diag([-1.0, -1.0, 1.0])}
"""What turns of the image turn the cameras by."""


def described(found: SfmResult, name: str, old: Reconstruction, photographs: PhotographSet, true: NDArray[np.float64]) -> str:
    """Rotation and centre off, focal lengths over those of the model, and what the report says."""
    (report,) = (image for image in found.report.images if image.name == name)
    if report.model is None:
        return f"refused: {report.reason} |  |  | "
    model = found.model
    index = torch.tensor([model.names.index(one) for one in (*old.names, name)])
    rows = torch.from_numpy(np.stack([*(photographs.poses[one] for one in old.names), true]))
    truth, mine = Pose(rows[:, :, :3], rows[:, :, 3]), model.poses[index]
    turn = (mine.R[-1] @ mine.R[:-1].mT) @ (truth.R[-1] @ truth.R[:-1].mT).mT
    moved = similarity_from_points(mine.centre[:-1], truth.centre[:-1]).transform(mine.centre[-1:])
    off = float((moved - truth.centre[-1:]).norm())
    K = model.cameras.K[model.camera_index[index[[-1, 0]]]].diagonal(dim1=-2, dim2=-1)
    ratio = (K[0] / K[1])[:2].tolist()
    return f"{float(rotation_angle(turn).rad2deg().median()):.2f} | {off:.4f} | {ratio[0]:.4f}, {ratio[1]:.4f} | {report.doubt}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--set", default="castle", choices=list(SETS))
    parser.add_argument("--new", default="3,9,15", help="numbers of the photographs that are left out and registered")
    parser.add_argument("--only", nargs="*", default=list(SPOILS), help="parts of the names of what is done to them")
    parser.add_argument("--together", action="store_true", help="register them all at once")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    data = data_folder()
    if data is None:
        raise SystemExit("TORCHSFM_DATA names no folder")
    photographs, new = SETS[options.set](data), [int(k) for k in options.new.split(",")]
    kinds = [kind for kind in SPOILS if any(word in kind for word in options.only)]
    print("| photograph | changed | rotation off, ° | centre off | focal lengths / the model's | doubt |")
    print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "model"
        old = reconstruct([path for k, path in enumerate(photographs.paths) if k not in new], out=out).model
        known = saved_features(out, old)
        assert known is not None
        for kind in kinds:
            files = {Path(folder) / f"new_{photographs.paths[k].stem}.png": k for k in new}
            for n, (file, k) in enumerate(files.items()):
                image = np.asarray(cv2.imread(str(photographs.paths[k])), dtype=np.uint8)
                cv2.imwrite(str(file), SPOILS[kind](image, n))
            groups = [list(files)] if options.together else [[file] for file in files]
            for group in groups:
                found = register_photographs(group, old, known)
                for file in group:
                    true = TURNED.get(kind, np.eye(3)) @ photographs.poses[photographs.paths[files[file]].name]
                    row = described(found, file.name, old, photographs, true)
                    print(f"| {photographs.name} {files[file]} | {kind} | {row} |", flush=True)


if __name__ == "__main__":
    main()
