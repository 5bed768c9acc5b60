from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import torchsfm.images.matching as matching
from torchsfm.images import Features, detect_features, match_descriptors, match_features, read_image


def features_of(descriptors: Tensor) -> Features:
    n = len(descriptors)
    return Features(torch.zeros(n, 2), torch.ones(n), torch.zeros(n), torch.ones(n), descriptors)


def random_descriptors(n: int, generator: torch.Generator, length: int = 128) -> Tensor:
    return as_bytes(torch.rand(n, length, generator=generator).pow(4))


def as_bytes(values: Tensor) -> Tensor:
    """Of nearly equal length, as RootSIFT is."""
    return (values / values.norm(dim=1, keepdim=True) * 256).round().clamp(0, 127).to(torch.uint8)


def noisy_copy(descriptors: Tensor, generator: torch.Generator) -> Tensor:
    noise = torch.randint(-12, 13, descriptors.shape, generator=generator)
    order = torch.randperm(len(descriptors), generator=generator)
    return as_bytes((descriptors.double() + noise).clamp_min(0))[order]


def brute_force(a: Tensor, b: Tensor, ratio: float, mutual: bool, limit: float) -> list[list[int]]:
    """One point after another, in double precision, in numpy."""
    a, b = a.double().numpy(), b.double().numpy()
    dot = a @ b.T
    rows = []
    for i in range(len(a)):
        order = np.argsort(-dot[i], kind="stable")
        j = int(order[0])
        angle = np.arccos(np.clip(dot[i, order] / np.linalg.norm(a[i]) / np.linalg.norm(b[order], axis=1), -1, 1))
        if angle[0] > limit or (ratio < 1 and len(order) > 1 and angle[0] >= ratio * angle[1]):
            continue
        if mutual and dot[:, j].max() > dot[i, j]:
            continue
        if mutual and any(row[1] == j for row in rows):
            continue
        rows.append([i, j])
    return rows


@pytest.mark.parametrize("ratio", [0.8, 1.0])
@pytest.mark.parametrize("mutual", [True, False])
@pytest.mark.parametrize("limit", [0.3, 0.7])
def test_bytes_against_brute_force(generator: torch.Generator, ratio: float, mutual: bool, limit: float) -> None:
    a = random_descriptors(300, generator)
    b = torch.cat([noisy_copy(a[:200], generator), random_descriptors(150, generator)])
    found = match_descriptors(a, b, ratio=ratio, mutual=mutual, max_distance=limit)
    expected = brute_force(a, b, ratio, mutual, limit)
    assert found.tolist() == expected
    assert len(expected) > 100


