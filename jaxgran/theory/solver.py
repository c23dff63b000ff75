"""Integration of the equations of a homogeneous gas: its moments at given times, and derivatives.

`integrate_at` solves ordinary differential equations with output at given times. diffrax makes the
steps and chooses their sizes. The loop around them is written here because it takes half as long to
compile as `diffrax.diffeqsolve` with its events, adjoints and rounding of times.

`MomentSolver.moments` has one linear rule for forward and reverse mode: the tangents of those
parameters of the scene that change are integrated together with the state, in the same steps, so
that they are the derivatives of the discrete solution at fixed steps. A scene has few parameters in
reduced units, and mostly one of them changes. `MomentSolver.moments_along` integrates tangents
along given directions instead.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.custom_derivatives import SymbolicZero
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from jaxgran._utils import status
from jaxgran.theory.equations import Equations, SceneAndDensity
from jaxgran.theory.moments import Moments

FIRST_STEP = 0.01
"""First step, before the error of a step is known; it is shortened where it is too long."""

WINDOW = 16
"""Number of output times that are interpolated together."""


def padded_length(size: int) -> int:
    """Return the smallest length of a geometric grid, `WINDOW` times a power of 2, >= `size`.

    Output times are padded to it, so that few lengths are compiled.
    """
    return WINDOW * 2 ** max(0, (size - 1) // WINDOW).bit_length()


class _Progress(NamedTuple):
    """Progress of an integration.

    Attributes:
        time: reached by the accepted steps.
        state: y at this time.
        values: y at the output times, shape (times, ...); y(0) at those not reached.
        num_known: number of output times that are reached.
        num_steps: number of steps tried.
        step_end: end of the next step.
        solver_state, control: states of the solver and of the controller of the steps.
    """

    time: Float[Array, ""]
    state: Array
    values: Array
    num_known: Int[Array, ""]
    num_steps: Int[Array, ""]
    step_end: Float[Array, ""]
    solver_state: Any
    control: Any


def _fill_values(
    evaluate: Callable[[Array], Array],
    times: Float[Array, "times"],
    reached: Float[Array, ""],
    values: Float[Array, "times ..."],
    known: Int[Array, ""],
) -> tuple[Float[Array, "times ..."], Int[Array, ""]]:
    """Return values at the output times, filled in up to a reached time, and how many are known.

    Args:
        evaluate: returns the value at a time of the last step.
        times: of the output.
        reached: end of the last step; -1 if it was rejected.
        values: known before this step.
        known: number of these.
    """

    window = min(WINDOW, times.size)

    def some_left(at):
        next_time = times[jnp.minimum(at[1], times.size - 1)]
        return (at[1] < times.size) & (next_time <= reached)

    def fill(at):
        values, known = at
        begin = jnp.minimum(known, times.size - window)
        t = jax.lax.dynamic_slice_in_dim(times, begin, window)
        old = jax.lax.dynamic_slice_in_dim(values, begin, window)
        inside = (begin + jnp.arange(window) >= known) & (t <= reached)
        inside = jnp.expand_dims(inside, tuple(range(1, old.ndim)))
        new = jnp.where(inside, jax.vmap(evaluate)(t), old)
        values = jax.lax.dynamic_update_slice_in_dim(values, new, begin, 0)
        return values, begin + jnp.sum(t <= reached)

    return jax.lax.while_loop(some_left, fill, (values, known))


def integrate_at(
    vector_field: Callable[[Any, Array], Array],
    start: Array,
    times: Float[Array, "times"],
    *,
    solver: diffrax.AbstractSolver,
    controller: diffrax.AbstractAdaptiveStepSizeController,
    max_steps: int,
) -> tuple[Float[Array, "times ..."], Bool[Array, ""]]:
    """Return the solution of ``dy/dt = vector_field(t, y)`` from t = 0 at given times.

    It is interpolated between the steps, to the order of an explicit solver.

    Args:
        vector_field: a function of a time and a state.
        start: y(0), any shape.
        times: not decreasing, >= 0.
        solver: an explicit one with ``scan_kind="lax"`` compiles fastest. Other methods than
            explicit Runge-Kutta are run by `diffrax.diffeqsolve`.
        controller: of the step sizes.
        max_steps: largest number of steps, including rejected ones.

    Returns:
        The states at those times, and False if `max_steps` ended the integration. The states at
        the times that were not reached then mean nothing: they are y(0), or inf by diffrax. Where
        diffrax fails for another reason all states are nan.
    """
    term = diffrax.ODETerm(lambda t, y, args: vector_field(t, y))
    if not isinstance(solver, diffrax.AbstractERK):
        if isinstance(solver, diffrax.AbstractImplicitSolver):
            # Their dense output is only of third order: step to every requested time instead.
            controller = diffrax.ClipStepSizeController(controller, step_ts=times)
        solution = diffrax.diffeqsolve(
            term,
            solver,
            t0=jnp.zeros((), times.dtype),
            t1=times[-1],
            dt0=None,
            y0=start,
            saveat=diffrax.SaveAt(ts=times),
            stepsize_controller=controller,
            adjoint=diffrax.ForwardMode(),
            max_steps=max_steps,
            throw=False,  # one member of a batch must not end the others
        )
        assert solution.ys is not None
        reached = solution.result != diffrax.RESULTS.max_steps_reached
        failed = reached & (solution.result != diffrax.RESULTS.successful)
        return jnp.where(failed, jnp.nan, solution.ys), reached

    last = times[-1]
    order: Any = solver.error_order(term)
    zero = jnp.zeros((), times.dtype)
    first = jnp.asarray(FIRST_STEP, times.dtype)
    end, control = controller.init(term, zero, last, start, first, None, solver.func, order)
    end = jnp.minimum(jnp.asarray(end), last)
    solver_state = solver.init(term, zero, end, start, None)
    # As arrays, so that their types do not change from step to step.
    solver_state, control = jax.tree.map(jnp.asarray, (solver_state, control))
    begun = _Progress(
        time=zero,
        state=start,
        values=jnp.broadcast_to(start, (times.size, *start.shape)),
        num_known=jnp.zeros((), int),
        num_steps=jnp.zeros((), int),
        step_end=end,
        solver_state=solver_state,
        control=control,
    )

    def is_unfinished(now: _Progress) -> Bool[Array, ""]:
        return (now.time < last) & (now.num_steps < max_steps)

    def step(now: _Progress) -> _Progress:
        begin = now.time
        end = now.step_end
        state, error, dense, solver_state, _ = solver.step(
            term, begin, end, now.state, None, now.solver_state, False
        )
        # An infinite error makes the controller repeat the step with a shorter one.
        error = jnp.where(jnp.isnan(error), jnp.inf, error)
        accepted, time, step_end, _, control, _ = controller.adapt_step_size(
            begin, end, now.state, state, None, error, order, now.control
        )
        piece = solver.interpolation_cls(t0=begin, t1=end, **dense)
        reached = jnp.where(accepted, end, -1.0)
        values, known = _fill_values(piece.evaluate, times, reached, now.values, now.num_known)
        state, solver_state = jax.tree.map(
            partial(jnp.where, accepted), (state, solver_state), (now.state, now.solver_state)
        )
        # Avoid a very short last step.
        step_end = jnp.where(step_end > last - 1e-3 * (step_end - time), last, step_end)
        control = jax.tree.map(jnp.asarray, control)
        return _Progress(
            jnp.asarray(time),
            state,
            values,
            known,
            now.num_steps + 1,
            step_end,
            solver_state,
            control,
        )

    ended = jax.lax.while_loop(is_unfinished, step, begun)
    return ended.values, ended.time >= last


class MomentSolver(NamedTuple):
    """How the moments of a gas are integrated.

    Attributes:
        equations: of the moments.
        solver: of diffrax.
        rtol: relative tolerance; may be traced.
        max_steps: largest number of steps.
    """

    equations: Equations
    solver: diffrax.AbstractSolver
    rtol: Any
    max_steps: int

    def moments(
        self, scene: SceneAndDensity, times: Float[Array, "times"]
    ) -> tuple[Moments, Int[Array, ""]]:
        """Return the moments of a gas at some reduced times, and a status.

        Args:
            scene: its floats can be differentiated, forward and reverse.
            times: not decreasing, >= 0.

        Returns:
            The moments, each of shape (times,), nan unless the status is ok; and the status.
        """
        equations = self.equations
        dtype = times.dtype
        leaves, structure = jax.tree.flatten(scene)
        leaves = [jnp.asarray(x, dtype) for x in leaves]

        @jax.custom_jvp
        def solve(leaves: list[Array], times: Array) -> tuple[Moments, Int[Array, ""]]:
            scene = structure.unflatten(leaves)
            table = equations.table(scene, times[-1])
            start = equations.initial(scene, times)

            def derivative(row):
                return equations.derivative(row, table(row[0]), scene)

            parameters = _ravel(leaves, dtype)
            rows, fault = self._integrate(jax.vmap(derivative), start[None], parameters, times)
            return equations.moments(rows[:, 0].T), fault

        @partial(solve.defjvp, symbolic_zeros=True)
        def solve_jvp(primals, tangents):
            leaves, times = primals
            along, times_along = tangents
            changing = [np.full(x.size, not _is_zero(x)) for x in along]
            units = np.eye(sum(x.size for x in along))
            units = units[np.concatenate([np.zeros(0, bool), *changing])]
            amounts = _ravel([x for x in along if not _is_zero(x)], dtype)
            scene = structure.unflatten(leaves)
            moments, slopes, rates, fault = self._along(scene, times, jnp.asarray(units, dtype))
            changes = jax.tree.map(lambda j: amounts @ j, slopes)
            if not _is_zero(times_along):
                changes = jax.tree.map(lambda m, v: m + v * times_along, changes, rates)
            no_tangent: Any = np.zeros(fault.shape, jax.dtypes.float0)  # of an integer
            return (moments, fault), (changes, no_tangent)

        return solve(leaves, times)

    def moments_along(
        self,
        scene: SceneAndDensity,
        times: Float[Array, "times"],
        scene_along: SceneAndDensity,
        times_along: Float[Array, "directions times"],
    ) -> tuple[Moments, Moments, Int[Array, ""]]:
        """Return the moments of a gas, their derivatives along some directions, and a status.

        The derivatives are integrated beside the moments, in the same steps. It costs less than
        differentiating `moments` where the directions are fewer than the floats of the scene.

        Args:
            scene, times: as of `moments`.
            scene_along: tangents of the floats of the scene, with a first axis (directions,).
            times_along: tangents of the times.

        Returns:
            The moments, shape (times,); their derivatives, shape (directions, times); and the
            status. All are nan unless it is ok.
        """
        dtype = times.dtype
        leaves = [jnp.asarray(x, dtype) for x in jax.tree.leaves(scene_along)]
        directions = jnp.concatenate([x.reshape(len(x), -1) for x in leaves], axis=1)
        moments, slopes, rates, fault = self._along(scene, times, directions)
        changes = jax.tree.map(lambda m, v: m + v[None] * times_along, slopes, rates)
        return moments, changes, fault

    def _along(
        self,
        scene: SceneAndDensity,
        times: Float[Array, "times"],
        directions: Float[Array, "directions parameters"],
    ) -> tuple[Moments, Moments, Moments, Int[Array, ""]]:
        """Return moments, their derivatives along directions of the parameters and in time, and a
        status."""
        equations = self.equations
        dtype = times.dtype
        leaves, structure = jax.tree.flatten(scene)
        leaves = [jnp.asarray(x, dtype) for x in leaves]
        parameters = _ravel(leaves, dtype)
        _, unravel = ravel_pytree(structure.unflatten(leaves))
        # A function of the parameters: all leaves of the scene, one after the other.
        table, table_along = jax.linearize(
            lambda parameters: equations.table(unravel(parameters), times[-1]), parameters
        )
        table = table.with_slopes(jax.vmap(lambda x: table_along(x).coefficients)(directions))

        @jax.jit  # traced once
        def derivative(state, rates, parameters):
            return equations.derivative(state, rates, unravel(parameters))

        @jax.jit  # traced once
        def rows_derivative(rows):
            # Row 0 is the state; the others, its tangents, obey the linearised equation.
            rates, slope, *_ = at = table(rows[0, 0])
            rate, linear = jax.linearize(derivative, rows[0], rates, parameters)

            def along(tangent, rates_along, direction):
                return linear(tangent, rates_along + slope * tangent[0], direction)

            return jnp.concatenate([rate[None], jax.vmap(along)(rows[1:], at[2:], directions)])

        start, start_along = jax.linearize(
            lambda parameters: equations.initial(unravel(parameters), times), parameters
        )
        first = jnp.concatenate([start[None], jax.vmap(start_along)(directions)])
        rows, fault = self._integrate(rows_derivative, first, parameters, times)
        states = rows[:, 0]
        rates = jax.vmap(lambda x: derivative(x, table(x[0])[0], parameters))(states)
        slopes = equations.moments(rows[:, 1:].T)
        return equations.moments(states.T), slopes, equations.moments(rates.T), fault

    def _integrate(
        self, derivative: Callable, first: Array, parameters: Array, times: Array
    ) -> tuple[Array, Int[Array, ""]]:
        """Return the rows at the given times, shape (times, rows, states), and a status."""
        dtype = times.dtype
        controlling = self.equations.controlling
        inputs_finite = jnp.all(jnp.isfinite(parameters)) & jnp.all(jnp.isfinite(times))
        # With nan parameters the state stays constant, so that the solver does not shorten its
        # steps.
        times = jnp.where(inputs_finite, times, jnp.linspace(1.0, 2.0, times.size, dtype=dtype))
        # Only the state controls the steps, so tangents are its derivatives at fixed steps.
        controller = diffrax.PIDController(
            rtol=self.rtol,
            atol=self.rtol,
            norm=lambda rows: optx.rms_norm(rows[0][controlling]),
        )
        rows, completed = integrate_at(
            # s = ln(1 + t): a power law of time takes the same number of steps each decade.
            lambda s, rows: jnp.where(inputs_finite, derivative(rows) * jnp.exp(s), 0.0),
            jnp.where(inputs_finite, first, 0.0),
            jnp.log1p(times),
            solver=self.solver,
            controller=controller,
            max_steps=self.max_steps,
        )
        finite = inputs_finite & jnp.all(jnp.isfinite(rows))
        fault = status.flag(status.MAX_STEPS_REACHED, ~completed)
        fault |= status.flag(status.NOT_FINITE, completed & ~finite)
        return jnp.where(fault == status.OK, rows, jnp.nan), fault


def _ravel(leaves: list[Array], dtype: Any) -> Float[Array, "parameters"]:
    return jnp.concatenate([jnp.zeros(0, dtype), *map(jnp.ravel, leaves)])


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, SymbolicZero)
