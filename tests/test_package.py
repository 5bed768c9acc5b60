"""What `import torchsfm` gives, and what it must not cost."""

import subprocess
import sys

import pytest
from public_names import FILE, lines

import torchsfm


def test_names_and_signatures_are_those_written_down() -> None:
    """Whoever changes what users call says so: `python tests/public_names.py` writes them anew."""
    assert lines() == FILE.read_text().splitlines()


def test_names_of_rooms_are_reached_from_the_top() -> None:
    """Those that once stood there, too; without being listed."""
    assert torchsfm.fundamental_7pt is torchsfm.motion.fundamental_7pt
    assert "fundamental_7pt" not in dir(torchsfm)
    for name in torchsfm.robust.__all__:
        assert getattr(torchsfm, name) is getattr(torchsfm.robust, name)
    with pytest.raises(AttributeError, match="fundamental_9pt"):
        torchsfm.fundamental_9pt  # noqa: B018


def test_import_leaves_the_slow_packages_out() -> None:
    code = (
        "import sys, torchsfm; slow = {'kornia', 'cv2', 'matplotlib', 'plotly', 'pycolmap', 'typer', 'rich', 'scipy'};"
        "print(sorted(slow & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
