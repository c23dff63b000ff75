"""Drop tests: normal and tangential restitution of single impacts at known speeds."""

from collections.abc import Iterable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxgran._utils.validation import (
    NON_NEGATIVE,
    POSITIVE,
    Domain,
    UserNumber,
    check_bool,
    float_array,
)
from jaxgran.scene.elements import Rough
from jaxgran.scene.gas import Gas

MAX_SIGMAS = 5.0
"""Largest distance of a measured restitution outside its range, in standard errors, that is taken
for chance."""

SPHERE = "sphere"
PLATE = "plate"
WALL = "wall"
PARTNERS = (SPHERE, PLATE, WALL)
"""What a sphere meets: an equal one, a thick plate of its material, or a wall of the container."""

OBLIQUE = ("tangential_speed", "tangential_restitution", "tangential_error")
"""Fields of oblique impacts, which are given together."""

COSINE = Domain(-1, 1, True, True)

DOMAINS_OF_SPEED_ERRORS = {
    "speed_error": NON_NEGATIVE,
    "correlation": COSINE,
    "tangential_speed_error": NON_NEGATIVE,
    "tangential_correlation": COSINE,
}
"""Allowed values of the fields that say how well the speeds are known."""


def _floats_or_none(value: UserNumber | None) -> Array | None:
    return None if value is None else float_array(value)


