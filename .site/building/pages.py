"""Pages that are files of the repository: README, benchmark tables and their history, changelog, contributing."""

import inspect
import re
from pathlib import Path

from building.files import write_folder
from building.names import find

SOURCES = ("homography_4pt", "write_tum", "KannalaBrandt")
"""Of these the page on additions shows the files."""
LINKS = {
    "bench/RESULTS.md": "/generated/pages/results.md",
    "RESULTS.md": "/generated/pages/results.md",
    "HISTORY.md": "/generated/pages/history.md",
    "CHANGELOG.md": "/generated/pages/changelog.md",
    ".github/CONTRIBUTING.md": "/generated/pages/contributing.md",
    "examples/fountain.png": "/generated/pages/fountain.png",
}


def write(root: Path, folder: Path) -> None:
    """Write the pages and the picture on the first."""
    readme = sections((root / "README.md").read_text())
    texts = {
        "parts/start.md": "## Start\n".join((readme["torchsfm"], readme["Start"])),
        "parts/uses.md": readme["Three uses"],
        "parts/conventions.md": readme["Conventions"],
        "parts/rooms.md": readme["The rooms"],
        "parts/working.md": readme["Working on it"],
        "results.md": (root / "bench" / "RESULTS.md").read_text(),
        "history.md": (root / "bench" / "HISTORY.md").read_text(),
        "changelog.md": (root / "CHANGELOG.md").read_text(),
        "contributing.md": (root / ".github" / "CONTRIBUTING.md").read_text(),
    }
    contents = {name: linked(text).encode() for name, text in texts.items()}
    contents |= {f"parts/{name}.py": source(name) for name in SOURCES}
    contents["fountain.png"] = (root / "examples" / "fountain.png").read_bytes()
    write_folder(folder, contents)


def source(name: str) -> bytes:
    """The file that a public name is written in."""
    found = find(name)
    assert found is not None
    return Path(str(inspect.getsourcefile(found.value))).read_bytes()


def sections(text: str) -> dict[str, str]:
    """The parts of a Markdown text by their headings, without these."""
    parts = re.split(r"^#{1,2} (.+)\n", text, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def linked(text: str) -> str:
    """Links from file to file as links from page to page."""
    for file, page in LINKS.items():
        text = re.sub(rf"\]\((?:\.\./)*{re.escape(file)}", f"]({page}", text)
    return text
