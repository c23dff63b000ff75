"""Covariance of the temperatures of one run of N grains, about kinetic theory.

T of a gas that starts at T_0 moves only by the losses of its impacts. Their number and their sizes
are random, so that ``x = (ln T, ...)`` of one run departs from its mean as a linear process,

    dx = J x dt + noise,    dC/dt = J C + C J^T + Q/N,    C(0) = 0.

J is the Jacobian of the mean rates, and Q holds the second moments of what an impact takes, both by
the same averages over impacts (`Impacts`). Collisions are a Poisson process of rate N omega/2 with
omega collisions per particle and time.

Smooth spheres without walls have one variable, and ``Q = (omega/2) <x^2>/d^2`` with the loss x of
`jaxgran.theory.averages.loss_moments`. With ``zeta = -d ln T/dt`` by impacts this is
``2 r zeta^2/omega``, ``r = <x^2>/<x>^2``. Drag takes the same share from all and has no noise. The
kicks of a drive that heats by ``dT/dt = xi_0^2`` add ``4 xi_0^2/(d T)``.

The second variable of rough spheres is ``y = ln(T_rot/T + c)``, since T_rot may begin at 0.

Walls: impacts on them are a Poisson process only over times shorter than a crossing of the box.
What they have just taken they cannot take again soon: a sphere hits the walls regularly, and the
gas before a wall is colder after a loss. So the third variable, m, is a memory,

    d ln T = ... + dW_w - m dt,    dm = -kappa m dt + kappa (1 - sqrt(f)) dW_w,

with the white noise W_w of wall impacts, of which the share f is left over long times.
"""

from math import sqrt
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran.data.curve import CoolingCurve
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS, wall_impact_ratio
from jaxgran.scene.gas import Gas, ReducedRough, ReducedScene, ReducedWalls, reduced_scene
from jaxgran.theory.averages import (
    collision_rate,
    loss_moments,
    loss_nodes,
    rough_energy_moments,
)
from jaxgran.theory.equations import Density, Spins, coulomb_limit, mean_kick

WALL_MEMORY = 9.0
"""k in ``kappa = k sqrt(T)/W``, with the width W that centres have."""

WALL_NOISE = 0.1
"""f, the share of the noise of wall impacts that is left over long times."""

ROTATION_OFFSET = 0.01
"""c in the variable ``ln(T_rot/T + c)``."""

NUM_DOUBLINGS = 20
"""An interval is divided into 2^20 steps, so that it may last 1e5 relaxation times."""


class Mean(NamedTuple):
    """The mean of a run at some times.

    Attributes:
        log_temperature: ln(T/T_0).
        sonine: a_2.
        collisions: per particle since t = 0.
        spins: T_rot/T of rough spheres, 0 of smooth ones, and cumulants as in `Moments`, None
            where spins are taken to be Gaussian.
    """

    log_temperature: Any
    sonine: Any
    collisions: Any
    spins: Spins


def run_covariance(
    gas: Gas,
    curve: CoolingCurve,
    spins: Spins | None = None,
    *,
    rotation: bool = False,
    softness: bool = True,
    correlations: bool = True,
) -> Float[Array, "n n"]:
    """Return the covariance of ln T of one run at all times of its mean curve, times N.

    The process of this module is propagated from time to time, with the collisions of a particle as
    the clock: between two times J and Q per collision are the means of their values at both. The
    times should be so dense that these values vary by less than a tenth or so in between. No
    inverse is taken: the result is positive semidefinite but for rounding, and nothing overflows in
    intervals that are long against all relaxation times.

    Args:
        gas: the scene.
        curve: by kinetic theory, at times that do not decrease, from t = 0 on, shape (times,).
        spins: T_rot/T and the cumulants of the spins at these times, as in `Moments`; without them
            spins are taken to be Gaussian, and C of T_rot is some 7 % too low.
        rotation: return the covariance of ln T_rot, too.
        softness, correlations: as in `jaxgran.KineticTheory`.

    Returns:
        C of ln T, shape (times, times); with `rotation` of ln T, then of ln T_rot, shape (2 times,
        2 times). T_0 and T_rot_0 are those of the run: C is 0 at t = 0, and where T_rot is 0.
    """
    theta = curve.temperature / gas.temperature
    ratio = jnp.zeros_like(theta)
    if curve.rotational_temperature is not None:
        ratio = curve.rotational_temperature / curve.temperature
    spins = spins or Spins(ratio, None, None)
    mean = Mean(jnp.log(theta), curve.sonine, curve.collisions, spins)
    rates = run_process(gas, mean, softness, correlations)
    passed = jnp.diff(mean.collisions)[None, None]
    growth, noise = propagators(*((x[..., 1:] + x[..., :-1]) / 2 * passed for x in rates))
    zero = jnp.zeros_like(ratio)
    outputs = [[zero + 1, *[zero] * (len(growth) - 1)]]
    if rotation:
        turning = ratio > 0
        by_rotation = (ratio + ROTATION_OFFSET) / jnp.where(turning, ratio, jnp.inf)
        outputs.append([turning + zero, by_rotation, *outputs[0][2:]])
    return covariance_at_all_times(growth, noise, jnp.stack([jnp.stack(row) for row in outputs]))


