"""Tangents of a gas of lasting contacts: exact for a while, then projected onto its temperature.

The trajectories of a gas diverge by a factor of e^2 to e^5 per collision, and the exact derivative
of a run with them: after a few collisions it says nothing about the mean. But a homogeneous gas
forgets all of its microscopic state except its temperature, and a change of temperature is only a
change of clock: with velocities s times as large, and with ``alpha s^2`` and ``A / s`` in place of
alpha and A, the particles follow the same paths s times as fast. So the tangent of a state in a
parameter p is kept in three parts:

- ``c = d ln T/dp``, which stands for velocities ``(c/2) v`` and for the corresponding changes of
  alpha and A;
- the tangent of the clock, the integral of ``-(c/2) dt``, at a fixed place in the sequence of
  collisions;
- the exact rest of the tangents of positions and velocities.

At regular intervals the rest is projected onto v (thermal projection): the energy in it is added to
c, and what is orthogonal to v is dropped. Spheres in contact are left out until they part.

The derivative at a fixed time is the derivative at a fixed place in the sequence of collisions plus
the rate of change of the gas times the tangent of the clock. The rates are averaged over the last
mean free times. This is less noisy than projecting at fixed times, since no time step is left out
or counted twice where a fixed end time moves through the steps.

In a box longer than L_c a gas remembers its flow too, and these derivatives are too large. What
else a projection may keep there is measured by ``experiments/accuracy/flow_memory.py``: nothing
that was tried is right at 100 collisions a particle, so nothing is kept; use
`jaxgran.gradients.rule`.

Tangents of a gas that exchanges energy with rotation, walls, drag and a drive.

Such a gas is taken to remember two numbers, the energies of translation and of rotation, with
velocities and spins distributed alike at all times. Their tangents ``dE`` in a parameter p, at a
fixed time, grow by the energy F that each step brings:

    d(dE) = dF/dp + dF/dc c + dF/dc_r c_r + F c/2.

Here c and c_r are the tangents ``dE/E`` of the two energies, which stand for velocities (c/2) v and
spins (c_r/2) s at all impacts of the step; and the last term says that faster spheres have more
impacts. All four are sums over the impacts that happen: no law of the gas is assumed. The number of
collisions has the tangent ``d(dN) = dN c/2``.

A direction of its own makes all that happens more frequent. It tells the derivative in time: what
is sooner by some share everywhere, is sooner by this share of its time.

Tangents of the paths of particles: how far they go, and how long they keep their velocity.

In own time s, ``ds = T^(1/2) dt``, collisions come at a constant rate, and kinetic theory has, with
``M = D / T^(1/2)`` and the mean square displacement R,

    dM/ds = 1 - kappa M,    dR/ds = 2 d M,    d ln<v(0).v>/ds = -kappa - zeta/2.

Here zeta is the cooling rate, and kappa the rate of velocity relaxation less zeta/2, both in own
time. For omega collisions per particle and unit of s at a restitution eps they are
``zeta = omega (1 - eps^2)/d`` and ``kappa = omega (1 + eps)^2/(2 d)``, so that a change of eps
changes both in a fixed ratio, ``d kappa = -h d zeta`` with ``h = (1 + eps)/(2 eps)``. The change of
zeta is what makes the tangent of the temperature grow: ``dc/ds = -d zeta``. This closes the
equations with measured rates, whatever the law of restitution.

Reference: Brilliantov & Poeschel, Self-diffusion in granular gases; first Sonine approximation.

Rates of a gas, as averages over its last mean free times.

Tangents of a gas of instantaneous impacts, projected at every impact.

Tangents of spins whose contacts rub, beside those of `jaxgran.gradients.tangents`.

A gas of spheres with friction remembers T and T_rot. A change of clock by c makes velocities and
spins faster alike, and leaves the coefficients of friction as they are. What a spin has besides
``(c/2) s`` is followed exactly, and replaced by its part along s at each projection, which is the
change of ``T_rot/T``.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, DTypeLike, Float

from jaxgran.scene.laws import ReducedLaw


class ExchangeTangents(NamedTuple):
    """Tangents of energies along p directions, the last of which is that of time.

    Attributes:
        energies: of translation and rotation.
        collisions: of their number.
    """

    energies: Float[Array, "p 2 *replicas"]
    collisions: Float[Array, "p *replicas"]

    def after(
        self,
        before: Float[Array, "2 *replicas"],
        gained: Float[Array, "2 *replicas"],
        along: Float[Array, "changes 2 *replicas"],
        collisions: Float[Array, "*replicas"],
    ) -> "ExchangeTangents":
        """The tangents after a step, by the midpoint rule.

        Args:
            before: both energies before it.
            gained: F, what each gained.
            along: tangents of F, for each direction, for the logarithm of all velocities, and for
                that of all spins.
            collisions: that happened.
        """
        sooner = jnp.zeros(len(self.energies), gained.dtype).at[-1].set(1.0)
        sooner = sooner.reshape(-1, *[1] * gained.ndim)
        by_velocity, by_spin = along[-2] + gained, along[-1]

        def growth(c: Array) -> Array:
            by_scale = by_velocity[None] * c[:, :1] / 2 + by_spin[None] * c[:, 1:] / 2
            return along[:-2] + by_scale + sooner * gained[None]

        middle = before + gained / 2
        first = _ratio_or_zero(self.energies, before[None])
        half = _ratio_or_zero(self.energies + growth(first) / 2, middle[None])
        met = sooner[:, 0] * collisions[None] + half[:, 0] / 2 * collisions[None]
        return ExchangeTangents(self.energies + growth(half), self.collisions + met)


def _ratio_or_zero(above: Array, below: Array) -> Array:
    """The ratio, 0 where the denominator is 0."""
    known = below > 0
    return jnp.where(known, above / jnp.where(known, below, 1.0), 0.0)


MIN_RESTITUTION = 0.3
"""Floor of eps in h, which grows without bound as eps vanishes."""


class PathTangents(NamedTuple):
    """Tangents at a fixed place in the sequence of collisions, along p directions.

    Attributes:
        mobility: M.
        displacement: R, as the equations above have it.
        mobility_along: tangents of M.
        displacement_along: tangents of R.
        correlation_along: tangents of ``ln(<v(0).v> / T^(1/2))``.
    """

    mobility: Float[Array, "replicas"]
    displacement: Float[Array, "replicas"]
    mobility_along: Float[Array, "p replicas"]
    displacement_along: Float[Array, "p replicas"]
    correlation_along: Float[Array, "p replicas"]

    @classmethod
    def at_start(cls, num_directions: int, replicas: int, dtype: DTypeLike) -> "PathTangents":
        """The tangents of an initial state."""
        each, along = jnp.zeros(replicas, dtype), jnp.zeros((num_directions, replicas), dtype)
        return cls(each, each, along, along, along)

    def after(
        self,
        own_time: Float[Array, "replicas"],
        gain: Float[Array, "p replicas"],
        meeting: Float[Array, "replicas"],
        cooling: Float[Array, "replicas"],
        dimension: int,
    ) -> "PathTangents":
        """The tangents after a time, by the implicit midpoint rule.

        Args:
            own_time: increase of s.
            gain: increase of c.
            meeting: omega.
            cooling: zeta.
            dimension: d.
        """
        d = dimension
        square = 1 - d * cooling / jnp.maximum(meeting, jnp.finfo(meeting.dtype).tiny)
        eps = jnp.sqrt(jnp.clip(square, MIN_RESTITUTION**2, 1.0))
        ratio = (1 + eps) / (2 * eps)
        half = 0.5 * meeting * (1 + eps) ** 2 / (2 * d) * own_time
        old = self.mobility
        new = ((1 - half) * old + own_time) / (1 + half)
        faded = ratio[None] * gain
        kept, mean = ((1 - half) / (1 + half))[None], (0.5 * (old + new) / (1 + half))[None]
        along = kept * self.mobility_along - mean * faded
        return PathTangents(
            mobility=new,
            displacement=self.displacement + d * own_time * (old + new),
            mobility_along=along,
            displacement_along=self.displacement_along
            + d * own_time[None] * (self.mobility_along + along),
            correlation_along=self.correlation_along - faded,
        )

    @property
    def log_displacement(self) -> Float[Array, "p replicas"]:
        """Tangents of ``ln R``; 0 at t = 0."""
        known = self.displacement > 0
        safe = jnp.where(known, self.displacement, 1.0)
        return jnp.where(known[None], self.displacement_along / safe[None], 0.0)


MEMORY = 5.0
"""Mean free times over which the rates of cooling and of collision are averaged."""


class Rates(NamedTuple):
    """Exponentially weighted sums, by replica, from which rates are estimated.

    Attributes:
        lost: energy lost.
        could_lose: energy that would have been lost, had the cooling rate been the trend itself.
        met: collisions per particle.
        could_meet: collisions per particle, had their rate been ``T^(1/2)``.
    """

    lost: Float[Array, "replicas"]
    could_lose: Float[Array, "replicas"]
    met: Float[Array, "replicas"]
    could_meet: Float[Array, "replicas"]

    @classmethod
    def none(cls, replicas: int, dtype: DTypeLike) -> "Rates":
        """The sums before the first collision."""
        return cls(*[jnp.zeros(replicas, dtype)] * 4)

    def cooling(self, trend: Float[Array, "replicas"]) -> Float[Array, "replicas"]:
        """``-d ln T/dt``, given its trend, which is its dependence on T in an arbitrary unit."""
        return ratio_or_zero(self.lost, self.could_lose) * trend

    def collision(self, temperature: Float[Array, "replicas"]) -> Float[Array, "replicas"]:
        """Collisions per particle and time, proportional to ``T^(1/2)``."""
        return ratio_or_zero(self.met, self.could_meet) * temperature**0.5


class LinearRatio(NamedTuple):
    """A ratio that depends linearly on another number x, both of which drift.

    The past fades exponentially, as in `Rates`. Where x stands still the ratio is its mean.

    Attributes:
        below, below_x, below_square: sums of the denominator, times 1, x and its square.
        above, above_x: the same of the numerator.
    """

    below: Float[Array, "replicas"]
    below_x: Float[Array, "replicas"]
    below_square: Float[Array, "replicas"]
    above: Float[Array, "replicas"]
    above_x: Float[Array, "replicas"]

    def after(self, passed: Array, above: Array, below: Array, x: Array) -> "LinearRatio":
        """With what came in a further time, in mean free times."""
        more = LinearRatio(below, x * below, x**2 * below, above, x * above)
        left = weight_after(passed)
        return LinearRatio(*(left * old + new for old, new in zip(self, more, strict=True)))

    def at(self, x: Float[Array, "replicas"]) -> Float[Array, "replicas"]:
        """The ratio at x; 0 where nothing is known."""
        mean, centre = (
            ratio_or_zero(self.above, self.below),
            ratio_or_zero(self.below_x, self.below),
        )
        square = self.below_square - centre * self.below_x
        known = square > 1e-12 * self.below_square
        slope = ratio_or_zero(self.above_x - centre * self.above, jnp.where(known, square, 0.0))
        return mean + slope * (x - centre)


def weight_after(passed: Any) -> Array:
    """What sums of the past are left by a further time, in mean free times."""
    return jnp.exp(-passed / MEMORY)


def update_rates(
    rates: Rates,
    lost: Float[Array, "replicas"],
    met: Float[Array, "replicas"],
    energy: Float[Array, "replicas"],
    temperature: Float[Array, "replicas"],
    trend: Float[Array, "replicas"],
    duration: ArrayLike,
    collision_frequency: ArrayLike,
) -> Rates:
    """The exponentially weighted sums after a further time.

    Args:
        rates: the sums before.
        lost: energy lost in this time.
        met: collisions per particle that began in it.
        energy: of the gas.
        temperature: of the gas.
        trend: the dependence of the cooling rate on T, at this temperature.
        duration: of this time.
        collision_frequency: at T = 1.
    """
    passed = duration * jnp.sqrt(temperature)
    old = weight_after(passed * collision_frequency)
    return Rates(
        lost=old * rates.lost + lost,
        could_lose=old * rates.could_lose + energy * trend * duration,
        met=old * rates.met + met,
        could_meet=old * rates.could_meet + passed,
    )


def ratio_or_zero(above: Array, below: Array) -> Array:
    """The ratio, 0 where the denominator is 0."""
    return jnp.where(below != 0, above / jnp.where(below != 0, below, 1.0), 0.0)


class ImpactTangents(NamedTuple):
    """Tangents of a gas of instantaneous impacts along p directions in its law of restitution.

    The tangent of the velocities is (c/2) v, without a rest, since every impact is projected. An
    impact at the normal speed g dissipates ``(1 - eps^2) g^2 / 4``, so that a change of eps adds
    ``eps g^2 d eps / 2`` to the energy, with ``d eps = d eps/dp + (c/2) d eps/d ln g``.

    Attributes:
        law: the directions, stacked along a first axis of each leaf.
        log_temperature: c = d ln T.
        clock: tangent of the time at a fixed place in the sequence of collisions.
        rates: of the gas.
        paths: tangents of the paths of the particles.
    """

    law: ReducedLaw
    log_temperature: Float[Array, "p replicas"]
    clock: Float[Array, "p replicas"]
    rates: Rates
    paths: PathTangents

    @classmethod
    def at_start(cls, law: ReducedLaw, replicas: int, dtype: DTypeLike) -> "ImpactTangents":
        """The tangents of an initial state, which does not depend on the law."""
        num_directions = max((len(leaf) for leaf in jax.tree.leaves(law)), default=0)
        zeros = jnp.zeros((num_directions, replicas), dtype)
        paths = PathTangents.at_start(num_directions, replicas, dtype)
        return cls(law, zeros, zeros, Rates.none(replicas, dtype), paths)

    def gains(
        self, law: ReducedLaw, normal_speed: Float[Array, "rows"]
    ) -> Float[Array, "changes rows"]:
        """``eps g^2 d eps / 2`` of impacts: one row per direction, and a last one for ln g."""

        def along(direction):
            return jax.jvp(lambda law: law.restitution(normal_speed), (law,), (direction,))[1]

        eps, in_speed = jax.jvp(law.restitution, (normal_speed,), (normal_speed,))
        slopes = in_speed[None]
        if len(self.log_temperature):
            slopes = jnp.concatenate([jax.vmap(along)(self.law), slopes])
        return 0.5 * (eps * normal_speed**2)[None] * slopes

    def after(
        self,
        gains: Float[Array, "changes replicas"],
        energy: Float[Array, "replicas"],
        temperature: Float[Array, "replicas"],
        duration: ArrayLike,
        rates: Rates,
        trend: Float[Array, "replicas"],
        dimension: int,
    ) -> "ImpactTangents":
        """The tangents after some impacts, by the implicit midpoint rule.

        Args:
            gains: the sums of `gains` over the impacts.
            energy: mean thermal energy of each replica during them.
            temperature: T of each replica after them.
            duration: of the time in which they happened.
            rates: of the gas after them.
            trend: the dependence of its cooling rate on T, now.
            dimension: d.
        """
        c = self.log_temperature
        half = gains[-1:] / (4 * energy[None])
        new = ((1 + half) * c + gains[:-1] / energy[None]) / (1 - half)
        speed = jnp.sqrt(temperature)
        paths = self.paths.after(
            speed * duration,
            new - c,
            meeting=rates.collision(jnp.ones_like(speed)),
            cooling=rates.cooling(trend) / jnp.where(speed > 0, speed, 1.0),
            dimension=dimension,
        )
        return self._replace(
            log_temperature=new,
            clock=self.clock - 0.25 * (c + new) * duration,
            rates=rates,
            paths=paths,
        )


class FrictionMaterial(NamedTuple):
    """The numbers of friction, or their tangents; None is what a scene does not have.

    Attributes:
        damping, friction, inertia, ratio: of the spheres, as in `soft.scene.SoftSurface`.
        wall_damping, wall_friction: of walls.
    """

    damping: Any
    friction: Any
    inertia: Any
    ratio: Any
    wall_damping: Any = None
    wall_friction: Any = None


class RotationTangents(NamedTuple):
    """Tangents of the spins along p directions.

    Attributes:
        directions: in the numbers of friction.
        spin: tangents of the spins, without the part (c/2) s.
        turned: energy that rotation gained in contacts in a mean free time, over that of
            translation, which depends on the ratio of both.
    """

    directions: FrictionMaterial
    spin: Float[Array, "p n spins"]
    rotational_gain: LinearRatio

    @classmethod
    def at_start(
        cls,
        directions: FrictionMaterial,
        inertia: Float[Array, ""],
        ratio: Float[Array, ""],
        spin: Float[Array, "n spins"],
        replicas: int,
    ) -> "RotationTangents":
        """The tangents of spins of ``q s^2 = ratio``; nan along a ratio that is 0, of which the
        spins are a square root."""
        along = directions.ratio
        faster = jnp.where(along == 0, 0.0, along / ratio) - directions.inertia / inertia
        zeros = jnp.zeros(replicas, spin.dtype)
        return cls(directions, 0.5 * faster[:, None, None] * spin[None], LinearRatio(*[zeros] * 5))

    def projected(
        self,
        spin: Float[Array, "n spins"],
        gain: Float[Array, "p replicas"],
        free: Bool[Array, "n"],
        due: ArrayLike,
    ) -> "RotationTangents":
        """The tangents after a projection that adds a gain to c, or unchanged unless it is due.

        Args:
            spin: of the spheres.
            gain: of c.
            free: spheres without contact, which are projected.
            due: whether it is time to.
        """
        replicas = gain.shape[1]
        size = len(spin) // replicas
        rest = self.spin - 0.5 * jnp.repeat(gain, size, axis=1)[:, :, None] * spin[None]
        share = along_spin(rest, jnp.where(free[:, None], spin, 0.0), replicas)
        kept = jnp.repeat(share, size, axis=1)[:, :, None] * spin[None]
        new = jnp.where(free[None, :, None], kept, rest)
        return self._replace(spin=jnp.where(due, new, self.spin))

    def log_temperature(
        self, spin: Float[Array, "n spins"], inertia: Array, c: Float[Array, "p replicas"]
    ) -> Float[Array, "p replicas"]:
        """Tangents of ln T_rot: those of q, of the clock, and of the spins besides."""
        share = along_spin(self.spin, spin, c.shape[1])
        return (self.directions.inertia / inertia)[:, None] + c + 2 * share


def along_spin(
    rest: Float[Array, "p n spins"], spin: Float[Array, "n spins"], replicas: int
) -> Float[Array, "p replicas"]:
    """The part of each replica's rest along its spins, over them; 0 where none rotates."""
    each = spin.reshape(replicas, -1)
    found = jnp.sum(rest.reshape(len(rest), *each.shape) * each[None], -1)
    return ratio_or_zero(found, jnp.sum(each * each, -1)[None])


