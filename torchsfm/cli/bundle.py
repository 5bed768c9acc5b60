"""`torchsfm bundle`: adjust a problem or model that is there already, and say what it brought."""

import time
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import torch
import typer

from torchsfm._types import Status
from torchsfm.bundle import BundleResult, bundle_adjust_model
from torchsfm.cli.job import INTERRUPTED, NOTHING, Job, UserError, told
from torchsfm.formats import write_model
from torchsfm.formats.registry import format_for, read_model_or_problem
from torchsfm.geometry import BundleProblem, Radial
from torchsfm.geometry.intrinsic_parameters import INTRINSICS
from torchsfm.optim import Cauchy, GemanMcClure, Huber, Loss, SoftL1, Truncated, Tukey


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
            help="A BAL or libmv problem, a saved model (.npz), or a model of any other format.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Where to write the result: .npz, .ply, .txt, .txt.gz or .txt.bz2 (BAL), or what else `torchsfm convert`"
            " writes; a name without ending is a COLMAP folder.",
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
        model = load(file)
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
        job.voice.record.update(
            cost_before=float(result.initial_cost), cost=float(result.cost), iterations=int(result.iterations),
            ending=Status(int(result.status)).name, out=None if out is None else str(out),
        )  # fmt: skip
        typer.echo(f"{ENDINGS.get(result.status, 'ended')} after {result.iterations} iterations, {seconds:.2f} s")
        if result.status in (Status.TOO_FEW, Status.NOT_FINITE):
            job.fail(f"{file}: nothing to adjust: no observation of finite numbers")
            raise typer.Exit(NOTHING)
        if out is not None:
            save(adjusted.model, out)
            typer.echo(f"written: {out}")
        if result.status == Status.INTERRUPTED:
            raise typer.Exit(INTERRUPTED)


def load(path: Path) -> BundleProblem:
    """Read whatever the path holds.

    Raises:
        UserError: It is not there or no model.
    """
    try:
        return read_model_or_problem(path)
    except ValueError as error:
        raise UserError(" ".join(str(error).split())) from None


def free_names(model: BundleProblem, wanted: str | None) -> tuple[str, ...]:
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


def describe(model: BundleProblem, names: tuple[str, ...]) -> str:
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


def check_output(model: BundleProblem, out: Path | None) -> None:
    """See that the result can be written there, before the work.

    Raises:
        UserError: The folder is not there, or the format cannot hold the model.
    """
    if out is None:
        return
    if not out.absolute().parent.is_dir():
        raise UserError(f"{out.absolute().parent}: no such folder")
    try:
        kind = format_for(out)
    except ValueError as error:
        raise UserError(str(error)) from None
    if kind.name == "bal" and not Radial.includes(type(model.cameras.distortion)):
        raise UserError(f"{out}: BAL holds two radial coefficients, not {type(model.cameras.distortion).__name__}")


def save(model: BundleProblem, out: Path) -> None:
    """Write in the format that the name says.

    Raises:
        UserError: The format cannot hold the model.
    """
    try:
        write_model(model, out)
    except ValueError as error:
        raise UserError(f"{out}: {' '.join(str(error).split())}") from None
