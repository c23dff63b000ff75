"""Statistics of the residuals of a fit.

Checks of what a fit is given, shared by all kinds of fits.

Weighted residuals of a measured curve as a function of the parameters of a model.

Standard errors that come from the scatter of a few replicas.
"""

from dataclasses import dataclass, replace
from math import erfc, sqrt

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num

from jaxgran._utils.tracing import any_traced
from jaxgran._utils.validation import no_type_check, number
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
"""Smallest and largest values of a measurement, SI."""

MIN_ERROR = 1e-12
"""Least relative error of a measurement."""


@no_type_check
def check_curve(gas: Gas, curve: CoolingCurve) -> None:
    """Raise ValueError for anything but one gas and a curve that can have been measured."""
    checked_gas(gas)
    if not isinstance(curve, CoolingCurve):
        raise ValueError(f"curve must be a jaxgran.CoolingCurve, got {curve!r:.60}")
    curve.check()
    _check_magnitudes(curve)


def _check_magnitudes(curve: CoolingCurve) -> None:
    """Raise ValueError for values that are no measurement: mostly slips of the pen or of units."""
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
                f"point {i}: {column} is {values[i]:g}, which cannot be measured (allowed are "
                f"{smallest:g} to {largest:g} in SI units, and errors above {MIN_ERROR:g} of the "
                "value); correct or remove it"
            )


def unused_rotation(gas: Gas, curve: CoolingCurve) -> str | None:
    """Why a fit does not use the T_rot of a curve; None if it does, or if there is none."""
    if curve.rotational_temperature is None:
        return None
    if gas.surface is None:
        return (
            "the measured T_rot is not used, since the gas has no surface=jaxgran.Rough(...) "
            "(header key beta_t)"
        )
    lacking = {"T_err": curve.temperature_error, "T_rot_err": curve.rotational_temperature_error}
    names = [name for name, error in lacking.items() if error is None]
    if names:
        return f"the measured T_rot is not used, for want of {' and '.join(names)} to weigh it by"
    return None


@no_type_check
def check_deterministic(model: AbstractModel, user: str) -> None:
    """Raise ValueError for a model whose every curve has other noise."""
    checked_model(model)
    if model.stochastic:
        raise ValueError(
            f"{user} needs a model without noise, got {type(model).__name__}, which is stochastic: "
            "use jaxgran.KineticTheory()"
        )


QUANTITIES = {"rotation": "T_rot", "displacement": "<dr^2>"}
"""What else than T a fit may use."""


