"""What the package shows: its names with their signatures, one in a line. Run as a program, it writes them anew."""

import inspect
from enum import EnumMeta
from pathlib import Path
from types import ModuleType
from typing import Any

import torchsfm

FILE = Path(__file__).with_suffix(".txt")


def public_names() -> dict[str, Any]:
    """The names at the top of the package that are no rooms."""
    values = {name: getattr(torchsfm, name) for name in torchsfm.__all__}
    return {name: value for name, value in values.items() if not isinstance(value, ModuleType)}


def lines() -> list[str]:
    """Each name with its signature, a class with those of its own methods."""
    found = []
    for name, value in public_names().items():
        if not inspect.isroutine(value) and not inspect.isclass(value):
            found.append(name)
            continue
        found.append(name + _signature(value))
        if inspect.isclass(value):
            methods = {k: getattr(value, k) for k, v in vars(value).items() if _is_method(k, v)}
            found += [f"  .{k}{_signature(method)}" for k, method in sorted(methods.items())]
    return found


def _is_method(name: str, value: Any) -> bool:
    return (name[0] != "_" and isinstance(value, (classmethod, staticmethod))) or (name[0] != "_" and inspect.isfunction(value))


def _signature(value: Any) -> str:
    """Parameters and defaults, without the annotations, which say more than a caller depends on."""
    if isinstance(value, EnumMeta):
        return f"({', '.join(value.__members__)})"
    if isinstance(value, type) and issubclass(value, (Exception, dict)):
        return ""
    signature = inspect.signature(value)
    bare = [p.replace(annotation=p.empty, default=_Shown.of(p.default)) for p in signature.parameters.values()]
    return str(signature.replace(parameters=bare, return_annotation=signature.empty))


class _Shown:
    """A default as it is written, without its place in memory."""

    def __init__(self, text: str) -> None:
        self.text = text

    @classmethod
    def of(cls, default: Any) -> Any:
        if default is inspect.Parameter.empty:
            return default
        text = repr(default)
        return cls("..." if " at 0x" in text or "<factory>" in text else text)

    def __repr__(self) -> str:
        return self.text


if __name__ == "__main__":
    FILE.write_text("\n".join(lines()) + "\n")
