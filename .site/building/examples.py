"""The examples as the gallery wants them: copies to run in, each with a title, each folder with a page of its own."""

import ast
import re
from pathlib import Path
from typing import Any

import torch

from building.files import write_folder

HEADERS = {
    "": """Examples
========

Scripts that run as they are, each on scenes that it makes itself.
""",
    "course": """Course
------

Multiple-view geometry from the first projection to curves in space, in parts of a quarter of an hour: scripts with cells, to
run as a whole or piece by piece, with figures and exercises.
""",
}
LEFT_OUT = re.compile(r"__pycache__|\.md$|^course/\D.*\.py$")
"""Of the scripts of the course, its parts have a number."""
HEADER = "/GALLERY_HEADER.rst"
TITLE = re.compile(r"(.+?)(?::|\.|(?<=[?!]))(?:\s+|$)(.*)", re.DOTALL)
COMMAND = re.compile(r"^    (python .*)$", re.MULTILINE)


def write(examples: Path, folder: Path, gallery: Path) -> None:
    """Copy the examples with the data that they need, and forget the pages in the gallery of those that are gone."""
    paths = {path.relative_to(examples).as_posix(): path for path in examples.rglob("*") if path.is_file()}
    contents = {name: path.read_bytes() for name, path in paths.items() if not LEFT_OUT.search(name)}
    scripts = [name for name in contents if name.endswith(".py")]
    for name in scripts:
        contents[name] = titled(contents[name].decode()).encode()
        contents[name.rpartition("/")[0] + HEADER] = HEADERS[name.rpartition("/")[0]].encode()
    write_folder(folder, {name.lstrip("/"): content for name, content in contents.items()})
    for page in gallery.rglob("*.rst"):
        if page.stem != "index" and page.relative_to(gallery).with_suffix(".py").as_posix() not in scripts:
            page.unlink()


def forget(gallery: dict[str, Any], script: str) -> None:
    """What one example leaves behind must not change the next."""
    torch.set_default_dtype(torch.float32)
    torch.manual_seed(0)


def titled(script: str) -> str:
    """The script with the first words of its docstring as the title of its page, unless it has one."""
    docstring = ast.get_docstring(ast.parse(script), clean=False) or ""
    first, _, rest = docstring.partition("\n\n")
    if re.search(r"^([=\-~#*^])\1{3,}$", first, re.MULTILINE):
        return script
    found = TITLE.fullmatch(first)
    title, text = (found[1], found[2]) if found else (first, "")
    title, text = " ".join(title.split()), text[:1].upper() + text[1:]
    body = COMMAND.sub(r".. code-block:: sh\n\n    \1", rest)
    return script.replace(docstring, f"{title}\n{'=' * len(title)}\n\n{text}\n\n{body}", 1)
