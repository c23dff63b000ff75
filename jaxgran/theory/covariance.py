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
A sphere hits walls regularly: what they have just taken they cannot take again soon. So only the
share f of their noise is white. The rest is a change of n, a stationary variable of a damped
oscillator that forgets within a crossing,

    d ln T = ... + sqrt(f) dW + dn,    d(n, u) = -(sqrt(T)/W) M (n, u) dt + sqrt(1 - f) b dW',

with the noise of Poissonian impacts in W and W', and the width W that centres have. n and u are
stationary from t = 0 on: the spheres are in flight then.

The energy that contacts of soft spheres hold scatters T, too: `jaxgran.theory.contact_noise`.

Where sizes differ the second variable is q, the logarithm of the ratio of the mean square
velocities of small and large spheres (`jaxgran.theory.sizes`). Impacts between small and large
spheres exchange energy, which changes T and not the energy. At t = 0 the velocities of both halves
are drawn from one Maxwellian: q has the variance 8/(d N).
"""

from functools import partial
from math import sqrt
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran.data.curve import CoolingCurve
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.gas import Gas
from jaxgran.scene.reduced import ReducedRough, ReducedScene, ReducedWalls, reduced_scene
from jaxgran.scene.walls import wall_impact_ratio
from jaxgran.theory.averages import (
    collision_rate,
    loss_moments,
    loss_nodes,
)
from jaxgran.theory.contact_noise import contact_covariance, contact_noise
from jaxgran.theory.density import Density
from jaxgran.theory.moments import Spins
from jaxgran.theory.rough_impacts import coulomb_limit, mean_impulse, rough_energy_moments
from jaxgran.theory.sizes import (
    PairRates,
    drag_factors,
    energy_slope,
    pair_rates,
    partial_temperatures,
    variable_changes,
)

WALL_NOISE = 0.15
"""f, the share of the noise of wall impacts that is left over long times.

It and the next two are the maximum of the likelihood of 1300 runs of hard spheres between walls of
eps_w = .75 to .9, with mean free paths of .2 W. For 400 runs with .5 W and 1.1 W (eps_w = .8, .75)
the whitened variance is .88 and .83.
"""

WALL_MEMORY = np.array([[5.5, 8.0], [-8.0, 5.5]])
"""M. Of the Poissonian variance of what walls take in a time t it leaves .83, .63, .36, .20 for
``t sqrt(T)/W`` = .1, .2, .4, 1.6."""

WALL_KICK = np.array([1.0, 0.67])
"""b."""

ROTATION_OFFSET = 0.01
"""c in the variable ``ln(T_rot/T + c)``."""

NUM_DOUBLINGS = 20
"""An interval is divided into 2^20 steps, so that it may last 1e5 relaxation times."""


class Mean(NamedTuple):
    """The mean of a run, at one time or at several.

    Attributes:
        log_temperature: ln(T/T_0).
        sonine: a_2.
        collisions: per particle since t = 0.
        spins: T_rot/T of rough spheres, 0 of smooth ones, and cumulants as in `Moments`, None
            where spins are taken to be Gaussian.
        size_ratio: q of spheres of unequal sizes; None for equal ones.
    """

    log_temperature: Any
    sonine: Any
    collisions: Any
    spins: Spins
    size_ratio: Any = None


def run_covariance(
    gas: Gas,
    curve: CoolingCurve,
    spins: Spins | None = None,
    *,
    rotation: bool = False,
    energy: bool = False,
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
        energy: T is the mean energy over the mean mass, see `jaxgran.theory.sizes`.
        softness, correlations: as in `jaxgran.KineticTheory`; contacts scatter T, too
            (`jaxgran.theory.contact_noise`).

    Returns:
        C of ln T, shape (times, times); with `rotation` of ln T, then of ln T_rot, shape (2 times,
        2 times). T_0 and T_rot_0 are the exact initial values of the run: C is 0 at t = 0. C of
        ln T_rot is also 0 where T_rot is 0.
    """
    theta = curve.temperature / gas.temperature
    ratio = jnp.zeros_like(theta)
    if curve.rotational_temperature is not None:
        ratio = curve.rotational_temperature / curve.temperature
    spins = spins or Spins(ratio, None, None)
    size_ratio = None if curve.size_ratio is None else jnp.log(curve.size_ratio)
    mean = Mean(jnp.log(theta), curve.sonine, curve.collisions, spins, size_ratio)
    *rates, starts = run_process(gas, mean, softness, correlations)
    passed = jnp.diff(mean.collisions)[None, None]
    growth, noise = propagators(*((x[..., 1:] + x[..., :-1]) / 2 * passed for x in rates))
    zero = jnp.zeros_like(ratio)
    outputs = [[zero + 1, *[zero] * (len(growth) - 1)]]
    if energy and size_ratio is not None:
        outputs[0][1] = energy_slope(gas.size_spread, size_ratio)
    if rotation:
        turning = ratio > 0
        by_rotation = (ratio + ROTATION_OFFSET) / jnp.where(turning, ratio, jnp.inf)
        outputs.append([turning + zero, by_rotation, *outputs[0][2:]])
    outputs = jnp.stack([jnp.stack(row) for row in outputs])
    whole = covariance_at_all_times(starts[..., 0], growth, noise, outputs)
    contacts = contact_noise(gas, mean.log_temperature) if softness else None
    if contacts is None:
        return whole
    of_T = slice(0, theta.size)
    return whole.at[of_T, of_T].add(contact_covariance(contacts, mean.collisions))


