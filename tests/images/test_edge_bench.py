"""The truth that `bench.edges` measures by, and the formula beside which it measures."""

import math

import numpy as np
import torch
from painting import half_plane
from scipy.spatial import cKDTree
from torch import Generator

from bench.edge_peers import devernay
from bench.edge_scenes import CONTRAST, DARK, disc, draw_scene, shown, step
from torchsfm import detect_edges


def test_pixels_of_steps_are_means_over_their_squares(generator: Generator) -> None:
    for angle in (0.0, 0.3, math.pi / 4, 2.0, math.pi):
        # As painted from six samples a pixel and axis, which widens a profile by less than a hundredth.
        painted = half_plane(angle, 0.2, blur=0.6)[0]
        assert float((step(angle, 0.2, 0.6) - painted).abs().max()) < 2e-3
    image = shown(step(1.0, 0.0, 0.01), 0.0, generator)
    assert abs(float(image.min()) - DARK) < 1e-9
    assert abs(float(image.max()) - DARK - CONTRAST) < 1e-9


def test_the_formula_has_the_errors_that_are_known_of_it(generator: Generator) -> None:
    """On blurred steps about 0.014 px, and discs too small by half the variance of all blur over their radius."""
    errors = []
    for k in range(12):
        angle = 0.5 * k
        x = devernay(shown(step(angle, 0.1, 0.6), 0.0, generator), 0.02, 0.06)
        errors.append((x - 31.5) @ [math.cos(angle), math.sin(angle)] - 0.1)
    assert 0.008 < np.sqrt(np.square(np.concatenate(errors)).mean()) < 0.02
    centre = torch.tensor([22.2, 21.7], dtype=torch.float64)
    x = devernay(shown(disc(centre, 10.0, 44), 0.0, generator), 0.02, 0.06)
    drawn_in = np.linalg.norm(x - centre.numpy(), axis=1).mean() - 10
    assert abs(drawn_in + (0.6**2 + 1 + 1 / 12 + 1 / 3) / 20) < 0.01


def test_outlines_that_are_seen_are_edges() -> None:
    scene = draw_scene(Generator().manual_seed(0), count=6, width=200, height=160)
    assert len(scene.x) == len(scene.normal) == len(scene.contrast) == len(scene.shape) == len(scene.piece)
    edges = detect_edges(scene.image, low=0.003, high=0.01)
    x = edges.x[edges.valid].numpy()
    assert float((cKDTree(x).query(scene.x)[0] < 1).mean()) > 0.9
    distance, index = cKDTree(scene.x).query(x)
    away = np.abs(((x - scene.x[index]) * scene.normal[index]).sum(-1))
    assert float(np.median(away[distance < 1])) < 0.01
