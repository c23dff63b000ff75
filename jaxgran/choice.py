"""Which model a scene needs: the cheapest whose estimated error is small enough, and why."""

import re
from collections.abc import Sequence
from math import sqrt
from numbers import Real
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import ArrayLike

from jaxgran import initial, kinetics, status
from jaxgran.boxes import SMALLEST_BOX
from jaxgran.domain import checked_times
from jaxgran.flow import flow_share
from jaxgran.gas import Gas
from jaxgran.models.dsmc import DSMC
from jaxgran.models.hard_spheres import HardSpheres
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.soft_spheres import SoftSpheres
from jaxgran.restitution import Viscoelastic

Model = KineticTheory | DSMC | HardSpheres | SoftSpheres

NUM_PARTICLES = 4000
"""Particles of a particle model if none are asked for."""

ENSKOG = (0.005, 0.1)
"""Relative error of Enskog's clock in a small box, ``a + b phi``.

Measured: the clock of hard spheres, N = 500, 8 replicas, 80 mean free times, beta_T0 = .15, is off
by 0 +- .6 %, .5 +- .6 %, 1.3 +- .8 % at phi = .02, .05, .1, that of LAMMPS by 1 % at .05; what
fluctuations leave over at phi = .2, .3, .4 is 1.2, 2.8, 2.4 %.
"""

CONTACT = 0.3
"""Relative error of the clock over the contact fraction t_c/tau_c: three spheres in touch.

Measured: soft spheres, N = 400, 8 replicas, 5 to 40 mean free times, net of the flow: .1 to .3
+- .1 at phi = .05, t_c/tau_c = .1 and .2; at phi = .2 .25 to .45 +- .08 for t_c/tau_c = .17, .27 to
.38 +- .04 for .4.
"""

SOFTNESS_SQUARED = 0.4
"""Relative error of the clock over (c X_T/sigma)^2, of which kinetic theory knows the first power.

Measured: .3 % at c X_T/sigma = .12; 8 to 12 % at .61, falling as the gas cools.
"""

SONINE = 0.3
"""Relative error of the clock over a_2^2: what two Sonine terms leave out of the velocities.

Measured: kinetic theory against DSMC, 200000 particles, constant restitution: T off by .6, .7, 1.8
+- .3 % after 80 mean free times at a_2 = .05, .12, .19, where |d ln T/d ln t| = 1.7.
"""

NOISE = 0.8
"""Scatter of ln T over sqrt(min(1, |ln T/T_0|) / N): shot noise of the first collisions.

Measured: hard spheres, N = 1000 (48 replicas) and 4000 (16), phi = .1 and .2, beta = .3 to .5, up
to 5 mean free times: .6 to 1.1, .82 in the mean.
"""

MISSING_HEAT = 1.6
"""Relative error of the clock over the share of heat that is missing: cooling goes as T^(8/5)."""

INTEGRATION = 0.001
"""Relative error of T of particles followed in time steps: eps good to 1e-4."""


class Choice(NamedTuple):
    """Attributes:
    model: ready to be given to `jaxgran.cool` or `jaxgran.fit`.
    reasons: why, a sentence each, the verdict first.
    errors: the estimated relative error of T at the worst of the times, by the model's name; 1
        means that nothing is known of T. Models that cannot run this scene are left out.
    """

    model: Model
    reasons: tuple[str, ...]
    errors: dict[str, float]

    @property
    def error(self) -> float:
        """Of the chosen model."""
        return self.errors[type(self.model).__name__]


