"""Words of fits."""

from jaxgran.fitting.messages import Message


def test_a_parameter_without_a_unit_has_no_blank_before_a_comma():
    values = {"symbol": "eps", "estimate": 0.9, "unit": "", "low": 0.85, "high": 0.95}
    assert str(Message("estimate and range", **values)) == "eps = 0.9, 95 % range 0.85 to 0.95"
