"""Drop tests: coefficients of restitution of single impacts at known normal speeds."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran._utils.validation import POSITIVE, UserNumber, check_bool, float_array
from jaxgran.scene.gas import Gas

DROP_TEST_COLUMNS = ("v", "eps", "eps_err")
"""Columns of a file of a drop test."""

MAX_SIGMAS = 5.0
"""Largest distance of a measured eps above 1, in standard errors, that is taken for chance."""


class DropTest(eqx.Module):
    """Coefficients of restitution of single impacts at some normal speeds.

    They depend on ``A Y^(2/5)``, as the cooling of a gas of hard spheres does, and on no other
    quantity of a cooling curve.

    Args:
        speed: normal relative speed before each impact, m/s, shape (n,), > 0.
        restitution: eps, shape (n,), > 0; above 1 only within its error.
        error: standard error of each eps, shape (n,), > 0.
        onto_plate: whether a sphere falls onto a thick plate of the same material, which makes
            ``alpha`` smaller by sqrt(2); if False, two equal spheres collide.

    Raises:
        ValueError: for a value out of its range, or lists of different lengths.

    >>> drops = jaxgran.DropTest(speed=[0.1, 0.3], restitution=[0.92, 0.90], error=[0.01, 0.01])
    >>> drops.speed.shape
    (2,)
    """

    speed: UserNumber = eqx.field(converter=float_array)
    restitution: UserNumber = eqx.field(converter=float_array)
    error: UserNumber = eqx.field(converter=float_array)
    onto_plate: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        check_bool(onto_plate=self.onto_plate)
        POSITIVE.check("speed", self.speed, "Give normal speeds in m/s.")
        advice = "Give the speed after over that before an impact."
        POSITIVE.check("restitution", self.restitution, advice)
        POSITIVE.check("error", self.error, "Give the standard error of each eps.")
        shapes = [np.shape(x) for x in (self.speed, self.restitution, self.error)]
        if len(shapes[0]) != 1 or len(set(shapes)) > 1 or shapes[0] == (0,):
            raise ValueError(
                "speed, restitution and error must be lists of equal length, with at least one "
                f"impact; got shapes {', '.join(map(str, shapes))}"
            )
        eps = np.asarray(self.restitution)
        error = np.asarray(self.error)
        above = eps > 1 + MAX_SIGMAS * error
        if np.any(above):
            i = int(np.argmax(above))
            raise ValueError(
                f"restitution must be at most 1 within its error, got {eps[i]:g} +- {error[i]:g}. "
                f"{advice}"
            )

    def computed(self, gas: Gas) -> Float[Array, "n"]:
        """Return eps of each impact, for spheres of a gas."""
        reduced = gas.law.on_wall if self.onto_plate else gas.law.reduced
        law = reduced(diameter=gas.diameter, mass=gas.mass, speed=jnp.ones(()))
        return law.restitution(jnp.asarray(self.speed))

    def residuals(self, gas: Gas) -> Float[Array, "n"]:
        """Return (measured - computed eps) over the error, for spheres of a gas."""
        return (jnp.asarray(self.restitution) - self.computed(gas)) / jnp.asarray(self.error)
