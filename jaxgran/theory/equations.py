"""The differential equations of a homogeneous gas: T, a_2, a_3, D, <dr^2>, collisions and T_rot.

Their terms come from `jaxgran.theory.averages` (impacts), `jaxgran.theory.elements` (roughness,
walls, drag, a drive), `jaxgran.theory.sizes` (unequal sizes) and `jaxgran.theory.density` (finite
density).

Units are the same as in `jaxgran.theory.averages`. "The paper" is Brilliantov & Poeschel,
Self-diffusion in granular gases, Phys. Rev. E 61, 1716 (2000), whose equations are numbered here as
in the authors' preprint.
"""

from functools import partial
from math import gamma, pi, sqrt
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran.scene.geometry import sphere_surface
from jaxgran.scene.laws import C1
from jaxgran.scene.reduced import ReducedScene
from jaxgran.theory.averages import (
    TERMS,
    collision_rate,
    impact_moments,
)
from jaxgran.theory.density import Density
from jaxgran.theory.elements import element_bounds, element_rates
from jaxgran.theory.moments import Moments, Spins
from jaxgran.theory.rate_table import RateTable, log_temperature_range
from jaxgran.theory.sizes import (
    drag_factors,
    equal_rates,
    pair_rates,
    partial_temperatures,
    variable_changes,
)

COOLING_RATE = {d: 9 / 5 / d * 2**0.2 * C1 * gamma(2.1) for d in (2, 3)}
"""Initial cooling rate ``tau_c(0) / (tau_0 delta)`` by dimension: 0.83193 in 3D; Eq. (39)."""

COOLING_CORRECTION = 33 / 20 * 2**0.2 * C1 * gamma(2.2) / gamma(2.1)
"""q, the ratio b_2/b_1 of the two terms of the cooling rate at T_0 and delta = 1: 2.3018."""


SceneAndDensity = tuple[ReducedScene, Density]
"""Scene in reduced units, and the effects of its density."""


class Equations(NamedTuple):
    """Choice of the equations of a gas.

    Attributes:
        dimension: d.
        order: of the Sonine expansion: 2 has a_2, 3 also a_3.
        maxwellian: if True, a_2 stays 0.
        initial_sonine: a_2 at t = 0.
        gaussian_spins: if True, a_11 and a_02 stay 0.
        spreading: whether D and <dr^2> are asked for.
        sizes: whether the spheres differ in size.
    """

    dimension: int
    order: int
    maxwellian: bool
    initial_sonine: float = 0.0
    gaussian_spins: bool = False
    spreading: bool = True
    sizes: bool = False

    @property
    def names(self) -> list[str]:
        """Names of the `Moments`, except the moments of spins."""
        names = list(Moments._fields[: 5 if self.spreading else 3])
        if self.order > 2:
            names += ["third_sonine"] + (["diffusion_shape"] if self.spreading else [])
        if self.sizes:
            names.append("size_ratio")
        return names

    @property
    def controlling(self) -> Any:
        """Index of the moments whose errors control the steps; all others follow them."""
        if self.sizes:
            return np.array([0, 1, 2, self.names.index("size_ratio")])
        return slice(5 if self.spreading else 3)

    def moments(self, values: Float[Array, "moments ..."]) -> Moments:
        """Return the moments held by the rows of an array."""
        names = [*self.names, *Moments._fields[7:10]]
        return Moments(**dict(zip(names, values, strict=False)))

    def initial(self, scene: SceneAndDensity, like: Array) -> Float[Array, "moments"]:
        """Return the `Moments` at t = 0 as one array, of the dtype of `like`."""
        start = [jnp.zeros((), like.dtype)] * len(self.names)
        start[1] += self.initial_sonine
        if scene[0].surface is not None:
            spins = Spins.gaussian(scene[0].surface.ratio.astype(like.dtype))
            start += spins[: 1 if self.gaussian_spins else 3]
        return jnp.stack(start)

    def table(self, scene: SceneAndDensity, duration: Array) -> RateTable:
        """Return the averages at all temperatures that the gas reaches in a time."""
        law, d = scene[0].law, self.dimension
        averages = partial(
            impact_moments, law, dimension=d, order=self.order, relaxation=self.spreading
        )
        bounds = element_bounds(scene[0], d)
        lowest, highest = log_temperature_range(law, duration, d, bounds)
        return RateTable.from_function(averages, lowest, highest, law.num_nodes)

    def derivative(
        self,
        state: Float[Array, "moments"],
        rates: Float[Array, "rows terms"],
        scene: SceneAndDensity,
    ) -> Float[Array, "moments"]:
        """Return the time derivative of the moments.

        Args:
            state: the `Moments` as one array.
            rates: from `jaxgran.theory.averages.impact_moments` at this temperature.
            scene: the gas.
        """
        moments = self.moments(state)
        d = self.dimension
        order = self.order
        gas, density = scene
        a2, speed = moments.sonine, jnp.exp(moments.log_temperature / 2)
        zero = jnp.zeros_like(speed)
        a3 = zero if moments.third_sonine is None else moments.third_sonine
        # The losses mu_2, mu_4, ..., and the matrix nu_jk row by row.
        values = rates @ jnp.stack([a2**i * a3**j for i, j in zip(*TERMS[order], strict=True)])
        losses = values[:order] * speed
        impacts = 2 / d * losses[0]
        a2_rate = 2 * impacts * (1 + a2) - 4 / (d * (d + 2)) * losses[1]
        a3_rate = shape_decay = zero
        if order > 2:
            sixth = 8 / (d * (d + 2) * (d + 4)) * losses[2]
            a3_rate = 3 * a2_rate - 3 * impacts * (1 + 3 * a2 - a3) + sixth
        inelasticity = rates[0, 0] * 2 * sqrt(2 * pi) / sphere_surface(d)  # <1 - eps^2>
        factor = density.factor(gas.law, speed, inelasticity, moments.collisions, d)
        cooling = impacts * factor
        relaxing = zero
        rotating = []
        if gas.has_elements:
            changes = element_rates(gas, speed, moments.spins, a2, d, self.gaussian_spins)
            cooling, relaxing = cooling + changes.cooling, changes.relaxation
            a2_rate = a2_rate + changes.sonine
            if gas.drive is not None:
                shape_decay = gas.drive / speed**2
                a3_rate = a3_rate - 3 * shape_decay * a3
            if (spins := moments.spins) is not None:  # over powers of T, which falls
                growth = zip(changes.spins, spins, (1, 1, 2), strict=True)
                rotating = [change + power * cooling * x for change, x, power in growth]
                rotating = rotating[: 1 if self.gaussian_spins else 3]
        colliding = collision_rate(a2, d, a3) * speed
        exchanging = []
        if gas.sizes is not None:
            assert moments.size_ratio is not None
            of_sizes = size_rates(gas, speed, moments.size_ratio, a2, d)
            cooling = cooling - factor * of_sizes.impacts - of_sizes.drag
            colliding = colliding * of_sizes.collisions
            exchanging = [of_sizes.ratio]
        # Of the terms that cool the gas, only impacts change the shape of the velocity
        # distribution.
        rate = [
            -cooling,
            zero if self.maxwellian else a2_rate,
            colliding,
        ]
        third = [] if order == 2 else [a3_rate]
        if self.spreading:
            assert moments.diffusion is not None
            relaxation = values[order:].reshape(order - 1, -1)
            diffusing = _diffusion_rates(moments, a3, relaxation, impacts, shape_decay, d)
            net_growth = cooling / 2 - relaxing
            diffusion, *shape = [change + net_growth * q for change, q in diffusing]
            rate += [diffusion, 2 * d * speed * moments.diffusion]
            third += shape
        return jnp.stack(rate + third + exchanging + rotating)


