"""What users look up says what they need: each public name has an example that runs, each field of a result its meaning."""

import ast
import dataclasses
import doctest
import importlib
import inspect
import math
import pkgutil
import re
import sys
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

import torchsfm

NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?(?!\w)")
# The program, which is run and not called.
NOT_CALLED = {"cli"}
UNFINISHED = {"_types", "images", "reconstruction"}


def _public() -> Iterator[tuple[str, Any]]:
    """Every function and class of a room's list, and the two that belong to no room."""
    rooms = [room.name for room in pkgutil.iter_modules(torchsfm.__path__) if room.ispkg and room.name not in NOT_CALLED]
    listed = [(room, name) for room in rooms for name in importlib.import_module(f"torchsfm.{room}").__all__]
    yield from {"_types.Solutions": torchsfm.Solutions, "_types.Status": torchsfm.Status}.items()
    for room, name in listed:
        value = getattr(importlib.import_module(f"torchsfm.{room}"), name)
        if inspect.isclass(value) or inspect.isroutine(value):
            yield f"{room}.{name}", value


PUBLIC = dict(_public())


class NumbersAsNumbers(doctest.OutputChecker):
    """What is printed agrees up to white space and rounding: `1.`, `1.0000` and `0.99999` are the same number."""

    def check_output(self, want: str, got: str, optionflags: int) -> bool:
        if re.sub(r"\s", "", NUMBER.sub("#", want)) != re.sub(r"\s", "", NUMBER.sub("#", got)):
            return False
        pairs = zip(NUMBER.findall(want), NUMBER.findall(got), strict=True)
        return all(math.isclose(float(a), float(b), rel_tol=1e-3, abs_tol=1e-3) for a, b in pairs)


def _examples(value: Any, name: str) -> list[doctest.DocTest]:
    return [test for test in doctest.DocTestFinder().find(value, name, module=False, globs={}) if test.examples]


def _own_example(value: Any) -> bool:
    return ">>> " in (value.__doc__ or "")


def _shown_by(value: Any) -> list[str]:
    """The names in "See the example of `name`." of a docstring."""
    sentence = re.search(r"See the examples? of ([^.]*(?:\.\w[^.]*)*)\.", value.__doc__ or "")
    return re.findall(r"`([\w.]+)`", sentence[1]) if sentence else []


@pytest.mark.parametrize("name", PUBLIC)
def test_examples_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each in a namespace and a folder of its own: it can be copied as it stands."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    said: list[str] = []
    runner = doctest.DocTestRunner(NumbersAsNumbers(), verbose=False)
    for test in _examples(PUBLIC[name], name):
        runner.run(test, out=said.append)
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
    assert not runner.failures, "".join(said)


def test_every_public_name_has_an_example() -> None:
    """Of its own, or, where something else makes it (a result) or takes it (a protocol), that name's."""
    short = {name.rpartition(".")[2]: value for name, value in PUBLIC.items()}
    without = [
        name
        for name, value in PUBLIC.items()
        if not _own_example(value) and not any(other in short and _own_example(short[other]) for other in _shown_by(value))
    ]
    assert not _finished(without)


def test_every_field_is_explained() -> None:
    """By a string below it, or in the docstring of its class or of one that it inherits from."""
    bare = [
        f"{name}.{field}"
        for name, value in PUBLIC.items()
        if inspect.isclass(value) and value.__module__.startswith("torchsfm")
        for field in _fields(value)
        if not any(_explains(base, field) for base in value.__mro__[:-1] if base.__module__.startswith("torchsfm"))
    ]
    assert not _finished(bare)


def _finished(names: list[str]) -> list[str]:
    return [name for name in names if name.partition(".")[0] not in UNFINISHED]


def _fields(value: type) -> list[str]:
    names = [f.name for f in dataclasses.fields(value)] if dataclasses.is_dataclass(value) else getattr(value, "_fields", ())
    return [name for name in names if not name.startswith("_")]


def _explains(value: type, field: str) -> bool:
    return re.search(rf"\b{field}\b", value.__doc__ or "") is not None or field in _explained(value)


def _explained(value: type) -> set[str]:
    """The fields of a class below which a string stands."""
    found = [node for node in ast.walk(_parsed(value.__module__)) if isinstance(node, ast.ClassDef)]
    (body,) = (node.body for node in found if node.name == value.__name__)
    return {
        line.target.id
        for line, after in pairwise(body)
        if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name)
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
    }


@cache
def _parsed(module: str) -> ast.Module:
    return ast.parse(inspect.getsource(sys.modules[module]))
