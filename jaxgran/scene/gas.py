"""The scene: a homogeneous gas of equal spheres, and the physical scales that follow from it.

A gas in short words.

The floats of a module and of its parts, by name.

The shear instability of a cooling gas: the shortest wave of a flow that outlives the heat.
"""

from abc import abstractmethod
from collections.abc import Iterator
from functools import reduce
from math import gamma, pi
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxgran._utils.formatting import Rows, format_quantity, html_table, text_table
from jaxgran._utils.validation import (
    POSITIVE,
    Domain,
    UserNumber,
    check_normal,
    number,
    whole_number,
)
from jaxgran.scene import elements
from jaxgran.scene.contact import ELASTIC_CONTACT_TIME, ELASTIC_OVERLAP
from jaxgran.scene.elements import (
    DrivenStart,
    Frictional,
    Rough,
    StokesDrag,
    Walls,
    WhiteNoise,
    optional_element,
)
from jaxgran.scene.geometry import (
    CLOSE_PACKING,
    contact_value,
    impact_average,
    side_of_box,
    sphere_surface,
)
from jaxgran.scene.laws import ReducedLaw, RestitutionLaw, Viscoelastic, check_units, restitution_at

FLOAT_UNITS = {
    "diameter": "m",
    "mass": "kg",
    "temperature": "m^2/s^2",
    "youngs_modulus": "Pa",
    "dissipative_constant": "s",
    "rotational_temperature": "m^2/s^2",
    "wall_side": "m",
    "drag_rate": "1/s",
    "drag_rotational_rate": "1/s",
    "drive_strength": "m^2/s^3",
}
"""Units of the floats of a gas that have one."""


def describe_floats(gas: Any) -> Rows:
    """Every float with its unit, and, of a single gas of known numbers, the scales that follow."""
    rows = [
        (name, format_quantity(gas.value(name), FLOAT_UNITS.get(name, ""))) for name in gas.domains
    ]
    leaves = jax.tree.leaves(gas)
    if any(isinstance(leaf, Tracer) or np.ndim(leaf) > 0 for leaf in leaves):
        return rows
    rows.append(("mean free time", format_quantity(gas.mean_free_time, "s")))
    if hasattr(gas.law, "dissipative_constant"):
        rows.append(("beta", format_quantity(gas.thermal_beta, "at v = sqrt(2 T_0)")))
        rows.append(("t_c/tau_c", format_quantity(gas.contact_fraction)))
    return rows


def describe_scene(gas: Any) -> str:
    """The law, the dimension and the elements."""
    elements = "".join(f", with {name}" for name in gas.elements)
    return f"Gas of {type(gas.law).__name__} spheres, d = {gas.dimension}{elements}"


S = TypeVar("S", bound="NamedFloats")


class Place(NamedTuple):
    """Where a float is: attributes, one within the other; and its allowed range."""

    path: tuple[str, ...]
    domain: Domain


