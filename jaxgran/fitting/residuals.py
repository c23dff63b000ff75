"""Weighted residuals of a measured curve, their statistics, and the checks that all fits share."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran._utils.tracing import any_traced, array_module, as_jax_arrays
from jaxgran._utils.validation import float_array
from jaxgran.data.curve import QUANTITIES, WITH_ERRORS, CoolingCurve, Run
from jaxgran.data.curve_file import DropTest
from jaxgran.fitting.parameters import START_TIME, Numbers, residuals_and_slopes, with_floats
from jaxgran.models.base import AbstractModel
from jaxgran.models.checks import checked_gas
from jaxgran.models.linearise import COMPUTED, LINEARISED, linearise, with_all_elements
from jaxgran.scene.gas import Gas

MAGNITUDES = 1e-30, 1e30
"""Smallest and largest allowed values of a measurement, SI."""

TINY = 1e-30

FEW_IMPACTS = 4.0
"""Excess of the variance of T_rot over that of Gaussian spins, times collisions per particle.

Measured: 100 runs of 250 spheres without initial rotation, beta_t = -.3: 5, 5, 4, 3 at .2, .7, 1.3,
2.2 collisions; between walls, which spheres hit, too, 3, 2, 1 at .1, .5, 1."""

MIN_ERROR = 1e-12
"""Smallest allowed relative error of a measurement."""


def check_curve(gas: Gas, curve: CoolingCurve) -> None:
    """Raise ValueError unless `gas` is a single gas and `curve` a valid measurement."""
    checked_gas(gas)
    if not isinstance(curve, CoolingCurve):
        raise ValueError(f"curve must be a jaxgran.CoolingCurve, got {curve!r:.60}")
    curve.check()
    _check_magnitudes(curve)


def _check_magnitudes(curve: CoolingCurve) -> None:
    """Raise ValueError for values outside `MAGNITUDES`, mostly typing or unit errors."""
    if any_traced(curve):
        return
    smallest, largest = MAGNITUDES
    for name, quantity in QUANTITIES.items():
        values = getattr(curve, name) if quantity.measured else None
        if values is None:
            continue
        least, column, values = smallest, quantity.column, np.asarray(values)
        if name.endswith("_error"):
            of = getattr(curve, name.removesuffix("_error"))
            if of is None:
                raise ValueError(f"the curve has {name} without the values. Leave it out as well.")
            least = MIN_ERROR * np.asarray(of)
        wrong = (values > 0) & ((values < least) | (values > largest))
        if np.any(wrong):
            i = int(np.argmax(wrong))
            raise ValueError(
                f"point {i}: {column} is {values[i]:g}, which cannot be measured. Allowed are "
                f"{smallest:g} to {largest:g} in SI units, and errors above {MIN_ERROR:g} of the "
                "value: correct or remove the point"
            )


def unused_rotation(gas: Gas, curve: CoolingCurve) -> str | None:
    """Return why a fit ignores the T_rot of a curve; None if it uses it or if there is none."""
    if curve.rotational_temperature is None:
        return None
    if gas.surface is None:
        return (
            "the measured T_rot is not used: the gas has no surface=jaxgran.Rough(...) (header key "
            "beta_t)"
        )
    lacking = {"T_err": curve.temperature_error, "T_rot_err": curve.rotational_temperature_error}
    names = [name for name, error in lacking.items() if error is None]
    if names:
        return f"the measured T_rot is not used: its weights need {' and '.join(names)}, or N"
    return None


def with_errors_of_particles(
    gas: Gas, curve: CoolingCurve, num_particles: int | None, replicas: int
) -> CoolingCurve:
    """Return a curve with the errors that its T_rot needs, from the fluctuations of N particles.

    Relative errors that the curve lacks are ``sqrt(2/(d N R))`` of T and, with R replicas and c
    collisions per particle, ``sqrt((1 + `FEW_IMPACTS`/c) 2/(d_rot N R))`` of T_rot: at first few
    spheres have hit another one and hold all rotation. Without N, T_rot or a surface the curve is
    returned unchanged.
    """
    if num_particles is None or gas.surface is None or curve.rotational_temperature is None:
        return curve
    xp, d, errors = array_module(gas, curve), gas.dimension, {}
    T, T_rot = xp.asarray(curve.temperature), xp.asarray(curve.rotational_temperature)
    if curve.temperature_error is None:
        errors["temperature_error"] = (2 / (d * num_particles * replicas)) ** 0.5 * T
    if curve.rotational_temperature_error is None:
        zero, T_0 = xp.zeros(1, T.dtype), xp.reshape(xp.asarray(gas.temperature), 1)
        times = xp.concatenate([zero, xp.asarray(curve.times)])
        speed = xp.sqrt(xp.concatenate([T_0, T]) / T_0)
        steps = (speed[1:] + speed[:-1]) / 2 * (times[1:] - times[:-1])
        collisions = xp.cumsum(steps) * xp.asarray(gas.collision_frequency)
        before = xp.asarray(gas.surface.rotational_temperature) / xp.maximum(T_rot, TINY)
        few = FEW_IMPACTS / xp.maximum(collisions, TINY) * xp.maximum(1 - before, 0.0)
        variance = (1 + few) * 2 / ((2 * d - 3) * num_particles * replicas)
        errors["rotational_temperature_error"] = xp.sqrt(variance) * T_rot
    return replace(curve, **errors) if errors else curve


def uses_rotation(gas: Gas, curve: CoolingCurve) -> bool:
    """Return True if a fit uses the T_rot of a curve; see `unused_rotation`."""
    return curve.rotational_temperature is not None and unused_rotation(gas, curve) is None


def log_temperatures(curve: CoolingCurve, rotation: bool) -> Float[Array, "*replicas points"]:
    """Return ln T at all times, followed by ln T_rot if `rotation` is True."""
    values = [jnp.log(curve.temperature)]
    if rotation:
        assert curve.rotational_temperature is not None
        values.append(jnp.log(curve.rotational_temperature))
    return jnp.concatenate(values, axis=-1)


CLOCK, CLOCK_TREND = "clock", "clock trend"
"""Nuisance parameters: mean and trend of the error of a model's clock, over its accuracy."""