class ElementMaterial(NamedTuple):
    """The numbers of walls and drag, or their tangents; None is what a scene does not have.

    Attributes:
        wall_alpha, wall_constant: alpha and A of contacts with walls.
        drag: gamma.
        spin_drag: rate at which spins slow down.
    """

    wall_alpha: Any = None
    wall_constant: Any = None
    drag: Any = None
    spin_drag: Any = None

    def of_walls(self) -> tuple[Any, Any]:
        """(alpha, A) of contacts with walls."""
        return self.wall_alpha, self.wall_constant


class ThermalTangents(NamedTuple):
    """Tangents of the state of a gas along p directions in (alpha, A), and in walls and drag.

    Attributes:
        alpha, dissipative_constant: the directions.
        log_temperature: c = d ln T.
        clock: tangent of the time at a fixed place in the sequence of collisions.
        position: tangent of the positions.
        velocity: tangent of the velocities, without the part (c/2) v.
        free: whether a sphere touches no other one.
        elapsed: time since the last projection.
        own_elapsed: the integral of T^(1/2) over this time.
        interval: between projections, in mean free times.
        damping: q delta of the trend.
        rates: of the gas.
        paths: tangents of the paths of the particles, up to the last projection.
        elements: directions in walls and drag; None where the gas has neither.
        drag: gamma; None without drag.
        rotation: tangents of spins; None of spheres that do not rub.
    """

    alpha: Float[Array, "p"]
    dissipative_constant: Float[Array, "p"]
    log_temperature: Float[Array, "p replicas"]
    clock: Float[Array, "p replicas"]
    position: Float[Array, "p n d"]
    velocity: Float[Array, "p n d"]
    free: Bool[Array, "n"]
    elapsed: Float[Array, ""]
    own_elapsed: Float[Array, "replicas"]
    interval: Float[Array, ""]
    damping: Float[Array, ""]
    rates: Rates
    paths: PathTangents
    elements: ElementMaterial | None = None
    drag: Float[Array, ""] | None = None
    rotation: RotationTangents | None = None

    def cooling(self, temperature: Float[Array, "replicas"]) -> Float[Array, "replicas"]:
        """``-d ln T/dt`` at a temperature, by contacts and drag."""
        by_contacts = self.rates.cooling(self.trend(temperature))
        return by_contacts if self.drag is None else by_contacts + 2 * self.drag

    def trend(self, temperature: Float[Array, "replicas"]) -> Float[Array, "replicas"]:
        """Dependence of the cooling rate on T, ``T^(3/5) / (1 + q delta T^(1/10))``.

        This has the first two terms of the rate in the dissipation delta.
        """
        return temperature**0.6 / (1 + self.damping * temperature**0.1)

    def material(self, scene_alpha: ArrayLike, scene_constant: ArrayLike) -> tuple[Array, Array]:
        """Tangents of alpha and A with the change of clock by c, each of shape (p, replicas)."""
        c = self.log_temperature
        alpha = self.alpha[:, None] - c * scene_alpha
        return alpha, self.dissipative_constant[:, None] + 0.5 * c * scene_constant

    def of_elements(self, scene: ElementMaterial) -> ElementMaterial:
        """The same of walls and drag, of which gamma is in units of a rate."""
        along, c = self.elements, self.log_temperature
        assert along is not None

        def moved(direction: Any, power: float, value: Any) -> Any:
            return None if value is None else direction[:, None] + power * c * value

        return ElementMaterial(
            wall_alpha=moved(along.wall_alpha, -1.0, scene.wall_alpha),
            wall_constant=moved(along.wall_constant, 0.5, scene.wall_constant),
            drag=moved(along.drag, -0.5, scene.drag),
            spin_drag=moved(along.spin_drag, -0.5, scene.spin_drag),
        )


