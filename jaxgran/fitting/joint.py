"""One fit of several measurements of one material."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxgran.checks.validation import no_type_check
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.drop_test import DropTest
from jaxgran.fitting.budget import clock_accuracy
from jaxgran.fitting.checks import check_curve, check_deterministic
from jaxgran.fitting.comparison import Comparison
from jaxgran.fitting.guess import guess_from_data, guess_of_start, halving_time
from jaxgran.fitting.least_squares import least_squares
from jaxgran.fitting.parameters import START, Parameters, domain_of, size_of
from jaxgran.fitting.result import SIGNIFICANCE
from jaxgran.models.base import AbstractModel
from jaxgran.models.checks import checked_gas
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.gas import Gas

MOST_STEPS = 100


class JointFit(NamedTuple):
    """Result of a fit of several measurements with shared parameters.

    Attributes:
        estimate: of each shared parameter by name, SI.
        standard_error: of each, SI, with the errors of all measurements and of the model's clock.
        separate: of each measurement by its label, its own parameters by name, and their errors.
        weight: of each measurement by its label, its share of what is known of each shared
            parameter; they add up to 1.
        chi2: of each measurement by its label, at the shared estimate.
        decrease: of each, by how much its chi^2 would fall with parameters of its own.
        p_value: probability of so large a decrease, of all together, by chance.
        agree: whether it is above 1 %: the measurements do not contradict each other.
        converged: whether the search reached its tolerance.

    >>> joint = jaxgran.fit_jointly({"a": (gas, curve), "b": (gas, curve)})
    >>> f"{float(joint.estimate['dissipative_constant']):.3g}"
    '3e-06'
    """

    estimate: dict[str, Float[np.ndarray, "..."]]
    standard_error: dict[str, Float[np.ndarray, "..."]]
    separate: dict[str, dict[str, tuple[float, float]]]
    weight: dict[str, dict[str, float]]
    chi2: dict[str, float]
    decrease: dict[str, float]
    p_value: float
    agree: bool
    converged: bool


@no_type_check
def fit_jointly(
    measurements: dict[str, tuple[Gas, CoolingCurve | DropTest]],
    *,
    shared: tuple[str, ...] = ("dissipative_constant",),
    separate: tuple[str, ...] = (),
    model: AbstractModel | None = None,
) -> JointFit:
    """Estimate what several measurements of one material have in common.

    Minimises the sum of all chi^2. Every curve has a clock of its own, known within the model's
    accuracy in its scene, and its own `separate` parameters; the errors hold both.

    Args:
        measurements: by a label of each, the gas (its diameter, packing fraction, ...) and its
            cooling curve, whose T must have errors, or a drop test of such spheres.
        shared: floats of the gas or its law that all measurements share.
        separate: floats that each curve has for itself, such as "temperature", or "t0", the time
            at which it began (see `jaxgran.fit`).
        model: a deterministic model, by default `jaxgran.KineticTheory()`.

    Returns:
        `JointFit`.

    Raises:
        ValueError: for unknown names, a curve without errors, or a stochastic model.
        RuntimeError: if the model cannot compute a curve where the search ends.

    >>> joint = jaxgran.fit_jointly({"a": (gas, curve), "b": (gas, curve)})
    >>> sorted(joint.weight), joint.agree
    (['a', 'b'], True)
    """
    model = KineticTheory() if model is None else model
    _check(measurements, shared, separate, model)
    labels, pairs = tuple(measurements), tuple(measurements.values())
    names = tuple(shared), tuple(separate)
    clocks = [
        jnp.zeros(())
        if isinstance(data, DropTest)
        else jnp.max(clock_accuracy(guess_from_data(gas, data, sum(names, ())), data, model))
        for gas, data in pairs
    ]
    found = _search(pairs, *names, model, clocks)
    if not all(np.all(np.isfinite(part)) for part in found[1]):
        raise RuntimeError("the model could not compute a curve where the joint search ended")
    return _result(labels, pairs, *names, *found)


def _check(measurements, shared, separate, model) -> None:
    if not isinstance(measurements, dict) or len(measurements) < 2:
        raise ValueError(
            "fit_jointly takes two or more measurements, as {'first': (gas, curve), 'second': "
            "(gas, drop_test)}; for one curve use jaxgran.fit"
        )
    check_deterministic(model, "a joint fit")
    names = (*shared, *separate)
    if not shared or len(set(names)) < len(names) or START in shared:
        raise ValueError(
            f"shared and separate must be different names, and each curve has its own {START}, got "
            f"shared = {shared}, separate = {separate}"
        )
    for label, pair in measurements.items():
        if not isinstance(pair, tuple) or len(pair) != 2:
            raise ValueError(f"measurement {label!r} must be (gas, curve), got {pair!r:.60}")
        gas, data = pair
        checked_gas(gas)
        for name in names:
            domain_of(gas, name)
        if isinstance(data, DropTest):
            continue
        if not isinstance(data, CoolingCurve):
            raise ValueError(
                f"measurement {label!r} must hold a jaxgran.CoolingCurve or a jaxgran.DropTest, "
                f"got {type(data).__name__}"
            )
        check_curve(gas, data)
        model.check_scene(gas)
        if data.temperature_error is None:
            raise ValueError(
                f"the curve of {label!r} has no errors, by which measurements are weighed: give "
                "temperature_error (jaxgran.fit tells the scatter of a single curve)"
            )


@eqx.filter_jit
def _search(
    pairs: tuple[tuple[Gas, CoolingCurve | DropTest], ...],
    shared: tuple[str, ...],
    separate: tuple[str, ...],
    model: AbstractModel,
    clocks: list[Float[Array, ""]],
) -> tuple[Array, list[Array], list[Array], Bool[Array, ""]]:
    """The unknowns, and each measurement's residuals and their derivatives in all unknowns."""
    first, parts = _unknowns(pairs, shared, separate)
    num_shared = first.size - sum(size for _, size in parts)

    def residuals(unknowns: Array) -> list[Array]:
        common, begin, each = unknowns[:num_shared], num_shared, []
        for (gas, data), (names, size), unsure in zip(pairs, parts, clocks, strict=True):
            own = unknowns[begin : begin + size]
            begin += size
            if isinstance(data, DropTest):
                each.append(data.residuals(Parameters(gas, shared).gas(common)))
                continue
            T, error = data.temperature, data.temperature_error
            bare = CoolingCurve(times=data.times, temperature=T, temperature_error=error)
            comparison = Comparison.of(gas, bare, model, (*shared, *names), None)
            clock = jnp.exp(unsure * own[-1])
            at = jnp.concatenate([common, own[:-1]])
            each.append(jnp.concatenate([comparison.evaluate(at, clock)[0], own[-1:]]))
        return each

    unknowns, _, converged = least_squares(
        lambda x: jnp.concatenate(residuals(x)), first, MOST_STEPS
    )
    return unknowns, residuals(unknowns), jax.jacfwd(residuals)(unknowns), converged


