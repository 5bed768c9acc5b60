"""The command started several times at once."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from datetime import timedelta
from pathlib import Path

import pytest
import torch.distributed
from chance import stream_seed
from command_line import copies, same_model, torchsfm

from bench import kills
from bench.kills import shards, workers
from torchsfm.cli import ranks
from torchsfm.cli.ranks import Started
from torchsfm.reconstruction.matching.stages import saved_stages

KILLS = 20
LAST = {"features": 1, "pairs": 5, "match": 6, "overlays": 7, "verify": 8, "map": 9}
"""How many files there are when each stage may be under way."""
LAUNCHED = {"RANK": "1", "WORLD_SIZE": "3", "MASTER_ADDR": "localhost", "MASTER_PORT": "29500"}


def test_what_the_environment_says() -> None:
    assert Started.by({}) == Started()
    assert Started.by(LAUNCHED) == Started(1, 3)
    assert Started.by(LAUNCHED | {"TORCHELASTIC_RESTART_COUNT": "2"}) == Started(1, 3, attempt=2)
    assert Started.by({"RANK": "1", "WORLD_SIZE": "3"}) == Started(), "of a batch system, without a place to meet"


@pytest.mark.parametrize("resume", [False, True])
def test_one_alone_meets_nobody(resume: bool, tmp_path: Path) -> None:
    assert Started().begin(tmp_path, resume) is resume


@pytest.mark.parametrize(
    ("rank", "attempt", "resume", "kept"),
    [(0, 0, False, False), (0, 1, False, True), (0, 0, True, True), (1, 0, False, True)],
)
def test_the_first_removes_what_is_of_no_use(
    rank: int, attempt: int, resume: bool, kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = torch.distributed.HashStore()
    monkeypatch.setattr(ranks, "rendezvous", lambda url: iter([(store, rank, 2)]))
    if rank > 0:
        monkeypatch.setattr(ranks, "LONGEST_START", timedelta(milliseconds=20))
        with pytest.raises(torch.distributed.DistStoreError, match="timeout"):
            Started(rank, 2, attempt).begin(tmp_path, resume)
        store.set(f"torchsfm ready {attempt}", "")
    (tmp_path / "stages/match").mkdir(parents=True)
    (tmp_path / "stages/match/000000.npz").write_bytes(b"")
    (tmp_path / "stages/features.npz").write_bytes(b"of an earlier version")
    assert Started(rank, 2, attempt).begin(tmp_path, resume)
    assert store.check([f"torchsfm ready {attempt}"])
    assert (saved_stages(tmp_path) == ["match"]) == kept
    assert (tmp_path / "stages/features.npz").exists() == kept


def test_a_helper_makes_the_stages_and_leaves_the_rest(
    courtyard: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One process after the other: the second does everything but the model, the first has nothing else left to do."""
    images = copies(courtyard, tmp_path / "images", "view0.png", "view1.png", "view2.png")
    words = ("reconstruct", images, "--max-features", 600, "--seed", 2)
    assert torchsfm(*words, "--out", tmp_path / "alone")[0] == 0
    with monkeypatch.context() as patched:
        patched.setattr(Started, "begin", lambda started, folder, resume: True)
        patched.setattr(Started, "by", classmethod(lambda cls: cls(1, 2)))
        assert torchsfm(*words, "--out", tmp_path / "out") == (0, "", "")
    assert saved_stages(tmp_path / "out") == ["features", "match", "overlays", "pairs", "verify"]
    assert not (tmp_path / "out/model.npz").exists()
    status, _, stderr = torchsfm(*words, "--out", tmp_path / "out", "--resume")
    assert status == 0
    assert [line for line in stderr.splitlines() if "..." in line] == ["building the model ...", "writing results ..."]
    assert same_model(tmp_path / "alone/model.npz", tmp_path / "out/model.npz")


# ---- torchrun ------------------------------------------------------------------------------------------------------------


def launch(count: int, *words: object) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", count, "--max-restarts", 3, "-m", "torchsfm"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    quiet = subprocess.DEVNULL
    return subprocess.Popen([str(word) for word in (*command, *words)], stdout=quiet, stderr=quiet, env=environment)


@pytest.mark.slow
def test_ranks_killed_at_any_moment(courtyard: Path, tmp_path: Path) -> None:
    """In whatever stage a rank is killed the run ends with the same model, and what was saved is not made again."""
    words, chance = ("reconstruct", courtyard, "--max-features", 600), random.Random(stream_seed())
    assert torchsfm(*words, "--out", tmp_path / "alone")[0] == 0
    for k in range(KILLS):
        out = tmp_path / str(k)
        with launch(2, *words, "--out", out) as process:
            wanted = list(LAST.values())[k % len(LAST)]
            while len(shards(out)) < wanted and process.poll() is None:
                time.sleep(0.01)
            time.sleep(chance.uniform(0, 0.3))
            before = shards(out)
            alive = workers(process.pid)
            if alive:
                os.kill(chance.choice(alive), signal.SIGKILL)
            assert process.wait() == 0
        after = shards(out)
        assert {name: after[name] for name in before} == before
        assert same_model(tmp_path / "alone/model.npz", out / "model.npz")
        assert not [path for path in out.rglob(".*") if path.name != ".lock"]


@pytest.mark.slow
@pytest.mark.parametrize("stage", LAST)
def test_begun_with_two_and_finished_with_three(stage: str, courtyard: Path, tmp_path: Path) -> None:
    """Ended from outside in a stage; of the three that go on one is killed, too."""
    words, chance = ("reconstruct", courtyard, "--max-features", 600, "--out", tmp_path / "out"), random.Random(stream_seed())
    with launch(2, *words) as process:
        while len(shards(tmp_path / "out")) < LAST[stage] and process.poll() is None:
            time.sleep(0.01)
        process.terminate()
    first = shards(tmp_path / "out")
    with launch(3, *words, "--resume") as process:
        while not (alive := workers(process.pid)) and process.poll() is None:
            time.sleep(0.01)
        time.sleep(chance.uniform(0, 8))
        before, alive = shards(tmp_path / "out"), workers(process.pid)
        if alive:
            os.kill(chance.choice(alive), signal.SIGKILL)
        assert process.wait() == 0
    after = shards(tmp_path / "out")
    assert {name: after[name] for name in before} == before
    assert first.items() <= before.items()
    assert torchsfm(*words[:-1], tmp_path / "alone")[0] == 0
    assert same_model(tmp_path / "alone/model.npz", tmp_path / "out/model.npz")


@pytest.mark.slow
def test_the_bench_kills_in_every_stage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Once each; what is on the record is not done again."""
    words = ["--times", "1", "--grow", "0", "--record", str(tmp_path / "record")]
    kills.main(words)
    record = (tmp_path / "record").read_text()
    assert {json.loads(line)["stage"] for line in record.splitlines()} >= {*kills.STAGES, "track"}
    capsys.readouterr()
    kills.main(words)
    assert (tmp_path / "record").read_text() == record
    assert "Kill(" not in capsys.readouterr().out