def initial_tangents(
    alpha: Float[Array, "p"],
    dissipative_constant: Float[Array, "p"],
    velocity: Float[Array, "n d"],
    replicas: int,
    interval: ArrayLike,
    damping: ArrayLike,
    elements: ElementMaterial | None = None,
    drag: Float[Array, ""] | None = None,
) -> ThermalTangents:
    """The tangents of an initial state, which does not depend on the parameters.

    Args:
        alpha, dissipative_constant: the p directions in (alpha, A).
        velocity: of the state, for its shape and dtype.
        replicas: number of boxes.
        interval: between projections, in mean free times.
        damping: q delta of `ThermalTangents.trend`.
        elements, drag: as in `ThermalTangents`.
    """
    p, dtype = len(alpha), velocity.dtype
    zeros = jnp.zeros((p, replicas), dtype)
    nothing = jnp.zeros((p, *velocity.shape), dtype)
    return ThermalTangents(
        alpha=alpha,
        dissipative_constant=dissipative_constant,
        log_temperature=zeros,
        clock=zeros,
        position=nothing,
        velocity=nothing,
        free=jnp.ones(len(velocity), bool),
        elapsed=jnp.zeros((), dtype),
        own_elapsed=jnp.zeros(replicas, dtype),
        interval=jnp.asarray(interval, dtype),
        damping=jnp.asarray(damping, dtype),
        rates=Rates.none(replicas, dtype),
        paths=PathTangents.at_start(p, replicas, dtype),
        elements=elements,
        drag=drag,
    )


