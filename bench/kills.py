"""Ranks of `torchrun` that are killed in every stage of a reconstruction, and runs that another number of ranks finishes.

    python -m bench.kills --times 20 --record build/kills.jsonl

renders a small set of photographs, reconstructs them by two processes that `torchrun` forks, kills one with SIGKILL at a random
moment of a stage, waits for the end of the run, and compares its model, bit by bit, with that of one undisturbed process. Then
runs of which all processes, the launcher too, are killed in a stage, and which three go on with, one of these killed again at
any moment (`--grow 3` of each stage). Each kill is a line of the record, and what is there already is not done again, so a
command that was interrupted goes on where it was. At the moment of the kill all ranks are stopped, so that what has been saved
and what each works on (the locks that the system says it holds) is of that moment. A kill counts where it fell.
"""

import argparse
import json
import math
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing.process import BaseProcess
from multiprocessing.resource_tracker import ensure_running
from pathlib import Path

import numpy as np
import torch
import torch.distributed.run

import torchsfm
from torchsfm.cli import app
from torchsfm.images import save_image
from torchsfm.simulation import courtyard_scene, orbit_poses, render_sequence

STAGES = ("start", "features", "pairs", "look", "match", "overlays", "verify", "map", "write")
FILM = ("start", "features", "pairs", "match", "track", "overlays", "verify", "map", "write")
"""What frames of a film go through; only `track` is theirs alone."""
WIDTH, HEIGHT, VIEWS, FEATURES = 240, 180, 26, 250
LONGEST = 300
"""Seconds after which a run that has not ended is taken for one that never does."""
MODULE = Path(torchsfm.__file__).with_name("__main__.py")
FORK = multiprocessing.get_context("fork")


@dataclass(frozen=True)
class Kill:
    """One run, and what became of it."""

    stage: str
    """Where it was killed."""
    ranks: int
    """How many finished it; all of two were killed where there are three."""
    rank: int
    """The one that was killed; of two the launcher and all, where three finished."""
    saved: int
    """Shards that were there at the kill."""
    begun: int
    """Most shards that one rank was working on at the kill, and that were made anew."""
    kept: bool
    """Whether all that was saved was used, and not made again."""
    same: bool
    """Whether the model is that of an undisturbed process."""
    ended: int | None
    """The exit status."""
    seconds: float

    @property
    def good(self) -> bool:
        """Whether all is as it should be."""
        return self.kept and self.same and self.ended == 0 and self.begun <= 1


def photograph(folder: Path) -> Path:
    """Small photographs on an arc around the things of a courtyard."""
    generator = torch.Generator().manual_seed(0)
    poses = orbit_poses(VIEWS, radius=5.2, height=(0.6, 2.2), sweep=math.radians(60), target=(0.0, 0.0, 0.7))
    scene = courtyard_scene(texel=0.02, generator=generator)
    rendered = render_sequence(scene, poses=poses, width=WIDTH, height=HEIGHT, points=0, generator=generator)
    folder.mkdir(parents=True)
    for i, image in enumerate(rendered.images):
        save_image(folder / f"view{i:02d}.jpg", image)
    return folder


@contextmanager
def launched(count: int, *words: object) -> Iterator[BaseProcess]:
    """The command by so many processes of `torchrun`, which starts them as forks of this one."""
    how = ("--nproc-per-node", count, "--max-restarts", 3, "--start-method", "fork", "--run-path", MODULE)
    process = FORK.Process(target=_torchrun, args=([str(word) for word in (*how, *words)],))
    process.start()
    try:
        yield process
        process.join(LONGEST)
    finally:
        process.terminate()
        process.join()


