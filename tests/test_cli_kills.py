"""Runs that are killed, that meet a full disk, and that meet each other: what is found afterwards is whole."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from chance import stream_seed
from command_line import same_model, torchsfm

from torchsfm.cli.output import output_folder
from torchsfm.formats import read_colmap, read_ply
from torchsfm.reconstruction import Reconstruction

pytestmark = pytest.mark.slow
KILLS = 50


@pytest.fixture
def courtyard(courtyard: Path) -> list[Path]:
    return sorted(courtyard.iterdir())


@contextmanager
def running(*words: object) -> Iterator[subprocess.Popen[str]]:
    """The command in a process of its own."""
    command = [sys.executable, "-m", "torchsfm", *map(str, words)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as process:
        try:
            yield process
        finally:
            process.kill()


def results(out: Path) -> dict[str, bytes]:
    """Everything that a run leaves for its user, and that it all belongs to one run."""
    files = {path.relative_to(out).as_posix(): path for path in out.rglob("*") if path.is_file()}
    files = {name: path for name, path in files.items() if not name.startswith((".", "stages/"))}
    if not files:
        return {}
    record = json.loads(files["report.json"].read_text())
    model = Reconstruction.load(out / "model.npz")
    names = [image["name"] for image in record["images"]]
    assert list(model.names) == names
    assert list(read_colmap(out / "colmap").names) == names
    points = record["models"][0]["points"]
    assert model.num_points == len(read_ply(out / "points.ply").X) == read_colmap(out / "colmap").num_points == points
    assert all(f"| {name} |" in (out / "report.md").read_text() for name in names)
    assert all(f'"{name}"' in (out / "page.html").read_text() for name in names)
    assert (out / "page.html").read_text().rstrip().endswith("</html>")
    return {name: path.read_bytes() for name, path in files.items()}


def test_a_run_killed_at_any_moment(courtyard: list[Path], tmp_path: Path) -> None:
    """After each kill the results before or the new ones are there, whole, and the next run is not held up."""
    out, chance = tmp_path / "out", random.Random(stream_seed())
    started = time.monotonic()
    with running("reconstruct", *courtyard[:2], "--out", out) as process:
        assert process.wait() == 0
    duration = time.monotonic() - started
    before, changes = results(out), 0
    for k in range(KILLS):
        images = courtyard[: 2 + (k + 1) % 2]
        with running("reconstruct", *images, "--out", out, *(["--resume"] if k % 3 else [])) as process:
            if k % 2:  # any moment
                time.sleep(chance.uniform(0, duration))
            else:  # while results are written, which is but a small part of the time
                assert process.stderr is not None
                lines = iter(process.stderr.readline, "")
                assert any(line.startswith("writing results") for line in lines)
                time.sleep(chance.uniform(0, 0.05 * duration))
            process.send_signal(signal.SIGKILL)
            process.communicate()
        with output_folder(out):  # as every command does first
            pass
        after = results(out)
        assert after
        changes += after != before
        assert not [path for path in out.rglob(".*") if path.name != ".lock"]
        before = after
    assert changes > 0
    assert torchsfm("reconstruct", *courtyard[:3], "--out", out, "--resume")[0] == 0
    assert torchsfm("reconstruct", *courtyard[:3], "--out", tmp_path / "clean")[0] == 0
    assert same_model(out / "model.npz", tmp_path / "clean/model.npz")


def test_two_runs_into_one_folder(courtyard: list[Path], tmp_path: Path) -> None:
    for _ in range(5):
        words = ("reconstruct", *courtyard[:2], "--out", tmp_path)
        with running(*words) as first, running(*words) as second:
            ended = [(*process.communicate(), process.returncode) for process in (first, second)]
        assert sorted(status for _, _, status in ended) == [0, 2]
        (refused,) = (stderr for _, stderr, status in ended if status == 2)
        assert len(refused.splitlines()) == 1
        assert f"{tmp_path}: another run is writing to it (process " in refused
        assert results(tmp_path)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of one megabyte."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "none", disk], capture_output=True).returncode:
        pytest.skip("no disk can be made here")
    yield disk
    subprocess.run(["umount", disk], check=True)


def test_a_disk_that_fills_up(courtyard: list[Path], small_disk: Path) -> None:
    """With ever less room a run succeeds, or says that there is no space and leaves what was there."""
    assert torchsfm("reconstruct", *courtyard[:2], "--out", small_disk / "out", "--max-features", 500)[0] == 0
    before, statuses = results(small_disk / "out"), []
    for room in range(0, 800_000, 50_000):
        ballast = small_disk / "ballast"
        free = os.statvfs(small_disk).f_bavail * os.statvfs(small_disk).f_frsize
        ballast.write_bytes(bytes(max(free - room, 0)))
        status, _, stderr = torchsfm("reconstruct", *courtyard[:3], "--out", small_disk / "out", "--max-features", 500)
        ballast.unlink()
        statuses.append(status)
        if status:
            assert status == 2
            assert stderr.splitlines()[-1].endswith("No space left on device")
            assert results(small_disk / "out") == before
        else:
            before = results(small_disk / "out")
    assert set(statuses) == {0, 2}
