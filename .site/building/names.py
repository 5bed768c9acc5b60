"""The public names of the package, as its `__all__` lists have them, and under which name each is documented."""

import importlib
import inspect
import pkgutil
from collections import Counter
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any

import torchsfm


@dataclass(frozen=True)
class Name:
    """A public name where it is documented."""

    room: str
    """The module: "torchsfm.motion", or "torchsfm" for what belongs to no room."""
    name: str
    value: Any

    @property
    def full(self) -> str:
        """What one writes to reach it."""
        return f"{self.room}.{self.name}"

    @property
    def at_top(self) -> bool:
        """Whether `torchsfm.NAME` is listed, too."""
        return self.name in torchsfm.__all__

    @property
    def kind(self) -> str:
        """As Sphinx calls it: "class", "exception", "function" or "data"."""
        if inspect.isclass(self.value):
            return "exception" if issubclass(self.value, Exception) else "class"
        return "function" if inspect.isroutine(self.value) else "data"


@cache
def rooms() -> dict[str, ModuleType]:
    """The packages of torchsfm that say what is public in them."""
    found = (importlib.import_module(f"torchsfm.{m.name}") for m in pkgutil.iter_modules(torchsfm.__path__) if m.ispkg)
    return {m.__name__: m for m in found if hasattr(m, "__all__") and m.__name__ != "torchsfm.cli"}


@cache
def listed() -> dict[str, Name]:
    """Every public name, by every listed way to write it: "torchsfm.motion.estimate_essential", "torchsfm.Camera"."""
    ways = {f"{room}.{name}": getattr(module, name) for room, module in rooms().items() for name in module.__all__}
    ways |= {f"torchsfm.{name}": getattr(torchsfm, name) for name in torchsfm.__all__}
    ways = {way: value for way, value in ways.items() if not inspect.ismodule(value)}
    homes: dict[tuple[str, int], Name] = {}
    for way, value in sorted(ways.items(), key=_home_first):
        room, _, name = way.rpartition(".")
        homes.setdefault((name, id(value)), Name(room, name, value))
    return {way: homes[way.rpartition(".")[2], id(value)] for way, value in ways.items()}


def _home_first(item: tuple[str, Any]) -> tuple[bool, bool, str]:
    """Order by the room that the value was written in, then other rooms, then the top."""
    way, value = item
    room = way.rpartition(".")[0]
    written = str(getattr(value, "__module__", ""))
    return not (room != "torchsfm" and f"{written}.".startswith(f"{room}.")), room == "torchsfm", way


def find(text: str) -> Name | None:
    """The public name that a piece of code stands for: with or without "torchsfm.", its room and parentheses at its end."""
    text = text.removesuffix("()").removeprefix("torchsfm.")
    return listed().get(f"torchsfm.{text}") or _by_last_part().get(text)


@cache
def _by_last_part() -> dict[str, Name]:
    """Names without their room, where no two rooms mean different things by them."""
    found = {n.full: n for n in listed().values()}.values()
    count = Counter(n.name for n in found)
    return {n.name: n for n in found if count[n.name] == 1}
