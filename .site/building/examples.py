"""The examples as the gallery wants them: copies to run in, each with a title, each folder with a page of its own."""

import ast
import re
from pathlib import Path

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
TITLE = re.compile(r"(.+?)(?::|\.|(?<=[?!]))(?:\s+|$)(.*)", re.DOTALL)
COMMAND = re.compile(r"^    (python .*)$", re.MULTILINE)


def write(examples: Path, folder: Path) -> None:
    """Copy the examples with what they need."""
    paths = [path for path in examples.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    contents = {path.relative_to(examples).as_posix(): path.read_bytes() for path in paths}
    for name, content in contents.items():
        if name.endswith(".py"):
            contents[name] = titled(content.decode()).encode()
    folders = {name.rpartition("/")[0] for name in contents if name.endswith(".py")}
    contents |= {f"{name}/GALLERY_HEADER.rst".lstrip("/"): HEADERS[name].encode() for name in folders}
    write_folder(folder, contents)


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
