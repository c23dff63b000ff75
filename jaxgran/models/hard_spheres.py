"""Hard spheres: instantaneous impacts in a periodic box, resolved event by event."""

import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import numpy as np
import scipy  # which imports scipy.spatial at its first use
from jaxtyping import Float

from jaxgran._utils.tracing import any_traced, concrete_array
from jaxgran._utils.validation import Domain, checked_float, python_int
from jaxgran.data.particles import Particles
from jaxgran.models import checks
from jaxgran.models.array_sizes import ArraySizes
from jaxgran.models.base import Limitation
from jaxgran.models.error_model import ErrorModel
from jaxgran.models.limitations import limitations_of_instant_impacts
from jaxgran.models.spheres import AbstractSpheres
from jaxgran.particles.capacity import capacities
from jaxgran.particles.hard.dynamics import (
    ALLOWED_OVERLAP,
    SPEED_MARGIN,
    HardDynamics,
    allowed_overlap,
)
from jaxgran.particles.hard.impacts import LawOfReplicas
from jaxgran.particles.hard.window_length import MIN_IMPACTS, longest_window
from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import wrap_on_host
from jaxgran.scene.reduced import SphereScene, reduced_scene, sphere_scene
from jaxgran.theory.averages import collision_rate

WINDOW_SHARE = 0.05
"""Impacts per particle in a window."""

CONTACT_TIMES = Domain(0.0, 0.1, low_allowed=True, high_allowed=True)


