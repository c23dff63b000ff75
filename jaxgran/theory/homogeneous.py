"""The equations of a homogeneous gas to a given order, ready to be integrated.

Units as in `jaxgran.theory.averages`.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from jaxtyping import Array, Float

from jaxgran.scene.reduced_scene import ReducedScene
from jaxgran.theory import elements, moments, rate_table, steady
from jaxgran.theory.moments import Density, Moments

Scene = tuple[ReducedScene, Density]
"""A scene in reduced units, and the effects of its density."""


class Equations(NamedTuple):
    """What is followed of a gas, and how closely.

    Attributes:
        dimension: d.
        order: of the Sonine expansion: 2 follows a_2, 3 also a_3.
        maxwellian: whether a_2 stays 0.
        softness: whether soft contacts slow the cooling.
        averages: over impacts, a function of law, speed, dimension and order.
    """

    dimension: int
    order: int
    maxwellian: bool
    softness: bool
    averages: Callable[..., Array]

    def start(self, scene: Scene, like: Array) -> Float[Array, "moments"]:
        """The `Moments` at t = 0, as one array of the precision of another."""
        first = Moments.at_start(scene[0], like, self.order)
        if scene[0].prepared is None or self.maxwellian:
            return first
        return steady.prepared(first, *scene, self.dimension, self.order)

    def table(self, scene: Scene, duration: Array) -> rate_table.RateTable:
        """The averages at all temperatures that the gas reaches in a time."""
        law, d = scene[0].law, self.dimension
        averages = partial(self.averages, law, dimension=d, order=self.order)
        bounds = elements.fastest_cooling(scene[0], d)
        return rate_table.RateTable.of(averages, duration, d, law.num_nodes, bounds)

    def velocity(
        self, state: Float[Array, "moments"], rates: Float[Array, "rows terms"], scene: Scene
    ) -> Float[Array, "moments"]:
        """Time derivative of the moments at given averages over impacts."""
        return moments.velocity(
            state,
            rates,
            *scene,
            self.dimension,
            order=self.order,
            softness=self.softness,
            maxwellian=self.maxwellian,
        )
