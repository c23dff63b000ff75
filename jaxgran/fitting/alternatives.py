"""Alternative explanations of a measured curve, and the range of the parameters over them.

Each alternative adds a loss of energy, or an error of the measurement, to the fitted model. Its
amplitude is varied from 0 until it explains almost the whole curve, and the free parameters are
fitted again for each amplitude. chi^2 as a function of the amplitude shows whether the data prefer
the alternative, or exclude it; otherwise the parameters are only as certain as the amplitude.

T(t) is computed by quadrature, with a cooling rate that is a function of T alone. This is much
cheaper than the differential equations of `jaxgran.KineticTheory`, but its a_2 always has the value
to which it relaxes, whereas the equations follow it from 0.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.optimise import least_squares
from jaxgran.fitting.parameters import START_TIME, Parameters, Priors, domain_of, size_of
from jaxgran.fitting.residuals import chi2_scale
from jaxgran.fitting.result import Fit
from jaxgran.scene.elements import Rough
from jaxgran.scene.gas import Gas
from jaxgran.scene.laws import ConstantRestitution
from jaxgran.scene.reduced import reduced_scene
from jaxgran.theory import averages
from jaxgran.theory.equations import element_rates, scene_at_start

PREFERRED_CHI2 = 6.63
"""Decrease of chi^2 above which the data prefer an alternative (1 % by chance)."""

ALLOWED_CHI2 = 3.84
"""Increase of chi^2 over its minimum up to which an amplitude is allowed (5 % by chance)."""

DISTINGUISHABLE_SHARE = 0.1
"""Relative change of an estimate below which an allowed alternative is negligible."""

SHARES = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.97, 0.995)
"""Amplitudes of an added loss, as shares of the initial cooling rate, and of a noise floor, as
shares of the last temperature."""

DRAG_SHARES = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 0.9)
"""Amplitudes of drag, as shares of the initial cooling rate; its share grows as the gas cools."""

ROUGHNESS = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 1.9)
"""Values of 1 + beta_t of rough spheres."""

DELAYS = (0.003, 0.01, 0.03, 0.1, 0.3, -0.001, -0.003, -0.01, -0.03, -0.1, -0.3)
"""Errors of the start of the clock, over the initial cooling time."""

EXTRA_DECADES = (0.5, 1.0, 2.0, 3.0)
"""Numbers of further decades of T that are tried to distinguish alternatives."""

MAX_STEPS = 30
"""Maximum number of iterations of each search."""

NUM_NODES = 192
"""Number of temperatures in the table of T(t)."""

NUM_RATE_NODES = 20
"""Number of temperatures at which the cooling rate is computed; ln rate is a polynomial of ln T."""

NUM_RELAXATION_STEPS = 3
"""Number of Newton steps for the value to which a_2 relaxes."""

Kind = tuple[str, str, tuple[float, ...]]
"""Name of an alternative, its field of `AddedTerms`, and its amplitudes."""


class Alternative(NamedTuple):
    """Alternative to a fitted law.

    Attributes:
        name: description of the added term.
        amplitude: the best amplitude, see `AddedTerms`.
        allowed: the smallest and the largest amplitude that the data allow.
        improvement: decrease of chi^2 from the fitted law to the best amplitude, over the scale of
            chi^2 (1 for independent errors of the given size).
        estimate: estimate of the free parameters at the best amplitude, SI.
        low, high: range of each free parameter over the allowed amplitudes, SI, 95 %.
        preferred: True if the data prefer this alternative to the fitted law (1 % by chance).
        distinguishable: True if the data distinguish the alternative from the fitted law: it
            changes the first parameter by less than 10 % beyond the error of the fitted law.
        error_reduction_needed: factor by which the errors must decrease to distinguish it; 1 if it
            is distinguishable.
        decades: number of further decades of T that must be measured, with the same errors and as
            many points per decade, to distinguish it; 0 if it is distinguishable, inf if more than
            the largest of `EXTRA_DECADES` are needed, nan if this was not computed.
    """

    name: str
    amplitude: float
    allowed: tuple[float, float]
    improvement: float
    estimate: Float[np.ndarray, "p"]
    low: Float[np.ndarray, "p"]
    high: Float[np.ndarray, "p"]
    preferred: bool
    distinguishable: bool
    error_reduction_needed: float
    decades: float


class AddedTerms(NamedTuple):
    """Terms added to a fitted law; each field is a number, or an array with one for each trial.

    Attributes:
        constant: share of the initial cooling rate due to a loss of a constant share of the energy
            in each impact, ``T^(1/2)``: constant restitution, walls, friction.
        drag: share of the initial cooling rate due to linear drag, independent of T.
        floor: noise in T, over the last measured temperature.
        rough: 1 + beta_t of rough spheres that do not rotate at t = 0.
        delay: time after t = 0 at which the clock was started, over the initial cooling time.
    """

    constant: Float[Array, "*trials"]
    drag: Float[Array, "*trials"]
    floor: Float[Array, "*trials"]
    rough: Float[Array, "*trials"]
    delay: Float[Array, "*trials"]


class AlternativeFits(NamedTuple):
    """Results of the fits of all trials."""

    chi2: Float[Array, "trials"]
    estimate: Float[Array, "trials p"]
    error: Float[Array, "trials p"]
    residuals: Float[Array, "trials times"]


def compare_alternatives(result: Fit, curve: CoolingCurve) -> tuple[Alternative, ...]:
    """Compare a fitted law with its alternatives, using T alone.

    T(t) is computed by quadrature; the difference of the fitted model from that is added to all
    trials.

    Args:
        result: a fit of one curve by `jaxgran.fit`.
        curve: the measured curve.

    Returns:
        The alternatives, those that fit best first; () if the fitted gas does not cool or is
        driven, so that T(t) has no quadrature, or if parameters of its elements were free, whose
        losses are degenerate with the alternatives.
    """
    if free_element_parameters(result) or result.gas.drive is not None:
        return ()
    kinds = _kinds(result)
    residuals = np.asarray(result.residuals)
    weights = np.where(residuals != 0, np.asarray(result.weights), 0.0)
    measured = np.log(curve.temperature)
    fitted = measured - residuals / np.where(weights > 0, weights, 1.0)
    ratios, T_rot = np.zeros_like(measured), result.curve.rotational_temperature
    if T_rot is not None:
        ratios = np.asarray(T_rot) / np.asarray(result.curve.temperature)
    columns = _padded(np.asarray(curve.times), measured, weights, fitted)
    rows = columns[0].size - ratios.size
    columns[3] = np.pad(fitted, (0, rows), "edge")
    columns.append(np.pad(ratios, (0, rows), "edge"))
    fits = _fit_kinds(result, kinds, columns)
    if not np.isfinite(fits.chi2[0]):
        return ()
    best = fits.residuals[int(np.nanargmin(fits.chi2))]
    scale = float(chi2_scale(jnp.asarray(best), len(result.names)))
    # Errors that the trials, which have no noise, do not include.
    parts = [result.error_budget.get(part, 0.0) for part in ("simulation", "few particles")]
    noise = np.hypot(*map(np.asarray, parts)) / scale**0.5
    fits = fits._replace(error=np.hypot(fits.error, noise))
    positive = _is_positive(result)
    alternatives = summarise_alternatives(kinds, fits, scale, positive)
    alternatives = _with_decades(result, kinds, columns, scale, alternatives)
    return tuple(sorted(alternatives, key=lambda alternative: -alternative.improvement))


def ranges_over_alternatives(
    result: Fit, alternatives: tuple[Alternative, ...]
) -> dict[str, tuple[Float[np.ndarray, "size"], Float[np.ndarray, "size"]]]:
    """Return the 95 % range of each free parameter over all alternatives that fit best.

    These are the alternatives whose improvement is within `ALLOWED_CHI2` of the largest one.

    Args:
        result: a fit by `jaxgran.fit`.
        alternatives: its alternatives.
    """
    best = max(alternative.improvement for alternative in alternatives)
    as_good = [a for a in alternatives if a.improvement >= best - ALLOWED_CHI2]
    low = np.min([a.low for a in as_good], axis=0)
    high = np.max([a.high for a in as_good], axis=0)
    sizes = [size_of(result.gas, name) for name in result.names]
    parts = (np.split(x, np.cumsum(sizes)[:-1]) for x in (low, high))
    return dict(zip(result.names, zip(*parts, strict=True), strict=True))


def free_element_parameters(result: Fit) -> tuple[str, ...]:
    """Return the free parameters that are floats of the elements of the scene."""
    plain = dataclasses.replace(result.gas, surface=None, container=None, drag=None, drive=None)
    return tuple(name for name in result.names if name not in (*plain.domains, START_TIME))


def _kinds(result: Fit) -> list[Kind]:
    """Return the kinds of alternatives to a fit."""
    kinds: list[Kind] = [
        ("linear drag, as in air", "drag", DRAG_SHARES),
        ("a noise floor in T", "floor", SHARES),
    ]
    elements = result.gas.elements
    if not isinstance(result.gas.law, ConstantRestitution):
        name = "an additional loss at constant eps"
        causes = {"container": "walls", "surface": "rough grains"}
        possible = [cause for element, cause in causes.items() if element not in elements]
        name += f", as by {' or '.join(possible)}" if possible else ""
        kinds.insert(0, (name, "constant", SHARES))
    if "surface" not in elements:
        kinds.append(("rough grains without initial rotation", "rough", ROUGHNESS))
    is_start_known = START_TIME not in (*result.names, *result.priors.names)
    if "temperature" not in result.names and is_start_known:
        kinds.append(("an error of the start time or of T_0", "delay", DELAYS))
    return kinds


def _trials(kinds: list[Kind]) -> AddedTerms:
    """Return no added terms, then each amplitude of each kind."""
    rows = [np.zeros(len(AddedTerms._fields))]
    for _, field, amplitudes in kinds:
        terms = np.zeros((len(amplitudes), len(AddedTerms._fields)))
        terms[:, AddedTerms._fields.index(field)] = amplitudes
        rows += list(terms)
    return AddedTerms(*map(jnp.asarray, np.array(rows).T))


def _padded(times: np.ndarray, *columns: np.ndarray) -> list[np.ndarray]:
    """Pad columns to a power of two, so that curves of many lengths share a compiled program."""
    rows = max(32, 2 ** (times.size - 1).bit_length()) - times.size
    return [np.pad(times, (0, rows), "edge"), *(np.pad(column, (0, rows)) for column in columns)]


def _is_positive(result: Fit) -> np.ndarray:
    """Return True for the free numbers that cannot be negative."""
    names = [name for name in result.names for _ in range(size_of(result.gas, name))]
    return np.array([domain_of(result.gas, name).low >= 0 for name in names])


def _fit_kinds(result: Fit, kinds: list[Kind], columns: list[np.ndarray]) -> AlternativeFits:
    """Fit all alternatives, with all amplitudes, to columns t, ln T, weights, ln T and T_rot/T."""
    fits = fit_alternatives(
        result.gas,
        result.start_time,
        result.names,
        *map(jnp.asarray, columns),
        trials=_trials(kinds),
        accuracy=jnp.asarray(np.max(result.clock_error)),
        priors=result.priors,
    )
    return jax.tree.map(np.asarray, fits)


def _with_decades(
    result: Fit,
    kinds: list[Kind],
    columns: list[np.ndarray],
    scale: float,
    alternatives: list[Alternative],
) -> list[Alternative]:
    """Add the number of further decades of T that would distinguish the alternatives.

    The fitted law is extrapolated by ``T = T_0 (1 + t/tau)^(-p)``, with tau from the last measured
    point, through the further decades of T, with the same errors and number of points per decade;
    the alternatives are then fitted to that.
    """
    decades = [0.0 if alternative.distinguishable else np.nan for alternative in alternatives]
    # If measured and modelled ln T are equal, `fit_alternatives` needs them only for their range.
    power = 2.0 if isinstance(result.gas.law, ConstantRestitution) else 5 / 3
    T_0 = float(np.log(result.gas.temperature))
    used = columns[2] > 0
    start, last = float(result.start_time), float(columns[0][used][-1])
    cooled = T_0 - float(columns[3][used][-1])
    all_distinguishable = all(alternative.distinguishable for alternative in alternatives)
    if not all_distinguishable and cooled > 0 and not result.gas.elements:
        tau = (last - start) / np.expm1(cooled / power)
        weight, number = np.sqrt(np.mean(columns[2][used] ** 2)), int(used.sum())
        for further in EXTRA_DECADES:
            depth = np.linspace(0.0, cooled + further * np.log(10.0), columns[0].size)
            times = np.maximum(start + tau * np.expm1(depth / power), 0.0)
            density = number * depth[-1] / cooled / depth.size
            weights = np.full(depth.size, weight * density**0.5)
            rows = [times, T_0 - depth, weights, T_0 - depth, np.zeros(depth.size)]
            fits = _fit_kinds(result, kinds, rows)
            longer = summarise_alternatives(kinds, fits, scale, _is_positive(result))
            for i, alternative in enumerate(longer):
                if np.isnan(decades[i]) and alternative.distinguishable:
                    decades[i] = further
            if not np.any(np.isnan(decades)):
                break
        decades = [np.inf if np.isnan(x) else x for x in decades]
    pairs = zip(alternatives, decades, strict=True)
    return [alternative._replace(decades=x) for alternative, x in pairs]


def summarise_alternatives(
    kinds: list[Kind], fits: AlternativeFits, scale: float, positive: Bool[np.ndarray, "p"]
) -> list[Alternative]:
    """Return the alternatives, from the fits of all trials, in the order of their kinds."""
    alternatives, begin = [], 1
    for name, _, amplitudes in kinds:
        rows = np.array([0, *range(begin, begin + len(amplitudes))])
        order = np.argsort([0.0, *amplitudes])
        in_order = np.array([0.0, *amplitudes])[order]
        alternatives.append(_alternative(name, in_order, fits, rows[order], scale, positive))
        begin += len(amplitudes)
    return alternatives


def _alternative(
    name: str,
    amplitudes: Float[np.ndarray, "rows"],
    fits: AlternativeFits,
    rows: np.ndarray,
    scale: float,
    positive: Bool[np.ndarray, "p"],
) -> Alternative:
    """Return an alternative, from the rows of the fits with its amplitudes in increasing order.

    chi^2 and the estimates are interpolated between the amplitudes.
    """
    all_chi2 = np.where(np.isfinite(fits.chi2), fits.chi2, np.inf)
    chi2 = np.where(np.isfinite(all_chi2[rows]), all_chi2[rows], 1e30)
    margin = 1.96 * scale**0.5 * fits.error
    fine = np.linspace(0, len(rows) - 1, 40 * (len(rows) - 1) + 1)

    def interpolate(values):
        return np.interp(fine, np.arange(len(rows)), values)

    allowed = interpolate(chi2) <= chi2.min() + ALLOWED_CHI2 * scale
    estimate, margins = fits.estimate[rows], margin[rows]
    columns = range(estimate.shape[1])
    low = [interpolate(estimate[:, k] - margins[:, k])[allowed].min() for k in columns]
    high = [interpolate(estimate[:, k] + margins[:, k])[allowed].max() for k in columns]
    fitted, fitted_margin = fits.estimate[0, 0], margin[0, 0]
    wider = max(fitted - fitted_margin - low[0], high[0] - fitted - fitted_margin) / abs(fitted)
    improvement = float((all_chi2[0] - chi2.min()) / scale)
    allowed_amplitudes = interpolate(amplitudes)[allowed]
    return Alternative(
        name=name,
        amplitude=float(amplitudes[np.argmin(chi2)]),
        allowed=(float(allowed_amplitudes.min()), float(allowed_amplitudes.max())),
        improvement=improvement,
        estimate=np.array(estimate[np.argmin(chi2)]),
        low=np.where(positive, np.maximum(low, 0.0), low),
        high=np.array(high),
        preferred=improvement > PREFERRED_CHI2,
        distinguishable=bool(wider < DISTINGUISHABLE_SHARE),
        error_reduction_needed=float(max(wider / DISTINGUISHABLE_SHARE, 1.0)),
        decades=float("nan"),
    )


@eqx.filter_jit
def fit_alternatives(
    gas: Gas,
    start_time: Float[Array, ""],
    names: tuple[str, ...],
    times: Float[Array, "times"],
    measured: Float[Array, "times"],
    weights: Float[Array, "times"],
    modelled: Float[Array, "times"],
    ratios: Float[Array, "times"],
    trials: AddedTerms,
    accuracy: Float[Array, ""],
    priors: Priors,
) -> AlternativeFits:
    """Fit the free parameters with each set of added terms.

    Args:
        gas, start_time, names: the fitted gas and t0, and the names of the free parameters.
        times, measured, weights: t, ln T and inverse relative errors, which are 0 where a point is
            not used.
        modelled, ratios: ln T and T_rot/T of the fitted model; T_rot is 0 for smooth spheres.
        trials: the added terms.
        accuracy: relative error of the model's cooling rate, of its mean and of its trend in ln T.
        priors: the priors of the fit.
    """
    varied, used = (*names, *priors.extra_parameters(names)), weights > 0
    parameters = Parameters(gas, varied, times[-1])
    lowest = jnp.min(jnp.where(used, measured, jnp.inf))
    depth = jnp.max(jnp.where(used, measured, -jnp.inf)) - lowest + 2.0

    def log_T_of(terms: AddedTerms, flat: Array, mean: ArrayLike, trend: ArrayLike) -> Array:
        changed = parameters.gas(flat)
        log_theta, rate = relaxed_cooling_rate(changed, depth)
        if changed.elements:
            ratio = jnp.interp(-log_theta - jnp.log(changed.temperature), -modelled, ratios)
            rate = rate + cooling_by_elements(changed, log_theta, ratio)
        rate_error = accuracy.astype(rate.dtype) * (mean + trend * (2 * log_theta / depth + 1))
        rate = rate * jnp.exp(rate_error)
        elapsed = times - parameters.start(flat) + terms.delay / rate[0]
        total_rate = rate + _added_rate(changed, terms, log_theta, rate)
        cooled = _log_temperature(log_theta, total_rate, elapsed)
        floor = jnp.log(jnp.maximum(terms.floor, jnp.finfo(rate.dtype).tiny))
        return jnp.logaddexp(jnp.log(changed.temperature) + cooled, floor + lowest)

    # The difference of the fitted model and the table is added to all trials.
    nothing = AddedTerms(*(jnp.zeros(()) for _ in AddedTerms._fields))
    offset = modelled - log_T_of(nothing, parameters.flat(gas, start_time), 0.0, 0.0)

    def fit_one(terms: AddedTerms) -> AlternativeFits:
        def residuals(unknowns: Array) -> Array:
            flat, errors = unknowns[:-2], unknowns[-2:]
            differences = measured - offset - log_T_of(terms, flat, *errors)
            of_priors = priors.residuals(parameters.gas(flat), parameters.start(flat))
            return jnp.concatenate([weights * jnp.where(used, differences, 0.0), of_priors, errors])

        first = parameters.flat(_guess(gas, names, terms), start_time)
        unknowns = least_squares(residuals, jnp.pad(first, (0, 2)), MAX_STEPS)[0]
        value, estimates = residuals(unknowns), parameters.estimates(unknowns[:-2])
        error = _errors(parameters, unknowns[:-2], jax.jacfwd(residuals)(unknowns))
        free = slice(sum(size_of(gas, name) for name in names))
        return AlternativeFits(jnp.sum(value**2), estimates[free], error[free], value[: times.size])

    return jax.lax.map(fit_one, trials)  # a batch of searches takes twice as long to compile


def _added_rate(
    gas: Gas, terms: AddedTerms, log_theta: Float[Array, "table"], rate: Float[Array, "table"]
) -> Float[Array, "table"]:
    added = terms.constant * jnp.exp(log_theta / 2) + terms.drag
    added = added / (1 - terms.constant - terms.drag) * rate[0]
    if gas.surface is None:
        added = added + cooling_by_roughness(_with_roughness(gas, terms), log_theta, rate + added)
    return added


def _with_roughness(gas: Gas, terms: AddedTerms) -> Gas:
    return dataclasses.replace(gas, surface=Rough(terms.rough - 1))


def _log_temperature(
    log_theta: Float[Array, "table"], rate: Float[Array, "table"], times: Float[Array, "times"]
) -> Float[Array, "times"]:
    """Return ln(T/T_0) from a table of cooling rates, with the first rate before t = 0."""
    cooled = log_temperature_by_quadrature(log_theta, rate, jnp.maximum(times, 0.0))
    return cooled - rate[0] * jnp.minimum(times, 0.0)


def _errors(
    parameters: Parameters, flat: Float[Array, "q"], jacobian: Float[Array, "residuals unknowns"]
) -> Float[Array, "q"]:
    """Standard errors, SI, of the parameters, which are the first of all unknowns."""
    slope = jnp.pad(jax.jacfwd(parameters.estimates)(flat), ((0, 0), (0, 2)))
    covariance = slope @ jnp.linalg.pinv(jacobian.T @ jacobian) @ slope.T
    return jnp.sqrt(jnp.maximum(jnp.diag(covariance), 0.0))


def _guess(gas: Gas, names: tuple[str, ...], terms: AddedTerms) -> Gas:
    """Reduce A so that the initial cooling rate with the added terms is about the fitted one."""
    if "dissipative_constant" not in names:
        return gas
    share = 1 - terms.constant - terms.drag
    if gas.surface is None:
        loss = 1 - gas.reduced_law.restitution(jnp.ones_like(gas.temperature)) ** 2
        surface = reduced_scene(_with_roughness(gas, terms)).surface
        assert surface is not None
        share = share / (1 + 4 * surface.eta * (1 - surface.eta) / loss)
    return gas.replace(dissipative_constant=gas.value("dissipative_constant") * share)


def _interpolation(num_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Chebyshev nodes in [0, 1], and the matrix that interpolates to evenly spaced nodes."""
    nodes = 0.5 - 0.5 * np.cos((np.arange(NUM_RATE_NODES) + 0.5) * np.pi / NUM_RATE_NODES)
    series = np.polynomial.chebyshev.chebvander
    even = np.linspace(-1.0, 1.0, num_nodes)
    return nodes, series(even, NUM_RATE_NODES - 1) @ np.linalg.inv(
        series(2 * nodes - 1, NUM_RATE_NODES - 1)
    )


