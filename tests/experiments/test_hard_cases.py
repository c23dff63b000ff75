"""The hard cases, one test each.

Their tolerances, with reasons, are given in experiments/support/hard_cases/.
"""

import jax
import pytest

from experiments.accuracy.hard_cases import CASES
from experiments.support.hard_cases.rows import Row

LONG = (
    "A = 0",
    "SI values",
    "sqrt(xi)",
    "head-on",
    "beta from",
    "own image",
    "three and four",
    "inelastic",
    "impact speeds",
    "touching",
    "constant eps",
    "phi from",
    "T/T_0",
    "times:",
    "N = 2",
    "near-simultaneous",
    "step 5",
    "stiff and",
    "fits:",
    "one member",
    "faults on the way",
)
"""Beginnings of the names of further cases that take long."""


def marks(case):
    return [pytest.mark.slow] if case.heavy or case.name.startswith(LONG) else []


@pytest.mark.parametrize("case", [pytest.param(c, id=c.name, marks=marks(c)) for c in CASES])
def test_hard_case(case):
    with jax.numpy_rank_promotion("raise"):
        rows = case.run()
    failed = [str(row) for row in rows if not row.passed]
    assert rows and not failed, "\n".join(failed)


def test_a_row_without_numbers_fails():
    nan = float("nan")
    assert Row("model", "float64", 1e-3, 1e-2).passed
    assert not Row("model", "float64", 1e-1, 1e-2).passed
    assert not Row("model", "float64", nan, 1.0).passed
    assert not Row("model", "float64", 0.0, 1.0, nan, 1.0).passed
    assert not Row("model", "float64", 0.0, 1.0, 2.0, 1.0).passed