class Projection(NamedTuple):
    """What a projection changes.

    Attributes:
        log_temperature: c = d ln T, with the energy that the rest held.
        clock: tangent of the clock.
        paths: tangents of the paths.
    """

    log_temperature: Float[Array, "p replicas"]
    clock: Float[Array, "p replicas"]
    paths: PathTangents


def projected(tangents: ThermalTangents, velocity: Float[Array, "n d"]) -> Projection:
    """A projection now, of the spheres that touch no other one.

    Args:
        tangents: of the state.
        velocity: of the particles, in the frame in which each replica is at rest.
    """
    c = tangents.log_temperature
    replicas, d = c.shape[1], velocity.shape[1]
    each = velocity.reshape(replicas, -1)
    v = jnp.where(tangents.free[:, None], velocity, 0.0).reshape(replicas, -1)
    rest = tangents.velocity.reshape(len(c), *v.shape)
    gain = ratio_or_zero(2 * jnp.sum(rest * v[None], -1), jnp.sum(v * v, -1)[None])
    heat = jnp.mean(each * each, -1)
    one = jnp.ones_like(heat)
    return Projection(
        log_temperature=c + gain,
        clock=tangents.clock - 0.5 * (c + 0.5 * gain) * tangents.elapsed,
        paths=tangents.paths.after(
            tangents.own_elapsed,
            gain,
            meeting=tangents.rates.collision(one),
            cooling=ratio_or_zero(tangents.cooling(heat), jnp.sqrt(heat)),
            dimension=d,
        ),
    )


