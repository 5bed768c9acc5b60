"""What holds at every door: units, threads, memory."""

import subprocess
import sys
from typing import Any

import pytest
import torch
from torch import Tensor

from torchsfm.geometry import rotation_from_rotvec
from torchsfm.motion import estimate_essential, estimate_fundamental, estimate_homography
from torchsfm.resection import estimate_camera

FOCAL, CENTRE = 800.0, 500.0
K = torch.tensor([[FOCAL, 0, CENTRE], [0, FOCAL, CENTRE], [0, 0, 1]], dtype=torch.float64)
MODELS = ["fundamental", "essential", "homography", "camera"]


def scene(model: str, p: int, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Two images, or an image and points, three in ten wrong."""
    kind: dict[str, Any] = {"generator": generator, "dtype": torch.float64}
    X = torch.rand(p, n, 3, **kind) * 4 - 2 + torch.tensor([0.0, 0, 6])
    if model == "homography":
        X = X / (X @ torch.tensor([0.03, -0.02, 0.17], dtype=torch.float64))[..., None]
    R = rotation_from_rotvec((torch.rand(p, 3, **kind) - 0.5) * 0.5)
    t = torch.nn.functional.normalize(torch.randn(p, 3, **kind), dim=-1)
    Y = X @ R.mT + t[:, None]
    images = [Z[..., :2] / Z[..., 2:] * FOCAL + CENTRE + 0.5 * torch.randn(p, n, 2, **kind) for Z in (X, Y)]
    wrong = torch.rand(p, n, 1, generator=generator) < 0.3
    images[1] = torch.where(wrong, torch.rand(p, n, 2, **kind) * 1000, images[1])
    return (images[1], X) if model == "camera" else (images[0], images[1])


def door(model: str, a: Tensor, b: Tensor, scale: float = 1.0, **options: Any) -> Any:
    options = {"generator": torch.Generator().manual_seed(1), **options}
    if model == "fundamental":
        return estimate_fundamental(scale * a, scale * b, threshold=1.5 * scale, **options)
    if model == "homography":
        return estimate_homography(scale * a, scale * b, threshold=1.5 * scale, **options)
    if model == "camera":
        S = torch.diag(torch.tensor([scale, scale, 1.0], dtype=torch.float64))
        return estimate_camera(scale * a, scale * b, S @ K, threshold=1.5 * scale, **options)
    rays = [torch.cat(((x - CENTRE) / FOCAL, torch.ones_like(x[..., :1])), -1) * scale for x in (a, b)]
    return estimate_essential(*rays, threshold=1.5 / FOCAL, **options)


@pytest.mark.parametrize("model", MODELS)
def test_the_unit_of_the_data_is_free(model: str, generator: torch.Generator) -> None:
    """Points and threshold times 1000 (for the camera the world too; for rays their length): the same inliers."""
    a, b = scene(model, 6, 150, generator)
    plain, scaled = door(model, a, b), door(model, a, b, 1000.0)
    assert torch.equal(plain.inliers, scaled.inliers)
    assert torch.equal(plain.degeneracy, scaled.degeneracy)
    torch.testing.assert_close(plain.score, scaled.score, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("model", MODELS)
def test_the_number_of_threads_does_not_matter(model: str, generator: torch.Generator) -> None:
    a, b = scene(model, 5, 600, generator)
    alone = door(model, a, b)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        together = door(model, a, b)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(alone.inliers, together.inliers)
    torch.testing.assert_close(alone.model, together.model, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("model", MODELS)
def test_no_pair_feels_the_others(model: str, generator: torch.Generator) -> None:
    """Bit for bit, with many kinds of neighbours: empty, tiny, huge, all wrong, all the same, with rows that are not finite."""
    a, b = scene(model, 9, 4000, generator)
    mask = torch.zeros(9, 4000, dtype=torch.bool)
    for i, count in enumerate((0, 1, 4, 7, 50, 4000, 300, 300, 300)):
        mask[i, :count] = True
    a[6] = torch.rand(4000, 2, generator=generator, dtype=torch.float64) * 1000
    a[7], b[7] = a[7, :1].clone(), b[7, :1].clone()
    a[8, ::3] = torch.nan
    options = {"max_iterations": 500}
    batch = door(model, a, b, mask=mask, **options)
    assert torch.isfinite(batch.model).all()
    assert torch.isfinite(batch.score).all()
    for i in range(9):
        alone = door(model, a[i], b[i], mask=mask[i], **options)
        for name in ("model", "inliers", "score", "threshold", "iterations", "status", "degeneracy"):
            assert torch.equal(getattr(alone, name), getattr(batch, name)[i]), (name, i)


MEMORY = """
import resource, torch
from torchsfm.motion import estimate_fundamental
torch.set_num_threads(1)
g = torch.Generator().manual_seed(0)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
x = torch.rand(256, 5000, 2, generator=g, dtype=torch.float64) * 1000
y = x * torch.tensor([1.1, 0.9]) + 5 * torch.randn(256, 5000, 1)
y = torch.where(torch.rand(256, 5000, 1, generator=g) < 0.6, y, x.flip(1))
estimate_fundamental(x, y, threshold=1.0, generator=g, max_iterations=1000)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e6)
"""


@pytest.mark.slow
def test_256_pairs_of_5000_points_stay_under_2_gb() -> None:
    done = subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 2.0
