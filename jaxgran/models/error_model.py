"""Estimates of the errors of the models, with constants measured by experiments.

`ErrorModel` holds a cooling gas as kinetic theory predicts it, and the errors that follow from it.
`flow_share` is the energy of the flow that grows in a box longer than L_c, and `slope_bias` the
bias of projected derivatives by it.
"""

from math import sqrt
from typing import NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxgran.data.curve import CoolingCurve
from jaxgran.models.scales import scales_at
from jaxgran.scene.gas import Gas

A = TypeVar("A", Array, np.ndarray)

MISSING_HEAT = 1.6
"""Relative error of the cooling rate over the share of energy that is flow instead of heat: the
rate of viscoelastic spheres is proportional to T^(8/5)."""

ENSKOG_ERROR = (0.005, 0.1)
"""Relative error of Enskog's cooling rate in a small box, ``a + b phi``.

Measured: the rate of hard spheres, N = 500, 8 replicas, 80 mean free times, beta_T0 = .15, is off
by 0 +- .6 %, .5 +- .6 %, 1.3 +- .8 % at phi = .02, .05, .1; the rate of LAMMPS is off by 1 % at
phi = .05. The error that fluctuations do not explain at phi = .2, .3, .4 is 1.2, 2.8, 2.4 %.
"""

CORRELATED_ERROR = {2: (0.003, 0.045), 3: (0.003, 0.02)}
"""Relative error ``a + b phi`` of the rate with velocity correlations, by dimension.

Measured by `experiments/accuracy/measure_correlations.py --full`: in 3D the error is at most .4 %
at phi = .05 and .1, .5 % at .2 and .9 % at .3, in 2D .5, .4, .8 and 1.7 %, each at eps = .8, a
value to which nothing was fitted. `jaxgran.theory.density` has the rate.
"""

CONTACT_ERROR = 0.3
"""Relative error of the cooling rate over the contact fraction t_c/tau_c, by contacts of three.

Measured: soft spheres, N = 400, 8 replicas, 5 to 40 mean free times, without the effect of the
flow: .1 to .3 +- .1 at phi = .05, t_c/tau_c = .1 and .2; at phi = .2 .25 to .45 +- .08 for
t_c/tau_c = .17, .27 to .38 +- .04 for .4.
"""

CROWDED_ERROR = 0.15
"""`CONTACT_ERROR` of a rate with the first-order correction (`crowding_coefficient`).

Measured: soft spheres, 40 replicas of 200 or 300, 15 mean free times, beta = .1: the clock is fast
by 2.0 +- .6 % at phi = .05, t_c/tau_c = .1, slow by .3 +- .5 % at .1, .05, fast by 1.3 +- .7 % at
.2, .15.
"""

SOFTNESS_SQUARED = 0.46
"""Relative error over (c X_T/sigma)^2 of a cooling rate corrected to the first power of it.

Measured: .3 % at c X_T/sigma = .11; 8 to 12 % at .57, falling as the gas cools.
"""

THIRD_SONINE_TRUNCATION = 0.1
"""Relative error of the cooling rate over a_2^2 of a theory with a_3, whose a_2 has an error of up
to 3 % (constant restitution, eps from 0 to 1)."""

SONINE_TRUNCATION = 0.3
"""Relative error of the cooling rate over a_2^2, from truncating the Sonine expansion at a_2.

Measured: kinetic theory against DSMC, 200000 particles, constant restitution: T off by .6, .7, 1.8
+- .3 % after 80 mean free times at a_2 = .05, .12, .19, where |d ln T/d ln t| = 1.7.
"""

