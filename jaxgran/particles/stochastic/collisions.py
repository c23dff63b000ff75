"""One step of direct simulation Monte Carlo: random collisions of a homogeneous gas."""

from collections.abc import Callable
from functools import cache, partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt32

from jaxgran.particles import cores
from jaxgran.particles.drag import decay
from jaxgran.particles.kicks import wrapped
from jaxgran.particles.stochastic import portions
from jaxgran.particles.stochastic.collision_rule import Outcome, collide
from jaxgran.particles.stochastic.elements import Walled, heating, hit_walls, left_by, shortened
from jaxgran.particles.stochastic.exchange import (
    Candidates,
    Gained,
    Step,
    energies_of,
    exchanged,
    of_walls,
)
from jaxgran.particles.stochastic.pairing import CEILING, Scheme, draw
from jaxgran.particles.stochastic.state import DSMCState
from jaxgran.particles.stochastic.tangents import carried
from jaxgran.scene.reduced_scene import ReducedScene
from jaxgran.tangents.exchange import ExchangeTangents

RECOUNTED = 32
"""Steps after which T is computed from the velocities again.

In between it is updated by the losses. The rounding errors of this sum do not shrink as T falls,
and in float32 they would dominate T once it has fallen to 1e-7 of its first value.
"""


def _step(
    state: DSMCState,
    key: PRNGKeyArray,
    some: portions.Portions,
    share: Float[Array, ""],
    most: portions.Portions,
    scene: ReducedScene,
    scheme: Scheme,
    tangents: bool,
) -> DSMCState:
    """A share, 0 to 1, of one step of one replica, always with the same random numbers.

    Each collision of the whole step takes place with this probability, so that the state within
    a step is as accurate as at its end.
    """
    key = jax.random.fold_in(key, state.steps)
    dt = share * scheme.own_step / jnp.sqrt(state.temperature)
    kicked = partial(_kicked, key=key, dt=dt, scene=scene, scheme=scheme)
    kicked = partial(kicked, turns=(some.kicks, most.kicks))
    before, state = state, kicked(state, clock=state.clock, place=0)
    exchanging = tangents and isinstance(state.tangents, ExchangeTangents)
    particles, sums, pairs = _collided(
        state, key, dt, share, scene, scheme, tangents and not exchanging
    )
    lost, met = sums.loss, None
    if some.walls is not None and most.walls is not None:
        bounced = partial(_bounced, drawn=(some.walls, most.walls), scene=scene, d=scheme.dimension)
        particles, to_walls, met = bounced(state, key, dt, particles, tangents=exchanging)
        lost = lost + to_walls
    energy = scheme.num_particles * scheme.dimension / 2  # sum v^2 at T_0
    temperature = state.temperature - lost / energy
    passed = state.clock_rest + dt
    clock = state.clock + passed
    new = state._replace(
        clock=clock,
        clock_rest=passed - (clock - state.clock),
        temperature=temperature,
        particles=particles,
        collisions=state.collisions + sums.num,
        missed=state.missed + sums.missed,
        steps=state.steps + (share > 0).astype(state.steps.dtype),
    )
    new = kicked(new, clock=state.clock, place=1)
    if not tangents:
        return new
    if isinstance(before.tangents, ExchangeTangents):
        ceiling = CEILING * jnp.sqrt(state.temperature)
        step = Step(pairs, met, ceiling, share, state.clock, dt, scheme.num_particles)
        energies = energies_of(before.particles, scene, scheme.dimension)
        along = exchanged(before.tangents, scene, energies, step, sums.num)
        return new._replace(tangents=along)
    ds, left = share * scheme.own_step, energy * temperature
    mobility, along = carried(before.tangents, state.mobility, scheme.dimension, sums, dt, ds, left)
    return new._replace(mobility=mobility, tangents=along)


