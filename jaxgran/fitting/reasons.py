"""The reasons for the verdict of a fit, one sentence each."""

from collections.abc import Collection, Iterator

import numpy as np

from jaxgran.data.drop_test import DropTest
from jaxgran.data.measurement import Measurement
from jaxgran.fitting.alternatives import Alternative, Explanations
from jaxgran.fitting.headline import describe_range
from jaxgran.fitting.measured_rows import UNKNOWN_NUMBER
from jaxgran.fitting.result import Fit, by_label, prefix_of
from jaxgran.fitting.rows import SIMULATION
from jaxgran.fitting.setup import Request
from jaxgran.fitting.verdict import Misfit, data_and_verb, symbols_of, why_undetermined
from jaxgran.models.base import AbstractModel
from jaxgran.models.limitations import describe_walls
from jaxgran.scene.parameters import symbol_of

MAX_ERROR_OF_N = 1.0
"""Standard error of ln N from which N by the scatter of a curve is not reported."""

NEARLY_CERTAIN = 0.99
"""Probability by chance from which it is not reported in digits."""

NEGLIGIBLE_ERROR = 1e-4
"""Relative error of T up to which it is not reported."""

MIN_REDUCTION = 1.1
"""Smallest factor by which errors are said to have to shrink: less would be rounded to 1."""

MIN_PARTICLES = 50
"""Least number of particles of a model whose noise is known."""

SPHERES = {
    "diameter_sd": "smooth spheres of one material, whose sizes differ as given",
    "friction": "equal spheres of constant friction",
    "surface": "equal, rough spheres of constant beta_t",
    "": "equal, smooth spheres",
}
"""What a model assumes of spheres with an element, the first one that they have; "" for none."""


def describe_fit(result: Fit, misfit: Misfit, model: AbstractModel) -> Iterator[str]:
    """Yield how well the data are fitted, and what the model assumes."""
    yield _chi2(result)
    yield from _reasons_of_misfit(result, misfit)
    yield from _scatter(result)
    yield from _errors_of_T(result)
    yield from _parts_of_measurements(result)
    yield _assumptions(model, result)
    yield from _absent_effects(result)


def _chi2(result: Fit) -> str:
    p_value = result.p_value
    chance = f"{100 * p_value:.2g} %" if p_value < NEARLY_CERTAIN else "over 99 %"
    return (
        f"reduced chi^2 is {result.reduced_chi2:.3g} for {int(result.degrees_of_freedom)} degrees "
        f"of freedom; the quantity that fits worst would fit worse by chance in {chance} of runs"
    )


def _reasons_of_misfit(result: Fit, misfit: Misfit) -> Iterator[str]:
    """Yield curves that rise, and what scatter that is too large or too small may come from."""
    for first, last in misfit.rising:
        yield (
            f"T rises from {first:.3g} to {last:.3g} m^2/s^2, and nothing drives this gas: check "
            "the order of the rows and the noise of the measurement, or give drive_strength"
        )
    if misfit.scatters_more:
        known = [m.num_particles for m in result.measurements.values()]
        as_few = ""
        if len(known) == 1 and known[0] is not None:
            number = _two_digits(known[0] / result.reduced_chi2)
            as_few = f"; without errors of T about {number:g} grains would scatter as much"
        yield (
            "the data scatter more about the model than their errors and N equal spheres allow; "
            "possible causes: another effect, a mixture of sizes, eps that scatters, fewer grains "
            f"than given, or noise of the measurement{as_few}"
        )
    if misfit.is_smooth:
        yield (
            "the curve scatters less than N equal spheres do; possible causes: walls that cool the "
            "grains, more grains than given, or smoothing of the curve"
        )
    elif misfit.scatters_less:
        yield (
            "the residuals are smaller than the errors of T allow by chance: these errors are too "
            "large, or they are common to the points"
        )


def _two_digits(x: float) -> float:
    """Return a number rounded to two digits, which is then written without an exponent."""
    return float(f"{x:.2g}")


