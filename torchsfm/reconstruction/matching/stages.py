"""Results of finished stages on disk, so that an interrupted reconstruction goes on where it was.

A stage is a folder of shards, `match/000012.npz`. Each is written beside and renamed, and is worked on by whichever process
holds its lock: any number of them may work into one folder, and what one that was killed had begun the others take up.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np
import torch
from torch import Tensor

from torchsfm.reconstruction.model.files import HELD, held_file, load_arrays, whole_file

Arrays = dict[str, Tensor]
T = TypeVar("T")
LAYOUT = 5
"""Counts changes of what stages hold: what an earlier version of this library left is not taken for what this one does."""
PAUSE = 0.05
"""Seconds between two looks whether other processes have finished."""


@dataclass(frozen=True)
class Shards(Sequence[Arrays]):
    """The tensors of the shards of a stage, read from disk whenever one is asked for, where there is a folder."""

    size: int
    load: Callable[[int, Callable[[str], bool] | None], Arrays]
    """Those of a shard whose names pass a test."""

    def __len__(self) -> int:
        return self.size

    @overload
    def __getitem__(self, number: int) -> Arrays: ...
    @overload
    def __getitem__(self, number: slice) -> list[Arrays]: ...
    def __getitem__(self, number: int | slice) -> Arrays | list[Arrays]:
        if isinstance(number, slice):
            return [self.load(k, None) for k in range(self.size)[number]]
        return self.load(range(self.size)[number], None)

    def only(self, number: int, *names: str) -> Arrays:
        """Some tensors of a shard; the others are not read."""
        return self.load(range(self.size)[number], names.__contains__)


@dataclass
class Stages:
    """Runs stages, times them, and keeps their tensors in a folder.

    A saved stage is used again only if it was made from the same input: every file carries a fingerprint of the images and
    options before it.

    Attributes:
        folder: Where to save; nowhere when None.
        resume: Use what an earlier run saved, and what other processes save meanwhile.
        fingerprint: What the results depend on.
        first: Where in a stage to begin, as a fraction of it, so that several processes do not begin at the same place.
        seconds: Time each stage took.
        made: The shards computed here.
    """

    folder: Path | None
    resume: bool
    fingerprint: str
    first: float = 0.0
    seconds: dict[str, float] = field(default_factory=dict)
    made: set[Path] = field(default_factory=set)

    def run(self, name: str, compute: Callable[[], Arrays], *, after: str = "") -> Arrays:
        """The tensors of a stage, from disk if they are there and fit, else computed and saved; `after` as for `shards`."""
        return self.shards(name, 1, lambda _: compute(), after=after)[0]

    def shards(self, name: str, count: int, compute: Callable[[int], Arrays], *, after: str = "", threads: int = 1) -> Shards:
        """A stage of many shards, each from disk if it is there and fits, else computed and saved.

        Returns when all are there, whichever process made them.

        Args:
            name: The stage.
            count: How many shards it has.
            compute: The tensors of one.
            after: What it depends on besides the fingerprint of all stages.
            threads: How many are computed at once.
        """
        mark = hashlib.sha256(f"{LAYOUT} {self.fingerprint} {name} {count} {after}".encode()).hexdigest()[:32]
        with self.timed(name):
            if self.folder is None:
                made = _each(compute, range(count), threads)
                return Shards(count, lambda k, wanted: {n: v for n, v in made[k].items() if wanted is None or wanted(n)})
            folder = self.folder / "stages" / name
            folder.mkdir(parents=True, exist_ok=True)
            paths = [folder / f"{k:06d}.npz" for k in range(count)]
            self._make(paths, mark, compute, threads)
            for old in {*folder.glob("*.npz")} - {*paths}:
                old.unlink(missing_ok=True)

        def load(number: int, wanted: Callable[[str], bool] | None) -> Arrays:
            path = folder / f"{number:06d}.npz"
            try:
                arrays = load_arrays(path, wanted)
            except (OSError, ValueError):  # damaged after it was found whole
                path.unlink(missing_ok=True)
                self._make([path], mark, lambda _: compute(number), 1)
                arrays = load_arrays(path, wanted)
            return {key: torch.from_numpy(value) for key, value in arrays.items() if key != "fingerprint"}

        return Shards(count, load)

    def _make(self, paths: list[Path], mark: str, compute: Callable[[int], Arrays], threads: int) -> None:
        """See that all files are there, together with whoever else works on them."""

        def attempt(number: int) -> bool:
            """Whether the file is there now."""
            path = paths[number]
            usable = self.resume or path in self.made
            if usable and _is_made(path, mark):
                return True
            with held_file(path.with_name(f".{path.stem}{HELD}")) as mine:
                if mine and not (usable and _is_made(path, mark)):
                    content: dict[str, Any] = {key: value.numpy() for key, value in compute(number).items()}
                    with whole_file(path) as file:
                        np.savez(file, allow_pickle=False, fingerprint=np.array(mark), **content)
                    self.made.add(path)
                return mine

        start = int(self.first * len(paths))
        left = [*range(start, len(paths)), *range(start)]
        while left:
            made = _each(attempt, left, threads)
            if not any(made):
                time.sleep(PAUSE)
            left = [number for number, there in zip(left, made, strict=True) if not there]

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add the time spent inside to a stage, less that of stages within, which is theirs."""
        start, told = time.perf_counter(), sum(self.seconds.values())
        try:
            yield
        finally:
            own = time.perf_counter() - start - (sum(self.seconds.values()) - told)
            self.seconds[name] = self.seconds.get(name, 0.0) + own


def _each(work: Callable[[int], T], numbers: Sequence[int], threads: int) -> list[T]:
    """What some work makes of each of some numbers."""
    if threads == 1:
        return list(map(work, numbers))
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, numbers))


def _is_made(path: Path, mark: str) -> bool:
    """Whether a shard is there, whole, and made from the same input."""
    try:
        return path.exists() and str(load_arrays(path, "fingerprint".__eq__).get("fingerprint")) == mark
    except (OSError, ValueError):
        return False  # cut short: made again


def saved_stages(folder: Path, since: float = 0.0) -> list[str]:
    """The stages of which anything was saved in a folder since a time."""
    found = {path.parent.name for path in folder.glob("stages/*/*.npz") if path.stat().st_mtime >= since}
    return sorted(found)


def clear_stages(folder: Path) -> None:
    """Remove what earlier runs saved in a folder, of this version or one before."""
    for path in [*folder.glob("stages/*.npz"), *folder.glob("stages/*/*.npz")]:
        path.unlink()


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute on one thread: for thousands of small tensor operations, where handing over to a second one costs more.

    On a busy machine it costs a multiple, as OpenMP's threads wait for each other at full speed.
    """
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(count)


def fingerprint(files: Sequence[Path], options: dict[str, Any]) -> str:
    """A digest of names, sizes and modification times of files, and of options."""
    listing = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    text = json.dumps([listing, options], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]
