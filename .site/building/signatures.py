"""Types as a user writes them, in signatures and at attributes."""

import enum
import inspect
import re
from functools import cache
from typing import Any

from building.names import listed

DOTTED = re.compile(r"~?([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+)")


def shorten(app: Any, what: str, name: str, value: Any, options: Any, signature: str | None, result: str | None) -> Any:
    """Signatures with names as a user writes them; none for what no one calls."""
    if inspect.isclass(value) and (getattr(value, "_is_protocol", False) or issubclass(value, (enum.Enum, Exception, dict))):
        return signature and "", None
    return signature and short(signature), result and short(result)


def short(types: str) -> str:
    """Names without the modules they are in; those that are public as they are documented."""
    types = DOTTED.sub(lambda found: _shown(found[1]), types)
    return types.replace("*#", "*").replace("'#", "'").replace("<factory>", "...")


def _shown(dotted: str) -> str:
    return f"~{_documented()[dotted]}" if dotted in _documented() else dotted.rpartition(".")[2]


@cache
def _documented() -> dict[str, str]:
    """Where values of modules that are not public are documented."""
    values = ((n.value, n.full) for n in listed().values() if n.kind != "data")
    return {f"{value.__module__}.{value.__qualname__}": full for value, full in values}
