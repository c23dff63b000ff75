"""The first line of a fit."""

from types import SimpleNamespace

import numpy as np

from jaxgran.fitting.headline import headline


def test_a_parameter_without_a_unit_has_no_blank_before_a_comma():
    fit = SimpleNamespace(
        names=("restitution",),
        value=lambda name: (0.9, 0.02),
        ranges={"restitution": (np.array([0.85]), np.array([0.95]))},
        alternatives=(),
    )
    assert headline(fit) == "eps = 0.9, 95 % range 0.85 to 0.95"
