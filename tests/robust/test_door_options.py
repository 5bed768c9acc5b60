"""Every door has the same options, and they mean the same."""

import inspect
from typing import Unpack, get_type_hints

import pytest
import torch
from robust_doors import DOORS, F64, SIZE, Door, Scene

from torchsfm import motion, resection
from torchsfm._types import Status
from torchsfm.robust import (
    InlierCount,
    LeastMedian,
    Magsac,
    Msac,
    Neighbours,
    Prosac,
    RansacOptions,
    SearchOptions,
    Uniform,
    ransac,
)

every_door = pytest.mark.parametrize("door", DOORS.values(), ids=DOORS)
PUBLIC = [
    motion.estimate_essential, motion.estimate_fundamental, motion.estimate_homography, motion.estimate_trifocal,
    motion.estimate_upright, resection.estimate_camera, resection.estimate_camera_focal, resection.estimate_camera_projective,
]  # fmt: skip


def test_the_signatures_agree() -> None:
    for door in PUBLIC:
        names = list(inspect.signature(door).parameters)
        assert names[-2:] == ["threshold", "options"], door
        assert "        **options: See `RansacOptions`" in (door.__doc__ or ""), door
        assert get_type_hints(door)["options"] == Unpack[RansacOptions]
    given = inspect.signature(ransac).parameters
    for kind in (SearchOptions, RansacOptions):
        for name in kind.__annotations__:
            assert f"        {name}: " in (kind.__doc__ or "") + (SearchOptions.__doc__ or ""), name
            assert name in given


@every_door
def test_there_are_no_other_options(door: Door, generator: torch.Generator) -> None:
    with pytest.raises(TypeError, match="iterations"):
        door(door.make(1, 30, generator), iterations=10)


@every_door
def test_weights_are_multiplicities(door: Door, generator: torch.Generator) -> None:
    """A datum of weight 3 is as good as three of them, one of weight 0 none."""
    problems = 12
    scene = door.make(problems, 81, generator)
    weights = torch.randint(0, 4, (problems, 81), generator=generator)
    weighted = door(scene, weights=weights.double(), covariance=True)
    plain = door(scene)
    assert not (weighted.inliers & (weights == 0)).any()
    size = weighted.covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    # As many rows as the most have, of which the others leave some out.
    number = weights.sum(-1, keepdim=True)
    mask = torch.arange(int(number.max())) < number
    index = torch.zeros(mask.shape, dtype=torch.long)
    index[mask] = torch.arange(81).repeat(problems).repeat_interleave(weights.flatten())
    repeated = door(Scene(tuple(d.take_along_dim(index[..., None], -2) for d in scene.data), scene.known), mask=mask)
    support = (weighted.support / repeated.support - 1).abs()
    apart, moved = (
        torch.stack([door.difference(a, b).norm() for a, b in zip(weighted.model, other.model, strict=True)]) / size
        for other in (repeated, plain)
    )
    alike = (weighted.inliers.take_along_dim(index, -1) == repeated.inliers) & mask
    assert (alike.sum(-1) / number[:, 0]).quantile(0.25) > 0.95
    # In standard deviations; the reach of the final loss has steps, and may fall on either side of one. Samples differ: of
    # several minima that cost nearly the same either may be found.
    assert apart.median() < 0.05
    assert support.median() < 5e-3
    assert apart.quantile(0.75) < 0.5
    assert apart.median() < 0.4 * moved.median()


