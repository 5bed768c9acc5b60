"""What `import torchsfm` gives, and what it must not cost."""

import subprocess
import sys

import torchsfm


def test_every_public_name_is_there_once() -> None:
    assert len(set(torchsfm.__all__)) == len(torchsfm.__all__)
    for name in torchsfm.__all__:
        assert getattr(torchsfm, name) is not None


def test_import_leaves_the_slow_packages_out() -> None:
    code = (
        "import sys, torchsfm; slow = {'kornia', 'cv2', 'matplotlib', 'plotly', 'pycolmap', 'typer', 'rich', 'scipy'};"
        "print(sorted(slow & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
