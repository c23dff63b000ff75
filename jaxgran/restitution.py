"""Laws of restitution: how fast two spheres part, over how fast they met."""

from abc import abstractmethod
from collections.abc import Sequence
from math import gamma, pi, sqrt
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxgran import contact
from jaxgran.domain import ANY, FRACTION, NOT_NEGATIVE, POSITIVE, Domain

C1 = gamma(3 / 5) * sqrt(pi) / (2 ** (1 / 5) * 5 ** (2 / 5) * gamma(21 / 10))
"""First coefficient of the restitution series, 1.153448858; Brilliantov & Poeschel, Eq. (5)."""

C2 = 3 / 5 * C1**2
"""Second coefficient of the restitution series, 0.798266561; Brilliantov & Poeschel, Eq. (6)."""

UNCLIPPED_SERIES = (-C1, C2, -0.522882568, 0.348742675, -0.233098132)
"""Coefficients of beta, beta^2, ... when contact ends at zero overlap, as the paper has it."""

C_CLIP = 4 / 15
"""Coefficient of beta^(5/2), the first trace of contact ending at zero force instead."""


class _Fit(NamedTuple):
    # eps = (1 + kappa beta)^(-decay) exp(beta P / Q): the power is the exact decay of a heavily
    # damped rebound; P = decay kappa - C1 + beta p(x), Q = 1 + beta q(x), x = sqrt(beta) or beta,
    # were fitted to contact.impact by experiments/derive_restitution.py. No odd power of
    # sqrt(beta) stands below the series' own beta^(5/2), so two derivatives at 0 are right.
    kappa: float
    decay: float
    in_roots: bool
    p: tuple[float, ...]
    q: tuple[float, ...]


_CLIPPED = _Fit(
    kappa=0.7,
    decay=5 / 3,
    in_roots=True,
    p=(
        -0.2645544275974496,
        0.2662489993348014,
        -0.13891254348909338,
        0.056252769400273614,
        -0.06687792761144479,
        -0.026658507899730673,
        -0.0007599914400559866,
    ),
    q=(
        0.8100120942728318,
        0.0,
        0.34839933904496506,
        0.18475467752620237,
        0.39206416580007863,
        0.3897068203711826,
        0.22360126211067868,
        0.08224151259197285,
        0.002344580847926078,
    ),
)

_UNCLIPPED = _Fit(
    kappa=0.7,
    decay=5.0,
    in_roots=False,
    p=(
        -2.1330761561766067,
        0.8581838820848968,
        -0.14743926285178546,
        -0.019055706594629386,
        0.02292264625997086,
        -0.009161977151659381,
        0.0024213697097119936,
        -0.00040636956570282444,
        3.687239511277726e-05,
        -5.992074134500146e-07,
    ),
    q=(
        -0.4436713336028546,
        -0.036043841852944625,
        0.11564821628375116,
        -0.056701740443611134,
        0.021178496954814743,
        -0.007677437237806214,
        0.003027939339635816,
        -0.0010554851332044285,
        0.0002841019235579368,
        -4.832580251405117e-05,
        4.198243276201555e-06,
    ),
)


def _horner(coefficients: tuple[float, ...], x: Array) -> Array:
    total = jnp.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = total * x + coefficient
    return total


def viscoelastic_restitution(beta: ArrayLike, *, clipped: bool = True) -> Float[Array, "..."]:
    """Restitution of a viscoelastic impact, fast: a rational function in place of the ODE.

    ``eps = 1 - C1 beta + C2 beta^2 + (4/15) beta^(5/2) - ...`` (the last term only if clipped);
    ``eps -> (3/2)^(2/3) beta^(-5/3)`` (clipped) or ``5.158 beta^(-5)`` for heavy damping.

    Args:
        beta: ``(3/2) A alpha^(2/5) v^(1/5)``, >= 0, any shape.
        clipped: whether contact ends where the force vanishes (default) or where the overlap does.

    Returns:
        eps, in (0, 1], with relative error against `contact.impact` below 1e-9 for every beta up
        to 1e4 (clipped), 1e-7 for every beta up to 40 (unclipped); beyond, below 3e-5.
        Derivatives are finite and right down to beta = 0.
    """
    return jnp.exp(_log_restitution(beta, clipped))