@dataclass(frozen=True)
class Comparison:
    """Weighted residuals of a measured curve as a function of the parameters of a model.

    The parameters ``flat`` are those of the gas in their unbounded scale: the free ones, then those
    that vary because of a prior. After them, where there are priors, come errors of the model's
    clock, of its mean and of its trend in ln T, so that these are not blamed on the gas; and, where
    they are used, the logarithms of a factor common to all T_rot and of one common to all values of
    D. All have the model's accuracy for a prior.

    Attributes:
        curve: the measured curve.
        model: of the computed curve.
        parameters: the free ones and those that vary because of a prior.
        num_free: how many numbers the free ones are.
        priors: of floats of the gas.
        weights: the inverse relative errors of the logarithms of T ("measurement") and, where they
            are used, of T_rot ("rotation") and of <dr^2> ("displacement").
        accuracies: relative accuracy of the model's T_rot ("rotation") and <dr^2> ("displacement"),
            where they are used.
        clock_of_few: factor by which the measured gas cools faster because its N are few.
        clock_accuracy: relative accuracy of the model's clock, for the priors of its errors.
        scatter: relative error of T where the curve has none; else None.
    """

    curve: CoolingCurve
    model: AbstractModel
    parameters: Parameters
    num_free: int
    priors: Priors
    weights: dict[str, Array]
    accuracies: dict[str, Float[Array, ""] | float]
    clock_of_few: Float[Array, ""] | float
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
        """Compare T and, where errors are known on both sides, T_rot and <dr^2>.

        Without a `clock_accuracy` it is the model's ``derivative_accuracy``.
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
        if START_TIME not in (
            *names,
            *priors.names,
        ):  # <dr^2> is counted from the start of the file
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
        faster = 1.0 if num_particles is None else clock_of_few(gas, num_particles)
        sure = model.derivative_accuracy if clock_accuracy is None else clock_accuracy
        return cls(curve, model, parameters, num_free, priors, weights, accuracies, faster, sure)

    def scaled(self, flat: Float[Array, "q"]) -> "Comparison":
        """The same with the scatter of ln T at some parameters for its error."""
        T, computed = self.curve.temperature, self.evaluate(flat)[1][1]
        used = self.weights["measurement"] > 0
        square = jnp.sum(jnp.where(used, _log_ratio(T, computed.temperature), 0.0) ** 2)
        scatter = jnp.sqrt(square / (jnp.sum(used) - self.num_free))
        # Not 0 for data without noise: the errors are then as small as numbers of this precision.
        scatter = jnp.maximum(scatter, jnp.finfo(scatter.dtype).eps)
        return replace(
            self, weights={"measurement": jnp.where(used, 1 / scatter, 0.0)}, scatter=scatter
        )

    @property
    def num_measured(self) -> int:
        """How many residuals are of measured values, which come before those of priors."""
        return sum(weights.size for weights in self.weights.values())

    @property
    def num_nuisance(self) -> int:
        """How many parameters there are after those of the gas."""
        return 2 * bool(self.priors.names) + len(self.accuracies)

    def of_gas(self, flat: Float[Array, "q"]) -> Float[Array, "r"]:
        """The parameters of the gas."""
        return flat[: flat.size - self.num_nuisance]

    def clock(self, flat: Float[Array, "q"]) -> tuple[Float[Array, "times"], Float[Array, "_"]]:
        """Factors of the model's clock, and the residuals of their priors."""
        if not self.priors.names:
            return jnp.full_like(self.curve.times, self.clock_of_few), flat[:0]
        mean, trend = errors = flat[self.of_gas(flat).size :][:2]
        log_T = jnp.log(self.curve.temperature)
        along = 2 * (log_T - log_T[0]) / (log_T[-1] - log_T[0]) - 1
        own = jnp.exp(self.clock_accuracy * (mean + trend * along))
        return self.clock_of_few * own, errors

    def estimates(self, flat: Float[Array, "q"]) -> Float[Array, "p"]:
        """SI values of the free parameters."""
        return self.parameters.estimates(self.of_gas(flat))[: self.num_free]

    def evaluate(
        self, flat: Float[Array, "q"], clock: Float[Array, "..."] | float = 1.0
    ) -> tuple[Float[Array, "residuals"], tuple[Float[Array, "residuals"], CoolingCurve]]:
        """The weighted residuals, twice, and the computed curve, as `jax.jacfwd` takes them.

        Args:
            flat: the parameters.
            clock: factor by which the times of the model are multiplied, or one for each.
        """
        gas = self.parameters.gas(self.of_gas(flat))
        own_clock, errors_of_clock = self.clock(flat)
        start = self.parameters.start(self.of_gas(flat))
        since = (self.curve.times - start) * clock * own_clock
        if START_TIME in self.parameters.names:
            computed = _begun_at_0(self.model, gas, since)
        else:
            computed = self.model.simulate(gas, since, Run())
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
            # The common factor is one of D: the ballistic flight before collisions is exact.
            diffusive = computed.collisions / (1 + computed.collisions)
            ratio = _log_ratio(self.curve.displacement, computed.displacement)
            ratio = ratio - factors["displacement"] * diffusive
            parts.append(self.weights["displacement"] * ratio)
        parts += [factors[name][None] / self.accuracies[name] for name in factors]
        residuals = jnp.concatenate([*parts, errors_of_clock, self.priors.residuals(gas, start)])
        return residuals, (residuals, computed)

    def residuals(self, flat: Float[Array, "q"]) -> Float[Array, "residuals"]:
        """The weighted residuals of ln T, of ln <dr^2>, of the factor of D and of the priors."""
        return self.evaluate(flat)[0]

    def split(self, rows: Float[Array, "*_ residuals"]) -> dict[str, Float[Array, "*_ part"]]:
        """What belongs to which residuals, by the names of `Fit.covariances`."""
        parts = [(name, weights.size) for name, weights in self.weights.items()]
        parts += [(f"model of {QUANTITIES[name]}", 1) for name in self.accuracies]
        if self.priors.names:
            sizes = zip(self.priors.names, self.priors.given, strict=True)
            parts += [("model", 2), *((name, given.size) for name, given in sizes)]
        ends = np.cumsum([size for _, size in parts])[:-1]
        names = [name for name, _ in parts]
        return dict(zip(names, jnp.split(rows, ends, axis=-1), strict=True))

    def best(self, guesses: list[Gas]) -> Float[Array, "q"]:
        """Of some guesses the one with the least chi^2."""
        names = self.parameters.names
        starts = [guess_start_time(guess, self.curve, names) for guess in guesses]
        pairs = zip(guesses, starts, strict=True)
        flats = jnp.stack([self.parameters.flat(*pair) for pair in pairs])
        flats = jnp.pad(flats, ((0, 0), (0, self.num_nuisance)))
        if len(guesses) == 1:
            return flats[0]
        costs = jnp.stack([jnp.sum(self.residuals(flat) ** 2) for flat in flats])
        return flats[jnp.argmin(jnp.where(jnp.isnan(costs), jnp.inf, costs))]


