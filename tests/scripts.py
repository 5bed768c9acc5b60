"""Running examples and notebooks of the course in this process: loading PyTorch takes longer than most of them."""

import runpy
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch


@dataclass(frozen=True)
class Runner:
    """Runs scripts in an empty folder."""

    folder: Path
    patch: pytest.MonkeyPatch
    capsys: pytest.CaptureFixture[str]

    def run(self, script: Path, *words: str) -> tuple[str, dict[str, Any]]:
        """What a script prints, and the names that it leaves behind."""
        self.patch.setattr(sys, "argv", [str(script), *words])
        space = runpy.run_path(str(script), run_name="__main__")
        return self.capsys.readouterr().out, space


@pytest.fixture
def runner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], unchecked: None
) -> Iterator[Runner]:
    """As for a user: without the checks of annotations, on the CPU, figures drawn but not shown."""
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("Agg")
    monkeypatch.chdir(tmp_path)
    dtype = torch.get_default_dtype()
    # PyTorch asks this mode at every operation: left out where it says nothing new.
    with nullcontext() if torch.get_default_device().type == "cpu" else torch.device("cpu"):
        yield Runner(tmp_path, monkeypatch, capsys)
    torch.set_default_dtype(dtype)
    plt.close("all")