def _log_restitution(beta: ArrayLike, clipped: bool) -> Float[Array, "..."]:
    beta = jnp.asarray(beta, dtype=jnp.result_type(float, beta))
    fit = _CLIPPED if clipped else _UNCLIPPED
    positive = beta > 0
    root = jnp.where(positive, jnp.sqrt(jnp.where(positive, beta, 1.0)), 0.0)
    x = root if fit.in_roots else beta
    p = (fit.decay * fit.kappa - C1) + beta * _horner(fit.p, x)
    q = 1 + beta * _horner(fit.q, x)
    return beta * p / q - fit.decay * jnp.log1p(fit.kappa * beta)


def number(value: ArrayLike | Sequence[float]) -> Array:
    """A strongly typed array, so that two Python floats do not make two compilations."""
    try:
        return jnp.asarray(value, dtype=jnp.result_type(float))
    except (TypeError, ValueError):
        raise ValueError(f"expected a number or an array of numbers, got {value!r}") from None


class RestitutionLaw(eqx.Module):
    """A law of restitution. To add one, write `reduced` and `restitution`, and state `domains`."""

    domains: ClassVar[dict[str, Domain]]
    """Allowed range of every float field, for checks and for fits."""

    def __check_init__(self):
        for name, domain in self.domains.items():
            domain.check(name, getattr(self, name), self.advice.get(name, ""))

    advice: ClassVar[dict[str, str]] = {}
    """What to do about a value outside its range."""

    @abstractmethod
    def reduced(self, *, diameter: ArrayLike, mass: ArrayLike, speed: ArrayLike) -> "ReducedLaw":
        """The law between two equal spheres, with `diameter` and `speed` as units."""