def _scatter(result: Fit) -> Iterator[str]:
    """Yield N by the scatter of each curve for which it is not known."""
    for label, (ratio, error) in result.scatter.items():
        if result.measurements[label].num_particles is None and error < MAX_ERROR_OF_N:
            number = UNKNOWN_NUMBER / ratio
            of_number = _two_digits(number * error)
            yield (
                f"{prefix_of(label)}the curve scatters as {_two_digits(number):g} +- "
                f"{of_number:g} grains do"
            )


def _errors_of_T(result: Fit) -> Iterator[str]:
    """Yield the errors of T that a fit found in curves without errors."""
    for label, error in result.errors_of_T.items():
        if error < NEGLIGIBLE_ERROR:
            continue  # another curve has the errors
        advice = "Give T_err if they are known"
        if result.measurements[label].curve.temperature_error is not None:
            advice = "If T_err are errors of the measurement, say so: `errors: measured`"
        yield (
            f"{prefix_of(label)}T scatters more than its grains can: the fit adds an independent "
            f"error of {100 * error:.2g} % to each T, beside every other effect. {advice}"
        )


def _parts_of_measurements(result: Fit) -> Iterator[str]:
    """Yield the misfit and the weight of each of several measurements."""
    if len(result.measurements) < 2:
        return
    symbol = symbol_of(result.names[0])
    for label, residuals in result.residuals.items():
        values = np.concatenate(list(residuals.values()))
        yield (
            f"{label}: chi^2 is {np.sum(values**2):.3g} for {np.sum(values != 0)} points; its "
            f"weight in {symbol} is {result.weights[label][0]:.2f}"
        )


def _assumptions(model: AbstractModel, result: Fit) -> str:
    """Return what a model assumes of the measured gases."""
    measurements = result.measurements
    spheres = {label: _element_of_spheres(m) for label, m in measurements.items()}
    assumed = []
    for element in dict.fromkeys(spheres.values()):
        labels = [label for label, x in spheres.items() if x == element]
        assumed += _in_curves(result, SPHERES[element], labels)
    without_walls = [label for label, m in measurements.items() if m.gas.container is None]
    assumed += _in_curves(result, "far from walls", without_walls)
    without_drag = [label for label, m in measurements.items() if m.gas.drag is None]
    assumed += _in_curves(result, "in vacuum", without_drag)
    if not model.has_positions:
        assumed.append("at homogeneous density")
    return f"the model assumes {', '.join(assumed)}"


def _element_of_spheres(m: Measurement) -> str:
    """Return the first element of `SPHERES` that a gas has; "" for equal, smooth spheres."""
    return next((element for element in SPHERES if element in m.gas.elements), "")


def _absent_effects(result: Fit) -> Iterator[str]:
    """Yield the effects that are known to be absent, with the curves if not in all of them."""
    measurements = result.measurements
    absent = []
    for effect in dict.fromkeys(x for m in measurements.values() for x in m.absent):
        labels = [label for label, m in measurements.items() if effect in m.absent]
        absent += _in_curves(result, effect, labels)
    if absent:
        yield f"known to be absent: {', '.join(absent)}"


def _in_curves(result: Fit, what: str, labels: Collection[str]) -> Iterator[str]:
    """Yield what holds for all curves, or for those that are then named; nothing for none.

    In a fit of drop tests alone these take the place of curves.

    Args:
        result: of the fit.
        what: the statement.
        labels: of the measurements for which it holds.
    """
    every = result.measurements
    curves = [x for x, m in every.items() if not isinstance(m.data, DropTest)] or [*every]
    among = [label for label in curves if label in labels]
    if among == curves:
        yield what
    elif among:
        yield f"{what} ({', '.join(among)})"


def describe_comparison(
    request: Request, result: Fit, explanations: Explanations | None
) -> Iterator[str]:
    """Yield why alternatives were not compared, and those that are preferred or possible."""
    if request.quick:
        yield "alternatives were not compared, as requested"
    if any(m.gas.drive is not None for m in request.measurements.values()):
        yield "alternatives were not compared: the gas is driven"
    if request.model.stochastic and result.alternatives:
        yield "alternatives are compared by kinetic theory, shifted to the fitted curve"
    if explanations is not None and explanations.not_computed:
        yield (
            f"alternatives not computed: {', '.join(explanations.not_computed)}; the range does "
            "not allow for them"
        )
    for alternative in result.alternatives:
        if alternative.preferred:
            yield from _preferred(result, alternative)
        elif not alternative.distinguishable:
            yield _possible(result, alternative)


