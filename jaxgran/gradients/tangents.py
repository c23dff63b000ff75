"""Tangents of chaotic gases, projected onto the few quantities that a homogeneous gas remembers.

The trajectories of a gas diverge by a factor of e^2 to e^5 per collision, and the exact derivative
of a run with them: after a few collisions it says nothing about the mean. But a homogeneous gas
forgets all of its microscopic state except its temperature, and a change of temperature is only a
change of clock: with velocities s times as large, and with ``alpha s^2`` and ``A / s`` in place of
alpha and A, the particles follow the same paths s times as fast. So the tangent of a state in a
parameter p is projected onto ``c = d ln T/dp`` and the tangent of the clock:

- `ContactTangents`: gases of lasting contacts;
- `ImpactTangents`: gases of instantaneous impacts;
- `ExchangeTangents`: gases that exchange energy with rotation, walls, drag and a drive;
- `PathTangents`: displacements and the velocity correlation of a gas;
- `RateSums` and `LinearRatio`: averages over its last mean free times.

The derivative at a fixed time is the derivative at a fixed place in the sequence of collisions plus
the rate of change of the gas times the tangent of the clock. The rates are averages over the last
mean free times. This is less noisy than projecting at fixed times, since no time step is left out
or counted twice where a fixed end time moves through the steps.

In a box longer than L_c a gas also remembers its flow, and these derivatives are too large.
``experiments/accuracy.md`` has figures of projections that keep more of the tangents there: none of
them is right at 100 collisions per particle, so the package has none. Use differences of
runs (`jaxgran.gradients.rule.by_differences`) in such boxes.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, DTypeLike, Float

from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.laws import ReducedLaw

AVERAGING_TIME = 5.0
"""Mean free times over which the rates of cooling and of collision are averaged."""


def ratio_or_zero(above: Array, below: Array) -> Array:
    """Return the ratio, or 0 where the denominator is 0."""
    return jnp.where(below != 0, above / jnp.where(below != 0, below, 1.0), 0.0)


class RateSums(NamedTuple):
    """Exponentially weighted sums, by replica, from which rates are estimated.

    Attributes:
        lost: energy lost.
        trend_loss: energy that a cooling rate equal to the trend would have taken.
        collisions: per particle.
        trend_collisions: per particle, if their rate were ``T^(1/2)``.
    """

    lost: Float[Array, "replicas"]
    trend_loss: Float[Array, "replicas"]
    collisions: Float[Array, "replicas"]
    trend_collisions: Float[Array, "replicas"]

    @classmethod
    def zero(cls, replicas: int, dtype: DTypeLike) -> "RateSums":
        """Return the sums before the first collision."""
        return cls(*[jnp.zeros(replicas, dtype)] * 4)

    def cooling(self, trend: Float[Array, "replicas"]) -> Float[Array, "replicas"]:
        """Return ``-d ln T/dt``, given its trend: its dependence on T in an arbitrary unit."""
        return ratio_or_zero(self.lost, self.trend_loss) * trend

    def collision(self, temperature: Float[Array, "replicas"]) -> Float[Array, "replicas"]:
        """Return the collisions per particle and time, which are proportional to ``T^(1/2)``."""
        return ratio_or_zero(self.collisions, self.trend_collisions) * temperature**0.5

    def after(
        self,
        lost: Float[Array, "replicas"],
        collisions: Float[Array, "replicas"],
        energy: Float[Array, "replicas"],
        temperature: Float[Array, "replicas"],
        trend: Float[Array, "replicas"],
        duration: Any,
        collision_frequency: Any,
    ) -> "RateSums":
        """Return the sums after a further time.

        Args:
            lost: energy lost in this time.
            collisions: per particle, those that began in it.
            energy: of the gas.
            temperature: of the gas.
            trend: the dependence of the cooling rate on T, at this temperature.
            duration: of this time.
            collision_frequency: at T = 1.
        """
        passed = duration * jnp.sqrt(temperature)
        new = RateSums(lost, energy * trend * duration, collisions, passed)
        return _add_decayed(self, new, passed * collision_frequency)


class LinearRatio(NamedTuple):
    """Ratio that depends linearly on another number x, when both drift in time.

    The weight of the past decays exponentially, as in `RateSums`. If x is constant, the ratio is
    its mean.

    Attributes:
        below, below_x, below_square: sums of the denominator, times 1, x and its square.
        above, above_x: sums of the numerator, times 1 and x.
    """

    below: Float[Array, "replicas"]
    below_x: Float[Array, "replicas"]
    below_square: Float[Array, "replicas"]
    above: Float[Array, "replicas"]
    above_x: Float[Array, "replicas"]

    def after(self, passed: Array, above: Array, below: Array, x: Array) -> "LinearRatio":
        """Return the sums after a further time `passed`, in mean free times."""
        new = LinearRatio(below, x * below, x**2 * below, above, x * above)
        return _add_decayed(self, new, passed)

    def at(self, x: Float[Array, "replicas"]) -> Float[Array, "replicas"]:
        """Return the ratio at x, or 0 where there is no data."""
        mean = ratio_or_zero(self.above, self.below)
        centre = ratio_or_zero(self.below_x, self.below)
        square = self.below_square - centre * self.below_x
        known = square > 1e-12 * self.below_square
        slope = ratio_or_zero(self.above_x - centre * self.above, jnp.where(known, square, 0.0))
        return mean + slope * (x - centre)


def _add_decayed(old: Any, new: Any, passed: Any) -> Any:
    """Return sums that forget the past, `passed` mean free times ago, plus new ones."""
    decay = jnp.exp(-passed / AVERAGING_TIME)
    return jax.tree.map(lambda old, new: decay * old + new, old, new)


MIN_RESTITUTION = 0.3
"""Lower bound of eps in h of `PathTangents`, which diverges as eps vanishes."""


class PathTangents(NamedTuple):
    """Tangents of the paths of particles at a fixed place in the sequence of collisions.

    There are p directions. In thermal time s, ``ds = T^(1/2) dt``, collisions come at a constant
    rate, and kinetic theory has, with ``M = D / T^(1/2)`` and the mean square displacement R,

        dM/ds = 1 - kappa M,    dR/ds = 2 d M,    d ln<v(0).v>/ds = -kappa - zeta/2.

    Here zeta is the cooling rate, and kappa the rate of velocity relaxation less zeta/2, both in
    thermal time. For omega collisions per particle and unit of s at a restitution eps they are
    ``zeta = omega (1 - eps^2)/d`` and ``kappa = omega (1 + eps)^2/(2 d)``, so that a change of eps
    changes both in a fixed ratio, ``d kappa = -h d zeta`` with ``h = (1 + eps)/(2 eps)``. The
    change of zeta makes the tangent of the temperature grow: ``dc/ds = -d zeta``. This closes the
    equations with measured rates, for any law of restitution.

    Reference: Brilliantov & Poeschel, Self-diffusion in granular gases; first Sonine approximation.

    Attributes:
        mobility: M.
        displacement: R.
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
    def initial(cls, directions: Any, replicas: int, dtype: DTypeLike) -> "PathTangents":
        """Return the tangents of an initial state, with directions along the first axis."""
        num_directions = max((len(leaf) for leaf in jax.tree.leaves(directions)), default=0)
        zeros, along = jnp.zeros(replicas, dtype), jnp.zeros((num_directions, replicas), dtype)
        return cls(zeros, zeros, along, along, along)

    def after_impacts(
        self,
        thermal_time: Float[Array, "replicas"],
        gain: Float[Array, "p replicas"],
        collision_rate: Float[Array, "replicas"],
        cooling: Float[Array, "replicas"],
        dimension: int,
    ) -> "PathTangents":
        """Return the tangents after a time with given rates.

        Args:
            thermal_time: increase of s.
            gain: increase of c.
            collision_rate: omega.
            cooling: zeta.
            dimension: d.
        """
        d = dimension
        square = 1 - d * cooling / jnp.maximum(collision_rate, jnp.finfo(collision_rate.dtype).tiny)
        eps = jnp.sqrt(jnp.clip(square, MIN_RESTITUTION**2, 1.0))
        relaxed = collision_rate * (1 + eps) ** 2 / (2 * d) * thermal_time
        return self.after(thermal_time, relaxed, ((1 + eps) / (2 * eps))[None] * gain, d)

    def after(
        self,
        thermal_time: Float[Array, "*replicas"],
        relaxed: Float[Array, "*replicas"],
        relaxation_gain: Float[Array, "p *replicas"],
        dimension: int,
    ) -> "PathTangents":
        """Return the tangents after a time, by the implicit midpoint rule.

        Args:
            thermal_time: increase of s.
            relaxed: the integral of kappa over it.
            relaxation_gain: tangents of this integral.
            dimension: d.
        """
        d, half, old = dimension, 0.5 * relaxed, self.mobility
        new = ((1 - half) * old + thermal_time) / (1 + half)
        decay, mean = ((1 - half) / (1 + half))[None], (0.5 * (old + new) / (1 + half))[None]
        along = decay * self.mobility_along - mean * relaxation_gain
        return PathTangents(
            mobility=new,
            displacement=self.displacement + d * thermal_time * (old + new),
            mobility_along=along,
            displacement_along=self.displacement_along
            + d * thermal_time[None] * (self.mobility_along + along),
            correlation_along=self.correlation_along - relaxation_gain,
        )

    @property
    def log_displacement(self) -> Float[Array, "p replicas"]:
        """Tangents of ``ln R``; 0 at t = 0."""
        return ratio_or_zero(self.displacement_along, self.displacement[None])