def choose_model(
    gas: Gas,
    times: ArrayLike | Sequence[float],
    tolerance: float = 0.02,
    num_particles: int | None = None,
    *,
    replicas: int = 1,
) -> Choice:
    """The cheapest model whose estimated error of T is under a tolerance.

    Where a model's clock, the rate of cooling, errs by a share ``e(t)``, its temperature errs by
    ``|d ln T/d ln t|`` times the mean of e since the start. e adds up from Enskog's frequency of
    collisions, from contacts that last (`CONTACT`) and overlap, and, in a box of known size, from
    the flow that grows in it, whose energy kinetic theory and DSMC count as heat, which cools.
    DSMC and hard spheres do without kinetic theory's first correction for soft contacts; a
    particle model has noise.

    Args:
        gas: the scene.
        times: t, s, as given to `jaxgran.cool`; they tell how long the gas is followed.
        tolerance: relative error of T allowed, > 0.
        num_particles: N of the gas, if known: tells the box, and how many a particle model follows
            (4000 if not). Without it the gas is taken to stay homogeneous.
        replicas: of a particle model.

    Returns:
        `Choice`: the model, reasons in words, estimated errors. If no model is accurate enough,
        the most accurate one; the first reason says so.

    Raises:
        ValueError: for values out of range or being traced, or a gas so soft that kinetic theory
            says nothing of it.
        RuntimeError: if kinetic theory, which tells them apart, cannot follow the gas so far.
    """
    if not isinstance(gas, Gas):
        raise ValueError(f"gas must be a jaxgran.Gas, got {type(gas).__name__}")
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((gas, times))):
        raise ValueError(
            "a model cannot be chosen for values being traced by jax.jit, jax.grad or jax.vmap: "
            "call choose_model outside, and give its model to cool"
        )
    if not (isinstance(tolerance, Real) and 0 < tolerance < np.inf):
        raise ValueError(
            f"tolerance must be a number > 0, got {tolerance!r}; 0.02 allows T to err by 2 %"
        )
    size = NUM_PARTICLES if num_particles is None else num_particles
    # From the cheapest to the dearest.
    made: list[Model] = [KineticTheory()]
    made += [m(num_particles=size, replicas=replicas) for m in (DSMC, HardSpheres, SoftSpheres)]
    by_name = {type(model).__name__: model for model in made}

    end = float(checked_times(times)[-1])
    course = _course(gas, jnp.asarray(end))
    check_softness(gas, 1 - course["softness"][0])
    fault = int(course.pop("status"))
    if fault != status.OK:
        raise RuntimeError(f"kinetic theory, which tells the models apart: {status.explain(fault)}")
    course = {name: np.asarray(values, float) for name, values in course.items()}
    flow = scatter = np.zeros_like(course["time"])
    if num_particles is not None:
        flow, scatter = flow_share(
            gas, course["log_temperature"], course["critical_box"], num_particles
        )
    space = ENSKOG[0] + ENSKOG[1] * float(gas.packing_fraction) + MISSING_HEAT * flow
    contacts, softness = CONTACT * course["contact"], course["softness"]
    cooled = min(1.0, max(0.0, -course["log_temperature"].min()))
    noise = NOISE * sqrt(cooled / (size * replicas))
    # A flow that has grown is of a few waves, strong by chance.
    flowing = _largest_error(course, MISSING_HEAT * scatter) / sqrt(replicas)
    homogeneous = space + contacts + SOFTNESS_SQUARED * softness**2
    theory = _largest_error(course, homogeneous + SONINE * course["sonine"] ** 2)
    dsmc = _largest_error(course, space + contacts + softness)
    hard = _largest_error(course, contacts + softness)
    theory_of_contacts = _largest_error(course, contacts + SOFTNESS_SQUARED * softness**2)
    errors = {
        "KineticTheory": theory,
        "DSMC": sqrt(dsmc**2 + noise**2),
        "HardSpheres": sqrt(hard**2 + noise**2 + flowing**2),
        "SoftSpheres": sqrt(INTEGRATION**2 + noise**2 + flowing**2),
    }
    unfit = _unfit(gas, size)
    errors = {name: min(error, 1.0) for name, error in errors.items() if name not in unfit}
    good = [name for name, error in errors.items() if error <= tolerance]
    name = good[0] if good else min(errors, key=lambda name: errors[name])
    error = _percent(errors[name])
    if good:
        verdict = (
            f"{words(name)}: the cheapest model whose estimated error of T, {error}, is within "
            f"{_percent(tolerance)}."
        )
    else:
        verdict = (
            f"{words(name)}: the closest; no model is within {_percent(tolerance)}, and its "
            f"estimated error of T is {error}."
        )
        if name != "KineticTheory":
            verdict += " More particles or replicas have less noise."
    reasons = [
        verdict,
        f"T falls to {np.exp(course['log_temperature'].min()):.2g} T_0 in "
        f"{course['collisions'][-1]:.3g} collisions per particle.",
        f"Contacts last {_percent(course['contact'].max())} of the mean free time and overlap by "
        f"{_percent(course['overlap'].max())} of a diameter: T errs by "
        f"{_percent(hard)} with instant impacts, {_percent(theory_of_contacts)} with kinetic "
        "theory's first correction.",
        _of_space(gas, num_particles, _largest_error(course, space), flow),
        _of_noise(size * replicas, noise, flowing),
        *unfit.values(),
    ]
    return Choice(by_name[name], tuple(reasons), errors)


