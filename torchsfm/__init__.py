"""Batched, differentiable multiple-view geometry on PyTorch tensors.

Objects, doors with their results, readers and writers, losses, scorings and samplers stand here; everything else is reached by
its room: `torchsfm.motion.fundamental_7pt`, `torchsfm.tensors.trifocal_from_cameras`.

`__init__.pyi` lists what stands here, for type checkers, for editors and for this file: a room is loaded when it, or one of its
names, is first asked for.
"""

import ast
from importlib import import_module
from pathlib import Path
from threading import RLock
from types import ModuleType
from typing import Any

_LINES = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
_HOMES = {alias.name: line.module for line in _LINES if isinstance(line, ast.ImportFrom) for alias in line.names}
_LOADING = RLock()
_ROOMS = [name for name, home in _HOMES.items() if home == __name__]

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """A room, or a name of one; the version of the installed package; and what once stood here and is a room's."""
    if name == "__version__":
        from importlib.metadata import version  # which takes as long as all else here

        return version(__name__)
    if name in _ROOMS:
        return _load(f"{__name__}.{name}")
    if name in _HOMES:
        value = globals()[name] = getattr(_load(_HOMES[name]), name)
        return value
    if not name.startswith("_"):
        for room in map(__getattr__, _ROOMS):
            if name in room.__all__:
                return getattr(room, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _load(module: str) -> ModuleType:
    """A module, whose constants lie on the CPU and may take part in derivatives wherever it is first asked for."""
    import torch

    # Threads that load rooms from several ends would wait for each other's modules, which Python ends with an error.
    with _LOADING, torch.inference_mode(False), torch.device("cpu"):
        return import_module(module)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