@every_door
def test_the_unit_of_the_weights_is_free(door: Door, generator: torch.Generator) -> None:
    """Good data stay good and nonsense stays nonsense, whatever number stands for one."""
    scene, nonsense = door.make(4, 100, generator), door.make(4, 100, generator, wrong=1.0)
    plain = door(scene, weights=torch.ones(4, 100, dtype=F64))
    for unit in (1e-3, 1e3):
        weights = torch.full((4, 100), unit, dtype=F64)
        found = door(scene, weights=weights)
        assert (found.status == Status.OK).all()
        torch.testing.assert_close(found.model, plain.model, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(found.support, unit * plain.support, rtol=1e-6, atol=0)
        wrong = door(nonsense, 1.0, weights=weights, max_iterations=100)
        assert (wrong.status == Status.NO_CONSENSUS).sum() >= 3


@every_door
def test_the_threshold_may_be_unknown(door: Door, generator: torch.Generator) -> None:
    scene = door.make(6, 200, generator, noise=0.5, wrong=0.3)
    found, known = door(scene, None), door(scene, 1.5)
    assert (found.status == Status.OK).all()
    assert (found.inliers == known.inliers).double().mean() > 0.95
    # Some three times the noise, for the root of the sum over the coordinates that count.
    pixels = found.threshold / known.threshold * 1.5
    assert ((pixels > 0.7) & (pixels < 4)).all()
    assert torch.equal(found.inliers, door(scene, None, scoring=LeastMedian()).inliers)
    with pytest.raises(ValueError, match="threshold"):
        door(scene, None, scoring=Msac())


@every_door
def test_every_scoring_finds_the_inliers(door: Door, generator: torch.Generator) -> None:
    scene = door.make(3, 120, generator, noise=0.3, wrong=0.25)
    plain = door(scene, 2.0)
    assert torch.equal(plain.model, door(scene, 2.0, scoring=Msac()).model)
    for scoring in (Magsac(), InlierCount(), LeastMedian()):
        found = door(scene, 2.0, scoring=scoring)
        assert (found.status == Status.OK).all(), scoring
        assert (found.inliers == plain.inliers).double().mean() > 0.95, scoring


@every_door
def test_samples_follow_the_quality_and_stop_when_told(door: Door, generator: torch.Generator) -> None:
    wrong = 0.6 if door.sample_size < 6 else 0.5
    scene = door.scene(3, 200, generator).noisy(0.3, 0.0, door.images, generator)
    spoiled = list(scene.data)
    bad = torch.arange(200) >= 200 * (1 - wrong)
    last = door.images - 1
    anywhere = torch.rand(spoiled[last].shape, generator=generator, dtype=F64) * SIZE
    spoiled[last] = torch.where(bad[:, None], anywhere, spoiled[last])
    scene = Scene(tuple(spoiled), scene.known)
    trust = (~bad).double() + 0.3 * torch.randn(3, 200, generator=generator, dtype=F64)
    plain, guided = door(scene), door(scene, quality=trust)
    assert (guided.status == Status.OK).all()
    assert guided.iterations.sum() <= plain.iterations.sum()
    assert torch.equal(guided.inliers, door(scene, quality=10 * trust - 3).inliers)
    sure, quick = door(scene, confidence=1 - 1e-12), door(scene, confidence=0.5)
    assert quick.iterations.sum() <= plain.iterations.sum() <= sure.iterations.sum()
    assert quick.iterations.sum() < sure.iterations.sum()
    assert (door(scene, max_iterations=32).iterations <= 32).all()
    assert torch.equal(door(scene, mask=~bad.expand(3, 200)).inliers[:, bad], torch.zeros_like(plain.inliers[:, bad]))


@every_door
def test_every_sampler_finds_the_inliers(door: Door, generator: torch.Generator) -> None:
    scene = door.make(3, 120, generator, noise=0.3, wrong=0.25)
    plain = door(scene, 2.0)
    assert torch.equal(plain.model, door(scene, 2.0, sampler=Uniform()).model)
    quality = torch.rand(3, 120, generator=generator, dtype=F64)
    assert torch.equal(door(scene, quality=quality).model, door(scene, quality=quality, sampler=Prosac()).model)
    for options in (
        {"sampler": Neighbours()},
        {"sampler": Uniform(), "quality": quality},
        {"sampler": Prosac(), "quality": quality},
    ):
        found = door(scene, 2.0, **options)
        assert (found.status == Status.OK).all(), options
        assert (found.inliers == plain.inliers).double().mean() > 0.95, options
    with pytest.raises(ValueError, match="sampler: Prosac"):
        door(scene, 2.0, sampler=Prosac())


@every_door
@pytest.mark.usefixtures("unchecked")
def test_types_and_wrong_options(door: Door, generator: torch.Generator) -> None:
    scene = door.make(2, 60, generator, wrong=0.1)
    single = Scene(tuple(d.float() for d in scene.data), tuple(k.float() for k in scene.known))
    one, weights = torch.ones(60), torch.ones(2, 60)
    found = door(single, torch.tensor([2.0, 3.0]), quality=one, weights=weights, covariance=True)
    for name in ("model", "support", "threshold", "covariance"):
        assert getattr(found, name).dtype == torch.float32, name
    torch.testing.assert_close(found.threshold[1] / found.threshold[0], torch.tensor(1.5))
    first = door(single.at(0), torch.tensor([2.0, 3.0]))
    assert first.status.shape == (2,)
    for options, name in (
        ({"weights": one.double()}, "weights"), ({"quality": torch.ones(59)}, "quality"), ({"threshold": -1.0}, "threshold"),
        ({"threshold": float("nan")}, "threshold"), ({"confidence": 1.0}, "confidence"), ({"max_iterations": 0}, "max_iter"),
        ({"mask": one}, "mask|visible"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=name):
            door(single, **options)