def check_softness(gas: Gas, factor: ArrayLike) -> None:
    """Raises ValueError where the factor by which soft contacts change cooling is not positive."""
    if np.any(np.asarray(factor) <= 0):
        raise ValueError(
            f"spheres overlap by {float(np.max(gas.mean_overlap)):.2g} diameters at T_0, where "
            "the softness correction has no meaning; is youngs_modulus in Pa? If so use "
            "SoftSpheres, or KineticTheory(softness=False)"
        )


@eqx.filter_jit
def _course(gas: Gas, end: jax.Array) -> dict[str, jax.Array]:
    """How the gas goes, by kinetic theory, on a grid of times from 0 to the end."""
    grid = jnp.linspace(0, jnp.log1p(end / gas.mean_free_time), 65)
    t = jnp.expm1(grid) * gas.mean_free_time
    curve = KineticTheory().cool(gas, t)
    assert curve.sonine is not None and curve.collisions is not None

    def scales(temperature):
        now = gas.replace(temperature=temperature)
        factor = kinetics.softness_factor(
            now.reduced_law, jnp.ones_like(temperature), now.dimension
        )
        return now.contact_fraction, now.mean_overlap, 1 - factor, now.critical_box

    contact, overlap, softness, critical = jax.vmap(scales)(curve.temperature)
    return {
        "status": jnp.asarray(curve.status),
        "time": t,
        "log_temperature": jnp.log(curve.temperature / gas.temperature),
        "collisions": curve.collisions,
        "sonine": curve.sonine,
        "contact": contact,
        "overlap": overlap,
        "softness": softness,
        "critical_box": critical,
    }


def _largest_error(course: dict[str, np.ndarray], clock: np.ndarray) -> float:
    """Of ln T, for a clock that errs by so much at each time."""
    t, log_T = course["time"], course["log_temperature"]
    if t[-1] == 0:
        return 0.0
    total = np.concatenate([[0], np.cumsum((clock[1:] + clock[:-1]) / 2 * np.diff(t))])
    return float(np.max(np.abs(np.gradient(log_T, t)) * total))


def _unfit(gas: Gas, size: int) -> dict[str, str]:
    """Models that cannot run this scene, and why not."""
    unfit = {}
    if not isinstance(gas.law, Viscoelastic):
        unfit["SoftSpheres"] = (
            f"Soft spheres need the Viscoelastic law; this gas has {type(gas.law).__name__}."
        )
    limit = initial.PACKING_LIMIT[gas.dimension]
    side = float(gas.box_side(size) / gas.diameter)
    for name in ("HardSpheres", "SoftSpheres"):
        if float(gas.packing_fraction) > limit:
            unfit[name] = f"{words(name)} start as a fluid, at a packing fraction up to {limit:g}."
        elif side < SMALLEST_BOX:
            unfit[name] = (
                f"{words(name)} need a box of {SMALLEST_BOX} diameters; that of {size} particles "
                f"is {side:.2g} long."
            )
    return unfit


def _of_space(gas: Gas, num_particles: int | None, error: float, flow: np.ndarray) -> str:
    text = f"At a packing fraction of {float(gas.packing_fraction):.2g}"
    if num_particles is None:
        return (
            f"{text} a gas that stays homogeneous leaves an error of {_percent(error)}; without "
            "num_particles the box is unknown, and clusters are not thought of."
        )
    ratio = float(gas.box_side(num_particles) / gas.critical_box)
    return (
        f"{text} in a box of {ratio:.2g} L_c, where the flow comes to hold {_percent(flow.max())} "
        f"of the energy, homogeneous models err by {_percent(error)}."
    )


def _of_noise(particles: int, noise: float, flowing: float) -> str:
    text = f"{particles} particles have a noise of {_percent(noise)} in T"
    if flowing <= noise / 10:
        return f"{text}."
    return (
        f"{text}, {_percent(sqrt(noise**2 + flowing**2))} where the flow, strong by chance, grows."
    )


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


def words(model: str) -> str:
    """The name of a model as it begins a sentence: "SoftSpheres" as "Soft spheres"."""
    return re.sub(r"(?<=[a-z])([A-Z])", lambda m: f" {m[1].lower()}", model)
