"""What holds at every door: units, threads, neighbours, memory."""

import subprocess
import sys

import pytest
import torch
from robust_doors import DOORS, F64, Door, extremes

from torchsfm._types import Status
from torchsfm.robust import Degeneracy

every_door = pytest.mark.parametrize("door", DOORS.values(), ids=DOORS)


@every_door
def test_the_unit_of_the_data_is_free(door: Door, generator: torch.Generator) -> None:
    """Points and threshold times 1000 (for cameras the world too; for rays their length): the same inliers."""
    scene = door.make(6, 150, generator)
    plain, scaled = door(scene, 1.5), door(scene, 1.5, unit=1000.0)
    assert torch.equal(plain.inliers, scaled.inliers)
    assert torch.equal(plain.degeneracy, scaled.degeneracy)
    torch.testing.assert_close(plain.support, scaled.support, rtol=1e-6, atol=1e-6)


@every_door
def test_the_number_of_threads_does_not_matter(door: Door, generator: torch.Generator) -> None:
    scene = door.make(5, 400, generator)
    alone = door(scene)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        together = door(scene)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(alone.inliers, together.inliers)
    assert torch.equal(alone.iterations, together.iterations)
    torch.testing.assert_close(alone.model, together.model, rtol=1e-9, atol=1e-12)


@every_door
def test_extremes_in_one_batch(door: Door, generator: torch.Generator) -> None:
    """Each has its status, finite numbers, and what it gets alone, after as many samples."""
    scene, mask, sizes = extremes(door, generator)
    # Of six random points few samples have cameras with all in front: the more are drawn, the surer one says so.
    options = {"max_iterations": 1000 if door is DOORS["trifocal"] else 300}
    batch = door(scene, mask=mask, **options)
    for i, (name, size) in enumerate(sizes.items()):
        alone = door(scene.at(i, slice(size)), **options)
        for result in ("status", "degeneracy", "iterations"):
            assert torch.equal(getattr(alone, result), getattr(batch, result)[i]), (name, result)
        assert torch.equal(alone.inliers, batch.inliers[i, :size]), name
        assert not batch.inliers[i, size:].any(), name
        for result in ("model", "support", "threshold"):
            value = getattr(batch, result)[i]
            assert torch.isfinite(value).all(), (name, result)
            far = (getattr(alone, result) - value).abs().max()
            assert far <= 1e-9 * value.abs().max(), (name, result)
    status = {name: Status(int(code)).name for name, code in zip(sizes, batch.status, strict=True)}
    for name in ("nothing", "one", "too few"):
        assert status[name] == "TOO_FEW", name
    for name in ("small", "huge", "right", "some NaN", "infinities"):
        assert status[name] == "OK", name
        assert batch.iterations[list(sizes).index(name)] < options["max_iterations"], name
    assert status["wrong"] == "NO_CONSENSUS"
    assert status["same"] == "DEGENERATE"
    assert status["all NaN"] == "NOT_FINITE"
    # Two views of a point agree, and collinear points determine an upright pair: nothing else has so few unknowns.
    if door is not DOORS["point"]:
        assert status["a sample"] in ("NO_CONSENSUS", "DEGENERATE")
        few = batch.degeneracy[[i for i, size in enumerate(sizes.values()) if size <= door.sample_size]]
        assert (few == Degeneracy.TOO_FEW).all()
        assert status["collinear"] == ("OK" if door is DOORS["upright"] else "DEGENERATE")


@every_door
def test_what_is_given_once_holds_for_all(door: Door, generator: torch.Generator) -> None:
    """Mask, weights, quality and thresholds without batch dimensions, and several of them for one problem."""
    n = 400
    scene = door.make(2, n, generator)
    mask, some = torch.rand(n, generator=generator) < 0.9, torch.rand(n, generator=generator, dtype=F64)
    for option, value in (("mask", mask), ("weights", some), ("quality", some), ("threshold", torch.tensor(2.0, dtype=F64))):
        once = door(scene, **{option: value})
        each = door(scene, **{option: value.expand(2, *value.shape)})
        assert torch.equal(once.inliers, each.inliers), option
        alone = door(scene.at(0), **{option: value.expand(2, *value.shape)})
        assert torch.equal(alone.inliers, once.inliers[:1].expand(2, n)), option


MEMORY = """
import resource, torch
from torchsfm.motion import estimate_fundamental
torch.set_num_threads(1)
g = torch.Generator().manual_seed(0)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
x = torch.rand(256, 5000, 2, generator=g, dtype=torch.float64) * 1000
y = x * torch.tensor([1.1, 0.9]) + 5 * torch.randn(256, 5000, 1, generator=g)
y = torch.where(torch.rand(256, 5000, 1, generator=g) < 0.6, y, x.flip(1))
estimate_fundamental(x, y, threshold=1.0, generator=g, max_iterations=1000)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e6)
"""


@pytest.mark.slow
def test_256_pairs_of_5000_points_stay_under_2_gb() -> None:
    done = subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 2.0
