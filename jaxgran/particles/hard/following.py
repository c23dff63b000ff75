"""The tangents of hard spheres after a window.

Of smooth ones see `jaxgran.tangents.impact`, of those with elements `jaxgran.tangents.exchange`.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxgran.particles.hard.candidates import Selection
from jaxgran.particles.hard.drive import heat_of_window
from jaxgran.particles.hard.impacts import ImpactWork
from jaxgran.particles.hard.observation import cooling_trend
from jaxgran.particles.hard.scene import HardScene
from jaxgran.particles.hard.tangents import HardTangents
from jaxgran.particles.state import State, kinetic_energy, temperature
from jaxgran.tangents.impact import ImpactTangents
from jaxgran.tangents.rates import remembered


def projected_after(
    new: State, scene: HardScene, chosen: Selection, work: ImpactWork, duration: Array
) -> ImpactTangents:
    """The tangents of smooth spheres after a window.

    Args:
        new: the state after it, with the tangents before it.
        scene: the gas.
        chosen, work: the impacts of the window.
        duration: of the window.
    """
    along, d = new.tangents, new.velocity.shape[1]
    replicas = len(new.dissipated)
    num_particles = len(new.velocity) // replicas
    lost, met = _sum(work.dissipated, chosen, replicas), _sum(work.impacts, chosen, replicas)
    heat = temperature(new.velocity, replicas)
    energy = 0.5 * d * num_particles * heat
    trend = cooling_trend(scene.law, heat, d)
    rates = remembered(
        along.rates,
        lost=lost,
        met=met / num_particles,
        energy=energy,
        temperature=heat,
        trend=trend,
        duration=duration,
        collision_frequency=scene.collision_frequency,
    )
    gains = jnp.zeros((len(work.gains), replicas), energy.dtype)
    gains = gains.at[:, chosen.replica[chosen.rows.a]].add(work.gains, mode="drop")
    return along.after(gains, energy + 0.5 * lost, heat, duration, rates, trend, d)


def exchanged_after(
    old: State, scene: HardScene, chosen: Selection, work: ImpactWork, duration: Array
) -> HardTangents:
    """The tangents of a gas with elements after a window.

    Args:
        old: the state before it.
        scene, chosen, work, duration: as for `projected_after`.
    """
    along, replicas = old.tangents, len(old.dissipated)
    n, d = len(old.velocity) // replicas, old.velocity.shape[1]
    before = jnp.stack([kinetic_energy(old.velocity, replicas), jnp.zeros(replicas)])
    gained = -_sum(work.dissipated, chosen, replicas)[None]
    gained = jnp.concatenate([gained, jnp.zeros_like(gained)])
    if scene.surface is not None and work.turned is not None:
        spins = jnp.sum(old.own.spin.reshape(replicas, -1) ** 2, axis=1)
        before = before.at[1].set(scene.surface.inertia / 2 * spins)
        gained = gained.at[1].set(_sum(work.turned, chosen, replicas))
    gains = jnp.zeros((along.num_changes, 2, replicas), before.dtype)
    gains = gains.at[:, :, chosen.replica[chosen.rows.a]].add(work.gains, mode="drop")
    if scene.walls is not None:
        gains = gains.at[:, :, chosen.replica].add(work.wall_gains, mode="drop")
    if scene.drive is not None:
        began = old.time + old.time_rest
        heat = partial(heat_of_window, scene, began=began, duration=duration)
        total, linear = jax.linearize(lambda material: n * d / 2 * heat(material), scene.material)
        # It does not depend on the speeds, which make impacts more frequent.
        gains = gains.at[:-2, 0].add(jax.vmap(linear)(along.directions)[:, None])
        gains = gains.at[-2, 0].add(-total)
        gained = gained.at[0].add(total)
    impacts = _sum(work.impacts, chosen, replicas) / 2
    return along._replace(exchange=along.exchange.after(before, gained, gains, impacts))


def _sum(values: Array, chosen: Selection, replicas: int) -> Array:
    """Sums over the slots of each replica; an empty slot is of none."""
    sums = jnp.zeros(replicas, values.dtype)
    return sums.at[chosen.replica].add(values, mode="drop")
