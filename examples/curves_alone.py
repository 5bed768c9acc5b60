"""From images of smooth painted shapes, without a single corner, to calibrated cameras and curves in space.

Where points fail, edges do: they are followed through the images, no point of one is known to belong to a point of another,
and neither cameras nor focal length are known.

    python examples/curves_alone.py
"""

import math

import torch

import torchsfm
from torchsfm.autocalibration import Assumption
from torchsfm.geometry import camera_from_krt, project_points, rotation_angle, rotation_from_rotvec
from torchsfm.simulation import paint_shapes

generator = torch.Generator().manual_seed(2)
F64 = torch.float64
SIZE = (400, 300)
FOCAL = 500.0


def rand(*shape: int) -> torch.Tensor:
    """Uniform numbers between -1 and 1."""
    return 2 * torch.rand(*shape, dtype=F64, generator=generator) - 1


# Six eggs and beans, flat, each in a plane of its own, around the origin.
t = torch.arange(72, dtype=F64) * (2 * math.pi / 72)
radius = 0.55 * (1 + 0.12 * (2 * t + 3 * rand(6, 1)).cos() + 0.04 * (3 * t + 3 * rand(6, 1)).cos())
flat = torch.stack((radius * t.cos(), radius * t.sin(), 0 * radius), -1)
place = torch.tensor([[x, y] for y in (-1.0, 1.0) for x in (-1.6, 0.0, 1.6)], dtype=F64)
shapes = flat @ rotation_from_rotvec(0.6 * rand(6, 3)).mT + torch.cat((place, rand(6, 1)), -1)[:, None]

# Seven cameras on an arc of 36 degrees, seven units away.
turn = math.radians(36) * torch.linspace(-0.5, 0.5, 7, dtype=F64)[:, None] * torch.tensor([0.3, 1.0, 0.0], dtype=F64)
R = rotation_from_rotvec(turn + 0.01 * rand(7, 3))
centre = torch.tensor([(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2], dtype=F64)
K = torchsfm.intrinsics(torch.tensor(FOCAL, dtype=F64), centre)
P = camera_from_krt(K, R, torch.tensor([0.0, 0.0, 7.0], dtype=F64) + 0.05 * rand(7, 3))

# Their images, with a little noise.
grey = torch.tensor([0.5, 0.9, 0.1, 0.8, 0.2, 0.95, 0.15], dtype=F64)
outlines = project_points(P, shapes.flatten(0, 1)).unflatten(1, (6, -1))
pictures = [paint_shapes(list(x), grey, width=SIZE[0], height=SIZE[1], fine=4) for x in outlines]
images = torch.stack(pictures) + 0.01 * torch.randn(7, 1, SIZE[1], SIZE[0], dtype=F64, generator=generator)

tracked = torchsfm.track_curves(torchsfm.detect_edges(images), reach=30.0)
print(f"{tracked.chain.shape[1]} curves followed, each through {(tracked.chain >= 0).sum(0).tolist()} images")

found = torchsfm.factorize_curves(tracked.curves, oriented=True, aligned=True)
counts = torch.isfinite(found.error)
print(f"projective: {torchsfm.Status(int(found.status)).name}, median distance {found.error[counts].median():.3f} px")

metric = torchsfm.autocalibrate_curves(
    found.P, found.X, tracked.curves, image_size=SIZE, visible=counts, assume=Assumption(free=("focal",))
)
turned = torch.linalg.solve(metric.K, metric.P[..., :3])
off = rotation_angle(turned @ turned[:1].mT @ (R @ R[:1].mT).mT).rad2deg()
print(f"metric: {torchsfm.Status(int(metric.status)).name}, focal length: {metric.K[0, 0, 0]:.1f} px, true {FOCAL} px")
print(f"rotations off by at most {off.max():.2f} degrees")
