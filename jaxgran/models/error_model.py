"""Shear modes of a freely cooling gas: the energy of the flow in a box longer than L_c.

The bias of projected derivatives in a gas with a flow, estimated from the energy of the flow.

The course of a cooling gas as kinetic theory predicts it, from which models estimate errors.
"""

from math import sqrt
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxgran.scene.gas import Gas

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


ENSKOG_ERROR = (0.005, 0.1)
"""Relative error of Enskog's cooling rate in a small box, ``a + b phi``.

Measured: the rate of hard spheres, N = 500, 8 replicas, 80 mean free times, beta_T0 = .15, is off
by 0 +- .6 %, .5 +- .6 %, 1.3 +- .8 % at phi = .02, .05, .1, that of LAMMPS by 1 % at .05; what
fluctuations leave over at phi = .2, .3, .4 is 1.2, 2.8, 2.4 %.
"""

CORRELATED_ERROR = {2: (0.003, 0.045), 3: (0.003, 0.02)}
"""The same of a rate with velocity correlations (`jaxgran.theory.equations`), by dimension.

As `experiments/accuracy/measure_correlations.py --full` finds: in 3D at most .4 % is left over at
phi = .05 and .1, .5 % at .2 and .9 % at .3, in 2D .5, .4, .8 and 1.7 %, each at eps = .8, of which
nothing was fitted.
"""

CONTACT_ERROR = 0.3
"""Relative error of the cooling rate over the contact fraction t_c/tau_c: three spheres in contact.

Measured: soft spheres, N = 400, 8 replicas, 5 to 40 mean free times, net of the flow: .1 to .3
+- .1 at phi = .05, t_c/tau_c = .1 and .2; at phi = .2 .25 to .45 +- .08 for t_c/tau_c = .17, .27 to
.38 +- .04 for .4.
"""

CROWDED_ERROR = 0.15
"""The same of a rate that is corrected for it to first order (`jaxgran.theory.equations.crowding`).

Measured: soft spheres, 40 replicas of 200 or 300, 15 mean free times, beta = .1: the clock is fast
by 2.0 +- .6 % at phi = .05, t_c/tau_c = .1, slow by .3 +- .5 % at .1, .05, fast by 1.3 +- .7 % at
.2, .15.
"""

SOFTNESS_SQUARED = 0.46
"""Relative error over (c X_T/sigma)^2 of a cooling rate corrected to the first power of it.

Measured: .3 % at c X_T/sigma = .11; 8 to 12 % at .57, falling as the gas cools.
"""

THIRD_SONINE_TRUNCATION = 0.1
"""Relative error of the cooling rate over a_2^2 of a theory that follows a_3, which errs in a_2 by
up to 3 % (constant restitution, eps from 0 to 1)."""

SONINE_TRUNCATION = 0.3
"""Relative error of the cooling rate over a_2^2, from truncating the Sonine expansion at a_2.

Measured: kinetic theory against DSMC, 200000 particles, constant restitution: T off by .6, .7, 1.8
+- .3 % after 80 mean free times at a_2 = .05, .12, .19, where |d ln T/d ln t| = 1.7.
"""

WALL_ERROR = 0.04
"""Relative error of a cooling rate that takes a gas between walls for mixed, but for the layer
before them (`jaxgran.scene.elements`).

Measured: hard spheres in a cube of 25 diameters, eps_w = .8, beta = .15, N = 100, 500, 4000 (mean
free paths of 1.3, .25 and .02 sides): ln T is .023, .013 and .013 higher than that of DSMC when T
has fallen to .5, and .07, .01 and .04 higher when it has fallen to .006, .04, .1. The loss of
elastic spheres to walls of eps_w = .9, .8, .6 is within 3.5 % (mean free paths of .09 to 1.2
sides), to .3 6 % higher. With elastic walls N = 500 agree within 2 +- 1 %. Rough spheres between
rough walls (N = 300, eps_w = .85, beta_t = 0): T is 8 % higher than that of theory when it has
fallen to .06, T_rot/T 13 % lower (3 % lower than that of DSMC).
"""