def run_process(
    gas: Gas, mean: Mean, softness: bool = True, correlations: bool = True
) -> tuple[Float[Array, "k k times"], Float[Array, "k k times"], Float[Array, "k k times"]]:
    """Return J, Q and C of a start, at some times of a mean: see `process`."""
    d = gas.dimension
    crossings = None
    if gas.container is not None:
        widths = jnp.broadcast_to(gas.container.side, (d,)) - gas.diameter
        crossings = jnp.mean(gas.path_length / widths)
    density = Density.from_gas(gas, softness, correlations)
    scene = reduced_scene(gas)
    return jax.vmap(partial(process, scene, density, crossings, d), 0, -1)(mean)


class Impacts(NamedTuple):
    """Impacts of one kind, or of all kinds with a first axis.

    Attributes:
        rate: impacts over the number of particles and the unit of reduced time.
        loss, square: mean and mean square of the loss x, see `loss_moments`.
        eta, impulse: coefficient of `Rough`, and (1 + eps)/2, if the spheres are rough.
    """

    rate: Any
    loss: Any
    square: Any
    eta: Any = None
    impulse: Any = None


def collisions(scene: ReducedScene, density: Density, speed: Array, mean: Mean, d: int) -> Impacts:
    """Return the impacts between spheres at a speed sqrt(T/T_0)."""
    loss, square = loss_moments(scene.law, speed, mean.sonine)
    factor = density.factor(scene.law, speed, loss / 2, mean.collisions, d)
    rate = collision_rate(0.0, d) / 2 * speed
    impacts = Impacts(rate, loss * factor, square * factor**2)
    if scene.surface is None:
        return impacts
    return impacts._replace(eta=scene.surface.eta, impulse=mean_impulse(scene.law, speed))


def wall_impacts(
    walls: ReducedWalls, surface: ReducedRough | None, speed: Array, d: int
) -> Impacts:
    """Return the impacts on all walls at a speed sqrt(T/T_0).

    Friction at a wall takes from one sphere what friction between two spheres with half the eta
    takes from both (`jaxgran.theory.elements`).
    """
    g, weights = loss_nodes(speed)
    eps = walls.law.restitution(g * speed / sqrt(2))
    lost = 1 - eps**2
    sums = jnp.stack([jnp.full_like(g, 0.5), lost, (lost * g) ** 2]) * weights[None]

    def across(frequency: Array) -> Array:
        """Rate of impacts on the walls across one axis, and sums of x and x^2 over them."""
        ratio = wall_impact_ratio(eps, frequency / collision_rate(0.0, d), d)
        return frequency * sums @ ratio

    rate, loss, square = jnp.sum(jax.vmap(across)(walls.frequency), 0)
    impacts = Impacts(rate * speed, loss / rate, square / rate)
    if surface is None:
        return impacts
    eta = jnp.zeros_like(speed)
    if walls.surface is not None:
        eta = surface.eta_on_wall(walls.surface) / 2
    return impacts._replace(eta=eta, impulse=mean_impulse(walls.law, speed / sqrt(2)))


def energy_moments(
    impacts: Impacts, surface: ReducedRough | None, S: Array, A: Array, d: int
) -> tuple[Float[Array, "e"], Float[Array, "e e"]]:
    """Return sums over the impacts of a unit of time, per particle, of the energies that they add.

    Args:
        impacts: of one kind, in a Maxwellian gas.
        surface: of rough spheres.
        S, A: variances, see `rough_energy_moments`.
        d: dimension.

    Returns:
        Sums of e of the translational energy, and of e' of the rotational one if the spheres are
        rough, over m T; and of their products.
    """
    rate, loss, square = impacts[:3]
    if surface is None:
        return jnp.reshape(-rate * loss / 2, 1), jnp.reshape(rate * square / 4, (1, 1))
    m = coulomb_limit(surface, impacts.eta, impacts.impulse, 1 + A / S)
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
).T
"""Steps of ln T, y, S and A of each point."""


