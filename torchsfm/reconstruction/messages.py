"""What all rooms here tell their callers: how far they are, and what cannot be used."""

from collections.abc import Callable, Sequence

Progress = Callable[[str, int, int], None]
"""Called with the stage, the number of items done and the number of all."""


class ReconstructionError(ValueError):
    """The input cannot be used; the message is one line for people.

    Example:
        >>> import torchsfm
        >>> torchsfm.reconstruct("no folder")
        Traceback (most recent call last):
            ...
        torchsfm.reconstruction.messages.ReconstructionError: no folder: no such folder
    """


def printable(text: str) -> str:
    """Text in one line that every terminal and file can hold; what cannot be shown is spelt as in a Python string.

    File names may hold line breaks, commands to the terminal, and bytes that are no characters.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def describe_skipped(skipped: Sequence[tuple[str, str]]) -> list[str]:
    """One line for each reason: how many, the first names."""
    lines = []
    for reason in dict.fromkeys(reason for _, reason in skipped):
        names = [name for name, why in skipped if why == reason]
        listed = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
        lines.append(printable(f"{listed} ({reason})"))
    return lines
