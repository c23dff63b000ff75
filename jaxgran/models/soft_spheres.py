"""Soft spheres: every contact resolved in time, in a periodic box."""

import math
import warnings
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy  # which imports scipy.spatial at its first use

from jaxgran._utils.tracing import any_traced, concrete_array
from jaxgran._utils.validation import POSITIVE, checked_float, checked_int, python_int
from jaxgran.data.particles import Particles
from jaxgran.models.array_sizes import ArraySizes
from jaxgran.models.base import Limitation
from jaxgran.models.error_model import ErrorModel
from jaxgran.models.spheres import AbstractSpheres
from jaxgran.particles.capacity import capacities, grid, round_up
from jaxgran.particles.soft.dynamics import SoftDynamics
from jaxgran.scene.contact import elastic_constant
from jaxgran.scene.elements import Frictional
from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import wrap_on_host
from jaxgran.scene.laws import Viscoelastic
from jaxgran.scene.reduced import (
    ReducedContact,
    ReducedFriction,
    ReducedScene,
    ReducedWalls,
    SphereScene,
    sphere_scene,
)
from jaxgran.scene.walls import Walls

PROJECTION = 0.1
"""Mean free times between thermal projections of a derivative."""

MAX_SPEED = 4.8
"""Speed of the fastest of some thousand spheres, in sqrt(T)."""

BLOCK_FLIGHT = 0.08
"""Distance in diameters that the fastest sphere may fly in a block of steps."""

BLOCK_LENGTHS = 1.2
"""Ratio of neighbouring lengths of blocks, each of which needs a compilation."""

MAX_STORED_ENERGY = 0.5
"""Energy of the contacts of a start, over the kinetic energy, without a warning."""

FRICTION_REFUSED = (
    "the derivative of a run of SoftSpheres in the tangential_damping, friction or inertia of "
    "contacts is not known. Hold them fixed with jax.lax.stop_gradient, take differences of runs, "
    "or for a short run use SoftSpheres(projection=None)"
)
"""What is said of derivatives in the numbers of frictional contacts."""

LENGTHS_REFUSED = (
    "the derivative in the side of a container, or in the diameter or packing_fraction of the gas "
    "in it, is not known. Hold them fixed with jax.lax.stop_gradient, take differences of runs, or "
    "use KineticTheory()"
)
"""What is said of derivatives in lengths between walls."""

INTEGRATION_ERROR = 0.001
"""Relative error of T by the time steps, with which eps is right to 1e-4."""


