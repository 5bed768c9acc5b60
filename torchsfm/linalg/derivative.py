"""When to compute a derivative."""

import torch
from torch import Tensor
from torch.autograd import forward_ad


def followed(x: Tensor) -> bool:
    """Whether reverse- or forward-mode differentiation follows x right now."""
    if torch.is_grad_enabled() and x.requires_grad:
        return True
    return forward_ad.unpack_dual(x).tangent is not None  # type: ignore[no-untyped-call]
