"""The scene: which spheres, how many to a volume, how hot, and every scale that follows."""

from math import gamma, pi
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxgran.domain import POSITIVE, Domain
from jaxgran.restitution import ReducedLaw, RestitutionLaw, Viscoelastic, number

ELASTIC_CONTACT_TIME = 3.21806546
"""Duration of an elastic Hertz impact in ``(alpha^2 v)^(-1/5)``."""

ELASTIC_OVERLAP = 1.09336207
"""Largest overlap of an elastic Hertz impact in ``(v^2/alpha)^(2/5)``."""

CLOSE_PACKING = {2: pi / (2 * 3**0.5), 3: pi / (3 * 2**0.5)}
"""Densest packing fraction of equal disks and spheres."""


def sphere_surface(dimension: int) -> float:
    """Surface of the unit sphere in d dimensions, ``S_d = 2 pi^(d/2) / Gamma(d/2)``."""
    return 2 * pi ** (dimension / 2) / gamma(dimension / 2)


def sphere_mass(diameter: ArrayLike, density: ArrayLike) -> Float[Array, ""]:
    """Mass of a sphere, ``pi density diameter^3 / 6``.

    Args:
        diameter: m, > 0.
        density: of the material, kg/m^3, > 0.
    """
    POSITIVE.check("diameter", diameter, "Give it in metres.")
    POSITIVE.check("density", density, "Give the material's density in kg/m^3.")
    return pi / 6 * number(density) * number(diameter) ** 3