FACTORS = {"rotational_temperature": "model of T_rot", "displacement": "model of <dr^2>"}
"""Nuisance parameters by quantity: the logarithm of a common factor of all its values."""

FLOOR = "floor"
"""Noise floor, m^2/s^2, added to the computed T: a parameter of an alternative explanation."""

MODEL_ERROR = "model"
"""Name of the part of an error budget due to the model's clock."""


class Rows(NamedTuple):
    """Weighted residuals of one kind.

    Attributes:
        kind: a field of a curve, "drop test", or the name of a prior or of a nuisance parameter.
        label: of the measurement; None for priors of shared parameters.
        values: the residuals, shape (n,).
        slopes: their derivatives in SI values of parameters, shape (n, size), by name.
        by_clock: their derivatives in a relative change of the model's time, each in its own time.
        share: the measured error of each over its whole error; 1 without noise of simulations.
        of_prior: True for a prior, which may have the name of a measured field, "temperature".
    """

    kind: str
    label: str | None
    values: Numbers
    slopes: dict[str, Numbers]
    by_clock: Numbers = 0.0
    share: Numbers = 1.0
    of_prior: bool = False

    @property
    def measured(self) -> bool:
        """True if these are residuals of a measurement."""
        return not self.of_prior and (self.kind in MEASURED or self.kind == "drop test")


