"""The bias of projected derivatives in a gas with a flow, estimated from the energy of the flow."""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

A = TypeVar("A", Array, np.ndarray)

MISSING_HEAT = 1.6
"""Relative error of the cooling rate over the share of energy that is flow instead of heat: the
rate of viscoelastic spheres goes as T^(8/5)."""

FLOW_OF_SLOPE = 3.0, 0.14
"""a, b of the relative error of a projected derivative of ln T in A, ``a c (1 + (c/b)^2)``, over
the relative error c of the clock of a model that takes the flow that a run has for heat.

Measured by differences of runs after 3, 10, 30, 100 collisions: soft spheres, phi = .3,
beta = .2, N = 1000 (1.4 L_c), 3, 7, 16, 78 +- 1, 1, 1, 3 % too large (this: 3, 6, 19, 80 %); hard
spheres, phi = .2, beta = .3, N = 500 (1.1 L_c), 7, 17, 18, 21 +- 2, 3, 3, 3 % (3, 9, 28, 21 %);
hard disks, phi = .25, beta = .3, N = 300 (2 L_c), 9, 21, 77 +- 4, 6, 30 % (4, 16, 670 %), after
which ln T does not depend on A any more, and the projected derivative says -1.7. Fitted to these
runs; ``experiments/accuracy/derivatives_in_flows.py`` has measured the last two again since, with
smaller errors.
"""

PREDICTED = 0.65
"""Flow that a run has in its longest waves over that of all modes that theory predicts.

Measured: .4 to .85 in these gases, more the later.
"""


def slope_bias(clock: A) -> A:
    """Relative error of a projected derivative: see `FLOW_OF_SLOPE`.

    Args:
        clock: relative error of the clock of a model that takes the flow for heat.
    """
    factor, scale = FLOW_OF_SLOPE
    return factor * clock * (1 + (clock / scale) ** 2)


@jax.jit
def slope_bias_of_run(
    times: Float[Array, "times"], flow_share: Float[Array, "times"]
) -> Float[Array, "times"]:
    """The same from the share of the energy in the flow that a run had at some times.

    ``c = 1.6 int_0^t share dt' / t``, by the trapezoidal rule, from no flow at t = 0. Where times
    are far apart c is too large, as a flow grows ever faster.
    """
    missing = MISSING_HEAT * flow_share
    before = jnp.concatenate([jnp.zeros(1, missing.dtype), missing[:-1]])
    steps = jnp.diff(times, prepend=jnp.zeros(1, times.dtype))
    # t = 0 itself has no clock yet.
    clock = jnp.cumsum((before + missing) / 2 * steps) / jnp.where(times > 0, times, 1.0)
    return slope_bias(jnp.where(times > 0, clock, 0.0))
