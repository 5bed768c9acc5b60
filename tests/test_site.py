"""What the site's hand-written pages say of the package is so, and its generated ones leave nothing out."""

import inspect
import io
import re
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from public_names import public_names
from test_layers import ALLOWED
from typer.main import get_command

import torchsfm
from torchsfm.cli import app

SITE = Path(__file__).parent.parent / ".site"
sys.path.insert(0, str(SITE))

from building.examples import titled  # noqa: E402
from building.names import Name, find, listed, rooms  # noqa: E402

TABLES = [
    [re.findall(r"`([^`]+)`", cell) for cell in line.strip("|\n").split(" | ")]
    for line in (SITE / "coming_from.md").read_text().splitlines()
    if line.startswith("| ") and "`" in line
]


def is_said_of(word: str, names: list[Name]) -> bool:
    """Whether it is an argument, attribute or option, "register" or "register=True", of one of these."""
    word = word.partition("=")[0]
    functions = [inspect.signature(n.value).parameters for n in names if n.kind == "function"]
    return any(word in known for known in [*functions, *(dir(n.value) for n in names), *map(annotations, names)])


def annotations(name: Name) -> dict[str, Any]:
    """The fields of a class."""
    return getattr(name.value, "__annotations__", {}) if name.kind == "class" else {}


@pytest.mark.parametrize("row", TABLES, ids=lambda row: " ".join(row[0]))
def test_what_others_call_it_leads_to_a_name_that_exists(row: list[list[str]]) -> None:
    names = [name for code in row[-1] if (name := find(code))]
    commands: Any = get_command(app)
    for code in row[-1]:
        command = re.fullmatch(r"torchsfm (\w+).*", code)
        known = command[1] in commands.commands if command else find(code) or is_said_of(code, names)
        assert known, f"{code} is nothing in torchsfm"


def test_tables_name_each_routine_once() -> None:
    assert len(TABLES) > 100
    toolbox = [routine for row in TABLES[[row[0] for row in TABLES].index(["intsec1"]) :] for routine in row[0]]
    assert len(toolbox) == len(set(toolbox)) == 57
    assert [row[0] for row in TABLES if not row[-1]] == [["cvnotations"]]


def test_every_public_name_has_a_page() -> None:
    pytest.importorskip("sphinx")
    from building.api import pages

    written = pages()
    assert set(rooms()) == {f"torchsfm.{room}" for room in ALLOWED if room != "_types"}
    for room, module in rooms().items():
        for name in module.__all__:
            assert f"``{name}``" in written[f"{room}.rst"]
            assert f"{listed()[f'{room}.{name}'].full}.rst" in written
    for name, value in public_names().items():
        found = find(f"torchsfm.{name}")
        assert found is not None
        assert found.value is value
        assert f":: {found.full}\n" in written[f"{found.full}.rst"]
        assert f"``{name}``" in written["index.rst"]


def test_names_in_text_are_found_as_they_are_written() -> None:
    for text in ("fundamental_7pt", "motion.fundamental_7pt", "torchsfm.motion.fundamental_7pt()"):
        found = find(text)
        assert found is not None
        assert found.full == "torchsfm.motion.fundamental_7pt"
    assert find("Status") == Name("torchsfm", "Status", torchsfm.Status)
    assert find("model") is find("motion.camera_p3p") is None


def test_stars_and_bars_in_docstrings_are_themselves() -> None:
    pytest.importorskip("sphinx")
    from docutils.core import publish_doctree

    from building.plain import plain

    text = "A pose [R | t] of shape (*batch, 3, 4), |t| = 1, with `a*b` or `|R|`.\n\nAs here::\n\n    f(*x) | y\n\n>>> g(*x)\n4"
    tree = publish_doctree(plain(text), settings_overrides={"report_level": 5, "default_role": "code"})
    assert tree.astext().split("\n\n") == [
        "A pose [R | t] of shape (*batch, 3, 4), |t| = 1, with a*b or |R|.", "As here:", "f(*x) | y", ">>> g(*x)\n4"
    ]  # fmt: skip
    example = "x\n\nExample:\n    >>> f(*x) | y\n    (4,)"
    assert plain(example) == example
    assert plain("x\n\nArgs:\n    *data: Tensors (*batch, n).") == "x\n\nArgs:\n    *data: Tensors (\\*batch, n)."


def test_examples_get_a_title_from_their_first_words() -> None:
    script = '"""How many? As many as\nit takes: more.\n\n    python examples/a.py\n"""\n\nx = 1\n'
    head, _, rest = titled(script).partition("\n\n")
    assert head == '"""How many?\n========='
    assert rest == 'As many as\nit takes: more.\n\n.. code-block:: sh\n\n    python examples/a.py\n"""\n\nx = 1\n'
    assert titled('"""A title\n=======\n\nText: so.\n"""\n') == '"""A title\n=======\n\nText: so.\n"""\n'


@pytest.mark.parametrize("path", sorted((SITE.parent / "examples").rglob("*.py")), ids=lambda path: path.stem)
def test_text_in_examples_is_markup_that_can_be_read(path: Path, tmp_path: Path) -> None:
    """What an editor breaks, as a list whose lines were filled, would be seen only when the site is built."""
    parser = pytest.importorskip("sphinx_gallery.py_source_parser")
    from docutils.core import publish_doctree

    script = tmp_path / "example.py"
    script.write_text(titled(path.read_text()))
    said = io.StringIO()
    for kind, text, _ in parser.split_code_and_text_blocks(str(script))[1]:
        if kind == "text":
            publish_doctree(text, settings_overrides={"warning_stream": said, "default_role": "code"})
    assert said.getvalue() == ""


def test_the_residual_that_is_shown_finds_the_points() -> None:
    code = re.search(r"## A residual.*?```python\n(.*?)```", (SITE / "adding.md").read_text(), re.DOTALL)
    assert code is not None
    said: dict[str, Any] = {}
    exec(code[1], said)
    assert said["found"].status == torchsfm.Status.OK
    assert torch.allclose(said["found"].x["place"], said["places"], rtol=0, atol=3e-3)