def run_process(
    gas: Gas, mean: Mean, softness: bool = True, correlations: bool = True
) -> tuple[Float[Array, "k k times"], Float[Array, "k k times"]]:
    """Return J and Q of a gas at some times of its mean, per collision: see `process`."""
    d = gas.dimension
    crossings = None
    if gas.container is not None:
        widths = jnp.broadcast_to(gas.container.side, (d,)) - gas.diameter
        crossings = jnp.mean(gas.path_length / widths)
    density = Density.from_gas(gas, softness, correlations)
    with jax.numpy_rank_promotion("allow"):  # the last axis of all arrays is that of the times
        return process(reduced_scene(gas), density, crossings, d, mean)


class Impacts(NamedTuple):
    """Impacts of one kind, or of all kinds with a first axis.

    Attributes:
        rate: impacts over the number of particles and the unit of reduced time.
        loss, square: mean and mean square of the loss x, see `loss_moments`.
        eta, kick: coefficient of `Rough`, and (1 + eps)/2, if the spheres are rough.
    """

    rate: Any
    loss: Any
    square: Any
    eta: Any = None
    kick: Any = None


def collisions(scene: ReducedScene, density: Density, speed: Array, mean: Mean, d: int) -> Impacts:
    """Return the impacts between spheres at speeds sqrt(T/T_0), shape (..., times)."""
    loss, square = loss_moments(scene.law, speed, mean.sonine)
    factor = density.factor(scene.law, speed, loss / 2, mean.collisions, d)
    rate = collision_rate(0.0, d) / 2 * speed
    impacts = Impacts(rate, loss * factor, square * factor**2)
    if scene.surface is None:
        return impacts
    eta = jnp.broadcast_to(scene.surface.eta, speed.shape)
    return impacts._replace(eta=eta, kick=mean_kick(scene.law, speed))


def wall_impacts(
    walls: ReducedWalls, surface: ReducedRough | None, speed: Array, d: int
) -> Impacts:
    """Return the impacts on all walls at speeds sqrt(T/T_0), shape (..., times).

    Friction at a wall takes from one sphere what friction between two spheres with half the eta
    takes from both (`jaxgran.theory.equations`).
    """
    g, weights = loss_nodes(speed)
    frequency = walls.frequency[:, None]
    eps = walls.law.restitution(g * speed[..., None, None] / sqrt(2))
    lost = 1 - eps**2
    weights = weights * frequency
    weights = weights * wall_impact_ratio(eps, frequency / collision_rate(0.0, d), d)
    rate, loss, square = (jnp.sum(weights * x, (-2, -1)) for x in (0.5, lost, (lost * g) ** 2))
    impacts = Impacts(rate * speed, loss / rate, square / rate)
    if surface is None:
        return impacts
    eta = jnp.zeros_like(speed)
    if walls.surface is not None:
        eta = eta + surface.eta_on_wall(walls.surface) / 2
    return impacts._replace(eta=eta, kick=mean_kick(walls.law, speed / sqrt(2)))


def energy_moments(
    impacts: Impacts, surface: ReducedRough | None, S: Array, A: Array, d: int
) -> tuple[Array, Array]:
    """Return sums over the impacts of a unit of time, per particle, of the energies that they add.

    Args:
        impacts: of each kind, shape (kinds, points, times), in a Maxwellian gas.
        surface: of rough spheres.
        S, A: variances, see `rough_energy_moments`.
        d: dimension.

    Returns:
        Sums of e of the translational energy, and of e' of the rotational one if the spheres are
        rough, over m T, shape (energies, kinds, points, times); and of their products, shape
        (energies, energies, kinds, points, times).
    """
    rate, loss, square = impacts[:3]
    if surface is None:
        return (-rate * loss / 2)[None], (rate * square / 4)[None, None]
    m = coulomb_limit(surface, impacts.eta, impacts.kick, 1 + A / S)
    more = S / 2  # the speed of impacts grows with the root of it
    losses = loss * more, square * more**2
    means, squares = rough_energy_moments(losses, m, impacts.eta, surface.inertia, S, A, d)
    rate = rate * jnp.sqrt(more)
    return rate * means, rate * squares


