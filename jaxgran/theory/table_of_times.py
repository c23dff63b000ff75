"""T(t) of a homogeneous gas by quadrature, where the cooling rate is a function of T alone.

A table of ln T over time, much cheaper than the differential equations of
`jaxgran.models.KineticTheory`: it serves to compare many laws of cooling. Its a_2 has always the
value that it relaxes to, where the equations follow it from 0.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran.scene.gas import Gas
from jaxgran.scene.reduced_scene import reduced_scene
from jaxgran.theory import averages, elements
from jaxgran.theory.steady import scene_at_start

NUM_NODES = 192
"""Temperatures of the table of times."""

NUM_RATES = 20
"""Temperatures at which the cooling rate is computed; its logarithm is a polynomial of ln T."""

RELAXATION_STEPS = 3
"""Newton steps for the value to which a_2 relaxes."""


def _interpolation(num_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Chebyshev nodes in [0, 1], and the matrix from values there to those at even spacing."""
    nodes = 0.5 - 0.5 * np.cos((np.arange(NUM_RATES) + 0.5) * np.pi / NUM_RATES)
    series = np.polynomial.chebyshev.chebvander
    even = np.linspace(-1.0, 1.0, num_nodes)
    return nodes, series(even, NUM_RATES - 1) @ np.linalg.inv(series(2 * nodes - 1, NUM_RATES - 1))


_RATE_NODES, _TO_NODES = _interpolation(NUM_NODES)


def relaxed_cooling_rate(
    gas: Gas, depth: Float[Array, ""]
) -> tuple[Float[Array, "nodes"], Float[Array, "nodes"]]:
    """``-d ln T/dt``, 1/s, of a gas of hard spheres whose a_2 has relaxed.

    Args:
        gas: the scene.
        depth: the range of ln(T/T_0) is from 0 to minus this.

    Returns:
        ln(T/T_0) at `NUM_NODES` evenly spaced nodes, and the rate there.
    """
    d, law = gas.dimension, gas.reduced_law

    def rate(log_theta):
        speed = jnp.exp(log_theta / 2)
        coefficients = averages.averages(law, speed, d)

        def drift(a2):
            rates = averages.Rates.of(coefficients, a2)
            return 4 / d * rates.cooling * (1 + a2) - 4 / (d * (d + 2)) * rates.fourth_moment

        a2 = jnp.zeros_like(speed)
        for _ in range(RELAXATION_STEPS):
            value, slope = jax.jvp(drift, (a2,), (jnp.ones_like(a2),))
            a2 = a2 - value / slope
        cooling = 2 / d * averages.Rates.of(coefficients, a2).cooling * speed
        return cooling

    # Cast in NumPy: the constants of a program have the precision of the rest.
    rate_nodes, to_nodes = (jnp.asarray(x.astype(depth.dtype)) for x in (_RATE_NODES, _TO_NODES))
    at_nodes = jax.vmap(rate)(-depth * rate_nodes)
    even = jnp.exp(to_nodes @ jnp.log(at_nodes))
    return -depth * jnp.linspace(0.0, 1.0, NUM_NODES), even * gas.impact_speed / gas.path_length


def cooling_by_elements(
    gas: Gas, log_theta: Float[Array, "nodes"], ratio: Float[Array, "nodes"]
) -> Float[Array, "nodes"]:
    """What roughness, walls and drag add to ``-d ln T/dt``, 1/s.

    Args:
        gas: the scene.
        log_theta: ln(T/T_0).
        ratio: T_rot/T there; without meaning for smooth spheres.
    """
    scene = scene_at_start(gas)
    nothing = jnp.zeros((), log_theta.dtype)

    def cooling(log_theta, ratio):
        speed = jnp.exp(log_theta / 2)
        return elements.changes(scene, speed, ratio, nothing, gas.dimension).cooling

    return jax.vmap(cooling)(log_theta, ratio) * gas.impact_speed / gas.path_length


def cooling_by_roughness(
    gas: Gas, log_theta: Float[Array, "nodes"], rate: Float[Array, "nodes"]
) -> Float[Array, "nodes"]:
    """What roughness adds to ``-d ln T/dt``, 1/s, of a gas whose rotation follows from its course.

    ``d(T_rot/T)/ds = (dT_rot/dt)/(T L) + T_rot/T`` over ``s = -ln(T/T_0)``, from the T_rot of the
    gas, with the whole cooling rate L; by steps from node to node, implicit in T_rot/T.

    Args:
        gas: of rough spheres.
        log_theta: ln(T/T_0) at evenly spaced nodes, from 0 downwards.
        rate: ``-d ln T/dt`` by all else there, 1/s.
    """
    alone = reduced_scene(gas)._replace(walls=None, drag=None, drive=None)
    nothing, unit = jnp.zeros((), log_theta.dtype), gas.impact_speed / gas.path_length

    def parts(log_theta, ratio):
        at = elements.changes(alone, jnp.exp(log_theta / 2), ratio, nothing, gas.dimension)
        return jnp.stack([at.cooling, at.rotation]) * unit

    def along(ratio, node):
        own, (cooling, rotation), (cooling_of_1, rotation_of_1) = node
        loss = cooling + ratio * (cooling_of_1 - cooling)
        whole = own + loss
        decay = -(rotation_of_1 - rotation) / whole - 1
        later = (ratio + step * rotation / whole) / (1 + step * decay)
        return later, loss

    step = log_theta[0] - log_theta[1]
    # Both changes are linear in T_rot/T.
    ends = [jax.vmap(parts, (0, None))(log_theta, nothing + ratio) for ratio in (0.0, 1.0)]
    first = gas.value("rotational_temperature") / gas.temperature
    return jax.lax.scan(along, first, (rate, *ends))[1]


def log_temperature(
    log_theta: Float[Array, "nodes"], rate: Float[Array, "nodes"], times: Float[Array, "times"]
) -> Float[Array, "times"]:
    """ln(T/T_0) at some times of a gas that cools at a given rate.

    ``t = int dy / rate(y)`` over y = -ln(T/T_0), in which between two nodes the rate is taken for a
    power of T.

    Args:
        log_theta: ln(T/T_0) at the nodes, from 0 downwards.
        rate: ``-d ln T/dt`` at the nodes, > 0.
        times: t, >= 0. Beyond the last node ln T stays what it is there.
    """
    time = 1 / rate
    growth = jnp.log(time[1:] / time[:-1])
    small = jnp.abs(growth) < 1e-4
    mean = jnp.where(
        small, 0.5 * (time[1:] + time[:-1]), jnp.diff(time) / jnp.where(small, 1.0, growth)
    )
    passed = jnp.cumsum(-jnp.diff(log_theta) * mean)
    # In ln(1 + t/t_0) the curve bends little.
    nodes = jnp.concatenate([jnp.zeros(1), jnp.log1p(passed * rate[0])])
    return jnp.interp(jnp.log1p(times * rate[0]), nodes, log_theta)
