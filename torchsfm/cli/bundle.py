"""`torchsfm bundle`: adjust a problem or model that is there already, and say what it brought."""

import time
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import torch
import typer

from torchsfm._types import Status
from torchsfm.bundle import BundleResult, bundle_adjust_model
from torchsfm.cli.job import INTERRUPTED, NOTHING, Job, UserError, told
from torchsfm.formats import read_bal, read_colmap, read_libmv, write_bal, write_colmap, write_ply
from torchsfm.geometry import BundleProblem, Radial
from torchsfm.geometry.intrinsic_parameters import INTRINSICS
from torchsfm.optim import Cauchy, GemanMcClure, Huber, Loss, SoftL1, Truncated, Tukey
from torchsfm.reconstruction import Reconstruction

Model = Reconstruction | BundleProblem


class LossName(StrEnum):
    """Losses of `--loss`."""

    squares = "squares"
    huber = "huber"
    soft_l1 = "soft_l1"
    cauchy = "cauchy"
    geman_mcclure = "geman_mcclure"
    tukey = "tukey"
    truncated = "truncated"


LOSSES: dict[LossName, Callable[[float], Loss]] = {
    LossName.huber: Huber,
    LossName.soft_l1: SoftL1,
    LossName.cauchy: Cauchy,
    LossName.geman_mcclure: GemanMcClure,
    LossName.tukey: Tukey,
    LossName.truncated: Truncated,
}
ENDINGS = {
    Status.OK: "converged",
    Status.NOT_CONVERGED: "stopped at the largest number of iterations",
    Status.INTERRUPTED: "interrupted",
}


def bundle(
    file: Annotated[
        Path,
        typer.Argument(
            help="A BAL problem (.txt, .txt.gz, .txt.bz2), a libmv problem (.bin), a COLMAP folder, or a saved model (.npz).",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Where to write the result: .npz, .ply, .txt, .txt.gz or .txt.bz2 (BAL); anything else is a COLMAP folder.",
            show_default=False,
        ),
    ] = None,
    free: Annotated[
        str | None,
        typer.Option(
            help="Intrinsics to adjust, with commas between: focal, aspect, principal_point, skew and distortion parameters;"
            " none to hold them. By default the focal length and all distortion parameters.",
            show_default=False,
        ),
    ] = None,
    loss: Annotated[LossName, typer.Option(help="Loss of the reprojection error.")] = LossName.squares,
    loss_scale: Annotated[float, typer.Option(min=1e-6, help="Pixels from which on the loss takes errors for outliers.")] = 1.0,
    max_iterations: Annotated[int, typer.Option(min=0, help="Most iterations.")] = 50,
    tolerance: Annotated[float, typer.Option(min=0, help="Least relative decrease of the cost to go on for.")] = 1e-6,
    threads: Annotated[int | None, typer.Option(min=1, help="Processor threads; all by default.")] = None,
) -> None:
    """Adjust cameras and points of a given problem, and compare before and after.

    An interrupt (Ctrl-C) ends it with the best so far, which is written as the end would be.
    """
    with told(Job(out or file)) as job:
        job.set_threads(threads)
        job.progress("problem", 0, 1)
        model = read_model(file)
        job.progress("problem", 1, 1)
        check_output(model, out)
        names = free_names(model, free)
        before = model.residuals()
        job.progress("bundle", 0, max_iterations)
        start = time.perf_counter()
        adjusted = bundle_adjust_model(
            model,
            free=names,
            loss=None if loss is LossName.squares else LOSSES[loss](loss_scale),
            max_iterations=max_iterations,
            tolerance=tolerance,
            progress=lambda iteration, cost: job.progress("bundle", iteration, max_iterations),
        )
        seconds = time.perf_counter() - start
        job.close()
        result = adjusted.result
        typer.echo(describe(model, names))
        typer.echo(compare_residuals(before, result))
        typer.echo(f"{ENDINGS.get(result.status, 'ended')} after {result.iterations} iterations, {seconds:.2f} s")
        if result.status in (Status.TOO_FEW, Status.NOT_FINITE):
            typer.echo(f"torchsfm: {file}: nothing to adjust: no observation of finite numbers", err=True)
            raise typer.Exit(NOTHING)
        if out is not None:
            write_model(adjusted.model, out)
            typer.echo(f"written: {out}")
        if result.status == Status.INTERRUPTED:
            raise typer.Exit(INTERRUPTED)


