"""Integration of ordinary differential equations with output at given times.

The steps and their sizes are those of diffrax; the loop around them is written here, because it is
half as much to compile as `diffrax.diffeqsolve` with its events, adjoints and rounding of times.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

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


def values_at(
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
