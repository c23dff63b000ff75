"""The first line of a fit."""

import pytest

from jaxgran.fitting.headline import unit_after_number


@pytest.mark.parametrize("name, unit", [("restitution", ""), ("dense: temperature", " m^2/s^2")])
def test_a_blank_stands_between_a_number_and_its_unit(name, unit):
    assert unit_after_number(name) == unit