def process(
    scene: ReducedScene,
    density: Density,
    crossings: Float[Array, ""] | None,
    d: int,
    mean: Mean,
) -> tuple[Float[Array, "k k"], Float[Array, "k k"], Float[Array, "k k"]]:
    """Return J and Q at one time, per collision of a particle, and C of a run that starts there.

    The variables are ln T, y of rough spheres or q of spheres of unequal sizes, n and u of a gas
    between walls.

    Args:
        scene: in reduced units.
        density: effects of density.
        crossings: mean of the path length over the widths that centres have; None without walls.
        d: dimension.
        mean: at this time.
    """
    if scene.sizes is not None:
        return _process_of_sizes(scene, density, d, mean)
    surface = scene.surface
    drag = scene.drag
    drive = scene.drive
    spins = mean.spins
    d_rot = NUM_SPIN_COMPONENTS[d]
    cumulants = surface is not None and spins.correlation is not None
    inertia = 1.0 if surface is None else surface.inertia
    exp_y = spins.rotation + ROTATION_OFFSET
    step_of_A = 2 * STEP * (1 + spins.rotation / inertia)

    def impacts_of(of_T: Float[Array, ""]) -> tuple[Array, Impacts]:
        """Speed sqrt(T/T_0), and each kind of impact."""
        speed = jnp.exp((mean.log_temperature + STEP * of_T) / 2)
        kinds = [collisions(scene, density, speed, mean, d)]
        if scene.walls is not None:
            kinds.append(wall_impacts(scene.walls, surface, speed, d))
        return speed, jax.tree.map(lambda *x: jnp.stack(x), *kinds)

    def at_point(
        steps: Float[Array, "4"], speed: Float[Array, ""], impacts: Impacts
    ) -> tuple[Array, Array]:
        """Rates of the temperatures, and second moments of the energies by each kind of impact."""
        _, of_y, of_S, of_A = steps
        shifted = exp_y * jnp.exp(STEP * of_y)
        rotation = shifted - ROTATION_OFFSET
        S = 2 + 2 * STEP * of_S
        A = 2 * rotation / inertia + step_of_A * of_A
        each_kind = jax.vmap(lambda impacts: energy_moments(impacts, surface, S, A, d))
        gains, squares = each_kind(impacts)
        gains = jnp.sum(gains, 0)
        heating = 2 / d * gains[0]
        if drag is not None:
            heating = heating - 2 * drag.rate
        if drive is not None:
            heating = heating + drive / speed**2
        if surface is None:
            return heating[None], squares
        turning = 2 / d_rot * gains[1] - rotation * heating
        if drag is not None:
            turning = turning - 2 * drag.rotational_rate * rotation
        return jnp.stack([heating, turning / shifted]), squares

    points = STENCIL[: 3 if surface is None else 11 if cumulants else 5]
    # Impacts depend on ln T alone, which has three values.
    dtype = mean.sonine.dtype
    at_three = jax.vmap(impacts_of)(jnp.asarray([0.0, 1.0, -1.0], dtype))
    of_T = points[:, 0]  # 0, 1 or -1: a place among the three
    at_points = jax.tree.map(lambda x: x[of_T], at_three)
    rates, squares = jax.vmap(at_point)(jnp.asarray(points, dtype), *at_points)
    size = rates.shape[1]
    jacobian = (rates[1 : 2 * size : 2] - rates[2 : 2 * size + 1 : 2]).T / (2 * STEP)
    moments = squares[0]
    if cumulants and spins.correlation is not None:
        of_aa = (squares[5] + squares[6] - 2 * squares[0]) / step_of_A**2
        of_Ta = (squares[7] + squares[8] - squares[9] - squares[10]) / (8 * STEP * step_of_A)
        added = spins.kurtosis / inertia**2 * of_aa + 2 * spins.correlation / inertia * of_Ta
        # Of both spheres of a collision; at a wall the pair stands for one sphere.
        moments = moments + jnp.array([1.0, 2.0])[: len(added), None, None] * added

    # Changes of the variables by each energy that an impact adds.
    speed = jnp.exp(mean.log_temperature / 2)
    by_T = jnp.stack([jnp.ones_like(speed), -spins.rotation / exp_y])[:size]
    changes = 2 / d * by_T[:, None]
    if surface is not None:
        by_T_rot = jnp.stack([jnp.zeros_like(speed), 2 / d_rot / exp_y])
        changes = jnp.stack([changes[:, 0], by_T_rot], 1)
    noise = changes @ moments[0] @ changes.T
    if drive is not None:
        noise = noise + 4 / d * drive / speed**2 * jnp.outer(by_T, by_T)
    start = jnp.zeros_like(noise)
    if crossings is not None:
        crossing = crossings * speed / sqrt(2)  # sqrt(T)/W
        decay = crossing * WALL_MEMORY
        oscillator = jnp.concatenate([jnp.outer(by_T, decay[0]), decay])
        jacobian = jnp.concatenate([jnp.pad(jacobian, ((0, 2), (0, 0))), -oscillator], 1)
        kicked = jnp.outer(jnp.asarray(WALL_KICK), changes[0])
        changes = jnp.concatenate([changes, kicked])
        regular = changes @ moments[1] @ changes.T
        white = noise + WALL_NOISE * regular[:size, :size]
        noise = jnp.pad(white, (0, 2)) + (1 - WALL_NOISE) * regular
        stationary = (1 - WALL_NOISE) * regular[size, size] / crossing * _stationary()
        start = jnp.pad(start, (0, 2)).at[size:, size:].set(stationary)
    frequency = collision_rate(mean.sonine, d) * speed
    return jacobian / frequency, noise / frequency, start