_RATE_NODES, _INTERPOLATION = _interpolation(NUM_NODES)


def relaxed_cooling_rate(
    gas: Gas, depth: Float[Array, ""]
) -> tuple[Float[Array, "nodes"], Float[Array, "nodes"]]:
    """``-d ln T/dt``, 1/s, of a gas of hard spheres whose a_2 has relaxed.

    Args:
        gas: the scene.
        depth: ln(T/T_0) ranges from 0 to ``-depth``.

    Returns:
        ln(T/T_0) at `NUM_NODES` evenly spaced nodes, and the rate there.
    """
    d, law = gas.dimension, gas.reduced_law

    def rate(log_theta):
        speed = jnp.exp(log_theta / 2)
        coefficients = averages.impact_moments(law, speed, d)

        def drift(a2):
            rates = averages.Rates.from_averages(coefficients, a2)
            return 4 / d * rates.cooling * (1 + a2) - 4 / (d * (d + 2)) * rates.fourth_moment

        a2 = jnp.zeros_like(speed)
        for _ in range(NUM_RELAXATION_STEPS):
            value, slope = jax.jvp(drift, (a2,), (jnp.ones_like(a2),))
            a2 = a2 - value / slope
        cooling = 2 / d * averages.Rates.from_averages(coefficients, a2).cooling * speed
        return cooling

    # NumPy casts the constants to the precision of the program.
    rate_nodes, interpolation = (
        jnp.asarray(x.astype(depth.dtype)) for x in (_RATE_NODES, _INTERPOLATION)
    )
    at_nodes = jax.vmap(rate)(-depth * rate_nodes)
    even = jnp.exp(interpolation @ jnp.log(at_nodes))
    return -depth * jnp.linspace(0.0, 1.0, NUM_NODES), even * gas.impact_speed / gas.path_length


