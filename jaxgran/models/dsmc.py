"""Direct simulation Monte Carlo (DSMC) of the velocities of a homogeneous gas."""

import dataclasses
from functools import partial
from math import hypot
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt32

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced
from jaxgran._utils.validation import (
    Domain,
    UserFloat,
    UserInt,
    checked_float,
    checked_int,
    python_int,
)
from jaxgran.data.checkpoint import describe_run
from jaxgran.data.curve import DEFAULTS, QUANTITIES, CoolingCurve, Run, records_in_si
from jaxgran.models import checks
from jaxgran.models.base import AbstractModel, Limitation
from jaxgran.models.error_model import ErrorModel
from jaxgran.particles import snapshot
from jaxgran.particles.dsmc.collisions import DSMCDynamics, Scheme
from jaxgran.particles.dsmc.run import differentiable_run, host_run_parts
from jaxgran.particles.run import (
    block_until_ready,
    compiling,
    join_records,
    needs_compilation,
    replica_devices,
    run_replicas,
    run_through_times,
)
from jaxgran.particles.state import transformed_times
from jaxgran.scene.gas import Gas
from jaxgran.scene.reduced import reduced_scene

MAX_STEP = 0.1
"""Largest number of collisions per particle and step: a step draws a particle at most twice."""


class DSMC(AbstractModel):
    """Homogeneous gas of hard spheres by direct simulation Monte Carlo: velocities, no positions.

    Solves the Enskog-Boltzmann equation of the homogeneous gas with any law of restitution:
    pairs collide at the rate ``sigma^(d-1) g_2 / V`` times ``g.n`` for each normal n with
    ``g.n > 0``, ``v_i -> v_i - (1 + eps)/2 (g.n) n``, ``v_j -> v_j + (1 + eps)/2 (g.n) n``.
    The velocity distribution is exact, while kinetic theory has two Sonine terms. The model leaves
    out correlations, clustering and the duration of contacts.

    A step is a fixed share of the current mean free time. Its error is of second order: a step
    draws disjoint random pairs, and then pairs that share a particle with these, as often as
    drawing one pair after the other would. Means over N particles have errors of O(1/N).

    Supports all elements of a scene but `jaxgran.Frictional`: rough spheres; walls, which all
    particles of the homogeneous gas hit with the same probability, more often the more energy the
    walls take (`jaxgran.scene.elements`); drag, exactly, by collisions in transformed time
    (`jaxgran.particles.state`), up to gamma t = 18 (8 in float32); a drive, with half of the kicks
    at the beginning of each step and half at its end, on subsets of the particles in turn
    (`jaxgran.particles.dsmc.collisions`). With elements the derivatives of T, T_rot and
    collisions are known (`jaxgran.gradients.tangents`), others are nan.

    The curve is differentiable in every float of the gas and in the times, forward and reverse.
    The derivatives are estimates. They are taken at a fixed scaled time s (``ds = sqrt(T) dt``, so
    that the order of collisions does not depend on the speeds). The gas is assumed to remember its
    temperature only; <dr^2> and the velocity correlation are assumed to change by the first Sonine
    order of diffusion. The derivative of a_2 in a float of the gas is not known, and is nan. Rates
    of change with time are those of the Maxwell-Sonine distribution. Second derivatives are
    refused.

    Args:
        num_particles: N, >= 2, on one device.
        replicas: number of independent gases that are simulated together; two or more give error
            bars.
        step: collisions per particle in one step, in (0, 0.1]. A step has at least one pair, which
            is 0.5/N; in a gas of some ten particles this is longer than requested.

    Raises:
        ValueError: for numbers out of range.

    Reference: G. A. Bird, Molecular Gas Dynamics (1994); J. M. Montanero & A. Santos, PRE 54, 438
    (1996) for dense gases; Brilliantov & Poeschel for the granular gas.

    >>> spheres = jaxgran.cool(gas, times[:2], model=jaxgran.DSMC(1000), progress=False)
    >>> f"{float(spheres.temperature[1]):.1g}"
    '0.005'
    """

    num_particles: UserInt = eqx.field(static=True, converter=python_int)
    replicas: UserInt = eqx.field(static=True, converter=python_int, default=1)
    step: UserFloat = eqx.field(static=True, default=0.05)

    stochastic: ClassVar[bool] = True
    saves: ClassVar[bool] = True
    elements: ClassVar[tuple[str, ...]] = ("surface", "container", "drag", "drive")
    derivative_accuracy: ClassVar[float] = 0.01

    def __check_init__(self):
        checked_int("num_particles", self.num_particles, 2)
        checked_int("replicas", self.replicas, 1)
        allowed = Domain(0.0, MAX_STEP, high_allowed=True)
        checked_float("step", self.step, allowed, "A particle collides at most twice in a step.")

    def check(self, gas: Gas) -> None:
        """Raise ValueError if the law of restitution heats the gas."""
        checks.check_cools(*checks.first_cooling_rate(gas))

    def estimated_error(self, error_model: ErrorModel) -> float:
        """Estimated relative error of T by `rate_error` and the shot noise of all replicas."""
        noise = error_model.shot_noise(self.num_particles * self.replicas)
        return hypot(error_model.error_of_temperature(self.rate_error(error_model)), noise)

    def rate_error(self, error_model: ErrorModel) -> Float[np.ndarray, "times"]:
        """Relative error of Enskog's rate, by contacts that last and are soft, and by walls."""
        return (
            error_model.homogeneous
            + error_model.lasting_contacts
            + error_model.softness
            + error_model.mixing
        )

    def limitations(self, gas: Gas, num_particles: int | None = None) -> tuple[Limitation, ...]:
        """Return limitations by contacts that last, correlated collisions, and a growing flow."""
        contacts = checks.limitations_of_instant_impacts(gas)
        return contacts + checks.limitations_of_homogeneity(gas, num_particles)

    def simulate(self, gas: Gas, times: Float[Array, "times"], run: Run = DEFAULTS) -> CoolingCurve:
        """Return the cooling curve at the given times, s; see `jaxgran.AbstractModel.simulate`.

        A run fails if too many pairs are faster than the ceiling of the collision rate.
        """
        unreachable_times = checks.unreachable_with_drag(gas, times)
        words = _key_words(run)
        scheme = Scheme.of(gas.dimension, self.num_particles, self.step)
        dynamics = DSMCDynamics(reduced_scene(gas), scheme)
        reduced = times * gas.impact_speed / gas.path_length
        if dynamics.scene.drag is not None:
            reduced = transformed_times(dynamics.scene.drag, reduced)
        units = snapshot.Units.of(gas, self.num_particles, gas.path_length, gas.impact_speed)
        if any_traced(gas, times, words):
            checks.refuse_files(self, run)
            options = {"units": units, "save": snapshot.save_function(run.save)}
            records = differentiable_run(
                dynamics, reduced, words, replicas=self.replicas, **options
            )
        elif on := replica_devices(self.replicas):
            single = dataclasses.replace(self, replicas=1)

            def run_replica(k: int, run: Run) -> dict[str, Array]:
                return single._run_on_host(dynamics, reduced, _key_words(run), units, run)

            records = join_records(run_replicas(run_replica, self.replicas, run, on))
        else:
            records = self._run_on_host(dynamics, reduced, words, units, run)
        curve, failed = _curve(gas, times, records, unreachable_times)
        size = self.replicas, self.num_particles
        rough = gas.surface is not None
        like = snapshot.particle_shapes(units, size, gas.dimension, times.dtype, rough)
        return snapshot.attach_saved(curve, run.save, records, like, failed)

    def _run_on_host(
        self,
        dynamics: DSMCDynamics,
        times: Float[Array, "times"],
        words: UInt32[Array, "2"],
        units: snapshot.Units,
        run: Run,
    ) -> dict[str, Array]:
        """Run on the host, with progress and checkpoints, and return the records."""
        new = needs_compilation((jax.tree.structure(dynamics), self.replicas, times.dtype))
        with compiling(run.progress and new):
            start, advance, observe = host_run_parts(
                dynamics, words, replicas=self.replicas, donate=run.checkpoint is None
            )
            recorded = partial(observe, units=units, save=snapshot.save_function(run.save))
            if new:  # compile with a call of zero steps; it may delete its state, so copy that
                jax.block_until_ready(recorded(advance(jax.tree.map(jnp.copy, start), 0.0)))
        description = {}
        if run.checkpoint is not None:
            fixed = {"dynamics": dynamics, "times": times, "key": words, "model": self}
            description = describe_run(**fixed, save=run.save)
        _, records, fault = run_through_times(
            start,
            np.asarray(times),
            lambda state, end: block_until_ready(advance(state, end)),
            recorded,
            shown=observe,
            scene=description,
            progress=run.progress,
            path=run.checkpoint,
        )
        records["fault"][np.isnan(records["temperature"])] |= fault  # a fault of the driver
        return {name: jnp.asarray(value) for name, value in records.items()}


