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


def said_by(code: str) -> str:
    """What a program of these lines prints, in a process of its own."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def test_all_names_are_listed_and_loaded_together() -> None:
    """And leave slow packages out, which only those load who need them."""
    code = (
        "from torchsfm import *; import sys, torchsfm, torchsfm.plot;"
        "slow = {'kornia', 'cv2', 'matplotlib', 'plotly', 'pycolmap', 'typer', 'rich', 'scipy'};"
        "print(set(torchsfm.__all__) <= set(globals()) & set(dir(torchsfm)), sorted(slow & set(sys.modules)))"
    )
    assert said_by(code) == "True []"


def test_rooms_are_loaded_when_they_are_asked_for() -> None:
    code = (
        "import sys, torchsfm; print('torch' in sys.modules);"
        "torchsfm.Camera; print('torchsfm.geometry' in sys.modules, 'torchsfm.motion' in sys.modules);"
        "print(torchsfm.motion.fundamental_7pt.__name__)"
    )
    assert said_by(code).splitlines() == ["False", "True False", "fundamental_7pt"]


def test_wherever_rooms_are_loaded_their_constants_are_the_same() -> None:
    """On the CPU, and such as can take part in a derivative later."""
    code = (
        "import gc, torch, torchsfm\n"
        "with torch.inference_mode(), torch.device('meta'):\n"
        "    [getattr(torchsfm, name) for name in torchsfm.__all__]\n"
        "tensors = [x for x in gc.get_objects() if type(x) is torch.Tensor]\n"
        "print(len(tensors) > 0, {(x.device.type, x.is_inference()) for x in tensors})"
    )
    assert said_by(code) == "True {('cpu', False)}"


def test_threads_may_be_the_first_to_ask() -> None:
    code = (
        "import torchsfm; from concurrent.futures import ThreadPoolExecutor\n"
        "names = torchsfm.__all__\n"
        "def read(start): return [getattr(torchsfm, name) for name in names[start:] + names[:start]]\n"
        "starts = range(0, len(names), 8)\n"
        "with ThreadPoolExecutor(len(starts)) as pool: found = list(pool.map(read, starts))\n"
        "print(all(values == read(start) for start, values in zip(starts, found)))"
    )
    assert said_by(code) == "True"


def test_no_compiler_is_imported() -> None:
    program = (
        "import sys, torch, torchsfm\n"
        "x = torch.rand(3, 4, 2, dtype=torch.float64, requires_grad=True)\n"
        "torchsfm.homography_4pt(x, torch.rand(3, 4, 2, dtype=torch.float64)).model.sum().backward()\n"
        "d = torch.rand(2, 5, 3, dtype=torch.float64, requires_grad=True)\n"
        "torchsfm.essential_5pt(d, torch.rand(2, 5, 3, dtype=torch.float64)).model.sum().backward()\n"
        "assert 'torch._dynamo' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
