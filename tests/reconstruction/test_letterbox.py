"""Films with black bars above and below the picture."""

import math
from pathlib import Path

from chance import seeded

from torchsfm.geometry import rotation_angle
from torchsfm.images import save_image
from torchsfm.reconstruction import reconstruct
from torchsfm.simulation import courtyard_scene, orbit_poses, render_sequence

WIDTH, HEIGHT, BAR, VIEWS = 360, 270, 30, 18


def test_a_film_with_bars_is_one_model(tmp_path: Path) -> None:
    """What the bars hide was missed, the model taken for folded and cut: 18 frames were five models, 17 of them doubtful."""
    generator = seeded(0)
    poses = orbit_poses(
        VIEWS, radius=5.2, height=(0.6, 1.6), sweep=math.radians(54), start=math.radians(-75), target=(0.0, 0.0, 0.7)
    )
    scene = courtyard_scene(texel=0.02, generator=generator)
    options = {"width": WIDTH, "height": HEIGHT, "points": 0, "supersample": 2}
    images = render_sequence(scene, poses=poses, generator=generator, **options).images
    images[:, :, :BAR] = 0
    images[:, :, -BAR:] = 0
    for i, image in enumerate(images):
        save_image(tmp_path / f"frame{i:02d}.png", image)
    result = reconstruct(tmp_path, sequence=True)
    assert len(result.models) == 1
    assert bool(result.model.registered.all())
    world = poses.R.mT @ result.model.poses.R
    assert float(rotation_angle(world @ world[0].mT).max()) < math.radians(0.3)
