"""All formats of models, a line each, and which of them a file or folder is.

What is read is told by its content, what is to be written by its name. A new format is a file with its reader and writer, and a
line in `FORMATS`.
"""

import errno
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from torchsfm.formats.bal import read_bal, write_bal
from torchsfm.formats.bundler import read_bundler, write_bundler
from torchsfm.formats.colmap import TABLES, read_colmap, write_colmap
from torchsfm.formats.gltf import write_gltf
from torchsfm.formats.kapture import read_kapture, write_kapture
from torchsfm.formats.libmv import read_libmv
from torchsfm.formats.nerfstudio import read_nerfstudio, write_nerfstudio
from torchsfm.formats.nvm import read_nvm, write_nvm
from torchsfm.formats.openmvg import read_openmvg, write_openmvg
from torchsfm.formats.opensfm import read_opensfm, write_opensfm
from torchsfm.formats.ply import write_ply
from torchsfm.formats.problem import as_reconstruction
from torchsfm.formats.trajectory import write_kitti, write_tum
from torchsfm.geometry import BundleProblem
from torchsfm.linalg.devices import on_the_cpu
from torchsfm.reconstruction.model.reconstruction import Reconstruction

HEAD = 2**20
"""The first bytes of a file, by which it is known."""


@dataclass(frozen=True)
class Format:
    """One format of models."""

    name: str
    what: str
    """In a few words."""
    files: tuple[str, ...]
    """Names of files, or endings of names, under which it is written, and looked for in folders; none for a folder."""
    read: Callable[[Path], BundleProblem] | None = None
    write: Callable[[Reconstruction, Path], None] | None = None
    marks: re.Pattern[bytes] | None = None
    """What the first bytes of a file match that is of this format."""
    within: str = ""
    """The file by which a folder is known to be of this format."""

    def named(self, path: Path) -> bool:
        """Whether a file of this name is of the format."""
        return any(path.name == file or (file.startswith(".") and path.name.endswith(file)) for file in self.files)


FORMATS: tuple[Format, ...] = (
    Format("torchsfm", "a saved model", (".npz",), Reconstruction.load, Reconstruction.save, re.compile(rb"PK[\x03\x05]")),
    Format("colmap", "COLMAP's folder of binary files", (), read_colmap, write_colmap),
    Format("colmap-text", "COLMAP's folder of text files", (), None, partial(write_colmap, text=True)),
    Format("openmvg", "OpenMVG's sfm_data.json", ("sfm_data.json",), read_openmvg, write_openmvg,
           re.compile(rb'\s*\{.*"sfm_data_version"', re.DOTALL)),
    Format("opensfm", "OpenSfM's reconstruction.json, with tracks.csv", ("reconstruction.json",), read_opensfm, write_opensfm,
           re.compile(rb'\s*\[\s*\{.*"(cameras|shots|points)"', re.DOTALL)),
    Format("nerfstudio", "transforms.json of nerfstudio", ("transforms.json",), read_nerfstudio, write_nerfstudio,
           re.compile(rb'\s*\{.*"(frames|camera_angle_x|fl_x)"\s*:', re.DOTALL)),
    Format("bundler", "Bundler's bundle.out, with list.txt", ("bundle.out", ".out"), read_bundler, write_bundler,
           re.compile(rb"# Bundle")),
    Format("nvm", "VisualSFM's NVM_V3", ("model.nvm", ".nvm"), read_nvm, write_nvm, re.compile(rb"NVM_V3")),
    Format("kapture", "a kapture dataset, a folder", (), read_kapture, write_kapture, within="sensors/sensors.txt"),
    Format("gltf", "points and cameras as binary glTF", (".glb",), None, write_gltf),
    Format("tum", "camera poses in the form of TUM", (".tum",), None, write_tum),
    Format("kitti", "camera poses in the form of KITTI", (".kitti",), None, write_kitti),
    Format("libmv", "a libmv problem", (".bin",), read_libmv, None, re.compile(rb"[vV][PN]")),
    Format("ply", "points and cameras for viewers", (".ply",), None, write_ply),
    Format("bal", "a problem of Bundle Adjustment in the Large", (".txt", ".txt.gz", ".txt.bz2", ".gz", ".bz2"), read_bal,
           write_bal, re.compile(rb"\s*\d+\s+\d+\s+\d+\s|\x1f\x8b|BZh")),
)  # fmt: skip


