"""Several structures in one set of data: against the truth of simulated scenes and of the Adelaide image pairs."""

from pathlib import Path

import numpy as np
import pytest
import torch
from chance import seeded
from scenes import make_scene
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from torchsfm._types import Status
from torchsfm.geometry import sampson_distance
from torchsfm.motion import (
    FundamentalEstimator,
    HomographyEstimator,
    estimate_fundamental,
    estimate_fundamentals,
    estimate_homographies,
)
from torchsfm.robust import find_structures
from torchsfm.robust.multi_structure import link

F64 = torch.float64


def misclassified(found: Tensor, truth: Tensor) -> float:
    """The share of data with the wrong label under the best matching of structures; -1 is none."""
    table = np.zeros((int(found.max()) + 2, int(truth.max()) + 2))
    np.add.at(table, ((found + 1).numpy(), (truth + 1).numpy()), 1)
    right = table[0, 0]
    rows, columns = linear_sum_assignment(-table[1:, 1:])
    return float(1 - (right + table[1:, 1:][rows, columns].sum()) / len(found))


def planes(batch: int, generator: torch.Generator, sizes: tuple[int, ...] = (40, 30, 20), wrong: int = 20) -> tuple:
    """Points of several planes in two images, in a random order, with noise of 0.001; their labels; the homographies."""
    x1, x2, label, models = [], [], [], []
    for k, size in enumerate(sizes):
        scene = make_scene(HomographyEstimator, (batch,), size, generator, 1e-3)
        x1.append(scene.data[0])
        x2.append(scene.data[1])
        label.append(torch.full((batch, size), k))
        models.append(scene.model)
    if wrong:
        x1.append(torch.rand(batch, wrong, 2, generator=generator, dtype=F64) * 2 - 1)
        x2.append(torch.rand(batch, wrong, 2, generator=generator, dtype=F64) * 2 - 1)
        label.append(torch.full((batch, wrong), -1))
    order = torch.randperm(sum(sizes) + wrong, generator=generator)
    return (*(torch.cat(v, 1)[:, order] for v in (x1, x2, label)), torch.stack(models, 1))


def test_planes_are_found(generator: torch.Generator) -> None:
    x1, x2, label, models = planes(5, generator)
    found = estimate_homographies(x1, x2, threshold=4e-3, generator=generator)
    assert (found.status == Status.OK).all()
    assert found.found.tolist() == [3] * 5
    assert found.valid.tolist() == [[True] * 3 + [False] * 5] * 5
    assert np.mean([misclassified(f, t) for f, t in zip(found.label, label, strict=True)]) < 0.05
    assert ((found.label >= 0).sum(-1) <= 95).all()
    # Largest first, each near the truth.
    for k in range(3):
        a = found.model[:, k]
        gap = torch.minimum((a - models[:, k]).norm(dim=(-2, -1)), (a + models[:, k]).norm(dim=(-2, -1)))
        assert gap.median() < 0.02
    assert (found.model[:, 3:] == 0).all()


def test_motions_are_found(generator: torch.Generator) -> None:
    scenes = [make_scene(FundamentalEstimator, (3,), n, generator, 1e-3) for n in (60, 40)]
    x1, x2 = (torch.cat([s.data[i] for s in scenes], 1) for i in (0, 1))
    truth = torch.cat((torch.zeros(60), torch.ones(40))).long()
    found = estimate_fundamentals(x1, x2, threshold=3e-3, generator=generator)
    assert (found.status == Status.OK).all()
    assert np.mean([misclassified(f, truth) for f in found.label]) < 0.2
    for k in range(2):
        near = sampson_distance(found.model[:, k], x1, x2)
        assert near[found.label == k].median() < 2e-3
    torch.testing.assert_close(found.model[:, 0].norm(dim=(-2, -1)), torch.ones(3, dtype=F64))


def test_one_structure_is_what_ransac_finds(generator: torch.Generator) -> None:
    scene = make_scene(FundamentalEstimator, (4,), 100, generator, 1e-3)
    wrong = torch.rand(4, 100, generator=generator) < 0.3
    x1, x2 = scene.spoil(scene.data, wrong, generator)
    found = estimate_fundamentals(x1, x2, threshold=4e-3, generator=generator)
    one = estimate_fundamental(x1, x2, threshold=3e-3, generator=generator)
    assert (found.found >= 1).all()
    first = found.label == 0
    assert (first & one.inliers).sum() > 0.9 * one.inliers.sum()
    assert (first & wrong).sum() < 0.15 * wrong.sum()