class DropTest(eqx.Module):
    """Restitution of single impacts, normal or oblique, at some speeds.

    The normal restitution eps depends on ``A Y^(2/5)``, as the cooling of a gas of hard spheres
    does, and on no other quantity of a cooling curve. The tangential one, ``eps_t = u_t'/u_t`` of
    the velocity of the surfaces at contact, is ``-beta_t`` where the spheres stick, and follows
    Coulomb's law where they slide (`jaxgran.Rough`), with one sphere or a plate as the partner:

        eps_t = 1 - min(1 + beta_t, (1 + 1/q) mu (1 + eps) v_n/v_t).

    The velocity of the centre of a sphere that does not rotate before the impact is multiplied by
    ``1 - q/(1 + q) (1 - eps_t)``.

    Args:
        speed: normal relative speed v_n before each impact, m/s, shape (n,), > 0.
        restitution: eps, shape (n,); below 0 or above 1 only within its error.
        error: standard error of each eps, shape (n,), > 0.
        onto: the partner: "sphere", an equal one; "plate", a thick plate of the same material,
            which makes ``alpha`` smaller by sqrt(2); or "wall", a wall of the gas's container.
        tangential_speed: v_t of the surfaces at contact before each oblique impact, m/s, shape
            (n,), > 0; None for normal impacts.
        tangential_restitution: eps_t, shape (n,), in [-1, 1] within its error.
        tangential_error: standard error of each eps_t, shape (n,), > 0.
        of_centres: whether tangential_restitution is the ratio of velocities of the centre, of
            spheres that do not rotate before the impact.
        speed_error: standard error of each speed, m/s, shape (n,), >= 0, where eps is the ratio of
            two measured speeds; `error` is then the error of the speed after the impact, over the
            speed before it. None if the speeds are known.
        correlation: of the errors of the speed before and of the speed after an impact, shape
            (n,), in [-1, 1]; None for 0.
        tangential_speed_error: standard error of each tangential speed, m/s, shape (n,), >= 0,
            where eps_t is the ratio of two measured velocities; `tangential_error` is then the
            error of the velocity after, over the speed before. None if these speeds are known.
        tangential_correlation: of the errors of the normal and of the tangential speed, both
            before an impact, shape (n,), in [-1, 1], as the error of an angle makes it; None for 0.
        scatters: whether eps scatters from impact to impact by more than its error, as rough
            surfaces make it; a fit then estimates the standard deviation of this scatter.

    Traced values are not checked; lengths of lists always are.

    Raises:
        ValueError: for a value out of its range, or lists of different lengths.

    Reference: Foerster, Louge, Chang & Allia, Phys. Fluids 6, 1108 (1994).

    >>> drops = jaxgran.DropTest(speed=[0.1, 0.3], restitution=[0.92, 0.90], error=[0.01, 0.01])
    >>> drops.speed.shape
    (2,)
    """

    speed: UserNumber = eqx.field(converter=float_array)
    restitution: UserNumber = eqx.field(converter=float_array)
    error: UserNumber = eqx.field(converter=float_array)
    onto: str = eqx.field(static=True, default=SPHERE)
    tangential_speed: UserNumber | None = eqx.field(converter=_floats_or_none, default=None)
    tangential_restitution: UserNumber | None = eqx.field(converter=_floats_or_none, default=None)
    tangential_error: UserNumber | None = eqx.field(converter=_floats_or_none, default=None)
    of_centres: bool = eqx.field(static=True, default=False)
    speed_error: UserNumber | None = eqx.field(converter=_floats_or_none, default=None)
    correlation: UserNumber | None = eqx.field(converter=_floats_or_none, default=None)
    scatters: bool = eqx.field(static=True, default=False)
    tangential_speed_error: UserNumber | None = eqx.field(converter=_floats_or_none, default=None)
    tangential_correlation: UserNumber | None = eqx.field(converter=_floats_or_none, default=None)

    advice: ClassVar[dict[str, str]] = {
        "speed": "Give normal speeds in m/s.",
        "restitution": "Give the speed after over that before an impact.",
        "error": "Give the standard error of each eps.",
        "tangential_speed": "Give the speed of the surfaces at contact in m/s; normal impacts are "
        "a drop test of their own.",
        "tangential_restitution": "Give eps_t = -beta_t, the tangential velocity after over that "
        "before an impact.",
        "tangential_error": "Give the standard error of each eps_t.",
        "speed_error": "Give the standard error of each speed in m/s.",
        "tangential_speed_error": "Give the standard error of each tangential speed in m/s.",
        "correlation": "Give none for 0.",
        "tangential_correlation": "Give none for 0.",
    }

    def __check_init__(self):
        check_bool(of_centres=self.of_centres, scatters=self.scatters)
        if self.onto not in PARTNERS:
            raise ValueError(f"onto must be one of {', '.join(PARTNERS)}, got {self.onto!r}")
        self._check_oblique()
        of_errors = self._given(DOMAINS_OF_SPEED_ERRORS)
        names = ["speed", "restitution", "error", *self._given(OBLIQUE), *of_errors]
        for name in names:
            if name not in ("restitution", "tangential_restitution"):
                domain = DOMAINS_OF_SPEED_ERRORS.get(name, POSITIVE)
                domain.check(name, getattr(self, name), self.advice[name])
        self._check_shapes(names)
        self._check_restitution("restitution", self._error_with(self.restitution), 0.0)
        if self.is_oblique:
            error = self._tangential_error_with(0.0, self.tangential_restitution)
            self._check_restitution("tangential_restitution", error, -1.0)

    def _given(self, names: Iterable[str]) -> list[str]:
        return [name for name in names if getattr(self, name) is not None]

    def _check_oblique(self) -> None:
        """Check that all fields of oblique impacts are given, or none."""
        given = self._given(OBLIQUE)
        if given and len(given) < len(OBLIQUE):
            raise ValueError(f"{', '.join(OBLIQUE)} are given together, got {', '.join(given)}")
        for name in self._given(DOMAINS_OF_SPEED_ERRORS):
            if name.startswith("tangential") and not given:
                raise ValueError(f"{name} needs oblique impacts: give {', '.join(OBLIQUE)}, too")

    def _check_shapes(self, names: list[str]) -> None:
        shapes = [np.shape(getattr(self, name)) for name in names]
        if len(shapes[0]) != 1 or len(set(shapes)) > 1 or shapes[0] == (0,):
            raise ValueError(
                f"{', '.join(names[:-1])} and {names[-1]} must be lists of equal length, with at "
                f"least one impact; got shapes {', '.join(map(str, shapes))}"
            )

    def _check_restitution(self, name: str, error: Array, low: float) -> None:
        """Check that a restitution lies in [low, 1] within its error, unless one is traced."""
        if isinstance(error, Tracer) or isinstance(getattr(self, name), Tracer):
            return
        value = np.asarray(getattr(self, name))
        error_bar = np.asarray(error)
        margin = MAX_SIGMAS * error_bar
        outside = ~((value <= 1 + margin) & (value >= low - margin))
        if np.any(outside):
            i = int(np.argmax(outside))
            limit = "most 1" if value[i] > low else f"least {low:g}"
            raise ValueError(
                f"{name} must be at {limit} within its error, got {value[i]:g} +- "
                f"{error_bar[i]:g}. {self.advice[name]}"
            )

    @property
    def is_oblique(self) -> bool:
        """Whether the tangential restitution was measured, too."""
        return self.tangential_speed is not None

    @property
    def num_values(self) -> int:
        """Number of measured values of restitution."""
        return int(np.size(self.restitution)) * (1 + self.is_oblique)

    def errors_of_ratio(self) -> Float[np.ndarray, "n"]:
        """Return the standard error of each eps, the error of the speed before included."""
        return np.asarray(self._error_with(self.restitution))

    def _error_with(self, slope: Any) -> Float[Array, "n"]:
        """Return the error of the speed after minus `slope` times that before, over the latter."""
        error = jnp.asarray(self.error)
        if self.speed_error is None:
            return error
        relative = jnp.asarray(slope) * jnp.asarray(self.speed_error) / jnp.asarray(self.speed)
        before_after = 0.0 if self.correlation is None else jnp.asarray(self.correlation)
        return jnp.sqrt(error**2 + relative**2 - 2 * before_after * error * relative)

    def _tangential_error_with(self, by_normal: Any, by_tangential: Any) -> Float[Array, "n"]:
        """Return the error of eps_t, by derivatives of the tangential velocity after an impact.

        Args:
            by_normal, by_tangential: its derivatives in the speeds before.
        """
        errors = self.speed_error, self.tangential_speed_error
        normal, tangential = (0.0 if x is None else jnp.asarray(x) for x in errors)
        correlation = self.tangential_correlation
        normal_tangential = 0.0 if correlation is None else jnp.asarray(correlation)
        before = jnp.asarray(self.tangential_speed)
        a = by_normal * normal / before
        b = by_tangential * tangential / before
        own = jnp.asarray(self.tangential_error)
        return jnp.sqrt(own**2 + a**2 + b**2 + 2 * normal_tangential * a * b)

    def check_gas(self, gas: Gas) -> None:
        """Raise ValueError for a gas that lacks the elements on which these impacts depend."""
        walls = gas.container
        if self.onto == WALL and walls is None:
            raise ValueError(
                "impacts onto a wall need the walls of the gas: add container_side and "
                "wall_restitution to the header (container=jaxgran.Walls(...)). For a thick plate "
                "of the material of the spheres write onto: plate"
            )
        if not self.is_oblique:
            return
        if not isinstance(gas.surface, Rough):
            raise ValueError(
                "the tangential restitution eps_t needs rough spheres in instantaneous impacts: "
                "add `beta_t: guess` and, if they slide, `friction: guess` to the header "
                "(surface=jaxgran.Rough(...)), and free both"
            )
        if self.onto == WALL and walls is not None and walls.tangential_restitution is None:
            raise ValueError(
                "the tangential restitution of impacts onto a wall needs rough walls: add "
                "`wall_beta_t: guess` to the header"
            )

    def computed(self, gas: Gas) -> Float[Array, "n"]:
        """Return eps of each impact, for spheres of a gas."""
        return self._eps(gas, jnp.asarray(self.speed))

    def _eps(self, gas: Gas, speed: Array) -> Float[Array, "n"]:
        law = gas.law
        if self.onto == WALL:
            assert gas.container is not None  # see check_gas
            law = gas.container.restitution
        reduced = law.reduced if self.onto == SPHERE else law.on_wall
        known = reduced(diameter=gas.diameter, mass=gas.mass, speed=jnp.ones(()))
        return known.restitution(speed)

    def computed_tangential(self, gas: Gas) -> Float[Array, "n"]:
        """Return eps_t of each oblique impact, for rough spheres of a gas."""
        return self._eps_t(gas, jnp.asarray(self.speed), jnp.asarray(self.tangential_speed))

    def _eps_t(self, gas: Gas, speed: Array, tangential_speed: Array) -> Float[Array, "n"]:
        surface = gas.surface
        assert isinstance(surface, Rough)
        beta = surface.tangential_restitution
        if self.onto == WALL:
            assert gas.container is not None and gas.container.tangential_restitution is not None
            beta = gas.container.tangential_restitution
        q = surface.inertia
        steepness = speed / tangential_speed
        change = jnp.broadcast_to(1 + beta, steepness.shape)
        if surface.friction is not None:
            sliding = (1 + 1 / q) * surface.friction * (1 + self._eps(gas, speed)) * steepness
            change = jnp.minimum(change, sliding)
        return 1 - change * (q / (1 + q) if self.of_centres else 1.0)

    def errors(self, gas: Gas) -> Float[Array, "values"]:
        """Return the standard errors of measured minus computed restitution, as `residuals`.

        The errors of the speeds before an impact change the measured ratios and the computed ones.
        """
        v = jnp.asarray(self.speed)
        one = jnp.ones_like(v)
        _, slope = jax.jvp(lambda v: v * self._eps(gas, v), (v,), (one,))
        normal = self._error_with(slope)
        if not self.is_oblique:
            return normal
        speeds = v, jnp.asarray(self.tangential_speed)

        def after(v: Array, v_t: Array) -> Array:
            return v_t * self._eps_t(gas, v, v_t)

        _, by_normal = jax.jvp(after, speeds, (one, jnp.zeros_like(v)))
        _, by_tangential = jax.jvp(after, speeds, (jnp.zeros_like(v), one))
        return jnp.concatenate([normal, self._tangential_error_with(by_normal, by_tangential)])

    def residuals(self, gas: Gas) -> Float[Array, "values"]:
        """Return measured minus computed restitution over the error, for spheres of a gas.

        The values of eps come first, then eps_t. Where speeds have errors the sum of squares is
        that with the most likely speeds, so that the errors are differentiated, too.
        """
        differences = jnp.asarray(self.restitution) - self.computed(gas)
        if self.is_oblique:
            tangential = jnp.asarray(self.tangential_restitution) - self.computed_tangential(gas)
            differences = jnp.concatenate([differences, tangential])
        return differences / self.errors(gas)