@dataclass(frozen=True)
class Measurement:
    """A measured curve with the weights of its quantities, to be compared with a model.

    Attributes:
        label: in a fit of several measurements, otherwise "".
        scene: the gas.
        gas: the same with all elements that the model supports.
        curve: the measured curve.
        weights: inverse relative errors by field of the curve; those that are absent are not used.
        accuracies: relative accuracy of the model's T_rot and <dr^2>, by field.
        faster: factor by which the measured gas cools faster because N is small.
        clock_accuracy: relative accuracy of the model's clock at each time.
        position: ln T, linear from -1 at first to 1 at last, for the trend of errors of the clock.
        offset: ln T of the fitted model minus that of `gas`, of a model with noise.
        scatter: relative error of T if the curve has none; None otherwise.
        error_degrees: degrees of freedom of the errors, by field; {} if they are exact.
    """

    label: str
    scene: Gas
    gas: Gas
    curve: CoolingCurve
    weights: dict[str, Numbers]
    accuracies: dict[str, Numbers]
    faster: Numbers
    clock_accuracy: Numbers
    position: Numbers
    offset: Numbers = 0.0
    scatter: Numbers | None = None
    error_degrees: dict[str, Numbers] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        label: str,
        gas: Gas,
        curve: CoolingCurve,
        model: AbstractModel,
        num_particles: int | None,
        replicas: int,
        *,
        use_displacement: bool,
    ) -> "Measurement":
        """Compare T and, if errors of the curve and of the model are known, T_rot and <dr^2>."""
        curve, error_degrees = smooth_errors(curve, replicas)
        xp = array_module(gas, curve)
        T, T_error = curve.temperature, curve.temperature_error
        weights = {"temperature": _weights(xp, T, T if T_error is None else T_error)}
        accuracies: dict[str, Numbers] = {}
        if uses_rotation(gas, curve):
            name = "rotational_temperature"
            weights[name] = _weights(xp, getattr(curve, name), curve.rotational_temperature_error)
            accuracies[name] = model.rotation_accuracy(gas)
        # A measured <dr^2> starts at t = 0 of the curve, not at t0.
        has_errors = T_error is not None and (
            curve.displacement_error is not None or num_particles is not None
        )
        accuracy = None
        if use_displacement and curve.displacement is not None and has_errors:
            accuracy = model.displacement_accuracy(gas)
        if accuracy is not None:
            accuracy, measured = xp.asarray(accuracy), xp.asarray(curve.displacement)
            total = (1 if num_particles is None else num_particles) * replicas
            sampling = (2 / (gas.dimension * total)) ** 0.5 * measured
            error = curve.displacement_error
            error = sampling if error is None else xp.asarray(error)
            error = xp.where(error > 0, xp.hypot(error, accuracy * measured), 0.0)
            weights["displacement"] = _weights(xp, measured, error)
            accuracies["displacement"] = accuracy
        faster = 1.0
        if num_particles is not None:
            faster = finite_size_cooling_factor(gas, float_array(num_particles))
        return cls(
            label,
            gas,
            with_all_elements(gas, model),
            curve,
            weights,
            accuracies,
            faster=xp.asarray(faster),
            clock_accuracy=xp.full(curve.times.shape, model.derivative_accuracy),
            position=_position(xp, xp.asarray(T)),
            error_degrees=error_degrees,
        )

    @property
    def data(self) -> CoolingCurve:
        """The measured curve."""
        return self.curve

    @property
    def num_points(self) -> int:
        """Number of values of T with a weight; of all values under a transformation."""
        weights = self.weights["temperature"]
        return weights.size if any_traced(weights) else int(np.sum(weights > 0))

    @property
    def nuisances(self) -> tuple[str, ...]:
        """Names of the nuisance parameters without those of the clock."""
        return tuple(FACTORS[name] for name in self.accuracies)

    def evaluate(
        self,
        model: AbstractModel,
        values: dict[str, Numbers],
        *,
        linear: bool = True,
        tolerance: float = 1.0,
    ) -> tuple[list[Rows], dict[str, Numbers]]:
        """Return the weighted residuals, with derivatives, and the computed curve as a dictionary.

        Args:
            model: without noise.
            values: SI values of floats of the gas, of `START_TIME` and of nuisance parameters.
            linear: if False, the residuals have no derivatives in floats of the gas and in time,
                and JAX can differentiate them.
            tolerance: factor of the model's tolerance.
        """
        xp = array_module(self.gas, self.curve, values) if linear else jnp
        domains = self.gas.domains
        floats = {name: x for name, x in values.items() if name in domains}
        times = xp.asarray(self.curve.times)
        position = self.position
        error = values.get(CLOCK, 0.0) + values.get(CLOCK_TREND, 0.0) * position
        clock = self.faster * xp.exp(self.clock_accuracy * error)
        elapsed = (times - values.get(START_TIME, 0.0)) * clock
        around = START_TIME in values
        if linear:
            gas = with_floats(self.gas, floats, xp)
            logs, computed = _log_curve(model, gas, elapsed, around, floats, tolerance)
        else:
            logs, computed = _log_values(model.simulate(self.scene, elapsed, Run()))
        if missing := ", ".join(name for name in self.weights if name not in logs):
            raise ValueError(
                f"{type(model).__name__} does not compute {missing} in this scene, though it gives "
                "its accuracy. Let displacement_accuracy return None there."
            )
        floor = values.get(FLOOR, 0.0)
        hot = xp.exp(logs["temperature"].values)
        share = hot / (hot + floor)
        rows: list[Rows] = []
        diffusive: Numbers = None
        if "displacement" in self.weights:
            collisions = computed["collisions"]
            # The common factor is one of D: the ballistic flight before collisions has no error.
            diffusive = collisions / (1 + collisions)
        for name, weights in self.weights.items():
            log, factor = logs[name], FACTORS.get(name)
            value, scale, extra = log.values, 1.0, {}
            if name == "temperature":
                value, scale = xp.log(hot + floor) + self.offset, share
                if FLOOR in values:
                    extra[FLOOR] = (1 / (hot + floor))[:, None]
            if factor in values:
                column = xp.ones_like(times) if name != "displacement" else diffusive
                value, extra[factor] = value + values[factor] * column, column[:, None]
            measured = xp.asarray(getattr(self.curve, name))
            # Not `value > -inf`: a curve of nan, which is not computed, would fit perfectly.
            positive = (measured > 0) & ~xp.isneginf(value) & (weights > 0)
            used = xp.where(positive, weights, 0.0)
            difference = xp.log(xp.where(positive, measured, 1.0)) - xp.where(positive, value, 0.0)
            factors = -used * scale
            rate = xp.where(positive, factors * log.by_time, 0.0)
            slopes = {
                key: xp.where(positive[:, None], factors[:, None] * slope, 0.0)
                for key, slope in log.by_float.items()
            }
            slopes |= {key: -used[:, None] * column for key, column in extra.items()}
            by_clock = rate * elapsed
            if around:
                slopes[START_TIME] = (-rate * clock)[:, None]
            if CLOCK in values:
                slopes[CLOCK] = (by_clock * self.clock_accuracy)[:, None]
                slopes[CLOCK_TREND] = (by_clock * self.clock_accuracy * position)[:, None]
            rows.append(Rows(name, self.label, used * difference, slopes, by_clock))
        widths = {FACTORS[name]: width for name, width in self.accuracies.items()}
        for name, width in (widths | {CLOCK: 1.0, CLOCK_TREND: 1.0}).items():
            if name in values:
                kind, slope = name if name in widths else MODEL_ERROR, xp.ones((1, 1)) / width
                value = xp.ravel(values[name] / width)
                rows.append(Rows(kind, self.label, value, {name: slope}))
        return rows, computed

    def as_curve(self, computed: dict[str, Numbers]) -> CoolingCurve:
        """Return a computed curve without the quantities that the scene does not have."""
        absent = () if self.scene.surface is not None else ("rotational_temperature",)
        if self.scene.container is not None:
            absent += "displacement", "diffusion"
        fields: dict[str, Any] = {k: x for k, x in computed.items() if k not in absent}
        return CoolingCurve(times=self.curve.times, **as_jax_arrays(fields))

    def with_scatter_as_error(self, rows: list[Rows], num_free: int) -> "Measurement":
        """Return the comparison with the scatter of ln T in residuals of weight 1 as its error."""
        residuals, weights = rows[0].values, self.weights["temperature"]
        xp = array_module(residuals)
        before = 1.0 if self.scatter is None else self.scatter
        used = weights > 0
        square = xp.sum(xp.where(used, residuals * before, 0.0) ** 2)
        scatter = xp.sqrt(square / (xp.sum(used) - num_free))
        # Data without noise have the round-off of this precision as error, not 0.
        scatter = xp.maximum(scatter, xp.finfo(scatter.dtype).eps)
        weights = {"temperature": xp.where(used, 1 / scatter, 0.0)}
        return replace(self, weights=weights, scatter=scatter)


