"""The first line of a fit."""

import numpy as np
import pytest

from jaxgran.fitting.headline import describe_range, unit_after_number
from jaxgran.fitting.result import Fit


class FakeFit(Fit):
    """A fit of which the first estimate alone is known."""

    def __init__(self, name, estimate):
        object.__setattr__(self, "names", (name,))
        object.__setattr__(self, "estimate", np.array([estimate]))


@pytest.mark.parametrize("name, unit", [("restitution", ""), ("dense: temperature", " m^2/s^2")])
def test_a_blank_stands_between_a_number_and_its_unit(name, unit):
    assert unit_after_number(name) == unit


@pytest.mark.parametrize(
    "name, estimate, low, high, words",
    [
        ("dissipative_constant", 1e-6, 9e-7, 2e-6, "A is between 9e-07 and 2e-06 s"),
        ("dissipative_constant", 1e-6, 0.0, 2e-6, "A is below 2e-06 s"),
        ("dissipative_constant", 1e-6, 9e-7, 2e-3, "A is above 9e-07 s"),
        ("dissipative_constant", 1e-6, 0.0, np.inf, "A has no bounds"),
        # Numbers of both signs may be near 0.
        ("t0", 1e-9, -0.002, 0.002, "t0 is between -0.002 and 0.002 s"),
        ("tangential_restitution", 2e-4, -0.05, 0.3, "beta_t is between -0.05 and 0.3"),
        ("tangential_restitution", 0.0, 0.0, 0.2, "beta_t is below 0.2"),
    ],
)
def test_the_range_of_a_parameter_in_words(name, estimate, low, high, words):
    assert describe_range(FakeFit(name, estimate), low, high) == words