def _diffusion_rates(
    moments: Moments, a3: Array, relaxation: Array, impacts: Array, shape_decay: Array, d: int
) -> list[tuple[Array, Array]]:
    """Rates of change of the diffusion moments, without the growth that cooling adds to all, each
    with its moment.

    The mean displacement of labelled spheres at velocity c is ``f(c) c (b_0 + b_1 S_1(c^2))``. Its
    moments ``q_j = <S_j c.dr>/d = sum_k n_jk b_k/2`` with ``n_00 = 1``, ``n_01 = -(h + 1) a_2``,
    ``n_11 = (h + 1) (1 + (h + 4) a_2 - (h + 2) a_3)`` and h = d/2 obey
    ``dq_j/dt = n_j0/2 - sum_k nu_jk b_k/2 + zeta (j q_j - j (j + h) q_(j-1)) + zeta/2 q_j`` with
    the cooling rate zeta. The last term is the growth by cooling.
    """
    half, a2, speed = d / 2, moments.sonine, jnp.exp(moments.log_temperature / 2)
    assert moments.diffusion is not None
    if moments.diffusion_shape is None:
        return [(speed / 2 - relaxation[0, 0] * speed * moments.diffusion, moments.diffusion)]
    q0, q1 = moments.diffusion, moments.diffusion_shape
    mixed = -(half + 1) * a2
    square = (half + 1) * (1 + (half + 4) * a2 - (half + 2) * a3)
    b1 = (q1 - mixed * q0) / (square - mixed**2)
    b0 = q0 - mixed * b1  # half of b_0 and b_1 above
    first = speed * (0.5 - relaxation[0, 0] * b0 - relaxation[0, 1] * b1)
    second = speed * (mixed / 2 - relaxation[1, 0] * b0 - relaxation[1, 1] * b1)
    coupling = impacts * (q1 - (half + 1) * q0) - shape_decay * q1
    return [(first, q0), (second + coupling, q1)]


class SizeRates(NamedTuple):
    """What unequal sizes add to the rates of change of a gas of equal spheres.

    Attributes:
        impacts: d ln T/dt by impacts, minus its value for equal spheres.
        drag: the same by drag.
        ratio: dq/dt.
        collisions: collision rate over the rate of equal spheres.
    """

    impacts: Float[Array, ""]
    drag: Float[Array, ""]
    ratio: Float[Array, ""]
    collisions: Float[Array, ""]


def size_rates(
    scene: ReducedScene,
    speed: Float[Array, ""],
    ratio: Float[Array, ""],
    sonine: Float[Array, ""],
    d: int,
) -> SizeRates:
    """Return what unequal sizes add to the rates of change of a gas of equal spheres.

    Args:
        scene: in reduced units.
        speed: sqrt(T/T_0).
        ratio: q, see `jaxgran.theory.sizes`.
        sonine: a_2.
        d: dimension.
    """
    pairs = pair_rates(scene.sizes, speed, ratio, sonine, d)
    of_T, of_ratio = variable_changes(ratio, d) @ pairs.changes
    of_drag = jnp.zeros_like(of_T)
    if scene.drag is not None:
        drag = 2 * scene.drag.rate * drag_factors(scene.sizes)
        of_drag = 2 * scene.drag.rate - jnp.mean(drag * partial_temperatures(ratio))
        of_ratio = of_ratio - drag[0] + drag[1]
    return SizeRates(
        impacts=of_T - equal_rates(scene.law, speed, sonine, d),
        drag=of_drag,
        ratio=of_ratio,
        collisions=pairs.impacts / (collision_rate(0.0, d) / 2 * speed),
    )
