"""Functions run by several processes that make a group of `torch.distributed`."""

import multiprocessing
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import torch.distributed
from torch import Tensor

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["torchsfm.bundle", "processes"])
SENT: list[tuple[str, int]] = []
"""The collectives of this process and the bytes that each was given, where they are counted."""


def run_ranks(count: int, folder: Path, work: Callable[..., Any], *arguments: Any) -> list[Any]:
    """What `work(*arguments)`, a function of a module, returns in each of so many processes."""
    folder = folder / f"{count}"
    folder.mkdir(parents=True)
    torch.save(arguments, folder / "arguments")
    processes = [_CONTEXT.Process(target=_run, args=(rank, count, str(folder), work)) for rank in range(count)]
    for process in processes:
        process.start()
    try:
        for process in processes:
            process.join(120)
            assert process.exitcode == 0
    finally:
        for process in processes:
            process.kill()  # of those that wait for one that has failed
    return [torch.load(folder / f"{rank}", weights_only=False) for rank in range(count)]


def _run(rank: int, count: int, folder: str, work: Callable[..., Any]) -> None:
    torch.set_num_threads(1)
    if os.path.exists("/sys/class/net/lo"):
        os.environ["GLOO_SOCKET_IFNAME"] = "lo"
    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=count)
    arguments = torch.load(f"{folder}/arguments", weights_only=False)
    torch.save(work(*arguments), f"{folder}/{rank}")
    torch.distributed.destroy_process_group()


def count_collectives() -> None:
    """Write all that this process sends from now on into `SENT`."""
    all_reduce, all_gather = torch.distributed.all_reduce, torch.distributed.all_gather

    def counting_reduce(x: Tensor, *options: Any, **more: Any) -> Any:
        SENT.append(("reduce", x.numel() * x.element_size()))
        return all_reduce(x, *options, **more)

    def counting_gather(found: list[Tensor], x: Tensor, **more: Any) -> Any:
        SENT.append(("gather", x.numel() * x.element_size()))
        return all_gather(found, x, **more)

    torch.distributed.all_reduce, torch.distributed.all_gather = counting_reduce, counting_gather
