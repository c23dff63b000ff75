"""Kinetic theory: the homogeneous gas as five ordinary differential equations."""

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from jaxgran.checks import status, validation
from jaxgran.checks.tracing import any_traced, lengthened, shortened
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.run import DEFAULTS, Run
from jaxgran.models import checks
from jaxgran.models.base import AbstractModel, Omission
from jaxgran.models.course import ROUGH, Course
from jaxgran.scene.gas import Gas
from jaxgran.scene.reduced_scene import ReducedScene, reduced_scene
from jaxgran.theory import averages, closed_forms, elements, moments, rate_table, steady
from jaxgran.theory.integration import padded_length, values_at
from jaxgran.theory.moments import Moments

TOLERANCES = validation.Domain(0.0, 0.1)
"""Relative tolerances of the solver."""


class KineticTheory(AbstractModel):
    """The homogeneous cooling gas, by Maxwell-Sonine kinetic theory; integrated with diffrax.

    ``dT/dt = -(2/d) mu_2 T (1 - c X_T/sigma)``,
    ``da_2/dt = (4/d) mu_2 (1 + a_2) - 4 mu_4/(d(d+2))``,
    ``dD/dt = T - nu_v D``, ``d<dr^2>/dt = 2 d D``, ``dN/dt = nu``, all but T from 0,
    with averages exact in eps(v) (`jaxgran.theory.averages.averages`). Leaves out correlations,
    clustering and three-body contacts: right for dilute gases in boxes below L_c whose contacts are
    short. The averages assume that eps(v) is smooth: for a law of your own with a kink, such as an
    eps capped at 1, use `jaxgran.DSMC`; T of ice, whose impacts become elastic at low speed, is 3 %
    off after some 1e5 mean free times, and the error grows.

    The curve is differentiable in every float of the gas and in the times, forward and reverse.
    Second derivatives are forward over forward or over reverse: `jax.hessian` or
    ``jax.jacfwd(jax.jacfwd(...))``, not ``jax.jacrev(jax.jacrev(...))``.

    Args:
        sonine: follow a_2; otherwise the gas stays Maxwellian.
        softness: the first correction for contacts of finite duration (viscoelastic spheres).
        averages: "exact", or "paper" for the paper's truncated b_1, b_2 and tau_v (viscoelastic
            law, which then must have delta < 0.43; Maxwellian).
        rtol: relative tolerance of the adaptive solver; by default 1e-9 in float64, 1e-5 in
            float32. T is wrong by about ten times as much.
        solver: a diffrax solver. The default suits up to some 1e6 collisions per particle; for
            more (A near 0 over many decades of time) use ``diffrax.Kvaerno5()``.
        max_steps: the most steps of one curve.

    Raises:
        ValueError: for values out of range.

    Reference: van Noije & Ernst 1998 for the averages; Brilliantov & Poeschel for the gas. D is
    the first Sonine approximation: 1.7 % (3D), 2.4 % (2D) below the exact elastic value of a
    dilute gas; at packing fraction phi collisions are correlated, and D is greater by another
    0.85 phi.

    >>> jaxgran.cool(gas, times, model=jaxgran.KineticTheory()).sonine.shape
    (4,)
    """

    sonine: validation.UserTruth = eqx.field(static=True, default=True)
    softness: validation.UserTruth = eqx.field(static=True, default=True)
    averages: str = eqx.field(static=True, default="exact")
    rtol: validation.UserFloat | None = eqx.field(static=True, default=None)
    solver: Any = eqx.field(static=True, default=diffrax.Tsit5(scan_kind="lax"))
    max_steps: validation.UserCount = eqx.field(static=True, default=200_000)

    def __check_init__(self):
        validation.truth_value("sonine", self.sonine)
        validation.truth_value("softness", self.softness)
        if self.averages not in ("exact", "paper"):
            raise ValueError(f'averages must be "exact" or "paper", got {self.averages!r}')
        if self.rtol is not None:
            validation.plain_number(
                "rtol", self.rtol, TOLERANCES, "Leave it out for 1e-9 (float32: 1e-5)."
            )
        if not isinstance(self.solver, diffrax.AbstractSolver):
            raise ValueError(
                f"solver must be a diffrax solver such as diffrax.Kvaerno5(), got {self.solver!r}"
            )
        validation.whole_number("max_steps", self.max_steps, 1, "Leave it out for 200000.")

    stochastic: ClassVar[bool] = False
    elements: ClassVar[tuple[str, ...]] = ("surface", "container", "drag", "drive", "preparation")
    derivative_accuracy: ClassVar[float] = 0.015  # of dilute gases, phi = .05, by particle runs

    def displacement_accuracy(self, gas: Gas) -> Float[Array, ""]:
        """Relative error of <dr^2>: first Sonine order of D, and correlated collisions.

        Kinetic theory takes successive collisions as uncorrelated. Hard spheres diffuse faster than
        Enskog's theory says, by the share 0.85 phi up to phi = .2 (Speedy, Mol. Phys. 62 (1987)
        509); the same is assumed for disks.
        """
        correlation = 0.85 * jnp.minimum(gas.packing_fraction, 0.2)
        first_order = {2: 0.024, 3: 0.017}[gas.dimension]
        if gas.surface is not None:  # spins and velocities are correlated: DSMC, beta_t = .5
            first_order += 0.07
        return jnp.hypot(first_order, correlation)

    def cooling_rate(self, gas: Gas) -> Float[Array, ""]:
        """``-d ln T/dt`` at t = 0, 1/s, of the Maxwellian gas; negative if the law heats it."""
        return checks.first_cooling_rate(gas, self._averages)

    def check(self, gas: Gas) -> None:
        """Raise ValueError for a law that heats the gas or contacts too soft for the theory."""
        if any_traced(gas):
            return
        rate, factor, hottest = _at_start(gas, self._averages)
        if self.softness:
            checks.check_softness(gas, factor, hottest)
        checks.check_cools(rate)

    def estimated_error(self, course: Course) -> float:
        """Of Enskog's rate, lasting contacts and the terms beyond a_2 and the first softness."""
        return course.error_of_temperature(self.rate_error(course))

    def rate_error(self, course: Course) -> Float[np.ndarray, "times"]:
        """The same, of the cooling rate."""
        softness = course.second_order_softness if self.softness else course.softness
        elements = course.mixing + (0.0 if course.gas.surface is None else ROUGH)
        rate = course.homogeneous + course.lasting_contacts + softness + course.truncation
        return rate + elements

    def omissions(self, gas: Gas, num_particles: int | None = None) -> tuple[Omission, ...]:
        """Contacts that last, correlated collisions and boxes in which a flow grows."""
        beyond = "beyond the first-order softness correction"
        return checks.omitted_by_instant_impacts(gas, beyond) + checks.omitted_by_homogeneity(
            gas, num_particles
        )

    def simulate(self, gas: Gas, times: Float[Array, "times"], run: Run = DEFAULTS) -> CoolingCurve:
        """The cooling curve at the given times, s; see `jaxgran.AbstractModel.simulate`."""
        size = times.size
        padded = lengthened(times, padded_length(size))
        curve = self._simulate(gas, padded)
        return jax.tree.map(lambda x: shortened(x, size) if x.ndim else x, curve)

    @eqx.filter_jit
    def _simulate(self, gas: Gas, times: Float[Array, "times"]) -> CoolingCurve:
        unit_time = gas.path_length / gas.impact_speed
        scene = reduced_scene(gas)
        parameters, unravel = ravel_pytree(scene)
        if parameters.size == 0:  # a law of no floats: jax gives none of them a type of its own
            parameters, unravel = jnp.zeros(0, times.dtype), lambda _: scene

        # In reduced units the gas has one or two parameters: following all their tangents beside
        # the state costs little, and one linear rule then serves forward and reverse mode alike.
        @jax.custom_jvp
        def solve(parameters, times):
            return self._solve(parameters, unravel, times, gas.dimension)

        @solve.defjvp
        def solve_jvp(at, along):
            parameters, times = at
            solution = self._solve_along(parameters, unravel, times, gas.dimension)
            state, velocity, jacobian, fault = solution
            moved = jax.tree.map(lambda v, j: v * along[1] + along[0] @ j, velocity, jacobian)
            no_tangent: Any = np.zeros(fault.shape, jax.dtypes.float0)  # of a whole number
            return (state, fault), (moved, no_tangent)

        state, fault = solve(parameters, times / unit_time)
        theta = jnp.exp(state.log_temperature)
        length = gas.path_length
        # Added last: compiled in float32, exp(nan) can be a number (jaxlib 0.10.1 on a CPU).
        spoilt = jnp.where(fault == status.OK, 0.0, jnp.nan).astype(theta.dtype)
        temperature, further = gas.temperature * theta + spoilt, {}
        if state.rotation is not None:
            further["rotational_temperature"] = temperature * state.rotation
        if gas.container is None:  # else spheres do not go far
            diffusion = state.diffusion * jnp.sqrt(theta) * length * gas.impact_speed
            further["diffusion"] = diffusion + spoilt
            further["displacement"] = state.displacement * length**2 + spoilt
        return CoolingCurve(
            times=times,
            temperature=temperature,
            sonine=state.sonine + spoilt,
            collisions=state.collisions + spoilt,
            status=fault,
            **further,
        )

    @property
    def _averages(self) -> Callable[..., Array]:
        """The averages over impacts, a function of law, speed and dimension."""
        return averages.averages if self.averages == "exact" else closed_forms.paper_averages

    def _velocity(self, state: Array, rates: Array, scene: ReducedScene, dimension: int) -> Array:
        """Time derivative of the state, in reduced time."""
        maxwellian = not self.sonine or self.averages == "paper"
        options = {"softness": self.softness, "maxwellian": maxwellian}
        return moments.velocity(state, rates, scene, dimension, **options)

    def _table(self, scene: ReducedScene, times: Array, dimension: int) -> rate_table.RateTable:
        """The averages at all temperatures that the gas reaches."""
        averages_of = partial(self._averages, scene.law, dimension=dimension)
        num_nodes, bounds = scene.law.num_nodes, elements.fastest_cooling(scene, dimension)
        return rate_table.RateTable.of(averages_of, times[-1], dimension, num_nodes, bounds)

    def _start(self, scene: ReducedScene, times: Array, dimension: int) -> Array:
        """The state at t = 0, as one array."""
        first = Moments.at_start(scene, times)
        if scene.prepared is None or not self.sonine:
            return first
        return first.at[1].set(steady.prepared_sonine(scene, times, dimension))

    def _solve(
        self, parameters: Array, unravel: Callable[[Array], ReducedScene], times: Array, d: int
    ) -> tuple[Moments, Int[Array, ""]]:
        """The states, nan unless the status, which follows them, is ok."""
        scene = unravel(parameters)
        table = self._table(scene, times, d)

        def velocity(row):
            return self._velocity(row, table(row[0]), scene, d)

        start = self._start(scene, times, d)
        rows, fault = self._integrate(jax.vmap(velocity), start[None], parameters, times)
        return Moments(*rows[:, 0].T), fault

    def _solve_along(
        self, parameters: Array, unravel: Callable[[Array], ReducedScene], times: Array, d: int
    ) -> tuple[Moments, Moments, Moments, Int[Array, ""]]:
        """States, their time derivatives and their derivatives in the parameters of the law.

        Last, a status; unless it is ok all of them are nan.
        """
        directions = jnp.eye(parameters.size, dtype=times.dtype)
        table, table_along = jax.linearize(
            lambda parameters: self._table(unravel(parameters), times, d), parameters
        )
        table = table.with_slopes(jax.vmap(lambda x: table_along(x).coefficients)(directions))

        def velocity(state, rates, parameters):
            return self._velocity(state, rates, unravel(parameters), d)

        def rows_velocity(rows):
            # Row 0 is the state; the others, its tangents, obey the linearised equation.
            rates, slope, *_ = at = table(rows[0, 0])
            rate, linear = jax.linearize(velocity, rows[0], rates, parameters)

            def along(tangent, rates_along, direction):
                return linear(tangent, rates_along + slope * tangent[0], direction)

            return jnp.concatenate([rate[None], jax.vmap(along)(rows[1:], at[2:], directions)])

        start, start_along = jax.linearize(
            lambda parameters: self._start(unravel(parameters), times, d), parameters
        )
        first = jnp.concatenate([start[None], jax.vmap(start_along)(directions)])
        rows, fault = self._integrate(rows_velocity, first, parameters, times)
        states, jacobian = rows[:, 0], jnp.moveaxis(rows[:, 1:], 2, 0)
        velocities = jax.vmap(lambda x: velocity(x, table(x[0])[0], parameters))(states)
        jacobian = jnp.swapaxes(jacobian, 1, 2)
        return Moments(*states.T), Moments(*velocities.T), Moments(*jacobian), fault

    def _integrate(
        self, velocity: Callable, first: Array, parameters: Array, times: Array
    ) -> tuple[Array, Int[Array, ""]]:
        """The rows at the given reduced times, shape (times, rows, states), and a status."""
        known = jnp.all(jnp.isfinite(parameters)) & jnp.all(jnp.isfinite(times))
        # A gas of nan keeps its state, so that its solver does not try ever shorter steps.
        times = jnp.where(known, times, jnp.linspace(1.0, 2.0, times.size, dtype=times.dtype))
        rtol = self.rtol or (1e-9 if times.dtype == jnp.float64 else 1e-5)
        # Steps follow the state alone: its tangents are then those of the discrete solution.
        controller = diffrax.PIDController(
            rtol=rtol, atol=rtol, norm=lambda rows: optx.rms_norm(rows[0])
        )
        rows, ended = values_at(
            # s = ln(1 + t): a power law of time takes the same number of steps each decade.
            lambda s, rows: jnp.where(known, velocity(rows) * jnp.exp(s), 0.0),
            jnp.where(known, first, 0.0),
            jnp.log1p(times),
            solver=self.solver,
            controller=controller,
            max_steps=self.max_steps,
        )
        finite = known & jnp.all(jnp.isfinite(rows))
        fault = status.flag(status.STEPS_SPENT, ~ended)
        fault |= status.flag(status.NOT_FINITE, ended & ~finite)
        return jnp.where(fault == status.OK, rows, jnp.nan), fault


@eqx.filter_jit
def _at_start(gas: Gas, averages_of: Callable[..., Array]) -> tuple[Array, Array, Array]:
    """The first cooling rate, the softness factor where it is hottest, and sqrt(T/T_0) there."""
    one = jnp.ones_like(gas.temperature)
    hottest = one if gas.drive is None else steady.hottest_speed(gas)
    factor = averages.softness_factor(gas.reduced_law, hottest, gas.dimension)
    return checks.first_cooling_rate(gas, averages_of), factor, hottest
