"""Observables of particles: functions that compile and have derivatives, for `cool(save=...)`.

Positions and velocities of one box are arrays of shape (N, d), in any consistent units; boxes are
periodic squares or cubes. Below, ``u`` is the mean velocity of the box.

>>> from jaxgran import observables
>>> position, velocity = jax.random.uniform(jax.random.key(0), (2, 1000, 3))
>>> k, S = jax.jit(observables.structure_factor)(position, 1.0)
>>> k.shape, S.shape
((4,), (4,))
"""

from jaxgran.particles.observables.cells import cell_density, cell_velocity, number_fluctuation
from jaxgran.particles.observables.distributions import pair_correlation, velocity_distribution
from jaxgran.particles.observables.moments import (
    mean_square_displacement,
    sonine,
    temperature,
    third_sonine,
    velocity_correlation,
)
from jaxgran.particles.observables.waves import flow_share, flow_spectrum, structure_factor

__all__ = [
    "cell_density",
    "cell_velocity",
    "flow_share",
    "flow_spectrum",
    "mean_square_displacement",
    "number_fluctuation",
    "pair_correlation",
    "sonine",
    "structure_factor",
    "temperature",
    "third_sonine",
    "velocity_correlation",
    "velocity_distribution",
]
