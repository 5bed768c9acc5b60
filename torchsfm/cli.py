"""The `torchsfm` command: photographs to model, a demonstration with known truth, and a look at saved models.

Exit statuses: 0, all good; 1, nothing could be reconstructed; 2, wrong input or usage; 130, interrupted (finished stages are
saved). What the user can put right is told in one line on stderr; a traceback means a fault of the program.
"""

import json
import math
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from jaxtyping import Float
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn
from torch import Tensor

from torchsfm.formats import write_colmap, write_ply
from torchsfm.geometry import Pose
from torchsfm.images import save_image
from torchsfm.plot import write_page
from torchsfm.reconstruction import Reconstruction, ReconstructionError, SfmResult
from torchsfm.reconstruction import reconstruct as reconstruct_photographs
from torchsfm.reconstruction.evaluation import pose_auc, pose_errors, position_rmse
from torchsfm.reconstruction.written_report import report_markdown, report_record
from torchsfm.simulation import render_sequence

NOTHING, WRONG, INTERRUPTED = 1, 2, 130
VERSION = metadata.version("torchsfm")

app = typer.Typer(
    name="torchsfm",
    help="From photographs to calibrated cameras and 3D structure.",
    epilog="Exit status: 0 all good, 1 nothing could be reconstructed, 2 wrong input or usage, 130 interrupted.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


class CameraModel(StrEnum):
    """Lens distortion models of `--camera`."""

    pinhole = "pinhole"
    simple_radial = "simple_radial"
    radial = "radial"
    opencv = "opencv"
    fisheye = "fisheye"


class UserError(Exception):
    """Something the user can put right; the message is one line."""


Threads = Annotated[int | None, typer.Option(min=1, help="Processor threads; all by default.")]
Seed = Annotated[int, typer.Option(help="The same seed gives the same model.")]


def print_version(wanted: bool) -> None:
    """Print the version and end."""
    if wanted:
        typer.echo(f"torchsfm {VERSION}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", is_eager=True, callback=print_version)
    ] = False,
) -> None:
    """From photographs to calibrated cameras and 3D structure."""