def _process_of_sizes(
    scene: ReducedScene, density: Density, d: int, mean: Mean
) -> tuple[Float[Array, "2 2"], Float[Array, "2 2"], Float[Array, "2 2"]]:
    """Return `process` of spheres of unequal sizes, with the variables ln T and q."""

    def rates(log_temperature: Array, ratio: Array) -> tuple[Array, PairRates, Array]:
        speed = jnp.exp(log_temperature / 2)
        pairs = pair_rates(scene.sizes, speed, ratio, mean.sonine, d)
        loss = loss_moments(scene.law, speed, mean.sonine)[0]
        factor = density.factor(scene.law, speed, loss / 2, mean.collisions, d)
        rows = jnp.stack([factor, jnp.ones_like(factor)])[:, None]
        changes = rows * variable_changes(ratio, d)
        of_both = changes @ pairs.changes
        if scene.drag is not None:
            drag = 2 * scene.drag.rate * drag_factors(scene.sizes)
            of_T = jnp.mean(drag * partial_temperatures(ratio))
            of_both = of_both - jnp.stack([of_T, drag[0] - drag[1]])
        return of_both, pairs, changes

    T = mean.log_temperature
    q = mean.size_ratio
    steps = jnp.asarray([[STEP, -STEP, 0, 0, 0], [0, 0, STEP, -STEP, 0]], T.dtype)
    pairs: PairRates
    at, pairs, changes = jax.vmap(rates)(T + steps[0], q + steps[1])
    jacobian = jnp.stack([at[0] - at[1], at[2] - at[3]], axis=1) / (2 * STEP)
    noise = changes[-1] @ pairs.squares[-1] @ changes[-1].T
    # In terms of collisions of a particle: twice as many as impacts.
    frequency = 2 * pairs.impacts[-1] * collision_rate(mean.sonine, d) / collision_rate(0.0, d)
    start = jnp.zeros_like(noise).at[1, 1].set(8 / d)
    return jacobian / frequency, noise / frequency, start


def _stationary() -> Float[np.ndarray, "2 2"]:
    """Return the stationary covariance S of the oscillator, ``M S + S M^T = b b^T``."""
    one = np.eye(len(WALL_KICK))
    sums = np.kron(WALL_MEMORY, one) + np.kron(one, WALL_MEMORY)
    return np.linalg.solve(sums, np.outer(WALL_KICK, WALL_KICK).ravel()).reshape(one.shape)


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
    start: Float[Array, "k k"],
    growth: Float[Array, "k k steps"],
    noise: Float[Array, "k k steps"],
    outputs: Float[Array, "o k times"],
) -> Float[Array, "n n"]:
    """Return the covariance of the outputs at all times, where it is 0 at the first one.

    Args:
        start: covariance of the variables at the first time.
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

    first = start[..., None], jnp.zeros((size, num_outputs, num_times))
    intervals = [jnp.moveaxis(x, -1, 0) for x in (growth, noise, outputs[..., 1:])]
    _, rows = jax.lax.scan(step, first, (*intervals, index[1:]))
    rows = jnp.concatenate([jnp.zeros_like(rows[:1]), rows])
    earlier = jnp.moveaxis(rows, 0, 1)  # output and time, output and time that is not later
    later = jnp.transpose(earlier, (2, 3, 0, 1))
    whole = jnp.where(index[:, None, None] >= column, earlier, later)
    square = whole.reshape(num_outputs * num_times, num_outputs * num_times)
    return (square + square.T) / 2  # blocks of one time differ from it by roundings


def product(a: Float[Array, "i j #n"], b: Float[Array, "j k #n"]) -> Float[Array, "i k n"]:
    """Products of matrices that the last axis counts."""
    return jnp.sum(a[:, :, None] * b[None], axis=1)


def transposed(a: Float[Array, "i j n"]) -> Float[Array, "j i n"]:
    return jnp.swapaxes(a, 0, 1)


def congruent(a: Float[Array, "i j n"], b: Float[Array, "j j n"]) -> Float[Array, "i i n"]:
    """Return ``A B A^T``."""
    return product(product(a, b), transposed(a))
