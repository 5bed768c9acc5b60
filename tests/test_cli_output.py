"""The output folder: results all or none, one run at a time."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from torchsfm.cli import output
from torchsfm.cli.job import UserError
from torchsfm.cli.output import finish_replacing, output_folder, replacing_results, unfinished

OLD = dict.fromkeys(("report.json", "report.md", "page.html", "model.npz", "model-1.npz", "colmap/cameras.bin"), "old")
NEW = dict.fromkeys(("report.json", "report.md", "page.html", "model.npz", "colmap/images.bin"), "new")
KEPT = {"notes.txt": "mine", "colmap/mine.txt": "mine"}


def write(folder: Path, contents: dict[str, str]) -> None:
    for name, text in contents.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)


def read(folder: Path) -> dict[str, str]:
    found = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.is_file()}
    return {name: path.read_text() for name, path in found.items() if name != output.LOCK}


def replace_all(folder: Path) -> None:
    with output_folder(folder), replacing_results(folder) as out:
        write(out, NEW)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write(tmp_path, OLD | KEPT)
    return tmp_path


def test_new_results_replace_all_old_ones(folder: Path) -> None:
    replace_all(folder)
    assert read(folder) == NEW | KEPT


def test_an_error_leaves_the_old_results(folder: Path) -> None:
    def fail(error: type[BaseException]) -> None:
        with output_folder(folder), replacing_results(folder) as out:
            write(out, NEW)
            raise error

    for error in (OSError, KeyboardInterrupt):
        with pytest.raises(error):
            fail(error)
        assert read(folder) == OLD | KEPT


STEPS = {os: ("replace",), shutil: ("rmtree",), Path: ("unlink", "rename", "mkdir", "rmdir")}
"""What changes folders."""


class Killed(BaseException):
    """In place of a signal that nothing can catch."""


def test_whatever_step_a_run_is_killed_at(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After every possible number of steps there are the old results or the next command makes it the new ones, never both."""
    steps = 0

    def counted(real):
        def step(*arguments, **options):
            nonlocal steps
            if steps == 0:
                raise Killed
            steps -= 1
            return real(*arguments, **options)

        return step

    seen = set()
    for limit in range(100):
        shutil.rmtree(folder)
        folder.mkdir()
        write(folder, OLD | KEPT)
        with monkeypatch.context() as patched:
            for owner, name in (
                (output.os, "replace"),
                (output.shutil, "rmtree"),
                *((Path, n) for n in ("unlink", "rename", "mkdir", "rmdir")),
            ):
                patched.setattr(owner, name, counted(getattr(owner, name)))
            steps = limit
            try:
                replace_all(folder)
            except Killed:
                pass
            else:
                break
        visible = {name: text for name, text in read(folder).items() if not name.startswith(".")}
        assert len({text for name, text in visible.items() if name not in KEPT}) <= 1, visible
        if {"report.json", "report.md"} <= set(visible):
            assert visible in (OLD | KEPT, NEW | KEPT)
        with output_folder(folder):
            pass
        assert not unfinished(folder)
        after = read(folder)
        assert after in (OLD | KEPT, NEW | KEPT)
        seen.add(after == NEW | KEPT)
    assert seen == {False, True}


def test_finishing_with_nothing_to_finish(folder: Path) -> None:
    finish_replacing(folder)
    assert read(folder) == OLD | KEPT


def test_two_runs_exclude_each_other_and_a_killed_one_does_not_block(folder: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from torchsfm.cli.output import output_folder\n"
        "with output_folder(Path(sys.argv[1])): print('held', flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE, text=True) as other:
        try:
            assert other.stdout is not None
            assert other.stdout.readline() == "held\n"
            message = rf"another run is writing to it \(process {other.pid}\)"
            for _ in range(2):
                with pytest.raises(UserError, match=message), output_folder(folder):
                    raise AssertionError("both hold it")
        finally:
            other.kill()
    with output_folder(folder):
        assert (folder / output.LOCK).read_text() == f"{os.getpid()}\n"
    with output_folder(folder):
        pass


def test_what_a_killed_run_left_is_removed(folder: Path) -> None:
    write(
        folder,
        {".writing/model.npz": "half", ".0123.partial": "half", "stages/.4567.partial": "half", "stages/match.npz": "whole"},
    )
    with output_folder(folder):
        assert read(folder) == OLD | KEPT | {"stages/match.npz": "whole"}
