"""White noise that drives hard spheres, and the steady state in which a gas can be prepared.

Each window begins and ends with half of its kicks. Units as in `jaxgran.particles.hard.scene`.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from jaxgran.particles import kicks, spins
from jaxgran.particles.drag import decay, lasting
from jaxgran.particles.hard.scene import HardScene, Material
from jaxgran.particles.state import State, temperature
from jaxgran.scene.elements import SPINS


def first_draw(state: State, scene: HardScene, replicas: int, key: PRNGKeyArray) -> State:
    """The state at t = 0 with random spins of rough spheres, and the key of a drive."""
    n, d = state.velocity.shape
    own = state.own
    if scene.surface is not None:
        drawn = jax.random.fold_in(key, 2)  # 0 and 1 are of positions and velocities
        shape = replicas, n // replicas, SPINS[d]
        mean_square = (scene.surface.ratio / scene.surface.inertia).astype(state.velocity.dtype)
        spin = spins.at_start(drawn, shape, mean_square).reshape(n, SPINS[d])
        own = own._replace(spin=spin, turned=jnp.zeros(replicas, spin.dtype))
    if scene.drive is not None:
        own = own._replace(key=counted(jax.random.fold_in(key, 3)))
    return state._replace(own=own)


def counted(key: PRNGKeyArray) -> Array:
    """Two words of a key, and the number of kicks made with it, none."""
    words = jax.random.bits(key, (2,), jnp.uint32)
    return jnp.concatenate([words, jnp.zeros(1, jnp.uint32)])


def kicked(
    state: State, scene: HardScene, replicas: int, variance: Float[Array, "replicas"]
) -> State:
    """The state with random kicks of a variance for each component of each replica's velocities."""
    if state.own.key is None:
        return state
    key = jax.random.fold_in(kicks.wrapped(state.own.key[:2]), state.own.key[2])
    each = state.velocity.reshape(replicas, -1, state.velocity.shape[-1])
    keys = jax.random.split(key, replicas)
    found = jax.vmap(kicks.kicks, (0, 0, None))(keys, each, scene.walls is None)
    velocity = each + jnp.sqrt(variance)[:, None, None] * found
    own = state.own._replace(key=state.own.key.at[2].add(jnp.uint32(1)))
    return state._replace(velocity=velocity.reshape(state.velocity.shape), own=own)


def heating(
    scene: HardScene, began: Float[Array, ""], duration: ArrayLike, place: float
) -> Float[Array, ""]:
    """Variance of half of the kicks of a window, made at its begin (place 0) or end (1).

    With drag a kick lasts as long as a velocity, and time is transformed.
    """
    assert scene.drive is not None
    strength = scene.drive.strength * scene.collision_frequency
    if scene.drag is None:
        return strength * duration / 2
    rates = scene.decay_rates
    time = lasting(rates, began, jnp.asarray(duration))
    return strength * time / 2 / decay(rates, began + place * duration).velocity ** 2


def driven(
    state: State, scene: HardScene, replicas: int, duration: ArrayLike, place: float
) -> State:
    """The state with half of the kicks of a window, made at its begin (place 0) or end (1).

    The state is that before the window; it may have had kicks.
    """
    if scene.drive is None:
        return state
    variance = heating(scene, state.time + state.time_rest, duration, place)
    return kicked(state, scene, replicas, jnp.broadcast_to(variance, (replicas,)))


def shortened(state: State, scene: HardScene, replicas: int) -> Float[Array, ""]:
    """Length of a window, so short that its kicks are small beside the velocities."""
    if scene.drive is None:
        return state.own.window
    heat = jnp.min(temperature(state.velocity, replicas))
    growth = 2 * heating(scene, state.time + state.time_rest, jnp.ones_like(heat), 0.0)
    safe = jnp.where(growth > 0, growth, 1.0)
    most = jnp.where(growth > 0, kicks.LARGEST * heat / safe, jnp.inf)
    return jnp.minimum(state.own.window, most)


def heat_of_window(
    scene: HardScene, material: Material, began: Float[Array, ""], duration: ArrayLike
) -> Float[Array, ""]:
    """Growth of T by the kicks of a window, as a function of the material."""
    here = scene.with_material(material)
    return heating(here, began, duration, 0.0) + heating(here, began, duration, 1.0)


def restored(
    state: State, scene: HardScene, replicas: int, lost: Float[Array, "replicas"]
) -> State:
    """The state with kicks that return the energy lost, scaled to T = 1 exactly.

    A gas that is driven so comes into the steady state of white noise.
    """
    n, d = state.velocity.shape
    # By chance the spins of rough spheres give more than impacts take: velocities are then scaled.
    variance = 2 * jnp.maximum(lost, 0.0) / (n // replicas * d)
    state = kicked(state, scene, replicas, variance)
    each = state.velocity.reshape(replicas, -1)
    size = jnp.sqrt(jnp.mean(each**2, axis=1, keepdims=True))
    return state._replace(velocity=(each / size).reshape(state.velocity.shape))
