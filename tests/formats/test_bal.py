"""BAL problems: what comes out goes in again, and every kind of damage is told in one line."""

import bz2
import gzip
import re
from pathlib import Path

import pytest
import torch
from chance import seeded
from full_disk import full_disk
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchsfm.formats import read_bal, write_bal
from torchsfm.geometry import (
    BrownConrady,
    BundleProblem,
    Camera,
    NoDistortion,
    Pose,
    Radial,
    SimpleRadial,
    intrinsics,
    random_rotation,
)

F64 = torch.float64
ONE = settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])


def make_problem(views: int, points: int, observations: int, seed: int, model: type = Radial) -> BundleProblem:
    g = seeded(seed)
    groups = max(views, 1)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=g, dtype=F64)

    return BundleProblem(
        Pose(random_rotation(views, generator=g, dtype=F64), draw(views, 3)),
        Camera(
            intrinsics(100 + draw(groups), draw(groups, 2) * 50),
            model.from_parameters(draw(groups, model.num_parameters)) if model.num_parameters else model(),
        ),
        torch.randint(groups, (views,), generator=g),
        draw(points, 3) * 10,
        draw(observations, 2) * 300,
        torch.randint(max(views, 1), (observations,), generator=g),
        torch.randint(max(points, 1), (observations,), generator=g),
    )


@ONE
@given(
    views=st.integers(1, 4),
    points=st.integers(1, 5),
    observations=st.integers(0, 9),
    seed=st.integers(0, 2**31),
    model=st.sampled_from([NoDistortion, SimpleRadial, Radial]),
    suffix=st.sampled_from([".txt", ".txt.gz", ".txt.bz2"]),
)
def test_round_trip(tmp_path: Path, views: int, points: int, observations: int, seed: int, model: type, suffix: str) -> None:
    problem = make_problem(views, points, observations, seed, model)
    write_bal(problem, tmp_path / f"problem{suffix}")
    found = read_bal(tmp_path / f"problem{suffix}")
    torch.testing.assert_close(found.residuals(), problem.residuals(), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(found.poses.R, problem.poses.R, rtol=0, atol=1e-9)
    assert torch.equal(found.poses.t, problem.poses.t)
    assert torch.equal(found.X, problem.X)
    assert torch.equal(found.view, problem.view)
    assert torch.equal(found.point, problem.point)
    assert torch.equal(found.cameras.K[:, 0, 0], problem.cameras.K[problem.camera_index, 0, 0])
    # And a second time nothing changes but the rounding of rotations.
    write_bal(found, tmp_path / "again.txt")
    again = read_bal(tmp_path / "again.txt")
    assert torch.equal(again.x, found.x)
    torch.testing.assert_close(again.poses.R, found.poses.R, rtol=0, atol=1e-9)


def test_empty_problem(tmp_path: Path) -> None:
    (tmp_path / "empty.txt").write_text("0 0 0\n")
    problem = read_bal(tmp_path / "empty.txt")
    assert (len(problem.X), len(problem.x), problem.poses.shape[0]) == (0, 0, 0)


def test_camera_looks_forwards(tmp_path: Path) -> None:
    """One camera at the origin: a point at z = -5 of the file is in front, and up in its image is up here (negative y)."""
    (tmp_path / "one.txt").write_text("1 1 1\n0 0 20.0 40.0\n0 0 0\n0 0 0\n100 0 0\n1.0 2.0 -5.0\n")
    problem = read_bal(tmp_path / "one.txt")
    assert problem.depths().tolist() == [5.0]
    assert problem.x.tolist() == [[20.0, -40.0]]
    assert problem.residuals().tolist() == [0.0]


@pytest.mark.parametrize(
    ("name", "cost"),
    [
        ("dubrovnik-3-7-pre.txt", 2764.22),
        ("problem-49-7776-pre.txt.gz", 8.509125e5),
        ("problem-21-11315-pre.txt.gz", 4.413239e6),
    ],
)
def test_real_problems_have_their_known_cost(data: Path, name: str, cost: float) -> None:
    problem = read_bal(data / "bal" / name)
    assert float(problem.residuals().square().sum() / 2) == pytest.approx(cost, rel=1e-6)
    assert (problem.depths() > 0).double().mean() > 0.99


@ONE
@given(cut=st.integers(0, 10_000), suffix=st.sampled_from([".txt", ".txt.gz", ".txt.bz2"]))
def test_truncated_files(tmp_path: Path, cut: int, suffix: str) -> None:
    path = tmp_path / f"cut{suffix}"
    write_bal(make_problem(3, 4, 8, 0), path)
    whole = path.read_bytes()
    # The last number may lose digits without anybody being able to tell.
    path.write_bytes(whole[: cut % (len(whole) - 25)])
    with pytest.raises(ValueError, match=re.escape(path.name)) as caught:
        read_bal(path)
    assert "\n" not in str(caught.value)


@ONE
@given(noise=st.binary(max_size=200), suffix=st.sampled_from([".txt", ".txt.gz", ".txt.bz2"]))
def test_noise_is_no_problem(tmp_path: Path, noise: bytes, suffix: str) -> None:
    path = tmp_path / f"noise{suffix}"
    path.write_bytes({".gz": gzip.compress, ".bz2": bz2.compress}.get(path.suffix, bytes)(noise + b" x"))
    with pytest.raises(ValueError, match="not a BAL problem") as caught:
        read_bal(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "numbers of cameras"),
        ("1 1", "numbers of cameras"),
        ("-1 1 1", "numbers of cameras"),
        ("1.5 1 1", "numbers of cameras"),
        ("nan 1 1", "numbers of cameras"),
        ("99999999 99999999 99999999", "truncated"),
        ("1 1 1\n0 0 1 1\n" + "0 " * 13, "too long"),
        ("1 1 1\n1 0 1 1\n" + "0 " * 12, "observation 0: there is no number 1 among 1 cameras"),
        ("1 1 1\n0 -1 1 1\n" + "0 " * 12, "observation 0: there is no number -1 among 1 points"),
        ("1 1 1\n0 0.5 1 1\n" + "0 " * 12, "there is no number 0.5"),
        ("1 1 1\n0 nan 1 1\n" + "0 " * 12, "there is no number nan"),
        ("1 1 1\n0 0 one 1\n" + "0 " * 12, "one"),
    ],
)
def test_wrong_numbers(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "bad.txt").write_text(text)
    with pytest.raises(ValueError, match=words) as caught:
        read_bal(tmp_path / "bad.txt")
    assert "bad.txt" in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    for name in ("none.txt", "none.txt.gz", "none.txt.bz2"):
        with pytest.raises(FileNotFoundError):
            read_bal(tmp_path / name)