def _begun_at_0(model: AbstractModel, gas: Gas, since: Float[Array, "times"]) -> CoolingCurve:
    """The curve of a gas that has T_0 at t = 0, at times of which some may be earlier.

    Before t = 0 it is continued to first order in t, ``ln T(-t) = 2 ln T_0 - ln T(t)``, and so is
    T_rot, unless the spheres began without rotation.
    """
    away = jnp.where(since >= 0, since, -since)
    order = jnp.argsort(away)
    computed = model.simulate(gas, away[order], Run())
    place = jnp.argsort(order)

    def in_place(values: Array | None) -> Array | None:
        return None if values is None else values[place]

    T, T_rot = computed.temperature[place], in_place(computed.rotational_temperature)
    if T_rot is not None:
        T_rot = jnp.where(since >= 0, T_rot, gas.value("rotational_temperature") ** 2 / T_rot)
    return CoolingCurve(
        times=since,
        temperature=jnp.where(since >= 0, T, gas.temperature**2 / T),
        sonine=in_place(computed.sonine),
        collisions=in_place(computed.collisions),
        rotational_temperature=T_rot,
        status=computed.status,
    )


def uses_rotation(gas: Gas, curve: CoolingCurve) -> bool:
    """Whether a fit uses a measured T_rot: where its errors are known, and those of T to weigh it
    with, and the spheres are rough."""
    return curve.rotational_temperature is not None and unused_rotation(gas, curve) is None


