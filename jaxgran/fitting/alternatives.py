"""Rivals of a fitted law: what else could have made a measured curve, and what A would then be.

Each rival adds a loss of energy, or an error of the measurement, to the fitted model. Its amplitude
is varied from nothing to all of the curve while the free parameters are fitted anew. chi^2 as a
function of the amplitude says whether the curve asks for the rival, or excludes it; where it does
neither, the parameters are known only as well as the amplitude is.

T(t) of a homogeneous gas by quadrature, where the cooling rate is a function of T alone.

A table of ln T over time, much cheaper than the differential equations of
`jaxgran.models.KineticTheory`: it serves to compare many laws of cooling. Its a_2 has always the
value that it relaxes to, where the equations follow it from 0.

Fits of a curve by the fitted law and something besides, of a given amplitude.

What a rival of a fitted law is found to be, from the fits with each of its amplitudes.
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
        coefficients = averages.impact_moments(law, speed, d)

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
        return element_rates(scene, speed, ratio, nothing, gas.dimension).cooling

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
        at = element_rates(alone, jnp.exp(log_theta / 2), ratio, nothing, gas.dimension)
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


def log_temperature_by_quadrature(
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


MAX_STEPS = 30
"""Steps of each search."""


class AddedTerms(NamedTuple):
    """What is added to a fitted law, each field a number or an array of one for each trial.

    Attributes:
        constant: share of the first cooling rate that is a loss of a fixed share of the energy in
            each impact, ``T^(1/2)``: constant restitution, walls, friction.
        drag: share of it that is linear drag, independent of T.
        floor: noise in T, over the last measured temperature.
        rough: 1 + beta_t of rough spheres that do not rotate at t = 0.
        delay: time after t = 0 at which the clock was started, over the first cooling time.
    """

    constant: Float[Array, "*trials"]
    drag: Float[Array, "*trials"]
    floor: Float[Array, "*trials"]
    rough: Float[Array, "*trials"]
    delay: Float[Array, "*trials"]


class AlternativeFits(NamedTuple):
    """Fits of all trials."""

    chi2: Float[Array, "trials"]
    estimate: Float[Array, "trials p"]
    error: Float[Array, "trials p"]
    residuals: Float[Array, "trials times"]


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
    """Fits of all trials.

    Args:
        gas, began, names: as fitted, and the free parameters.
        times, measured, weights: t, ln T and inverse relative errors; 0 where a point is not used.
        modelled, ratios: ln T and T_rot/T of the fitted model; T_rot is 0 of smooth spheres.
        trials, priors: what is added, and what else is known of the gas.
        accuracy: relative error of the model's cooling rate, of its mean and of its trend in ln T.
    """
    varied, used = (*names, *priors.extra_parameters(names)), weights > 0
    parameters = Parameters(gas, varied, times[-1])
    lowest = jnp.min(jnp.where(used, measured, jnp.inf))
    depth = jnp.max(jnp.where(used, measured, -jnp.inf)) - lowest + 2.0

    def computed(trial: AddedTerms, flat: Array, mean: ArrayLike, trend: ArrayLike) -> Array:
        changed = parameters.gas(flat)
        log_theta, rate = relaxed_cooling_rate(changed, depth)
        if changed.elements:
            ratio = jnp.interp(-log_theta - jnp.log(changed.temperature), -modelled, ratios)
            rate = rate + cooling_by_elements(changed, log_theta, ratio)
        unsure = accuracy.astype(rate.dtype) * (mean + trend * (2 * log_theta / depth + 1))
        rate = rate * jnp.exp(unsure)
        since = times - parameters.start(flat) + trial.delay / rate[0]
        cooled = _continued(log_theta, rate + _added(changed, trial, log_theta, rate), since)
        floor = jnp.log(jnp.maximum(trial.floor, jnp.finfo(rate.dtype).tiny))
        return jnp.logaddexp(jnp.log(changed.temperature) + cooled, floor + lowest)

    nothing = AddedTerms(*(jnp.zeros(()) for _ in AddedTerms._fields))
    beside = modelled - computed(nothing, parameters.flat(gas, start_time), 0.0, 0.0)

    def fitted(trial: AddedTerms) -> AlternativeFits:
        def residuals(unknowns: Array) -> Array:
            flat, errors = unknowns[:-2], unknowns[-2:]
            differences = measured - beside - computed(trial, flat, *errors)
            known = priors.residuals(parameters.gas(flat), parameters.start(flat))
            return jnp.concatenate([weights * jnp.where(used, differences, 0.0), known, errors])

        first = parameters.flat(_guess(gas, names, trial), start_time)
        unknowns = least_squares(residuals, jnp.pad(first, (0, 2)), MAX_STEPS)[0]
        value, estimates = residuals(unknowns), parameters.estimates(unknowns[:-2])
        error = _errors(parameters, unknowns[:-2], jax.jacfwd(residuals)(unknowns))
        free = slice(sum(size_of(gas, name) for name in names))
        return AlternativeFits(jnp.sum(value**2), estimates[free], error[free], value[: times.size])

    return jax.lax.map(fitted, trials)  # a batch of searches takes twice as long to compile


def _added(
    gas: Gas, trial: AddedTerms, log_theta: Float[Array, "table"], rate: Float[Array, "table"]
) -> Float[Array, "table"]:
    """What a trial adds to the cooling rate of a gas."""
    added = trial.constant * jnp.exp(log_theta / 2) + trial.drag
    added = added / (1 - trial.constant - trial.drag) * rate[0]
    if gas.surface is None:
        added = added + cooling_by_roughness(_roughened(gas, trial), log_theta, rate + added)
    return added


def _roughened(gas: Gas, trial: AddedTerms) -> Gas:
    return dataclasses.replace(gas, surface=Rough(trial.rough - 1))


def _continued(
    log_theta: Float[Array, "table"], rate: Float[Array, "table"], times: Float[Array, "times"]
) -> Float[Array, "times"]:
    """ln(T/T_0) of a table of cooling rates; before t = 0 at the first rate."""
    cooled = log_temperature_by_quadrature(log_theta, rate, jnp.maximum(times, 0.0))
    return cooled - rate[0] * jnp.minimum(times, 0.0)


def _errors(
    parameters: Parameters, flat: Float[Array, "q"], jacobian: Float[Array, "residuals unknowns"]
) -> Float[Array, "q"]:
    """Standard errors, SI, of parameters that are the first of all unknowns."""
    slope = jnp.pad(jax.jacfwd(parameters.estimates)(flat), ((0, 0), (0, 2)))
    covariance = slope @ jnp.linalg.pinv(jacobian.T @ jacobian) @ slope.T
    return jnp.sqrt(jnp.maximum(jnp.diag(covariance), 0.0))


def _guess(gas: Gas, names: tuple[str, ...], trial: AddedTerms) -> Gas:
    """The gas whose first cooling rate, with what is added, is about that of the fitted one."""
    if "dissipative_constant" not in names:
        return gas
    share = 1 - trial.constant - trial.drag
    if gas.surface is None:
        loss = 1 - gas.reduced_law.restitution(jnp.ones_like(gas.temperature)) ** 2
        surface = reduced_scene(_roughened(gas, trial)).surface
        assert surface is not None
        share = share / (1 + 4 * surface.eta * (1 - surface.eta) / loss)
    return gas.replace(dissipative_constant=gas.value("dissipative_constant") * share)


PREFERRED_CHI2 = 6.63
"""chi^2 by which a rival must fit better for the curve to ask for it (1 % by chance)."""

ALLOWED_CHI2 = 3.84
"""chi^2 over the best one up to which an amplitude is allowed (5 % by chance)."""

DISTINGUISHABLE_SHARE = 0.1
"""Relative change of an estimate below which an allowed rival does not matter."""


Kind = tuple[str, str, tuple[float, ...]]
"""The words of a rival, its field of `Trial`, and its amplitudes."""


class Alternative(NamedTuple):
    """One rival of a fitted law.

    Attributes:
        name: the words for it.
        amplitude: the best one, see `Trial`.
        allowed: the smallest and the largest amplitude that the curve allows.
        improvement: chi^2 of the fitted law less that of the best amplitude, over the scale of
            chi^2 (1 for independent errors of the given size).
        estimate: of the free parameters at the best amplitude, SI.
        low, high: range of each free parameter over the allowed amplitudes, SI, 95 %.
        asked: whether the curve asks for this rival (1 % by chance).
        told_apart: whether the curve tells the rival apart from the fitted law, so that it changes
            the first parameter by less than 10 %, over the fitted law's own error.
        sharper: factor by which the errors must be smaller to tell it apart; 1 if it is.
        decades: of T through which the gas must be followed further, with as many points in each
            and the same errors, to tell it apart; 0 if it is, inf if more than
            `jaxgran.fitting.alternatives.FURTHER` goes are needed, nan where this was not looked for.
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


