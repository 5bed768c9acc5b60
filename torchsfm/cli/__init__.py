"""The `torchsfm` command: photographs to model, a demonstration with known truth, and a look at saved models.

Exit statuses: 0, all good; 1, nothing could be reconstructed; 2, wrong input or usage, a file that cannot be read or written (a
full disk), or another run that is writing to the same folder; 130, interrupted (finished stages are saved). What the user can
put right is told in one line on stderr; a traceback means a fault of the program. The results of a run replace those of an
earlier one all together, when they are complete: whatever else happens, those stay as they were.
"""

from torchsfm.cli.commands import app


def main() -> None:
    """Run the command line."""
    app()


__all__ = ["app", "main"]