def _torchrun(words: list[str]) -> None:
    """What `torchrun` does, without a word."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    sys.stdout = sys.stderr = os.fdopen(nowhere, "w")
    # Forks would have its handler; a process that is started anew ends at once.
    os.register_at_fork(after_in_child=partial(signal.signal, signal.SIGTERM, signal.SIG_DFL))
    torch.distributed.run.main(words)


def workers(launcher: int | None) -> list[int]:
    """The processes that torchrun has started, by their ranks."""
    listed = subprocess.run(["ps", "-o", "pid=", "--ppid", str(launcher)], capture_output=True, text=True)
    return sorted(int(line) for line in listed.stdout.split())


def shards(out: Path) -> dict[str, tuple[int, int]]:
    """What is saved, and when it was made."""
    found = {path: path.stat() for path in out.glob("stages/*/*.npz")}
    return {path.relative_to(out).as_posix(): (stat.st_ino, stat.st_mtime_ns) for path, stat in found.items()}


def same_model(a: Path, b: Path) -> bool:
    """Whether two files hold the same arrays, bit by bit."""
    with np.load(a) as first, np.load(b) as second:
        return set(first.files) == set(second.files) and all(np.array_equal(first[name], second[name]) for name in first.files)


def under_way(out: Path, stages: Sequence[str] = STAGES) -> str:
    """The last stage that has begun."""
    if (out / ".writing").is_dir() or (out / "report.json").exists():
        return "write"
    if next(out.glob("stages/verify/*.npz"), None) is not None:
        return "map"
    return next((name for name in reversed(stages) if (out / "stages" / name).is_dir()), "start")


def held(out: Path, pids: Sequence[int]) -> dict[int, int]:
    """How many shards each process is working on: the locks that the system says it has (Linux)."""
    places = {path.stat().st_ino for path in out.glob("stages/*/.*.lock")}
    count = dict.fromkeys(pids, 0)
    for line in Path("/proc/locks").read_text().splitlines():
        word = line.split()
        if word[1] == "FLOCK" and int(word[4]) in count and int(word[5].split(":")[-1]) in places:
            count[int(word[4])] += 1
    return count


def wait_for(stage: str, out: Path, process: BaseProcess, stages: Sequence[str], count: int = 2) -> list[int]:
    """Return the ranks as soon as all have been started and a stage, or a later one, has begun."""
    ranks: list[int] = []
    while process.is_alive():
        ranks = ranks if len(ranks) >= count else workers(process.pid)
        if len(ranks) >= count and stages.index(under_way(out, stages)) >= stages.index(stage):
            break
        time.sleep(0.0005 if len(ranks) >= count else 0.02)
    return ranks


def lengths(out: Path, words: Sequence[object], stages: Sequence[str]) -> dict[str, float]:
    """How long each stage of an undisturbed run takes."""
    begun: list[float] = []
    with launched(2, *words, "--out", out) as process:
        for stage in stages:
            wait_for(stage, out, process, stages, 1)
            begun.append(time.monotonic())
    return {stage: b - a for stage, a, b in zip(stages, begun, [*begun[1:], time.monotonic()], strict=True)}


def kill(
    ranks: Sequence[int], chosen: Sequence[int], out: Path, stages: Sequence[str]
) -> tuple[str, dict[str, tuple[int, int]], int]:
    """Kill some processes while all are stopped: the stage, what was saved, and the most shards one of them worked on."""
    for pid in ranks:
        send(pid, signal.SIGSTOP)
    seen = under_way(out, stages), shards(out), max(held(out, ranks).values(), default=0)
    for pid in chosen:
        send(pid, signal.SIGKILL)
    for pid in {*ranks} - {*chosen}:
        send(pid, signal.SIGCONT)
    return seen


def runs(pid: int) -> bool:
    """Whether a process has not ended (one that nobody has asked for its status is there still)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


def send(pid: int, number: int) -> None:
    """A signal to a process that may have ended."""
    with suppress(ProcessLookupError):
        os.kill(pid, number)


