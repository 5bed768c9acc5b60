"""Are errors as large as the stated deviations say? On rendered photographs, whose truth is exact, nothing known of the camera.

`python -m bench.deviations [--images 12 14 16 18 20 22 24 28 32]` prints a line for each number of photographs of one
scene, from an arc of 300 degrees: errors over their standard deviations, with their sign of the camera's numbers, root mean
squares of the rotations and places; and the root mean square of each over all lines, which should be about 1.
"""

import argparse
import tempfile
from pathlib import Path

import torch
from torch import Tensor

from bench.scale import HEIGHT, WIDTH, render, ring
from torchsfm import reconstruct
from torchsfm.geometry.intrinsic_parameters import intrinsic_labels, row_from_camera
from torchsfm.reconstruction import Reconstruction
from torchsfm.reconstruction.model.evaluation import align_poses, pose_errors
from torchsfm.simulation.rendering import default_camera

NUMBERS = ("focal", "cx", "cy", "k1", "k2")


def median_distances(model: Reconstruction) -> Tensor:
    """Median depth of the points that each registered image sees."""
    depth = model.poses[model.view].transform(model.X[model.point][:, None])[:, 0, 2]
    return torch.stack([depth[model.view == i].median() for i in model.registered.nonzero()[:, 0].tolist()])


def line(views: int) -> Tensor:
    """Errors over deviations: of the camera's numbers, and root mean squares of rotations and places."""
    with tempfile.TemporaryDirectory() as folder:
        render(Path(folder), views)
        result = reconstruct(folder)
    model, found = result.model, result.report.calibrations[0]
    truth = ring(views, torch.Generator().manual_seed(0))[1]
    camera = default_camera(WIDTH, HEIGHT)
    true = dict(zip(intrinsic_labels(type(camera.distortion)), row_from_camera(camera).tolist(), strict=True))
    numbers = [(float(found.values[0, k]) - true[name]) / float(found.deviation[0, k]) for k, name in enumerate(found.names)]
    errors = pose_errors(model.poses, truth, model.registered)
    own = model.registered
    images = [image for image in result.report.images if image.model == 0]
    rotation = errors.image_rotation[own] / torch.tensor([image.rotation_sigma for image in images])
    scale = align_poses(model.poses, truth, own).scale
    sigma = torch.tensor([image.position_sigma for image in images]) * median_distances(model) * scale
    position = errors.image_position[own] / sigma
    both = (part.square().mean().sqrt() for part in (rotation, position))
    return torch.tensor([*(value for name, value in zip(found.names, numbers, strict=True) if name in NUMBERS), *both])


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m bench.deviations", description=__doc__)
    parser.add_argument("--images", nargs="+", type=int, default=[12, 14, 16, 18, 20, 22, 24, 28, 32])
    options = parser.parse_args(arguments)
    print("| photographs |", *(f"{name} |" for name in (*NUMBERS, "rotations", "places")))
    print("|---" * (len(NUMBERS) + 3) + "|", flush=True)
    lines = []
    for views in options.images:
        lines.append(line(views))
        print(f"| {views} |", *(f"{value:.1f} |" for value in lines[-1].tolist()), flush=True)
    print("| root mean square |", *(f"{value:.2f} |" for value in torch.stack(lines).square().mean(0).sqrt().tolist()))


if __name__ == "__main__":
    main()
