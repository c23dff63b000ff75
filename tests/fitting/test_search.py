"""The search for the maximum of a likelihood, and the region in which it stays."""

import numpy as np
import pytest

import jaxgran
from jaxgran.fitting.search import (
    MAX_DISTANCE,
    MULTIMODAL_STARTS,
    Minimum,
    minima_from_starts,
    minimise,
    newton_step,
)
from jaxgran.fitting.setup import Request, build_problem
from tests.fitting.curves import BOTH, A, cooled_beads, rough_beads


@pytest.mark.parametrize("beyond", [0.0, 3.0])
def test_a_search_stays_in_its_region_and_fits_the_other_unknowns_there(beyond):
    gas, curve = cooled_beads()
    measurement = jaxgran.Measurement(gas, curve, num_particles=1000)
    request = Request({"": measurement}, jaxgran.KineticTheory(), BOTH, (), {}, None, quick=True)
    problem, first, _ = build_problem(request)
    free = minimise(problem, first, 100)
    # The best A is a factor e below the region; the search begins at its edge, or outside.
    origin = free.flat.copy()
    origin[0] += MAX_DISTANCE[A] + 1.0
    begin = free.flat.copy()
    begin[0] += 1.0 - beyond
    end = minimise(problem, begin, 100, origin=origin)
    assert end.flat[0] == origin[0] - MAX_DISTANCE[A]
    assert free.value < end.value < np.inf and end.steps > 0
    found = problem.evaluate(end.flat)
    assert found.value == end.value
    # With A held there no step in the other unknowns is left.
    others = found._replace(gradient=found.gradient[1:], information=found.information[1:, 1:])
    assert newton_step(others).length < 0.03  # `CONVERGED_STEP`
    # A first guess that is outside of the region, and otherwise at the end, is moved to the edge.
    outside = end.flat.copy()
    outside[0] -= 3.0
    assert minimise(problem, outside, 100, origin=origin).flat[0] == end.flat[0]


def test_a_start_at_another_beta_t_from_which_a_search_diverges_is_left_out():
    curve = jaxgran.cool(rough_beads(-0.5), np.linspace(0.01, 1.0, 5))
    measurement = jaxgran.Measurement(rough_beads(-0.5), curve, num_particles=1000)
    names = (A, "tangential_restitution")
    request = Request({"": measurement}, jaxgran.KineticTheory(), names, (), {}, None, quick=True)
    problem, first, _ = build_problem(request)
    begun = []

    def search(problem, start, max_steps):
        begun.append(start)
        if len(begun) == 2:
            raise RuntimeError("diverges")
        return Minimum(start, 0.0, 1, True)

    minima = minima_from_starts(problem, first, 10, search)
    assert len(begun) == 1 + len(MULTIMODAL_STARTS) and len(minima) == len(begun) - 1
    np.testing.assert_array_equal(minima[0].flat, first)