def component_along(
    rest: Float[Array, "p n k"], vectors: Float[Array, "n k"], replicas: int
) -> Float[Array, "p replicas"]:
    """Return the component of each replica's rest along its vectors, relative to the vectors.

    It is 0 where all vectors are 0.
    """
    flat = vectors.reshape(replicas, -1)
    product = jnp.sum(rest.reshape(len(rest), *flat.shape) * flat[None], -1)
    return ratio_or_zero(product, jnp.sum(flat * flat, -1)[None])


class ContactTangents(NamedTuple):
    """Tangents of the state of a gas of lasting contacts along p directions in its material.

    The tangent of a state has three parts:

    - ``c = d ln T/dp``, which stands for velocities ``(c/2) v``, spins ``(c/2) s`` and for the
      corresponding changes of the material;
    - the tangent of the clock, the integral of ``-(c/2) dt``, at a fixed place in the sequence of
      collisions;
    - the exact rest of the tangents of positions, velocities and spins.

    At regular intervals the rest is projected (thermal projection): its component along v is added
    to c, and the part orthogonal to v is dropped. A gas with friction remembers T and T_rot, so
    that the rest of the spins is replaced by its component along s, the change of ``T_rot/T``.
    Spheres in contact are projected after they part.

    Attributes:
        directions: in the material, a pytree like it, stacked along a first axis.
        log_temperature: c = d ln T.
        clock: tangent of the time at a fixed place in the sequence of collisions.
        position: tangent of the positions.
        velocity: tangent of the velocities, without the part (c/2) v.
        free: True for spheres that touch no other one.
        elapsed: time since the last projection.
        thermal_elapsed: the integral of T^(1/2) over this time.
        rates: of the gas.
        paths: tangents of the paths of the particles, up to the last projection.
        spin: tangents of the spins, without the part (c/2) s; None for smooth spheres.
        rotational_gain: energy that rotation gained in contacts per mean free time, over that of
            translation, as a function of the ratio of both energies; None for smooth spheres.
    """

    directions: Any
    log_temperature: Float[Array, "p replicas"]
    clock: Float[Array, "p replicas"]
    position: Float[Array, "p n d"]
    velocity: Float[Array, "p n d"]
    free: Bool[Array, "n"]
    elapsed: Float[Array, ""]
    thermal_elapsed: Float[Array, "replicas"]
    rates: RateSums
    paths: PathTangents
    spin: Float[Array, "p n spins"] | None = None
    rotational_gain: LinearRatio | None = None

    @classmethod
    def initial(
        cls,
        directions: Any,
        velocity: Float[Array, "n d"],
        replicas: int,
        spin: Float[Array, "p n spins"] | None = None,
    ) -> "ContactTangents":
        """Return the tangents of an initial state that depends on the material by its spins only.

        Args:
            directions: p directions in the material.
            velocity: of the state, for its shape and dtype.
            replicas: number of boxes.
            spin: tangents of the spins; None for smooth spheres.
        """
        dtype, by_replica = velocity.dtype, jnp.zeros(replicas, velocity.dtype)
        paths = PathTangents.initial(directions, replicas, dtype)
        zeros = paths.correlation_along
        particle_zeros = jnp.zeros((len(zeros), *velocity.shape), dtype)
        return cls(
            directions=directions,
            log_temperature=zeros,
            clock=zeros,
            position=particle_zeros,
            velocity=particle_zeros,
            free=jnp.ones(len(velocity), bool),
            elapsed=jnp.zeros((), dtype),
            thermal_elapsed=by_replica,
            rates=RateSums.zero(replicas, dtype),
            paths=paths,
            spin=spin,
            rotational_gain=None if spin is None else LinearRatio(*[by_replica] * 5),
        )

    def projected(
        self,
        velocity: Float[Array, "n d"],
        cooling: Float[Array, "replicas"],
        spin: Float[Array, "n spins"] | None = None,
    ) -> "ContactTangents":
        """Return the tangents after a thermal projection of the spheres that touch no other one.

        Args:
            velocity: of the particles, in the frame in which each replica is at rest.
            cooling: ``-d ln T/dt``.
            spin: of the particles; None for smooth spheres.
        """
        c, free = self.log_temperature, self.free[:, None]
        replicas, d = c.shape[1], velocity.shape[1]
        gain = 2 * component_along(self.velocity, jnp.where(free, velocity, 0.0), replicas)
        temperature = jnp.mean(velocity.reshape(replicas, -1) ** 2, -1)
        per_time = self.rates.collision(jnp.ones_like(temperature))
        zeta = ratio_or_zero(cooling, jnp.sqrt(temperature))
        size = len(velocity) // replicas

        def of_particles(values: Float[Array, "p replicas"]) -> Float[Array, "p n 1"]:
            return jnp.repeat(values, size, axis=1)[:, :, None]

        spin_tangent = self.spin
        if spin_tangent is not None and spin is not None:
            rest = spin_tangent - 0.5 * of_particles(gain) * spin[None]
            share = component_along(rest, jnp.where(free, spin, 0.0), replicas)
            spin_tangent = jnp.where(free[None], of_particles(share) * spin[None], rest)
        rest = self.velocity - 0.5 * of_particles(gain) * velocity[None]
        return self._replace(
            log_temperature=c + gain,
            clock=self.clock - 0.5 * (c + 0.5 * gain) * self.elapsed,
            position=jnp.where(free[None], 0.0, self.position),
            velocity=jnp.where(free[None], 0.0, rest),
            elapsed=jnp.zeros_like(self.elapsed),
            thermal_elapsed=jnp.zeros_like(self.thermal_elapsed),
            paths=self.paths.after_impacts(self.thermal_elapsed, gain, per_time, zeta, d),
            spin=spin_tangent,
        )


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
    rates: RateSums
    paths: PathTangents

    @classmethod
    def initial(cls, law: ReducedLaw, replicas: int, dtype: DTypeLike) -> "ImpactTangents":
        """Return the tangents of an initial state, which does not depend on the law."""
        paths = PathTangents.initial(law, replicas, dtype)
        zeros = paths.correlation_along
        return cls(law, zeros, zeros, RateSums.zero(replicas, dtype), paths)

    def gains(
        self, law: ReducedLaw, normal_speed: Float[Array, "rows"]
    ) -> Float[Array, "changes rows"]:
        """Return ``eps g^2 d eps / 2`` of impacts: a row per direction, then one for ln g."""

        def along(direction):
            return jax.jvp(lambda law: law.restitution(normal_speed), (law,), (direction,))[1]

        eps, slope = jax.jvp(law.restitution, (normal_speed,), (normal_speed,))
        slopes = slope[None]
        if len(self.log_temperature):
            slopes = jnp.concatenate([jax.vmap(along)(self.law), slopes])
        return 0.5 * (eps * normal_speed**2)[None] * slopes

    def after(
        self,
        gains: Float[Array, "changes replicas"],
        energy: Float[Array, "replicas"],
        temperature: Float[Array, "replicas"],
        duration: ArrayLike,
        rates: RateSums,
        trend: Float[Array, "replicas"],
        dimension: int,
    ) -> "ImpactTangents":
        """Return the tangents after some impacts, by the implicit midpoint rule.

        Args:
            gains: the sums of `gains` over the impacts.
            energy: mean thermal energy of each replica during them.
            temperature: T of each replica after them.
            duration: of the time in which they happened.
            rates: of the gas after them.
            trend: the dependence of its cooling rate on T, at this time.
            dimension: d.
        """
        c = self.log_temperature
        half = gains[-1:] / (4 * energy[None])
        new = ((1 + half) * c + gains[:-1] / energy[None]) / (1 - half)
        speed = jnp.sqrt(temperature)
        per_time = rates.collision(jnp.ones_like(speed))
        zeta = rates.cooling(trend) / jnp.where(speed > 0, speed, 1.0)
        paths = self.paths.after_impacts(speed * duration, new - c, per_time, zeta, dimension)
        clock = self.clock - 0.25 * (c + new) * duration
        return self._replace(log_temperature=new, clock=clock, rates=rates, paths=paths)


