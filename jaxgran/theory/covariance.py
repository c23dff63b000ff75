"""Stub."""

import jax.numpy as jnp

from jaxgran.scene.gas import mean_loss

NUM_RUN_VARIABLES = 3


def fluctuations(gas, temperature, sonine, collisions, rotation):
    now = gas.replace(temperature=temperature)
    nu = now.collision_frequency
    zeta = nu * mean_loss(now.reduced_law, temperature) / now.dimension
    J = jnp.zeros((3, 3)).at[0, 0].set(-0.6 * zeta).at[1, 1].set(-0.1 * nu).at[2, 2].set(-nu)
    Q = jnp.zeros((3, 3)).at[0, 0].set(2 * 2.21 * zeta**2 / nu).at[1, 1].set(1e-12 * nu)
    return J, Q