STEP = 0.02
"""Step of the differences that give J and the effect of the cumulants of spins."""

STENCIL = np.array(
    [
        [0, 1, -1, 0, 0, 0, 0, 0, 0, 0, 0],
        [0, 0, 0, 1, -1, 0, 0, 0, 0, 0, 0],
        [0, 0, 0, 0, 0, 0, 0, 1, -1, 1, -1],
        [0, 0, 0, 0, 0, 1, -1, 1, -1, -1, 1],
    ]
)[..., None]
"""Steps of ln T, y, S and A of each point."""


def process(
    scene: ReducedScene,
    density: Density,
    crossings: Float[Array, ""] | None,
    d: int,
    mean: Mean,
) -> tuple[Float[Array, "k k times"], Float[Array, "k k times"]]:
    """Return J and Q at some times, per collision of a particle.

    The variables are ln T, y of rough spheres, m of a gas between walls.

    Args:
        scene: in reduced units.
        density: effects of density.
        crossings: mean of the path length over the widths that centres have; None without walls.
        d: dimension.
        mean: at these times.
    """
    surface, drag = scene.surface, scene.drag
    rough, cumulants = surface is not None, mean.spins.correlation is not None
    num_points = 11 if cumulants else 5 if rough else 3
    steps = jnp.asarray(STEP * STENCIL[:, :num_points], mean.sonine.dtype)
    log_theta = mean.log_temperature + steps[0]
    spinning = (mean.spins.rotation + ROTATION_OFFSET) * jnp.exp(steps[1])
    speed, rotation = jnp.exp(log_theta / 2), spinning - ROTATION_OFFSET
    kinds = [collisions(scene, density, speed, mean, d)]
    if scene.walls is not None:
        kinds.append(wall_impacts(scene.walls, surface, speed, d))
    impacts = jax.tree.map(lambda *x: jnp.stack(x), *kinds)
    inertia = 1.0 if surface is None else surface.inertia
    step_of_A = 2 * (1 + mean.spins.rotation / inertia)
    S, A = 2 + 2 * steps[2], 2 * rotation / inertia + step_of_A * steps[3]
    gains, squares = energy_moments(impacts, surface, S, A, d)

    gains = jnp.sum(gains, axis=1)
    heating = jnp.zeros_like(speed) if scene.drive is None else scene.drive / speed**2
    rates = [2 / d * gains[0] + heating]
    if drag is not None:
        rates[0] = rates[0] - 2 * drag.rate
    if rough:
        turning = 2 / NUM_SPIN_COMPONENTS[d] * gains[1] - rotation * rates[0]
        if drag is not None:
            turning = turning - 2 * drag.rotational_rate * rotation
        rates.append(turning / spinning)
    rates = jnp.stack(rates)
    ups, downs = slice(1, 2 * len(rates), 2), slice(2, 2 * len(rates) + 1, 2)
    jacobian = (rates[:, ups] - rates[:, downs]) / (2 * STEP)

    if cumulants:
        # Of both spheres of a collision; at a wall the pair stands for one sphere.
        spheres = jnp.array([1.0, 2.0])[: len(kinds), None]
        unit = STEP * step_of_A
        of_aa = (squares[..., 5, :] + squares[..., 6, :] - 2 * squares[..., 0, :]) / unit**2
        of_Ta = squares[..., 7, :] + squares[..., 8, :] - squares[..., 9, :] - squares[..., 10, :]
        of_Ta = of_Ta / (4 * 2 * STEP * unit)
        added = mean.spins.kurtosis / inertia**2 * of_aa
        added = added + 2 * mean.spins.correlation / inertia * of_Ta
        squares = squares.at[..., 0, :].add(spheres * added)
    squares = squares[..., 0, :]
    # Changes of the variables by each energy that an impact adds.
    by_T = jnp.stack([jnp.ones_like(speed[0]), -rotation[0] / spinning[0]][: len(rates)])
    changes = 2 / d * by_T[:, None]
    if rough:
        by_T_rot = 2 / NUM_SPIN_COMPONENTS[d] / spinning[0]
        changes = jnp.stack([changes[:, 0], jnp.stack([0 * by_T_rot, by_T_rot])], axis=1)
    noise = congruent(changes, squares[:, :, 0]) + 4 / d * heating[0] * by_T[:, None] * by_T
    if crossings is not None:
        forgetting = WALL_MEMORY / sqrt(2) * crossings * speed[:1]
        column = jnp.concatenate([-by_T, -forgetting])[:, None]
        jacobian = jnp.concatenate([jnp.pad(jacobian, [(0, 1), (0, 0), (0, 0)]), column], axis=1)
        kept = forgetting * (1 - sqrt(WALL_NOISE)) * changes[:1]
        noise = jnp.pad(noise, [(0, 1), (0, 1), (0, 0)])
        noise = noise + congruent(jnp.concatenate([changes, kept]), squares[:, :, 1])
    frequency = collision_rate(mean.sonine, d) * speed[0]
    return jacobian / frequency, noise / frequency