class _LogQuantity(NamedTuple):
    values: Numbers
    by_float: dict[str, Numbers]
    by_time: Numbers


def _log_values(curve: CoolingCurve) -> tuple[dict[str, _LogQuantity], dict[str, Array]]:
    """Return logarithms of the quantities of a curve without derivatives, and its fields."""
    fields = {name: getattr(curve, name) for name in COMPUTED}
    known = {name: value for name, value in fields.items() if value is not None}
    zero = jnp.zeros_like(curve.temperature)
    logs = {
        name: _LogQuantity(jnp.log(value), {}, zero)
        for name, value in known.items()
        if name in LINEARISED
    }
    return logs, known


def _log_curve(
    model: AbstractModel,
    gas: Gas,
    times: Numbers,
    around: bool,
    free: Iterable[str],
    tolerance: float,
) -> tuple[dict[str, _LogQuantity], dict[str, Numbers]]:
    """Return logarithms of a curve's quantities, derivatives in free floats, and all its fields.

    If `around` is True, times may be negative. T is continued to t < 0 to first order in t,
    ``ln T(-t) = 2 ln T_0 - ln T(t)``, and so is T_rot, unless the spheres began without rotation.
    """
    xp = array_module(gas, times)
    order = inverse = slice(None)
    before, distance = xp.zeros(times.shape, bool), times
    if around:
        before, distance = times < 0, xp.abs(times)
        order = xp.argsort(distance)
        inverse = xp.argsort(order)
    linear = linearise(model, gas, distance[order], tolerance)
    values = {k: x[inverse] if x.ndim else x for k, x in linear.values.items()}
    firsts = {"temperature": gas.temperature} if around else {}
    if around and gas.surface is not None:
        firsts["rotational_temperature"] = gas.surface.rotational_temperature
    logs = {}
    for name, by_time in linear.by_time.items():
        value = values[name]
        safe = xp.where(value > 0, value, 1.0)
        log = xp.where(value > 0, xp.log(safe), xp.where(value <= 0, -xp.inf, xp.nan))
        by_float = {key: linear.by_float[key][name][inverse] / safe[:, None] for key in free}
        if name in firsts:
            first = xp.asarray(firsts[name])
            log_first = xp.log(xp.where(first > 0, first, 1.0))
            reflect = before & (first > 0)
            log = xp.where(reflect, 2 * log_first - log, log)
            by_float = {k: xp.where(reflect[:, None], -x, x) for k, x in by_float.items()}
            added = xp.where(reflect, 2 / xp.where(first > 0, first, 1.0), 0.0)[:, None]
            if name in by_float:  # the float has the name of the quantity
                by_float[name] = by_float[name] + added
            values[name] = xp.exp(log)
        logs[name] = _LogQuantity(log, by_float, by_time[inverse] / safe)
    return logs, values


