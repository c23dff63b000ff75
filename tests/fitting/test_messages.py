"""Words of fits."""

from pathlib import Path

import jaxgran
from jaxgran.fitting.messages import MESSAGES, Message
from tests.calls import literal_arguments


def test_each_sentence_that_is_said_is_in_the_table():
    said = literal_arguments(Path(jaxgran.__file__).parent.glob("fitting/*.py"))["Message"]
    assert len(said) > 40
    assert said <= MESSAGES.keys()


def test_a_parameter_without_a_unit_has_no_blank_before_a_comma():
    values = {"symbol": "eps", "estimate": 0.9, "unit": "", "low": 0.85, "high": 0.95}
    assert str(Message("estimate and range", **values)) == "eps = 0.9, 95 % range 0.85 to 0.95"
