"""Weighted residuals of a measured curve, their statistics, and the checks that all fits share."""

from dataclasses import dataclass, replace
from math import erfc, sqrt

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num

from jaxgran._utils.tracing import any_traced
from jaxgran._utils.validation import float_array, no_type_check
from jaxgran.data.curve import COLUMNS, CoolingCurve, Run
from jaxgran.fitting.parameters import (
    NO_PRIORS,
    START_TIME,
    Parameters,
    Priors,
    guess_start_time,
    halving_time,
    size_of,
)
from jaxgran.models.base import AbstractModel
from jaxgran.models.checks import checked_gas, checked_model
from jaxgran.scene.gas import Gas

MAGNITUDES = 1e-30, 1e30
"""Smallest and largest allowed values of a measurement, SI."""

MIN_ERROR = 1e-12
"""Smallest allowed relative error of a measurement."""


@no_type_check
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
    for column, field in COLUMNS.items():
        values = getattr(curve, field)
        if values is None:
            continue
        least, values = smallest, np.asarray(values)
        if column.endswith("_err"):
            least = MIN_ERROR * np.asarray(getattr(curve, field.removesuffix("_error")))
        wrong = (values > 0) & ((values < least) | (values > largest))
        if np.any(wrong):
            i = int(np.argmax(wrong))
            raise ValueError(
                f"point {i}: {column} is {values[i]:g}, which cannot be measured. Allowed are "
                f"{smallest:g} to {largest:g} in SI units, and errors above {MIN_ERROR:g} of the "
                "value: correct or remove the point"
            )


