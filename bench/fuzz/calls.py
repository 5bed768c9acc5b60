"""Bad arguments for every public function: values of every kind, and wrong shapes, types and options.

Good arguments come from a scene, by the names and shapes in the signatures. Some problems of a batch are then made bad: nothing
may be raised, what the result calls good must be finite and supported, and the other problems must get the very numbers that
they get without bad neighbours. Wrong arguments must raise a `ValueError` that names them, or be right after all.
"""

import inspect
import re
from collections.abc import Callable, Iterator
from typing import Any, get_args, get_type_hints, is_typeddict

import numpy as np
import torch
from torch import Tensor

from bench.fuzz.campaign import Target, Trial, main
from bench.fuzz.functions import EXCEPTIONS, FUNCTIONS, INNER, Function, public_functions
from bench.fuzz.poison import poison
from bench.fuzz.promises import changed, not_finite, tensors, verdict, zero_models
from bench.fuzz.scene import Scene
from bench.fuzz.support import JUDGES
from torchsfm._types import tensor_map

SMALL: tuple[tuple[int, ...], ...] = ((4,), (2, 3))
"""Shapes of batches of what is slow."""
BATCHES = (*SMALL, *[(64,)] * 6)
"""Shapes of batches of all else: most are large, for one call then judges many problems."""
BAD = 0.75
"""Share of the problems of a batch that are made bad."""
OPTIONAL = 0.3
"""How often an optional argument is given."""
JUDGED_BY_TORCH = {"device", "dtype", "generator", "shape", "progress"}
"""Options of which torch itself, or Python, says what is wrong with them."""
ELSEWHERE = "on another device"

Arguments = dict[str, Any]
Call = Callable[..., Any]


def load() -> list[Target]:
    """A target for the values of each function, and one for the arguments of those that are for users.

    The others are for the library's own inner loops, which know what they pass.
    """
    targets = []
    for name, call in public_functions().items():
        if name in EXCEPTIONS:
            continue
        how = FUNCTIONS.get(name, Function())
        targets.append(Target(f"{name} values", lambda seed, name=name, call=call: _bad_values(name, call, seed)))
        if not name.startswith("linalg.") and name not in INNER:
            targets.append(Target(f"{name} arguments", lambda seed, call=call, how=how: _wrong_arguments(call, how, seed)))
    return targets


def good_arguments(call: Call, how: Function, scene: Scene) -> Arguments:
    """Arguments by name that make sense together; optional ones now and then."""
    arguments: Arguments = {}
    left_out = {name for group in how.together if torch.rand((), generator=scene.generator) > OPTIONAL for name in group}
    together = {name for group in how.together for name in group} - left_out
    for name, parameter in parameters_of(call).items():
        if name in how.given:
            value = how.given[name]
            arguments[name] = value(scene) if inspect.isfunction(value) else value
            continue
        kinds = [a for a in (parameter.annotation, *get_args(parameter.annotation)) if hasattr(a, "dim_str")]
        needed = parameter.default is parameter.empty and parameter.kind is not parameter.VAR_KEYWORD
        given = name in together or torch.rand((), generator=scene.generator) < OPTIONAL
        if not needed and (not kinds or name in left_out or not given):
            continue
        dims = [tuple(d for d in kind.dim_str.split() if not d.startswith(("*", "_"))) for kind in kinds]
        found = (scene.value(name, d) for d in dims)
        value = next((v for v in found if v is not None), None)
        if value is not None:
            arguments[name] = value
        elif needed:
            raise LookupError(f"{call.__name__}: what is {name}? Say so in bench.fuzz.functions")
    return arguments


def parameters_of(call: Call) -> dict[str, inspect.Parameter]:
    """The parameters by name; options that a typed dictionary describes are parameters of their own."""
    found: dict[str, inspect.Parameter] = {}
    for name, parameter in inspect.signature(call).parameters.items():
        options = [kind for kind in get_args(parameter.annotation) if is_typeddict(kind)]
        if parameter.kind is parameter.VAR_KEYWORD and options:
            for option, annotation in get_type_hints(options[0]).items():
                found[option] = inspect.Parameter(option, parameter.KEYWORD_ONLY, default=None, annotation=annotation)
        else:
            found[name] = parameter
    return found


