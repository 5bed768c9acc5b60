"""A page for every room and for every public name, with the examples that use it."""

import ast
import importlib
import inspect
from enum import Enum, EnumMeta
from functools import cache
from pathlib import Path
from typing import Any

from sphinx.pycode import ModuleAnalyzer

from building.files import write_folder
from building.names import Name, listed, rooms
from building.plain import plain

HEADINGS = {"function": "Functions", "class": "Classes", "exception": "Errors", "data": "Tables and constants"}
SHAPES = """Shapes are part of the signatures. ``Float[Tensor, '*batch n 2']`` is a tensor of floating-point numbers: its last
dimension is 2, the one before is any ``n``, the same wherever ``n`` stands, and ``*batch`` is any number of leading dimensions,
which broadcast against those of the other arguments. See :doc:`/conventions`."""


def write(folder: Path) -> None:
    """Write the pages."""
    write_folder(folder, {name: text.encode() for name, text in pages().items()})


def pages() -> dict[str, str]:
    """All pages by the names of their files."""
    found = {f"{name.full}.rst": name_page(name) for name in listed().values()}
    tops = {"torchsfm": [n for n in listed().values() if n.room == "torchsfm"]}
    tables = tops | {room: [listed()[f"{room}.{name}"] for name in module.__all__] for room, module in rooms().items()}
    found |= {f"{room}.rst": room_page(room, names) for room, names in tables.items()}
    return found | {"index.rst": index_page(list(tables))}


def index_page(tables: list[str]) -> str:
    """All rooms, and what stands at the top."""
    top = sorted({n.name: n for way, n in listed().items() if way.count(".") == 1}.values(), key=lambda n: n.name.lower())
    return "\n".join(
        [
            *_title("Reference"),
            SHAPES,
            "",
            ".. toctree::",
            "   :hidden:",
            "",
            *(f"   {room}" for room in tables),
            "",
            *_table([(f":doc:`{room.removeprefix('torchsfm.')} <{room}>`", _question(room)) for room in tables]),
            *_title("At the top of the package", "-"),
            "These are written ``torchsfm.NAME``; every other name by its room, ``torchsfm.motion.essential_5pt``.",
            "",
            ", ".join(f"``{n.name}``" for n in top) + ".",
            "",
        ]
    )


def room_page(room: str, names: list[Name]) -> str:
    """What is in a room, by kind, one line each."""
    module = importlib.import_module(room)
    lines = [*_title(room.removeprefix("torchsfm.")), f".. py:module:: {room}", "", plain(inspect.getdoc(module) or ""), ""]
    for kind, heading in HEADINGS.items():
        chosen = [n for n in names if n.kind == kind]
        if chosen:
            lines += [*_title(heading, "-"), *_table([(f"``{n.name}``", _first_sentence(n)) for n in chosen])]
    return "\n".join(lines)


def name_page(name: Name) -> str:
    """One name: its docstring, and the examples that use it."""
    way = f"``{name.full}``"
    if name.at_top and name.room != "torchsfm":
        way = f"``torchsfm.{name.name}``, also {way}"
    lines = [":orphan:", "", *_title(name.name), f":doc:`{name.room}` / {way}", ""]
    if name.kind == "data":
        lines += [f".. py:data:: {name.full}", "", *(f"   {line}" for line in plain(_comment(name)).splitlines())]
    else:
        lines += [f".. auto{name.kind}:: {name.full}"]
        lines += ["   :undoc-members:"] * isinstance(name.value, EnumMeta)
        lines += ["   :show-inheritance:"] * _tells_of_bases(name.value)
    lines += ["", f".. minigallery:: torchsfm.{name.name} {name.full}", "   :add-heading: Examples that use it", ""]
    return "\n".join(lines)


def _tells_of_bases(value: Any) -> bool:
    """Whether a class derives from something that a user knows."""
    known = {id(n.value) for n in listed().values()}
    return inspect.isclass(value) and (any(id(b) in known for b in value.__bases__) or issubclass(value, (Exception, Enum)))


def _title(text: str, line: str = "=") -> list[str]:
    return [text, line * len(text), ""]


def _table(rows: list[tuple[str, str]]) -> list[str]:
    lines = [line for name, text in rows for line in (f"   * - {name}", f"     - {text}")]
    return [".. list-table::", "   :class: names", "   :widths: auto", "", *lines, ""]


def _question(room: str) -> str:
    return plain((inspect.getdoc(importlib.import_module(room)) or "").partition("\n\n")[0])


def _first_sentence(name: Name) -> str:
    text = _comment(name) if name.kind == "data" else inspect.getdoc(name.value) or ""
    return plain(text.partition("\n\n")[0].replace("\n", " "))


@cache
def _imports(room: str) -> dict[str, str]:
    """Which module a room has each of its names from."""
    tree = ast.parse(Path(str(importlib.import_module(room).__file__)).read_text())
    froms = (node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module)
    return {alias.name: str(node.module) for node in froms for alias in node.names}


def _comment(name: Name) -> str:
    """The string below a constant where it is written."""
    module = _imports(name.room).get(name.name, name.room)
    found: dict[tuple[str, str], list[str]] = ModuleAnalyzer.for_module(module).find_attr_docs()
    return "\n".join(found.get(("", name.name), [])).strip()