def model_files(path: str | Path) -> list[tuple[Format, Path]]:
    """The models that a file or folder is or holds, each with its format.

    A folder that `torchsfm reconstruct` wrote holds `model.npz`, `model-1.npz` and so on.

    Raises:
        FileNotFoundError: There is no such file or folder.
        ValueError: It is, or holds, no model of a known kind.
        OSError: It cannot be read.
    """
    path = Path(path)
    if path.is_dir():
        found = _within(path)
        if not found:
            raise ValueError(f"{path}: holds no model of a known kind ({', '.join(_readable())})")
        return found
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, "no such file or folder", str(path))
    with path.open("rb") as file:
        head = file.read(HEAD)
    readable = [(kind, kind.marks) for kind in FORMATS if kind.marks is not None]
    # What is known by its name only will be said to be damaged.
    known = [kind for kind, marks in readable if marks.match(head)] or [kind for kind, _ in readable if kind.named(path)]
    if known:
        return [(known[0], path)]
    raise ValueError(f"{path}: not a model of a known kind ({', '.join(_readable())})")


def _within(folder: Path) -> list[tuple[Format, Path]]:
    """The models in a folder: of the first format that has any there."""
    results = sorted(folder.glob("model*.npz"), key=lambda path: (len(path.name), path.name))
    if results:
        return [(FORMATS_BY_NAME["torchsfm"], path) for path in results]
    places = [folder, *sorted(folder.glob("sparse/*")), folder / "sparse", folder / "colmap"]
    tables = [place for place in places if any(all((place / f"{t}.{e}").is_file() for t in TABLES[:3]) for e in ("bin", "txt"))]
    if tables:
        return [(FORMATS_BY_NAME["colmap"], place) for place in tables]
    for kind in FORMATS:
        if kind.within and (folder / kind.within).is_file():
            return [(kind, folder)]
        if kind.marks is not None:
            files = [path for path in sorted(folder.iterdir()) if path.name in kind.files and path.is_file()]
            if files:
                return [(kind, path) for path in files]
    return []


def _readable() -> list[str]:
    return [kind.name for kind in FORMATS if kind.read is not None]


def read_model_or_problem(path: str | Path) -> BundleProblem:
    """Read the model, or the problem of bundle adjustment, that a file or folder is or holds; of several the first.

    Raises:
        ValueError: It is no model of a known kind, or a damaged one; one line that says why.
        OSError: It cannot be read.
    """
    kind, place = model_files(path)[0]
    assert kind.read is not None
    return kind.read(place)


@on_the_cpu
def read_model(path: str | Path) -> Reconstruction:
    """Read a model of whatever format this library reads; its content tells which.

    Args:
        path: A file, or a folder with a model in it; of several the first is read.

    Returns:
        The model. Problems of bundle adjustment get numbers for names, grey points, and images as large as their observations
        need.

    Raises:
        ValueError: It is no model of a known kind, or a damaged one; one line that says why.
        OSError: It cannot be read.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> model.num_registered, model.num_points, model.num_observations
        (3, 20, 50)
    """
    return as_reconstruction(read_model_or_problem(path))


def format_for(path: str | Path, name: str | None = None) -> Format:
    """The format to write under a name: the one asked for, else by the ending; a name without one is COLMAP's folder.

    Raises:
        ValueError: There is no such format, or it is not written here.
    """
    writable = [kind for kind in FORMATS if kind.write is not None]
    if name is not None:
        chosen = FORMATS_BY_NAME.get(name)
    else:
        chosen = next((kind for kind in writable if kind.named(Path(path))), None)
        if chosen is None and (Path(path).is_dir() or not Path(path).suffix):
            chosen = FORMATS_BY_NAME["colmap"]
    if chosen is None or chosen.write is None:
        what = f"{path}: a name that tells no format" if name is None else f"format {name!r} is not written"
        raise ValueError(f"{what}; there are {', '.join(kind.name for kind in writable)}")
    return chosen


@on_the_cpu
def write_model(model: BundleProblem, path: str | Path, format: str | None = None) -> None:
    """Write a model in the format that is asked for, or that the name of the file tells.

    Args:
        model: The model.
        path: A file, or a folder for COLMAP.
        format: The name of a format in `FORMATS`.

    Raises:
        ValueError: There is no such format, or it cannot hold the model.
        OSError: It cannot be written.

    Example:
        >>> import torch, torchsfm
        >>> g = torch.Generator().manual_seed(0)
        >>> torchsfm.write_model(torchsfm.random_bundle_problem(3, 20, 50, generator=g).truth, "model.npz")
        >>> model = torchsfm.read_model("model.npz")
        >>> torchsfm.write_model(model, "sfm_data.json")  # the name says which format
        >>> torchsfm.read_model("sfm_data.json").num_points
        20
    """
    kind = format_for(path, format)
    assert kind.write is not None
    kind.write(as_reconstruction(model), Path(path))


FORMATS_BY_NAME = {kind.name: kind for kind in FORMATS}