def project(
    tangents: ThermalTangents,
    velocity: Float[Array, "n d"],
    due: ArrayLike,
    spin: Float[Array, "n spins"] | None = None,
) -> ThermalTangents:
    """The tangents after a thermal projection now, or unchanged unless it is due."""
    new = projected(tangents, velocity)
    replicas = new.clock.shape[1]
    gain = new.log_temperature - tangents.log_temperature
    each_gain = jnp.repeat(gain, len(velocity) // replicas, axis=1)
    dropped = due & tangents.free[None, :, None]
    kept = tangents.velocity - 0.5 * each_gain[:, :, None] * velocity[None]
    held = jnp.where(due, kept, tangents.velocity)
    old = Projection(tangents.log_temperature, tangents.clock, tangents.paths)
    now = jax.tree.map(lambda new, old: jnp.where(due, new, old), new, old)
    rotation = tangents.rotation
    if rotation is not None and spin is not None:
        rotation = rotation.projected(spin, gain, tangents.free, due)
    return tangents._replace(
        rotation=rotation,
        **now._asdict(),
        position=jnp.where(dropped, 0.0, tangents.position),
        velocity=jnp.where(dropped, 0.0, held),
        elapsed=jnp.where(due, 0.0, tangents.elapsed),
        own_elapsed=jnp.where(due, 0.0, tangents.own_elapsed),
    )
