"""The search by gradient descent, and what it says where it ends."""

import optax
import pytest

import jaxgran
from jaxgran.fitting.descent import Descent
from jaxgran.fitting.search import minimise
from jaxgran.fitting.setup import Request, build_problem
from tests.fitting.curves import BOTH, cooled_beads


@pytest.mark.parametrize("distance", [0.1, 10.0])
@pytest.mark.parametrize("solver", [optax.sgd(1e-12), optax.adam(1e-8)], ids=["sgd", "adam"])
def test_a_descent_that_hardly_moves_has_converged_near_the_minimum_alone(solver, distance):
    gas, curve = cooled_beads()
    measurement = jaxgran.Measurement(gas, curve, num_particles=1000)
    request = Request({"": measurement}, jaxgran.KineticTheory(), BOTH, (), {}, None, quick=True)
    problem, first, _ = build_problem(request)
    begin = minimise(problem, first, 100, tolerance=1e-3).flat.copy()
    begin[0] += distance / problem.evaluate(begin).information[0, 0] ** 0.5
    end = Descent(solver, progress=False, throw=True)(problem, begin, 100)
    assert end.steps == 51 and "no longer falls" in end.trace.reason
    assert end.converged == (distance < 0.3)  # `STALLED_STEP`, in standard errors
    assert ("Change the learning rate" in end.trace.reason) == (not end.converged)
