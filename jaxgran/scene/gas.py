"""A homogeneous gas of spheres: its parameters, its elements, and its physical scales."""

from functools import cached_property
from math import gamma, pi
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran._utils.formatting import format_quantity, text_table
from jaxgran._utils.tracing import any_traced
from jaxgran._utils.validation import POSITIVE, Domain, UserNumber, checked_int, float_array
from jaxgran.scene import laws
from jaxgran.scene.contact import ELASTIC_CONTACT_TIME, ELASTIC_OVERLAP
from jaxgran.scene.elements import Frictional, Rough, StokesDrag, WhiteNoise, check_elements
from jaxgran.scene.geometry import (
    CLOSE_PACKING,
    contact_value,
    scaled_critical_wavenumber,
    sphere_surface,
)
from jaxgran.scene.parameter_fields import (
    ParameterField,
    element_fields,
    fields_by_name,
    law_fields,
)
from jaxgran.scene.parameters import (
    ADVICE,
    PARAMETER_UNITS,
    domains_of,
    fields_of,
    number_named,
    optional_number_named,
    unit_of,
)
from jaxgran.scene.walls import Walls

PACKING_DOMAINS = {d: Domain(0.0, close) for d, close in CLOSE_PACKING.items()}
"""Allowed packing fractions, by dimension."""


def _checked_law(law: laws.RestitutionLaw) -> laws.RestitutionLaw:
    if not isinstance(law, laws.RestitutionLaw):
        raise ValueError(f"law must be a restitution law such as jaxgran.Viscoelastic, got {law!r}")
    # Functions in a law, as in a neural network, must not be leaves beside its arrays.
    law = jax.tree.map(_without_function_leaf, law)
    laws.check_reduced_units(law)
    return law


def _without_function_leaf(leaf: Any) -> Any:
    if isinstance(leaf, str):
        raise ValueError(
            f"a law must consist of numbers, arrays and functions, got {leaf!r}. Declare that "
            "field as eqx.field(static=True)"
        )
    return jax.tree_util.Partial(leaf) if callable(leaf) else leaf


ELEMENTS: dict[str, tuple[type, ...]] = {
    "surface": (Rough, Frictional),
    "container": (Walls,),
    "drag": (StokesDrag,),
    "drive": (WhiteNoise,),
}
"""Fields of `Gas` that are elements, with their classes."""


def optional_element(name: str) -> Any:
    """Return the field of an element, which accepts only None and instances of its classes."""
    classes = ELEMENTS[name]

    def check_class(value: Any) -> Any:
        if value is None or isinstance(value, classes):
            return value
        allowed = ", ".join(f"a jaxgran.{cls.__name__}" for cls in classes)
        raise ValueError(f"{name}: expected {allowed} or None, got {value!r}")

    return eqx.field(converter=check_class, default=None, kw_only=True)


MAX_SIZE_SPREAD = 0.2
"""Largest standard deviation of diameters over their mean: two sizes 1 : 1.5 have it."""


def is_allowed_spread(spread: Any) -> Any:
    """Return whether the theory of unequal sizes holds at a spread of diameters over their mean."""
    return spread <= MAX_SIZE_SPREAD * (1 + 1e-6)


