"""Multilinear tensors."""

from bench.cases.case import Case

CASES: tuple[Case, ...] = ()