class NamedFloats(eqx.Module):
    """A module whose floats, those of its parts included, can be read and replaced by name."""

    def __repr__(self) -> str:
        return text_table(describe_scene(self), describe_floats(self))

    def _repr_html_(self) -> str:
        return html_table(describe_scene(self), describe_floats(self))

    def __getattr__(self, name: str) -> Any:
        # Only for names that are no attributes: floats of parts are read as they are replaced.
        if not name.startswith("_") and "law" in vars(self) and name in self._places:
            return self.value(name)
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    @property
    @abstractmethod
    def _places(self) -> dict[str, Place]:
        """Where each float is."""

    @property
    def domains(self) -> dict[str, Domain]:
        """Allowed range of every float, by name."""
        return {name: place.domain for name, place in self._places.items()}

    def value(self, name: str) -> Float[Array, "..."]:
        """The value of a float, by name.

        Raises:
            ValueError: for an unknown name.
        """
        places = self._places
        if name not in places:
            raise ValueError(f"no float {name!r} in this gas; it has {', '.join(places)}")
        return reduce(getattr, places[name].path, self)

    def replace(self: S, **values: UserNumber) -> S:
        """A copy with other values of some floats: ``gas.replace(dissipative_constant=1e-6)``.

        Args:
            values: by name.

        Raises:
            ValueError: for an unknown name or a value outside its range.
        """
        places = self._places
        for name, value in values.items():
            self.value(name)
            places[name].domain.check(name, value)

        def get(module):
            return [reduce(getattr, places[name].path, module) for name in values]

        return eqx.tree_at(get, self, [number(value) for value in values.values()])

    def _check_single(self, lists: tuple[str, ...]) -> None:
        """Raise ValueError for a batch; `lists` are the floats that hold more than one number."""
        if all(jnp.shape(leaf) == () for leaf in jax.tree.leaves(self)):
            return
        for name in self._places:
            shape = jnp.shape(self.value(name))
            if shape != () and name not in lists:
                raise ValueError(
                    f"{name} of the gas has shape {shape}, and one number is allowed: take many "
                    "gases with jax.vmap(lambda gas: jaxgran.cool(gas, times))(gases), or call "
                    "this for one gas at a time"
                )


SHEAR_VISCOSITY = {2: (2.0, 1.0, 0.8729), 3: (4.0, 0.8, 0.7614)}
"""b, a_1, a_2 of Enskog's ``eta g_2 / eta_0 = 1 + a_1 y + a_2 y^2`` with ``y = b phi g_2``.

Reference: Gass 1971 (2D); Chapman & Cowling, Eq. 16.41.7 (3D).
"""


def unit_wavenumber(packing_fraction: Float[Array, ""], dimension: int) -> Float[Array, ""]:
    """``k_c sigma/sqrt(I)``, I = <1 - eps^2>: see `critical_length`."""
    g_2, phi = contact_value(packing_fraction, dimension), packing_fraction
    b, first, second = SHEAR_VISCOSITY[dimension]
    y = b * phi * g_2
    dense = g_2**2 / (1 + first * y + second * y**2)
    density = phi * dimension * 2**dimension / sphere_surface(dimension)
    return density * jnp.sqrt((32 * pi / 15 if dimension == 3 else pi) * dense)


def mean_loss(law: ReducedLaw, like: Float[Array, ""]) -> Float[Array, ""]:
    """``I = <1 - eps^2>``, weighted by the energy of the normal motion, at the reference speed.

    Args:
        law: of restitution.
        like: a number of the precision that is wanted.
    """

    def lost(g: Array) -> Array:
        loss = law.loss(g)
        return g**2 / 2 * loss * (2 - loss)

    return impact_average(lost, like)


def critical_length(
    law: ReducedLaw, packing_fraction: Float[Array, ""], dimension: int
) -> Float[Array, ""]:
    """L_c = 2 pi/k_c in diameters, at the reference speed sqrt(2 T) of the law.

    The energy of a wave of shear flow decays at the rate ``2 eta k^2/rho``, heat at the cooling
    rate: equal at k_c. ``k_c sigma = n sigma^3 sqrt((32 pi/15) I f)`` (3D) or
    ``n sigma^2 sqrt(pi I f)`` (2D) with ``I = <1 - eps^2>``, weighted by the energy of the normal
    motion, and ``f = g_2^2/(1 + a_1 y + a_2 y^2)`` of a dense gas, by Enskog's viscosity of elastic
    spheres in the first Sonine approximation.

    Returns:
        L_c/sigma; infinite for elastic spheres.
    """
    loss = mean_loss(law, packing_fraction)
    inelastic = loss > 0
    root = unit_wavenumber(packing_fraction, dimension) * jnp.sqrt(jnp.where(inelastic, loss, 1.0))
    return jnp.where(inelastic, 2 * pi / root, jnp.inf)


if TYPE_CHECKING:
    UserLaw = RestitutionLaw
else:
    # A run-time type checker lets everything pass, so that a wrong type is reported in words.
    UserLaw = Any


_PACKINGS = {d: Domain(0.0, close) for d, close in CLOSE_PACKING.items()}