def _kicked(
    state: DSMCState,
    key: PRNGKeyArray,
    dt: Float[Array, ""],
    turns: tuple[Int[Array, ""] | None, Int[Array, ""] | None],
    scene: ReducedScene,
    scheme: Scheme,
    clock: Float[Array, ""],
    place: int,
) -> DSMCState:
    """The state after half of the kicks of a step, at its begin (place 0) or end (1); `turns` are
    portions of this replica and the most of any."""
    own, most = turns
    if scene.drive is None or own is None or most is None:
        return state
    d = scheme.dimension
    growth = heating(scene.drive, scene.drag, clock, dt, float(place))
    key = jax.random.fold_in(key, 2 + place)
    halves = 2 * state.steps + place
    at_rest = scene.walls is None
    particles, grown = portions.kicked(
        state.particles, key, own, most, halves, growth, state.clock, d, at_rest
    )
    return state._replace(particles=particles, temperature=state.temperature + grown)


def _collided(
    state: DSMCState,
    key: PRNGKeyArray,
    dt: Float[Array, ""],
    share: Float[Array, ""],
    scene: ReducedScene,
    scheme: Scheme,
    tangents: bool,
) -> tuple[Float[Array, "N components"], Outcome, tuple[Candidates, Candidates]]:
    """The particles after a step, sums over its collisions, and the candidates."""
    d, first, second = scheme.dimension, scheme.first, scheme.second
    bits = jax.random.bits(key, (2, first + second + 2), jnp.uint32)
    i, j, k = draw(bits[:, -2:].ravel(), scheme)
    index = jnp.concatenate([i, j, k])
    options = {"mode": "promise_in_bounds", "unique_indices": True}
    old = state.particles.at[index].get(**options)
    v, spin, slowed, kept = old[:, :d], old[:, 2 * d :], None, 1.0
    # Collisions happen at the middle of the step, on average: x - v t changes by -kick t.
    middle = state.clock + dt / 2
    if scene.drag is not None:
        left = decay(scene.drag, middle)
        slowed, kept = left.velocity, left.spin
        spin = spin * kept

    ceiling = CEILING * jnp.sqrt(state.temperature)
    rule = partial(
        collide, ceiling=ceiling, share=share, scene=scene, tangents=tangents, slowed=slowed
    )
    rough = scene.surface is not None
    firsts = v[:first] - v[first : 2 * first]
    turning = spin[:first] + spin[first : 2 * first] if rough else None
    one = rule(firsts, bits[:, :first], spin=turning)
    twice, again = one.kick[:second], one.twist
    if again is not None:
        again = spin[:second] + again[:second] + spin[2 * first :]
    seconds = v[:second] + twice - v[2 * first :]
    two = rule(seconds, bits[:, first:-2], spin=again)
    kicks = jnp.concatenate([twice + two.kick, one.kick[second:], -one.kick, -two.kick])
    changes = [kicks, -middle * kicks]
    if one.twist is not None and two.twist is not None:
        both = one.twist[:second] + two.twist
        changes.append(jnp.concatenate([both, one.twist[second:], one.twist, two.twist]) / kept)
    sums = jax.tree.map(jnp.add, *(x._replace(kick=0.0, twist=None) for x in (one, two)))
    new = old + jnp.concatenate(changes, axis=-1)
    pairs = (
        Candidates(firsts, None if turning is None else turning / kept, bits[:, :first]),
        Candidates(seconds, None if again is None else again / kept, bits[:, first:-2]),
    )
    return state.particles.at[index].set(new, **options), sums, pairs


