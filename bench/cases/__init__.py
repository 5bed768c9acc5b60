"""Every solver of the library as a case of the solver bench: one line a solver, in the file of its room."""

from bench.cases import resection, tensors, two_view
from bench.cases.case import Case

CASES: tuple[Case, ...] = (*two_view.CASES, *resection.CASES, *tensors.CASES)