def summarise_alternatives(
    kinds: list[Kind], profile: AlternativeFits, scale: float, positive: Bool[np.ndarray, "p"]
) -> list[Alternative]:
    """The rivals in the order of their kinds."""
    found, begin = [], 1
    for name, _, amplitudes in kinds:
        rows = np.array([0, *range(begin, begin + len(amplitudes))])
        order = np.argsort([0.0, *amplitudes])
        each = np.array([0.0, *amplitudes])[order]
        found.append(_alternative(name, each, profile, rows[order], scale, positive))
        begin += len(amplitudes)
    return found


def _alternative(
    name: str,
    amplitudes: Float[np.ndarray, "rows"],
    profile: AlternativeFits,
    rows: np.ndarray,
    scale: float,
    positive: Bool[np.ndarray, "p"],
) -> Alternative:
    """A rival, from those rows of the profile that have its amplitudes, in increasing order.

    Between the amplitudes chi^2 and the estimates are interpolated.
    """
    chi2 = np.where(np.isfinite(profile.chi2), profile.chi2, np.inf)
    own = np.where(np.isfinite(chi2[rows]), chi2[rows], 1e30)
    margin = 1.96 * scale**0.5 * profile.error
    place = np.linspace(0, len(rows) - 1, 40 * (len(rows) - 1) + 1)

    def between(values):
        return np.interp(place, np.arange(len(rows)), values)

    allowed = between(own) <= own.min() + ALLOWED_CHI2 * scale
    estimate, spread = profile.estimate[rows], margin[rows]
    columns = range(estimate.shape[1])
    low = [between(estimate[:, k] - spread[:, k])[allowed].min() for k in columns]
    high = [between(estimate[:, k] + spread[:, k])[allowed].max() for k in columns]
    first, own_margin = profile.estimate[0, 0], margin[0, 0]
    wider = max(first - own_margin - low[0], high[0] - first - own_margin) / abs(first)
    improvement = float((chi2[0] - own.min()) / scale)
    reached = between(amplitudes)[allowed]
    return Alternative(
        name=name,
        amplitude=float(amplitudes[np.argmin(own)]),
        allowed=(float(reached.min()), float(reached.max())),
        improvement=improvement,
        estimate=np.array(estimate[np.argmin(own)]),
        low=np.where(positive, np.maximum(low, 0.0), low),
        high=np.array(high),
        preferred=improvement > PREFERRED_CHI2,
        distinguishable=bool(wider < DISTINGUISHABLE_SHARE),
        error_reduction_needed=float(max(wider / DISTINGUISHABLE_SHARE, 1.0)),
        decades=float("nan"),
    )


