"""Forms in the data, such as h2' F h1, of many models of the same data.

A form is a sum of monomials of a datum: products of two of its coordinates, or of one and 1. Their coefficients are sums of two
products of the numbers of a model. The monomials are made once for all models and the coefficients once for all data, by a few
operations however many there are, and one matrix product gives the forms.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

Term = tuple[int, int, int, int, float]
"""The form, the monomial, two of the numbers of a model (-2 stands for 1) and a factor."""
ONE = -2
"""The number 1 among the numbers of a model."""
_ZERO = -1


@dataclass(frozen=True)
class Forms:
    """Which coordinates make the monomials, and which numbers of a model make the coefficients.

    Attributes:
        coordinates: Number of coordinates of a datum, the last of them 1 if there is one.
        numbers: Number of numbers of a model.
        monomials: The two coordinates of each monomial.
        terms: Of what the coefficients are the sum: two at most for each.
    """

    coordinates: int
    numbers: int
    monomials: tuple[tuple[int, int], ...]
    terms: tuple[Term, ...]

    @property
    def count(self) -> int:
        """The number of forms."""
        return 1 + max(form for form, *_ in self.terms)

    def of(self, model: Float[Tensor, "*#batch s k"], h: Float[Tensor, "*#batch q n"]) -> Sequence[Float[Tensor, "*batch s n"]]:
        """The values of the forms.

        Args:
            model: The numbers of s models.
            h: The coordinates of n data.
        """
        left, right, numbers, factors = _tables(self, model.dtype, model.device)
        z = h.index_select(-2, left) * h.index_select(-2, right)
        rows = model.mT
        rows = torch.cat((rows, torch.ones_like(rows[..., :1, :]), torch.zeros_like(rows[..., :1, :])), -2)
        first, second = rows.index_select(-2, numbers).chunk(2, -2)
        one, other = (first * second * factors).chunk(2, -2)
        # (monomial, form and model): the forms come out one after the other.
        coefficients = (one + other).reshape(*rows.shape[:-2], len(self.monomials), self.count * rows.shape[-1])
        values: Tensor = coefficients.mT @ z
        return values.reshape(*values.shape[:-2], self.count, rows.shape[-1], values.shape[-1]).unbind(-3)


@lru_cache
def _tables(forms: Forms, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The coordinates of the monomials; the numbers, by factor, term, monomial and form; the factors of the terms."""
    left, right = torch.tensor(forms.monomials, device=device).unbind(-1)
    shape = (2, len(forms.monomials), forms.count)
    numbers = torch.full((2, *shape), forms.numbers + 2 + _ZERO)
    factors, used = torch.zeros(shape, dtype=dtype), torch.zeros(shape[1:], dtype=torch.long)
    for form, monomial, first, second, factor in forms.terms:
        slot = int(used[monomial, form])
        used[monomial, form] += 1
        for side, number in enumerate((first, second)):
            numbers[side, slot, monomial, form] = number if number >= 0 else forms.numbers + 2 + number
        factors[slot, monomial, form] = factor
    return left.contiguous(), right.contiguous(), numbers.flatten().to(device), factors.reshape(-1, 1).to(device)