def _checked_law(law: UserLaw) -> RestitutionLaw:
    if not isinstance(law, RestitutionLaw):
        raise ValueError(f"law must be a restitution law such as jaxgran.Viscoelastic, got {law!r}")
    check_units(law)
    return law


class Gas(NamedFloats):
    """A homogeneous gas of equal spheres in its initial state.

    Every float can be traced, differentiated and batched with `jax.vmap`.

    Args:
        law: law of restitution, such as `jaxgran.Viscoelastic`, `jaxgran.ConstantRestitution` or
            `jaxgran.RestitutionSeries`.
        diameter: sigma, m, > 0.
        mass: m, kg, > 0; `jaxgran.sphere_mass` computes it from the density of the material.
        packing_fraction: phi (the paper's eta), in (0, close packing): the fraction of the volume
            (of the area if d = 2) that the spheres occupy.
        temperature: T_0 = <v^2>/d at t = 0, m^2/s^2, > 0, without the mass, as in the paper.
        dimension: d, 3, or 2 for spheres that move in a plane.
        surface: `jaxgran.Rough`, or `jaxgran.Frictional` where contacts last; None is smooth.
        container: `jaxgran.Walls`; None is periodic or unbounded.
        drag: `jaxgran.StokesDrag`; None is a vacuum.
        drive: `jaxgran.WhiteNoise`, which heats the gas; None lets it cool.
        preparation: `jaxgran.DrivenStart` of smooth spheres that were driven before t = 0; None
            begins with Maxwellian velocities.

    Floats of elements are known by name as those of the gas are, with the prefix wall_, drag_ or
    drive_, as in ``gas.replace(wall_coefficient=0.8)``. Values outside a range raise ValueError.

    >>> round(float(gas.mean_free_time), 4)
    0.026
    """

    law: RestitutionLaw = eqx.field(converter=_checked_law)
    diameter: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    mass: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    packing_fraction: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    temperature: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    dimension: int = eqx.field(static=True, default=3, kw_only=True)
    surface: Rough | Frictional | None = optional_element(Rough, Frictional)
    container: Walls | None = optional_element(Walls)
    drag: StokesDrag | None = optional_element(StokesDrag)
    drive: WhiteNoise | None = optional_element(WhiteNoise)
    preparation: DrivenStart | None = optional_element(DrivenStart)

    _domains: ClassVar[dict[str, Domain]] = {
        "diameter": POSITIVE,
        "mass": POSITIVE,
        "temperature": POSITIVE,
    }
    _advice: ClassVar[dict[str, str]] = {
        "diameter": "Give it in metres.",
        "mass": "Give it in kilograms; sphere_mass(diameter, density) computes it.",
        "temperature": "Give <v^2>/d in m^2/s^2.",
        "packing_fraction": "It is the fraction of the volume (of the area if dimension = 2) that "
        "the spheres occupy; the upper end is close packing.",
    }

    def __check_init__(self):
        if self.dimension not in CLOSE_PACKING or isinstance(self.dimension, bool | float):
            raise ValueError(f"dimension must be 2 or 3, got {self.dimension!r}")
        shared = [name for name in self.law.domains if name in self._advice]
        if shared:
            raise ValueError(
                f"the law {type(self.law).__name__} has a field {shared[0]!r}, which is the name "
                "of a float of the gas: rename it"
            )
        for name, domain in self.domains.items():
            if name in self._advice:
                value = getattr(self, name)
                domain.check(name, value, self._advice[name])
                check_normal(name, value)
        elements.check_elements(self)

    @property
    def _places(self) -> dict[str, Place]:
        own = {**self._domains, "packing_fraction": _PACKINGS[self.dimension]}
        places = {name: Place(("law", name), domain) for name, domain in self.law.domains.items()}
        places |= {name: Place((name,), domain) for name, domain in own.items()}
        for prefix, path, part in self._elements():
            for name, domain in part.domains.items():
                places[prefix + name] = Place((*path, name), domain)
        return places

    def _elements(self) -> Iterator[tuple[str, tuple[str, ...], Any]]:
        """Elements of the scene: the prefix of the names of their floats, where they are, and they
        themselves."""
        if self.surface is not None:
            yield "", ("surface",), self.surface
        if self.container is not None:
            yield "wall_", ("container",), self.container
            yield "wall_", ("container", "restitution"), self.container.restitution
        if self.drag is not None:
            yield "drag_", ("drag",), self.drag
        if self.drive is not None:
            yield "drive_", ("drive",), self.drive

    @property
    def elements(self) -> tuple[str, ...]:
        """Optional fields that this scene has, by name; "friction" is a surface=`Frictional`."""
        names = ("surface", "container", "drag", "drive", "preparation")
        given = tuple(name for name in names if getattr(self, name) is not None)
        return ("friction", *given[1:]) if isinstance(self.surface, Frictional) else given

    def check_single(self) -> None:
        """Check that this is one gas, not a batch of them outside of `jax.vmap`.

        Raises:
            ValueError: naming the float that has more than one value.
        """
        self._check_single((*self.law.lists, "wall_side"))

    @property
    def number_density(self) -> Float[Array, ""]:
        """Number density n, m^-d."""
        volume_of_sphere = (
            sphere_surface(self.dimension) / self.dimension * (self.diameter / 2) ** self.dimension
        )
        return self.packing_fraction / volume_of_sphere

    @property
    def density(self) -> Float[Array, ""]:
        """Mass over the volume of a sphere, ``6 m / (pi sigma^3)``, kg/m^3."""
        return 6 / pi * self.mass / self.diameter**3

    @property
    def contact_value(self) -> Float[Array, ""]:
        """Pair correlation at contact g_2: Carnahan & Starling (3D) or Henderson (2D)."""
        return contact_value(self.packing_fraction, self.dimension)

    @property
    def path_length(self) -> Float[Array, ""]:
        """``1 / (n g_2 sigma^(d-1))``, m, over `Walls.more_collisions` in a container."""
        meeting = self.number_density * self.contact_value
        if self.container is not None:
            meeting = meeting * self.container.more_collisions(self.diameter, self.dimension)
        return 1 / (meeting * self.diameter ** (self.dimension - 1))

    @property
    def mean_free_path(self) -> Float[Array, ""]:
        """``1 / (sqrt(2) pi n g_2 sigma^2)`` (3D) or ``1 / (2 sqrt(2) n g_2 sigma)`` (2D), m."""
        return self.path_length / (2**0.5 * (pi if self.dimension == 3 else 2))

    @property
    def impact_speed(self) -> Float[Array, ""]:
        """``sqrt(2 T_0)``, m/s, the rms of a component of the relative velocity of two spheres."""
        return jnp.sqrt(2 * self.temperature)

    @property
    def collision_frequency(self) -> Float[Array, ""]:
        """Collisions per particle per second of a Maxwellian gas at t = 0.

        ``nu_0 = n g_2 sigma^(d-1) S_d sqrt(T_0/pi)``. A collision counts once for each of its two
        particles.
        """
        return sphere_surface(self.dimension) * jnp.sqrt(self.temperature / pi) / self.path_length

    @property
    def mean_free_time(self) -> Float[Array, ""]:
        """Mean free time at t = 0, ``tau_c(0) = 1 / nu_0``, s; the paper's Eq. (12)."""
        return 1 / self.collision_frequency

    @property
    def reduced_law(self) -> ReducedLaw:
        """The law of restitution in units of the diameter and of `impact_speed`."""
        return self.law.reduced(diameter=self.diameter, mass=self.mass, speed=self.impact_speed)

    def restitution(self, normal_speed: UserNumber) -> Float[Array, "..."]:
        """Coefficient of restitution eps of an impact.

        Args:
            normal_speed: normal relative speed before the impact, m/s, > 0, any shape.

        Returns:
            eps, same shape.

        Raises:
            ValueError: for a speed that is not positive.
        """
        POSITIVE.check("normal_speed", normal_speed, "Give the normal approach speed in m/s.")
        return restitution_at(self.law, self.diameter, self.mass, number(normal_speed))

    def _viscoelastic(self, quantity: str) -> Viscoelastic:
        if not isinstance(self.law, Viscoelastic):
            raise ValueError(
                f"{quantity} belongs to the Viscoelastic law, this gas has "
                f"{type(self.law).__name__}; make the gas with jaxgran.Viscoelastic"
            )
        return self.law

    @property
    def alpha(self) -> Float[Array, ""]:
        """Elastic constant over effective mass, m^(-1/2) s^(-2); viscoelastic spheres only."""
        return self._viscoelastic("alpha").alpha(diameter=self.diameter, mass=self.mass)

    @property
    def delta(self) -> Float[Array, ""]:
        """The paper's small parameter, ``delta = A alpha^(2/5) T_0^(1/10)``."""
        law = self._viscoelastic("delta")
        return law.dissipative_constant * self.alpha**0.4 * self.temperature**0.1

    @property
    def thermal_beta(self) -> Float[Array, ""]:
        """beta of an impact at `impact_speed`, ``beta_T0 = (3/2) A alpha^(2/5) (2 T_0)^(1/10)``."""
        return 1.5 * 2**0.1 * self.delta

    @property
    def contact_duration(self) -> Float[Array, ""]:
        """Mean duration of the contacts at t = 0 if they were elastic, s; 0 for hard spheres.

        ``t_c = 3.218 (X/v) <g^(-1/5)>`` with X and v at `impact_speed` and, g being the normal
        speed over v, the mean over impacts ``<g^(-1/5)> = 2^(-1/10) Gamma(9/10)``.
        """
        length = self.reduced_law.impact_length(jnp.ones_like(self.temperature)) * self.diameter
        return ELASTIC_CONTACT_TIME * 2**-0.1 * gamma(0.9) * length / self.impact_speed

    @property
    def contact_fraction(self) -> Float[Array, ""]:
        """Mean contact duration over mean free time, t_c/tau_c.

        Where it is small against 1, nearly all impacts are binary.
        """
        return self.contact_duration * self.collision_frequency

    @property
    def mean_overlap(self) -> Float[Array, ""]:
        """Mean of the largest overlap of the impacts at t = 0 if they were elastic, in diameters.

        ``1.093 X_T <g^(4/5)>`` with X_T at `impact_speed` and, g being the normal speed over
        `impact_speed`, the mean over impacts ``<g^(4/5)> = 2^(2/5) Gamma(7/5)``; 0 for hard
        spheres.
        """
        length = self.reduced_law.impact_length(jnp.ones_like(self.temperature))
        return ELASTIC_OVERLAP * 2**0.4 * gamma(1.4) * length

    @property
    def critical_box(self) -> Float[Array, ""]:
        """Critical length of the shear instability, ``L_c = 2 pi / k_c``, m, at t = 0.

        In a periodic box longer than L_c a flow grows at the expense of the heat. Clusters come
        later, when it is strong enough to sweep the spheres together: in boxes of 8 to 10 L_c, two
        dimensions, T departs by 5 % after 20 (phi = .245, eps = .9) and 5 (.05, .6) collisions
        per particle, and density fluctuations reach twice those of an elastic fluid after 55 and 7
        (``experiments/paper/paper_clustering.py``); in shorter boxes later or never. See
        `jaxgran.scene.gas.critical_length`. Infinite for elastic spheres.
        """
        reduced = critical_length(self.reduced_law, self.packing_fraction, self.dimension)
        return self.diameter * reduced

    def box_side(self, num_particles: int) -> Float[Array, ""]:
        """Side of the cube (of the square if d = 2) that contains N spheres of this gas, m.

        Args:
            num_particles: N, >= 1.
        """
        num_particles = whole_number("num_particles", num_particles, 1)
        return side_of_box(number(num_particles), self.number_density, self.dimension)
