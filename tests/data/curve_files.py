"""Curve files of a gas, their headers, and what is read from them."""

import warnings

import numpy as np

import jaxgran
from jaxgran import read_measurement
from jaxgran.data.header import gas_of_header

KEYS = {"N": 2000, "eta": 0.04, "diameter": 0.003, "density": 1200, "Y": 2e7, "nu": 0.3, "T0": 0.02}


def header_of(**keys):
    """A header; `keys` replace its values, and None leaves one out."""
    return {key: str(value) for key, value in (KEYS | keys).items() if value is not None}


def gas_of(**keys):
    return gas_of_header(header_of(**keys))[0]


GAS = gas_of()
TIMES = np.geomspace(0.02, 60.0, 40)
TRUE_A = 4e-6
CURVE = jaxgran.cool(GAS.replace(dissipative_constant=TRUE_A), TIMES)
T = np.asarray(CURVE.temperature) * (1 + 0.005 * np.sin(7.0 * np.arange(40)))
SPEED_XY = np.sqrt(np.pi / 2 * T)


def text_of(names="t,T,T_err", columns=(TIMES, T, 0.01 * T), *, row=None, **keys):
    """The text of a curve file; `keys` are of its header, and `row` replaces the fourth."""
    rows = [",".join(f"{x:.9g}" for x in values) for values in zip(*columns, strict=True)]
    if row is not None:
        rows[3] = row
    head = [f"# {key}: {value}" for key, value in header_of(**keys).items()]
    return "\n".join([*head, names, *rows]) + "\n"


PLAIN = text_of()
HEAD = PLAIN.partition("t,T")[0]
SEMICOLONS = PLAIN.replace(",", ";")
IN_MM = text_of("t,T,T_err", (1e3 * TIMES, 1e6 * T, 1e4 * T))

ROUGH = {"beta_t": "-0.2", "friction": "0.4", "T_rot_0": "2e-3", "container_side": "0.089"}
ROUGH |= {"wall_restitution": "0.9", "wall_beta_t": "0.1", "gamma": "0.3"}
ROUGH |= {"drive_strength": "2.5e-4"}
"""Keys of rough spheres between walls, with drag and a drive."""


def said(path, header=None):
    """Read a file; return the curve, the gas and all questions."""
    with warnings.catch_warnings(record=True) as questions:
        warnings.simplefilter("always")
        measurement = read_measurement(path, header)
    words = "\n".join(str(question.message) for question in questions)
    return measurement.curve, measurement.gas, words


def assert_plain(curve, gas, rtol=1e-7):
    np.testing.assert_allclose(curve.temperature, T, rtol=rtol)
    numbers = gas.diameter, gas.density, gas.packing_fraction, gas.youngs_modulus, gas.temperature
    np.testing.assert_allclose(numbers, (0.003, 1200, 0.04, 2e7, 0.02), rtol=1e-12)
