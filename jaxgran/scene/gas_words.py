"""A gas in short words."""

from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from jaxgran.checks.words import Rows, said

UNITS = {
    "diameter": "m",
    "mass": "kg",
    "temperature": "m^2/s^2",
    "youngs_modulus": "Pa",
    "dissipative_constant": "s",
    "rotational_temperature": "m^2/s^2",
    "wall_side": "m",
    "drag_rate": "1/s",
    "drag_rotational_rate": "1/s",
    "drive_strength": "m^2/s^3",
}
"""Units of the floats of a gas that have one."""


def gas_rows(gas: Any) -> Rows:
    """Every float with its unit, and, of a single gas of known numbers, the scales that follow."""
    rows = [(name, said(gas.value(name), UNITS.get(name, ""))) for name in gas.domains]
    leaves = jax.tree.leaves(gas)
    if any(isinstance(leaf, Tracer) or np.ndim(leaf) > 0 for leaf in leaves):
        return rows
    rows.append(("mean free time", said(gas.mean_free_time, "s")))
    if hasattr(gas.law, "dissipative_constant"):
        rows.append(("beta", said(gas.thermal_beta, "at v = sqrt(2 T_0)")))
        rows.append(("t_c/tau_c", said(gas.contact_fraction)))
    return rows


def gas_title(gas: Any) -> str:
    """The law, the dimension and the elements."""
    elements = "".join(f", with {name}" for name in gas.elements)
    return f"Gas of {type(gas.law).__name__} spheres, d = {gas.dimension}{elements}"
