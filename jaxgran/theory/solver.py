"""The moments of a homogeneous gas at given times, and their derivatives.

One linear rule serves forward and reverse mode: the tangents of those parameters of the scene that
move are integrated beside the state, in the same steps, so that they are the derivatives of the
discrete solution. A scene has few parameters in reduced units, of which mostly one moves.

Integration of ordinary differential equations with output at given times.

The steps and their sizes are those of diffrax; the loop around them is written here, because it is
half as much to compile as `diffrax.diffeqsolve` with its events, adjoints and rounding of times.
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
from jaxgran.theory.equations import Equations, Moments, Scene

FIRST_STEP = 0.01
"""The first step, before the error of a step is known; it is shortened where it is too long."""

WINDOW = 16
"""Output times that are interpolated together. Their number must be a multiple of it."""


class _Progress(NamedTuple):
    # Of the loop over steps: the next step, the state before it, what solver and controller
    # remember, the values at output times, how many of these are known, and the steps made.
    t: Float[Array, ""]
    end: Float[Array, ""]
    y: Array
    solver: Any
    control: Any
    values: Array
    known: Int[Array, ""]
    steps: Int[Array, ""]


def padded_length(size: int) -> int:
    """The least length of a geometric grid, `WINDOW` times a power of 2, that is not below `size`.

    Output times are padded to it, so that few lengths are compiled.
    """
    return WINDOW * 2 ** max(0, (size - 1) // WINDOW).bit_length()


def integrate_at(
    velocity: Callable[[Any, Array], Array],
    start: Array,
    times: Float[Array, "times"],
    *,
    solver: diffrax.AbstractSolver,
    controller: diffrax.AbstractAdaptiveStepSizeController,
    max_steps: int,
) -> tuple[Float[Array, "times ..."], Bool[Array, ""]]:
    """Solution of ``dy/dt = velocity(t, y)`` from t = 0 at given times.

    It is interpolated between the steps, to the order of an explicit solver.

    Args:
        velocity: of a time and a state.
        start: y(0), any shape.
        times: not decreasing, >= 0; a multiple of `WINDOW`.
        solver: an explicit one with ``scan_kind="lax"`` compiles fastest. What is no explicit
            Runge-Kutta method is left to `diffrax.diffeqsolve`.
        controller: of the step sizes.
        max_steps: the most steps, refused ones included.

    Returns:
        The states at those times, and whether the last time was reached within that number of
        steps; nan where the solver failed otherwise.
    """
    term = diffrax.ODETerm(lambda t, y, args: velocity(t, y))
    if isinstance(solver, diffrax.AbstractERK):
        return _by_steps(term, start, times, solver, controller, max_steps)
    return _by_diffrax(term, start, times, solver, controller, max_steps)


def _by_steps(
    term: diffrax.ODETerm,
    start: Array,
    times: Array,
    solver: diffrax.AbstractERK,
    controller: diffrax.AbstractAdaptiveStepSizeController,
    max_steps: int,
) -> tuple[Array, Array]:
    """The same by a loop over the steps of an explicit solver."""
    last = times[-1]
    order: Any = solver.error_order(term)
    zero, first = jnp.zeros((), times.dtype), jnp.asarray(FIRST_STEP, times.dtype)
    end, control = controller.init(term, zero, last, start, first, None, solver.func, order)
    end = jnp.minimum(jnp.asarray(end), last)
    begun = solver.init(term, zero, end, start, None)
    # As arrays, whose types do not change from step to step.
    begun, control = jax.tree.map(jnp.asarray, (begun, control))
    values = jnp.broadcast_to(start, (times.size, *start.shape))
    none = jnp.zeros((), int)
    progress = _Progress(zero, end, start, begun, control, values, none, none)

    def unfinished(at: _Progress) -> Array:
        return (at.t < last) & (at.steps < max_steps)

    def step(at: _Progress) -> _Progress:
        y, error, dense, solver_state, _ = solver.step(
            term, at.t, at.end, at.y, None, at.solver, False
        )
        error = jnp.where(jnp.isnan(error), jnp.inf, error)  # such a step is made shorter
        kept, t, end, _, control, _ = controller.adapt_step_size(
            at.t, at.end, at.y, y, None, error, order, at.control
        )
        piece = solver.interpolation_cls(t0=at.t, t1=at.end, **dense)
        reached = jnp.where(kept, at.end, -1.0)
        values, known = _interpolated(piece.evaluate, times, reached, at.values, at.known)
        y, solver_state = jax.tree.map(
            lambda new, old: jnp.where(kept, new, old), (y, solver_state), (at.y, at.solver)
        )
        near = jnp.where(end > last - 1e-3 * (end - t), last, end)  # no sliver of a last step
        control = jax.tree.map(jnp.asarray, control)
        return _Progress(
            jnp.asarray(t), near, y, solver_state, control, values, known, at.steps + 1
        )

    done = jax.lax.while_loop(unfinished, step, progress)
    return done.values, done.t >= last


def _interpolated(
    evaluate: Callable[[Array], Array], times: Array, reached: Array, values: Array, known: Array
) -> tuple[Array, Int[Array, ""]]:
    """The values with those up to a reached time filled in, and how many are known then."""

    def next_time(known):
        return times[jnp.minimum(known, times.size - 1)]

    def some_left(at):
        return (at[1] < times.size) & (next_time(at[1]) <= reached)

    def fill(at):
        values, known = at
        begin = jnp.minimum(known, times.size - WINDOW)
        t = jax.lax.dynamic_slice_in_dim(times, begin, WINDOW)
        old = jax.lax.dynamic_slice_in_dim(values, begin, WINDOW)
        inside = (begin + jnp.arange(WINDOW) >= known) & (t <= reached)
        inside = jnp.expand_dims(inside, tuple(range(1, old.ndim)))
        new = jnp.where(inside, jax.vmap(evaluate)(t), old)
        values = jax.lax.dynamic_update_slice_in_dim(values, new, begin, 0)
        return values, begin + jnp.sum(t <= reached)

    return jax.lax.while_loop(some_left, fill, (values, known))


def _by_diffrax(
    term: diffrax.ODETerm,
    start: Array,
    times: Array,
    solver: diffrax.AbstractSolver,
    controller: diffrax.AbstractAdaptiveStepSizeController,
    max_steps: int,
) -> tuple[Array, Array]:
    """The same by `diffrax.diffeqsolve`."""
    if isinstance(solver, diffrax.AbstractImplicitSolver):
        # Their dense output is only of third order: step onto every requested time instead.
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


class Integrator(NamedTuple):
    """How equations are integrated.

    Attributes:
        solver: of diffrax.
        rtol: relative tolerance.
        max_steps: the most steps of one curve.
    """

    solver: diffrax.AbstractSolver
    rtol: float
    max_steps: int


def moments_at(
    scene: Scene, times: Float[Array, "times"], equations: Equations, integrator: Integrator
) -> tuple[Moments, Int[Array, ""]]:
    """The moments of a gas at some reduced times, and a status.

    Args:
        scene: whose floats can be differentiated.
        times: not decreasing, >= 0; their number is that of `jaxgran.theory.solver.integrate_at`.
        equations: of the moments.
        integrator: of the equations.

    Returns:
        The moments, each of shape (times,), nan unless the status, which follows them, is ok.
    """
    leaves, structure = jax.tree.flatten(scene)
    leaves = [jnp.asarray(x, times.dtype) for x in leaves]
    _, unravel = ravel_pytree(structure.unflatten(leaves))

    @jax.custom_jvp
    def solve(leaves, times):
        return _solve(_raveled(leaves, times.dtype), unravel, times, equations, integrator)

    @partial(solve.defjvp, symbolic_zeros=True)
    def solve_jvp(at, along):
        leaves, times = at
        parameters = _raveled(leaves, times.dtype)
        moving = [np.full(x.size, not _is_zero(x)) for x in along[0]]
        each = np.eye(parameters.size)[np.concatenate([np.zeros(0, bool), *moving])]
        directions = jnp.asarray(each, times.dtype)
        solution = _solve_along(parameters, unravel, times, directions, equations, integrator)
        state, velocity, jacobian, fault = solution
        by = _raveled([x for x in along[0] if not _is_zero(x)], times.dtype)
        moved = jax.tree.map(lambda j: by @ j, jacobian)
        if not _is_zero(along[1]):
            moved = jax.tree.map(lambda m, v: m + v * along[1], moved, velocity)
        no_tangent: Any = np.zeros(fault.shape, jax.dtypes.float0)  # of a whole number
        return (state, fault), (moved, no_tangent)

    return solve(leaves, times)


def _raveled(leaves: list[Array], dtype: Any) -> Float[Array, "parameters"]:
    return jnp.concatenate([jnp.zeros(0, dtype), *map(jnp.ravel, leaves)])


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, SymbolicZero)


def _solve(
    parameters: Array,
    unravel: Callable[[Array], Scene],
    times: Array,
    equations: Equations,
    integrator: Integrator,
) -> tuple[Moments, Int[Array, ""]]:
    """The states, nan unless the status, which follows them, is ok."""
    scene = unravel(parameters)
    table = equations.table(scene, times[-1])

    def velocity(row):
        return equations.velocity(row, table(row[0]), scene)

    start = equations.start(scene, times)
    rows, fault = _integrate(jax.vmap(velocity), start[None], parameters, times, integrator)
    return Moments.of(rows[:, 0].T, equations.order), fault


def _solve_along(
    parameters: Array,
    unravel: Callable[[Array], Scene],
    times: Array,
    directions: Float[Array, "directions parameters"],
    equations: Equations,
    integrator: Integrator,
) -> tuple[Moments, Moments, Moments, Int[Array, ""]]:
    """States, their time derivatives and their derivatives along directions of the parameters.

    Last, a status; unless it is ok all of them are nan.
    """
    order = equations.order
    table, table_along = jax.linearize(
        lambda parameters: equations.table(unravel(parameters), times[-1]), parameters
    )
    table = table.with_slopes(jax.vmap(lambda x: table_along(x).coefficients)(directions))

    def velocity(state, rates, parameters):
        return equations.velocity(state, rates, unravel(parameters))

    def rows_velocity(rows):
        # Row 0 is the state; the others, its tangents, obey the linearised equation.
        rates, slope, *_ = at = table(rows[0, 0])
        rate, linear = jax.linearize(velocity, rows[0], rates, parameters)

        def along(tangent, rates_along, direction):
            return linear(tangent, rates_along + slope * tangent[0], direction)

        return jnp.concatenate([rate[None], jax.vmap(along)(rows[1:], at[2:], directions)])

    start, start_along = jax.linearize(
        lambda parameters: equations.start(unravel(parameters), times), parameters
    )
    first = jnp.concatenate([start[None], jax.vmap(start_along)(directions)])
    rows, fault = _integrate(rows_velocity, first, parameters, times, integrator)
    states, jacobian = rows[:, 0], jnp.moveaxis(rows[:, 1:], 2, 0)
    velocities = jax.vmap(lambda x: velocity(x, table(x[0])[0], parameters))(states)
    jacobian = jnp.swapaxes(jacobian, 1, 2)
    state, rate, slope = (Moments.of(x, order) for x in (states.T, velocities.T, jacobian))
    return state, rate, slope, fault


def _integrate(
    velocity: Callable, first: Array, parameters: Array, times: Array, integrator: Integrator
) -> tuple[Array, Int[Array, ""]]:
    """The rows at the given reduced times, shape (times, rows, states), and a status."""
    known = jnp.all(jnp.isfinite(parameters)) & jnp.all(jnp.isfinite(times))
    # A gas of nan keeps its state, so that its solver does not try ever shorter steps.
    times = jnp.where(known, times, jnp.linspace(1.0, 2.0, times.size, dtype=times.dtype))
    # Steps follow the state alone: its tangents are then those of the discrete solution.
    controller = diffrax.PIDController(
        rtol=integrator.rtol, atol=integrator.rtol, norm=lambda rows: optx.rms_norm(rows[0][:5])
    )
    rows, ended = integrate_at(
        # s = ln(1 + t): a power law of time takes the same number of steps each decade.
        lambda s, rows: jnp.where(known, velocity(rows) * jnp.exp(s), 0.0),
        jnp.where(known, first, 0.0),
        jnp.log1p(times),
        solver=integrator.solver,
        controller=controller,
        max_steps=integrator.max_steps,
    )
    finite = known & jnp.all(jnp.isfinite(rows))
    fault = status.flag(status.STEPS_SPENT, ~ended)
    fault |= status.flag(status.NOT_FINITE, ended & ~finite)
    return jnp.where(fault == status.OK, rows, jnp.nan), fault
