"""A command started several times at once, as `torchrun` does: all work on the stages of a run, the first does the rest.

Work is divided through the folder of the stages (see `torchsfm.reconstruction.stages`), so a process that is killed takes no
more with it than the shard that it was working on.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch.distributed

from torchsfm.reconstruction.stages import clear_stages


@dataclass(frozen=True)
class Started:
    """Which of how many processes this is."""

    rank: int = 0
    count: int = 1
    again: bool = False
    """Whether they were started anew after one had failed."""

    @classmethod
    def by(cls, environment: Mapping[str, str] = os.environ) -> "Started":
        """What the variables of `torchrun` say."""
        if not all(environment.get(name) for name in ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")):
            return cls()
        again = int(environment.get("TORCHELASTIC_RESTART_COUNT", "0")) > 0
        return cls(int(environment["RANK"]), int(environment["WORLD_SIZE"]), again)

    def begin(self, folder: Path, resume: bool) -> bool:
        """Wait for all processes; return whether to use what is saved in the folder.

        Several do so always: what is of no use to them the first has removed before.
        """
        if self.count == 1:
            return resume
        if self.rank == 0 and not (resume or self.again):
            clear_stages(folder)
        torch.distributed.init_process_group("gloo")
        torch.distributed.barrier()
        torch.distributed.destroy_process_group()
        return True