def clock_of_few(gas: Gas, num_particles: Float[Array, ""]) -> Float[Array, ""]:
    """Factor by which N particles without a total momentum cool faster than many, at the same T.

    Their relative velocities are those of the temperature ``T' = T N/(N-1)``, and each meets N - 1
    others: of ``-d ln T/dt = r(T)`` remains r(T')/r(T), here with the loss ``1 - eps^2`` at the
    impact speed sqrt(2 T): 1 + .6/N for viscoelastic spheres, 1 + .5/N for a constant eps.
    Walls take up momentum, so that between them all N are there.
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

    It must be measured and computed, and its error be known, and that of T to weigh it with.
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
    """Inverse relative errors; 0 where the error is 0: a value that was set, not measured."""
    known = (values > 0) & (error > 0)
    return jnp.where(known, values / jnp.where(known, error, 1.0), 0.0)


def _log_ratio(
    measured: Float[Array, "times"], computed: Float[Array, "times"]
) -> Float[Array, "times"]:
    # Not `computed > 0`: a curve that could not be computed, nan, must not count as a perfect fit.
    positive = (measured > 0) & ~(computed <= 0)
    safe = jnp.where(positive, measured, 1.0), jnp.where(positive, computed, 1.0)
    return jnp.log(safe[0]) - jnp.log(safe[1])


MIN_RESIDUALS = 4
"""Residuals below which no correlation is estimated."""

OUTLIER = 3.0
"""Distance from the median, in standard deviations, beyond which a residual is clipped."""

MAX_CORRELATION = 0.95
"""Largest correlation that is taken over from an estimate."""


@eqx.filter_jit
def neighbour_correlation(
    residuals: Num[Array, "n"], used: Bool[Array, "n"] | None = None
) -> Float[Array, ""]:
    """Correlation of neighbouring residuals, outliers clipped; from -.95 to .95.

    Args:
        residuals: in the order of time.
        used: which of them count, by default those that are not 0.
    """
    used = residuals != 0 if used is None else used
    number = jnp.sum(used)
    packed = jnp.argsort(~used, stable=True)
    known = jnp.where(used, residuals, jnp.nan)[packed]
    spread = OUTLIER * jnp.nanstd(known)
    middle = jnp.nanmedian(known)
    clipped = jnp.clip(known, middle - spread, middle + spread)
    centred = jnp.nan_to_num(clipped - jnp.nanmean(clipped))
    square = jnp.sum(centred**2)
    enough = (number >= MIN_RESIDUALS) & (square > 0)
    correlation = jnp.sum(centred[1:] * centred[:-1]) / jnp.where(enough, square, 1.0)
    return jnp.clip(jnp.where(enough, correlation, 0.0), -MAX_CORRELATION, MAX_CORRELATION)


def runs_test(residuals: Num[np.ndarray, "n"]) -> tuple[int, float, float]:
    """Wald & Wolfowitz's test of the runs of one sign in a sequence.

    Of ``a`` positive and ``b`` negative residuals in random order, n in all, the number of runs has
    the mean ``m = 1 + 2 a b/n`` and the variance ``(m - 1)(m - 2)/(n - 1)``; it is taken for
    Gaussian.

    Args:
        residuals: in the order of time; those that are 0 do not count.

    Returns:
        The number of runs, m, and the probability of so few by chance; 1 for fewer than `FEWEST`
        residuals and where all have one sign.
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
        residuals: over their errors, of the best fit; 0 where a point is not used.
        num_parameters: of that fit.
    """
    degrees = jnp.maximum(jnp.sum(residuals != 0) - num_parameters, 1)
    reduced = jnp.sum(residuals**2) / degrees
    return correlation_factor(neighbour_correlation(residuals)) ** 2 * jnp.maximum(reduced, 1.0)


REPLICA_QUANTITIES = {
    "measurement": "temperature",
    "rotation": "rotational_temperature",
    "displacement": "displacement",
}
"""Fields of a curve that have errors, by the names of `jaxgran.fitting.residuals.Comparison`."""

POINTS_EACH = 6
"""Fewest points for each coefficient of the smooth course of an error."""

ITERATIONS = 60
"""Of the fit of that course, whose steps are at most 1 in the logarithm of a variance."""


def smooth_errors(
    curve: CoolingCurve, replicas: int
) -> tuple[CoolingCurve, dict[str, Float[Array, ""]]]:
    """The curve with errors that are smooth along it, and how many degrees of freedom they have.

    The relative variance of each point, from R replicas, has R - 1 degrees of freedom and scatters
    by ``sqrt(2/(R - 1))``: weights by it favour points that agree by chance. Its expectation is
    taken to be smooth, ``ln variance`` a parabola in the number of the point (a line or a constant
    for few points), fitted by maximum likelihood of the chi^2 distribution of the R - 1 degrees;
    all points together have ``(R - 1) n (1 - c)/(1 + c)`` degrees, c being the correlation of
    neighbours' variances, by which a chi^2 has the F distribution.

    Args:
        curve: with errors of means over the replicas; one without errors is returned as it is.
        replicas: R; with 1, errors are taken for known exactly.

    Returns:
        The curve, and the degrees of freedom of the errors by quantity; {} where they are exact.
    """
    if replicas < 2 or curve.temperature_error is None:
        return curve, {}
    smooth, degrees = {}, {}
    for name, field in REPLICA_QUANTITIES.items():
        values, error = getattr(curve, field), getattr(curve, f"{field}_error")
        if values is None or error is None:
            continue
        found = _smoothed(values, error, number(replicas))
        smooth[f"{field}_error"], degrees[name] = found
    return replace(curve, **smooth), degrees


@eqx.filter_jit
def _smoothed(
    values: Float[Array, "n"], error: Float[Array, "n"], replicas: Float[Array, ""]
) -> tuple[Float[Array, "n"], Float[Array, ""]]:
    """Smooth errors of values, and their degrees of freedom."""
    used = (values > 0) & (error > 0)
    share = jnp.where(used, error, 1.0) / jnp.where(used, values, 1.0)
    expected, own = _variance_along(share**2, used)
    return jnp.where(used, values * jnp.sqrt(expected), 0.0), (replicas - 1) * jnp.maximum(own, 1.0)


def _variance_along(
    variance: Float[Array, "n"], used: Bool[Array, "n"]
) -> tuple[Float[Array, "n"], Float[Array, ""]]:
    """The expectation of variances along a curve, and the number of independent points."""
    place = jnp.linspace(-1.0, 1.0, variance.size, dtype=variance.dtype)
    powers = min(2, variance.size // POINTS_EACH - 1)
    design = jnp.stack([place**k for k in range(max(powers, 0) + 1)], axis=1)
    onto = jnp.linalg.pinv(design * used[:, None])

    def step(_, coefficients: Array) -> Array:
        excess = jnp.where(used, variance * jnp.exp(-design @ coefficients) - 1, 0.0)
        return coefficients + jnp.clip(onto @ excess, -1.0, 1.0)

    number = jnp.maximum(jnp.sum(used), 1)
    mean = jnp.sum(jnp.where(used, variance, 0.0)) / number
    tiny = jnp.finfo(variance.dtype).tiny
    first = jnp.zeros(design.shape[1], variance.dtype).at[0].set(jnp.log(jnp.maximum(mean, tiny)))
    expected = jnp.exp(design @ jax.lax.fori_loop(0, ITERATIONS, step, first))
    correlation = jnp.maximum(neighbour_correlation(variance / expected - 1, used), 0.0)
    return expected, number * (1 - correlation) / (1 + correlation)


def log_temperatures(curve: CoolingCurve, rotation: bool) -> Float[Array, "*replicas points"]:
    """ln T at all times, and after it ln T_rot if a search uses it."""
    values = [jnp.log(curve.temperature)]
    if rotation:
        assert curve.rotational_temperature is not None
        values.append(jnp.log(curve.rotational_temperature))
    return jnp.concatenate(values, axis=-1)
