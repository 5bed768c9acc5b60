"""What `bench.scale` photographs: a scene whose parts every photograph can have in common with the next one."""

from torch import Generator

from bench.scale import ring
from torchsfm.simulation import render_sequence


def test_cameras_of_the_ring_see_the_same_things() -> None:
    g = Generator().manual_seed(0)
    scene, poses = ring(24, g)
    seen = render_sequence(scene, poses=poses, width=96, height=72, points=500, generator=g).visible
    shared = (seen[1:] & seen[:-1]).sum(1) / (seen[1:] | seen[:-1]).sum(1)
    assert bool((shared > 0.3).all())
