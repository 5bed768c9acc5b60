"""Batched, differentiable multiple-view geometry on PyTorch tensors."""

from torchsfm._types import Solutions, Status

__all__ = ["Solutions", "Status"]
__version__ = "0.1.0"
