"""Choice of the fastest model whose estimated error in a scene is small enough."""

import dataclasses
from collections.abc import Iterator, Sequence
from math import hypot
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jaxgran._utils import status
from jaxgran._utils.formatting import text_table
from jaxgran._utils.tracing import any_traced
from jaxgran._utils.validation import POSITIVE, checked_float, checked_int, checked_times
from jaxgran.models.base import AbstractModel
from jaxgran.models.checks import check_softness_at, check_volume, checked_gas
from jaxgran.models.dsmc import DSMC
from jaxgran.models.error_model import ErrorModel
from jaxgran.models.hard_spheres import HardSpheres
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.limitations import describe_walls
from jaxgran.models.linearise import curve_of_program
from jaxgran.models.particle_model import AbstractParticleModel
from jaxgran.models.scales import scales_at
from jaxgran.models.soft_spheres import SoftSpheres
from jaxgran.scene.gas import Gas

NUM_PARTICLES = 4000
"""Particles of a particle model if the user gives no number."""

NUM_TIMES = 64
"""Number of times at which an `ErrorModel` samples the cooling gas."""


class Candidate(NamedTuple):
    """A model that was considered for a scene.

    Attributes:
        model: the model.
        error: its estimated relative error of T at the worst of the times, at most 1, which means
            that nothing is known of T; None if the model does not support the scene.
        refusal: the reason why the model does not support the scene; None if it does.
    """

    model: AbstractModel
    error: float | None
    refusal: str | None


class Choice(NamedTuple):
    """The model chosen for a scene.

    Attributes:
        model: the model, for `jaxgran.cool` or `jaxgran.fit`.
        reasons: the reasons, one sentence each, the verdict first.
        candidates: all models considered, fastest first.
        error: estimated relative error of T of the chosen model.

    >>> choice = jaxgran.choose_model(gas, times, num_particles=200)
    >>> choice.model.name, choice.error < 0.02
    ('kinetic theory', True)
    """

    model: AbstractModel
    reasons: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    error: float

    def __repr__(self) -> str:
        title = f"Choice: {self.model.name}, T within {100 * self.error:.2g} % by estimate"
        return text_table(title, [(f"{i}.", x) for i, x in enumerate(self.reasons, start=1)])


def default_models(num_particles: int, replicas: int = 1) -> tuple[AbstractModel, ...]:
    """Return the models of this package, fastest first."""
    kinds = (DSMC, HardSpheres, SoftSpheres)
    return KineticTheory(), *(kind(num_particles, replicas=replicas) for kind in kinds)


def choose_model(
    gas: Gas,
    times: ArrayLike | Sequence[float],
    tolerance: float = 0.02,
    num_particles: int | None = None,
    *,
    replicas: int = 1,
    models: Sequence[AbstractModel] | None = None,
) -> Choice:
    """Return the fastest model whose estimated error of T is within a tolerance.

    A model whose cooling rate has a relative error e(t) has a relative error
    ``|d ln T/dt| int_0^t e dt'`` of T. Contributions to e(t) are Enskog's collision frequency,
    contacts that last and overlap, and, in a box of known size, the flow that grows in it:
    kinetic theory and DSMC count its energy as heat, which cools. Particle models have noise. Each
    model estimates its own error (`jaxgran.extend.AbstractModel.estimated_error`).

    Args:
        gas: the scene.
        times: t, s, as given to `jaxgran.cool`; the last one is the end of the estimate.
        tolerance: relative error of T allowed, > 0.
        num_particles: N of the gas, if known: gives the box, and the number of particles of a
            particle model (4000 if unknown). Without it the gas is assumed to stay homogeneous.
        replicas: number of replicas of a particle model.
        models: the models to choose from, fastest first; by default all models of this package.

    Returns:
        `Choice`: the model, reasons in words, all candidates with their estimated errors. If no
        model is accurate enough, the most accurate one, and the first reason says so.

    Raises:
        ValueError: for values out of range or being traced, a gas so soft that kinetic theory is
            meaningless, a container of another volume than N spheres need, or a scene that no
            model supports.
        RuntimeError: if kinetic theory, which estimates the errors, cannot reach the last time.

    >>> choice = jaxgran.choose_model(gas, times, num_particles=200)
    >>> choice.reasons[0][:43]
    'Kinetic theory: the fastest model whose est'
    """
    checked_gas(gas)
    if any_traced(gas, times):
        raise ValueError(
            "a model cannot be chosen for values traced by jax.jit, jax.grad or jax.vmap: "
            "call choose_model outside, and pass its model to cool"
        )
    tolerance = checked_float("tolerance", tolerance, POSITIVE, "0.02 allows T to err by 2 %.")
    if num_particles is not None:
        num_particles = checked_int("num_particles", num_particles, 1)
        check_volume(gas, num_particles)
    size = NUM_PARTICLES if num_particles is None else num_particles
    models = default_models(size, replicas) if models is None else models
    if not models:
        raise ValueError("models must be a sequence of models, or None for all; got none")
    end = float(checked_times(times)[-1])
    error_model = predict_error_model(gas, end, num_particles)
    candidates = tuple(_candidate(model, error_model) for model in models)
    model, error = _best(candidates, tolerance)
    reasons = _verdict(model, error, tolerance), *_describe(error_model, model, candidates)
    return Choice(model, reasons, candidates, error)


def _candidate(model: AbstractModel, error_model: ErrorModel) -> Candidate:
    try:
        model.check_scene(error_model.gas)
    except ValueError as refusal:
        return Candidate(model, None, str(refusal))
    return Candidate(model, min(model.estimated_error(error_model), 1.0), None)


