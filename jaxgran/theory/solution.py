"""The moments of a homogeneous gas at given times, and their derivatives.

One linear rule serves forward and reverse mode: the tangents of those parameters of the scene that
move are integrated beside the state, in the same steps, so that they are the derivatives of the
discrete solution. A scene has few parameters in reduced units, of which mostly one moves.
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
from jaxtyping import Array, Float, Int

from jaxgran.checks import status
from jaxgran.theory.homogeneous import Equations, Scene
from jaxgran.theory.integration import values_at
from jaxgran.theory.moments import Moments


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
        times: not decreasing, >= 0; their number is that of `jaxgran.theory.integration.values_at`.
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
    rows, ended = values_at(
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
