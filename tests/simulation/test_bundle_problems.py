"""Generated bundle problems: counts as asked, everything in front and in the image, noise as asked, one seed one problem."""

import pytest
import torch
from chance import seeded

from torchsfm.geometry import Radial
from torchsfm.simulation import random_bundle_problem


@pytest.mark.parametrize(
    ("layout", "cameras", "points", "observations"),
    [("path", 2, 10, 20), ("path", 60, 1500, 7000), ("dome", 16, 300, 1100), ("dome", 60, 1500, 7000)],
)
def test_counts_and_visibility(layout: str, cameras: int, points: int, observations: int, generator: torch.Generator) -> None:
    made = random_bundle_problem(cameras, points, observations, layout=layout, generator=generator)
    problem, truth = made.problem, made.truth
    assert (problem.poses.shape[0], len(problem.X), len(problem.x)) == (cameras, points, observations)
    assert int(torch.bincount(problem.point, minlength=points).min()) >= 2
    # No point twice in a view.
    assert len(torch.unique(problem.view * points + problem.point)) == observations
    assert bool((truth.depths() > 0).all())
    assert bool((truth.x.abs() <= torch.tensor([1000.0, 750.0]) + 1e-6).all())
    assert float(truth.residuals().max()) == 0
    noise = (problem.x - truth.x).square().mean().sqrt()
    assert abs(float(noise) / 0.5 - 1) < 4 * (1 / (4 * observations)) ** 0.5 + 0.02
    # The median of the smallest problem, of 20, is between 13 and 87 in 60 trials.
    assert 2 < float(problem.residuals().median()) < 200
    assert isinstance(truth.cameras.distortion, Radial)


def test_long_tracks_are_rare_and_neighbours_share_points(generator: torch.Generator) -> None:
    problem = random_bundle_problem(200, 4000, 16000, generator=generator).problem
    lengths = torch.bincount(problem.point)
    assert float((lengths == 2).double().mean()) > 0.25
    assert int(lengths.max()) > 12
    first = torch.full((4000,), 1000).scatter_reduce(0, problem.point, problem.view, "amin")
    last = torch.zeros(4000, dtype=torch.int64).scatter_reduce(0, problem.point, problem.view, "amax")
    assert int((last - first).max()) < 100


def test_start_and_outliers(generator: torch.Generator) -> None:
    made = random_bundle_problem(10, 200, 700, disturbance=0.0, noise=0.0, outliers=0.2, generator=generator)
    residuals = made.problem.residuals()
    assert float(residuals[~made.outlier].max()) < 1e-9
    assert float(residuals[made.outlier].median()) > 50
    assert abs(float(made.outlier.double().mean()) - 0.2) < 0.06


def test_one_seed_one_problem() -> None:
    one, two, other = (random_bundle_problem(5, 40, 120, generator=seeded(seed)).problem for seed in (1, 1, 2))
    assert torch.equal(one.x, two.x)
    assert torch.equal(one.poses.R, two.poses.R)
    assert not torch.equal(one.X, other.X)


@pytest.mark.parametrize(
    ("counts", "options", "words"),
    [
        ((1, 10, 30), {}, "num_cameras"),
        ((5, 10, 19), {}, "num_observations: wanted at least 2"),
        ((3, 10, 31), {}, "num_observations: wanted at most"),
        ((5, 10, 30), {"layout": "circle"}, "layout"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_what_cannot_be_had(counts: tuple[int, int, int], options: dict[str, str], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        random_bundle_problem(*counts, **options, generator=seeded())  # type: ignore[arg-type]