class Gas(eqx.Module):
    """A homogeneous gas of equal spheres at its initial temperature.

    Every float may be traced, differentiated and batched with `jax.vmap`.

    Args:
        law: how two spheres rebound; see `jaxgran.Viscoelastic` and its neighbours.
        diameter: sigma, m, > 0.
        mass: m, kg, > 0; `jaxgran.sphere_mass` makes it of a density.
        packing_fraction: phi (the paper's eta), in (0, close packing).
        temperature: T_0 = <v^2>/d at t = 0, m^2/s^2, > 0 (the paper's unit-mass convention).
        dimension: d, 2 (spheres moving in a plane) or 3.

    Raises:
        ValueError: for a value outside its range.
    """

    law: RestitutionLaw
    diameter: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    mass: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    packing_fraction: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    temperature: Float[Array, ""] = eqx.field(converter=number, kw_only=True)
    dimension: int = eqx.field(static=True, default=3, kw_only=True)

    _domains: ClassVar[dict[str, Domain]] = {
        "diameter": POSITIVE,
        "mass": POSITIVE,
        "temperature": POSITIVE,
    }
    _advice: ClassVar[dict[str, str]] = {
        "diameter": "Give it in metres.",
        "mass": "Give it in kilograms; sphere_mass(diameter, density) computes it.",
        "temperature": "Give <v^2>/d in m^2/s^2.",
        "packing_fraction": "It is the share of volume (area for d = 2) that the spheres fill; "
        "the upper end is close packing.",
    }

    def __check_init__(self):
        if not isinstance(self.law, RestitutionLaw):
            raise ValueError(
                f"law must be a restitution law such as jaxgran.Viscoelastic, got {self.law!r}"
            )
        if self.dimension not in CLOSE_PACKING:
            raise ValueError(f"dimension must be 2 or 3, got {self.dimension!r}")
        for name, domain in self.domains.items():
            if name in self._advice:
                domain.check(name, getattr(self, name), self._advice[name])

    @property
    def domains(self) -> dict[str, Domain]:
        """Allowed range of every float, the law's included, by name."""
        packing = Domain(0.0, CLOSE_PACKING[self.dimension])
        return {**self.law.domains, **self._domains, "packing_fraction": packing}

    def value(self, name: str) -> Float[Array, "..."]:
        """The float called `name`, of the gas or of its law."""
        if name not in self.domains:
            raise ValueError(f"no float {name!r} in this gas; it has {', '.join(self.domains)}")
        return getattr(self.law if name in self.law.domains else self, name)

    def replace(self, **values: ArrayLike) -> "Gas":
        """The same gas with other values, by name: ``gas.replace(dissipative_constant=1e-6)``.

        Raises:
            ValueError: for an unknown name or a value outside its range.
        """
        for name, value in values.items():
            self.value(name)
            self.domains[name].check(name, value)

        def get(gas):
            return [getattr(gas.law if k in gas.law.domains else gas, k) for k in values]

        return eqx.tree_at(get, self, [number(value) for value in values.values()])

    @property
    def number_density(self) -> Float[Array, ""]:
        """n, 1/m^d."""
        ball = (
            sphere_surface(self.dimension) / self.dimension * (self.diameter / 2) ** self.dimension
        )
        return self.packing_fraction / ball

    @property
    def contact_value(self) -> Float[Array, ""]:
        """Pair correlation at contact g_2: Carnahan & Starling (3D), Henderson (2D)."""
        phi = self.packing_fraction
        if self.dimension == 3:
            return (2 - phi) / (2 * (1 - phi) ** 3)
        return (1 - 7 * phi / 16) / (1 - phi) ** 2

    @property
    def path_length(self) -> Float[Array, ""]:
        """``1 / (n g_2 sigma^(d-1))``, m: the mean free path but for a number; unit of <dr^2>."""
        return 1 / (
            self.number_density * self.contact_value * self.diameter ** (self.dimension - 1)
        )

    @property
    def impact_speed(self) -> Float[Array, ""]:
        """``sqrt(2 T_0)``, m/s, the rms normal relative speed of a random pair."""
        return jnp.sqrt(2 * self.temperature)

    @property
    def collision_frequency(self) -> Float[Array, ""]:
        """Collisions per particle per second at t = 0.

        ``nu_0 = n g_2 sigma^(d-1) S_d sqrt(T_0/pi)``. A collision counts once for each of its two
        particles.
        """
        return sphere_surface(self.dimension) * jnp.sqrt(self.temperature / pi) / self.path_length

    @property
    def mean_free_time(self) -> Float[Array, ""]:
        """``tau_c(0) = 1 / nu_0``, s; the paper's Eq. (12)."""
        return 1 / self.collision_frequency

    @property
    def reduced_law(self) -> ReducedLaw:
        """The law in units of the diameter and of `impact_speed`."""
        return self.law.reduced(diameter=self.diameter, mass=self.mass, speed=self.impact_speed)

    def restitution(self, normal_speed: ArrayLike) -> Float[Array, "..."]:
        """eps at a normal approach speed > 0 in m/s, any shape."""
        POSITIVE.check("normal_speed", normal_speed, "Give the speed of approach in m/s.")
        law = self.law.reduced(diameter=self.diameter, mass=self.mass, speed=number(1.0))
        return law.restitution(number(normal_speed))

    def _viscoelastic(self, quantity: str) -> Viscoelastic:
        if not isinstance(self.law, Viscoelastic):
            raise ValueError(
                f"{quantity} belongs to the Viscoelastic law; "
                f"this gas has {type(self.law).__name__}"
            )
        return self.law

    @property
    def alpha(self) -> Float[Array, ""]:
        """Elastic constant over effective mass, m^(-1/2) s^(-2); viscoelastic spheres only."""
        return self._viscoelastic("alpha").alpha(diameter=self.diameter, mass=self.mass)

    @property
    def delta(self) -> Float[Array, ""]:
        """The paper's small parameter ``delta = A alpha^(2/5) T_0^(1/10)``."""
        law = self._viscoelastic("delta")
        return law.dissipative_constant * self.alpha**0.4 * self.temperature**0.1

    @property
    def thermal_beta(self) -> Float[Array, ""]:
        """``beta_T0 = (3/2) A alpha^(2/5) (2 T_0)^(1/10)``: beta of an impact at sqrt(2 T_0)."""
        return 1.5 * 2**0.1 * self.delta

    @property
    def contact_duration(self) -> Float[Array, ""]:
        """Mean duration of an elastic contact, s, over the impacts of the gas; 0 for hard spheres.

        ``3.218 (X/v) <g^(-1/5)>`` with the mean over impacts ``2^(-1/10) Gamma(9/10)``.
        """
        length = self.reduced_law.impact_length(jnp.ones_like(self.temperature)) * self.diameter
        return ELASTIC_CONTACT_TIME * 2**-0.1 * gamma(0.9) * length / self.impact_speed

    @property
    def contact_fraction(self) -> Float[Array, ""]:
        """Contact duration over mean free time; impacts are binary and instant where it is << 1."""
        return self.contact_duration * self.collision_frequency

    @property
    def mean_overlap(self) -> Float[Array, ""]:
        """Mean largest overlap of an elastic impact, in diameters; 0 for hard spheres.

        ``1.093 X_T <g^(4/5)>`` with the mean over impacts ``2^(2/5) Gamma(7/5)``.
        """
        length = self.reduced_law.impact_length(jnp.ones_like(self.temperature))
        return ELASTIC_OVERLAP * 2**0.4 * gamma(1.4) * length

    @property
    def critical_box(self) -> Float[Array, ""]:
        """``L_c = 2 pi / k_c``, m: the gas stays homogeneous only in boxes shorter than this.

        ``k_c sigma = n sigma^3 sqrt((32 pi / 15) (1 - eps^2))`` (3D) or
        ``n sigma^2 sqrt(pi (1 - eps^2))`` (2D), of a dilute gas, with eps at
        `impact_speed`; infinite for elastic spheres.
        """
        eps = self.reduced_law.restitution(jnp.ones_like(self.temperature))
        strength = 32 * pi / 15 if self.dimension == 3 else pi
        density = self.number_density * self.diameter**self.dimension
        lossy = eps < 1
        loss = jnp.sqrt(strength * jnp.where(lossy, 1 - eps**2, 1.0))
        return jnp.where(lossy, 2 * pi * self.diameter / (density * loss), jnp.inf)

    def box_side(self, num_particles: int) -> Float[Array, ""]:
        """Side of the cube (square) that holds `num_particles` of this gas, m."""
        return (num_particles / self.number_density) ** (1 / self.dimension)
