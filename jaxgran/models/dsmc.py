"""Direct simulation Monte Carlo (DSMC) of the velocities of a homogeneous gas."""

from collections.abc import Callable
from math import hypot
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxgran._utils.validation import Domain, checked_float, python_int
from jaxgran.gradients.rule import Result, differentiable
from jaxgran.models import checks
from jaxgran.models.base import Limitation
from jaxgran.models.error_model import ErrorModel
from jaxgran.models.limitations import limitations_of_homogeneity, limitations_of_instant_impacts
from jaxgran.models.particle_model import AbstractParticleModel
from jaxgran.particles.dsmc.collisions import Scheme
from jaxgran.particles.dsmc.dynamics import DSMCDynamics
from jaxgran.particles.snapshot import Units
from jaxgran.scene.gas import Gas
from jaxgran.scene.reduced import ReducedScene, reduced_scene

MAX_STEP = 0.1
"""Largest number of collisions per particle and step: a step draws a particle at most twice."""


class DSMC(AbstractParticleModel):
    """Homogeneous gas of hard spheres by direct simulation Monte Carlo: velocities, no positions.

    Solves the Enskog-Boltzmann equation of the homogeneous gas with any law of restitution:
    pairs collide at the rate ``sigma^(d-1) g_2 / V`` times ``g.n`` for each normal n with
    ``g.n > 0``, ``v_i -> v_i - (1 + eps)/2 (g.n) n``, ``v_j -> v_j + (1 + eps)/2 (g.n) n``.
    The velocity distribution is exact, while kinetic theory has two Sonine terms. The model leaves
    out correlations, clustering and the duration of contacts.

    A step has a fixed number of candidate pairs, and takes the random time in which so many meet,
    on average a fixed share of the current mean free time: T of a run scatters as in a gas of N
    spheres. The error of a step is of second order: it draws disjoint random pairs, and then pairs
    that share a particle with these, as often as drawing one pair after the other would. Means over
    N particles have errors of O(1/N).

    Supports all elements of a scene but `jaxgran.Frictional`: rough spheres; walls, which all
    particles of the homogeneous gas hit with the same probability, more often the more energy the
    walls take (`jaxgran.scene.walls`); drag, exactly, by collisions in transformed time
    (`jaxgran.particles.elements`), up to gamma t = 18 (8 in float32); a drive, with half of the
    kicks at the beginning of each step and half at its end, on subsets of the particles in turn
    (`jaxgran.particles.dsmc.dynamics`).

    Derivatives of T, T_rot and collisions are known in every parameter of the gas and in the times,
    forward and reverse. The gas is assumed to remember its energies only, of translation and of
    rotation, whose tangents grow by what each collision, walls, drag and a drive exchange
    (`jaxgran.gradients.tangents`). The shape of the velocity distribution also depends on A, which
    is left out: d ln T/d ln A is right within .2 % up to gas.thermal_beta = .15, and 1 %, 2.4 % and
    5 % too small at .3, .5 and 1. Kinetic theory differs by more at a finite density, by .6 % at
    phi = .08, because it corrects for correlations of velocities, which this model lacks. All other
    derivatives are nan. Second derivatives are refused.

    Args:
        num_particles: N, >= 2, on one device.
        replicas: number of independent gases that are simulated together; two or more give error
            bars.
        step: mean number of collisions per particle in one step, in (0, 0.1]. A step has at least
            one pair, which is 0.5/N; in a gas of some ten particles this is longer than requested.

    Raises:
        ValueError: for numbers out of range.

    Reference: G. A. Bird, Molecular Gas Dynamics (1994); J. M. Montanero & A. Santos, PRE 54, 438
    (1996) for dense gases; Brilliantov & Poeschel for the granular gas.

    >>> spheres = jaxgran.cool(gas, times[:2], model=jaxgran.DSMC(1000), progress=False)
    >>> f"{float(spheres.temperature[1]):.1g}"
    '0.005'
    """

    num_particles: int = eqx.field(static=True, converter=python_int)
    replicas: int = eqx.field(static=True, converter=python_int, default=1)
    step: float = eqx.field(static=True, default=0.05)

    start: ClassVar[None] = None
    transforms_time: ClassVar[bool] = True
    elements: ClassVar[tuple[str, ...]] = ("surface", "container", "drag", "drive")
    derivative_accuracy: ClassVar[float] = 0.01

    def __check_init__(self):
        allowed = Domain(0.0, MAX_STEP, high_allowed=True)
        checked_float("step", self.step, allowed, "A particle collides at most twice in a step.")

    @property
    def projected(self) -> bool:
        """True: derivatives are projected."""
        return True

    def check(self, gas: Gas) -> None:
        """Raise ValueError if the law of restitution heats the gas."""
        checks.check_cools(gas)

    def estimated_error(self, error_model: ErrorModel) -> float:
        """Estimated relative error of T by `rate_error` and the shot noise of all replicas."""
        noise = error_model.shot_noise(self.num_particles * self.replicas)
        return hypot(error_model.error_of_temperature(self.rate_error(error_model)), noise)

    def rate_error(self, error_model: ErrorModel) -> Float[np.ndarray, "times"]:
        """Relative error of Enskog's rate, by contacts that last and are soft, and by walls."""
        return error_model.homogeneous + error_model.instant_contacts + error_model.mixing

    def limitations(self, gas: Gas, num_particles: int | None = None) -> tuple[Limitation, ...]:
        """Return limitations by contacts that last, correlated collisions, and a growing flow."""
        contacts = limitations_of_instant_impacts(gas)
        return contacts + limitations_of_homogeneity(gas, num_particles)

    def scene(self, gas: Gas) -> ReducedScene:
        """Return the gas in units of its path length and impact speed."""
        return reduced_scene(gas)

    def units(self, gas: Gas) -> Units:
        """Return the path length and the impact speed as units."""
        return Units.from_gas(gas, self.num_particles, gas.path_length, gas.impact_speed)

    def dynamics(
        self, scene: ReducedScene, dimension: int, replicas: int, traced: bool = False
    ) -> DSMCDynamics:
        """Return the steps of the gas."""
        scheme = Scheme.build(dimension, self.num_particles, self.step)
        shape = replicas, self.num_particles, dimension
        return DSMCDynamics(scene=scene, scheme=scheme, shape=shape)

    def differentiable(
        self, run: Callable[..., Result], shifted: Callable[..., Result]
    ) -> Callable[..., Result]:
        """Return runs with derivatives in all numbers of a scene; none of them is a frequency."""
        return differentiable(run, material=lambda scene: scene, frequency=lambda scene: None)

    def batch_dynamics(self, scene: Any, differs: Any, dimension: int, members: int) -> None:
        """Return no motion: particles of a batch wait for nothing."""
        return None

    def derivative_bias(self, gas: Gas, times: Array, flow_share: Array) -> None:
        """Return None: the gas has no flow."""