def read_model(path: Path) -> Model:
    """Read whatever the path holds.

    Raises:
        UserError: It is not there or cannot be read as what its name says.
    """
    if not path.exists():
        raise UserError(f"{path}: no such file or folder")
    try:
        if path.is_dir():
            return read_colmap(path)
        if path.suffix == ".npz":
            return Reconstruction.load(path)
        return read_libmv(path) if path.suffix == ".bin" else read_bal(path)
    except ValueError as error:
        raise UserError(" ".join(str(error).split())) from None


def free_names(model: Model, wanted: str | None) -> tuple[str, ...]:
    """The intrinsics to adjust.

    Raises:
        UserError: A name is not one of the model's.
    """
    distortion = tuple(model.cameras.distortion.parameter_names)
    if wanted is None:
        return ("focal", *distortion)
    names = tuple(name.strip().replace("-", "_") for name in wanted.split(",") if name.strip())
    if names in ((), ("none",)):
        return ()
    known = (*INTRINSICS, *distortion)
    for name in names:
        if name not in known:
            raise UserError(f"--free: wanted names among {', '.join(known)}, got {name!r}")
    return names


def describe(model: Model, names: tuple[str, ...]) -> str:
    """What is adjusted, in one line."""
    kind = type(model.cameras.distortion).__name__
    return (
        f"{len(torch.unique(model.view))} views, {len(model.cameras.K)} cameras ({kind}), {len(model.X)} points, "
        f"{len(model.x)} observations; free intrinsics: {', '.join(names) or 'none'}"
    )


def compare_residuals(before: torch.Tensor, result: BundleResult) -> str:
    """A table of two lines, over the observations that count."""
    lines = [f"{'':6}  {'cost':>14}  {'RMS, px':>10}  {'median, px':>10}  {'90 %, px':>10}"]
    for name, cost, residuals in (("before", result.initial_cost, before), ("after", result.cost, result.residuals)):
        r = residuals[result.used].double()
        numbers = (r.square().mean().sqrt(), r.quantile(0.5), r.quantile(0.9)) if len(r) else (torch.nan,) * 3
        lines.append(f"{name:6}  {cost:14.6g}" + "".join(f"  {float(v):10.4f}" for v in numbers))
    unused = len(result.used) - int(result.used.sum())
    if unused:
        lines.append(f"{unused} observations left out: not finite")
    return "\n".join(lines)


def check_output(model: Model, out: Path | None) -> None:
    """See that the result can be written there, before the work.

    Raises:
        UserError: The folder is not there, or the format cannot hold the model.
    """
    if out is None:
        return
    if not out.absolute().parent.is_dir():
        raise UserError(f"{out.absolute().parent}: no such folder")
    if is_bal(out) and not Radial.includes(type(model.cameras.distortion)):
        raise UserError(f"{out}: BAL holds two radial coefficients, not {type(model.cameras.distortion).__name__}")


def is_bal(path: Path) -> bool:
    """Whether the name is that of a BAL problem."""
    return path.suffix in (".txt", ".gz", ".bz2")


def write_model(model: Model, out: Path) -> None:
    """Write in the format that the name says.

    Raises:
        UserError: The format cannot hold the model.
    """
    try:
        if is_bal(out):
            write_bal(as_problem(model), out)
        elif out.suffix == ".npz":
            as_reconstruction(model).save(out)
        elif out.suffix == ".ply":
            write_ply(as_reconstruction(model), out)
        else:
            write_colmap(as_reconstruction(model), out)
    except ValueError as error:
        raise UserError(f"{out}: {' '.join(str(error).split())}") from None


def as_problem(model: Model) -> BundleProblem:
    """The members that count."""
    names: dict[str, Any] = {name: getattr(model, name) for name in BundleProblem.__dataclass_fields__}
    return BundleProblem(**names)


def as_reconstruction(model: Model) -> Reconstruction:
    """With names that are numbers, grey points, and images as large as their observations need."""
    if isinstance(model, Reconstruction):
        return model
    views = model.poses.shape[0]
    order = torch.argsort(model.point * views + model.view)
    size = torch.ones(views, 2, dtype=torch.int64)
    size.scatter_reduce_(0, model.view[:, None].expand(-1, 2), model.x.nan_to_num(0).ceil().long() + 1, "amax")
    return Reconstruction(
        tuple(f"{k:06d}" for k in range(views)),
        size,
        model.cameras,
        model.camera_index,
        model.poses,
        torch.ones(views, dtype=torch.bool),
        model.X,
        torch.full_like(model.X, 0.5),
        model.x[order],
        model.view[order],
        model.point[order],
    )
