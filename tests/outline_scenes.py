"""Cameras around points, some of which are none: outlines, which move over things as the camera does."""

from dataclasses import replace

import torch
from torch import Tensor

from torchsfm.bundle import BundleModel
from torchsfm.geometry import BundleProblem, Camera, intrinsics, rotation_angle
from torchsfm.simulation import orbit_poses

VIEWS, POINTS = 12, 300


def outline_scene(g: torch.Generator, outlines: float) -> tuple[BundleProblem, BundleProblem, Tensor]:
    """Cameras on an arc around points, some of which lie on the left outlines of upright posts: with these, the truth without
    noise or outlines, and which points are on outlines.
    """
    poses = orbit_poses(VIEWS, radius=5.0, height=(0.5, 1.5), sweep=1.3)
    camera = Camera(intrinsics(torch.tensor(500.0).double(), torch.tensor([320.0, 240.0]).double()))[None]
    X = 3 * torch.rand(POINTS, 3, generator=g, dtype=torch.float64) - 1.5
    bad = torch.rand(POINTS, generator=g) < outlines
    radius = torch.where(bad, 0.05 + 0.1 * torch.rand(POINTS, generator=g, dtype=torch.float64), 0.0)
    sight = X - poses.centre[:, None]
    across = torch.stack((-sight[..., 1], sight[..., 0], torch.zeros_like(sight[..., 0])), -1)
    left = across / across.norm(dim=-1, keepdim=True)
    seen = camera.project(poses.transform(X + radius[:, None] * left))
    view, point = torch.meshgrid(torch.arange(VIEWS), torch.arange(POINTS), indexing="ij")
    view, point, index = view.flatten(), point.flatten(), torch.zeros(VIEWS, dtype=torch.long)
    x = seen.reshape(-1, 2) + 0.2 * torch.randn(VIEWS * POINTS, 2, generator=g, dtype=torch.float64)
    truth = BundleProblem(poses, camera, index, X, camera.project(poses.transform(X)).reshape(-1, 2), view, point)
    return replace(truth, x=x), truth, bad


def rotation_error(problem: BundleModel, truth: BundleProblem) -> float:
    """Root mean square error of relative rotations, degrees."""
    i, j = torch.combinations(torch.arange(VIEWS), 2).unbind(-1)
    R, R_true = (p.poses.R[j] @ p.poses.R[i].mT for p in (problem, truth))
    return float(rotation_angle(R @ R_true.mT).square().mean().sqrt().rad2deg())