def apply(call: Call, arguments: Arguments) -> Any:
    """Call with arguments by name, also those that signatures take as `*args`; every generator starts anew."""
    positional: list[Any] = []
    keywords: Arguments = {}
    parameters = parameters_of(call)
    several = any(p.kind is p.VAR_POSITIONAL for p in parameters.values())
    for name, parameter in parameters.items():
        if name not in arguments:
            continue
        value = arguments[name]
        if isinstance(value, torch.Generator):
            value = torch.Generator().manual_seed(value.initial_seed())
        if parameter.kind is parameter.VAR_POSITIONAL:
            positional += value
        elif several and parameter.kind is parameter.POSITIONAL_OR_KEYWORD:
            positional.append(value)
        else:
            keywords[name] = value
    return call(*positional, **keywords)


def _scene(how: Function, generator: torch.Generator, batch: tuple[int, ...]) -> Scene:
    return Scene(generator, batch if how.batched else (), tuple(how.sizes.items()), how.planar, how.centred)


def _cast(arguments: Arguments, dtype: torch.dtype) -> Arguments:
    return tensor_map(lambda t: t.to(dtype) if t.is_floating_point() else t, arguments)


def _poisoned(arguments: Arguments, how: Function, kept: Tensor, generator: torch.Generator) -> Arguments:
    """The arguments with the problems that are not kept made bad, one by one."""
    leaves = dict(tensors(arguments))
    b = kept.ndim if how.batched else 0
    mine = {name: t.clone() for name, t in leaves.items() if t.shape[:b] == kept.shape[:b] and _is_data(t, how)}
    for index in (~kept).nonzero().tolist() if b else [()]:
        bad = poison({name: t[tuple(index)] for name, t in mine.items()}, generator)
        for name, value in bad.items():
            mine[name][tuple(index)] = value
    spoiled = iter([mine.get(name, t) for name, t in leaves.items()])
    return tensor_map(lambda _: next(spoiled), arguments)


def _is_data(t: Tensor, how: Function) -> bool:
    return t.is_floating_point() or (t.dtype == torch.bool and how.batched)


def _bad_values(name: str, call: Call, seed: int) -> Trial:
    how = FUNCTIONS.get(name, Function())
    generator = torch.Generator().manual_seed(seed)
    batches = SMALL if how.slow else BATCHES
    scene = _scene(how, generator, batches[seed % len(batches)])
    arguments = good_arguments(call, how, scene)
    if how.half and torch.rand((), generator=generator) < 0.3:
        arguments = _cast(arguments, torch.float32)
    kept = torch.zeros(scene.batch, dtype=torch.bool)
    if how.batched:
        while not bool(kept.any()) or bool(kept.all()):
            kept = torch.rand(scene.batch, generator=generator) >= BAD
    bad = _poisoned(arguments, how, kept, generator)
    try:
        result = apply(call, bad)
    except how.raises:
        return Trial(1)
    broken = [*not_finite(result), *zero_models(result)]
    if name in JUDGES:
        broken += JUDGES[name](result, _cast(bad, torch.float64))
    if how.batched:
        broken += changed(result, apply(call, arguments), kept, homogeneous=how.homogeneous)
    return Trial(int((~kept).sum()) if how.batched else 1, tuple(broken))


