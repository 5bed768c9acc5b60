"""Docstrings are plain text with code between backticks: stars and bars in them are what they look like."""

import re
from typing import Any

from building.signatures import short

CODE_OR_MARK = re.compile(r"(``.+?``|`[^`]+`)|(?<!\\)[*|]", re.DOTALL)
ARGUMENT = re.compile(r"^[ \t]*(?:\*{1,2}\w+:|\* )", re.MULTILINE)


def plain(text: str) -> str:
    """The text as reStructuredText; examples, blocks of code and the names of arguments stay as they are."""
    paragraphs = re.split(r"(\n\s*\n)", text)
    return "".join(paragraph if _is_code(paragraphs, i) else _escaped(paragraph) for i, paragraph in enumerate(paragraphs))


def _is_code(paragraphs: list[str], i: int) -> bool:
    indented = paragraphs[i][:1] == " " or "\n " in paragraphs[i - 1]
    block = i >= 2 and paragraphs[i - 2].rstrip().endswith("::") and indented
    return block or re.search(r"^\s*>>> ", paragraphs[i], re.MULTILINE) is not None


def _escaped(paragraph: str) -> str:
    names = [range(*found.span()) for found in ARGUMENT.finditer(paragraph)]
    return CODE_OR_MARK.sub(lambda m: m[0] if m[1] or any(m.start() in name for name in names) else f"\\{m[0]}", paragraph)


def types_beside_names(app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Where the sections of a class were read: the type of an attribute stands in its heading, not below its description."""
    heading = None
    for i, line in enumerate(lines):
        if line.startswith(".. attribute::"):
            heading = i
        elif line.startswith("   :type: ") and heading is not None:
            del lines[i]
            lines.insert(heading + 1, f"   :type: {short(line.removeprefix('   :type: '))}")


def process(app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Make a docstring reStructuredText, before its sections are read.

    That of an attribute begins with an empty comment: what stands before a colon in its first line would be taken for its type.
    """
    lines[:] = plain("\n".join(lines)).split("\n")
    if what in {"attribute", "data", "property"}:
        lines[:0] = ["..", ""]
