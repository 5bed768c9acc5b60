"""Stages on disk: used again only when they fit, whole or not at all."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from torchsfm.reconstruction.matching.stages import Arrays, Stages, clear_stages, fingerprint, saved_stages
from torchsfm.reconstruction.model.files import held_file


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
    path = tmp_path / "stages" / "match" / "000000.npz"
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


# ---- shards ----------------------------------------------------------------------------------------------------------------


def numbered(calls: list[int]) -> Callable[[int], Arrays]:
    """Shards that tell their number, and when they are computed."""

    def compute(number: int) -> Arrays:
        calls.append(number)
        return {"number": torch.tensor(number), "rest": torch.arange(number)}

    return compute


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("saved", [True, False])
def test_shards_are_made_once_and_read_in_part(tmp_path: Path, threads: int, saved: bool) -> None:
    stages, calls = Stages(tmp_path if saved else None, True, "x", first=0.5), list[int]()
    shards = stages.shards("match", 5, numbered(calls), threads=threads)
    assert sorted(calls) == list(range(5))
    assert [int(shard["number"]) for shard in shards] == list(range(5))
    assert len(shards[3]["rest"]) == 3
    assert shards.only(2, "number").keys() == {"number"}
    assert [int(shard["number"]) for shard in shards[1:3]] == [1, 2]
    with pytest.raises(IndexError):
        shards[5]
    if saved:
        Stages(tmp_path, True, "x").shards("match", 5, numbered(calls))
        assert len(calls) == 5
        assert not [path for path in tmp_path.rglob(".*") if path.is_file()]


def test_one_lost_shard_is_made_again_alone(tmp_path: Path) -> None:
    calls: list[int] = []
    shards = Stages(tmp_path, True, "x").shards("match", 6, numbered(calls))
    (tmp_path / "stages/match/000004.npz").unlink()
    damaged = tmp_path / "stages/match/000001.npz"
    damaged.write_bytes(damaged.read_bytes()[:-30])
    Stages(tmp_path, True, "x").shards("match", 6, numbered(calls))
    assert calls[6:] == [1, 4]
    # Also one that is lost after all were found.
    damaged.write_bytes(damaged.read_bytes()[:50])
    assert int(shards[1]["number"]) == 1
    assert calls[8:] == [1]


@pytest.mark.parametrize(("count", "after", "resume"), [(4, "", True), (3, "y", True), (3, "", False)])
def test_shards_of_another_division_or_input_are_made_anew(tmp_path: Path, count: int, after: str, resume: bool) -> None:
    calls: list[int] = []
    Stages(tmp_path, True, "x").shards("match", 3, numbered(calls))
    Stages(tmp_path, True, "x").shards("verify", 3, numbered(calls))
    Stages(tmp_path, resume, "x").shards("match", count, numbered(calls), after=after)
    assert calls[6:] == list(range(count))
    Stages(tmp_path, resume, "x").shards("match", 2, numbered(calls))
    assert sorted(path.name for path in (tmp_path / "stages/match").iterdir()) == ["000000.npz", "000001.npz"]
    assert saved_stages(tmp_path) == ["match", "verify"]
    clear_stages(tmp_path)
    assert saved_stages(tmp_path) == []


def test_several_share_the_work(tmp_path: Path) -> None:
    """Threads that each think they are alone: every shard is computed by one of them, and all find all."""
    count, calls = 24, list[int]()

    def slow(number: int) -> Arrays:
        time.sleep(0.005)
        return numbered(calls)(number)

    def work(rank: int) -> list[int]:
        shards = Stages(tmp_path, True, "x", first=rank / 4).shards("match", count, slow)
        return [int(shard["number"]) for shard in shards]

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(work, range(4))) == [list(range(count))] * 4
    assert sorted(calls) == list(range(count))


def test_what_another_holds_is_waited_for(tmp_path: Path) -> None:
    """A shard that others hold is taken up when they let it go and have not made it."""
    calls: list[int] = []
    (tmp_path / "stages/match").mkdir(parents=True)
    with ThreadPoolExecutor(1) as pool:
        with held_file(tmp_path / "stages/match/.000001.lock") as mine:
            assert mine
            waiting = pool.submit(Stages(tmp_path, True, "x").shards, "match", 3, numbered(calls))
            while len(calls) < 2:
                time.sleep(0.01)
            time.sleep(0.2)
            assert calls == [0, 2]
            assert not waiting.done()
            with held_file(tmp_path / "stages/match/.000001.lock") as second:
                assert not second
        assert len(waiting.result()) == 3
    assert calls == [0, 2, 1]