def _best(candidates: Sequence[Candidate], tolerance: float) -> tuple[AbstractModel, float]:
    """Return the fastest model within the tolerance, or the most accurate one, and its error."""
    possible = [(c.model, c.error) for c in candidates if c.error is not None]
    if not possible:
        refusals = "; ".join(str(c.refusal).rstrip(".") for c in candidates)
        raise ValueError(f"no model supports this scene: {refusals}.")
    accurate = [(model, error) for model, error in possible if error <= tolerance]
    return accurate[0] if accurate else min(possible, key=lambda pair: pair[1])


def _verdict(model: AbstractModel, error: float, tolerance: float) -> str:
    name = _capitalised(model.name)
    if error <= tolerance:
        return (
            f"{name}: the fastest model whose estimated error of T, {_percent(error)}, is within "
            f"{_percent(tolerance)}."
        )
    verdict = (
        f"{name}: the most accurate model, with an estimated error of T of {_percent(error)}; no "
        f"model is within {_percent(tolerance)}."
    )
    if model.stochastic:
        verdict += " More particles or replicas reduce the noise."
    return verdict


def _describe(
    error_model: ErrorModel, chosen: AbstractModel, candidates: Sequence[Candidate]
) -> Iterator[str]:
    """Yield what the estimates say of the gas, and why models do not support it."""
    yield _describe_cooling(error_model)
    yield _describe_contacts(error_model)
    yield _describe_box(error_model)
    models = chosen, *(c.model for c in candidates)
    of_particles = next((x for x in models if isinstance(x, AbstractParticleModel)), None)
    if of_particles is not None:
        yield _describe_noise(error_model, of_particles)
    if "friction" in error_model.gas.elements:
        yield "These estimates leave friction out."
    for c in candidates:
        if c.refusal is not None:
            yield f"{_capitalised(c.model.name)}: {c.refusal.rstrip('.')}."


def predict_error_model(gas: Gas, end: float, num_particles: int | None = None) -> ErrorModel:
    """Return the error model of a gas from t = 0 to an end, by kinetic theory without friction.

    Args:
        gas: the scene.
        end: last time, s.
        num_particles: N of the gas; None if unknown.

    Raises:
        ValueError: for a gas so soft that the softness correction is invalid.
        RuntimeError: if kinetic theory cannot reach the end.
    """
    check_softness_at(gas, 1.0)
    mean_free_time = float(scales_at(gas).mean_free_time)
    grid = np.linspace(0, np.log1p(end / mean_free_time), NUM_TIMES)
    known = dataclasses.replace(gas, surface=None) if "friction" in gas.elements else gas
    curve = curve_of_program(KineticTheory(), known, np.expm1(grid) * mean_free_time)
    fault = int(jnp.asarray(curve.status))
    if fault != status.OK:
        raise RuntimeError(f"kinetic theory, which estimates the errors: {status.explain(fault)}")
    error_model = ErrorModel.from_curve(gas, curve, num_particles)
    softest = np.argmax(error_model.softness)
    check_softness_at(gas, float(np.exp(error_model.log_temperature[softest])))
    return error_model


def _describe_cooling(error_model: ErrorModel) -> str:
    lowest, end = np.exp([error_model.log_temperature.min(), error_model.log_temperature[-1]])
    heated = error_model.gas.drive is not None and end > 1
    change = f"rises to {end:.2g}" if heated else f"falls to {lowest:.2g}"
    return f"T {change} T_0 in {error_model.collisions[-1]:.3g} collisions per particle."


def _describe_contacts(error_model: ErrorModel) -> str:
    instant = error_model.error_of_temperature(error_model.instant_contacts)
    corrected = error_model.error_of_temperature(error_model.corrected_contacts)
    return (
        f"Contacts last {_percent(error_model.contact_fraction.max())} of the mean free time and "
        f"overlap by {_percent(error_model.overlap.max())} of a diameter: the error of T is "
        f"{_percent(instant)} with instantaneous impacts, {_percent(corrected)} with kinetic "
        "theory's first-order correction."
    )


def _describe_box(error_model: ErrorModel) -> str:
    gas = error_model.gas
    error = _percent(error_model.error_of_temperature(error_model.correlated))
    density = f"At a packing fraction of {float(gas.packing_fraction):.2g}"
    if error_model.num_particles is None:
        return (
            f"{density} the error of kinetic theory is {error} if the gas stays homogeneous; "
            "without num_particles the box is unknown, and clustering is not estimated."
        )
    scales = scales_at(gas)
    side = scales.box_side(error_model.num_particles, gas.dimension)
    ratio = side / float(scales.critical_box)
    clusters = " Clusters follow the flow (see Gas.critical_box)." if ratio > 1 else ""
    return (
        f"{density} in a box of {ratio:.2g} L_c, where the flow reaches "
        f"{_percent(error_model.flow_share.max())} of the energy, the error of homogeneous models "
        f"is {error}.{clusters} The box {describe_walls(gas, error_model.num_particles)}."
    )


def _describe_noise(error_model: ErrorModel, model: AbstractParticleModel) -> str:
    number = model.num_particles * model.replicas
    noise = error_model.shot_noise(number)
    flowing = error_model.flow_noise(model.replicas)
    sentence = f"{number} particles have a noise of {_percent(noise)} in T"
    if flowing > noise / 10:
        both = _percent(hypot(noise, flowing))
        sentence += f", {both} with the random amplitudes of the flow"
    return f"{sentence}."


def _capitalised(text: str) -> str:
    return text[:1].upper() + text[1:]


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"
