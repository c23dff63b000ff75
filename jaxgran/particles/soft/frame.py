"""The frame in which a gas is at rest: that of its centre of mass, or of its walls."""

from jaxtyping import Array, Float

from jaxgran.particles import observables
from jaxgran.particles.soft.scene import SoftScene
from jaxgran.particles.state import centred, temperature


def at_rest(scene: SoftScene, velocity: Float[Array, "n d"], replicas: int) -> Float[Array, "n d"]:
    """Velocities in the frame in which each replica is at rest."""
    if scene.walls is not None:
        return velocity
    return centred(velocity, replicas).reshape(velocity.shape)


def heat(
    scene: SoftScene, velocity: Float[Array, "n d"], replicas: int
) -> Float[Array, "replicas"]:
    """T of each replica."""
    if scene.walls is None:
        return temperature(velocity, replicas)
    return observables.temperature(velocity.reshape(replicas, -1, velocity.shape[-1]))


def agitation(
    scene: SoftScene, velocity: Float[Array, "n d"], replicas: int
) -> Float[Array, "replicas"]:
    """T of each replica by all velocities that matter for the length of a step: with those of its
    centre of mass, unless it is at rest."""
    if scene.inertial:
        return temperature(velocity, replicas)
    return observables.temperature(velocity.reshape(replicas, -1, velocity.shape[-1]))


def rotational_temperature(
    scene: SoftScene, spin: Float[Array, "n spins"], replicas: int
) -> Float[Array, "replicas"]:
    """T_rot of each replica, ``q <s^2>/d_rot``."""
    assert scene.surface is not None
    each = spin.reshape(replicas, -1, spin.shape[-1])
    return scene.surface.inertia * observables.temperature(each)
