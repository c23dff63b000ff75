"""Boxes of spheres, soft or hard: what is asked of them, how they start, melt and cool."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer, eval_context
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from jaxgran import checkpoint, given, initial, neighbours, observables, status
from jaxgran.curve import CoolingCurve, Particles
from jaxgran.gas import Gas
from jaxgran.room import Room
from jaxgran.simulation import forward, simulate, stretches
from jaxgran.tangents import Inputs, Outputs

SMALLEST_BOX = 2.1
"""Box side in diameters below which a sphere could touch another and its image at once."""

MELT_COLLISIONS = 10.0
"""Mean free times of elastic motion before t = 0."""

SETTLED = 2.0
"""Mean free times of it after which the room of a run will do."""

MOST_PAIRS = 100
"""Pairs per particle beyond which a list is taken to have gone wrong."""


class Model(given.Model, Protocol):
    """What models of spheres in boxes have in common."""

    @property
    def key(self) -> PRNGKeyArray | None: ...
    @property
    def neighbours(self) -> str: ...
    @property
    def progress(self) -> bool: ...
    @property
    def checkpoint(self) -> str | Path | None: ...
    @property
    def plan(self) -> Any: ...


class Kind(NamedTuple):
    """How one kind of spheres moves; its states and scenes are its own.

    Attributes:
        at_start: the state at t = 0 of positions and velocities and the skin of the list.
        stretch: a state taken further towards an end, with the status and the rows needed.
        observe: the records of a state.
        elastic: the scene in which no energy is lost.
        followed: a state with the tangents at t = 0, or as it is.
        fault: the status of a given start, where it could not be checked before.
    """

    at_start: Callable[[Array, Array, ArrayLike], Any]
    stretch: Callable[..., Any]
    observe: Callable[[Any], dict[str, Array]]
    elastic: Callable[[Any], Any]
    followed: Callable[[Any], Any]
    fault: Callable[[Any], Array] = lambda state: jnp.zeros((), jnp.int32)


def check_counts(model: Model, **least: int) -> None:
    """Raises ValueError where a whole number of the model is less than it must be."""
    for name, lowest in ({"num_particles": 2, "replicas": 1} | least).items():
        value = getattr(model, name)
        if not isinstance(value, int) or value < lowest:
            raise ValueError(f"{name} must be a whole number >= {lowest}, an int, got {value!r}")
    neighbours.engine(model.neighbours)


def check_box(model: Model, gas: Gas) -> None:
    """Raises ValueError for a gas too dense, a box too small, or a start not of this gas."""
    given.check(model, gas)
    if isinstance(gas.packing_fraction, Tracer) or isinstance(gas.diameter, Tracer):
        return
    limit, phi = initial.PACKING_LIMIT[gas.dimension], float(jnp.max(gas.packing_fraction))
    if phi > limit and model.start is None:
        raise ValueError(
            f"packing_fraction {phi:.3g} is too dense for a fluid start, at most {limit:g}; "
            "lower it, or give your own start"
        )
    side = float(jnp.min(gas.box_side(model.num_particles) / gas.diameter))
    if side < SMALLEST_BOX:
        raise ValueError(
            f"the box is {side:.3g} diameters long, at least {SMALLEST_BOX} are needed to tell "
            "a sphere from its image; use more particles or a lower packing_fraction"
        )


def settled_plan(model: Model, size: Callable[[], Any], **fixed: Any) -> Any:
    """The model's plan, or one that is sized now, if all that it depends on is known.

    Args:
        model: the model, whose plan, if it has one, was made by its `sized_for`.
        size: makes a plan.
        fixed: what a plan fixes besides sizes, as the model and its gas have it now.
    """
    for name, value in fixed.items():
        if model.plan is not None and getattr(model.plan, name) != value:
            raise ValueError(
                f"this {type(model).__name__} was sized for {name} = "
                f"{getattr(model.plan, name)!r}, and now has {value!r}: call sized_for(gas) again"
            )
    try:
        with jax.ensure_compile_time_eval():
            return model.plan or size()
    except jax.errors.ConcretizationTypeError:
        raise ValueError(
            f"inside jax.jit the sizes of arrays must be known: give {type(model).__name__}(...)"
            ".sized_for(gas), made outside with a gas of known numbers"
        ) from None


def run(
    model: Model,
    inputs: Inputs,
    kind: Kind,
    plan: Any,
    skin: ArrayLike,
    dimension: int,
    settings: tuple = (),
) -> Outputs:
    """Melt, then cool.

    Args:
        model: N, replicas, progress and so on.
        inputs: the scene, times, start and key.
        kind: how these spheres move.
        plan: sizes of arrays, with the fields `room` and, for the melt, `melting`.
        skin: of the neighbour list.
        dimension: d.
        settings: what else of the model fixes the result.
    """
    scene, replicas = inputs.scene, model.replicas
    if inputs.start is None:
        keys = jax.random.split(jax.random.key(0) if inputs.key is None else inputs.key)
        size = replicas, model.num_particles, dimension
        position = initial.positions(keys[0], scene.side, *size)
        velocity = initial.velocities(keys[1], *size)
    else:
        position, velocity = inputs.start
    state = kind.at_start(position, velocity, skin)

    def begun(melted):
        velocity = melted.velocity
        if inputs.start is None:
            velocity = initial.settle(velocity, replicas)
        return kind.followed(kind.at_start(melted.position, velocity, melted.skin))

    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(inputs)):
        checkpoint.refuse(model.checkpoint, type(model).__name__)
        if model.neighbours == "jax-md":
            raise ValueError(
                'inside jax.jit or jax.vmap neighbours="jax-md" cannot find the pairs, as it sizes '
                "its cells from known numbers: leave neighbours out"
            )
        state, records, fault = _traced(model, inputs, kind, plan, state, begun)
    else:
        # Under jax.grad every call of a compiled function would be traced again.
        with eval_context():
            state, records, fault = _driven(model, inputs, kind, plan, state, begun, settings)
    return Outputs(neighbours.wrap(scene.side, state.position), state.velocity, records, fault)


_NEEDED: dict[tuple[Any, str], Room] = {}


def _driven(model: Model, inputs: Inputs, kind: Kind, plan, state, begun, settings):
    """Run by a loop on the host, which makes room as it is needed.

    The room that a plan came to need is remembered: a run that goes on from another, or the next
    of a fit, neither fails on the way to it nor compiles again. Results do not depend on it. A melt
    begins with many spheres near contact, and its needs are its own.
    """
    scene, engine = inputs.scene, neighbours.engine(model.neighbours, plan.room.ahead)
    rooms = {"melt": plan.melting, "run": plan.room}

    def advance(state, end: float, scene=scene, stage: str = "run"):
        while True:
            room: Room = _NEEDED.get((plan, stage)) or rooms[stage]
            roomy = plan._replace(room=room)
            state, fault, needed = forward(kind.stretch, state, scene, end, roomy, engine)
            fault = int(fault)
            if fault == status.OK:
                return state
            needed = [int(x) for x in needed]
            missing = fault & (status.LIST_FULL.bit | status.CONTACTS_FULL.bit)
            if not missing or max(needed) > MOST_PAIRS * len(state.position):
                at = float(jnp.mean(state.velocity**2))
                raise RuntimeError(f"stopped at T/T_0 = {at:.3g}: {status.explain(fault)}")
            # That stretch is made again as a whole: a list made on the way has another order.
            _NEEDED[plan, stage] = room.grown(needed)

    # A run to be resumed has been melted.
    if inputs.start is None and not (model.checkpoint and Path(model.checkpoint).exists()):
        elastic, settled = kind.elastic(scene), float(SETTLED / scene.collision_frequency)

        def melt(state, end: float):
            return advance(state, end, elastic, "melt" if state.time < settled else "run")

        end = np.asarray([MELT_COLLISIONS / scene.collision_frequency])
        state, _ = simulate(state, end, melt, kind.observe, progress=model.progress, label="melt")
    state = advance(begun(state), 0.0)  # counts the energy in contacts
    size = model.num_particles, model.replicas, *settings, model.neighbours
    state, records = simulate(
        state,
        np.asarray(inputs.times),
        advance,
        kind.observe,
        scene=checkpoint.fingerprint(inputs, state.tangents, size),
        progress=model.progress,
        path=model.checkpoint,
    )
    records = {name: jnp.asarray(value) for name, value in records.items()}
    return state, records, jnp.zeros((), jnp.int32)


def _traced(model: Model, inputs: Inputs, kind: Kind, plan, state, begun):
    """The same inside `jax.jit`, `jax.vmap` or a derivative: room is fixed beforehand."""

    by = neighbours.engine(model.neighbours, plan.room.ahead, traced=True)
    scene = inputs.scene
    # There a list has no time to be of use, and stretches would not end.
    fault = status.flag(status.BOX_TOO_SMALL, scene.side < SMALLEST_BOX)

    def further(carry, scene, end, plan=plan, least=0, most=None):
        state, fault = carry
        return stretches(kind.stretch, state, scene, end, plan, by, least, most, fault)[:2]

    if inputs.start is None:
        end = MELT_COLLISIONS / scene.collision_frequency
        melting = plan._replace(room=plan.melting)
        state, fault = further((state, fault), kind.elastic(scene), end, melting)
    else:
        fault |= kind.fault(state)
    zero = jnp.zeros_like(state.time)
    state, fault = further((begun(state), fault), scene, zero, least=1, most=1)

    def to(carry, end):
        state, fault = further(carry, scene, end)
        records, bad = kind.observe(state), fault != status.OK
        return (state, fault), jax.tree.map(lambda x: jnp.where(bad, jnp.nan, x), records)

    (state, fault), records = jax.lax.scan(to, (state, fault), inputs.times)
    return state, records, fault


def observed(
    state: Any, side: Array, replicas: int
) -> tuple[dict[str, Array], Float[Array, "replicas N d"], Float[Array, "replicas N d"]]:
    """The records of every kind of spheres, and their paths and velocities in the frame at rest."""

    def centred(x):
        each = x.reshape(replicas, -1, x.shape[-1])
        return each - jnp.mean(each, axis=1, keepdims=True)

    velocity = centred(state.velocity)
    travelled = centred(state.position - state.origin + side * state.image)
    records = {
        "temperature": observables.temperature(velocity),
        "sonine": observables.sonine(velocity),
        "displacement": observables.mean_square_displacement(travelled),
        "velocity_correlation": observables.velocity_correlation(
            centred(state.first_velocity), velocity
        ),
    }
    return records, travelled, velocity


def curve(gas: Gas, times: Array, model: Model, side: Array, run: Outputs) -> CoolingCurve:
    """The curve in SI units, of records in units of diameter, mass and first temperature."""
    energy = gas.mass * gas.temperature
    units = {
        "temperature": gas.temperature,
        "sonine": 1.0,
        "displacement": gas.diameter**2,
        "velocity_correlation": gas.temperature,
        "elastic_energy": energy,
        "dissipated_energy": energy,
        "collisions": 1.0,
        "regularised": 1.0,
    }
    each = {name: values.T * units[name] for name, values in run.records.items()}
    other = given.of_other_box(model, gas)  # where it could not be checked before
    each = {name: jnp.where(other, jnp.nan, values) for name, values in each.items()}
    shape = model.replicas, model.num_particles, gas.dimension
    return CoolingCurve.of_replicas(
        times,
        each,
        particles=Particles(
            position=run.position.reshape(shape) * gas.diameter,
            velocity=run.velocity.reshape(shape) * jnp.sqrt(gas.temperature),
            box_side=side * gas.diameter,
        ),
        status=run.status | status.flag(status.OTHER_BOX, other),
    )