ROUGHNESS_ERROR = 0.01
"""Relative error of kinetic theory's cooling rate of rough spheres, whose spins and velocities are
correlated. Measured: T within .8 % of DSMC after 60 mean free times, beta_t = -.8 to .5."""

FLOW_NOISE = 0.8
"""Scatter of ln T over sqrt(min(1, |ln T/T_0|) / N): shot noise of the first collisions.

Measured: hard spheres, N = 1000 (48 replicas) and 4000 (16), phi = .1 and .2, beta = .3 to .5, up
to 5 mean free times: .6 to 1.1, .82 in the mean.
"""


class ErrorModel(NamedTuple):
    """The course of a cooling gas from t = 0 on, with the quantities that limit the models.

    Attributes:
        gas: the scene.
        num_particles: N of the gas, or None if it is unknown; then the box is, too.
        time: t, s, shape (times,), increasing from 0; so are all that follow, at these times.
        log_temperature: ln(T/T_0).
        collisions: per particle.
        sonine: a_2.
        contact_fraction: contact duration over mean free time.
        overlap: mean largest overlap, in diameters.
        softness: c X_T/sigma, by which soft contacts slow the cooling.
        flow_share: mean share of the kinetic energy in the flow, 0 where the box is unknown.
        flow_scatter: its standard deviation between realisations.

    >>> from jaxgran.models.choose import course_of
    >>> course = course_of(gas, end=3.0)
    >>> 0.005 < course.error_of_temperature(0.01) < 0.02
    True
    """

    gas: Gas
    num_particles: int | None
    time: Float[np.ndarray, "times"]
    log_temperature: Float[np.ndarray, "times"]
    collisions: Float[np.ndarray, "times"]
    sonine: Float[np.ndarray, "times"]
    contact_fraction: Float[np.ndarray, "times"]
    overlap: Float[np.ndarray, "times"]
    softness: Float[np.ndarray, "times"]
    flow_share: Float[np.ndarray, "times"]
    flow_scatter: Float[np.ndarray, "times"]

    def error_of_temperature(self, rate_error: Float[np.ndarray, "times"] | float) -> float:
        """Relative error of T, at the worst time, of a model whose cooling rate errs.

        ``|d ln T/dt| int_0^t e dt'`` for a cooling rate wrong by the share e(t): the model's clock
        is off by the integral. Of a driven gas y = |d ln T| obeys
        ``dy/dt = e zeta - (zeta/2 + xi_0^2/T) y`` with the cooling rate zeta by all losses.
        """
        t = self.time
        if t[-1] == 0:
            return 0.0
        if self.gas.drive is not None:
            return self._error_where_driven(np.broadcast_to(rate_error, t.shape))
        delay = self._integral(np.broadcast_to(rate_error, t.shape))
        return float(np.max(np.abs(np.gradient(self.log_temperature, t)) * delay))

    def _error_where_driven(self, e: Float[np.ndarray, "times"]) -> float:
        t, y, worst = self.time, 0.0, 0.0
        temperature = float(self.gas.temperature) * np.exp(self.log_temperature)
        heating = float(self.gas.value("drive_strength")) / temperature
        loss = np.maximum(heating - np.gradient(self.log_temperature, t), 0.0)
        for step, rate, gain in zip(np.diff(t), loss / 2 + heating, e * loss, strict=False):
            decay = np.exp(-rate * step)
            y = y * decay + gain * (-np.expm1(-rate * step) / rate if rate > 0 else step)
            worst = max(worst, float(y))
        return worst

    def clock_error(
        self, rate_error: Float[np.ndarray, "times"] | float
    ) -> Float[np.ndarray, "times"]:
        """Relative error of the clock, ``int_0^t e dt' / t``, of a cooling rate wrong by e(t)."""
        e = np.broadcast_to(rate_error, self.time.shape)
        return np.where(self.time > 0, self._integral(e) / np.where(self.time > 0, self.time, 1), e)

    def chance_of_clock(self, num_particles: int) -> Float[np.ndarray, "times"]:
        """Variance of the clock, s^2, by the chance of single collisions of N particles.

        Collisions are a Poisson process of rate N nu/2. The energy lost in each goes as the square
        of the normal speed, which is distributed exponentially: its mean square is twice the square
        of its mean. Time, told by the loss, is then uncertain by ``int 4 dt / (N nu)``. (It is 4.4
        where ``1 - eps^2`` grows as v^(1/5).)
        """
        frequency = float(self.gas.collision_frequency) * np.exp(self.log_temperature / 2)
        return self._integral(4 / (num_particles * frequency))

    def slope_error(self) -> Float[np.ndarray, "times"]:
        """Relative error of projected derivatives through particles in a box that has a flow: the
        memory of T alone loses how the flow depends on the material. 0 in boxes below L_c.
        """
        if self.num_particles is None:
            return np.zeros(self.time.shape)
        if float(self.gas.box_side(self.num_particles)) <= float(self.gas.critical_box):
            return np.zeros(self.time.shape)
        return slope_bias(self.clock_error(PREDICTED * MISSING_HEAT * self.flow_share))

    def noise_of_differences(self, step: float, noise: float) -> Float[np.ndarray, "times"]:
        """Relative standard error of a derivative of ln T by differences of runs.

        ``s / (sqrt(2) h |d ln T/d ln A|)`` for a step h and a standard error s of ln T, with the
        derivative of a gas that depends on the product of A and t, ``d ln T/d ln t``.
        """
        slope = np.abs(self.time * np.gradient(self.log_temperature, self.time))
        error = noise / (np.sqrt(2) * step)
        return error / np.maximum(slope, error)  # nothing is known where it exceeds the slope

    @property
    def mixing(self) -> float:
        """Error of the cooling rate of models in which the gas between walls is mixed."""
        return 0.0 if self.gas.container is None else WALL_ERROR

    def _integral(self, values: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times"]:
        steps = (values[1:] + values[:-1]) / 2 * np.diff(self.time)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def homogeneous(self) -> Float[np.ndarray, "times"]:
        """Error of Enskog's cooling rate where the gas has a flow (an energy that is no heat)."""
        return self._of_density(ENSKOG_ERROR)

    @property
    def correlated(self) -> Float[np.ndarray, "times"]:
        """The same of a rate with velocity correlations."""
        return self._of_density(CORRELATED_ERROR[self.gas.dimension])

    def _of_density(self, error: tuple[float, float]) -> Float[np.ndarray, "times"]:
        own = error[0] + error[1] * float(self.gas.packing_fraction)
        return own + MISSING_HEAT * self.flow_share

    @property
    def lasting_contacts(self) -> Float[np.ndarray, "times"]:
        """Error of the cooling rate of a model of binary impacts."""
        return CONTACT_ERROR * self.contact_fraction

    @property
    def crowded_contacts(self) -> Float[np.ndarray, "times"]:
        """The same of a model that corrects for them to first order."""
        return CROWDED_ERROR * self.contact_fraction

    @property
    def second_order_softness(self) -> Float[np.ndarray, "times"]:
        """Error of the cooling rate left by the first-order softness correction."""
        return SOFTNESS_SQUARED * self.softness**2

    def truncation(self, order: int) -> Float[np.ndarray, "times"]:
        """Error of the cooling rate by the Sonine terms beyond a_2 or a_3."""
        return {2: SONINE_TRUNCATION, 3: THIRD_SONINE_TRUNCATION}[order] * self.sonine**2

    def shot_noise(self, num_particles: int) -> float:
        """Standard error of ln T of so many particles in a homogeneous gas."""
        cooled = min(1.0, max(0.0, -self.log_temperature.min()))
        return FLOW_NOISE * sqrt(cooled / num_particles)

    def flow_noise(self, replicas: int) -> float:
        """Standard error of ln T by the few waves of a flow that grows, over so many replicas."""
        return self.error_of_temperature(MISSING_HEAT * self.flow_scatter) / sqrt(replicas)


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