class ReducedLaw(eqx.Module):
    """A law of restitution between two given spheres, in units of a length and a speed."""

    num_nodes: ClassVar[int] = 40
    """Chebyshev nodes in ln T that resolve averages over its impacts; 40 serves eps(v) as steep as
    v over 12 decades of time (1e-7 of the cooling rate), less steep laws need fewer."""

    @abstractmethod
    def restitution(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """eps at a normal approach speed > 0, in units of the reference speed."""

    def loss(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """1 - eps; a law that knows it without cancellation keeps the digits of weak losses."""
        return 1 - self.restitution(normal_speed)

    def impact_length(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """X = (v^2/alpha)^(2/5), the length over which an impact is stopped, in diameters.

        Zero for hard spheres, the default."""
        return jnp.zeros_like(normal_speed)


class ReducedViscoelastic(ReducedLaw):
    """`Viscoelastic` at a reference speed: all that an impact depends on.

    Attributes:
        beta: ``(3/2) A alpha^(2/5) v^(1/5)`` at the reference speed.
        length: ``(v^2/alpha)^(2/5)`` at the reference speed, in diameters.
    """

    beta: Float[Array, ""]
    length: Float[Array, ""]
    clipped: bool = eqx.field(static=True)

    num_nodes: ClassVar[int] = 20

    def restitution(self, normal_speed):
        return viscoelastic_restitution(self.beta * normal_speed**0.2, clipped=self.clipped)

    def loss(self, normal_speed):
        return -jnp.expm1(_log_restitution(self.beta * normal_speed**0.2, self.clipped))

    def impact_length(self, normal_speed):
        return self.length * normal_speed**0.8


class Viscoelastic(RestitutionLaw):
    """Viscoelastic spheres: ``F = rho xi^(3/2) + (3/2) A rho sqrt(xi) xi_dot``.

    Args:
        youngs_modulus: Y, Pa, > 0.
        poisson_ratio: nu, in (-1, 0.5).
        dissipative_constant: A, s, >= 0; 0 is an elastic sphere.
        clipped: contact ends where the force vanishes (True, physical without adhesion) or where
            the overlap does (False, the convention of the paper's series).

    Raises:
        ValueError: for a value outside its range.

    Reference: Brilliantov & Poeschel, Self-diffusion in granular gases, Eqs. (1)-(2); valid while
    impacts are neither so fast that they yield plastically nor so slow that surfaces stick.
    """

    youngs_modulus: Float[Array, ""] = eqx.field(converter=number)
    poisson_ratio: Float[Array, ""] = eqx.field(converter=number)
    dissipative_constant: Float[Array, ""] = eqx.field(converter=number)
    clipped: bool = eqx.field(static=True, default=True)

    domains: ClassVar[dict[str, Domain]] = {
        "youngs_modulus": POSITIVE,
        "poisson_ratio": Domain(-1.0, 0.5),
        "dissipative_constant": NOT_NEGATIVE,
    }
    advice: ClassVar[dict[str, str]] = {
        "youngs_modulus": "Give Young's modulus in Pa (glass is about 7e10).",
        "poisson_ratio": "Most solids lie between 0.2 and 0.45.",
        "dissipative_constant": "Give A in seconds; A = 0 is an elastic sphere.",
    }

    def alpha(self, *, diameter: ArrayLike, mass: ArrayLike) -> Float[Array, ""]:
        """``alpha = rho / m_eff`` with ``m_eff = m / 2``, m^(-1/2) s^(-2); paper's Eq. (2)."""
        rho = contact.elastic_constant(self.youngs_modulus, self.poisson_ratio, diameter)
        return 2 * rho / mass

    def reduced(self, *, diameter, mass, speed) -> ReducedViscoelastic:
        alpha = self.alpha(diameter=diameter, mass=mass)
        beta = 1.5 * self.dissipative_constant * alpha**0.4 * speed**0.2
        length = jnp.asarray((speed**2 / alpha) ** 0.4 / diameter)
        return ReducedViscoelastic(beta, length, self.clipped)


class ConstantRestitution(RestitutionLaw, ReducedLaw):
    """The same restitution at every speed: Haff's gas.

    Args:
        coefficient: e, in [0, 1].

    Raises:
        ValueError: for e outside [0, 1].
    """

    coefficient: Float[Array, ""] = eqx.field(converter=number)

    domains: ClassVar[dict[str, Domain]] = {"coefficient": FRACTION}
    advice: ClassVar[dict[str, str]] = {"coefficient": "1 is elastic, 0 sticks along the normal."}

    def reduced(self, *, diameter, mass, speed) -> "ConstantRestitution":
        return self

    def restitution(self, normal_speed):
        return jnp.broadcast_to(self.coefficient, normal_speed.shape)


class RestitutionSeries(RestitutionLaw, ReducedLaw):
    """``eps(v) = 1 + sum_k c_k v^(gamma_k)``: any exponents, the paper's closing remark.

    The series is used as it stands, also where it leaves [0, 1]: check that the speeds of the gas,
    up to five times the thermal one, stay where it makes sense.

    Args:
        coefficients: c_k, shape (terms,), units (m/s)^(-gamma_k).
        exponents: gamma_k, shape (terms,).

    Raises:
        ValueError: for shapes that differ or values that are not finite.
    """

    coefficients: Float[Array, "terms"] = eqx.field(converter=number)
    exponents: Float[Array, "terms"] = eqx.field(converter=number)

    domains: ClassVar[dict[str, Domain]] = {"coefficients": ANY, "exponents": ANY}

    def __check_init__(self):
        if self.coefficients.shape != self.exponents.shape or self.coefficients.ndim < 1:
            raise ValueError(
                "coefficients and exponents must be lists of the same length, got shapes "
                f"{self.coefficients.shape} and {self.exponents.shape}"
            )

    @classmethod
    def from_viscoelastic(
        cls, law: Viscoelastic, *, diameter: ArrayLike, mass: ArrayLike, num_terms: int = 2
    ) -> "RestitutionSeries":
        """The paper's truncated series, Eq. (1), of given viscoelastic spheres.

        Args:
            law: the material.
            diameter, mass: m and kg, of either sphere.
            num_terms: how many powers of beta to keep, 1 to 5; the paper keeps 2.
        """
        if not 1 <= num_terms <= len(UNCLIPPED_SERIES):
            raise ValueError(
                f"num_terms must be 1 to {len(UNCLIPPED_SERIES)}, got {num_terms}; "
                "use Viscoelastic itself for more"
            )
        beta = law.reduced(diameter=diameter, mass=mass, speed=1.0).beta
        powers = jnp.arange(1, num_terms + 1)
        return cls(jnp.asarray(UNCLIPPED_SERIES[:num_terms]) * beta**powers, powers / 5)

    def reduced(self, *, diameter, mass, speed) -> "RestitutionSeries":
        return RestitutionSeries(self.coefficients * speed**self.exponents, self.exponents)

    def restitution(self, normal_speed):
        return 1 - self.loss(normal_speed)

    def loss(self, normal_speed):
        terms = zip(self.coefficients, self.exponents, strict=True)
        return jnp.asarray(-sum(c * normal_speed**gamma for c, gamma in terms))