class ExchangeTangents(NamedTuple):
    """Tangents of energies along p directions, the last of which is that of time.

    A gas that exchanges energy with rotation, walls, drag and a drive is assumed to remember two
    numbers, the energies of translation and of rotation; the shapes of the distributions of
    velocities and spins do not change. The tangents ``dE`` of the energies in a parameter p, at a
    fixed time, grow by the energy F that each step adds:

        d(dE) = dF/dp + dF/dc c + dF/dc_r c_r + F c/2.

    Here c and c_r are the tangents ``dE/E`` of the two energies, which stand for velocities (c/2) v
    and spins (c_r/2) s in all impacts of the step; the last term arises because faster spheres have
    more impacts. All four terms are sums over the impacts that happen, so no law of the gas is
    assumed. The number of collisions has the tangent ``d(dN) = dN c/2``.

    One extra direction makes all events more frequent. It gives the derivative in time: events that
    are all sooner by some share are sooner by this share of their time.

    Attributes:
        directions: in the material, stacked along a first axis of each leaf.
        energies: tangents of those of translation and rotation.
        collisions: tangents of their number.
    """

    directions: Any
    energies: Float[Array, "p 2 *replicas"]
    collisions: Float[Array, "p *replicas"]

    @classmethod
    def initial(
        cls, directions: Any, material: Any, velocity: Float[Array, "n d"], replicas: int
    ) -> "ExchangeTangents":
        """Return the tangents at t = 0, where T is 1 and T_rot is that of the material."""
        directions = jax.tree.map(
            lambda x: jnp.concatenate([x, jnp.zeros_like(x, shape=(1, *x.shape[1:]))]), directions
        )
        if material.drag is not None:  # drag acts sooner, too
            rates = jax.tree.map(lambda x, rate: x.at[-1].set(rate), directions.drag, material.drag)
            directions = directions._replace(drag=rates)
        (n, d), p = velocity.shape, len(jax.tree.leaves(directions)[0])
        energies = jnp.zeros((p, 2, replicas), velocity.dtype)
        if material.surface is not None:
            rotational_energy = n // replicas * NUM_SPIN_COMPONENTS[d] / 2
            energies = energies.at[:, 1].add(rotational_energy * directions.surface.ratio[:, None])
        return cls(directions, energies, jnp.zeros((p, replicas), velocity.dtype))

    def after(
        self,
        before: Float[Array, "2 *replicas"],
        gained: Float[Array, "2 *replicas"],
        along: Float[Array, "changes 2 *replicas"],
        collisions: Float[Array, "*replicas"],
    ) -> "ExchangeTangents":
        """Return the tangents after a step, by the midpoint rule.

        Args:
            before: both energies before it.
            gained: F, the energy that each gained.
            along: tangents of F, for each direction, for the logarithm of all velocities, and for
                that of all spins.
            collisions: number of those that happened.
        """
        sooner = jnp.zeros(len(self.energies), gained.dtype).at[-1].set(1.0)
        sooner = sooner.reshape(-1, *[1] * gained.ndim)
        by_velocity, by_spin = along[-2] + gained, along[-1]

        def growth(c: Array) -> Array:
            by_scale = by_velocity[None] * c[:, :1] / 2 + by_spin[None] * c[:, 1:] / 2
            return along[:-2] + by_scale + sooner * gained[None]

        middle = before + gained / 2
        first = ratio_or_zero(self.energies, before[None])
        half = ratio_or_zero(self.energies + growth(first) / 2, middle[None])
        new_collisions = sooner[:, 0] * collisions[None] + half[:, 0] / 2 * collisions[None]
        return self._replace(
            energies=self.energies + growth(half), collisions=self.collisions + new_collisions
        )
