"""The package's calls are checked against their annotations: the types by beartype, the names of axes by jaxtyping.

What jaxtyping's import hook does with its own decorator, at a fraction of the price: a function that is defined anew in every
call of another has its checks made once, and a call of which annotations can tell no more than of one that passed, as the
types and shapes are the same, passes.
"""

import dataclasses
import functools
import inspect
from collections.abc import Callable, Collection, Hashable
from typing import Any

import jaxtyping
import numpy as np
from beartype import beartype
from torch import Tensor

_CHECKS: dict[tuple[str, str, int], "_Checks"] = {}
_PLAIN: set[type] = set()
"""Types of which annotations tell no more than the type."""


def install() -> None:
    """Have the import hook that `--jaxtyping-packages` sets up decorate with `checked`: it goes by the name in the module."""
    jaxtyping.jaxtyped = checked


def checked(target: Any = None, *, typechecker: Any = None) -> Any:
    """A function, or a dataclass of which the making is, that raises where a call breaks its annotations."""
    if target is None:
        return functools.partial(checked, typechecker=typechecker)
    if inspect.isclass(target):
        if dataclasses.is_dataclass(target) and not hasattr(target.__init__, "__wrapped__"):
            target.__init__ = checked(target.__init__)
        return target
    checks = _CHECKS.setdefault((target.__module__, target.__qualname__, target.__code__.co_firstlineno), _Checks())
    config, passed_for = jaxtyping.config, checks.passed.get

    @functools.wraps(target)
    def call(*args: Any, **kwargs: Any) -> Any:
        if config.jaxtyping_disable:
            return target(*args, **kwargs)
        if checks.given is None:
            checks.make(target)
        try:
            given = checks.given(*args, **kwargs)
        except TypeError:
            checks.arguments(*args, **kwargs)  # says what is wrong with the call
            raise
        passed = passed_for(given)
        if passed is None:
            with _names_of_axes("context"):
                checks.arguments(*args, **kwargs)
                checks.passed[given] = passed = set()
                value = target(*args, **kwargs)
                checks.result(value)
                passed.add(checks.kind(value))
            return value
        value = target(*args, **kwargs)
        kind = checks.kind(value)
        if kind not in passed:
            with _names_of_axes("context"):
                checks.arguments(*args, **kwargs)
                checks.result(value)
            passed.add(kind)
        return value

    return call


_names_of_axes = jaxtyping.jaxtyped


class _Checks:
    """Those of one function, made once it is called."""

    arguments: Callable[..., None]
    result: Callable[[Any], Any]
    given: Callable[..., Hashable] | None = None
    """All that the annotations of arguments can tell of these,"""
    kind: Callable[[Any], Hashable]
    """and that of the result of one."""

    def __init__(self) -> None:
        self.passed: dict[Hashable, set[Hashable]] = {}
        """Kinds of results by those of arguments."""

    def make(self, target: Callable[..., Any]) -> None:
        self.arguments, self.result = _arguments(target), _result(target)
        self.kind = type if _is_told_by_type(target.__annotations__.get("return", Any)) else _kind
        self.given = _given(target)


def _is_told_by_type(hint: Any) -> bool:
    """Whether a hint asks for a class, and for nothing in which two of its values may differ."""
    return hint is None or (inspect.isclass(hint) and not type(hint).__module__.startswith("jaxtyping"))


def _given(function: Callable[..., Any]) -> Callable[..., Hashable]:
    """Takes what the function takes, and gives all that its annotations can tell of that; written out, as loops take longer."""
    parts = []
    for name, p in inspect.signature(function).parameters.items():
        if p.kind is p.VAR_POSITIONAL:
            parts.append(f"*_map(_kind, {name})")
        elif p.kind is p.VAR_KEYWORD:
            parts.append(f"*{name}, *_map(_kind, {name}.values())")
        elif _is_told_by_type(p.annotation):
            parts.append(f"_type({name})")
        else:
            parts.append(f"({name}.shape, {name}.dtype) if _type({name}) is _Tensor else _kind({name})")
    names = {"_kind": _kind, "_map": map, "_type": type, "_Tensor": Tensor}
    return _taking(function, f"return ({''.join(part + ', ' for part in parts)})", names)


def _kind(x: Any) -> Hashable:
    """All that annotations can tell of a value; one that holds others unseen is like no other."""
    what = type(x)
    if what is Tensor:
        return x.shape, x.dtype
    if what in _PLAIN:
        return what
    if isinstance(x, (str, int, type)):
        return what, x
    if isinstance(x, tuple):
        return what, *map(_kind, x)
    if isinstance(x, dict):
        return what, *[(_kind(key), _kind(value)) for key, value in x.items()]
    if isinstance(x, list | set | frozenset):
        return what, frozenset(map(_kind, x))
    if isinstance(x, Tensor | np.ndarray):
        return what, x.shape, x.dtype
    if isinstance(x, Collection):
        return object()
    _PLAIN.add(what)
    return what


def _arguments(function: Callable[..., Any]) -> Callable[..., None]:
    """Takes what the function takes, does nothing, and is checked."""
    take = _taking(function, "pass", {})
    take.__defaults__, take.__kwdefaults__ = function.__defaults__, function.__kwdefaults__
    return _like(function, take, {name: hint for name, hint in function.__annotations__.items() if name != "return"})


def _taking(function: Callable[..., Any], do: str, names: dict[str, Any]) -> Callable[..., Any]:
    """A function that takes the same arguments; those left out are `...`."""
    bare = [
        p.replace(annotation=p.empty, default=p.empty if p.default is p.empty else ...)
        for p in inspect.signature(function).parameters.values()
    ]
    space = dict(names)
    exec(f"def take{inspect.Signature(bare)}: {do}", space)
    return space["take"]


def _result(function: Callable[..., Any]) -> Callable[[Any], Any]:
    def give(value: Any) -> Any:
        return value

    return _like(function, give, {name: hint for name, hint in function.__annotations__.items() if name == "return"})


def _like(function: Callable[..., Any], check: Any, hints: dict[str, Any]) -> Any:
    """The check with these annotations; names in them mean what they mean where the function stands."""
    for name in ("__module__", "__name__", "__qualname__"):
        setattr(check, name, getattr(function, name))
    check.__annotations__ = hints
    return beartype(check)
