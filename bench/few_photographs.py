"""A few neighbouring photographs of the real sets at a time, nothing known of the camera: are they right, or doubted?

`TORCHSFM_DATA=... python -m bench.few_photographs [--sets castle entry] [--sizes 3 4 5] [--step 1] [--zoom]`. An image's error
is the median, the lower one, of the pose errors of its pairs: of three images of which one is wrong the other two are not. With
`--zoom` each photograph is as by a zoom lens, the middle of it 1 to 1.7 times as large.
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from bench.real_data import SETS, PhotographSet, data_folder
from bench.spoiled_folders import zoom
from torchsfm import reconstruct
from torchsfm.geometry import Pose
from torchsfm.reconstruction.model.evaluation import pose_errors

WRONG, RIGHT = 5.0, 2.0
"""Degrees from which on an image that is not doubted is silently wrong, and up to which one that is doubted is right."""


def image_errors(poses: Pose, true: Pose, registered: torch.Tensor) -> torch.Tensor:
    """For each image the lower median of its pairs' pose errors, in degrees; 0 for images that are not registered."""
    errors = pose_errors(poses, true, registered)
    of_pair = errors.pose.new_full((len(registered),) * 2, torch.nan)
    i, j = errors.pair.unbind(-1)
    of_pair[i, j] = of_pair[j, i] = torch.where(errors.pose.isfinite(), errors.pose, torch.nan)
    return of_pair.nanmedian(1).values.nan_to_num(0)


def window(some: list[Path], photographs: PhotographSet) -> tuple[int, torch.Tensor, torch.Tensor, float]:
    """How many are registered, each one's error and whether it is doubted, and the first camera's focal length."""
    with tempfile.TemporaryDirectory() as folder:
        for path in some:
            (Path(folder) / path.name).symlink_to(path)
        result = reconstruct(folder)
    if not result.models:
        return 0, torch.zeros(len(some)), torch.zeros(len(some), dtype=torch.bool), 0.0
    model = result.models[0]
    pose = {Path(name).stem: torch.from_numpy(value) for name, value in photographs.poses.items()}
    true = Pose.from_matrix(torch.stack([pose[Path(name).stem] for name in model.names]))
    doubted = torch.tensor([bool(image.doubt) for image in result.report.images])
    error = image_errors(model.poses, true, model.registered)
    return int(model.registered.sum()), error, doubted & model.registered, float(model.cameras.K[0, 0, 0])


def main() -> None:
    """Print a line for each window, and what all come to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", nargs="+", default=["fountain", "castle", "entry", "temple"])
    parser.add_argument("--sizes", nargs="+", type=int, default=[3, 4, 5])
    parser.add_argument("--step", type=int, default=1, help="images from one window to the next")
    parser.add_argument("--side", type=int, default=768, help="of the photographs, pixels")
    parser.add_argument("--zoom", action="store_true", help="photographs by a zoom lens")
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    data = data_folder()
    if data is None:
        raise SystemExit("TORCHSFM_DATA names no folder")
    for name in options.sets:
        photographs = SETS[name](data)
        with tempfile.TemporaryDirectory() as folder:
            paths, random = [], np.random.default_rng(3)
            for number, path in enumerate(photographs.paths):
                image: Any = cv2.imread(str(path))
                scale = min(1.0, options.side / max(image.shape[:2]))
                image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
                paths.append(Path(folder) / f"{path.stem}.png")
                cv2.imwrite(str(paths[-1]), zoom(image, number, random) if options.zoom else image)
            total = dict.fromkeys(("images", "registered", "wrong", "silently", "right but doubted"), 0)
            for size in options.sizes:
                for begin in range(0, len(paths) - size + 1, options.step):
                    start = time.process_time()
                    registered, error, doubted, focal = window(paths[begin : begin + size], photographs)
                    seconds = time.process_time() - start
                    wrong = error > WRONG
                    counts = (size, registered, wrong.sum(), (wrong & ~doubted).sum(), (doubted & (error <= RIGHT)).sum())
                    for key, count in zip(total, counts, strict=True):
                        total[key] += int(count)
                    degrees = " ".join(f"{e:.1f}" for e in error.tolist())
                    print(
                        f"{name} {size} from {begin:2d}: registered {registered}, degrees {degrees}, "
                        f"doubted {int(doubted.sum())}, f {focal:.0f}, {seconds:.1f} s",
                        flush=True,
                    )
            print(name, ", ".join(f"{count} {key}" for key, count in total.items()), flush=True)


if __name__ == "__main__":
    main()
