"""The state of a DSMC run at t = 0."""

from functools import partial
from math import sqrt

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, UInt32

from jaxgran.particles import initial, spins
from jaxgran.particles.stochastic import collisions, elements
from jaxgran.particles.stochastic.exchange import energies_at_start
from jaxgran.particles.stochastic.pairing import Scheme
from jaxgran.particles.stochastic.state import DSMCState
from jaxgran.particles.stochastic.tangents import DSMCTangents
from jaxgran.scene.elements import SPINS
from jaxgran.scene.reduced_scene import ReducedScene
from jaxgran.theory import averages

PREPARED = 10.0
"""Mean free times in the steady state in which a gas begins."""


@partial(jax.jit, static_argnames=("replicas", "scheme", "num_parameters"))
def at_start(
    key: UInt32[Array, "2"],
    replicas: int,
    scheme: Scheme,
    num_parameters: int,
    scene: ReducedScene | None = None,
) -> DSMCState:
    """Maxwellian velocities at t = 0, with tangents in so many parameters."""
    d = scheme.dimension
    key = jax.random.fold_in(collisions.wrapped(key), 2**32 - 1)
    v = initial.velocities(key, replicas, scheme.num_particles, d).reshape(replicas, -1, d)
    parts = [v / sqrt(2), jnp.zeros_like(v)]
    if scene is not None and scene.surface is not None:
        shape = (replicas, scheme.num_particles, SPINS[d])
        key = jax.random.fold_in(key, 0)
        mean_square = (scene.surface.ratio / (2 * scene.surface.inertia)).astype(v.dtype)
        parts.append(spins.at_start(key, shape, mean_square))
    each, along = jnp.zeros(replicas, v.dtype), jnp.zeros((replicas, num_parameters), v.dtype)
    tangents = DSMCTangents(*[along] * len(DSMCTangents._fields))
    if scene is not None and num_parameters and has_elements(scene):
        tangents = energies_at_start(scene, num_parameters, scheme.num_particles, d, replicas)
    state = DSMCState(
        time=jnp.zeros((), v.dtype),
        clock=each,
        clock_rest=each,
        temperature=each + 1,
        particles=jnp.concatenate(parts, axis=-1),
        collisions=each,
        missed=each,
        steps=jnp.zeros(replicas, jnp.uint32),
        mobility=each,
        tangents=tangents,
    )
    if scene is None or scene.prepared is None:
        return state
    return state._replace(particles=prepared(state, key, scene, scheme))


def has_elements(scene: ReducedScene) -> bool:
    """Whether there is more than smooth spheres in free flight that begin as a Maxwellian gas."""
    return any(element is not None for element in scene[1:])


def prepared(
    state: DSMCState, key: PRNGKeyArray, scene: ReducedScene, scheme: Scheme
) -> Float[Array, "replicas N components"]:
    """The particles in the steady state of white noise that returns what impacts take."""
    losing, d = ReducedScene(scene.law, scene.surface, scene.walls), scheme.dimension
    rate = averages.collision_rate(0.0, d) * scheme.own_step
    words = jax.random.bits(jax.random.fold_in(key, 1), (2,), jnp.uint32)
    share = jnp.ones(len(state.clock), state.clock.dtype)

    def further(i, now):
        after = collisions.step(now, words, share, losing, scheme, False)
        growth = jnp.maximum(1 - after.temperature, 0.0)
        keys = jax.random.split(jax.random.fold_in(collisions.wrapped(words), i), len(share))
        kick = jax.vmap(elements.kicked, (0, 0, 0, None, None, None))
        hot = kick(after.particles, keys, growth, jnp.zeros(()), d, scene.walls is None)
        velocity = initial.settle(hot[..., :d].reshape(-1, d), len(share)) / sqrt(2)
        velocity = velocity.reshape(hot[..., :d].shape)
        parts = [velocity, jnp.zeros_like(velocity), hot[..., 2 * d :]]
        particles = jnp.concatenate(parts, axis=-1)
        return after._replace(particles=particles, temperature=share)

    steps = jnp.ceil(PREPARED / rate).astype(jnp.int32)
    return jax.lax.fori_loop(0, steps, further, state).particles
