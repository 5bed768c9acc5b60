"""Stages on disk: used again only when they fit, whole or not at all."""

from pathlib import Path

import pytest
import torch

from torchsfm.reconstruction.stages import Arrays, Stages, fingerprint


class Counter:
    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> Arrays:
        self.calls += 1
        return {"a": torch.arange(3), "b": torch.ones(2, 2)}


def test_a_saved_stage_is_used_again(tmp_path: Path) -> None:
    compute = Counter()
    first = Stages(tmp_path, True, "x").run("match", compute)
    second = Stages(tmp_path, True, "x").run("match", compute)
    assert compute.calls == 1
    assert all(torch.equal(first[key], second[key]) for key in first)


@pytest.mark.parametrize(("resume", "mark"), [(False, "x"), (True, "y")])
def test_other_input_or_no_resume_computes(tmp_path: Path, resume: bool, mark: str) -> None:
    compute = Counter()
    Stages(tmp_path, True, "x").run("match", compute)
    Stages(tmp_path, resume, mark).run("match", compute)
    assert compute.calls == 2


def test_a_cut_file_is_made_again(tmp_path: Path) -> None:
    compute = Counter()
    Stages(tmp_path, True, "x").run("match", compute)
    path = tmp_path / "stages" / "match.npz"
    path.write_bytes(path.read_bytes()[:100])
    result = Stages(tmp_path, True, "x").run("match", compute)
    assert compute.calls == 2
    assert result["a"].tolist() == [0, 1, 2]


def test_a_failing_stage_leaves_nothing(tmp_path: Path) -> None:
    def interrupted() -> Arrays:
        raise KeyboardInterrupt

    stages = Stages(tmp_path, True, "x")
    with pytest.raises(KeyboardInterrupt):
        stages.run("match", interrupted)
    assert not list(tmp_path.rglob("*.npz"))
    assert "match" in stages.seconds


def test_fingerprint_depends_on_files_and_options(tmp_path: Path) -> None:
    file = tmp_path / "a.png"
    file.write_bytes(b"one")
    base = fingerprint([file], {"seed": 0})
    assert base == fingerprint([file], {"seed": 0})
    assert base != fingerprint([file], {"seed": 1})
    file.write_bytes(b"another")
    assert base != fingerprint([file], {"seed": 0})
