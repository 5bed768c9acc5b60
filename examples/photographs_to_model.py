"""Photographs in, cameras and coloured points out, with nothing known of the camera.

    python examples/photographs_to_model.py [FOLDER]

reconstructs the images in FOLDER. Without one it renders eight small photographs of a courtyard first, and then knows the truth
to compare with.
"""

import math
import sys
import tempfile
from pathlib import Path

import torch

from torchsfm.reconstruction import reconstruct
from torchsfm.reconstruction.model.evaluation import align_reconstruction, pose_errors
from torchsfm.simulation import RenderedSequence, courtyard_scene, orbit_poses, render_sequence


def photograph(folder: Path) -> RenderedSequence:
    """Render a scene from eight places and save the images."""
    generator = torch.Generator().manual_seed(0)
    scene = courtyard_scene(texel=0.012, generator=generator)
    poses = orbit_poses(8, radius=5.2, height=(0.6, 2.2), sweep=math.radians(60), start=math.radians(-75), target=(0, 0, 0.7))
    truth = render_sequence(scene, poses=poses, width=480, height=360, generator=generator)
    truth.save(folder)
    return truth


def main(folder: Path | None = None) -> None:
    """Reconstruct, look at the result, and compare with the truth where it is known."""
    with tempfile.TemporaryDirectory() as scratch:
        truth = photograph(Path(scratch)) if folder is None else None
        result = reconstruct(folder or scratch, seed=0)

    model = result.model  # the largest one; `result.models` has all, `result.report` says what became of each image
    print(model.summary())
    print("longest track:", int(model.track_lengths().max()), "images")
    print("mean error per image, px:", [round(error, 2) for error in model.view_errors().tolist()])

    if truth is not None:
        errors = pose_errors(model.poses, truth.poses, model.registered)
        print(f"rotation between images, median error: {errors.rotation.median():.3f} deg")
        print(f"focal length: {model.cameras.K[0, 0, 0]:.1f} px, true {truth.cameras.K[0, 0, 0]:.1f} px")
        model = align_reconstruction(model, truth.poses)  # into the frame and scale of the truth
    model.save("model.npz")
    print("saved model.npz; `torchsfm info model.npz` describes it, Reconstruction.load reads it")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
