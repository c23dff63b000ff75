"""Shear modes of a freely cooling gas: the energy of the flow in a box longer than L_c."""

from math import sqrt

import numpy as np
from jaxtyping import Float, Int

from jaxgran.scene.gas import Gas

MAX_WAVENUMBER_SQUARED = 4.0
"""Largest (k/k_c)^2 of the modes that are counted; shorter waves belong to the error of Enskog's
theory."""

MAX_ENUMERATED_BOX = 6.0
"""Largest box, in L_c, whose waves are enumerated; larger boxes are scaled from it."""


def flow_share(
    gas: Gas,
    log_temperature: Float[np.ndarray, "times"],
    critical_box: Float[np.ndarray, "times"],
    num_particles: int,
) -> tuple[Float[np.ndarray, "times"], Float[np.ndarray, "times"]]:
    """Fraction of the kinetic energy in shear modes above equipartition, and its scatter.

    A shear mode of wavenumber k loses energy by viscosity only, while T falls by collisions. Its
    energy in units of T, e = 1 in equilibrium, obeys ``de/ds = (1 - q) e + q`` with
    ``s = ln(T_0/T)`` and ``q = (k/k_c)^2``: modes below k_c grow, those above k_c tend to
    1/(1 - 1/q). Each wave vector that fits the box has d - 1 shear modes, among the d N degrees of
    freedom of the gas. k and -k belong to the same wave, whose energy is distributed
    exponentially, so that its standard deviation equals its mean.

    Args:
        gas: the scene.
        log_temperature: ln(T/T_0) at some times from t = 0 on.
        critical_box: L_c, m, at the same times.
        num_particles: N.

    Returns:
        Mean and standard deviation between realisations, at each time; at most 1.

    Reference: van Noije, Ernst, Brito & Orza, Phys. Rev. Lett. 79, 411 (1997).
    """
    q_of_longest = (critical_box / float(gas.box_side(num_particles))) ** 2
    longest = sqrt(1 / q_of_longest.min())
    if longest * sqrt(MAX_WAVENUMBER_SQUARED) < 1:
        none = np.zeros_like(q_of_longest)
        return none, none
    # A larger box has more waves, but as many for each particle: they are counted in a smaller box.
    scale = max(1.0, longest / MAX_ENUMERATED_BOX)
    d = gas.dimension
    count = _count_waves(int(sqrt(MAX_WAVENUMBER_SQUARED) * longest / scale), d)
    num_waves = count * scale**d
    q = np.arange(1, count.size + 1) * scale**2 * q_of_longest[:, None]
    counted = q[0] < MAX_WAVENUMBER_SQUARED
    s = -log_temperature
    # Energy of one mode in units of T, above its value of 1 in equilibrium.
    energy, flow, variance = np.zeros(count.size), [0.0], [0.0]
    for ds, q_now in zip(np.diff(s), (q[1:] + q[:-1]) / 2, strict=True):
        growth = 1 - q_now
        growth = np.where(np.abs(growth) < 1e-6, 1e-6, growth)
        energy = energy * np.exp(growth * ds) + np.expm1(growth * ds) / growth
        flow.append((d - 1) * np.sum((num_waves * energy)[counted]))
        variance.append(2 * (d - 1) * np.sum((num_waves * energy**2)[counted]))
    degrees = d * num_particles
    return np.minimum(np.array(flow) / degrees, 1.0), np.minimum(np.sqrt(variance) / degrees, 1.0)


def _count_waves(most: int, dimension: int) -> Int[np.ndarray, "squares"]:
    """Number of wave vectors n, in units of 2 pi / box, with n^2 = 1, 2, ...

    The components of n go from -most to most.
    """
    axes = np.meshgrid(*[np.arange(-most, most + 1)] * dimension)
    squares = np.sum([n**2 for n in axes], axis=0)
    return np.bincount(squares.ravel())[1:]
