"""Rivals of a fitted law: what else could have made a measured curve, and what A would then be.

Each rival adds a loss of energy, or an error of the measurement, to the fitted model. Its amplitude
is varied from nothing to all of the curve while the free parameters are fitted anew. chi^2 as a
function of the amplitude says whether the curve asks for the rival, or excludes it; where it does
neither, the parameters are known only as well as the amplitude is.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.amplitudes import ALLOWED, Kind, Rival, compared
from jaxgran.fitting.parameters import START, domain_of, size_of
from jaxgran.fitting.profile import Profile, Trial, fit_trials
from jaxgran.fitting.residuals import chi2_scale
from jaxgran.fitting.result import Fit
from jaxgran.scene.restitution import ConstantRestitution

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


def rivals(result: Fit, curve: CoolingCurve) -> tuple[Rival, ...]:
    """Compare a fitted law with its rivals, by T alone.

    The course of T comes from `jaxgran.theory.table_of_times`; what the fitted model has besides is
    added to all trials alike.

    Args:
        result: of `jaxgran.fit`, of one curve.
        curve: the measured curve.

    Returns:
        The rivals, those that fit best first; () where the fitted gas does not cool or is driven,
        of which T is not a table of times, or where floats of its elements were free, whose losses
        are such rivals themselves.
    """
    if free_elements(result) or result.gas.drive is not None:
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
    found = compared(kinds, profile, scale, positive)
    found = _with_decades(result, kinds, columns, scale, found)
    return tuple(sorted(found, key=lambda rival: -rival.improvement))


def _profile(result: Fit, kinds: list[Kind], columns: list[np.ndarray]) -> Profile:
    """Fits of all rivals, with all amplitudes, to rows of t, ln T, weights, ln T and T_rot/T."""
    profile = fit_trials(
        result.gas,
        result.began,
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
    found: list[Rival],
) -> list[Rival]:
    """The rivals with the decades of T that would tell them apart.

    The fitted law itself is followed further, by ``T = T_0 (1 + t/tau)^(-p)`` with tau of the last
    measured point, through so many decades of T, with as many points in each decade as there are
    now, of the same errors; and the rivals are fitted to that.
    """
    decades = [0.0 if rival.told_apart else np.nan for rival in found]
    # Of rows that are the model's own, `fit_trials` needs ln T only for its range.
    power = 2.0 if isinstance(result.gas.law, ConstantRestitution) else 5 / 3
    T_0 = float(np.log(result.gas.temperature))
    used = columns[2] > 0
    start, last = float(result.began), float(columns[0][used][-1])
    cooled = T_0 - float(columns[3][used][-1])
    if not all(rival.told_apart for rival in found) and cooled > 0 and not result.gas.elements:
        tau = (last - start) / np.expm1(cooled / power)
        weight, number = np.sqrt(np.mean(columns[2][used] ** 2)), int(used.sum())
        for further in FURTHER:
            depth = np.linspace(0.0, cooled + further * np.log(10.0), columns[0].size)
            times = np.maximum(start + tau * np.expm1(depth / power), 0.0)
            density = number * depth[-1] / cooled / depth.size
            weights = np.full(depth.size, weight * density**0.5)
            rows = [times, T_0 - depth, weights, T_0 - depth, np.zeros(depth.size)]
            then = _profile(result, kinds, rows)
            then = compared(kinds, then, scale, _positive(result))
            for i, rival in enumerate(then):
                if np.isnan(decades[i]) and rival.told_apart:
                    decades[i] = further
            if not np.any(np.isnan(decades)):
                break
        decades = [np.inf if np.isnan(x) else x for x in decades]
    return [rival._replace(decades=x) for rival, x in zip(found, decades, strict=True)]


def free_elements(result: Fit) -> tuple[str, ...]:
    """The free parameters that are floats of the elements of the scene."""
    plain = dataclasses.replace(result.gas, surface=None, container=None, drag=None, drive=None)
    return tuple(name for name in result.names if name not in (*plain.domains, START))


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
    if "temperature" not in result.names and START not in (*result.names, *result.priors.names):
        kinds.append(("a wrong start of the clock, or a wrong T_0", "delay", DELAYS))
    return kinds


def _trials(kinds: list[Kind]) -> Trial:
    """The fitted law itself, then each amplitude of each rival, the others being 0."""
    rows = [np.zeros(len(Trial._fields))]
    for _, field, amplitudes in kinds:
        own = np.zeros((len(amplitudes), len(Trial._fields)))
        own[:, Trial._fields.index(field)] = amplitudes
        rows += list(own)
    return Trial(*map(jnp.asarray, np.array(rows).T))


def _padded(times: np.ndarray, *columns: np.ndarray) -> list[np.ndarray]:
    """The times and other columns, with rows of 0 up to a power of two.

    Curves of many lengths then share a compiled program.
    """
    rows = max(32, 2 ** (times.size - 1).bit_length()) - times.size
    return [np.pad(times, (0, rows), "edge"), *(np.pad(column, (0, rows)) for column in columns)]


def ranges(
    result: Fit, found: tuple[Rival, ...]
) -> dict[str, tuple[Float[np.ndarray, "size"], Float[np.ndarray, "size"]]]:
    """The range of each free parameter, 95 %, over all rivals that fit as well as the best.

    Args:
        result: of `jaxgran.fit`.
        found: its rivals.
    """
    best = max(rival.improvement for rival in found)
    equal = [rival for rival in found if rival.improvement >= best - ALLOWED]
    low = np.min([rival.low for rival in equal], axis=0)
    high = np.max([rival.high for rival in equal], axis=0)
    sizes = [size_of(result.gas, name) for name in result.names]
    parts = (np.split(x, np.cumsum(sizes)[:-1]) for x in (low, high))
    return dict(zip(result.names, zip(*parts, strict=True), strict=True))