WALL_ERROR = 0.012
"""Relative error of a cooling rate that assumes a mixed gas between walls, over (T/T_0)^(1/2),
apart from the layer before them (`jaxgran.scene.walls`).

Measured, phi = .03: the time in which hard spheres cool to T/T_0 = .5, .2, .1, .03 is longer than
in theory by 1.0, .7, .5, .3 +- .1 % for N = 250 and eps_w = .9, by 1.2, 1.0, .8, .7 % for N = 60,
by .4, .5, .4, .4 % for N = 1000; by .2, .4, .3, .3 % for N = 250 and eps_w = .95, by .5, .6, .4,
.4 % for .8, by -.7, -.1, -.1, .2 % for .6; with elastic walls they agree within .2 %. In the first
sound times, until T has fallen to .7, it is longer by 8 % for eps_w = .6, by 1.3 % for .8.
"""

ELASTIC_WALL_ERROR = 0.004
LOSS_WALL_ERROR = 0.08
NARROW_BOX = 30.0
"""Error of a given box, by the same measurements: ``e (T/T_0)^(1/2) + NARROW_BOX (sigma/W)^4``,
``e = min(ELASTIC_WALL_ERROR + LOSS_WALL_ERROR (1 - eps_w), WALL_ERROR)``, with the width W that
centres have."""

ROUGH_WALL_ERROR = 0.05
"""The same for rough walls, beta_t from -.3 to .5.

Measured: the mean rate until T has fallen to .5, .2, .03 is lower by 4, 6, 7 % for N = 60, by 1 to
3, 4 to 5, 5 to 6 % for N = 250 and by 2, 2, 3 % for N = 2000; T_rot/T is up to 11 % lower.
"""

ROUGHNESS_ERROR = 0.008
"""Relative error of kinetic theory's cooling rate of rough spheres.

Measured: T within 1.2 % of DSMC up to 100 mean free times, beta_t = 0 to 1, with and without
sliding (mu = .05 to 1). The mean rate until T has fallen to .03, beta_t = -.3, is lower in hard
spheres by .2 +- .3 %, with sliding (mu = .2) by .4 to .7 +- .4 %."""

SLIDING_ERROR = 0.01
"""The same of spheres that slide, if their spins are Gaussian: T within 2 % of DSMC."""

SIZE_ERROR = 0.15
"""Relative error of kinetic theory's cooling rate over the squared relative spread of sizes.

Measured by `experiments/accuracy/size_statistics.py`: 400 runs of hard spheres with diameters
within 10 %, of 1 : 1.2 and of 1 : 1.4 cool faster by .2, .1 and between .3 and .6 +- .15 %."""

FLOW_NOISE = 0.8
"""Standard deviation of ln T over sqrt(min(1, |ln T/T_0|) / N): shot noise of first collisions.

Measured: hard spheres, N = 1000 (48 replicas) and 4000 (16), phi = .1 and .2, beta = .3 to .5, up
to 5 mean free times: .6 to 1.1, .82 in the mean.
"""

SLOPE_BIAS_COEFFICIENTS = 3.0, 0.14
"""a, b of the relative error of a projected derivative of ln T in A, ``a c (1 + (c/b)^2)``.

c is the relative error of the clock of a model that counts the flow of a run as heat.

Measured by differences of runs after 3, 10, 30, 100 collisions: soft spheres, phi = .3,
beta = .2, N = 1000 (1.4 L_c), 3, 7, 16, 78 +- 1, 1, 1, 3 % too large (this: 3, 6, 19, 80 %); hard
spheres, phi = .2, beta = .3, N = 500 (1.1 L_c), 7, 17, 18, 21 +- 2, 3, 3, 3 % (3, 9, 28, 21 %);
hard disks, phi = .25, beta = .3, N = 300 (2 L_c), 9, 21, 77 +- 4, 6, 30 % (4, 16, 670 %), after
which ln T no longer depends on A, and the projected derivative is -1.7. a and b are fitted to these
runs; ``experiments/accuracy/gradient_health.py`` measures the last two again, with smaller
errors.
"""

MEASURED_FLOW = 0.65
"""Ratio of the flow in the longest waves of a run to the predicted flow in all modes.

Measured: .4 to .85 in the gases of `SLOPE_BIAS_COEFFICIENTS`, increasing with time.
"""

MAX_WAVENUMBER_SQUARED = 4.0
"""Largest (k/k_c)^2 of the modes in `flow_share`; `ENSKOG_ERROR` contains shorter waves."""

