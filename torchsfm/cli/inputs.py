"""What the user gives: photographs, and a file with known intrinsics."""

from pathlib import Path

import torch
import typer
from jaxtyping import Float
from torch import Tensor

from torchsfm.cli.job import Job, UserError
from torchsfm.formats import read_database, read_hloc
from torchsfm.images import FILMS, extract_frames
from torchsfm.images.film import FPS
from torchsfm.reconstruction import MatchedImages, Reconstruction, ReconstructionError
from torchsfm.reconstruction.matching.sources import Sources

FRAMES = "frames"
"""The folder of a film's frames, beside the results."""
SQLITE, HDF5 = b"SQLite format 3\0", b"\x89HDF\r\n\x1a\n"


def read_matched(inputs: list[Path]) -> MatchedImages | None:
    """Keypoints and matches of another program, where files of such are given instead of images.

    Raises:
        UserError: They cannot be read.
    """
    heads = []
    for path in inputs:
        if not path.is_file():
            return None
        with path.open("rb") as file:
            heads.append(file.read(16))
    try:
        if len(inputs) == 1 and (heads[0] == SQLITE or inputs[0].suffix == ".db"):
            return read_database(inputs[0])
        if len(inputs) == 2 and all(head.startswith(HDF5) for head in heads):
            return read_hloc(*inputs)
    except (ValueError, ImportError) as error:
        raise UserError(" ".join(str(error).split())) from None
    return None


def photograph_folder(images: list[Path]) -> Path:
    """The folder in which images lie under their names in the model.

    Raises:
        UserError: There are none, or some are not there.
    """
    try:
        return Sources.of(images, least=1).folder
    except ReconstructionError as error:
        raise UserError(" ".join(str(error).split())) from None


def film_among(images: list[Path], fps: float | None) -> Path | None:
    """The film that is given instead of images, if one is.

    Raises:
        UserError: It is not the only thing given, or there is a rate of frames and no film.
    """
    films = [path for path in images if path.suffix.lower() in FILMS and not path.is_dir()]
    if films and len(images) > 1:
        raise UserError(f"{films[0]}: a film is reconstructed by itself, not with other images")
    if fps is not None and not films:
        raise UserError("--fps: wants a film")
    return films[0] if films else None


def read_film(job: Job, film: Path, fps: float | None, max_pixels: int) -> None:
    """Save frames of a film in the folder of the results.

    Raises:
        UserError: It cannot be read, or gives a single frame.
    """
    try:
        frames = extract_frames(
            film, job.out / FRAMES, fps=FPS if fps is None else fps, max_pixels=max_pixels,
            progress=lambda done, total: job.progress("film", done, total),
        )  # fmt: skip
    except ValueError as error:
        raise UserError(" ".join(str(error).split())) from None
    if len(frames) < 2:
        raise UserError(f"{film}: one frame is not enough, two views are the least; --fps takes more of them")


def read_intrinsics(path: Path) -> Float[Tensor, "3 3"]:
    """Read the matrix K from a text file.

    The file holds nine numbers, or lines of which the first three hold three numbers each, as in the camera files of multi-view
    data sets. `#` starts a comment; commas count as spaces.

    Raises:
        UserError: The file cannot be read or holds no calibration matrix.
    """
    try:
        text = path.read_text()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: not a text file") from None
    lines = [line.partition("#")[0].replace(",", " ").replace(";", " ").split() for line in text.splitlines()]
    lines = [line for line in lines if line]
    try:
        numbers = [[float(word) for word in line] for line in lines]
    except ValueError as error:
        raise UserError(f"{path}: not a matrix of numbers ({error})") from None
    flat = [number for line in numbers for number in line]
    rows = [flat[0:3], flat[3:6], flat[6:9]] if len(flat) == 9 else numbers[:3]
    if len(rows) != 3 or any(len(row) != 3 for row in rows):
        raise UserError(f"{path}: wanted three lines of three numbers, the matrix K")
    K = torch.tensor(rows, dtype=torch.float64)
    if not (rows[0][0] > 0 and rows[1][1] > 0 and rows[1][0] == 0 and rows[2] == [0, 0, 1] and bool(K.isfinite().all())):
        raise UserError(f"{path}: not a calibration matrix; wanted [fx s cx; 0 fy cy; 0 0 1] with fx, fy > 0")
    return K


def warn_about_intrinsics(K: Float[Tensor, "3 3"], model: Reconstruction) -> None:
    """A matrix for another image size is the usual mistake: its principal point lies far from the middle."""
    width, height = model.image_size[0].tolist()
    cx, cy = K[0, 2].item(), K[1, 2].item()
    if abs(cx - width / 2) > width / 4 or abs(cy - height / 2) > height / 4:
        typer.echo(
            f"torchsfm: warning: the principal point ({cx:g}, {cy:g}) is far from the middle of the {width} x {height} images; "
            "was K made for another size?",
            err=True,
        )
