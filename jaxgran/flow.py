"""The flow that grows in a gas which cools in a box longer than L_c, before it clusters."""

from math import sqrt

import numpy as np

from jaxgran.gas import Gas

FLOW_CUT = 4.0
"""(k/k_c)^2 of the shortest waves of the flow that are counted; shorter ones are Enskog's error."""

LARGEST = 6.0
"""Box over L_c up to which waves are counted one by one; larger boxes scale."""

SHEAR_VISCOSITY = {2: (2.0, 1.0, 0.8729), 3: (4.0, 0.8, 0.7614)}
"""b, a_1, a_2 of Enskog's ``eta g_2 / eta_0 = 1 + a_1 y + a_2 y^2``, ``y = b phi g_2``.

Reference: Gass 1971 (2D); Chapman & Cowling, Eq. 16.41.7 (3D).
"""


def flow_share(
    gas: Gas, log_temperature: np.ndarray, critical_box: np.ndarray, num_particles: int
) -> tuple[np.ndarray, np.ndarray]:
    """Share of the kinetic energy in the flow, beyond that of equilibrium, and its scatter.

    A shear mode of wavenumber k loses no energy to collisions but to viscosity, while T falls: its
    energy over T, 1 in equilibrium, obeys ``de/ds = (1 - q) e + q``, ``s = ln(T_0/T)``,
    ``q = (k/k_c)^2``: modes below k_c grow, those above settle at 1/(1 - 1/q) or less. There are
    d - 1 of them to each wave that fits the box, among the d N of the gas. The waves of k and -k
    are one, whose energy is distributed exponentially: it scatters by as much as it is.

    Args:
        gas: the scene.
        log_temperature, critical_box: ln T/T_0 and L_c, m, at each of some times from 0 on.
        num_particles: N.

    Returns:
        Mean and standard deviation, at each time.

    Reference: van Noije, Ernst, Brito & Orza, PRL 79, 411 (1997).
    """
    d, phi, g_2 = gas.dimension, float(gas.packing_fraction), float(gas.contact_value)
    b, first, second = SHEAR_VISCOSITY[d]
    y = b * phi * g_2
    # The dilute k_c^2 goes as the frequency of collisions over the viscosity.
    dense = g_2**2 / (1 + first * y + second * y**2)
    q_of_longest = (critical_box / float(gas.box_side(num_particles))) ** 2 / dense
    longest = sqrt(1 / q_of_longest.min())
    if longest * sqrt(FLOW_CUT) < 1:
        none = np.zeros_like(q_of_longest)
        return none, none
    # In a large box there are more waves, but as many to a particle: a smaller one has them all.
    smaller = max(1.0, longest / LARGEST)
    most = int(sqrt(FLOW_CUT) * longest / smaller)
    axes = np.meshgrid(*[np.arange(-most, most + 1)] * d)
    count = np.bincount(sum(n**2 for n in axes).ravel())[1:]  # pyright: ignore
    num_waves = count * smaller**d
    q = np.arange(1, count.size + 1) * smaller**2 * q_of_longest[:, None]
    counted = q[0] < FLOW_CUT
    s = -log_temperature
    energy, flow, variance = np.zeros(count.size), [0.0], [0.0]
    for ds, q_now in zip(np.diff(s), (q[1:] + q[:-1]) / 2, strict=True):
        growth = 1 - q_now
        growth = np.where(np.abs(growth) < 1e-6, 1e-6, growth)
        energy = energy * np.exp(growth * ds) + np.expm1(growth * ds) / growth
        flow.append((d - 1) * np.sum((num_waves * energy)[counted]))
        variance.append(2 * (d - 1) * np.sum((num_waves * energy**2)[counted]))
    degrees = d * num_particles
    return np.minimum(np.array(flow) / degrees, 1.0), np.minimum(np.sqrt(variance) / degrees, 1.0)