MAX_ENUMERATED_BOX = 6.0
"""Largest box, in L_c, with enumerated waves; larger boxes are scaled from it."""


class ErrorModel(NamedTuple):
    """Error model: a cooling gas from t = 0 on, with the quantities that limit the models.

    Attributes:
        gas: the scene.
        num_particles: N of the gas, or None if it is unknown; then the box is unknown, too.
        time: t, s, shape (times,), increasing from 0; all following arrays are at these times.
        log_temperature: ln(T/T_0).
        collisions: per particle.
        sonine: a_2.
        contact_fraction: contact duration over mean free time.
        overlap: mean largest overlap, in diameters.
        softness: c X_T/sigma, by which soft contacts slow the cooling.
        flow_share: mean share of the kinetic energy in the flow, 0 where the box is unknown.
        flow_scatter: standard deviation of this share between realisations.

    >>> from jaxgran.models.choose import predict_error_model
    >>> error_model = predict_error_model(gas, end=3.0)
    >>> 0.005 < error_model.error_of_temperature(0.01) < 0.02
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

    @classmethod
    def from_curve(
        cls, gas: Gas, curve: CoolingCurve, num_particles: int | None = None
    ) -> "ErrorModel":
        """Return the error model of a gas from its cooling curve, which begins at t = 0.

        a_2 and the collisions are set to 0 if the curve does not have them.

        Args:
            gas: the scene.
            curve: T at times from t = 0 on.
            num_particles: N of the gas; None if unknown.
        """
        temperature = np.asarray(curve.temperature)
        log_temperature = np.log(temperature / np.asarray(gas.temperature)).astype(float)
        scales = scales_at(gas, temperature)
        zero = np.zeros(temperature.shape)
        share, scatter = zero, zero
        if num_particles is not None:
            critical_box = np.asarray(scales.critical_box, float)
            share, scatter = flow_share(gas, log_temperature, critical_box, num_particles)
        return cls(
            gas=gas,
            num_particles=num_particles,
            time=np.asarray(curve.times, float),
            log_temperature=log_temperature,
            collisions=zero if curve.collisions is None else np.asarray(curve.collisions, float),
            sonine=zero if curve.sonine is None else np.asarray(curve.sonine, float),
            contact_fraction=np.asarray(scales.contact_fraction, float),
            overlap=np.asarray(scales.overlap, float),
            softness=np.asarray(scales.softness, float),
            flow_share=share,
            flow_scatter=scatter,
        )

    def error_of_temperature(self, rate_error: Float[np.ndarray, "times"] | float) -> float:
        """Relative error of T, at the worst time, by a relative error e(t) of the cooling rate.

        It is ``|d ln T/dt| int_0^t e dt'``, since the clock of the model is wrong by the integral.
        In a driven gas y = |d ln T| obeys ``dy/dt = e zeta - (zeta/2 + xi_0^2/T) y`` with the
        cooling rate zeta by all losses.
        """
        t = self.time
        if t[-1] == 0:
            return 0.0
        if self.gas.drive is not None:
            return self._error_where_driven(np.broadcast_to(rate_error, t.shape))
        delay = self._integral(np.broadcast_to(rate_error, t.shape))
        return float(np.max(np.abs(np.gradient(self.log_temperature, t)) * delay))

    def _error_where_driven(self, e: Float[np.ndarray, "times"]) -> float:
        t = self.time
        y = 0.0
        worst = 0.0
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
        """Relative error of the clock, ``int_0^t e dt' / t``, by an error e(t) of the rate."""
        e = np.broadcast_to(rate_error, self.time.shape)
        return np.where(self.time > 0, self._integral(e) / np.where(self.time > 0, self.time, 1), e)

    def slope_error(self) -> Float[np.ndarray, "times"]:
        """Relative error of projected derivatives of a particle run by a flow in its box.

        The projection remembers T alone, and not how the flow depends on the material. The error
        is 0 in boxes below L_c.
        """
        gas = self.gas
        n = self.num_particles
        if n is None:
            return np.zeros(self.time.shape)
        scales = scales_at(gas)
        if scales.box_side(n, gas.dimension) <= scales.critical_box:
            return np.zeros(self.time.shape)
        return slope_bias(self.clock_error(MEASURED_FLOW * MISSING_HEAT * self.flow_share))

    def noise_of_differences(self, step: float, noise: float) -> Float[np.ndarray, "times"]:
        """Relative standard error of a derivative of ln T by differences of runs, at most 1.

        It is ``s / (sqrt(2) h |d ln T/d ln A|)`` for a step h and a standard error s of ln T, with
        the derivative ``d ln T/d ln t`` of a gas that depends on the product of A and t.
        """
        slope = np.abs(self.time * np.gradient(self.log_temperature, self.time))
        error = noise / (np.sqrt(2) * step)
        return error / np.maximum(slope, error)  # 1 if the error exceeds the slope

    @property
    def mixing(self) -> Float[np.ndarray, "times"] | float:
        """Error of the cooling rate of models that assume a mixed gas between walls."""
        gas = self.gas
        walls = self.gas.container
        if walls is None:
            return 0.0
        if walls.tangential_restitution is not None:
            return ROUGH_WALL_ERROR
        law = walls.restitution.on_wall(
            diameter=gas.diameter, mass=gas.mass, speed=gas.impact_speed
        )
        loss = 1 - float(law.restitution(jnp.ones(())))
        near = np.max(np.asarray(gas.diameter / (walls.side - gas.diameter)))
        error = min(ELASTIC_WALL_ERROR + LOSS_WALL_ERROR * loss, WALL_ERROR)
        speed = np.exp(np.minimum(self.log_temperature, 0.0) / 2)  # sqrt(T/T_0), at most 1
        return error * speed + NARROW_BOX * float(near) ** 4

    @property
    def roughness(self) -> float:
        """Error of kinetic theory's cooling rate by rotation."""
        return 0.0 if self.gas.surface is None else ROUGHNESS_ERROR

    @property
    def sizes(self) -> float:
        """Error of kinetic theory's cooling rate by unequal sizes."""
        return SIZE_ERROR * float(self.gas.size_spread) ** 2

    def _integral(self, values: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times"]:
        steps = (values[1:] + values[:-1]) / 2 * np.diff(self.time)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def homogeneous(self) -> Float[np.ndarray, "times"]:
        """Error of Enskog's cooling rate by density, and by a flow (energy that is not heat)."""
        return self._density_and_flow(ENSKOG_ERROR)

    @property
    def correlated(self) -> Float[np.ndarray, "times"]:
        """Error of the cooling rate with velocity correlations, by density and by a flow."""
        return self._density_and_flow(CORRELATED_ERROR[self.gas.dimension])

    def _density_and_flow(self, error: tuple[float, float]) -> Float[np.ndarray, "times"]:
        by_density = error[0] + error[1] * float(self.gas.packing_fraction)
        return by_density + MISSING_HEAT * self.flow_share

    @property
    def instant_contacts(self) -> Float[np.ndarray, "times"]:
        """Error of the cooling rate of a model of binary impacts without duration."""
        return CONTACT_ERROR * self.contact_fraction + self.softness

    @property
    def corrected_contacts(self) -> Float[np.ndarray, "times"]:
        """Error of the cooling rate with the first-order corrections for contacts that last."""
        return CROWDED_ERROR * self.contact_fraction + SOFTNESS_SQUARED * self.softness**2

    def truncation(self, order: int) -> Float[np.ndarray, "times"]:
        """Error of the cooling rate by the Sonine terms beyond a_2 or a_3."""
        return {2: SONINE_TRUNCATION, 3: THIRD_SONINE_TRUNCATION}[order] * self.sonine**2

    def shot_noise(self, num_particles: int) -> float:
        """Standard error of ln T by shot noise of N particles in a homogeneous gas."""
        cooled = min(1.0, max(0.0, -self.log_temperature.min()))
        return FLOW_NOISE * sqrt(cooled / num_particles)

    def flow_noise(self, replicas: int) -> float:
        """Standard error of ln T over some replicas, by the few random waves of a growing flow."""
        return self.error_of_temperature(MISSING_HEAT * self.flow_scatter) / sqrt(replicas)


def slope_bias(clock: A) -> A:
    """Return the relative error of a projected derivative: see `SLOPE_BIAS_COEFFICIENTS`.

    Args:
        clock: relative error of the clock of a model that counts the flow as heat.
    """
    factor, scale = SLOPE_BIAS_COEFFICIENTS
    return factor * clock * (1 + (clock / scale) ** 2)


def slope_bias_of_run(
    times: Float[Array, "times"], flow_share: Float[Array, "times"]
) -> Float[Array, "times"]:
    """Return `slope_bias` from the share of the energy in the flow of a run at some times.

    ``c = 1.6 int_0^t share dt' / t``, by the trapezoidal rule, from no flow at t = 0. If times are
    far apart c is too large, because the growth of a flow accelerates.
    """
    missing = MISSING_HEAT * flow_share
    before = jnp.concatenate([jnp.zeros(1, missing.dtype), missing[:-1]])
    steps = jnp.diff(times, prepend=jnp.zeros(1, times.dtype))
    # The clock error is not defined at t = 0.
    clock = jnp.cumsum((before + missing) / 2 * steps) / jnp.where(times > 0, times, 1.0)
    return slope_bias(jnp.where(times > 0, clock, 0.0))


def flow_share(
    gas: Gas,
    log_temperature: Float[np.ndarray, "times"],
    critical_box: Float[np.ndarray, "times"],
    num_particles: int,
) -> tuple[Float[np.ndarray, "times"], Float[np.ndarray, "times"]]:
    """Return the fraction of kinetic energy in shear modes above equipartition, and its scatter.

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
    side = scales_at(gas).box_side(num_particles, gas.dimension)
    q_of_longest = (critical_box / side) ** 2
    longest = sqrt(1 / q_of_longest.min())
    if longest * sqrt(MAX_WAVENUMBER_SQUARED) < 1:
        zero = np.zeros_like(q_of_longest)
        return zero, zero
    # Waves per particle do not depend on the box, so a smaller box stands for a large one.
    scale = max(1.0, longest / MAX_ENUMERATED_BOX)
    d = gas.dimension
    count = _count_waves(int(sqrt(MAX_WAVENUMBER_SQUARED) * longest / scale), d)
    num_waves = count * scale**d
    q = np.arange(1, count.size + 1) * scale**2 * q_of_longest[:, None]
    counted = q[0] < MAX_WAVENUMBER_SQUARED
    s = -log_temperature
    # Energy of one mode in units of T, minus its value of 1 in equilibrium.
    energy = np.zeros(count.size)
    flow = [0.0]
    variance = [0.0]
    for ds, q_now in zip(np.diff(s), (q[1:] + q[:-1]) / 2, strict=True):
        growth = 1 - q_now
        growth = np.where(np.abs(growth) < 1e-6, 1e-6, growth)
        energy = energy * np.exp(growth * ds) + np.expm1(growth * ds) / growth
        flow.append((d - 1) * np.sum((num_waves * energy)[counted]))
        variance.append(2 * (d - 1) * np.sum((num_waves * energy**2)[counted]))
    degrees = d * num_particles
    return np.minimum(np.array(flow) / degrees, 1.0), np.minimum(np.sqrt(variance) / degrees, 1.0)


def _count_waves(largest: int, dimension: int) -> Int[np.ndarray, "squares"]:
    """Return the numbers of wave vectors n, in units of 2 pi / box, with n^2 = 1, 2, ...

    The components of n go from -largest to largest.
    """
    axes = np.meshgrid(*[np.arange(-largest, largest + 1)] * dimension)
    squares = np.sum([n**2 for n in axes], axis=0)
    return np.bincount(squares.ravel())[1:]
