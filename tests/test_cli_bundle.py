"""`torchsfm bundle`: every format in, a report of before and after, every format out, and one line where the user errs."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from chance import seeded
from command_line import torchsfm

from torchsfm.cli.job import Job
from torchsfm.formats import read_bal, read_colmap, read_ply, write_bal, write_colmap
from torchsfm.geometry import BrownConrady, BundleProblem, Camera
from torchsfm.reconstruction import Reconstruction
from torchsfm.simulation import random_bundle_problem

F64 = torch.float64


def assert_one_line(stderr: str, *words: str) -> None:
    lines = [line for line in stderr.strip().splitlines() if not line.endswith("...")]
    assert len(lines) == 1, stderr
    assert lines[0].startswith("torchsfm: ")
    for word in words:
        assert word in lines[0]


def table(text: str) -> dict[str, list[float]]:
    """The lines of the report that begin with before and after, as numbers."""
    return {m[1]: [float(v) for v in m[2].split()] for m in re.finditer(r"^(before|after)\s+(.*)$", text, re.MULTILINE)}


@pytest.fixture(scope="module")
def problem() -> BundleProblem:
    """Small enough to be quick."""
    return random_bundle_problem(6, 80, 260, layout="path", generator=seeded(3)).problem


@pytest.fixture
def bal(problem: BundleProblem, tmp_path: Path) -> Path:
    write_bal(problem, tmp_path / "problem.txt.gz")
    return tmp_path / "problem.txt.gz"


def as_model(problem: BundleProblem) -> Reconstruction:
    order = torch.argsort(problem.point * 6 + problem.view)
    return Reconstruction(
        names=tuple(f"{k}.jpg" for k in range(6)),
        image_size=torch.full((6, 2), 2000),
        cameras=problem.cameras,
        camera_index=problem.camera_index,
        poses=problem.poses,
        registered=torch.ones(6, dtype=torch.bool),
        X=problem.X,
        color=torch.rand(len(problem.X), 3, dtype=F64),
        x=problem.x[order],
        view=problem.view[order],
        point=problem.point[order],
    )


def test_report_of_before_and_after(bal: Path, problem: BundleProblem) -> None:
    status, text, stderr = torchsfm("bundle", bal, "--tolerance", 1e-9)
    assert status == 0, stderr
    assert "6 views, 6 cameras (Radial), 80 points, 260 observations; free intrinsics: focal, k1, k2" in text
    rows = table(text)
    before, quantiles = problem.residuals(), torch.tensor([0.5, 0.9], dtype=F64)
    expected = [float(before.square().sum() / 2), float(before.square().mean().sqrt()), *before.quantile(quantiles).tolist()]
    assert rows["before"] == pytest.approx(expected, rel=1e-3)
    cost, rms, median, ninety = rows["after"]
    assert cost < 0.01 * rows["before"][0]
    assert median < rms < ninety < 2
    assert re.search(r"converged after \d+ iterations, \d+\.\d\d s", text)
    assert "adjusting" in stderr


def test_every_format_out(bal: Path, tmp_path: Path) -> None:
    costs = {}
    for name in ("out.txt", "out.txt.bz2", "out.npz", "colmap"):
        status, text, stderr = torchsfm("bundle", bal, "--out", tmp_path / name)
        assert status == 0, stderr
        assert f"written: {tmp_path / name}" in text
        path = tmp_path / name
        model = {"out.npz": Reconstruction.load, "colmap": read_colmap}.get(name, read_bal)(path)
        costs[name] = float(model.residuals().square().sum() / 2)
        assert costs[name] == pytest.approx(table(text)["after"][0], rel=1e-4)
    torchsfm("bundle", bal, "--out", tmp_path / "out.ply")
    assert len(read_ply(tmp_path / "out.ply").X) == 80


def test_every_format_in(problem: BundleProblem, bal: Path, tmp_path: Path) -> None:
    model = as_model(problem)
    model.save(tmp_path / "model.npz")
    _, expected, _ = torchsfm("bundle", bal)
    status, text, _ = torchsfm("bundle", tmp_path / "model.npz", "--out", tmp_path / "new.npz")
    assert status == 0
    assert table(text)["after"][0] == pytest.approx(table(expected)["after"][0], rel=1e-4)
    new = Reconstruction.load(tmp_path / "new.npz")
    assert new.names == model.names
    assert torch.equal(new.color, model.color)
    write_colmap(model, tmp_path / "folder")
    status, text, _ = torchsfm("bundle", tmp_path / "folder")
    assert status == 0
    assert table(text)["after"][0] == pytest.approx(table(expected)["after"][0], rel=1e-4)


def test_libmv(data: Path, tmp_path: Path) -> None:
    status, text, _ = torchsfm(
        "bundle", data / "bal/libmv_problem_01.bin", "--free", "focal,k1,k2", "--threads", torch.get_num_threads(),
        "--out", tmp_path / "out.npz",
    )  # fmt: skip
    assert status == 0
    assert table(text)["before"][1] == pytest.approx(1.304, abs=1e-3)
    assert table(text)["after"][1] < 1.295
    assert len(Reconstruction.load(tmp_path / "out.npz").cameras.K) == 1


def test_options_reach_the_adjustment(bal: Path) -> None:
    _, squares, _ = torchsfm("bundle", bal)
    _, robust, _ = torchsfm("bundle", bal, "--loss", "cauchy", "--loss-scale", 0.5)
    assert table(robust)["before"][0] < 0.01 * table(squares)["before"][0]
    assert table(robust)["after"][0] < table(squares)["after"][0]
    _, held, _ = torchsfm("bundle", bal, "--free", "none")
    assert "free intrinsics: none" in held
    assert table(held)["after"][0] > table(squares)["after"][0]
    _, short, _ = torchsfm("bundle", bal, "--max-iterations", 1)
    assert "stopped at the largest number of iterations after 1 iterations" in short


def test_interrupt_keeps_the_best_so_far(bal: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = Job.progress

    def progress(self: Job, stage: str, done: int, total: int) -> None:
        plain(self, stage, done, total)
        if (stage, done) == ("bundle", 2):
            raise KeyboardInterrupt

    monkeypatch.setattr(Job, "progress", progress)
    status, text, _ = torchsfm("bundle", bal, "--out", tmp_path / "out.txt")
    assert status == 130
    assert "interrupted after 2 iterations" in text
    cost = float(read_bal(tmp_path / "out.txt").residuals().square().sum() / 2)
    assert cost == pytest.approx(table(text)["after"][0], rel=1e-4)
    assert cost < 0.5 * table(text)["before"][0]


def test_what_is_not_there(tmp_path: Path) -> None:
    for name in ("none.txt", "none.npz", "none.bin", "nowhere"):
        status, _, stderr = torchsfm("bundle", tmp_path / name)
        assert status == 2
        assert_one_line(stderr, name, "no such file")


def test_damaged_files(tmp_path: Path) -> None:
    for name, data, words in (
        ("a.txt", b"1 1 1\n0 0", "truncated"),
        ("a.txt.gz", b"no archive", "damaged archive"),
        ("a.txt.bz2", b"no archive", "damaged archive"),
        ("a.bin", b"xx", "not a libmv problem"),
        ("a.npz", b"xx", "not a saved reconstruction"),
        ("a.txt", b"words", "not a BAL problem"),
    ):
        (tmp_path / name).write_bytes(data)
        status, _, stderr = torchsfm("bundle", tmp_path / name)
        assert status == 2
        assert_one_line(stderr, name, words)
    (tmp_path / "folder").mkdir()
    status, _, stderr = torchsfm("bundle", tmp_path / "folder")
    assert status == 2
    assert_one_line(stderr)


def test_wrong_options(bal: Path, problem: BundleProblem, tmp_path: Path) -> None:
    status, _, stderr = torchsfm("bundle", bal, "--free", "focal,p1")
    assert status == 2
    assert_one_line(stderr, "--free", "p1", "k2")
    status, _, stderr = torchsfm("bundle", bal, "--out", tmp_path / "no" / "where.npz")
    assert status == 2
    assert_one_line(stderr, "no such folder")
    assert torchsfm("bundle", bal, "--loss", "l7")[0] == 2
    assert torchsfm("bundle", bal, "--threads", 0)[0] == 2
    brown = BrownConrady(*(torch.zeros(6, dtype=F64) for _ in range(5)))
    as_model(replace(problem, cameras=Camera(problem.cameras.K, brown))).save(tmp_path / "brown.npz")
    status, _, stderr = torchsfm("bundle", tmp_path / "brown.npz", "--out", tmp_path / "brown.txt")
    assert status == 2
    assert_one_line(stderr, "BrownConrady")


def test_nothing_to_adjust(tmp_path: Path) -> None:
    (tmp_path / "empty.txt").write_text("0 0 0\n")
    (tmp_path / "nan.txt").write_text("1 1 1\n0 0 nan nan\n" + "0 " * 6 + "100 0 0\n0 0 -5\n")
    for name in ("empty.txt", "nan.txt"):
        status, _, stderr = torchsfm("bundle", tmp_path / name)
        assert status == 1
        assert_one_line(stderr, name, "nothing to adjust")
