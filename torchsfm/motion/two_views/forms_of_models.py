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

from torchsfm.motion.two_views.epipolar_fit import product

Term = tuple[int, int, int, int, float]
"""The form, the monomial, two of the numbers of a model and a factor."""
ONE = -1
"""The number 1 among the numbers of a model."""


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
        rows = torch.cat((rows, rows.new_ones(*rows.shape[:-2], 1, rows.shape[-1])), -2)
        first, second = rows.index_select(-2, numbers).chunk(2, -2)
        one, other = (first * second * factors).chunk(2, -2)
        # (monomial, form and model): the forms come out one after the other.
        coefficients = (one + other).reshape(*rows.shape[:-2], len(self.monomials), self.count * rows.shape[-1])
        values = product(coefficients.mT, z)
        return values.reshape(*values.shape[:-2], self.count, rows.shape[-1], values.shape[-1]).unbind(-3)


def coordinates_of_pairs(x1: Float[Tensor, "*batch 1 n 2"], x2: Float[Tensor, "*batch 1 n 2"]) -> Float[Tensor, "*batch 5 n"]:
    """The coordinates x1, y1, x2, y2, 1 of pairs of points, once for all models."""
    return torch.nn.functional.pad(torch.cat((x1.mT, x2.mT), -2), (0, 0, 0, 1), value=1.0)[..., 0, :, :]


@lru_cache
def _tables(forms: Forms, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The coordinates of the monomials; the numbers, by side, term, monomial and form; the factors of the terms."""
    size = len(forms.monomials) * forms.count
    slots = [[ONE] * size for _ in range(4)]
    factors = [[0.0] * size for _ in range(2)]
    for form, monomial, first, second, factor in forms.terms:
        place = monomial * forms.count + form
        slot = int(factors[0][place] != 0)
        slots[slot][place], slots[2 + slot][place] = first, second
        factors[slot][place] = factor
    numbers = [number % (forms.numbers + 1) for row in slots for number in row]
    columns = [list(column) for column in zip(*forms.monomials, strict=True)]
    # Whoever asks first may be in inference mode; others may not.
    with torch.inference_mode(False):
        left, right, chosen = (torch.tensor(row, device=device) for row in (*columns, numbers))
        return left, right, chosen, torch.tensor(factors, dtype=dtype, device=device).reshape(-1, 1)