class HardSpheres(AbstractSpheres):
    """Spheres in periodic boxes that collide instantaneously, by any law of restitution.

    Between impacts spheres fly freely; an impact changes their velocities by
    ``+- (1 + eps(g)) g n / 2`` with the unit vector n between the centres and the normal speed g of
    approach. A serial event-driven code has the same impacts; here many are resolved at once,
    namely all impacts that no other impact can precede.

    Inelastic collapse, infinitely many impacts in a finite time, is prevented by making an impact
    of a sphere elastic within ``contact_time`` of its last one (Luding & McNamara, Granular Matter
    1, 113 (1998), the TC model). In a homogeneous gas this lowers the loss by the share
    ``2 contact_time``.

    The gas starts from random positions and Maxwellian velocities of exactly T_0 and no momentum,
    after an elastic equilibration of 10 mean free times.

    Supports all elements of a scene but `jaxgran.Frictional`: rough spheres; containers, cubes or
    boxes of given sides, with exact impacts on their walls, in place of the periodic box; drag,
    exactly, by impacts in transformed time (`jaxgran.particles.elements`), up to gamma t = 18 (8 in
    float32); a drive, with kicks at both ends of each window of some .05 mean free times.

    Args:
        num_particles: N in each box, >= 2; the box must be 2.1 diameters or longer. It lives on
            one device: the guide says how large it may be.
        replicas: number of independent boxes; two or more give error bars. `key` of `jaxgran.cool`
            describes what replicas share.
        contact_time: in mean free times of the homogeneous gas at the current temperature, in
            [0, 0.1]; 0 is the pure hard sphere, which may collapse.
        start: initial positions and velocities instead of random ones; their box must be the box of
            the gas, and no spheres may overlap. In a container positions are coordinates from a
            corner, and centres must be at least a radius from each wall.
        neighbours: the search for pairs: "sweep" (for boxes of up to some thousand spheres),
            "cells" (for larger ones), "jax-md" (not inside `jax.jit`), or "auto" for the fastest.
        differences: step in ln(loss of an impact), in (0, 0.5], typically 0.3: derivatives are then
            differences of whole runs (`jaxgran.gradients.differences`). They need two more runs for
            each number of the law and have noise, but no bias in a gas that clusters. None for
            projected derivatives.

    Derivatives of T, T_rot and collisions are known in every parameter of the gas and in the times,
    forward and reverse, for any law, and of the dissipated energy for smooth spheres. The gas
    is assumed to remember its energies only, of translation and of rotation, whose tangents grow by
    what each impact, walls, drag and a drive exchange (`jaxgran.gradients.tangents`). Compared with
    finite differences d ln T/d ln A is right within 5 % in boxes shorter than L_c, but 14 % too
    large after 10 mean free times where flows have begun to hold energy (phi = .2, beta = .3,
    1.1 L_c). The curve's ``derivative_bias`` estimates this bias, and `differences` avoids it. It
    does not contain what the shape of the velocity distribution adds, 1 % at a thermal beta of .3
    and 5 % at 1 (`jaxgran.gradients.tangents`). The
    density acts through Enskog's collision frequency only: at fixed N it also changes the box, and
    with it the growth of flows, which is left out. All other derivatives, as of a_2, <dr^2>, the
    velocity correlation and the final particles, are nan. Second derivatives are refused. Each
    replica is simulated in the frame in which it is at rest, unless there are walls or drag. With a
    given start T_0 is a unit only, and its derivative is 0; the start scales with the diameter.

    The positions of spheres between walls are not remembered, except that the gas is denser before
    walls the more energy they take (`jaxgran.scene.walls`). Compared with differences (N = 500,
    eps_w = .8) a derivative in eps_w is right within 2 %. With rough walls the derivative of T_rot
    in beta_t is up to 20 % too small, since spins near walls differ from spins in the middle.

    Raises:
        ValueError: for numbers out of range.

    >>> model = jaxgran.HardSpheres(50, replicas=2)
    >>> model.num_particles, model.stochastic
    (50, True)
    """

    num_particles: int = eqx.field(static=True, converter=python_int)
    replicas: int = eqx.field(static=True, converter=python_int, default=1)
    contact_time: float = eqx.field(static=True, default=1e-5)
    start: Particles | None = None
    neighbours: str = eqx.field(static=True, default="auto")
    differences: float | None = eqx.field(static=True, default=None)
    _sizes: ArraySizes | None = eqx.field(static=True, default=None)

    listed_by_skin: ClassVar[float] = 7.0
    sized_by: ClassVar[tuple[str, ...]] = ("num_particles", "replicas", "neighbours")
    transforms_time: ClassVar[bool] = True
    elements: ClassVar[tuple[str, ...]] = ("surface", "container", "drag", "drive")

    def __check_init__(self):
        advice = "In mean free times; it only keeps clusters from collapsing, so leave it small."
        checked_float("contact_time", self.contact_time, CONTACT_TIMES, advice)

    @property
    def projected(self) -> bool:
        """True: derivatives are projected or by differences."""
        return True

    def check(self, gas: Gas) -> None:
        """Check that the model supports this law and scene.

        Raises:
            ValueError: for a law that heats the gas, a gas too dense, a box too small, or a start
                with spheres that overlap.
        """
        checks.check_cools(gas)
        with jax.ensure_compile_time_eval():
            self.check_spheres(gas, 0.5 - ALLOWED_OVERLAP)
            self._check_overlap(gas)

    def _check_overlap(self, gas: Gas) -> None:
        if self.start is None or any_traced(gas, self.start):
            return  # the run checks traced values
        side = float(self.scene(gas).side)
        boxes = np.asarray(self.start.position, float) / float(gas.diameter)
        trees = [scipy.spatial.KDTree(wrap_on_host(box, side), boxsize=side) for box in boxes]
        # The nearest neighbour of each sphere after itself; infinite if none overlaps.
        closest = min(
            np.min(tree.query(tree.data, 2, distance_upper_bound=1.0)[0][:, 1]) for tree in trees
        )
        if closest < 1 - float(allowed_overlap(self.start.position.dtype, side)):
            raise ValueError(
                f"two spheres of the start are {closest:.9g} diameters apart, hard spheres must "
                "not overlap. Move them apart, or leave start out for a random one."
            )

    def estimated_error(self, error_model: ErrorModel) -> float:
        """Estimated relative error of T by contacts that last and overlap, and by noise."""
        contacts = error_model.error_of_temperature(self.rate_error(error_model))
        return math.hypot(contacts, *self.noise(error_model))

    def rate_error(self, error_model: ErrorModel) -> Float[np.ndarray, "times"]:
        """Relative error of the cooling rate by contacts that last and overlap."""
        return error_model.instant_contacts

    def limitations(self, gas: Gas, num_particles: int | None = None) -> tuple[Limitation, ...]:
        """Return limitations by contacts that last and overlap."""
        return limitations_of_instant_impacts(gas)

    def scene(self, gas: Gas) -> SphereScene:
        """Return the gas in units of its diameter, mass and initial temperature."""
        material = reduced_scene(gas)
        if (walls := material.walls) is not None:
            per_collision = walls.frequency / collision_rate(0.0, gas.dimension)
            material = material._replace(walls=walls._replace(frequency=per_collision))
        return sphere_scene(gas, self.num_particles, material)

    def motion(
        self, scene: SphereScene, shape: tuple[int, int, int], sizes: ArraySizes, engine: str
    ) -> HardDynamics:
        """Return the motion of the spheres."""
        return HardDynamics(
            scene=scene,
            shape=shape,
            capacity=sizes.capacity,
            equilibration_capacity=sizes.equilibration_capacity,
            listed_by_skin=self.listed_by_skin,
            engine=engine,
            compiled_engine=sizes.engine,
            share=sizes.steps,
            contact_time=concrete_array(self.contact_time, scene.side.dtype),
            all_elastic=concrete_array(False),
        )

    def law_of_replicas(self, laws: Any, differs: Any) -> LawOfReplicas:
        """Return the law of each replica."""
        return LawOfReplicas(laws)

    def refused_derivatives(self, scene: SphereScene) -> dict[str, Any]:
        """Return nothing: derivatives are known in all numbers."""
        return {}

    def needed_sizes(
        self, scene: SphereScene, dimension: int, replicas: int, spare: float | None = None
    ) -> ArraySizes:
        """Return static sizes; capacities were measured for phi = .001 to .4 (disks: .6) and
        N = 125 to 50 000."""
        d = dimension
        n = replicas * self.num_particles
        neighbours = self.neighbourhood(scene, d, replicas)
        share = max(WINDOW_SHARE, 2 * MIN_IMPACTS / n)
        fastest = SPEED_MARGIN * (0.5 + (2 * math.log(n)) ** 0.5)  # of Maxwell's n speeds
        longest = share * longest_window(0.5 * share * n)
        reach = 2 * fastest * longest / neighbours.collision_frequency
        packed = 0.9 + 0.45 * neighbours.in_contact / 2 ** (d - 1)
        near = packed * neighbours.contact_value * neighbours.in_contact * ((1 + reach) ** d - 1)
        near = min(near, neighbours.listed)
        chosen = min((0.65 + 0.35 * near) * longest, neighbours.listed)
        expected = neighbours.listed, near, chosen, 1.25 * longest
        extra = 1.3 * max(neighbours.in_contact - 0.4, 0.0)  # random positions have more near pairs
        capacity, equilibration_capacity = capacities(expected, neighbours, spare or 1.15, extra, n)
        return ArraySizes(share, capacity, equilibration_capacity, neighbours.engine)
