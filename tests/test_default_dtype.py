"""What `torch.set_default_dtype` says is for tensors that users make: functions follow their arguments, whatever it is."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from test_device import agreeable

from bench.fuzz.calls import apply
from bench.fuzz.functions import EXCEPTIONS, FUNCTIONS, Function, public_functions
from bench.fuzz.promises import tensors
from torchsfm._types import tensor_map

CALLS = {name: call for name, call in public_functions().items() if name not in EXCEPTIONS}


def under(default: torch.dtype, call: Callable[[], Any]) -> Any:
    before = torch.get_default_dtype()
    torch.set_default_dtype(default)
    try:
        return call()
    finally:
        torch.set_default_dtype(before)


def compare(call: Callable[[], Any], usual: Any = None) -> None:
    """The same dtypes, and the same numbers but for rounding: where tensors lie in memory may change the last digits.

    What comes under PyTorch's own default may be known.
    """
    usual = under(torch.float32, call) if usual is None else usual
    usual, other = list(tensors(usual)), list(tensors(under(torch.float64, call)))
    for (name, wanted), (_, found) in zip(usual, other, strict=True):
        assert found.dtype == wanted.dtype, name
        if wanted.is_floating_point():
            size = wanted.nan_to_num(0, 0, 0).abs().amax() if wanted.numel() else 0
            close = {"rtol": 0.0, "atol": float(torch.finfo(wanted.dtype).eps ** 0.6 * size)}
        else:
            close = {"rtol": 0.0, "atol": 0.0}
        torch.testing.assert_close(found, wanted, equal_nan=True, msg=lambda text, name=name: f"{name}: {text}", **close)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("name", CALLS)
@pytest.mark.usefixtures("unchecked")
def test_functions(name: str, dtype: torch.dtype) -> None:
    how = FUNCTIONS.get(name, Function())
    if dtype == torch.float32 and (not how.half or how.slow):
        pytest.skip("wants double precision, or too much time")
    arguments, found = agreeable(name)
    numbers = [t for _, t in tensors(arguments) if t.is_floating_point()]
    if not numbers:
        pytest.skip("takes no numbers")
    given = tensor_map(lambda t: t.to(dtype) if t.is_floating_point() else t, arguments)
    compare(lambda: apply(CALLS[name], given), found if all(t.dtype == dtype for t in numbers) else None)