def cooling_by_elements(
    gas: Gas, log_theta: Float[Array, "nodes"], ratio: Float[Array, "nodes"]
) -> Float[Array, "nodes"]:
    """Contribution of roughness, walls and drag to ``-d ln T/dt``, 1/s.

    Args:
        gas: the scene.
        log_theta: ln(T/T_0).
        ratio: T_rot/T at these temperatures; ignored for smooth spheres.
    """
    scene = scene_at_start(gas)
    nothing = jnp.zeros((), log_theta.dtype)

    def cooling(log_theta, ratio):
        speed = jnp.exp(log_theta / 2)
        return element_rates(scene, speed, ratio, nothing, gas.dimension).cooling

    return jax.vmap(cooling)(log_theta, ratio) * gas.impact_speed / gas.path_length


def cooling_by_roughness(
    gas: Gas, log_theta: Float[Array, "nodes"], rate: Float[Array, "nodes"]
) -> Float[Array, "nodes"]:
    """Contribution of roughness to ``-d ln T/dt``, 1/s, with T_rot integrated along the cooling.

    Integrates ``d(T_rot/T)/ds = (dT_rot/dt)/(T L) + T_rot/T`` over ``s = -ln(T/T_0)``, from the
    initial T_rot of the gas, where L is the total cooling rate; the steps from node to node are
    implicit in T_rot/T.

    Args:
        gas: a gas of rough spheres.
        log_theta: ln(T/T_0) at evenly spaced nodes, decreasing from 0.
        rate: ``-d ln T/dt`` at the nodes due to everything but roughness, 1/s.
    """
    scene = reduced_scene(gas)._replace(walls=None, drag=None, drive=None)
    nothing, unit = jnp.zeros((), log_theta.dtype), gas.impact_speed / gas.path_length

    def rates_at(log_theta, ratio):
        at = element_rates(scene, jnp.exp(log_theta / 2), ratio, nothing, gas.dimension)
        return jnp.stack([at.cooling, at.rotation]) * unit

    def advance(ratio, node):
        other, (cooling, rotation), (cooling_of_1, rotation_of_1) = node
        loss = cooling + ratio * (cooling_of_1 - cooling)
        total = other + loss
        decay = -(rotation_of_1 - rotation) / total - 1
        next_ratio = (ratio + step * rotation / total) / (1 + step * decay)
        return next_ratio, loss

    step = log_theta[0] - log_theta[1]
    # Both changes are linear in T_rot/T.
    ends = [jax.vmap(rates_at, (0, None))(log_theta, nothing + ratio) for ratio in (0.0, 1.0)]
    first = gas.value("rotational_temperature") / gas.temperature
    return jax.lax.scan(advance, first, (rate, *ends))[1]


def log_temperature_by_quadrature(
    log_theta: Float[Array, "nodes"], rate: Float[Array, "nodes"], times: Float[Array, "times"]
) -> Float[Array, "times"]:
    """ln(T/T_0) at given times of a gas with a given cooling rate.

    Integrates ``t = int dy / rate(y)`` over y = -ln(T/T_0); between two nodes the rate is a power
    of T.

    Args:
        log_theta: ln(T/T_0) at the nodes, decreasing from 0.
        rate: ``-d ln T/dt`` at the nodes, > 0.
        times: t, >= 0. After the last node ln T is constant.
    """
    time = 1 / rate
    growth = jnp.log(time[1:] / time[:-1])
    small = jnp.abs(growth) < 1e-4
    mean = jnp.where(
        small, 0.5 * (time[1:] + time[:-1]), jnp.diff(time) / jnp.where(small, 1.0, growth)
    )
    elapsed = jnp.cumsum(-jnp.diff(log_theta) * mean)
    # Interpolate in ln(1 + t/t_0), where the curve is almost straight.
    nodes = jnp.concatenate([jnp.zeros(1), jnp.log1p(elapsed * rate[0])])
    return jnp.interp(jnp.log1p(times * rate[0]), nodes, log_theta)
