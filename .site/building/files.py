"""Writing a folder of generated files, so that nothing stale stays and nothing unchanged is read anew."""

from pathlib import Path


def write_folder(folder: Path, contents: dict[str, bytes]) -> None:
    """Make `folder` hold just these files, by their path in it; those that are as they should be are not touched."""
    for path in folder.rglob("*"):
        if path.is_file() and path.relative_to(folder).as_posix() not in contents:
            path.unlink()
    for name, content in contents.items():
        path = folder / name
        if not path.is_file() or path.read_bytes() != content:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