def test_cameras_that_bal_cannot_hold(tmp_path: Path) -> None:
    problem = make_problem(2, 3, 4, 1)

    def with_K(row: int, column: int, value: float) -> BundleProblem:
        K = problem.cameras.K.clone()
        K[0, row, column] = value
        return BundleProblem(problem.poses, Camera(K, problem.cameras.distortion), *list(vars(problem).values())[2:])

    for wrong, words in ((with_K(0, 1, 1.0), "skew"), (with_K(1, 1, 7.0), "square")):
        with pytest.raises(ValueError, match=words):
            write_bal(wrong, tmp_path / "x.txt")
    with pytest.raises(ValueError, match="BrownConrady"):
        write_bal(make_problem(2, 3, 4, 1, BrownConrady), tmp_path / "x.txt")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 1 1\n0 0 1 1\n" + "0 " * 8 + "nan " + "0 " * 3, "camera 0 is not finite"),
        ("1 1 1\n0 0 1 1\n1e300 1e300 " + "0 " * 10, "camera 0 is turned by an angle that is none"),
        ("1 2 1\n0 0 1 1\n" + "0 " * 9 + "0 0 0 0 1e999 0", "point 1 is not finite"),
    ],
)
def test_cameras_and_points_are_finite(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "bad.txt").write_text(text)
    with pytest.raises(ValueError, match=rf"bad\.txt: {words}"):
        read_bal(tmp_path / "bad.txt")


@pytest.mark.parametrize("suffix", [".gz", ".bz2"])
def test_an_archive_made_to_fill_the_memory(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"bomb.txt{suffix}"
    path.write_bytes({".gz": gzip.compress, ".bz2": bz2.compress}[suffix](b"1 " * 2**24))
    assert path.stat().st_size < 10**5
    with pytest.raises(ValueError, match=r"bomb.*unpacks to more than"):
        read_bal(path)


@pytest.mark.parametrize("suffix", ["", ".gz", ".bz2"])
def test_a_full_disk_leaves_the_problem_before(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.txt{suffix}"
    write_bal(make_problem(3, 4, 8, 0), path)
    before = path.read_bytes()
    with full_disk(500), pytest.raises(OSError, match="File too large"):
        write_bal(make_problem(30, 40, 80, 0), path)
    assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1
