"""What would the cameras see? Synthetic scenes, viewpoints, observations and images, with the truth known."""

from torchsfm.simulation.boards import render_board
from torchsfm.simulation.bundle_problems import SimulatedBundle, random_bundle_problem
from torchsfm.simulation.conic_scenes import SimulatedConics, simulate_conics
from torchsfm.simulation.observations import SimulatedImages, random_intrinsics, random_points, simulate_images
from torchsfm.simulation.rendering import RenderedSequence, render_sequence
from torchsfm.simulation.segments import SimulatedSegments, simulate_segments
from torchsfm.simulation.shapes import RenderedShapes, paint_shapes, render_shapes
from torchsfm.simulation.textured_scene import TexturedScene, courtyard_scene
from torchsfm.simulation.viewpoints import look_at, orbit_poses, random_poses

__all__ = [
    "RenderedSequence",
    "RenderedShapes",
    "SimulatedBundle",
    "SimulatedConics",
    "SimulatedImages",
    "SimulatedSegments",
    "TexturedScene",
    "courtyard_scene",
    "look_at",
    "orbit_poses",
    "paint_shapes",
    "random_bundle_problem",
    "random_intrinsics",
    "random_points",
    "random_poses",
    "render_board",
    "render_sequence",
    "render_shapes",
    "simulate_conics",
    "simulate_images",
    "simulate_segments",
]
