"""A line, an ellipse and a curve in space from their images in four known views.

No point of one image is known to belong to a point of another: a line is where planes of sight meet, an ellipse and a curve
are found by how they look from everywhere.

    python examples/lines_and_curves.py
"""

import math

import torch

import torchsfm
from torchsfm.geometry import camera_from_krt, curve_from_samples, foot_points, project_points, rotation_from_rotvec
from torchsfm.images import fit_ellipse
from torchsfm.triangulation import triangulate_conics, triangulate_curves, triangulate_lines

generator = torch.Generator().manual_seed(0)
F64 = torch.float64


def noise(*shape: int) -> torch.Tensor:
    """Half a pixel."""
    return 0.5 * torch.randn(*shape, dtype=F64, generator=generator)


# Four cameras ten units from the origin, turned by up to half a radian.
K = torchsfm.intrinsics(torch.tensor(800.0, dtype=F64), torch.tensor([319.5, 239.5], dtype=F64))
R = rotation_from_rotvec(0.4 * torch.randn(4, 3, dtype=F64, generator=generator))
P = camera_from_krt(K, R, torch.tensor([0.0, 0.0, 10.0], dtype=F64).expand(4, 3))

# A segment: its ends in the images are not those of the same points, but they are on the same line.
ends = torch.tensor([[-1.0, 0.3, 0.2], [1.2, -0.4, 0.5]], dtype=F64)
seen = ends[0] + torch.rand(4, 2, 1, dtype=F64, generator=generator).sort(1).values * (ends[1] - ends[0])
segments = project_points(P, seen) + noise(4, 2, 2)
line = triangulate_lines(segments[:, None], P)
direction = torch.nn.functional.normalize(line.model[0, :3], dim=-1)
angle = torch.linalg.cross(direction, torch.nn.functional.normalize(ends[1] - ends[0], dim=-1)).norm().asin().rad2deg()
print(f"line: {torchsfm.Status(int(line.status)).name}, direction off by {angle:.2f} degrees")

# An ellipse: edge points around its images, ellipses through these, then the ellipse in space.
t = torch.arange(60, dtype=F64) * (2 * math.pi / 60)
ring = 0.9 * t.cos()[:, None] * torch.tensor([1.0, 0.2, 0.1], dtype=F64) + 0.6 * t.sin()[:, None] * torch.tensor(
    [0.0, 1.0, 0.4]
)
edges = project_points(P, ring) + noise(4, 60, 2)
images = fit_ellipse(edges)
ellipse = triangulate_conics(torchsfm.geometry.conic_from_ellipse(images.model)[:, None], P, x=edges[:, None])
print(f"ellipse: centre off by {ellipse.model.centre[0].norm():.4f}, edge points by {ellipse.error[0]:.2f} pixels")

# A bent curve, each image of it sampled at places of its own.
turns = (t + torch.rand(4, 1, dtype=F64, generator=generator))[..., None]
bent = torch.cat((turns.cos(), turns.sin(), 0.3 * (2 * turns).sin()), -1)
curve = triangulate_curves(curve_from_samples(project_points(P, bent), closed=True), P, samples=60)
fine = torch.arange(720, dtype=F64)[:, None] * (2 * math.pi / 720)
truth = curve_from_samples(torch.cat((fine.cos(), fine.sin(), 0.3 * (2 * fine).sin()), -1), closed=True)
gap = (foot_points(truth, curve.curve.x).x - curve.curve.x).norm(dim=-1)[curve.measured]
print(f"curve: {int(curve.measured.sum())} of 60 samples found, off by {gap.mean():.5f} on average")
