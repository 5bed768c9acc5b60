"""`torchsfm view`: the page of a model in the browser."""

import tempfile
import webbrowser
from pathlib import Path
from threading import Event
from typing import Annotated

import typer

from torchsfm.cli.export import find_photographs, load
from torchsfm.cli.job import Job, UserError, told
from torchsfm.formats.registry import model_files
from torchsfm.plot import LiveViewer, write_page

PAGE = "page.html"


def view(
    model: Annotated[
        Path, typer.Argument(help="Folder written by `torchsfm reconstruct`, or a model of any format.", show_default=False)
    ],
    images: Annotated[
        Path | None,
        typer.Option(help="Folder with the photographs under their names, to be shown at the cameras.", show_default=False),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Where to write the page; by default that of the run, else a temporary file.", show_default=False),
    ] = None,
    unit: Annotated[
        str, typer.Option(help="Name of the unit that the model is in, such as m; without it lengths are in units.")
    ] = "",
    live: Annotated[
        bool, typer.Option("--live", help="Serve the model to the browser until Ctrl-C, with viser (the extra `viser`).")
    ] = False,
    port: Annotated[int, typer.Option(min=1, max=65535, help="For --live: the port, or the next free one.")] = 8080,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page, or only say where it is.")] = True,
) -> None:
    """Show a model in the browser, to turn with the mouse."""
    with told(Job(out or model)) as job:
        page = model / PAGE
        if images is not None and not images.is_dir():
            raise UserError(f"{images}: no such folder")
        if live:
            serve(job, model, images, port, browser)
            return
        if images is not None or out is not None or unit or not page.is_file():
            page = write(model, images, out, unit)
        job.close()
        job.voice.record["page"] = str(page.absolute())
        if browser and not webbrowser.open(page.absolute().as_uri()):
            typer.echo(f"{page}  no browser was found here: open it in one")
        else:
            typer.echo(f"{page}  open it in a browser and turn the model with the mouse" if not browser else str(page))


def serve(job: Job, path: Path, images: Path | None, port: int, browser: bool) -> None:
    """Show the model of a path by the live viewer until the user ends that.

    Raises:
        UserError: It holds no model, or there is no viewer.
    """
    model = load(path)
    try:
        viewer = LiveViewer(port=port)
    except ImportError as error:
        raise UserError(str(error)) from None
    try:
        viewer.show(model, images=images or find_photographs(path, model))
        job.voice.record["address"] = viewer.address
        if not job.voice.quiet:
            typer.echo(f"{viewer.address}  Ctrl-C ends it", err=True)
        if browser:
            webbrowser.open(viewer.address)
        Event().wait()
    except KeyboardInterrupt:
        pass
    finally:
        viewer.close()


def write(model: Path, images: Path | None, out: Path | None, unit: str) -> Path:
    """Write the page of what a path holds.

    Raises:
        UserError: It holds no model.
    """
    try:
        models = [load(file) for _, file in model_files(model)]
    except ValueError as error:
        raise UserError(" ".join(str(error).split())) from None
    if out is not None and out.is_dir():
        out = out / PAGE
    target = out or Path(tempfile.mkdtemp(prefix="torchsfm-")) / PAGE
    photographs = images or find_photographs(model, models[0])
    return write_page(models, target, title=model.resolve().name, images=photographs, unit=unit)
