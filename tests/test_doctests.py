"""What users look up says what they need: each public name has an example that runs, each field of a result its meaning."""

import ast
import doctest
import importlib
import inspect
import math
import pkgutil
import re
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

import torchsfm

# The program, which is run and not called.
NOT_CALLED = {"cli"}
# Those that run where a package is installed which torchsfm does without.
WANTED = {
    "formats.model_from_pycolmap": "pycolmap", "formats.pycolmap_from_model": "pycolmap", "formats.read_hloc": "h5py",
    "plot.LiveViewer": "viser",
}  # fmt: skip

NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?(?!\w)")


def _public() -> Iterator[tuple[str, Any]]:
    """Every function and class of a room's list, and the two that belong to no room."""
    yield from {"Solutions": torchsfm.Solutions, "Status": torchsfm.Status}.items()
    for room in pkgutil.iter_modules(torchsfm.__path__):
        if room.ispkg and room.name not in NOT_CALLED:
            module = importlib.import_module(f"torchsfm.{room.name}")
            for name in module.__all__:
                value = getattr(module, name)
                if inspect.isclass(value) or inspect.isroutine(value):
                    yield f"{room.name}.{name}", value


PUBLIC = dict(_public())
CLASSES = {name: value for name, value in PUBLIC.items() if inspect.isclass(value)}


class NumbersAsNumbers(doctest.OutputChecker):
    """What is printed agrees up to white space and rounding: `1.`, `1.0000` and `0.99999` are the same number."""

    def check_output(self, want: str, got: str, optionflags: int) -> bool:
        if re.sub(r"\s", "", NUMBER.sub("#", want)) != re.sub(r"\s", "", NUMBER.sub("#", got)):
            return False
        pairs = zip(NUMBER.findall(want), NUMBER.findall(got), strict=True)
        return all(math.isclose(float(a), float(b), rel_tol=1e-3, abs_tol=1e-3) for a, b in pairs)


def _lines(value: Any, name: str) -> list[doctest.Example]:
    """The example in the docstring of a function or class itself."""
    return doctest.DocTestParser().get_examples(inspect.getdoc(value) or "", name)


@pytest.mark.parametrize("name", PUBLIC)
def test_examples_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each in a namespace and a folder of its own: it can be copied as it stands."""
    if name in WANTED:
        pytest.importorskip(WANTED[name])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    said: list[str] = []
    runner = doctest.DocTestRunner(NumbersAsNumbers(), verbose=False)
    for test in doctest.DocTestFinder().find(PUBLIC[name], name, module=False, globs={}):
        runner.run(test, out=said.append)
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
    assert not runner.failures, "".join(said)


def test_every_public_name_has_an_example_of_which_all_runs() -> None:
    shown = {name: _lines(value, name) for name, value in PUBLIC.items()}
    assert not [name for name, lines in shown.items() if not lines]
    assert not [name for name, lines in shown.items() if any(doctest.SKIP in line.options for line in lines)]


def test_every_field_is_explained() -> None:
    """By a string below it, or by its name in the docstring of its class or of one that it inherits from."""
    bare = [
        f"{name}.{field}"
        for name, value in CLASSES.items()
        for field in _fields(value)
        if not any(_explains(base, field) for base in value.__mro__ if base.__module__.startswith("torchsfm"))
    ]
    assert not bare


def test_every_parameter_of_a_function_is_explained() -> None:
    functions = {name: value for name, value in PUBLIC.items() if name not in CLASSES}
    bare = {name: set(inspect.signature(value).parameters) - _arguments(value) for name, value in functions.items()}
    assert not {name: parameters for name, parameters in bare.items() if parameters}


def _arguments(value: Any) -> set[str]:
    """The parameters with a line in the docstring's list of arguments."""
    listed = re.search(r"^Args:\n((?: +.*\n)+)", (inspect.getdoc(value) or "") + "\n", re.MULTILINE)
    return set(re.findall(r"^    \**(\w+): ", listed[1], re.MULTILINE)) if listed else set()


def _fields(value: type) -> list[str]:
    names = [f.name for f in fields(value)] if is_dataclass(value) else getattr(value, "_fields", ())
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