class DropTestRows(NamedTuple):
    """A drop test of spheres of a gas, among the measurements of a fit.

    It has the attributes of a `Measurement` that all fits use.
    """

    label: str
    scene: Gas
    data: DropTest
    weights: dict[str, Numbers] = {}
    error_degrees: dict[str, Numbers] = {}
    clock_accuracy: float = 0.0
    scatter: None = None

    @property
    def gas(self) -> Gas:
        """The gas of the spheres; it needs no further elements."""
        return self.scene

    @property
    def num_points(self) -> int:
        """Number of impacts."""
        return np.size(self.data.restitution)

    def evaluate(
        self, model: AbstractModel, values: dict[str, Numbers], *, tolerance: float = 1.0
    ) -> tuple[list[Rows], None]:
        """Return the residuals of the impacts, with derivatives."""
        xp = array_module(self.gas, values)
        floats = {n: jnp.asarray(x) for n, x in values.items() if n in self.gas.domains}
        row = residuals_and_slopes(self.data.residuals, self.gas, floats)
        return [Rows("drop test", self.label, *jax.tree.map(xp.asarray, row))], None


@eqx.filter_jit
def finite_size_cooling_factor(gas: Gas, num_particles: Float[Array, ""]) -> Float[Array, ""]:
    """Factor by which N particles without total momentum cool faster than many, at the same T.

    Their relative velocities are those of the temperature ``T' = T N/(N-1)``, and each particle
    collides with N - 1 others: with ``-d ln T/dt = r(T)`` the factor is r(T')/r(T), here with the
    loss ``1 - eps^2`` at the impact speed sqrt(2 T): 1 + .6/N for viscoelastic spheres, 1 + .5/N
    for a constant eps. It is 1 between walls, which take up momentum.
    """
    if gas.container is not None:
        return jnp.ones_like(gas.temperature)
    hotter = jnp.sqrt(num_particles / jnp.maximum(num_particles - 1, 1.0))
    one = jnp.ones_like(gas.temperature)
    loss = 1 - gas.reduced_law.restitution(one) ** 2
    ratio = (1 - gas.reduced_law.restitution(hotter * one) ** 2) / jnp.where(loss > 0, loss, 1.0)
    return hotter * jnp.where(loss > 0, ratio, 1.0)