def _wrong_arguments(call: Call, how: Function, seed: int) -> Trial:
    generator = torch.Generator().manual_seed(seed)
    batch: tuple[int, ...] = ((), (2,), (0,))[int(torch.randint(3, (), generator=generator))]
    arguments = good_arguments(call, how, _scene(how, generator, batch))
    parameters = parameters_of(call)
    several = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    names = [n for n, p in parameters.items() if p.kind not in several and n not in JUDGED_BY_TORCH]
    names = [n for n in names if not callable(arguments.get(n, parameters[n].default))]
    if not names:
        return Trial(0)
    name = names[int(torch.randint(len(names), (), generator=generator))]
    value = arguments.get(name, parameters[name].default)
    alone = sum(isinstance(a, Tensor) for a in arguments.values()) < 2
    wrong = [w for w in _wrong_values(value, generator) if not (alone and w[0] == ELSEWHERE)]
    if not wrong:
        return Trial(0)
    what, wrong_value = wrong[int(torch.randint(len(wrong), (), generator=generator))]
    try:
        result = apply(call, arguments | {name: wrong_value})
    except how.raises:
        return Trial(1)
    except ValueError as error:
        said = str(error)
        # Where two arguments do not fit together the other may be the one that is named.
        named = name in said or bool(parameters.keys() & set(re.findall(r"\w+", said.partition(":")[0])))
        return Trial(1, () if named else (f"unnamed: {name} = {what}: {' '.join(said.split())[:160]}",))
    except Exception as error:
        text = " ".join(str(error).split())[:120]
        return Trial(1, (f"not a ValueError: {name} = {what}: {type(error).__name__}: {text}",))
    good = verdict(result)
    empty = isinstance(wrong_value, Tensor) and not wrong_value.numel() and isinstance(value, Tensor) and value.numel()
    broken = list(not_finite(result))
    if empty and "no data" in what and good is not None and bool(good.any()) and value.is_floating_point():
        broken.append(f"something from nothing: {name} = {what}")
    return Trial(1, tuple(broken))


def _wrong_values(value: Any, generator: torch.Generator) -> Iterator[tuple[str, Any]]:
    """Values that are none for an argument, each with a word for it."""
    if isinstance(value, Tensor):
        yield "None", None
        yield "a list", value.tolist()
        yield "an array", np.asarray(value)
        yield "a number", 1.0
        yield "a string", "tensor"
        for dtype in (torch.float16, torch.bfloat16, torch.float32, torch.int64, torch.bool, torch.complex128):
            yield str(dtype), value.to(dtype)
        yield ELSEWHERE, value.to("meta")
        if value.ndim and value.numel():
            yield "a longer last dimension", torch.cat((value, value[..., :1]), -1)
            yield "a shorter last dimension", value[..., :-1]
            yield "an empty last dimension", value[..., :0]
            yield "a dimension less", value[..., 0]
            yield "one number", value.flatten()[:1].sum()
            yield "a batch that does not fit", value.expand(3, *value.shape) if value.ndim < 5 else value[..., 0]
        if value.ndim > 1:
            yield "no data", value[..., :0, :]
            yield "one datum", value[..., :1, :]
            yield "transposed", value.mT
        if value.ndim > 2:
            yield "no matrix", value[..., :0, :, :]
    elif isinstance(value, bool):
        yield from (("None", None), ("a string", "yes"))
    elif isinstance(value, int | float):
        yield from (("None", None), ("a string", "many"), ("-1", -1), ("0", 0), ("nan", torch.nan), ("inf", torch.inf))
        yield from (("1.5", 1.5), ("a tensor", torch.ones(7)), ("a list", [value]))
    elif isinstance(value, str):
        yield from (("None", None), ("a number", 3), ("another word", "nonsense"))
    elif isinstance(value, tuple):
        yield from (("None", None), ("a string", "ab"), ("empty", ()), ("longer", (*value, *value)))
        yield from (("of strings", ("a",) * len(value)), ("of nan", (torch.nan,) * len(value)), ("of zeros", (0,) * len(value)))
    elif value is None or value is inspect.Parameter.empty:
        yield from (("a string", "nonsense"), ("a list", [1.0]), ("a wrong tensor", torch.ones(7, 1, 5)))
    else:
        yield from (("None", None), ("a string", "nonsense"), ("a number", 3.0))


if __name__ == "__main__":
    main(["bench.fuzz.calls"], __doc__)