def test_alone_and_in_a_batch_and_with_masks(generator: torch.Generator) -> None:
    x1, x2, _, _ = planes(3, generator)
    mask = torch.rand(3, x1.shape[1], generator=generator) < 0.9
    options = {"threshold": 4e-3, "hypotheses": 800, "kept": 200}
    together = find_structures(HomographyEstimator(), x1, x2, mask=mask, generator=seeded(7), **options)
    assert (together.label[~mask] == -1).all()
    for i in range(3):
        alone = find_structures(
            HomographyEstimator(), x1[i][mask[i]], x2[i][mask[i]], generator=seeded(7), **options
        )  # fmt: skip
        assert torch.equal(alone.label, together.label[i][mask[i]])
        assert torch.equal(alone.model, together.model[i])
    again = find_structures(HomographyEstimator(), x1[None], x2[None], mask=mask, generator=seeded(7), **options)
    assert again.label.shape == (1, 3, x1.shape[1])
    assert torch.equal(again.label[0], together.label)


def test_coordinates_may_be_of_any_scale(generator: torch.Generator) -> None:
    x1, x2, _, _ = planes(1, generator)
    a = estimate_homographies(x1, x2, threshold=4e-3, generator=seeded())
    b = estimate_homographies(
        1024 * x1, 1024 * x2, threshold=4.096, generator=seeded()
    )  # fmt: skip
    assert torch.equal(a.label, b.label)
    single = estimate_homographies(x1.float(), x2.float(), threshold=4e-3, generator=seeded())
    assert single.model.dtype == torch.float32


def test_bad_problems_and_few_slots(generator: torch.Generator) -> None:
    x1, x2, _, _ = planes(7, generator)
    mask = torch.ones(7, x1.shape[1], dtype=torch.bool)
    mask[1, 3:] = False
    x1[2] = torch.nan
    x1[3], x2[3] = x1[3, :1], x2[3, :1]
    x1[4, ::3] = torch.inf
    x1[5] = torch.rand(x1[5].shape, generator=generator, dtype=F64)
    mask[6] = False
    found = estimate_homographies(x1, x2, threshold=2e-3, mask=mask, slots=2, smallest=12, generator=generator)
    assert found.status.tolist()[:5] == [Status.OK, Status.TOO_FEW, Status.NOT_FINITE, Status.DEGENERATE, Status.OK]
    assert found.status.tolist()[5:] == [Status.NO_CONSENSUS, Status.TOO_FEW]
    assert found.found[0] == 3
    assert found.label.max() == 1
    assert torch.isfinite(found.model).all()
    assert (found.label[[1, 2, 3, 5, 6]] == -1).all()
    assert (found.label[4, ::3] == -1).all()
    assert estimate_homographies(x1[:0], x2[:0], threshold=1.0).label.shape == (0, x1.shape[1])


def test_linking_groups_what_prefers_the_same() -> None:
    preference = torch.zeros(9, 6, dtype=F64)
    preference[[0, 3, 6], 0] = torch.tensor([0.9, 0.8, 0.7], dtype=F64)
    preference[[1, 4], 2], preference[[1, 4], 3] = 0.5, 0.4
    preference[2, 5] = preference[8, 5] = 1
    assert link(preference).tolist() == [0, 1, 2, 0, 1, 5, 0, 7, 2]


def test_wrong_arguments(unchecked: None) -> None:
    x = torch.zeros(10, 2)
    for options in ({"slots": 0}, {"smallest": 3}, {"hypotheses": 0}, {"kept": 0}):
        with pytest.raises(ValueError, match=f"{next(iter(options))}: wanted int >= "):
            find_structures(HomographyEstimator(), x, x, threshold=1.0, **options)
    with pytest.raises(ValueError, match="data"):
        find_structures(HomographyEstimator(), threshold=1.0)
    with pytest.raises(ValueError, match="x2"):
        estimate_fundamentals(x, x[:5], threshold=1.0)


@pytest.mark.parametrize(("kind", "limit"), [("F", 0.08), ("H", 0.12)])
def test_adelaide(kind: str, limit: float, data: Path) -> None:
    archive = np.load(data / "two_view" / "adelaide_rmf" / f"{kind}.npz")
    names = [n[: -len("_data")] for n in archive.files if n.endswith("_data")]
    names = sorted(n for n in names if archive[n + "_data"].shape[1] < 1000)
    width = max(archive[n + "_data"].shape[1] for n in names)
    x = torch.full((len(names), width, 6), torch.nan, dtype=F64)
    for i, name in enumerate(names):
        points = torch.from_numpy(archive[name + "_data"]).mT
        x[i, : len(points)] = points
    mask = torch.isfinite(x).all(-1)
    estimate, threshold = (estimate_fundamentals, 4.0) if kind == "F" else (estimate_homographies, 2.0)
    found = estimate(x[..., :2], x[..., 3:5], threshold=threshold, mask=mask, generator=seeded())
    errors = []
    for i, name in enumerate(names):
        truth = torch.from_numpy(archive[name + "_label"].ravel().astype(int)) - 1
        errors.append(misclassified(found.label[i][mask[i]], truth))
    # Over seeds the mean is 0.053 and 0.093 with a scatter of 0.005 and 0.008, the median 0.039 and 0.073, 0.005 and 0.012.
    assert np.mean(errors) < limit
    assert np.median(errors) < limit