def propagators(
    jacobian: Float[Array, "k k n"],
    noise: Float[Array, "k k n"],
    num_doublings: Any = NUM_DOUBLINGS,
) -> tuple[Float[Array, "k k n"], Float[Array, "k k n"]]:
    """Return ``F - 1`` of intervals of constant J and Q, and the noise that they add.

    ``F = exp(J)`` and ``int_0^1 exp(J s) Q exp(J^T s) ds``, by `NUM_DOUBLINGS` doublings of a short
    step: two steps have ``(1 + G)^2 = 1 + 2 G + G^2`` and ``Q + F Q F^T``. G = F - 1 keeps its
    digits where steps are short.

    Args:
        jacobian, noise: J and Q times the length of each interval.
        num_doublings: may be traced, but then has no derivatives in reverse mode.
    """
    step = jnp.exp2(-jnp.asarray(num_doublings, jacobian.dtype))
    growth = jacobian * step
    noise = noise * step
    change = product(growth, noise) / 2
    first = growth + product(growth, growth) / 2, noise + change + transposed(change)

    def double(_: Any, now: tuple[Array, Array]) -> tuple[Array, Array]:
        growth, noise = now
        half = noise + product(growth, noise)
        moved = half + product(half, transposed(growth))  # F Q F^T
        return 2 * growth + product(growth, growth), noise + moved

    return jax.lax.fori_loop(0, num_doublings, double, first)


def covariance_at_all_times(
    growth: Float[Array, "k k steps"],
    noise: Float[Array, "k k steps"],
    outputs: Float[Array, "o k times"],
) -> Float[Array, "n n"]:
    """Return the covariance of the outputs at all times, from 0 at the first one.

    Args:
        growth: F - 1 of each interval.
        noise: what each interval adds to the covariance of the variables.
        outputs: as linear functions of the variables, at each time.
    """
    num_outputs, size, num_times = outputs.shape
    index = jnp.arange(num_times)
    column = index[None, None]

    def step(now: tuple[Array, Array], interval: tuple) -> tuple[tuple[Array, Array], Array]:
        # Covariances of the variables, and of the variables with all outputs up to now.
        variance, known = now
        growth, noise, output, i = interval
        matrix = (growth + jnp.eye(size))[..., None]
        variance = congruent(matrix, variance) + noise[..., None]
        new = product(variance, transposed(output[..., None]))
        known = jnp.where(column == i, new, product(matrix, known))
        return (variance, known), product(output[..., None], known)

    start = jnp.zeros((size, size, 1)), jnp.zeros((size, num_outputs, num_times))
    intervals = [jnp.moveaxis(x, -1, 0) for x in (growth, noise, outputs[..., 1:])]
    _, rows = jax.lax.scan(step, start, (*intervals, index[1:]))
    rows = jnp.concatenate([jnp.zeros_like(rows[:1]), rows])
    earlier = jnp.moveaxis(rows, 0, 1)  # output and time, output and time that is not later
    later = jnp.transpose(earlier, (2, 3, 0, 1))
    whole = jnp.where(index[:, None, None] >= index[None, None], earlier, later)
    return whole.reshape(num_outputs * num_times, num_outputs * num_times)


def product(a: Float[Array, "i j #n"], b: Float[Array, "j k #n"]) -> Float[Array, "i k n"]:
    """Products of matrices that the last axis counts."""
    return jnp.sum(a[:, :, None] * b[None], axis=1)


def transposed(a: Float[Array, "i j n"]) -> Float[Array, "j i n"]:
    return jnp.swapaxes(a, 0, 1)


def congruent(a: Float[Array, "i j n"], b: Float[Array, "j j n"]) -> Float[Array, "i i n"]:
    """Return ``A B A^T``."""
    return product(product(a, b), transposed(a))
