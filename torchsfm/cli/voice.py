"""Whom a command speaks to: people, programs (`--json`), or nobody unless something is wrong (`--quiet`)."""

import inspect
import io
import json
import math
from collections.abc import Callable
from contextlib import redirect_stdout
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import wraps
from typing import Annotated, Any

import typer

Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but warnings and errors.")]
Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON object on stdout, and nothing else there: results, `status`, `error`.")
]


@dataclass
class Voice:
    """How a command is to speak, and what it has to say to programs."""

    quiet: bool = False
    record: dict[str, Any] = field(default_factory=dict)
    """Its results; with `text`, what people would have read, it makes the object of `--json`."""


VOICE: ContextVar[Voice] = ContextVar("VOICE", default=Voice())  # noqa: B039, for callers that are no command


def spoken(command: Callable[..., None]) -> Callable[..., None]:
    """The command with the options `--quiet` and `--json`.

    What it prints on stdout is kept from there; with `--json` the object is printed at the end, whatever its exit status. A
    fault of the program prints no object.
    """

    @wraps(command)
    def run(*arguments: Any, quiet: bool, as_json: bool, **options: Any) -> None:
        voice = Voice(quiet)
        before = VOICE.set(voice)
        heard, status = io.StringIO(), 0
        try:
            if not (quiet or as_json):
                command(*arguments, **options)
                return
            try:
                with redirect_stdout(heard):
                    command(*arguments, **options)
            except typer.Exit as end:
                status = end.exit_code
            if as_json:
                content = {**voice.record, "status": status, "text": heard.getvalue().splitlines()}
                typer.echo(json.dumps(plain(content), allow_nan=False))
            if status:
                raise typer.Exit(status)
        finally:
            VOICE.reset(before)

    signature = inspect.signature(command)
    more = {"quiet": Quiet, "as_json": Json}
    parameters = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=kind) for name, kind in more.items()
    ]
    run.__signature__ = signature.replace(parameters=[*signature.parameters.values(), *parameters])  # type: ignore[attr-defined]
    run.__annotations__ = {**command.__annotations__, **more}
    return run


def plain(value: Any) -> Any:
    """The value with null in the place of numbers that JSON has not: infinite ones, and those that are none."""
    match value:
        case float():
            return value if math.isfinite(value) else None
        case dict():
            return {str(key): plain(entry) for key, entry in value.items()}
        case list() | tuple():
            return [plain(entry) for entry in value]
        case _:
            return value