def _unknowns(
    pairs: tuple[tuple[Gas, CoolingCurve | DropTest], ...],
    shared: tuple[str, ...],
    separate: tuple[str, ...],
) -> tuple[Array, list[tuple[tuple[str, ...], int]]]:
    """First values of all unknowns; of each measurement its own parameters, and how many numbers
    they are with the clock."""
    own, sizes, common = [], [], None
    for gas, data in pairs:
        if isinstance(data, DropTest):
            sizes.append(((), 0))
            continue
        guess = guess_from_data(gas, data, (*shared, *separate))
        common = Parameters(gas, shared).flat(guess) if common is None else common
        start = guess_of_start(guess, data, (*shared, *separate))
        at = jnp.zeros(0)
        if separate:
            at = Parameters(gas, separate, halving_time(data)).flat(guess, start)
        own += [at, jnp.zeros(1)]
        sizes.append((separate, at.size + 1))
    if common is None:  # drop tests alone: the gas's own values
        common = Parameters(pairs[0][0], shared).flat(pairs[0][0])
    return jnp.concatenate([common, *own]), sizes


def _result(labels, pairs, shared, separate, flat, residuals, jacobians, converged) -> JointFit:
    """The fit in words and SI units."""
    gas = pairs[0][0]
    parameters = Parameters(gas, shared)
    p = parameters.flat(gas).size
    jacobians = [np.asarray(part) for part in jacobians]
    residuals = [np.asarray(part) for part in residuals]
    covariance = np.linalg.pinv(sum(part.T @ part for part in jacobians))
    scale = np.asarray(jax.jacfwd(parameters.estimates)(flat[:p]))
    errors = np.sqrt(np.diag(scale @ covariance[:p, :p] @ scale.T))
    estimates = np.asarray(parameters.estimates(flat[:p]))
    each = [_information(part, p) for part in jacobians]
    total = np.maximum(sum(np.diag(part) for part in each), 1e-300)
    decrease = [_decrease(part, r) for part, r in zip(jacobians, residuals, strict=True)]
    informative = sum(bool(np.any(np.diag(part) > 0)) for part in each)
    p_value = float(jax.scipy.stats.chi2.sf(sum(decrease), max(p * (informative - 1), 1)))
    ends = np.cumsum([size_of(gas, name) for name in shared])[:-1]

    def named(values):
        return dict(zip(shared, map(np.squeeze, np.split(values, ends)), strict=True))

    shares = [{n: float(np.mean(x)) for n, x in named(np.diag(i) / total).items()} for i in each]
    return JointFit(
        estimate=named(estimates),
        standard_error=named(errors),
        separate=_own(labels, pairs, separate, flat, p, np.sqrt(np.diag(covariance))),
        weight=dict(zip(labels, shares, strict=True)),
        chi2={k: float(np.sum(r**2)) for k, r in zip(labels, residuals, strict=True)},
        decrease=dict(zip(labels, decrease, strict=True)),
        p_value=p_value,
        agree=p_value > SIGNIFICANCE,
        converged=bool(converged),
    )


