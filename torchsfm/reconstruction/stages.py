"""Results of finished stages on disk, so that an interrupted reconstruction goes on where it was."""

import hashlib
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsfm.reconstruction.files import load_arrays, whole_file

Arrays = dict[str, Tensor]


@dataclass
class Stages:
    """Runs stages, times them, and keeps their tensors in a folder.

    A saved stage is used again only if it was made from the same input: every file carries a fingerprint of the images and
    options before it.

    Attributes:
        folder: Where to save; nowhere when None.
        resume: Use what an earlier run saved.
        fingerprint: What the results depend on.
        seconds: Time each stage took.
    """

    folder: Path | None
    resume: bool
    fingerprint: str
    seconds: dict[str, float] = field(default_factory=dict)

    def run(self, name: str, compute: Callable[[], Arrays]) -> Arrays:
        """The tensors of a stage, from disk if they are there and fit, else computed and saved."""
        with self.timed(name):
            if self.resume and (saved := self._load(name)) is not None:
                return saved
            arrays = compute()
            self._save(name, arrays)
            return arrays

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add the time spent inside to a stage, less that of stages within, which is theirs."""
        start, told = time.perf_counter(), sum(self.seconds.values())
        try:
            yield
        finally:
            own = time.perf_counter() - start - (sum(self.seconds.values()) - told)
            self.seconds[name] = self.seconds.get(name, 0.0) + own

    def _path(self, name: str) -> Path | None:
        return None if self.folder is None else self.folder / "stages" / f"{name}.npz"

    def _load(self, name: str) -> Arrays | None:
        path = self._path(name)
        if path is None or not path.exists():
            return None
        try:
            arrays = load_arrays(path)
        except (OSError, ValueError):
            return None  # cut short by a crash: made again
        if str(arrays.pop("fingerprint", "")) != self.fingerprint:
            return None
        return {key: torch.from_numpy(value) for key, value in arrays.items()}

    def _save(self, name: str, arrays: Arrays) -> None:
        path = self._path(name)
        if path is None:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        content: dict[str, Any] = {key: value.numpy() for key, value in arrays.items()}
        with whole_file(path) as file:
            np.savez(file, allow_pickle=False, fingerprint=np.array(self.fingerprint), **content)


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


def fingerprint(files: list[Path], options: dict[str, Any]) -> str:
    """A digest of names, sizes and modification times of files, and of options."""
    listing = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    text = json.dumps([listing, options], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]