@app.command()
def reconstruct(
    images: Annotated[list[Path], typer.Argument(help="A folder of images, or image files.", show_default=False)],
    out: Annotated[Path, typer.Option(help="Folder for the model, the page, the report and the finished stages.")],
    sequence: Annotated[bool, typer.Option("--sequence", help="The images are frames of a video, in order.")] = False,
    camera: Annotated[
        CameraModel | None, typer.Option(help="Lens distortion; radial, or pinhole with --intrinsics.", show_default=False)
    ] = None,
    intrinsics: Annotated[
        Path | None, typer.Option(help="Text file with the known 3x3 matrix K of all images, in pixels.", show_default=False)
    ] = None,
    shared_camera: Annotated[
        bool | None,
        typer.Option(
            "--shared-camera/--own-cameras",
            help="Whether one camera took all images of a size; by default as the files' Exif data suggest.",
            show_default=False,
        ),
    ] = None,
    free_principal_point: Annotated[
        bool, typer.Option("--free-principal-point", help="Estimate the principal point too.")
    ] = False,
    max_features: Annotated[int, typer.Option(min=100, help="Most features per image.")] = 8192,
    seed: Seed = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where an earlier run into the same folder stopped.")] = False,
    threads: Threads = None,
) -> None:
    """Turn photographs into calibrated cameras and coloured 3D points."""
    with told(Job(out)) as job:
        prepare_folder(out)
        K = None if intrinsics is None else read_intrinsics(intrinsics)
        source: Path | list[Path] = images[0] if len(images) == 1 and not images[0].is_file() else images
        result = job.run(
            source, threads, sequence=sequence, camera=camera.value if camera else None, K=K, shared_camera=shared_camera,
            free_principal_point=free_principal_point, max_features=max_features, seed=seed, resume=resume,
        )  # fmt: skip
        if K is not None:
            warn_about_intrinsics(K, result)
        finish(job, result, {})


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the rendered images and all results.")] = Path("torchsfm-demo"),
    views: Annotated[int, typer.Option(min=3, max=100, help="Number of photographs to render.")] = 12,
    width: Annotated[int, typer.Option(min=320, max=4000, help="Their width in pixels.")] = 960,
    seed: Seed = 0,
    threads: Threads = None,
) -> None:
    """Photograph a synthetic scene, reconstruct it knowing nothing, and compare with the truth."""
    with told(Job(out)) as job:
        prepare_folder(out)
        folder = out / "images"
        prepare_folder(folder)
        job.set_threads(threads)
        generator = torch.Generator().manual_seed(seed)
        # One image at a time would show progress, but the rays are shared by all of them.
        job.progress("render", 0, views)
        truth = render_sequence(views=views, width=width, height=3 * width // 4, generator=generator)
        for old in folder.glob("view*.jpg"):
            old.unlink()
        names = [f"view{i:02d}.jpg" for i in range(views)]
        for i, name in enumerate(names):
            save_image(folder / name, truth.images[i])
            job.progress("render", i + 1, views)
        result = job.run(folder, threads, seed=seed, resume=False)
        compared = {}
        if result.models:
            compared = compare(result.models[0], truth.poses, truth.cameras.K)
        finish(job, result, compared)


@app.command()
def info(
    folder: Annotated[Path, typer.Argument(help="Folder written by `torchsfm reconstruct`, or a saved model (.npz).")],
) -> None:
    """Describe saved models: cameras, points and how well each image fits."""
    with told(Job(folder)):
        if not folder.exists():
            raise UserError(f"{folder}: no such folder")
        files = sorted(folder.glob("model*.npz"), key=lambda path: (len(path.name), path.name)) if folder.is_dir() else [folder]
        if not files:
            raise UserError(f"{folder}: holds no model (no model.npz)")
        for file in files:
            try:
                model = Reconstruction.load(file)
            except ValueError as error:
                raise UserError(" ".join(str(error).split())) from None
            typer.echo(f"{file}\n{model.summary()}\n")
            counts = torch.bincount(model.view, minlength=len(model.names)).tolist()
            errors = model.view_errors().tolist()
            width = max(len("image"), *(len(name) for name in model.names))
            typer.echo(f"{'image':<{width}}  observations  mean error, px")
            for name, registered, count, error in zip(model.names, model.registered.tolist(), counts, errors, strict=True):
                typer.echo(f"{name:<{width}}  " + (f"{count:>12}  {error:>14.3f}" if registered else "not registered"))
            typer.echo("")


LABELS = {
    "render": "rendering the scene",
    "read": "reading images",
    "features": "finding features",
    "match": "matching pairs",
    "track": "tracking corners",
    "verify": "checking epipolar geometry",
    "map": "building the model",
    "refine": "refining the model",
    "write": "writing results",
}


@dataclass
class Job:
    """One run of a command: where it writes, and what it shows meanwhile on stderr."""

    out: Path
    stage: str = ""
    console: Console = field(default_factory=lambda: Console(stderr=True, highlight=False))
    bars: Progress | None = None
    tasks: dict[str, TaskID] = field(default_factory=dict)

    def progress(self, stage: str, done: int, total: int) -> None:
        """Show how far a stage is: a bar on a terminal, else one line as it begins."""
        if stage != self.stage:
            self.stage = stage
            if not self.console.is_terminal:
                typer.echo(f"{LABELS.get(stage, stage)} ...", err=True)
        if not self.console.is_terminal:
            return
        if self.bars is None:
            columns = (
                SpinnerColumn(),
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
            )
            self.bars = Progress(*columns, console=self.console)
            self.bars.start()
        if stage not in self.tasks:
            self.tasks[stage] = self.bars.add_task(LABELS.get(stage, stage), total=total)
        self.bars.update(self.tasks[stage], completed=done, total=total)

    def close(self) -> None:
        """Leave the bars as they are and give the terminal back."""
        if self.bars is not None:
            self.bars.stop()
            self.bars = None

    def set_threads(self, threads: int | None) -> None:
        """Limit the processor threads of the numerical work."""
        if threads is not None:
            torch.set_num_threads(threads)

    def run(self, images: Path | list[Path], threads: int | None, **arguments: Any) -> SfmResult:
        """Reconstruct, with faults of the input told as such."""
        self.set_threads(threads)
        try:
            return reconstruct_photographs(images, out=self.out, progress=self.progress, **arguments)
        except ReconstructionError as error:
            raise UserError(" ".join(str(error).split())) from None


@contextmanager
def told(job: Job) -> Iterator[Job]:
    """End in a line and an exit status instead of a traceback where the user can do something about it."""
    try:
        yield job
    except KeyboardInterrupt:
        job.close()
        saved = sorted(path.stem for path in job.out.glob("stages/*.npz"))
        typer.echo(f"interrupted while {LABELS.get(job.stage, 'starting')}", err=True)
        if saved and sys.argv[1:2] == ["reconstruct"]:
            words = [word for word in sys.argv[1:] if word != "--resume"]
            typer.echo(f"saved in {job.out / 'stages'}: {', '.join(saved)}; to go on from there:", err=True)
            typer.echo(f"  torchsfm {shlex.join([*words, '--resume'])}", err=True)
        raise typer.Exit(INTERRUPTED) from None
    except (UserError, OSError, MemoryError, RuntimeError) as error:
        job.close()
        if isinstance(error, OSError):
            error = UserError(f"{error.filename or job.out}: {error.strerror or error}")
        elif isinstance(error, MemoryError) or "allocate memory" in str(error):
            error = UserError(f"out of memory while {LABELS.get(job.stage, 'starting')}; use smaller images or --max-features")
        if not isinstance(error, UserError):
            raise
        typer.echo(f"torchsfm: {error}", err=True)
        raise typer.Exit(WRONG) from None
    finally:
        job.close()


def prepare_folder(folder: Path) -> None:
    """Make the folder and see that it can be written, before any work is done for it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror or error})") from None


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


def warn_about_intrinsics(K: Float[Tensor, "3 3"], result: SfmResult) -> None:
    """A matrix for another image size is the usual mistake: its principal point lies far from the middle."""
    for model in result.models[:1]:
        width, height = model.image_size[0].tolist()
        cx, cy = K[0, 2].item(), K[1, 2].item()
        if abs(cx - width / 2) > width / 4 or abs(cy - height / 2) > height / 4:
            typer.echo(
                f"torchsfm: warning: the principal point ({cx:g}, {cy:g}) is far from the middle of the {width} x {height} "
                "images; was K made for another size?",
                err=True,
            )


def compare(model: Reconstruction, poses_true: Pose, K_true: Float[Tensor, "v 3 3"]) -> dict[str, str]:
    """True errors of a model, in words; the images must be those of the truth, in its order."""
    errors = pose_errors(model.poses, poses_true, model.registered)
    known = model.registered
    K = model.cameras.K[model.camera_index]
    focal, focal_true = K[:, 0, 0][known], K_true[:, 0, 0][known]
    rotation = errors.image_rotation[known]
    both = torch.isfinite(errors.pose)
    rmse = float(position_rmse(model.poses, poses_true, known))
    distance = torch.pdist(poses_true.centre).max().item()
    areas = ", ".join(f"{area:.3f}" for area in pose_auc(errors.pose).tolist())
    words = {
        "rotation error, mean / largest": f"{rotation.mean():.4f} / {rotation.max():.4f} deg",
        "relative rotation of pairs, median": f"{errors.rotation[both].median():.4f} deg" if both.any() else "no pairs",
        "direction of baselines, median": f"{errors.direction[both].median():.4f} deg" if both.any() else "no pairs",
        "position error (RMS), of the largest distance between cameras": f"{100 * rmse / distance:.3f} %",
        "focal length, found / true": f"{focal.mean():.2f} / {focal_true.mean():.2f} px",
        "focal length error": f"{100 * ((focal - focal_true).abs() / focal_true).mean():.3f} %",
        "pose AUC at 1, 2, 5 deg": areas,
    }
    return {key: value for key, value in words.items() if not math.isnan(rmse)}


def finish(job: Job, result: SfmResult, truth: dict[str, str]) -> None:
    """Write everything there is to `job.out`, and say in a few lines what came out and where to look."""
    more: dict[str, Any] = {"version": VERSION, "command": shlex.join(sys.argv[1:])}
    if not result.models:
        more["failure"] = result.failure()
    written = write_models(job, result)
    record = report_record(result, peak_memory_mb=peak_memory(), truth=truth, **more)
    (job.out / "report.json").write_text(json.dumps(record, indent=1))
    (job.out / "report.md").write_text(report_markdown(record))
    job.close()
    for i, model in enumerate(result.models):
        typer.echo(("" if len(result.models) == 1 else f"model {i}: ") + model.summary())
    typer.echo(result.report.summary())
    for key, value in truth.items():
        typer.echo(f"{key}: {value}")
    for name, what in [*written, ("report.md", "what happened to each image and pair (report.json: the same for programs)")]:
        typer.echo(f"{job.out / name}  {what}")
    if not result.models:
        typer.echo(f"torchsfm: nothing could be reconstructed: {result.failure()}", err=True)
        raise typer.Exit(NOTHING)


def write_models(job: Job, result: SfmResult) -> list[tuple[str, str]]:
    """Write each model in all formats whose packages are there; return what to look at."""

    def npz(model: Reconstruction, path: Path) -> None:
        model.save(path)

    for stale in (path for pattern in ("model*.npz", "points*.ply", "page*.html") for path in job.out.glob(pattern)):
        stale.unlink()
    formats: list[tuple[str, str, Callable[[Reconstruction, Path], Any], str]] = [
        ("page", ".html", write_page, "open it in a browser and turn the model with the mouse"),
        ("model", ".npz", npz, "the model, for Reconstruction.load and torchsfm info"),
        ("points", ".ply", write_ply, "coloured points and cameras for viewers"),
        ("colmap", "", write_colmap, "the model for COLMAP"),
    ]
    written = []
    for i, model in enumerate(result.models):
        for k, (stem, suffix, write, what) in enumerate(formats):
            job.progress("write", i * len(formats) + k, len(result.models) * len(formats))
            name = f"{stem}{suffix}" if i == 0 else f"{stem}-{i}{suffix}"
            try:
                write(model, job.out / name)
            except ImportError as error:
                if i == 0:
                    written.append((name, f"not written: the package {error.name} is not installed"))
                continue
            written.append((name, what if i == 0 else f"the same of model {i}"))
    return written


def peak_memory() -> float | None:
    """The most memory this process ever held, in MB, where the system tells."""
    try:
        import resource
    except ImportError:
        return None
    # Linux counts in kilobytes, macOS in bytes.
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def main() -> None:
    """Run the command line."""
    app()


if __name__ == "__main__":
    main()