def disturbed(
    stage: str, lasts: float, out: Path, words: Sequence[object], truth: Path, chance: random.Random, *, grow: bool = False,
    stages: Sequence[str] = STAGES,
) -> Kill:  # fmt: skip
    """A run of two ranks, of which one is killed; to `grow`, all are, and three go on, of which one is killed at any moment."""
    began, rank = time.monotonic(), chance.randrange(2)
    with launched(2, *words, "--out", out) as process:
        ranks = wait_for(stage, out, process, stages)
        time.sleep(chance.uniform(0, lasts))
        alive = list(filter(runs, ranks))
        rank = min(rank, len(alive) - 1)
        assert process.pid is not None, "started"
        fell, saved, begun = kill(ranks, [process.pid, *ranks] if grow else alive[rank : rank + 1], out, stages)
    ended = process.exitcode
    kept = True
    if grow:
        before = saved
        with launched(3, *words, "--out", out, "--resume") as process:
            ranks = wait_for("start", out, process, stages, 3)
            time.sleep(chance.uniform(0, time.monotonic() - began))
            alive = list(filter(runs, ranks))
            rank = chance.randrange(max(len(alive), 1))
            _, saved, more = kill(ranks, alive[rank : rank + 1], out, stages)
        begun, kept, ended = max(begun, more), before.items() <= saved.items(), process.exitcode
    after = shards(out)
    kept = kept and all(after.get(name) == made for name, made in saved.items())
    kept = kept and not [path for path in out.rglob(".*") if path.name != ".lock"]
    same = (out / "model.npz").exists() and same_model(truth, out / "model.npz")
    seconds = time.monotonic() - began
    return Kill(fell, 3 if grow else 2, rank, len(saved), begun, kept, same, ended, round(seconds, 1))


def table(kills: Sequence[Kill]) -> str:
    """What became of the runs, by stage."""
    heads = ("killed in", "ranks at the end", "runs", "the same model", "saved shards made again", "begun by a rank, at most")
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    order = sorted(kills, key=lambda k: (k.ranks, (*STAGES, "track").index(k.stage)))
    for key in dict.fromkeys((k.stage, k.ranks) for k in order):
        some = [k for k in kills if (k.stage, k.ranks) == key]
        good, kept = sum(k.same and k.ended == 0 for k in some), sum(k.kept for k in some)
        again = "none" if kept == len(some) else f"in {len(some) - kept} runs"
        lines.append(f"| {key[0]} | {key[1]} | {len(some)} | {good} | {again} | {max(k.begun for k in some)} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Kill until each stage has had its number, then print the table."""
    parser = argparse.ArgumentParser(prog="python -m bench.kills", description="Ranks that are killed in every stage.")
    parser.add_argument("--times", type=int, default=20, help="kills of one rank in each stage")
    parser.add_argument("--grow", type=int, default=3, help="runs in each stage that two begin and three finish")
    parser.add_argument("--record", type=Path, default=Path("build/kills.jsonl"))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    ensure_running()  # once, so that ranks are the only processes that launchers start
    options.record.parent.mkdir(parents=True, exist_ok=True)
    done = [Kill(**json.loads(line)) for line in options.record.read_text().splitlines()] if options.record.exists() else []
    chance = random.Random(f"{options.seed} {len(done)}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        photographs = photograph(folder / "photographs")
        for stages, wanted, more in ((STAGES, STAGES, ()), (FILM, ("track",), ("--sequence",))):
            words = ("reconstruct", photographs, "--max-features", FEATURES, *more)
            alone = folder / f"alone{len(more)}"
            app([*map(str, words), "--out", str(alone), "--quiet"], standalone_mode=False)
            lasts = lengths(folder / f"undisturbed{len(more)}", words, stages)
            print({stage: round(seconds, 3) for stage, seconds in lasts.items()}, flush=True)
            for grow, times in ((False, options.times), (True, options.grow)):
                while True:
                    had = {s: sum(k.stage == s and k.ranks == 2 + grow for k in done) for s in wanted}
                    stage = min(wanted, key=had.__getitem__)
                    if had[stage] >= times:
                        break
                    out = folder / "out"
                    found = disturbed(stage, lasts[stage], out, words, alone / "model.npz", chance, grow=grow, stages=stages)
                    shutil.rmtree(out)
                    done.append(found)
                    with options.record.open("a") as record:
                        record.write(json.dumps(asdict(found)) + "\n")
                    print(found, flush=True)
    print(table(done))
    if not all(found.good for found in done):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