def _position(xp: Any, T: Numbers) -> Numbers:
    log_T = xp.log(xp.where(T > 0, T, 1.0))
    return 2 * (log_T - log_T[0]) / (log_T[-1] - log_T[0]) - 1


def _weights(xp: Any, values: Numbers, error: Numbers) -> Numbers:
    """Inverse relative errors; 0 where the error is 0, for a prescribed value."""
    values, error = xp.asarray(values), xp.asarray(error)
    known = (values > 0) & (error > 0)
    return xp.where(known, values / xp.where(known, error, 1.0), 0.0)


MIN_RESIDUALS = 4
"""Minimum number of residuals for an estimate of their correlation."""

OUTLIER_DISTANCE = 3.0
"""Distance from the median, in standard deviations, beyond which a residual is clipped."""

MAX_CORRELATION = 0.95
"""Largest magnitude of an estimated correlation."""


def neighbour_correlation(residuals: Numbers, used: Numbers = None) -> Numbers:
    """Correlation of neighbouring residuals, with outliers clipped, from -.95 to .95.

    Args:
        residuals: the residuals in the order of time.
        used: True for residuals that count; by default those that are not 0.
    """
    xp = array_module(residuals, used)
    used = xp.asarray(residuals != 0 if used is None else used)
    number = xp.sum(used)
    packed = xp.argsort(~used, stable=True)
    known = xp.where(used, residuals, xp.nan)[packed]
    if xp is np and number < MIN_RESIDUALS:
        return np.zeros(())
    spread = OUTLIER_DISTANCE * xp.nanstd(known)
    middle = xp.nanmedian(known)
    clipped = xp.clip(known, middle - spread, middle + spread)
    centred = xp.nan_to_num(clipped - xp.nanmean(clipped))
    square = xp.sum(centred**2)
    enough = (number >= MIN_RESIDUALS) & (square > 0)
    correlation = xp.sum(centred[1:] * centred[:-1]) / xp.where(enough, square, 1.0)
    return xp.clip(xp.where(enough, correlation, 0.0), -MAX_CORRELATION, MAX_CORRELATION)


def correlation_factor(correlation: Numbers) -> Numbers:
    """Factor >= 1 by which correlated errors increase a standard error."""
    xp = array_module(correlation)
    positive = xp.maximum(correlation, 0.0)
    return xp.sqrt((1 + positive) / (1 - positive))


def chi2_scale(residuals: Numbers, num_parameters: int) -> tuple[Numbers, Numbers]:
    """Return the scale of differences of chi^2, and the effective degrees of freedom.

    The scale is 1 for independent errors of the given size. Where it is estimated, a difference
    over the scale has the F distribution with these degrees: n correlated points count as
    ``n (1 - c)/(1 + c)``.

    Args:
        residuals: weighted residuals of the best fit; 0 where a point is not used.
        num_parameters: the number of parameters of that fit.
    """
    xp = array_module(residuals)
    number = xp.sum(residuals != 0)
    reduced = xp.sum(residuals**2) / xp.maximum(number - num_parameters, 1)
    factor = correlation_factor(neighbour_correlation(residuals)) ** 2
    degrees = xp.maximum(number / factor - num_parameters, 1)
    return factor * xp.maximum(reduced, 1.0), degrees