def _preferred(result: Fit, alternative: Alternative) -> Iterator[str]:
    """Yield by how much an alternative fits better, and the first parameter there."""
    name = alternative.name
    eps = alternative.restitution
    decreases = (
        f"decreases -2 ln L by {alternative.improvement:.3g} (by chance in less than 1 % of fits)"
    )
    low, high = _range_of(alternative)
    if eps is None:
        span = describe_range(result, low, high)
        yield f"{name} added to the model {decreases}; with it {span}"
    else:
        yield f"{name}, {eps:.3g}, in place of the fitted law {decreases}: A has no meaning then"
    estimate = float(result.estimate[0])
    if not low <= estimate <= high:
        yield (
            f"the estimate {estimate:.3g} lies outside this range, because the estimate assumes "
            "that the preferred alternative is absent"
        )


def _possible(result: Fit, alternative: Alternative) -> str:
    """Return that an alternative is possible, with the first parameter there."""
    name = alternative.name
    eps = alternative.restitution
    if eps is not None:
        return (
            f"{name}, {eps:.3g}, in place of the fitted law cannot be excluded: A would then have "
            "no meaning"
        )
    span = describe_range(result, *_range_of(alternative))
    factor = _two_digits(max(alternative.error_reduction_needed, MIN_REDUCTION))
    return (
        f"{name} cannot be excluded; with it {span}; errors {factor:g} times smaller would "
        "exclude this explanation or make it negligible"
    )


def _range_of(alternative: Alternative) -> tuple[float, float]:
    """Return the range of the first parameter under an alternative."""
    return float(alternative.low[0]), float(alternative.high[0])


def describe_surroundings(result: Fit) -> Iterator[str]:
    """Yield for each curve what its walls, or the box of its grains, may mean."""
    gases = by_label(result.gas)
    for label, m in result.measurements.items():
        if isinstance(m.data, DropTest):
            continue
        gas = gases[label]
        N = m.num_particles
        if gas.container is not None:
            yield (
                f"{prefix_of(label)}gravity is neglected: in one simulated box, with walls of "
                "restitution 0.8, a gravity of 0.1 m/s^2 made the fitted A 9 % too small"
            )
        elif N is not None and "walls" not in m.absent:
            yield f"{prefix_of(label)}the box of {N} spheres {describe_walls(gas, N)}"


def describe_convergence(result: Fit) -> Iterator[str]:
    """Yield whether the search did not converge, and the noise of simulations."""
    if not result.converged:
        yield (
            "the search did not converge: free fewer parameters, or in Python increase max_steps"
        )
    noise = result.error_budget.get(SIMULATION)
    if noise is not None:
        share = 100 * float(np.max(noise / result.standard_error))
        words = (
            f"at most {share:.0f} % of the standard error" if np.isfinite(share) else "not known"
        )
        yield f"{result.iterations} simulations were run; their noise is {words}"


def describe_search(result: Fit) -> Iterator[str]:
    """Yield few particles, undetermined parameters and equally good minima.

    `jaxgran.fit` also gives them as warnings.
    """
    number = getattr(result.model, "num_particles", None)
    if number is not None and number < MIN_PARTICLES:
        yield (
            f"{number} particles are too few for their noise to be known, and cool faster than a "
            f"gas: give the model {MIN_PARTICLES} or more"
        )
    data, do = data_and_verb(result)
    if group := result.undetermined:
        yield (
            f"{data} {do} not determine {symbols_of(group)}: {why_undetermined(group)}; free fewer "
            "parameters"
        )
    if len(result.other_minima):
        symbols = [symbol_of(name) for name in result.element_names]
        places = []
        for minimum in result.other_minima:
            values = zip(symbols, minimum, strict=True)
            places.append(", ".join(f"{symbol} = {x:.3g}" for symbol, x in values))
        yield (
            f"-2 ln L has another minimum that is nearly as good, at {' and at '.join(places)}: "
            f"{data} {do} not distinguish them"
        )
