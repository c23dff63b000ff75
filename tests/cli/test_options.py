"""Options of the command."""

import pytest

import jaxgran
from jaxgran.cli.options import parse_settings


def test_settings_have_the_notation_of_headers(measured):
    """An error in per cent is a share of the value, which stands in the file."""
    given = parse_settings(["eta_err=5 %"])
    measurement = jaxgran.read_measurement(measured / "thin.csv", given)
    value, error = measurement.priors["packing_fraction"]
    assert float(error) == pytest.approx(0.05 * float(value))