class Gas(eqx.Module):
    """A homogeneous gas of spheres in its initial state.

    Every parameter can be traced, differentiated and batched with `jax.vmap`.

    Args:
        law: law of restitution, such as `jaxgran.Viscoelastic`, `jaxgran.ConstantRestitution` or
            `jaxgran.RestitutionSeries`.
        diameter: sigma, m, > 0; the mean (by number) where diameters differ.
        mass: m, kg, > 0, of a sphere of this diameter; `jaxgran.sphere_mass` computes it from the
            density of the material. Where diameters differ the mean mass is larger, by ``1 + 3
            (diameter_sd/diameter)^2``.
        packing_fraction: phi (the paper's eta), in (0, close packing): the fraction of the volume
            (of the area if d = 2) that the spheres occupy, ``(pi/6) n <sigma^3>``. Where diameters
            differ it belongs to fewer spheres than phi of equal ones; N spheres in a known volume
            V have ``phi = N (pi/6) sigma^3 (1 + 3 (diameter_sd/diameter)^2)/V``.
        temperature: T_0 = <v^2>/d at t = 0, m^2/s^2, > 0, without the mass, as in the paper.
        dimension: d, 3, or 2 for spheres that move in a plane.
        diameter_sd: standard deviation of the diameters, m, from 0 to .2 sigma; None (the default)
            for equal spheres. All spheres consist of one material, the distribution of their
            diameters is nearly symmetric, and at t = 0 small and large ones are equally fast:
            `jaxgran.theory.sizes`.
        surface: `jaxgran.Rough`, or `jaxgran.Frictional` for contacts of finite duration; None for
            smooth spheres.
        container: `jaxgran.Walls`; None for a periodic box or an unbounded gas.
        drag: `jaxgran.StokesDrag`; None for a vacuum.
        drive: `jaxgran.WhiteNoise`, which heats the gas; None for a gas that cools.

    Raises:
        ValueError: for a value outside its range.

    Floats of elements have names, too, with the prefix wall_, drag_ or drive_, as in
    ``gas.replace(wall_coefficient=0.8)``.

    >>> round(float(gas.mean_free_time), 4)
    0.026
    """

    law: laws.RestitutionLaw = eqx.field(converter=_checked_law)
    diameter: Float[Array, ""] = eqx.field(converter=number_named("diameter"), kw_only=True)
    mass: Float[Array, ""] = eqx.field(converter=number_named("mass"), kw_only=True)
    packing_fraction: Float[Array, ""] = eqx.field(
        converter=number_named("packing_fraction"), kw_only=True
    )
    temperature: Float[Array, ""] = eqx.field(converter=number_named("temperature"), kw_only=True)
    dimension: int = eqx.field(static=True, default=3, kw_only=True)
    diameter_sd: Float[Array, ""] | None = eqx.field(
        converter=optional_number_named("diameter_sd"), default=None, kw_only=True
    )
    surface: Rough | Frictional | None = optional_element("surface")
    container: Walls | None = optional_element("container")
    drag: StokesDrag | None = optional_element("drag")
    drive: WhiteNoise | None = optional_element("drive")

    def __check_init__(self):
        if self.dimension not in CLOSE_PACKING or isinstance(self.dimension, bool | float):
            raise ValueError(f"dimension must be 2 or 3, got {self.dimension!r}")
        own = fields_of("Gas")
        shared = [name for name in law_fields(self.law) if name in own]
        if shared:
            raise ValueError(
                f"the law {type(self.law).__name__} has a field {shared[0]!r}, which is also the "
                "name of a parameter of the gas: rename it"
            )
        for name in own:
            if getattr(self, name) is not None:
                self.domains[name].check(name, getattr(self, name), ADVICE[name])
        self.check_sizes()
        check_elements(self)

    def check_sizes(self) -> None:
        """Raise ValueError if diameters differ so much that the theory of them does not hold."""
        if self.diameter_sd is None or any_traced(self.diameter_sd, self.diameter):
            return
        spread = float(np.max(np.asarray(self.diameter_sd) / np.asarray(self.diameter)))
        if not is_allowed_spread(spread):
            raise ValueError(
                f"diameter_sd is {spread:.3g} of the diameter, at most {MAX_SIZE_SPREAD:g} is "
                "allowed: the theory is of second order in it. Sieve the grains, or measure one "
                "size alone"
            )

    def __getattr__(self, name: str) -> Any:
        # Python calls this only for names that are not attributes, such as parameters of parts.
        if not name.startswith("_") and "law" in vars(self) and name in self._parameter_fields:
            return self.value(name)
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    @property
    def domains(self) -> dict[str, Domain]:
        """Allowed range of every parameter, by name."""
        return {name: field.domain for name, field in self._parameter_fields.items()}

    @property
    def parameters(self) -> dict[str, Any]:
        """Value of every parameter, by name: arrays of JAX, in fits also of NumPy."""
        return {name: field.get(self) for name, field in self._parameter_fields.items()}

    def value(self, name: str) -> Float[Array | np.ndarray, "..."]:
        """Value of the parameter with this name.

        Raises:
            ValueError: for an unknown name.
        """
        return self._field_named(name).get(self)

    def replace(self, **values: UserNumber) -> "Gas":
        """Return a copy with new values of some parameters.

        For example ``gas.replace(dissipative_constant=1e-6)``.

        Args:
            values: new values, by name of the parameter.

        Raises:
            ValueError: for an unknown name or a value outside its range.
        """
        fields = [self._field_named(name) for name in values]
        arrays = []
        for field, (name, value) in zip(fields, values.items(), strict=True):
            field.domain.check(name, value)
            arrays.append(float_array(value, name, unit_of(name)))
        return eqx.tree_at(lambda module: [field.get(module) for field in fields], self, arrays)

    def with_arrays(self, values: dict[str, Any]) -> "Gas":
        """Return a copy with new values of some parameters, whose ranges are not checked.

        Fits use it in each step. Elsewhere use `replace`, which checks.

        Args:
            values: new values, by name of the parameter: arrays of JAX or NumPy of any shape.

        Raises:
            ValueError: for an unknown name.

        >>> gas.with_arrays({"temperature": jnp.array([0.01, 0.02])}).temperature.shape
        (2,)
        """
        leaves, structure = jax.tree.flatten(self)
        positions = structure.unflatten(range(len(leaves)))
        for name, value in values.items():
            leaves[self._field_named(name).get(positions)] = value
        changed = structure.unflatten(leaves)
        # Its parameters have the same places: to find them again takes as long as all else here.
        vars(changed)["_parameter_fields"] = self._parameter_fields
        return changed

    def _field_named(self, name: str) -> ParameterField:
        fields = self._parameter_fields
        if name not in fields:
            raise ValueError(f"Gas has no parameter {name!r}; it has {', '.join(fields)}")
        return fields[name]

    @cached_property
    def _parameter_fields(self) -> dict[str, ParameterField]:
        own = domains_of("Gas") | {"packing_fraction": PACKING_DOMAINS[self.dimension]}
        if self.diameter_sd is None:
            del own["diameter_sd"]
        of_law = law_fields(self.law)
        fields = {name: field.within("law") for name, field in of_law.items()}
        fields |= fields_by_name(own)
        for element in ELEMENTS:
            if getattr(self, element) is not None:
                of_element = element_fields(getattr(self, element))
                fields |= {name: field.within(element) for name, field in of_element.items()}
        return fields

    @property
    def elements(self) -> tuple[str, ...]:
        """Names of the elements of this gas, which include diameter_sd.

        A `Frictional` surface has the name "friction", a `Rough` one "surface".
        """
        names = (*ELEMENTS, "diameter_sd")
        given = [name for name in names if getattr(self, name) is not None]
        if isinstance(self.surface, Frictional):
            given[given.index("surface")] = "friction"
        return tuple(given)

    def check_single(self) -> None:
        """Check that this is one gas, not a batch of gases outside of `jax.vmap`.

        Raises:
            ValueError: if a parameter has more than one value; the message names it.
        """
        if all(jnp.shape(leaf) == () for leaf in jax.tree.leaves(self)):
            return
        # The arrays of a law that is a network, and the sides of walls, may have axes.
        parts = law_fields(self.law).keys() - self.law.domains.keys()
        lists = (*self.law.lists, *parts, "wall_side")
        for name in self.domains:
            shape = jnp.shape(self.value(name))
            if shape != () and name not in lists:
                raise ValueError(
                    f"{name} of the gas has shape {shape}, but only one number is allowed. For "
                    "many gases use jax.vmap(lambda gas: jaxgran.cool(gas, times))(gases), or "
                    "call this for one gas at a time; put the name of a vector of a law into "
                    "`lists` of its class."
                )

    def __repr__(self) -> str:
        parts = "".join(f", with {name}" for name in self.elements)
        title = f"Gas of {type(self.law).__name__} spheres, d = {self.dimension}{parts}"
        units = [(name, PARAMETER_UNITS.get(name, "")) for name in self.domains]
        rows = [(name, format_quantity(self.value(name), unit)) for name, unit in units]
        if any_traced(self) or any(np.ndim(leaf) > 0 for leaf in jax.tree.leaves(self)):
            return text_table(title, rows)
        rows.append(("mean free time", format_quantity(self.mean_free_time, "s")))
        if isinstance(self.law, laws.Viscoelastic):
            rows.append(("beta", format_quantity(self.thermal_beta, "at v = sqrt(2 T_0)")))
            rows.append(("t_c/tau_c", format_quantity(self.contact_fraction)))
        return text_table(title, rows)

    @property
    def size_spread(self) -> Float[Array, "..."]:
        """Standard deviation of the diameters over their mean; 0 of equal spheres."""
        if self.diameter_sd is None:
            return jnp.zeros_like(self.diameter)
        return jnp.asarray(self.diameter_sd / self.diameter)

    @property
    def number_density(self) -> Float[Array, ""]:
        """Number density n, m^-d."""
        d = self.dimension
        volume_of_sphere = sphere_surface(d) / d * (self.diameter / 2) ** d
        if self.diameter_sd is not None:  # <sigma^d> over <sigma>^d
            unequal = 1 + (2 * d - 3) * self.size_spread**2
            volume_of_sphere = volume_of_sphere * unequal
        return self.packing_fraction / volume_of_sphere

    @property
    def density(self) -> Float[Array, ""]:
        """Density of the material of a solid sphere, ``6 m / (pi sigma^3)``, kg/m^3."""
        return 6 / pi * self.mass / self.diameter**3

    @property
    def contact_value(self) -> Float[Array, ""]:
        """Pair correlation at contact g_2: Carnahan & Starling (3D) or Henderson (2D)."""
        return contact_value(self.packing_fraction, self.dimension)

    @property
    def path_length(self) -> Float[Array, ""]:
        """Length scale of free paths, ``1 / (n g_2 sigma^(d-1))``, m.

        In a container it is divided by `Walls.more_collisions`.
        """
        density = self.number_density * self.contact_value
        if self.container is not None:
            density = density * self.container.more_collisions(self.diameter, self.dimension)
        return 1 / (density * self.diameter ** (self.dimension - 1))

    @property
    def mean_free_path(self) -> Float[Array, ""]:
        """Mean free path, m.

        ``1 / (sqrt(2) pi n g_2 sigma^2)`` (3D) or ``1 / (2 sqrt(2) n g_2 sigma)`` (2D).
        """
        return self.path_length / (2**0.5 * (pi if self.dimension == 3 else 2))

    @property
    def impact_speed(self) -> Float[Array, ""]:
        """Root mean square of one component of the relative velocity, ``sqrt(2 T_0)``, m/s."""
        return jnp.sqrt(2 * self.temperature)

    @property
    def collision_frequency(self) -> Float[Array, ""]:
        """Collisions per particle per second of a Maxwellian gas at t = 0.

        ``nu_0 = n g_2 sigma^(d-1) S_d sqrt(T_0/pi)``, 1/s. A collision counts once for each of its
        two particles.
        """
        return sphere_surface(self.dimension) * jnp.sqrt(self.temperature / pi) / self.path_length

    @property
    def mean_free_time(self) -> Float[Array, ""]:
        """Mean free time at t = 0, ``tau_c(0) = 1 / nu_0``, s; the paper's Eq. (12)."""
        return 1 / self.collision_frequency

    @property
    def reduced_law(self) -> laws.ReducedLaw:
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
        return _restitution(self, float_array(normal_speed))

    def _viscoelastic(self, quantity: str) -> laws.Viscoelastic:
        if not isinstance(self.law, laws.Viscoelastic):
            raise ValueError(
                f"{quantity} belongs to the Viscoelastic law, but this gas has "
                f"{type(self.law).__name__}. Make the gas with jaxgran.Viscoelastic."
            )
        return self.law

    @property
    def alpha(self) -> Float[Array, ""]:
        """Elastic constant over effective mass, m^(-1/2) s^(-2); viscoelastic spheres only."""
        return self._viscoelastic("alpha").alpha(diameter=self.diameter, mass=self.mass)

    @property
    def delta(self) -> Float[Array, ""]:
        """Small parameter of the paper; viscoelastic spheres only.

        ``delta = A alpha^(2/5) T_0^(1/10)``, dimensionless.
        """
        law = self._viscoelastic("delta")
        return law.dissipative_constant * self.alpha**0.4 * self.temperature**0.1

    @property
    def thermal_beta(self) -> Float[Array, ""]:
        """Dissipation parameter of an impact at `impact_speed`; viscoelastic spheres only.

        ``beta_T0 = (3/2) A alpha^(2/5) (2 T_0)^(1/10)``, dimensionless.
        """
        return 1.5 * 2**0.1 * self.delta

    @property
    def contact_duration(self) -> Float[Array, ""]:
        """Mean duration of contacts at t = 0 if they were elastic, s; 0 for hard spheres.

        ``t_c = 3.218 (X/v) <g^(-1/5)>`` with X and v at `impact_speed`. Here g is the normal speed
        over v, and the mean over impacts is ``<g^(-1/5)> = 2^(-1/10) Gamma(9/10)``.
        """
        length = self.reduced_law.impact_length(jnp.ones_like(self.temperature)) * self.diameter
        return ELASTIC_CONTACT_TIME * 2**-0.1 * gamma(0.9) * length / self.impact_speed

    @property
    def contact_fraction(self) -> Float[Array, ""]:
        """Ratio of the mean contact duration to the mean free time, t_c/tau_c.

        If it is much smaller than 1, nearly all impacts are binary.
        """
        return self.contact_duration * self.collision_frequency

    @property
    def mean_overlap(self) -> Float[Array, ""]:
        """Mean largest overlap of impacts at t = 0 if they were elastic, in diameters.

        ``1.093 X_T <g^(4/5)>`` with X_T at `impact_speed`. Here g is the normal speed over
        `impact_speed`, and the mean over impacts is ``<g^(4/5)> = 2^(2/5) Gamma(7/5)``. It is 0 for
        hard spheres.
        """
        length = self.reduced_law.impact_length(jnp.ones_like(self.temperature))
        return ELASTIC_OVERLAP * 2**0.4 * gamma(1.4) * length

    @property
    def critical_box(self) -> Float[Array, ""]:
        """Critical length of the shear instability, ``L_c = 2 pi / k_c``, m, at t = 0.

        The energy of a shear wave decays at the rate ``2 eta k^2/rho``, and the heat decays at the
        cooling rate; the two rates are equal at k_c. It follows that
        ``k_c sigma = n sigma^3 sqrt((32 pi/15) I f)`` (3D) or ``n sigma^2 sqrt(pi I f)`` (2D). Here
        ``I = <1 - eps^2>`` is weighted by the energy of the normal motion, and the density factor
        ``f = g_2^2/(1 + a_1 y + a_2 y^2)`` follows from Enskog's viscosity of elastic spheres in
        the first Sonine approximation (`SHEAR_VISCOSITY` in `jaxgran.scene.geometry`).

        In a periodic box longer than L_c a flow grows relative to the thermal motion. Clusters form
        later, when the flow is strong enough to sweep the spheres together. In two-dimensional
        boxes of 8 to 10 L_c, T departs by 5 % from homogeneous cooling after 20 (phi = 0.245,
        eps = 0.9) and 5 (phi = 0.05, eps = 0.6) collisions per particle, and density fluctuations
        are twice as strong as in an elastic fluid after 55 and 7
        (``experiments/paper/paper_clustering.py``). In shorter boxes this happens later or never.
        L_c is infinite for elastic spheres.
        """
        loss = laws.mean_loss(self.reduced_law, self.packing_fraction)
        inelastic = loss > 0
        wavenumber = scaled_critical_wavenumber(self.packing_fraction, self.dimension)
        root = wavenumber * jnp.sqrt(jnp.where(inelastic, loss, 1.0))
        return self.diameter * jnp.where(inelastic, 2 * pi / root, jnp.inf)

    def box_side(self, num_particles: int) -> Float[Array, ""]:
        """Side of the cube (of the square if d = 2) that contains N spheres of this gas, m.

        Args:
            num_particles: N, >= 1.

        Raises:
            ValueError: if N is not an integer >= 1.
        """
        num_particles = checked_int("num_particles", num_particles, 1)
        return (float_array(num_particles) / self.number_density) ** (1 / self.dimension)


@eqx.filter_jit
def _restitution(gas: Gas, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
    one = jnp.ones_like(gas.temperature)
    law = gas.law.reduced(diameter=gas.diameter, mass=gas.mass, speed=one)
    return law.restitution(normal_speed)