MEASURED = tuple(quantity.field for quantity in WITH_ERRORS)
"""Fields of a curve that may have errors."""

MIN_POINTS_PER_COEFFICIENT = 6
"""Minimum number of points for each coefficient of the polynomial of `smooth_errors`."""

NUM_SMOOTHING_STEPS = 60
"""Iterations of the fit of that polynomial; a step is at most 1 in the logarithm of a variance."""


def smooth_errors(curve: CoolingCurve, replicas: int) -> tuple[CoolingCurve, dict[str, Numbers]]:
    """Smooth the errors of a curve of few replicas, and return their degrees of freedom.

    The relative variance of each point, from R replicas, has R - 1 degrees of freedom and scatters
    by ``sqrt(2/(R - 1))``: weights from it favour points that agree by chance. Its expectation is
    assumed to be smooth: ``ln variance`` is a parabola in the index of the point (a line or a
    constant for few points), fitted by maximum likelihood of the chi^2 distribution with R - 1
    degrees. All points together have ``(R - 1) n (1 - c)/(1 + c)`` degrees, where c is the
    correlation of the variances of neighbours; chi^2 then has the F distribution.

    Args:
        curve: a curve with errors of means over the replicas; one without errors is returned
            unchanged.
        replicas: R; with 1, the errors are taken as exact.

    Returns:
        The curve, and the degrees of freedom of the errors by quantity; {} if they are exact.
    """
    if replicas < 2 or curve.temperature_error is None:
        return curve, {}
    smooth, degrees = {}, {}
    for name in MEASURED:
        values, error = getattr(curve, name), getattr(curve, f"{name}_error")
        if values is not None and error is not None:
            smooth[f"{name}_error"], degrees[name] = _smooth_error(values, error, replicas)
    return replace(curve, **smooth), degrees


def _smooth_error(values: Numbers, error: Numbers, replicas: int) -> tuple[Numbers, Numbers]:
    """Return smooth errors of values, and their degrees of freedom."""
    xp = array_module(values, error)
    values, error = xp.asarray(values), xp.asarray(error)
    used = (values > 0) & (error > 0)
    share = xp.where(used, error, 1.0) / xp.where(used, values, 1.0)
    expected, num_independent = _fit_variance(share**2, used)
    degrees = (replicas - 1) * xp.maximum(num_independent, 1.0)
    return xp.where(used, values * xp.sqrt(expected), 0.0), degrees


def _fit_variance(variance: Numbers, used: Numbers) -> tuple[Numbers, Numbers]:
    """Return the expectation of variances along a curve, and the number of independent points."""
    xp = array_module(variance, used)
    position = np.linspace(-1.0, 1.0, variance.size)
    powers = min(2, variance.size // MIN_POINTS_PER_COEFFICIENT - 1)
    design = xp.asarray(np.stack([position**k for k in range(max(powers, 0) + 1)], axis=1))
    design = design.astype(variance.dtype)
    inverse = xp.linalg.pinv(design * used[:, None])
    number = xp.maximum(xp.sum(used), 1)
    mean = xp.sum(xp.where(used, variance, 0.0)) / number
    first = xp.log(xp.maximum(mean, xp.finfo(variance.dtype).tiny))
    coefficients = first * xp.eye(1, design.shape[1])[0]
    for _ in range(NUM_SMOOTHING_STEPS):
        excess = xp.where(used, variance * xp.exp(-design @ coefficients) - 1, 0.0)
        coefficients = coefficients + xp.clip(inverse @ excess, -1.0, 1.0)
    expected = xp.exp(design @ coefficients)
    correlation = xp.maximum(neighbour_correlation(variance / expected - 1, used), 0.0)
    return expected, number * (1 - correlation) / (1 + correlation)
