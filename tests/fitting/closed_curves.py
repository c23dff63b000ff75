"""Cooling curves by closed forms that fits do not use, of gases that contain more than they know.

Rates of T are integrated here: rough spheres as two temperatures with constant tangential
restitution (Huthmann & Zippelius, PRE 56, R6275 (1997)), walls as the loss of a Maxwellian gas that
stays mixed, collisions as Enskog's.
"""

import jax.numpy as jnp
import numpy as np

import jaxgran
from jaxgran.fitting.alternatives import relaxed_cooling_rate

TRUE_A = 3e-6
STEPS = 4000
BOX = 0.05  # m


def beads(A: float = TRUE_A) -> jaxgran.Gas:
    return jaxgran.Gas(
        jaxgran.Viscoelastic(5e7, 0.22, A),
        diameter=2e-3,
        mass=jaxgran.sphere_mass(2e-3, 2500.0),
        packing_fraction=0.05,
        temperature=0.01,
    )


def normal_rate(gas):
    """-d ln T/dt by collisions of smooth spheres, a function of T."""
    log_theta, rate = (np.asarray(x) for x in relaxed_cooling_rate(gas, jnp.asarray(20.0)))
    return lambda T: np.interp(np.log(T / float(gas.temperature)), log_theta[::-1], rate[::-1])


def frequency(gas, T: float) -> float:
    """Collisions per sphere and second."""
    return np.sqrt(T / float(gas.temperature)) / float(gas.mean_free_time)


def cooled(rates, T_0: float, last_share: float, other: float = 0.0):
    """Times and T until T has fallen to a share, for ``rates(T, R) = (dT/dt, dR/dt)``."""
    state, t, times, values = np.array([T_0, other]), 0.0, [0.0], [T_0]
    for _ in range(100 * STEPS):
        speed = np.array(rates(*state))
        dt = 0.002 * state[0] / max(abs(speed[0]), 1e-300)
        middle = np.array(rates(*(state + 0.5 * dt * speed)))
        state, t = state + dt * middle, t + dt
        times.append(t)
        values.append(state[0])
        if state[0] < last_share * T_0:
            break
    return np.array(times), np.array(values)


def rough(beta: float):
    """Two temperatures of rough spheres with a moment of inertia of 2/5 m (sigma/2)^2."""
    q = 0.4
    eta = q * (1 + beta) / (2 * q + 2)
    a, b, c = eta * (1 - eta), eta**2 / q, eta / q * (1 - eta / q)

    def rates_of(gas):
        normal = normal_rate(gas)

        def rates(T, R):
            tangential = 4 / 3 * frequency(gas, T)
            return (
                -normal(T) * T - tangential * (a * T - b * R),
                tangential * (b * T - c * R),
            )

        return rates

    return rates_of


def beside(extra):
    """Collisions of smooth spheres, and another rate of loss."""

    def rates_of(gas):
        normal = normal_rate(gas)
        return lambda T, R: (-(normal(T) + extra(gas, T)) * T, 0.0)

    return rates_of


def walls(eps: float):
    """Flux ``Z n sqrt(T / 2 pi)`` onto six faces, each impact losing ``(1 - eps^2) m T``.

    Centres are in a cube shorter by a diameter, with the pressure Z n m T at the walls.
    """

    def loss(gas, T):
        phi = float(gas.packing_fraction)
        pressure = (1 + phi + phi**2 - phi**3) / (1 - phi) ** 3
        faces = 6 / (BOX - float(gas.diameter))
        return pressure * faces * np.sqrt(T / (2 * np.pi)) * (1 - eps**2) * 2 / 3

    return beside(loss)


def drag(share: float):
    """Linear drag, a share of the first rate of collisional cooling."""
    return beside(lambda gas, T: share * normal_rate(gas)(float(gas.temperature)))


def constant(eps: float):
    """Constant restitution instead of A, by Haff's law."""

    def rates_of(gas):
        return lambda T, R: (-(1 - eps**2) / 3 * frequency(gas, T) * T, 0.0)

    return rates_of


def nothing(gas):
    return beside(lambda gas, T: 0.0)(gas)
