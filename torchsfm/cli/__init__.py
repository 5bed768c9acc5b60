"""The `torchsfm` command: photographs to model, a demonstration with known truth, and a look at saved models.

Exit statuses: 0, all good; 1, nothing could be reconstructed; 2, wrong input or usage; 130, interrupted (finished stages are
saved). What the user can put right is told in one line on stderr; a traceback means a fault of the program.
"""

from torchsfm.cli.commands import app


def main() -> None:
    """Run the command line."""
    app()


__all__ = ["app", "main"]