@no_type_check
def check_deterministic(model: AbstractModel, user: str) -> None:
    """Raise ValueError for a stochastic model; `user` names what does not support it."""
    checked_model(model)
    if model.stochastic:
        raise ValueError(
            f"{user} needs a model without noise, got {type(model).__name__}, which is stochastic. "
            "Use jaxgran.KineticTheory()"
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
        return f"the measured T_rot is not used: its weights need {' and '.join(names)}"
    return None


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


QUANTITIES = {"rotation": "T_rot", "displacement": "<dr^2>"}
"""Quantities other than T that a fit may use, by the name of their residuals."""


@dataclass(frozen=True)
class Comparison:
    """Weighted residuals of a measured curve as a function of the parameters of a model.

    The parameters ``flat`` are those of the gas in their unconstrained scale: the free ones, then
    those that vary because of a prior. Nuisance parameters follow. If there are priors, these are
    the mean of the error of the model's clock and its trend in ln T, so that errors of the clock
    are not attributed to the gas; and, if the quantities are used, the logarithm of a common factor
    of all T_rot and that of a common factor of all values of D. All nuisance parameters have the
    model's accuracy as prior.

    Attributes:
        curve: the measured curve.
        model: the model that computes the curve.
        parameters: the free parameters and those that vary because of a prior.
        num_free: the number of elements of the free parameters.
        priors: priors of floats of the gas.
        weights: inverse relative errors of T ("measurement") and, if they are used, of T_rot
            ("rotation") and <dr^2> ("displacement").
        accuracies: relative accuracy of the model's T_rot ("rotation") and <dr^2> ("displacement"),
            if they are used.
        finite_size_factor: factor by which the measured gas cools faster because N is small.
        clock_accuracy: relative accuracy of the model's clock, for the priors of its errors.
        scatter: relative error of T if the curve has none; None otherwise.
    """

    curve: CoolingCurve
    model: AbstractModel
    parameters: Parameters
    num_free: int
    priors: Priors
    weights: dict[str, Array]
    accuracies: dict[str, Float[Array, ""] | float]
    finite_size_factor: Float[Array, ""] | float
    clock_accuracy: Float[Array, "..."] | float
    scatter: Float[Array, ""] | None = None

    @classmethod
    def of(
        cls,
        gas: Gas,
        curve: CoolingCurve,
        model: AbstractModel,
        names: tuple[str, ...],
        num_particles: Float[Array, ""] | None,
        replicas: Float[Array, ""] | float = 1.0,
        priors: Priors = NO_PRIORS,
        clock_accuracy: Float[Array, "..."] | None = None,
    ) -> "Comparison":
        """Compare T and, if errors of the curve and of the model are known, T_rot and <dr^2>.

        The default of `clock_accuracy` is the model's ``derivative_accuracy``.
        """
        T, T_error = curve.temperature, curve.temperature_error
        weights = {"measurement": _weights(T, T if T_error is None else T_error)}
        accuracies: dict[str, Float[Array, ""] | float] = {}
        if uses_rotation(gas, curve):
            T_rot, error = curve.rotational_temperature, curve.rotational_temperature_error
            assert T_rot is not None and error is not None
            weights["rotation"] = _weights(T_rot, error)
            accuracies["rotation"] = model.rotation_accuracy
        accuracy = None
        # A measured <dr^2> starts at t = 0 of the curve, not at t0.
        if START_TIME not in (*names, *priors.names):
            accuracy = _displacement_accuracy(gas, curve, model, num_particles)
        if accuracy is not None:
            assert curve.displacement is not None
            total = (1 if num_particles is None else num_particles) * replicas
            sampling = (2 / (gas.dimension * total)) ** 0.5 * curve.displacement
            error = sampling if curve.displacement_error is None else curve.displacement_error
            error = jnp.where(error > 0, jnp.hypot(error, accuracy * curve.displacement), 0.0)
            weights["displacement"] = _weights(curve.displacement, error)
            accuracies["displacement"] = accuracy
        varied = (*names, *priors.extra_parameters(names))
        parameters = Parameters(gas, varied, halving_time(curve))
        num_free = sum(size_of(gas, name) for name in names)
        faster = 1.0 if num_particles is None else finite_size_cooling_factor(gas, num_particles)
        accuracy = model.derivative_accuracy if clock_accuracy is None else clock_accuracy
        return cls(
            curve,
            model,
            parameters,
            num_free,
            priors,
            weights,
            accuracies,
            finite_size_factor=faster,
            clock_accuracy=accuracy,
        )

    def with_scatter_as_error(self, flat: Float[Array, "q"]) -> "Comparison":
        """Return the comparison with the scatter of ln T, at some parameters, as its error."""
        T, computed = self.curve.temperature, self.evaluate(flat)[1][1]
        used = self.weights["measurement"] > 0
        square = jnp.sum(jnp.where(used, _log_ratio(T, computed.temperature), 0.0) ** 2)
        scatter = jnp.sqrt(square / (jnp.sum(used) - self.num_free))
        # Data without noise have the round-off of this precision as error, not 0.
        scatter = jnp.maximum(scatter, jnp.finfo(scatter.dtype).eps)
        return replace(
            self, weights={"measurement": jnp.where(used, 1 / scatter, 0.0)}, scatter=scatter
        )

    @property
    def num_measured(self) -> int:
        """The number of residuals of measured values, which come before those of priors."""
        return sum(weights.size for weights in self.weights.values())

    @property
    def num_nuisance(self) -> int:
        """The number of nuisance parameters, which come after those of the gas."""
        return 2 * bool(self.priors.names) + len(self.accuracies)

    def gas_parameters(self, flat: Float[Array, "q"]) -> Float[Array, "r"]:
        """Return the parameters of the gas."""
        return flat[: flat.size - self.num_nuisance]

    def clock_factors(
        self, flat: Float[Array, "q"]
    ) -> tuple[Float[Array, "times"], Float[Array, "_"]]:
        """Return factors of the model's clock, and the residuals of their priors."""
        if not self.priors.names:
            return jnp.full_like(self.curve.times, self.finite_size_factor), flat[:0]
        mean, trend = errors = flat[self.gas_parameters(flat).size :][:2]
        log_T = jnp.log(self.curve.temperature)
        position = 2 * (log_T - log_T[0]) / (log_T[-1] - log_T[0]) - 1
        fitted = jnp.exp(self.clock_accuracy * (mean + trend * position))
        return self.finite_size_factor * fitted, errors

    def estimates(self, flat: Float[Array, "q"]) -> Float[Array, "p"]:
        """Return SI values of the free parameters."""
        return self.parameters.estimates(self.gas_parameters(flat))[: self.num_free]

    def evaluate(
        self, flat: Float[Array, "q"], clock: Float[Array, "..."] | float = 1.0
    ) -> tuple[Float[Array, "residuals"], tuple[Float[Array, "residuals"], CoolingCurve]]:
        """Return the weighted residuals, and again with the computed curve for `jax.jacfwd`.

        Args:
            flat: the parameters.
            clock: factor by which the times of the model are multiplied, or one for each time.
        """
        gas = self.parameters.gas(self.gas_parameters(flat))
        clock_factors, clock_residuals = self.clock_factors(flat)
        start = self.parameters.start(self.gas_parameters(flat))
        elapsed = (self.curve.times - start) * clock * clock_factors
        if START_TIME in self.parameters.names:
            computed = _simulate_around_start(self.model, gas, elapsed)
        else:
            computed = self.model.simulate(gas, elapsed, Run())
        ratio = _log_ratio(self.curve.temperature, computed.temperature)
        parts = [self.weights["measurement"] * ratio]
        factors = dict(zip(self.accuracies, flat[flat.size - len(self.accuracies) :], strict=True))
        if "rotation" in factors:
            assert self.curve.rotational_temperature is not None
            assert computed.rotational_temperature is not None
            T_rot = self.curve.rotational_temperature, computed.rotational_temperature
            ratio = _log_ratio(*T_rot) - factors["rotation"]
            parts.append(self.weights["rotation"] * ratio)
        if "displacement" in factors:
            assert self.curve.displacement is not None
            assert computed.displacement is not None and computed.collisions is not None
            # The common factor is one of D: the ballistic flight before collisions has no error.
            diffusive = computed.collisions / (1 + computed.collisions)
            ratio = _log_ratio(self.curve.displacement, computed.displacement)
            ratio = ratio - factors["displacement"] * diffusive
            parts.append(self.weights["displacement"] * ratio)
        parts += [factors[name][None] / self.accuracies[name] for name in factors]
        residuals = jnp.concatenate([*parts, clock_residuals, self.priors.residuals(gas, start)])
        return residuals, (residuals, computed)

    def residuals(self, flat: Float[Array, "q"]) -> Float[Array, "residuals"]:
        """Return all weighted residuals: of measured values, nuisance parameters and priors."""
        return self.evaluate(flat)[0]

    def split(self, rows: Float[Array, "*_ residuals"]) -> dict[str, Float[Array, "*_ part"]]:
        """Split the last axis by the kind of residual, named as in `Fit.covariances`."""
        parts = [(name, weights.size) for name, weights in self.weights.items()]
        parts += [(f"model of {QUANTITIES[name]}", 1) for name in self.accuracies]
        if self.priors.names:
            sizes = zip(self.priors.names, self.priors.given, strict=True)
            parts += [("model", 2), *((name, given.size) for name, given in sizes)]
        ends = np.cumsum([size for _, size in parts])[:-1]
        names = [name for name, _ in parts]
        return dict(zip(names, jnp.split(rows, ends, axis=-1), strict=True))

    def best_guess(self, guesses: list[Gas]) -> Float[Array, "q"]:
        """Return the parameters of the guess with the smallest chi^2."""
        names = self.parameters.names
        starts = [guess_start_time(guess, self.curve, names) for guess in guesses]
        pairs = zip(guesses, starts, strict=True)
        flats = jnp.stack([self.parameters.flat(*pair) for pair in pairs])
        flats = jnp.pad(flats, ((0, 0), (0, self.num_nuisance)))
        if len(guesses) == 1:
            return flats[0]
        costs = jnp.stack([jnp.sum(self.residuals(flat) ** 2) for flat in flats])
        return flats[jnp.argmin(jnp.where(jnp.isnan(costs), jnp.inf, costs))]


def _simulate_around_start(
    model: AbstractModel, gas: Gas, times: Float[Array, "times"]
) -> CoolingCurve:
    """Return the curve of a gas that has T_0 at t = 0, at times that may be negative.

    T is continued to t < 0 to first order in t, ``ln T(-t) = 2 ln T_0 - ln T(t)``, and so is
    T_rot, unless the spheres began without rotation.
    """
    distance = jnp.where(times >= 0, times, -times)
    order = jnp.argsort(distance)
    computed = model.simulate(gas, distance[order], Run())
    inverse_order = jnp.argsort(order)

    def restore_order(values: Array | None) -> Array | None:
        return None if values is None else values[inverse_order]

    T, T_rot = computed.temperature[inverse_order], restore_order(computed.rotational_temperature)
    if T_rot is not None:
        T_rot = jnp.where(times >= 0, T_rot, gas.value("rotational_temperature") ** 2 / T_rot)
    return CoolingCurve(
        times=times,
        temperature=jnp.where(times >= 0, T, gas.temperature**2 / T),
        sonine=restore_order(computed.sonine),
        collisions=restore_order(computed.collisions),
        rotational_temperature=T_rot,
        status=computed.status,
    )


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


def _displacement_accuracy(
    gas: Gas,
    curve: CoolingCurve,
    model: AbstractModel,
    num_particles: Float[Array, ""] | None,
) -> Float[Array, ""] | None:
    """Relative accuracy of the model's <dr^2>; None if the fit cannot use <dr^2>.

    <dr^2> is used if it is measured and computed, and its error and that of T are known.
    """
    if curve.displacement is None or curve.temperature_error is None:
        return None
    if curve.displacement_error is None and num_particles is None:
        return None
    accuracy = model.displacement_accuracy(gas)
    if accuracy is not None:
        computed = eqx.filter_eval_shape(model.simulate, gas, curve.times, Run())
        if computed.displacement is None or computed.collisions is None:
            return None
    return accuracy


def _weights(values: Float[Array, "times"], error: Float[Array, "times"]) -> Float[Array, "times"]:
    """Inverse relative errors; 0 where the error is 0, for a prescribed value."""
    known = (values > 0) & (error > 0)
    return jnp.where(known, values / jnp.where(known, error, 1.0), 0.0)


def _log_ratio(
    measured: Float[Array, "times"], computed: Float[Array, "times"]
) -> Float[Array, "times"]:
    # Not `computed > 0`: a curve of nan, which could not be computed, would be a perfect fit.
    positive = (measured > 0) & ~(computed <= 0)
    safe = jnp.where(positive, measured, 1.0), jnp.where(positive, computed, 1.0)
    return jnp.log(safe[0]) - jnp.log(safe[1])


MIN_RESIDUALS = 4
"""Minimum number of residuals for an estimate of their correlation."""

OUTLIER_DISTANCE = 3.0
"""Distance from the median, in standard deviations, beyond which a residual is clipped."""

MAX_CORRELATION = 0.95
"""Largest magnitude of an estimated correlation."""


@eqx.filter_jit
def neighbour_correlation(
    residuals: Num[Array, "n"], used: Bool[Array, "n"] | None = None
) -> Float[Array, ""]:
    """Correlation of neighbouring residuals, with outliers clipped, from -.95 to .95.

    Args:
        residuals: the residuals in the order of time.
        used: True for residuals that count; by default those that are not 0.
    """
    used = residuals != 0 if used is None else used
    number = jnp.sum(used)
    packed = jnp.argsort(~used, stable=True)
    known = jnp.where(used, residuals, jnp.nan)[packed]
    spread = OUTLIER_DISTANCE * jnp.nanstd(known)
    middle = jnp.nanmedian(known)
    clipped = jnp.clip(known, middle - spread, middle + spread)
    centred = jnp.nan_to_num(clipped - jnp.nanmean(clipped))
    square = jnp.sum(centred**2)
    enough = (number >= MIN_RESIDUALS) & (square > 0)
    correlation = jnp.sum(centred[1:] * centred[:-1]) / jnp.where(enough, square, 1.0)
    return jnp.clip(jnp.where(enough, correlation, 0.0), -MAX_CORRELATION, MAX_CORRELATION)


def runs_test(residuals: Num[np.ndarray, "n"]) -> tuple[int, float, float]:
    """Wald & Wolfowitz's test of the runs of one sign in a sequence.

    For ``a`` positive and ``b`` negative residuals in random order, n in total, the number of runs
    has the mean ``m = 1 + 2 a b/n`` and the variance ``(m - 1)(m - 2)/(n - 1)``; its distribution
    is approximated by a Gaussian.

    Args:
        residuals: the residuals in the order of time; those that are 0 do not count.

    Returns:
        The number of runs, m, and the probability of so few runs by chance, which is 1 for fewer
        than `MIN_RESIDUALS` residuals or if all have the same sign.
    """
    positive = residuals[residuals != 0] > 0
    n, a = positive.size, int(np.sum(positive))
    number = int(np.sum(positive[1:] != positive[:-1])) + bool(n)
    mean = 1 + 2 * a * (n - a) / max(n, 1)
    variance = (mean - 1) * (mean - 2) / max(n - 1, 1)
    if n < MIN_RESIDUALS or variance <= 0:
        return number, mean, 1.0
    return number, mean, 0.5 * erfc((mean - number) / sqrt(2 * variance))


def correlation_factor(correlation: Float[Array, ""]) -> Float[Array, ""]:
    """Factor >= 1 by which correlated errors increase a standard error."""
    positive = jnp.maximum(correlation, 0.0)
    return jnp.sqrt((1 + positive) / (1 - positive))


@eqx.filter_jit
def chi2_scale(
    residuals: Num[Array, "n"], num_parameters: Int[Array, ""] | int
) -> Float[Array, ""]:
    """Scale of differences of chi^2: 1 for independent errors of the given size.

    Args:
        residuals: weighted residuals of the best fit; 0 where a point is not used.
        num_parameters: the number of parameters of that fit.
    """
    degrees = jnp.maximum(jnp.sum(residuals != 0) - num_parameters, 1)
    reduced = jnp.sum(residuals**2) / degrees
    return correlation_factor(neighbour_correlation(residuals)) ** 2 * jnp.maximum(reduced, 1.0)


REPLICA_QUANTITIES = {
    "measurement": "temperature",
    "rotation": "rotational_temperature",
    "displacement": "displacement",
}
"""Fields of a curve that have errors, by the names of `Comparison.weights`."""

MIN_POINTS_PER_COEFFICIENT = 6
"""Minimum number of points for each coefficient of the polynomial of `smooth_errors`."""

NUM_SMOOTHING_STEPS = 60
"""Iterations of the fit of that polynomial; a step is at most 1 in the logarithm of a variance."""


def smooth_errors(
    curve: CoolingCurve, replicas: int
) -> tuple[CoolingCurve, dict[str, Float[Array, ""]]]:
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
    for name, field in REPLICA_QUANTITIES.items():
        values, error = getattr(curve, field), getattr(curve, f"{field}_error")
        if values is None or error is None:
            continue
        smooth[f"{field}_error"], degrees[name] = _smooth_error(
            values, error, float_array(replicas)
        )
    return replace(curve, **smooth), degrees


@eqx.filter_jit
def _smooth_error(
    values: Float[Array, "n"], error: Float[Array, "n"], replicas: Float[Array, ""]
) -> tuple[Float[Array, "n"], Float[Array, ""]]:
    """Return smooth errors of values, and their degrees of freedom."""
    used = (values > 0) & (error > 0)
    share = jnp.where(used, error, 1.0) / jnp.where(used, values, 1.0)
    expected, num_independent = _fit_variance(share**2, used)
    degrees = (replicas - 1) * jnp.maximum(num_independent, 1.0)
    return jnp.where(used, values * jnp.sqrt(expected), 0.0), degrees


def _fit_variance(
    variance: Float[Array, "n"], used: Bool[Array, "n"]
) -> tuple[Float[Array, "n"], Float[Array, ""]]:
    """Return the expectation of variances along a curve, and the number of independent points."""
    position = jnp.linspace(-1.0, 1.0, variance.size, dtype=variance.dtype)
    powers = min(2, variance.size // MIN_POINTS_PER_COEFFICIENT - 1)
    design = jnp.stack([position**k for k in range(max(powers, 0) + 1)], axis=1)
    inverse = jnp.linalg.pinv(design * used[:, None])

    def step(_, coefficients: Array) -> Array:
        excess = jnp.where(used, variance * jnp.exp(-design @ coefficients) - 1, 0.0)
        return coefficients + jnp.clip(inverse @ excess, -1.0, 1.0)

    number = jnp.maximum(jnp.sum(used), 1)
    mean = jnp.sum(jnp.where(used, variance, 0.0)) / number
    tiny = jnp.finfo(variance.dtype).tiny
    first = jnp.zeros(design.shape[1], variance.dtype).at[0].set(jnp.log(jnp.maximum(mean, tiny)))
    expected = jnp.exp(design @ jax.lax.fori_loop(0, NUM_SMOOTHING_STEPS, step, first))
    correlation = jnp.maximum(neighbour_correlation(variance / expected - 1, used), 0.0)
    return expected, number * (1 - correlation) / (1 + correlation)