def _bounced(
    state: DSMCState,
    key: PRNGKeyArray,
    dt: Float[Array, ""],
    particles: Float[Array, "N components"],
    drawn: tuple[Int[Array, ""], Int[Array, ""]],
    scene: ReducedScene,
    d: int,
    tangents: bool,
) -> tuple[Float[Array, "N components"], Float[Array, ""], Gained | None]:
    """The particles after their impacts on walls in a step, the decrease of sum v^2, and with
    tangents what both energies gain."""
    left = left_by(scene.drag, state.clock + dt / 2)
    axis, one = (state.steps % d).astype(jnp.int32), jnp.ones(())

    def meet(rows: Array, chance: Array) -> tuple[Array, tuple[Array, Gained | None]]:
        velocity, spin = rows[:, :d], rows[:, 2 * d :]

        def hit(scene: ReducedScene, faster: Array, turning: Array, slowed: Array) -> Walled:
            return hit_walls(scene, chance, axis, velocity * faster, spin * turning, dt, slowed)

        found = hit(scene, one, left.spin, left.velocity)
        gained = of_walls(hit, scene, state.clock + dt / 2) if tangents else None
        after = [found.velocity, rows[:, d : 2 * d], found.spin / left.spin]
        return jnp.concatenate(after, axis=-1), (found.lost, gained)

    shapes = jax.eval_shape(meet, particles[:1], particles[:1, 0])[1]
    none = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    bounced = portions.bounced(particles, jax.random.fold_in(key, 1), *drawn, meet, none)
    return bounced[0], *bounced[1]


def step(
    state: DSMCState,
    key: UInt32[Array, "2"],
    share: Float[Array, "replicas"],
    scene: ReducedScene,
    scheme: Scheme,
    tangents: bool,
) -> DSMCState:
    """A share, 0 to 1, of the next step of each replica."""
    replicas = jnp.arange(len(state.clock), dtype=jnp.uint32)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(wrapped(key), replicas)
    some = portions.of_step(state.temperature, state.clock, share, scene, scheme)
    most = jax.tree.map(jnp.max, some)
    one = partial(_step, most=most, scene=scene, scheme=scheme, tangents=tangents)
    axes = jax.tree.map(lambda _: 0, state)._replace(time=None)
    state = jax.vmap(one, (axes, 0, 0, 0), axes)(state, keys, some, share)
    due = state.steps % RECOUNTED == 0

    def recounted(temperature):
        velocity = state.particles[..., : scheme.dimension]
        counted = 2 * jnp.mean(velocity**2, axis=(1, 2))
        return jnp.where(due, counted, temperature)

    temperature = jax.lax.cond(jnp.any(due), recounted, lambda x: x, state.temperature)
    return state._replace(temperature=temperature)


def _advanced(
    state: DSMCState,
    end: Float[Array, ""],
    scene: ReducedScene,
    key: UInt32[Array, "2"],
    max_steps: Int[Array, ""],
    *,
    scheme: Scheme,
    tangents: bool = False,
) -> DSMCState:
    """Whole steps towards a time: each replica is taken to its last step that ends before it.

    Args:
        state: where to start.
        end: the time.
        scene: in reduced units.
        key: of the random numbers, two 32-bit words.
        max_steps: the most steps to take; `time` of the state tells how far they led.
        scheme: sizes of a step.
        tangents: whether tangents are followed.
    """

    def length(state):
        whole = scheme.own_step / jnp.sqrt(state.temperature)
        return shortened(scene, state.temperature, state.clock, whole, scheme.dimension)

    def due(state):
        return length(state) <= (end - state.clock) - state.clock_rest

    def unfinished(carry):
        state, left = carry
        return jnp.any(due(state)) & (left > 0)

    def further(carry):
        state, left = carry
        share = due(state).astype(state.clock.dtype)
        if scene.drive is not None or scene.walls is not None:
            share = share * length(state) * jnp.sqrt(state.temperature) / scheme.own_step
        return step(state, key, share, scene, scheme, tangents), left - 1

    state, _ = jax.lax.while_loop(unfinished, further, (state, max_steps))
    time = jnp.where(jnp.any(due(state)), jnp.min(state.clock), end)
    return state._replace(time=jnp.maximum(time, state.time))


advance = jax.jit(_advanced, static_argnames=("scheme", "tangents"))


@cache
def advancing(donate: bool) -> Callable[..., DSMCState]:
    """`advance` as the host driver calls it, which may write over the state given, and so delete
    it."""
    static, given = ("scheme", "tangents"), "state" if donate else ()
    options = cores.options()
    return jax.jit(
        _advanced, static_argnames=static, donate_argnames=given, compiler_options=options
    )