@pytest.mark.parametrize("mutual", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_floats_against_brute_force(generator: torch.Generator, mutual: bool, dtype: torch.dtype) -> None:
    a = torch.nn.functional.normalize(torch.randn(280, 64, generator=generator, dtype=dtype), dim=1)
    noise = 0.05 * torch.randn(280, 64, generator=generator)
    b = torch.nn.functional.normalize(a[torch.randperm(280, generator=generator)] + noise, dim=1)
    found = match_descriptors(a, b.to(dtype), ratio=0.9, mutual=mutual, max_distance=1.0)
    assert found.tolist() == brute_force(a, b.to(dtype), 0.9, mutual, 1.0)
    assert len(found) > 250


def test_equal_descriptors_are_matched_once() -> None:
    # Two equal rows on each side: no ratio test can tell them apart; without it the first ones are partners.
    a = torch.eye(4, 16, dtype=torch.uint8)[[0, 0, 1, 2]] * 100
    assert match_descriptors(a, a, ratio=1.0).tolist() == [[0, 0], [2, 2], [3, 3]]
    assert match_descriptors(a, a, ratio=0.8).tolist() == [[2, 2], [3, 3]]
    assert match_descriptors(a.float(), a.float(), ratio=1.0).tolist() == [[0, 0], [2, 2], [3, 3]]


@pytest.mark.parametrize("bytes_pay", [None, False])
def test_column_chunks_and_row_blocks_change_nothing(
    bytes_pay: bool | None, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Long descriptors of large values leave room for few column numbers: several chunks must be merged. Nor can float32 hold
    # their products, where bytes are not multiplied as such.
    if bytes_pay is not None:
        monkeypatch.setattr(matching, "_bytes_pay", lambda: bytes_pay)
    a = torch.randint(100, 128, (150, 3000), generator=generator, dtype=torch.uint8)
    b = torch.cat([a.flip(0), torch.randint(100, 128, (150, 3000), generator=generator, dtype=torch.uint8)])
    monkeypatch.setattr(matching, "_ROWS", 7)
    value, index = matching._top_two(a.to(torch.int8), b.to(torch.int8))
    exact = (a.double() @ b.double().mT).sort(dim=1, descending=True, stable=True)
    assert torch.equal(value.double(), exact.values[:, :2])
    assert torch.equal(index, exact.indices[:, :2])


def test_without_byte_products_the_answer_is_the_same(generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    a = random_descriptors(200, generator)
    b = noisy_copy(a, generator)
    for pays in (True, False):
        monkeypatch.setattr(matching, "_bytes_pay", lambda pays=pays: pays)
        assert match_descriptors(a, b).tolist() == brute_force(a, b, 0.8, True, 0.7)


def test_extreme_bytes_do_not_overflow() -> None:
    a = torch.full((3, 128), 127, dtype=torch.int8)
    a[1, ::2], a[2] = -127, -127
    assert match_descriptors(a, a, ratio=1.0).tolist() == [[0, 0], [1, 1], [2, 2]]


def test_bytes_of_unequal_length_are_compared_by_angle(generator: torch.Generator) -> None:
    a = random_descriptors(60, generator)
    stretched = a // torch.randint(1, 4, (60, 1), generator=generator).to(torch.uint8)
    assert match_descriptors(a, stretched).tolist() == [[i, i] for i in range(60)]


def test_large_values_are_compared_as_floats(generator: torch.Generator) -> None:
    a = torch.randint(0, 256, (50, 32), generator=generator, dtype=torch.uint8)
    small = a // 2
    assert match_descriptors(a, a.flip(0)).tolist() == [[i, 49 - i] for i in range(50)]
    assert match_descriptors(a, small).tolist() == [[i, i] for i in range(50)]  # the one as floats, the other as bytes


def test_empty_and_single_sets(generator: torch.Generator) -> None:
    a = random_descriptors(5, generator)
    for first, second in ((a[:0], a), (a, a[:0]), (a[:0], a[:0])):
        assert match_descriptors(first, second).shape == (0, 2)
    assert match_descriptors(a, a[2:3]).tolist() == [[2, 0]]  # no second best: no ratio test
    assert match_features([], torch.zeros(0, 2, dtype=torch.long)) == []


def test_descriptors_without_meaning_match_nothing(generator: torch.Generator) -> None:
    a = torch.nn.functional.normalize(torch.randn(6, 16, generator=generator), dim=1)
    broken = a.clone()
    broken[1], broken[3] = 0.0, torch.nan
    assert match_descriptors(a, broken).tolist() == [[0, 0], [2, 2], [4, 4], [5, 5]]
    assert match_descriptors(broken, a).tolist() == [[0, 0], [2, 2], [4, 4], [5, 5]]
    zeros = random_descriptors(4, generator)
    zeros[2] = 0
    assert match_descriptors(zeros, zeros).tolist() == [[0, 0], [1, 1], [3, 3]]


def test_a_pair_does_not_depend_on_the_others(generator: torch.Generator) -> None:
    sets = [random_descriptors(n, generator) for n in (150, 90, 200)]
    sets += [noisy_copy(sets[0], generator), noisy_copy(sets[2], generator)]
    features = [features_of(s) for s in sets]
    pairs = torch.combinations(torch.arange(5))
    done: list[int] = []
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        together = match_features(features, pairs, progress=done.append)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(threads)
    assert done == list(range(1, 11))
    for (i, j), matches in zip(pairs.tolist(), together, strict=True):
        assert torch.equal(match_features(features, torch.tensor([[i, j]]))[0], matches)
        assert torch.equal(match_descriptors(sets[i], sets[j]), matches)
        swapped = match_descriptors(sets[j], sets[i], ratio=1.0).flip(1)
        assert sorted(swapped.tolist()) == match_descriptors(sets[i], sets[j], ratio=1.0).tolist()
    assert len(together[2]) > 140
    assert len(together[0]) < 10


@pytest.mark.usefixtures("unchecked")
def test_errors_name_the_argument(generator: torch.Generator) -> None:
    a = random_descriptors(5, generator)
    with pytest.raises(ValueError, match="descriptors1, descriptors2: wanted one length"):
        match_descriptors(a, a[:, :64])
    with pytest.raises(ValueError, match="descriptors1: wanted shape"):
        match_descriptors(a[0], a)
    with pytest.raises(ValueError, match="float32"):
        match_descriptors(a.float(), a.double())
    with pytest.raises(ValueError, match="ratio: wanted float > 0"):
        match_descriptors(a, a, ratio=0.0)
    with pytest.raises(ValueError, match="pairs: wanted indices from 0 to 0"):
        match_features([features_of(a)], torch.tensor([[0, 1]]))


def camera_of(path: Path) -> tuple[Tensor, Tensor, Tensor]:
    rows = [list(map(float, line.split())) for line in path.read_text().splitlines() if line.strip()]
    K, Rt = (torch.tensor(rows[k : k + 3], dtype=torch.float64) for k in (0, 3))
    return K, Rt[:, :3], Rt[:, 3]


def fundamental_of(folder: Path, i: int, j: int) -> Tensor:
    (K1, R1, t1), (K2, R2, t2) = (camera_of(folder / f"{k:04d}.txt") for k in (i, j))
    R = R2 @ R1.mT
    t = t2 - R @ t1
    cross = torch.tensor([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]], dtype=torch.float64)
    return torch.linalg.inv(K2).mT @ cross @ R @ torch.linalg.inv(K1)


def epipolar_error(F: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
    """Sampson's distance in pixels."""
    ones = torch.ones(len(x1), 1, dtype=torch.float64)
    h1, h2 = torch.cat([x1.double(), ones], 1), torch.cat([x2.double(), ones], 1)
    l2, l1 = h1 @ F.mT, h2 @ F
    return (h2 * l2).sum(1).abs() / (l1[:, :2].square().sum(1) + l2[:, :2].square().sum(1)).sqrt()


def test_matches_of_photographs_obey_their_cameras(data: Path) -> None:
    folder = data / "images" / "fountain-P11"
    features = [detect_features(read_image(folder / "images" / f"{i:04d}.jpg", gray=True), 4000) for i in (4, 5, 7)]
    pairs = torch.tensor([[0, 1], [0, 2], [1, 2]])
    near, wide, middle = match_features(features, pairs)
    for matches, (a, b), (i, j), least in (
        (near, (0, 1), (4, 5), 1200),
        (wide, (0, 2), (4, 7), 300),
        (middle, (1, 2), (5, 7), 700),
    ):
        error = epipolar_error(fundamental_of(folder / "gt", i, j), features[a].x[matches[:, 0]], features[b].x[matches[:, 1]])
        assert len(matches) > least
        assert (error < 1).double().mean() > 0.85
        assert error.median() < 0.2