def _own(labels, pairs, separate, flat, begin, deviations):
    """The separate parameters of each curve, SI, with their errors."""
    own = {}
    for label, (scene, data) in zip(labels, pairs, strict=True):
        if isinstance(data, DropTest):
            continue
        size = 0
        if separate:
            parameters = Parameters(scene, separate, halving_time(data))
            size = parameters.flat(scene).size
            at = flat[begin : begin + size]
            slope = np.diag(np.asarray(jax.jacfwd(parameters.estimates)(at)))
            errors = np.abs(slope) * deviations[begin : begin + size]
            values = np.asarray(parameters.estimates(at))
            pairs_of = zip(values.tolist(), errors.tolist(), strict=True)
            own[label] = dict(zip(separate, pairs_of, strict=True))
        begin += size + 1  # the clock
    return own


def _information(jacobian: Float[np.ndarray, "residuals q"], p: int) -> Float[np.ndarray, "p p"]:
    """What a measurement alone tells of the first p unknowns, its own ones being unknown."""
    common, own = jacobian[:, :p], jacobian[:, p:]
    own = own[:, np.any(own != 0, axis=0)]
    if own.shape[1]:
        common = common - own @ (np.linalg.pinv(own) @ common)
    return common.T @ common


def _decrease(
    jacobian: Float[np.ndarray, "residuals q"], residuals: Float[np.ndarray, "r"]
) -> float:
    """By how much chi^2 would fall, to first order, if all unknowns were the measurement's own."""
    used = jacobian[:, np.any(jacobian != 0, axis=0)]
    return float(residuals @ used @ np.linalg.pinv(used) @ residuals)
