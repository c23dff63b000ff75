"""The state of a DSMC run."""

from typing import NamedTuple

from jaxtyping import Array, Float, UInt32

from jaxgran.particles.stochastic.tangents import DSMCTangents
from jaxgran.tangents.exchange import ExchangeTangents


class DSMCState(NamedTuple):
    """R replicas of N particles. Units: the impact speed sqrt(2 T_0) and the path length.

    Attributes:
        time: which all replicas have reached.
        clock: start of the step of each replica that ends beyond `time`.
        clock_rest: what rounding has left out of `clock`, a compensated sum.
        temperature: T/T_0, updated by the losses and recomputed every `collisions.RECOUNTED` steps.
        particles: the 2 d components of v and of x - v t, which only collisions change, and the
            spins of rough spheres. With drag they are transformed: see `jaxgran.particles.drag`.
        collisions: number of pairs that collided.
        missed: number of collisions missed because of the `CEILING`.
        steps: number of steps.
        mobility: M = D / sqrt(T/T_0), followed together with the tangents.
        tangents: in the parameters of the law, or of a scene with elements.
    """

    time: Float[Array, ""]
    clock: Float[Array, "*replicas"]
    clock_rest: Float[Array, "*replicas"]
    temperature: Float[Array, "*replicas"]
    particles: Float[Array, "*replicas N components"]
    collisions: Float[Array, "*replicas"]
    missed: Float[Array, "*replicas"]
    steps: UInt32[Array, "*replicas"]
    mobility: Float[Array, "*replicas"]
    tangents: DSMCTangents | ExchangeTangents
