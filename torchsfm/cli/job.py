"""One run of a command: progress while it works, and an exit status with one line where it fails."""

import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import torch
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeRemainingColumn

from torchsfm.cli.ranks import Started
from torchsfm.cli.voice import VOICE, Voice
from torchsfm.reconstruction import MatchedImages, ReconstructionError, SfmResult, reconstruct, reconstruct_matches
from torchsfm.reconstruction.matching.sources import Source
from torchsfm.reconstruction.matching.stages import saved_stages
from torchsfm.reconstruction.photographs import NEIGHBOURS, match_photographs

NOTHING, WRONG, INTERRUPTED = 1, 2, 130
PAUSE = 30.0
"""Seconds between two lines on how far a stage is, where there is no terminal for a bar."""
LONGEST_ESTIMATE = 1e9
"""Seconds over which the speed of a stage is averaged: all of it."""

LABELS = {
    "render": "rendering the scene",
    "film": "reading the film",
    "read": "reading images",
    "pattern": "finding the pattern",
    "problem": "reading",
    "features": "finding features",
    "look": "looking for pairs to match",
    "match": "matching pairs",
    "track": "tracking corners",
    "verify": "checking epipolar geometry",
    "map": "building the model",
    "segments": "finding line segments",
    "refine": "refining the model",
    "bundle": "adjusting",
    "merge": "joining the models",
    "edges": "finding edges",
    "motion": "finding what moves where",
    "follow": "following edges through images",
    "curves": "finding curves in space",
    "poses": "checking the poses",
    "write": "writing results",
    "pictures": "writing pictures",
}


class UserError(Exception):
    """Something the user can put right; the message is one line."""


@dataclass
class Job:
    """One run of a command: where it writes, and what it shows meanwhile on stderr."""

    out: Path
    stage: str = ""
    started: float = field(default_factory=time.time)
    console: Console = field(default_factory=lambda: Console(stderr=True, highlight=False))
    terminal: bool = field(default_factory=lambda: sys.stderr.isatty())
    bars: Progress | None = None
    reported: float = field(default_factory=time.monotonic)
    tasks: dict[str, TaskID] = field(default_factory=dict)
    voice: Voice = field(default_factory=VOICE.get)
    began: tuple[float, int] = (0.0, 0)
    """When the stage began, and what of it was done then."""

    def progress(self, stage: str, done: int, total: int) -> None:
        """Show how far a stage is and how long it will take: a bar on a terminal, else a line now and then."""
        begins, self.stage = stage != self.stage, stage
        if self.voice.quiet:
            return
        if not self.terminal:
            self._line(begins, done, total)
            return
        if self.bars is None:
            columns = (
                SpinnerColumn(),
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeRemainingColumn(elapsed_when_finished=True),
            )
            self.bars = Progress(
                *columns, console=self.console, get_time=time.monotonic, speed_estimate_period=LONGEST_ESTIMATE
            )
            self.bars.start()
        if stage not in self.tasks:
            self.tasks[stage] = self.bars.add_task(LABELS.get(stage, stage), total=total)
            # A stage that first reports when something is done began where the one before it ended.
            self.bars.tasks[-1].start_time = self.reported
        self.bars.update(self.tasks[stage], completed=done, total=total)
        self.reported = time.monotonic()

    def _line(self, begins: bool, done: int, total: int) -> None:
        """Say that a stage begins, and from time to time how far it is."""
        now = time.monotonic()
        if begins:
            self.began = now, done
            typer.echo(f"{LABELS.get(self.stage, self.stage)} ...", err=True)
        elif now < self.reported + PAUSE or done >= total:
            return
        else:
            start, first = self.began
            left = f", {duration((now - start) * (total - done) / (done - first))} left" if done > first else ""
            typer.echo(f"{LABELS.get(self.stage, self.stage)}: {done} of {total}{left}", err=True)
        self.reported = now

    def close(self) -> None:
        """Leave the bars as they are and give the terminal back."""
        if self.bars is not None:
            self.bars.stop()
            self.bars = None

    def complain(self, what: str) -> NoReturn:
        """End for a fault that the user can put right."""
        self.close()
        self.fail(what)
        raise typer.Exit(WRONG) from None

    def fail(self, what: str) -> None:
        """Say in one line what is wrong."""
        self.voice.record["error"] = what
        typer.echo(f"torchsfm: {what}", err=True)

    def set_threads(self, threads: int | None) -> None:
        """Limit the processor threads of the numerical work."""
        if threads is not None:
            torch.set_num_threads(threads)

    def run_matched(self, matched: MatchedImages, threads: int | None, **arguments: Any) -> SfmResult:
        """Reconstruct from keypoints and matches, with faults of the input told as such."""
        self.set_threads(threads)
        try:
            return reconstruct_matches(
                matched.keypoints,
                matched.pairs,
                matched.matches,
                matched.image_size,
                weights=matched.weights,
                names=matched.names,
                camera_index=matched.camera_index,
                focal=matched.focal,
                progress=self.progress,
                **arguments,
            )
        except ReconstructionError as error:
            raise UserError(" ".join(str(error).split())) from None

    def run(self, images: Source, threads: int | None, **arguments: Any) -> SfmResult:
        """Reconstruct, with faults of the input told as such."""
        self.set_threads(threads)
        try:
            return reconstruct(images, out=self.out, progress=self.progress, **arguments)
        except ReconstructionError as error:
            raise UserError(" ".join(str(error).split())) from None

    def help(self, images: Source, threads: int | None, started: Started, **arguments: Any) -> None:
        """Work on the stages of a run that another process leads; that one tells what there is to tell of the input."""
        self.set_threads(threads)
        try:
            match_photographs(
                images,
                out=self.out,
                resume=True,
                neighbours=NEIGHBOURS,
                first=started.rank / started.count,
                progress=lambda stage, done, total: None,
                **arguments,
            )
        except ReconstructionError:
            raise typer.Exit(WRONG) from None


def duration(seconds: float) -> str:
    """A time in words, as exactly as an estimate deserves."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


@contextmanager
def told(job: Job) -> Iterator[Job]:
    """End in a line and an exit status instead of a traceback where the user can do something about it."""
    try:
        yield job
    except KeyboardInterrupt:
        job.close()
        # Without --resume, what an earlier run left there is of no use.
        since = 0 if "--resume" in sys.argv else job.started
        saved = saved_stages(job.out, since)
        job.voice.record["error"] = f"interrupted while {LABELS.get(job.stage, 'starting')}"
        typer.echo(job.voice.record["error"], err=True)
        if saved and sys.argv[1:2] == ["reconstruct"]:
            words = [word for word in sys.argv[1:] if word != "--resume"]
            typer.echo(f"saved in {job.out / 'stages'}: {', '.join(saved)}; to go on from there:", err=True)
            typer.echo(f"  torchsfm {shlex.join([*words, '--resume'])}", err=True)
        raise typer.Exit(INTERRUPTED) from None
    except UserError as error:
        job.complain(str(error))
    except OSError as error:
        job.complain(f"{error.filename or job.out}: {error.strerror or error}")
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and "allocate memory" not in str(error):
            raise
        job.complain(f"out of memory while {LABELS.get(job.stage, 'starting')}; use smaller images or --max-features")
    finally:
        job.close()
