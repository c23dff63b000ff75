"""What a law of restitution is: the base classes of those in `restitution` and of a user's own."""

import dataclasses
import inspect
from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from jaxgran.checks.validation import ANY, Domain, number

UNITS = (
    "a reduced law is given speeds in units of `speed`: leave `reduced` out and let "
    "restitution(self, normal_speed) take m/s, or divide the law's speeds by `speed`"
)
_CHECKED: set[type] = set()


class RestitutionLaw(eqx.Module):
    """A law of restitution of a material, in SI units.

    A law of one's own is a subclass with `restitution(self, normal_speed)`, eps at normal approach
    speeds in m/s, and a field for each of its numbers, annotated ``float``, in any units that
    `restitution` understands. Fields become JAX arrays: they can be fitted, swept and
    differentiated by name. `domains` may give the allowed range of a field, as
    ``domains = {"yield_speed": jaxgran.Domain(0.0)}``; without it any finite number is allowed. No
    field may have the name of a float of `jaxgran.Gas`. Kinetic theory needs an eps that is smooth
    in the speed. Where eps depends on the diameter or the mass too, override `reduced` instead.

    >>> class Plastic(jaxgran.RestitutionLaw):
    ...     yield_speed: float  # m/s
    ...     def restitution(self, normal_speed):  # m/s
    ...         return (1 + (normal_speed / self.yield_speed) ** 2) ** -0.125
    >>> own = dataclasses.replace(gas, law=Plastic(0.2))
    >>> round(float(own.restitution(0.1)), 4)
    0.9725
    """

    domains: ClassVar[dict[str, Domain]] = {}
    """Allowed range of every float field, by name; used for validation and for fits."""

    lists: ClassVar[tuple[str, ...]] = ()
    """Names of those fields that hold more than one number."""

    advice: ClassVar[dict[str, str]] = {}
    """What to do about a value outside its range, by name: a sentence for the error message."""

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        numbers = _number_fields(cls)
        if "domains" not in vars(cls):
            cls.domains = {**cls.domains, **dict.fromkeys(numbers, ANY)}
        for name in numbers:
            default = vars(cls).get(name, dataclasses.MISSING)
            if not isinstance(default, dataclasses.Field):
                setattr(cls, name, eqx.field(converter=number, default=default))

    def __check_init__(self):
        kind, base = type(self), RestitutionLaw
        if kind.reduced is base.reduced and kind.restitution is base.restitution:
            raise ValueError(
                f"{kind.__name__} has no restitution: define restitution(self, normal_speed), "
                "which returns eps at normal approach speeds in m/s"
            )
        for name, domain in self.domains.items():
            if not hasattr(self, name):
                raise ValueError(
                    f"domains of {kind.__name__} has {name!r}, which is no field: give domains the "
                    "names of its float fields"
                )
            domain.check(name, getattr(self, name), self.advice.get(name, ""))

    def restitution(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Coefficient of restitution eps, where it depends on nothing but the speed.

        Args:
            normal_speed: normal approach speed, m/s, > 0, any shape.

        Returns:
            eps, same shape, or one number for all speeds.
        """
        raise NotImplementedError(
            f"eps of {type(self).__name__} depends on the spheres: see jaxgran.Gas.restitution"
        )

    def loss(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """``1 - eps``; override it where it can be computed without cancellation for eps near 1.

        Args: as `restitution`.
        """
        return 1 - self.restitution(normal_speed)

    def reduced(self, *, diameter: ArrayLike, mass: ArrayLike, speed: ArrayLike) -> "ReducedLaw":
        """The law for two equal spheres, in units of their diameter and of a reference speed.

        By default `restitution` at the speeds in m/s, the same for all spheres.

        Args:
            diameter: sigma, m, > 0.
            mass: m, kg, > 0, of either sphere.
            speed: reference speed, m/s, > 0.
        """
        return LawInUnits(self, jnp.asarray(speed))

    def on_wall(self, *, diameter: ArrayLike, mass: ArrayLike, speed: ArrayLike) -> "ReducedLaw":
        """The same for a sphere and a flat wall, where the law is that of the wall."""
        return self.reduced(diameter=diameter, mass=mass, speed=speed)


class ReducedLaw(eqx.Module):
    """A law of restitution for two given spheres, in units of a length and a reference speed.

    A subclass defines `restitution`.

    >>> reduced = gas.reduced_law
    >>> bool(jnp.isclose(reduced.restitution(jnp.ones(())), gas.restitution(gas.impact_speed)))
    True
    """

    num_nodes: ClassVar[int] = 40
    """Number of Chebyshev nodes in ln T that resolve averages over the impacts of this law.

    40 suffice for laws as steep as 1 - eps ~ v over 12 decades of time (relative error 1e-7 of the
    cooling rate); flatter laws need fewer."""

    @abstractmethod
    def restitution(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Coefficient of restitution eps at a normal approach speed.

        Args:
            normal_speed: in units of the reference speed, > 0, any shape.

        Returns:
            eps, same shape.
        """

    def loss(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """``1 - eps``; override it where it can be computed without cancellation for eps near 1.

        Args: as `restitution`.
        """
        return 1 - self.restitution(normal_speed)

    def impact_length(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """``X = (v^2/alpha)^(2/5)``, the length scale of the overlap, in diameters.

        Zero for hard spheres, the default.

        Args: as `restitution`.
        """
        return jnp.zeros_like(normal_speed)

    def dissipation(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """``beta = (3/2) A alpha^(2/5) v^(1/5)`` of viscoelastic spheres; 0 of others."""
        return jnp.zeros_like(normal_speed)


class LawInUnits(ReducedLaw):
    """A law that is a function of the speed alone, in units of a reference speed.

    Attributes:
        law: takes speeds in m/s.
        speed: the reference speed, m/s.
    """

    law: RestitutionLaw
    speed: Float[Array, ""]

    def restitution(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        found = self.law.restitution(normal_speed * self.speed)
        return jnp.broadcast_to(found, jnp.shape(normal_speed))

    def loss(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        found = self.law.loss(normal_speed * self.speed)
        return jnp.broadcast_to(found, jnp.shape(normal_speed))


def restitution_at(
    law: RestitutionLaw, diameter: Array, mass: Array, normal_speed: Float[Array, "..."]
) -> Float[Array, "..."]:
    """eps of spheres at speeds in m/s."""
    reduced = law.reduced(diameter=diameter, mass=mass, speed=number(1.0))
    return reduced.restitution(normal_speed)


def check_units(law: RestitutionLaw) -> None:
    """Check, once for each class of law, that `reduced` returns a law in the units it is told.

    Raises:
        ValueError: if it returns no `ReducedLaw`, or one whose eps depends on the units.
    """
    kind = type(law)
    traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(law))
    own = kind.__module__.startswith(f"{__package__}.")  # those of this package, which are tested
    if own or kind in _CHECKED or kind.reduced is RestitutionLaw.reduced or traced:
        return
    found = []
    with jax.ensure_compile_time_eval():
        for unit in (0.1, 1.0):
            reduced = law.reduced(diameter=1e-3, mass=1e-6, speed=jnp.asarray(unit))
            if not isinstance(reduced, ReducedLaw):
                raise ValueError(
                    f"{kind.__name__}.reduced must return a jaxgran.ReducedLaw, got "
                    f"{type(reduced).__name__}; {UNITS}"
                )
            found.append(np.asarray(reduced.restitution(jnp.array([0.03, 0.3]) / unit), float))
    one, other = found
    if np.all(np.isfinite(found)) and np.max(np.abs(one - other)) > 1e-3:
        raise ValueError(
            f"{kind.__name__}.reduced gives eps = {one[1]:.4g} at 0.3 m/s in units of 0.1 m/s and "
            f"{other[1]:.4g} in units of 1 m/s; {UNITS}"
        )
    _CHECKED.add(kind)


def _number_fields(cls: type) -> list[str]:
    """Names of the fields that a class adds and that are annotated as numbers or arrays."""
    kinds = (float, jax.Array, Array, "float", "jax.Array", "Array")
    return [name for name, kind in inspect.get_annotations(cls).items() if kind in kinds]
