"""A command started several times at once, as `torchrun` does: all work on the stages of a run, the first does the rest.

Work is divided through the folder of the stages (see `torchsfm.reconstruction.matching.stages`), so a process that is killed
takes no more with it than the shard that it was working on.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

from torch.distributed.rendezvous import rendezvous

from torchsfm.reconstruction.matching.stages import clear_stages

LONGEST_START = timedelta(minutes=30)
"""What the first process may take until it has the folder; if it fails before, the others are ended from outside."""


@dataclass(frozen=True)
class Started:
    """Which of how many processes this is."""

    rank: int = 0
    count: int = 1
    attempt: int = 0
    """How often they were started anew after one had failed."""

    @classmethod
    def by(cls, environment: Mapping[str, str] = os.environ) -> "Started":
        """What the variables of `torchrun` say."""
        if not all(environment.get(name) for name in ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")):
            return cls()
        attempt = int(environment.get("TORCHELASTIC_RESTART_COUNT", "0"))
        return cls(int(environment["RANK"]), int(environment["WORLD_SIZE"]), attempt)

    def begin(self, folder: Path, resume: bool) -> bool:
        """Wait for the first process; return whether to use what is saved in the folder.

        Several do so always: what is of no use to them the first has removed before.
        """
        if self.count == 1:
            return resume
        store, _, _ = next(rendezvous("env://"))
        ready = f"torchsfm ready {self.attempt}"
        if self.rank > 0:
            store.wait([ready], LONGEST_START)
            return True
        if not resume and self.attempt == 0:
            clear_stages(folder)
        store.set(ready, "")
        return True