class SoftSpheres(AbstractSpheres):
    """Viscoelastic spheres in periodic boxes, every contact resolved by time steps.

    ``m dv_i/dt = sum_j n_ij F(xi_ij, xi_dot_ij)`` with the force of `jaxgran.contact_force`,
    by drift-kick-drift steps whose kick is an implicit midpoint rule solved in closed form.
    Second order in the step: at 40 steps a contact eps is right to 3e-5 on average, with a scatter
    of 2e-4 that comes from the square root at first contact and falls as dt^(3/2).

    The gas starts from random positions and Maxwellian velocities of exactly T_0 and no momentum,
    after an elastic equilibration of 10 mean free times. Steps lengthen as it cools.

    A gas may have walls (of a `jaxgran.Viscoelastic` law: the same force, with the mass and radius
    of one sphere), where momentum is not conserved; drag, exact in the drift; and friction, also of
    walls (`jaxgran.Frictional`). The energy that they take counts as dissipated. In a step the
    normal kicks of pairs come first, then normal kicks of walls, then tangential kicks.

    Args:
        num_particles: N in each box, >= 2; the box must be 2.1 diameters or longer. It lives on
            one device: the guide says how large it may be.
        steps_per_contact: steps in the mean contact duration at the current temperature, >= 10.
        replicas: number of independent boxes; two or more give error bars. `key` of `jaxgran.cool`
            describes what replicas share.
        start: initial positions and velocities instead of random ones; their box must be the box of
            the gas.
        neighbours: the search for pairs: "sweep" (for boxes of up to some thousand spheres),
            "cells" (for larger ones), "jax-md" (not inside `jax.jit`), or "auto" for the fastest.
        projection: mean free times between thermal projections of a derivative, > 0; derivatives
            agree for 0.02 to 0.5 (see `jaxgran.gradients.tangents`). None for the plain
            derivative, which is exact, and useless after 3 to 5 collisions per particle.
        differences: step in ln(loss of an impact), in (0, 0.5], typically 0.3: derivatives are then
            differences of whole runs (`jaxgran.gradients.differences`). They need two more runs for
            each of A and alpha and have noise, but no bias in a gas that clusters. None for
            projected derivatives.

    Derivatives of T, T_rot, collisions and the energies are known, forward and reverse: a gas
    depends on (alpha, A), its walls and drag, its collision frequency and the times only. The
    density acts through Enskog's collision frequency only: at fixed N it also changes the box, and
    with it the growth of flows, which is left out. The tangent of T is exact but for the
    projection, and the others are estimated from it (`jaxgran.gradients.tangents`). All others, as
    of a_2, <dr^2>, the velocity correlation and the final particles, and derivatives in a
    rotational_temperature of 0, are nan. Derivatives in the friction, tangential_damping and
    inertia of contacts, between walls those in lengths and the density, and second derivatives are
    refused. In boxes above L_c derivatives are too large; the curve estimates this bias
    (``derivative_bias``), and `differences` avoids it. Each replica is simulated in the frame in
    which it is at rest. With a given start T_0 is a unit only, and its derivative is 0.

    Raises:
        ValueError: for numbers out of range.

    >>> model = jaxgran.SoftSpheres(20, replicas=2, steps_per_contact=20)
    >>> model.name, model.num_particles
    ('soft spheres', 20)
    """

    num_particles: int = eqx.field(static=True, converter=python_int)
    steps_per_contact: int = eqx.field(static=True, converter=python_int, default=40)
    replicas: int = eqx.field(static=True, converter=python_int, default=1)
    start: Particles | None = None
    neighbours: str = eqx.field(static=True, default="auto")
    projection: float | None = eqx.field(static=True, default=PROJECTION)
    differences: float | None = eqx.field(static=True, default=None)
    _sizes: ArraySizes | None = eqx.field(static=True, default=None)

    listed_by_skin: ClassVar[float] = 3.0
    sized_by: ClassVar[tuple[str, ...]] = (
        "num_particles",
        "replicas",
        "neighbours",
        "steps_per_contact",
    )
    elements: ClassVar[tuple[str, ...]] = ("friction", "container", "drag")
    transforms_time: ClassVar[bool] = False

    def __check_init__(self):
        checked_int("steps_per_contact", self.steps_per_contact, 10)
        if self.projection is not None:
            advice = f"It is in mean free times: {PROJECTION}, or None for the plain derivative."
            checked_float("projection", self.projection, POSITIVE, advice)

    @property
    def projected(self) -> bool:
        """True if derivatives are projected or by differences, False if they are plain."""
        return self.projection is not None

    def check(self, gas: Gas) -> None:
        """Raise ValueError for a law without a force, a gas too dense or a box too small."""
        if not isinstance(gas.law, Viscoelastic):
            raise ValueError(
                "SoftSpheres needs the Viscoelastic law, which has a force; this gas has "
                f"{type(gas.law).__name__}. Use KineticTheory, DSMC or HardSpheres."
            )
        with jax.ensure_compile_time_eval():
            self.check_spheres(gas, 0.0)
            if gas.container is not None:
                _check_walls(gas.container)
            self._ask_about_overlaps(gas)

    def _ask_about_overlaps(self, gas: Gas) -> None:
        """Warn if contacts of the start store much energy, which becomes thermal motion."""
        start = self.start
        law = gas.law
        if start is None or any_traced(gas, start) or not isinstance(law, Viscoelastic):
            return
        side = np.broadcast_to(np.asarray(start.box_side, float), (gas.dimension,))
        stored = 0.0
        diameter = float(gas.diameter)
        for x in np.asarray(start.position, float):
            tree = scipy.spatial.KDTree(
                wrap_on_host(x, side), boxsize=None if gas.container else side
            )
            distance = tree.sparse_distance_matrix(tree, diameter, output_type="coo_matrix").data
            stored += np.sum((diameter - distance[distance > 0]) ** 2.5) / 2
        stored *= 0.4 * float(elastic_constant(law.youngs_modulus, law.poisson_ratio, diameter))
        kinetic = float(gas.mass) / 2 * float(jnp.sum(start.velocity**2))
        if stored > MAX_STORED_ENERGY * kinetic:
            warnings.warn(
                f"spheres of the start overlap: the energy of their contacts, {stored:.3g} J, "
                f"becomes thermal motion, which has {kinetic:.3g} J. Move them apart, or leave "
                "start out for a random one.",
                stacklevel=4,
            )

    def estimated_error(self, error_model: ErrorModel) -> float:
        """Estimated relative error of T by time steps and noise."""
        return math.hypot(INTEGRATION_ERROR, *self.noise(error_model))

    @property
    def has_contacts(self) -> bool:
        """True."""
        return True

    def rate_error(self, error_model: ErrorModel) -> float:
        """Relative error of the cooling rate by time steps."""
        return INTEGRATION_ERROR

    def limitations(self, gas: Gas, num_particles: int | None = None) -> tuple[Limitation, ...]:
        """Return no limitations: soft spheres resolve every contact."""
        return ()

    def scene(self, gas: Gas) -> SphereScene:
        """Return the gas in units of its diameter, mass and initial temperature."""
        law: Any = gas.law  # `check` refuses others than Viscoelastic, also of walls
        surface = walls = None
        if isinstance(rough := gas.surface, Frictional):
            surface = ReducedFriction(
                rough.tangential_damping,
                rough.friction,
                rough.inertia,
                rough.rotational_temperature / gas.temperature,
            )
        if (box := gas.container) is not None:
            wall_law: Any = box.restitution
            friction = None
            if box.tangential_damping is not None and box.friction is not None:
                friction = ReducedFriction(box.tangential_damping, box.friction)
            walls = ReducedWalls(ReducedContact.from_law(wall_law.of_wall(), gas), None, friction)
        material = ReducedScene(ReducedContact.from_law(law, gas), surface, walls)
        return sphere_scene(gas, self.num_particles, material)

    def law_of_replicas(self, laws: Any, differs: Any) -> Any:
        """Return the contacts of each replica; None if their stiffness, and so steps, differ."""
        if differs.alpha:
            return None
        return ReducedContact(laws.alpha[0], laws.dissipative_constant, laws.clipped)

    def refused_derivatives(self, scene: SphereScene) -> dict[str, Any]:
        """Return numbers of a scene in which the derivative of a run is not known, by a message.

        These are the numbers of frictional contacts, and lengths between walls.
        """
        friction = [scene.material.surface and scene.material.surface._replace(ratio=None)]
        lengths = []
        if scene.container is not None:
            friction.append(scene.material.walls.surface)
            lengths = [scene.side, scene.container, scene.collision_frequency]
        return {FRICTION_REFUSED: friction, LENGTHS_REFUSED: lengths}

    def motion(
        self, scene: SphereScene, shape: tuple[int, int, int], sizes: ArraySizes, engine: str
    ) -> SoftDynamics:
        """Return the motion of the spheres."""
        return SoftDynamics(
            scene=scene,
            shape=shape,
            capacity=sizes.capacity,
            equilibration_capacity=sizes.equilibration_capacity,
            listed_by_skin=self.listed_by_skin,
            engine=engine,
            compiled_engine=sizes.engine,
            steps_per_contact=self.steps_per_contact,
            steps_per_block=sizes.steps,
            projection=concrete_array(self.projection or np.inf, scene.side.dtype),
        )

    def needed_sizes(
        self, scene: SphereScene, dimension: int, replicas: int, spare: float | None = None
    ) -> ArraySizes:
        """Return static sizes; capacities were measured for phi = .01 to .4 (disks: .5) and
        t_c/tau_c = .003 to .3."""
        d = dimension
        n = replicas * self.num_particles
        neighbours = self.neighbourhood(scene, d, replicas)
        duration = round_up(float(scene.contact_duration), grid(n)[0])
        # A block lasts at most a contact, less if spheres fly far in that time.
        contacts_flown = MAX_SPEED * float(scene.contact_duration) / BLOCK_FLIGHT
        shorter = round_up(max(1.0, contacts_flown), BLOCK_LENGTHS)
        steps = max(round(self.steps_per_contact / shorter), 8)
        block = steps / self.steps_per_contact
        flight = MAX_SPEED * duration * block
        near = 0.75 * neighbours.in_contact * neighbours.contact_value * ((1 + 5 * flight) ** d - 1)
        near = near * neighbours.listed / (near + neighbours.listed)
        # Contacts that exist or begin in a block, and the near pairs.
        contact_fraction = duration * neighbours.collision_frequency
        contact_fraction *= (1 + block) / 2
        touching = min(contact_fraction * (2.2 + 3 * near**2), near)
        expected = neighbours.listed, near, touching, 2 * touching / (1 + 1.6 * touching**0.6)
        # At random positions the additional touching pairs are about those without correlation.
        extra = 1.3 * neighbours.in_contact
        capacity, equilibration_capacity = capacities(expected, neighbours, spare or 1.2, extra, n)
        return ArraySizes(steps, capacity, equilibration_capacity, neighbours.engine)


def _check_walls(walls: Walls) -> None:
    """Raise ValueError for walls without a force."""
    if not isinstance(walls.restitution, Viscoelastic):
        raise ValueError(
            "SoftSpheres needs walls of the Viscoelastic law, which has a force (elastic for A = "
            f"0); these have {type(walls.restitution).__name__}. Use HardSpheres, DSMC or "
            "KineticTheory, or Walls(side, restitution=jaxgran.Viscoelastic(...))."
        )
    if walls.tangential_restitution is not None:
        raise ValueError(
            "tangential_restitution of the walls belongs to instantaneous impacts. Give the walls "
            "tangential_damping and friction instead, or use HardSpheres."
        )