def _key_words(run: Run) -> UInt32[Array, "2"]:
    """Return two random words from a key of any kind."""
    key = jax.random.key(0) if run.key is None else run.key
    return jax.random.bits(key, (2,), jnp.uint32)


def _curve(
    gas: Gas,
    times: Float[Array, "times"],
    records: dict[str, Array],
    unreachable_times: Bool[Array, "times"],
) -> tuple[CoolingCurve, Bool[Array, "replicas times"]]:
    """Return the curve in SI units and a mask of its nan values.

    A replica is nan from its first fault on, and all replicas are nan at unreachable times.
    """
    fault = records["fault"] | status.flag(status.OUT_OF_RANGE, unreachable_times)[:, None]
    failed = jnp.cumsum(fault != status.OK, axis=0) > 0
    records = {name: x for name, x in records.items() if name in QUANTITIES}
    if gas.container is not None:  # walls would limit <dr^2>
        records.pop("displacement", None)
    values = records_in_si(
        {name: jnp.where(failed, jnp.nan, x) for name, x in records.items()},
        length=gas.path_length,
        temperature=gas.temperature,
        mass=gas.mass,
    )
    status_of_all = jnp.bitwise_or.reduce(fault, axis=None)
    return CoolingCurve.of_replicas(times, values, status=status_of_all), failed.T
