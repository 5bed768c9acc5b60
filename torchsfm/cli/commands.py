"""The commands by name: each is loaded from its file when it is called."""

import json
import sys
from importlib import import_module
from importlib.metadata import version
from io import TextIOWrapper
from typing import Annotated, Any

import typer
from typer.core import TyperGroup
from typer.main import get_command

from torchsfm.cli.voice import spoken

COMMANDS = {
    "reconstruct": ("reconstruct", "Turn photographs into calibrated cameras and coloured 3D points."),
    "demo": ("demo", "Photograph a synthetic scene, reconstruct it knowing nothing, and compare with the truth."),
    "info": ("info", "Describe saved models: cameras, points and how well each image fits."),
    "view": ("view", "Show a model in the browser, to turn with the mouse."),
    "compare": (
        "compare",
        "Compare the cameras of a model with true ones: pose AUC, position error, and the error of each image.",
    ),
    "triangulate": ("known_poses", "Find the 3D points of photographs whose poses are known."),
    "register": ("known_poses", "Place new photographs in an old model, whose poses and cameras stay as they are."),
    "align": (
        "align",
        "Move a model to the frame and scale of another one, of GPS, of measured points or of the ground; or scale it.",
    ),
    "merge": ("merge", "Join models that share images, in the world frame of the first one, and adjust them together."),
    "bundle": ("bundle", "Adjust cameras and points of a given problem, and compare before and after."),
    "calibrate": ("calibrate", "Calibrate a camera from photographs of a flat pattern, and say how sure the result is."),
    "export": (
        "export",
        "Write a folder that another program can be pointed at: model and, where it wants them, undistorted pictures.",
    ),
    "convert": ("export", "Write a model in another format."),
    "curves": ("curves", "Find the curves in space whose images are the edges of photographs with known cameras."),
}
"""Of each command the file in which its function stands, and the first line of that function's docstring.

So the program tells what it can do before it has loaded PyTorch.
"""


class Commands(TyperGroup):
    """All commands: listed as the table has them, and loaded when they are called."""

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[Any, Any, list[str]]:
        """The command that the words name, from its file, and the words that are for it."""
        name, _, rest = super().resolve_command(ctx, args)
        return name, name and load(name), rest

    def invoke(self, ctx: Any) -> Any:
        """Run the command that the words name; wrong usage is told to programs, too, where the words ask for `--json`."""
        wanted = "--json" in ctx.args
        try:
            return super().invoke(ctx)
        except Exception as error:
            # Errors of usage, which are raised before the command begins, are of a class that has a message for people.
            if wanted and hasattr(error, "format_message"):
                typer.echo(json.dumps({"error": error.format_message(), "status": 2, "text": []}))
            raise


def load(name: str) -> Any:
    """The command of this name with all its options."""
    file, _ = COMMANDS[name]
    alone = typer.Typer(add_completion=False)
    alone.command(name)(spoken(getattr(import_module(f"torchsfm.cli.{file}"), name)))
    return get_command(alone)


app = typer.Typer(
    name="torchsfm",
    cls=Commands,
    help="From photographs to calibrated cameras and 3D structure.",
    epilog="Exit status: 0 all good, 1 nothing could be reconstructed, 2 wrong input or usage, or a file that cannot be read or"
    " written (results of an earlier run then stay as they were), 130 interrupted.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def print_version(wanted: bool) -> bool:
    """Print the version and end, if wanted."""
    if wanted:
        typer.echo(f"torchsfm {version('torchsfm')}")
        raise typer.Exit
    return wanted


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", is_eager=True, callback=print_version)
    ] = False,
) -> None:
    """From photographs to calibrated cameras and 3D structure."""
    for stream in (sys.stdout, sys.stderr):
        # Names of folders may hold what the terminal's encoding does not.
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def unloaded() -> None:
    """Stand for a command in the list of all."""


for name, (_, line) in COMMANDS.items():
    app.command(name, help=line)(unloaded)