SHARES = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.97, 0.995)
"""Amplitudes of an added loss, as shares of the first cooling rate, and of a noise floor, as shares
of the last temperature."""

DRAG_SHARES = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 0.9)
"""The same of drag, which gains on collisions as the gas cools."""

ROUGHNESS = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 1.9)
"""1 + beta_t of rough spheres."""

DELAYS = (0.003, 0.01, 0.03, 0.1, 0.3, -0.001, -0.003, -0.01, -0.03, -0.1, -0.3)
"""Errors of the start of the clock, over the first cooling time."""

FURTHER = (0.5, 1.0, 2.0, 3.0)
"""Decades of T that a gas is followed further, in turn, to see what that would tell."""


def compare_alternatives(result: Fit, curve: CoolingCurve) -> tuple[Alternative, ...]:
    """Compare a fitted law with its rivals, by T alone.

    The course of T comes from `jaxgran.fitting.alternatives`; what the fitted model has besides is
    added to all trials alike.

    Args:
        result: of `jaxgran.fit`, of one curve.
        curve: the measured curve.

    Returns:
        The rivals, those that fit best first; () where the fitted gas does not cool or is driven,
        of which T is not a table of times, or where floats of its elements were free, whose losses
        are such rivals themselves.
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
    profile = _profile(result, kinds, columns)
    if not np.isfinite(profile.chi2[0]):
        return ()
    best = profile.residuals[int(np.nanargmin(profile.chi2))]
    scale = float(chi2_scale(jnp.asarray(best), len(result.names)))
    # What trials, which have no noise of their own, cannot tell.
    beside = [result.error_budget.get(part, 0.0) for part in ("simulation", "few particles")]
    noise = np.hypot(*map(np.asarray, beside)) / scale**0.5
    profile = profile._replace(error=np.hypot(profile.error, noise))
    positive = _positive(result)
    found = summarise_alternatives(kinds, profile, scale, positive)
    found = _with_decades(result, kinds, columns, scale, found)
    return tuple(sorted(found, key=lambda rival: -rival.improvement))


def _profile(result: Fit, kinds: list[Kind], columns: list[np.ndarray]) -> AlternativeFits:
    """Fits of all rivals, with all amplitudes, to rows of t, ln T, weights, ln T and T_rot/T."""
    profile = fit_alternatives(
        result.gas,
        result.start_time,
        result.names,
        *map(jnp.asarray, columns),
        trials=_trials(kinds),
        accuracy=jnp.asarray(np.max(result.clock_error)),
        priors=result.priors,
    )
    return jax.tree.map(np.asarray, profile)


def _positive(result: Fit) -> np.ndarray:
    """Which of the free numbers cannot be negative."""
    names = [name for name in result.names for _ in range(size_of(result.gas, name))]
    return np.array([domain_of(result.gas, name).low >= 0 for name in names])


def _with_decades(
    result: Fit,
    kinds: list[Kind],
    columns: list[np.ndarray],
    scale: float,
    found: list[Alternative],
) -> list[Alternative]:
    """The rivals with the decades of T that would tell them apart.

    The fitted law itself is followed further, by ``T = T_0 (1 + t/tau)^(-p)`` with tau of the last
    measured point, through so many decades of T, with as many points in each decade as there are
    now, of the same errors; and the rivals are fitted to that.
    """
    decades = [0.0 if rival.distinguishable else np.nan for rival in found]
    # Of rows that are the model's own, `fit_trials` needs ln T only for its range.
    power = 2.0 if isinstance(result.gas.law, ConstantRestitution) else 5 / 3
    T_0 = float(np.log(result.gas.temperature))
    used = columns[2] > 0
    start, last = float(result.start_time), float(columns[0][used][-1])
    cooled = T_0 - float(columns[3][used][-1])
    if not all(rival.distinguishable for rival in found) and cooled > 0 and not result.gas.elements:
        tau = (last - start) / np.expm1(cooled / power)
        weight, number = np.sqrt(np.mean(columns[2][used] ** 2)), int(used.sum())
        for further in FURTHER:
            depth = np.linspace(0.0, cooled + further * np.log(10.0), columns[0].size)
            times = np.maximum(start + tau * np.expm1(depth / power), 0.0)
            density = number * depth[-1] / cooled / depth.size
            weights = np.full(depth.size, weight * density**0.5)
            rows = [times, T_0 - depth, weights, T_0 - depth, np.zeros(depth.size)]
            then = _profile(result, kinds, rows)
            then = summarise_alternatives(kinds, then, scale, _positive(result))
            for i, rival in enumerate(then):
                if np.isnan(decades[i]) and rival.distinguishable:
                    decades[i] = further
            if not np.any(np.isnan(decades)):
                break
        decades = [np.inf if np.isnan(x) else x for x in decades]
    return [rival._replace(decades=x) for rival, x in zip(found, decades, strict=True)]


def free_element_parameters(result: Fit) -> tuple[str, ...]:
    """The free parameters that are floats of the elements of the scene."""
    plain = dataclasses.replace(result.gas, surface=None, container=None, drag=None, drive=None)
    return tuple(name for name in result.names if name not in (*plain.domains, START_TIME))


def _kinds(result: Fit) -> list[Kind]:
    """The rivals that the fit can have."""
    kinds: list[Kind] = [
        ("linear drag, as of air", "drag", DRAG_SHARES),
        ("a noise floor in T", "floor", SHARES),
    ]
    elements = result.gas.elements
    if not isinstance(result.gas.law, ConstantRestitution):
        words = "a further loss at constant eps"
        causes = {"container": "walls", "surface": "rough grains"}
        left = [cause for name, cause in causes.items() if name not in elements]
        words += f", as of {' or '.join(left)}" if left else ""
        kinds.insert(0, (words, "constant", SHARES))
    if "surface" not in elements:
        kinds.append(("rough grains, at rest in rotation at t = 0", "rough", ROUGHNESS))
    if "temperature" not in result.names and START_TIME not in (
        *result.names,
        *result.priors.names,
    ):
        kinds.append(("a wrong start of the clock, or a wrong T_0", "delay", DELAYS))
    return kinds


def _trials(kinds: list[Kind]) -> AddedTerms:
    """The fitted law itself, then each amplitude of each rival, the others being 0."""
    rows = [np.zeros(len(AddedTerms._fields))]
    for _, field, amplitudes in kinds:
        own = np.zeros((len(amplitudes), len(AddedTerms._fields)))
        own[:, AddedTerms._fields.index(field)] = amplitudes
        rows += list(own)
    return AddedTerms(*map(jnp.asarray, np.array(rows).T))


def _padded(times: np.ndarray, *columns: np.ndarray) -> list[np.ndarray]:
    """The times and other columns, with rows of 0 up to a power of two.

    Curves of many lengths then share a compiled program.
    """
    rows = max(32, 2 ** (times.size - 1).bit_length()) - times.size
    return [np.pad(times, (0, rows), "edge"), *(np.pad(column, (0, rows)) for column in columns)]


def ranges_over_alternatives(
    result: Fit, found: tuple[Alternative, ...]
) -> dict[str, tuple[Float[np.ndarray, "size"], Float[np.ndarray, "size"]]]:
    """The range of each free parameter, 95 %, over all rivals that fit as well as the best.

    Args:
        result: of `jaxgran.fit`.
        found: its rivals.
    """
    best = max(rival.improvement for rival in found)
    equal = [rival for rival in found if rival.improvement >= best - ALLOWED_CHI2]
    low = np.min([rival.low for rival in equal], axis=0)
    high = np.max([rival.high for rival in equal], axis=0)
    sizes = [size_of(result.gas, name) for name in result.names]
    parts = (np.split(x, np.cumsum(sizes)[:-1]) for x in (low, high))
    return dict(zip(result.names, zip(*parts, strict=True), strict=True))
