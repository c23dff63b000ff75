"""Laws of restitution: the ratio of the normal speeds after and before an impact, eps(v)."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxgran.checks.validation import (
    ANY,
    FRACTION,
    NOT_NEGATIVE,
    POSITIVE,
    Domain,
    UserTruth,
    number,
    truth_value,
)
from jaxgran.scene import contact
from jaxgran.scene.law import ReducedLaw, RestitutionLaw
from jaxgran.scene.restitution_table import (
    UNCLIPPED_SERIES,
    log_viscoelastic_restitution,
    viscoelastic_restitution,
)


class ReducedViscoelastic(ReducedLaw):
    """`Viscoelastic` in reduced units: the two numbers on which an impact depends.

    Attributes:
        beta: ``(3/2) A alpha^(2/5) v^(1/5)`` at the reference speed.
        length: ``(v^2/alpha)^(2/5)`` at the reference speed, in diameters.
        clipped: as for `Viscoelastic`.
    """

    beta: Float[Array, ""]
    length: Float[Array, ""]
    clipped: bool = eqx.field(static=True)

    num_nodes: ClassVar[int] = 20

    def restitution(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        return viscoelastic_restitution(self.dissipation(normal_speed), clipped=self.clipped)

    def loss(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        beta = self.dissipation(normal_speed)
        return -jnp.expm1(log_viscoelastic_restitution(beta, clipped=self.clipped))

    def impact_length(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.length * normal_speed**0.8

    def dissipation(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.beta * normal_speed**0.2


class Viscoelastic(RestitutionLaw):
    """Viscoelastic spheres, with the force ``F = rho xi^(3/2) + (3/2) A rho sqrt(xi) xi_dot``.

    Args:
        youngs_modulus: Y, Pa, > 0.
        poisson_ratio: nu, in (-1, 0.5).
        dissipative_constant: A, s, >= 0; 0 makes the spheres elastic.
        clipped: whether contact ends where the force vanishes (True: spheres without adhesion
            cannot pull) or where the overlap does (False: the convention of the paper's series).

    Raises:
        ValueError: for a value outside its range.

    Valid while impacts are neither so fast that the material yields plastically nor so slow that
    adhesion matters.

    Reference: Brilliantov & Poeschel, Self-diffusion in granular gases, Eqs. (1)-(2).

    >>> glass = jaxgran.Viscoelastic(5e7, poisson_ratio=0.22, dissipative_constant=3e-6)
    >>> f"{float(glass.dissipative_constant):g} s"
    '3e-06 s'
    """

    youngs_modulus: Float[Array, ""] = eqx.field(converter=number)
    poisson_ratio: Float[Array, ""] = eqx.field(converter=number)
    dissipative_constant: Float[Array, ""] = eqx.field(converter=number)
    clipped: UserTruth = eqx.field(static=True, default=True)

    domains: ClassVar[dict[str, Domain]] = {
        "youngs_modulus": POSITIVE,
        "poisson_ratio": Domain(-1.0, 0.5),
        "dissipative_constant": NOT_NEGATIVE,
    }
    advice: ClassVar[dict[str, str]] = {
        "youngs_modulus": "Give Young's modulus in Pa (glass has about 7e10).",
        "poisson_ratio": "Most solids lie between 0.2 and 0.45.",
        "dissipative_constant": "Give A in seconds; A = 0 makes the spheres elastic.",
    }

    def __check_init__(self):
        truth_value("clipped", self.clipped)

    def alpha(self, *, diameter: ArrayLike, mass: ArrayLike) -> Float[Array, ""]:
        """Elastic constant over effective mass, ``alpha = rho / m_eff`` with ``m_eff = m / 2``.

        Args:
            diameter: sigma, m, > 0.
            mass: m, kg, > 0, of either sphere.

        Returns:
            alpha, m^(-1/2) s^(-2).

        Reference: Brilliantov & Poeschel, Self-diffusion in granular gases, Eq. (2).
        """
        rho = contact.elastic_constant(self.youngs_modulus, self.poisson_ratio, diameter)
        return 2 * rho / mass

    def reduced(
        self, *, diameter: ArrayLike, mass: ArrayLike, speed: ArrayLike
    ) -> ReducedViscoelastic:
        alpha = self.alpha(diameter=diameter, mass=mass)
        beta = 1.5 * self.dissipative_constant * alpha**0.4 * speed**0.2
        length = jnp.asarray((speed**2 / alpha) ** 0.4 / diameter)
        return ReducedViscoelastic(beta, length, self.clipped)

    def of_wall(self) -> "Viscoelastic":
        """The law of two spheres that collide as a sphere does with a flat wall of this material.

        ``alpha``, proportional to ``Y sqrt(R_eff)/m_eff``, is smaller by sqrt(2): the effective
        radius and mass are twice those of two spheres.
        """
        return eqx.tree_at(lambda law: law.youngs_modulus, self, self.youngs_modulus / 2**0.5)

    def on_wall(
        self, *, diameter: ArrayLike, mass: ArrayLike, speed: ArrayLike
    ) -> ReducedViscoelastic:
        return self.of_wall().reduced(diameter=diameter, mass=mass, speed=speed)


class ConstantRestitution(RestitutionLaw, ReducedLaw):
    """The same coefficient of restitution at every speed, as in Haff's law.

    Args:
        coefficient: e, in [0, 1].

    Raises:
        ValueError: for e outside [0, 1].

    >>> grains = jaxgran.ConstantRestitution(0.9)
    >>> float(gas.replace(temperature=1.0).restitution(0.1)), float(grains.coefficient)
    (0.9075542559594306, 0.9)
    """

    coefficient: Float[Array, ""] = eqx.field(converter=number)

    domains: ClassVar[dict[str, Domain]] = {"coefficient": FRACTION}
    advice: ClassVar[dict[str, str]] = {
        "coefficient": "1 is an elastic impact; 0 removes the normal relative velocity."
    }

    def reduced(
        self, *, diameter: ArrayLike, mass: ArrayLike, speed: ArrayLike
    ) -> "ConstantRestitution":
        return self

    def restitution(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.broadcast_to(self.coefficient, normal_speed.shape)


class RestitutionSeries(RestitutionLaw, ReducedLaw):
    """A series in powers of the speed, ``eps(v) = 1 + sum_k c_k v^(gamma_k)``.

    The series is not restricted to [0, 1]: check that eps is physical for the normal speeds of
    the gas, up to about five times sqrt(2 T).

    Args:
        coefficients: c_k, (m/s)^(-gamma_k), shape (terms,).
        exponents: gamma_k, shape (terms,).

    Raises:
        ValueError: for shapes that differ or values that are not finite.

    >>> law = jaxgran.RestitutionSeries(coefficients=[-0.1], exponents=[0.2])  # 1 - .1 v^(1/5)
    >>> law.coefficients.shape
    (1,)
    """

    coefficients: Float[Array, "terms"] = eqx.field(converter=number)
    exponents: Float[Array, "terms"] = eqx.field(converter=number)

    domains: ClassVar[dict[str, Domain]] = {"coefficients": ANY, "exponents": ANY}
    lists: ClassVar[tuple[str, ...]] = ("coefficients", "exponents")

    def __check_init__(self):
        shape = self.coefficients.shape
        if shape != self.exponents.shape or self.coefficients.ndim < 1 or shape[-1] < 1:
            raise ValueError(
                "coefficients and exponents must be lists of the same length, 1 or more, got "
                f"shapes {shape} and {self.exponents.shape}"
            )

    @classmethod
    def from_viscoelastic(
        cls, law: Viscoelastic, *, diameter: ArrayLike, mass: ArrayLike, num_terms: int = 2
    ) -> "RestitutionSeries":
        """The truncated series in powers of beta of given viscoelastic spheres.

        Args:
            law: the material.
            diameter: sigma, m, > 0.
            mass: m, kg, > 0, of either sphere.
            num_terms: number of powers of beta, 1 to 5; the paper has 2.

        Raises:
            ValueError: for another number of terms.

        Reference: Brilliantov & Poeschel, Self-diffusion in granular gases, Eq. (1).
        """
        if not 1 <= num_terms <= len(UNCLIPPED_SERIES):
            raise ValueError(
                f"num_terms must be 1 to {len(UNCLIPPED_SERIES)}, got {num_terms}; "
                "use the Viscoelastic law itself for more"
            )
        beta = law.reduced(diameter=diameter, mass=mass, speed=1.0).beta
        powers = jnp.arange(1, num_terms + 1)
        return cls(jnp.asarray(UNCLIPPED_SERIES[:num_terms]) * beta**powers, powers / 5)

    def reduced(
        self, *, diameter: ArrayLike, mass: ArrayLike, speed: ArrayLike
    ) -> "RestitutionSeries":
        return RestitutionSeries(self.coefficients * speed**self.exponents, self.exponents)

    def restitution(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        return 1 - self.loss(normal_speed)

    def loss(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        terms = zip(self.coefficients, self.exponents, strict=True)
        return jnp.asarray(-sum(c * normal_speed**gamma for c, gamma in terms))
