"""Laws of restitution: the ratio of the normal speeds after and before an impact, eps(v).

First the base classes, `RestitutionLaw` in SI units and `ReducedLaw` in reduced units; then the
coefficient of restitution of viscoelastic spheres; then the laws of the package.
"""

import dataclasses
import inspect
from abc import abstractmethod
from math import gamma, pi, sqrt
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran._utils.tracing import any_traced
from jaxgran._utils.validation import (
    ANY,
    NON_NEGATIVE,
    POSITIVE,
    Domain,
    UserNumber,
    check_bool,
    checked_float,
    float_array,
)
from jaxgran.scene import contact
from jaxgran.scene.geometry import impact_average
from jaxgran.scene.parameters import ADVICE, domains_of, number_named

_UNITS_ADVICE = (
    "a reduced law gets speeds in units of `speed`: leave `reduced` out and let "
    "restitution(self, normal_speed) take m/s, or divide the speeds of the law by `speed`"
)
_CHECKED_CLASSES: set[type] = set()


class RestitutionLaw(eqx.Module):
    """Base class of the laws of restitution of a material, in SI units.

    To write a law, make a subclass with a method `restitution(self, normal_speed)`, which returns
    eps at normal approach speeds in m/s, and with a field for each number of the law, annotated
    ``float``, in any units that `restitution` understands. The fields become JAX arrays: they can
    be fitted, swept and differentiated by name. `domains` may give the allowed range of a field, as
    in ``domains = {"yield_speed": jaxgran.extend.Domain(0.0)}``; without it any finite number is
    allowed. No field may have the name of a parameter of `jaxgran.Gas`. Kinetic theory needs an eps
    that is smooth in the speed. If eps also depends on the diameter or the mass, override `reduced`
    instead.

    >>> class Plastic(jaxgran.extend.RestitutionLaw):
    ...     yield_speed: float  # m/s
    ...     def restitution(self, normal_speed):  # m/s
    ...         return (1 + (normal_speed / self.yield_speed) ** 2) ** -0.125
    >>> plastic = dataclasses.replace(gas, law=Plastic(0.2))
    >>> round(float(plastic.restitution(0.1)), 4)
    0.9725
    """

    domains: ClassVar[dict[str, Domain]] = {}
    """Allowed range of every float field, by name; used for validation and for fits."""

    lists: ClassVar[tuple[str, ...]] = ()
    """Names of the fields that hold more than one number."""

    constants: ClassVar[tuple[str, ...]] = ()
    """Array fields that are not parameters: fits and sweeps leave them as they are."""

    advice: ClassVar[dict[str, str]] = {}
    """Advice on a value outside its range, by name: a sentence that ends the error message."""

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        numbers = _number_fields(cls)
        if "domains" not in vars(cls):
            cls.domains = {**cls.domains, **dict.fromkeys(numbers, ANY)}
        for name in numbers:
            default = vars(cls).get(name, dataclasses.MISSING)
            if not isinstance(default, dataclasses.Field):
                setattr(cls, name, eqx.field(converter=number_named(name), default=default))

    def __check_init__(self):
        kind = type(self)
        base = RestitutionLaw
        if kind.reduced is base.reduced and kind.restitution is base.restitution:
            raise ValueError(
                f"{kind.__name__} has no restitution: define restitution(self, "
                "normal_speed), which returns eps at normal approach speeds in m/s."
            )
        for name, domain in self.domains.items():
            if not hasattr(self, name):
                raise ValueError(
                    f"domains of {kind.__name__} has the key {name!r}, which is not a field. Use "
                    "the names of its float fields as keys."
                )
            domain.check(name, getattr(self, name), self.advice.get(name, ""))

    def restitution(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Coefficient of restitution eps of a law that depends on the speed alone.

        Args:
            normal_speed: normal approach speed, m/s, > 0, any shape.

        Returns:
            eps, same shape, or one number for all speeds.
        """
        raise NotImplementedError(
            f"eps of {type(self).__name__} depends on the spheres. Use jaxgran.Gas.restitution."
        )

    def loss(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Loss ``1 - eps``, with the arguments of `restitution`.

        Override it if it can be computed without cancellation for eps near 1.
        """
        return 1 - self.restitution(normal_speed)

    def prior_residuals(self) -> Float[Array, "residuals"]:
        """Prior knowledge of the numbers of this law, as residuals of unit variance.

        Fits in which numbers of the law are free add their squares to chi^2. There are none by
        default.
        """
        return jnp.zeros(0)

    def reduced(self, *, diameter: ArrayLike, mass: ArrayLike, speed: ArrayLike) -> "ReducedLaw":
        """Return the law of two equal spheres, in units of their diameter and a reference speed.

        By default it is `restitution` at the speeds in m/s, for spheres of any diameter and mass.

        Args:
            diameter: sigma, m, > 0.
            mass: m, kg, > 0, of either sphere.
            speed: reference speed, m/s, > 0.
        """
        return ScaledLaw(self, jnp.asarray(speed))

    def on_wall(self, *, diameter: ArrayLike, mass: ArrayLike, speed: ArrayLike) -> "ReducedLaw":
        """Return the law of a sphere and a flat wall that has this law, in the units of `reduced`.

        By default it equals the law of two spheres.
        """
        return self.reduced(diameter=diameter, mass=mass, speed=speed)


class ReducedLaw(eqx.Module):
    """Base class of the laws of two given spheres, in units of their diameter and a speed.

    A subclass defines `restitution`.

    >>> reduced = gas.reduced_law
    >>> bool(jnp.isclose(reduced.restitution(jnp.ones(())), gas.restitution(gas.impact_speed)))
    True
    """

    num_nodes: ClassVar[int] = 40
    """Number of Chebyshev nodes in ln T that resolve averages over the impacts of this law.

    40 nodes suffice for laws as steep as 1 - eps ~ v over 12 decades of time (relative error of the
    cooling rate: 1e-7); flatter laws need fewer."""

    @abstractmethod
    def restitution(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Coefficient of restitution eps at a normal approach speed.

        Args:
            normal_speed: in units of the reference speed, > 0, any shape.

        Returns:
            eps, same shape.
        """

    def loss(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Loss ``1 - eps``, with the arguments of `restitution`.

        Override it if it can be computed without cancellation for eps near 1.
        """
        return 1 - self.restitution(normal_speed)

    def loss_powers(
        self, normal_speed: Float[Array, "..."], count: int
    ) -> Float[Array, "powers ..."]:
        """Means of (1 - eps)^k over the impacts at a speed, for k from 0 to `count`, shape (count +
        1, ...). Here all impacts at a speed have the same eps."""
        loss = self.loss(normal_speed)
        return jnp.stack([loss**0 * 1.0, loss, *(loss**k for k in range(2, count + 1))])

    def impact_length(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Length scale of the overlap in diameters, ``X = (v^2/alpha)^(2/5)``.

        It is zero for hard spheres, which is the default. Arguments: see `restitution`.
        """
        return jnp.zeros_like(normal_speed)

    def dissipation(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Dissipation ``beta = (3/2) A alpha^(2/5) v^(1/5)``; 0 if spheres are not viscoelastic."""
        return jnp.zeros_like(normal_speed)


class ScaledLaw(ReducedLaw):
    """A law that depends on the speed alone, in units of a reference speed.

    Attributes:
        law: law of restitution, a function of the speed in m/s.
        speed: the reference speed, m/s.
    """

    law: RestitutionLaw
    speed: Float[Array, ""]

    def restitution(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        values = self.law.restitution(normal_speed * self.speed)
        return jnp.broadcast_to(values, jnp.shape(normal_speed))

    def loss(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        values = self.law.loss(normal_speed * self.speed)
        return jnp.broadcast_to(values, jnp.shape(normal_speed))


def check_reduced_units(law: RestitutionLaw) -> None:
    """Check, once for each class of laws, that `reduced` returns a law in the given units.

    Raises:
        ValueError: if it does not return a `ReducedLaw`, or if eps depends on the units.
    """
    cls = type(law)
    built_in = cls.__module__.startswith(f"{__package__}.")  # checked by tests
    default = cls.reduced is RestitutionLaw.reduced
    if built_in or default or cls in _CHECKED_CLASSES or any_traced(law):
        return
    values = []
    with jax.ensure_compile_time_eval():
        for unit in (0.1, 1.0):
            reduced = law.reduced(diameter=1e-3, mass=1e-6, speed=jnp.asarray(unit))
            if not isinstance(reduced, ReducedLaw):
                raise ValueError(
                    f"{cls.__name__}.reduced must return a jaxgran.extend.ReducedLaw, got "
                    f"{type(reduced).__name__}; {_UNITS_ADVICE}"
                )
            values.append(np.asarray(reduced.restitution(jnp.array([0.03, 0.3]) / unit), float))
    fine, coarse = values
    if np.all(np.isfinite(values)) and np.max(np.abs(fine - coarse)) > 1e-3:
        raise ValueError(
            f"{cls.__name__}.reduced gives eps = {fine[1]:.4g} at 0.3 m/s in units of 0.1 m/s and "
            f"{coarse[1]:.4g} in units of 1 m/s; {_UNITS_ADVICE}"
        )
    _CHECKED_CLASSES.add(cls)


def _number_fields(cls: type) -> list[str]:
    """Names of the fields that a class itself annotates as numbers or arrays."""
    kinds = (float, jax.Array, Array, "float", "jax.Array", "Array")
    return [name for name, kind in inspect.get_annotations(cls).items() if kind in kinds]


C1 = gamma(3 / 5) * sqrt(pi) / (2 ** (1 / 5) * 5 ** (2 / 5) * gamma(21 / 10))
"""First coefficient of the restitution series, 1.153448858; Brilliantov & Poeschel, Eq. (5)."""

C2 = 3 / 5 * C1**2
"""Second coefficient of the restitution series, 0.798266561; Brilliantov & Poeschel, Eq. (6)."""

UNCLIPPED_SERIES = (-C1, C2, -0.522882568, 0.348742675, -0.233098132)
"""Coefficients of beta, beta^2, ... if the contact ends at zero overlap, as in the paper."""

C_CLIP = 4 / 15
"""Coefficient of beta^(5/2), the lowest term that changes if the contact ends at zero force."""


class _RationalFit(NamedTuple):
    # eps = (1 + kappa beta)^(-decay) exp(beta P / Q). The power is the asymptotic decay for heavy
    # damping. P = decay kappa - C1 + beta p(x) and Q = 1 + beta q(x), where x is sqrt(beta) or beta
    # and the coefficients are in ascending order, were fitted to `contact.impact` by
    # experiments/accuracy/derive_coefficients.py. There is no odd power of sqrt(beta) below the
    # beta^(5/2) of the series; hence the first two derivatives at beta = 0 are finite.
    kappa: float
    decay: float
    in_sqrt_beta: bool
    p: tuple[float, ...]
    q: tuple[float, ...]


# fmt: off
_CLIPPED = _RationalFit(kappa=0.7, decay=5 / 3, in_sqrt_beta=True,
    p=(-0.2645544275974496, 0.2662489993348014, -0.13891254348909338, 0.056252769400273614,
       -0.06687792761144479, -0.026658507899730673, -0.0007599914400559866),
    q=(0.8100120942728318, 0.0, 0.34839933904496506, 0.18475467752620237, 0.39206416580007863,
       0.3897068203711826, 0.22360126211067868, 0.08224151259197285, 0.002344580847926078))
_UNCLIPPED = _RationalFit(kappa=0.7, decay=5.0, in_sqrt_beta=False,
    p=(-2.1330761561766067, 0.8581838820848968, -0.14743926285178546, -0.019055706594629386,
       0.02292264625997086, -0.009161977151659381, 0.0024213697097119936, -0.00040636956570282444,
       3.687239511277726e-05, -5.992074134500146e-07),
    q=(-0.4436713336028546, -0.036043841852944625, 0.11564821628375116, -0.056701740443611134,
       0.021178496954814743, -0.007677437237806214, 0.003027939339635816, -0.0010554851332044285,
       0.0002841019235579368, -4.832580251405117e-05, 4.198243276201555e-06))
# fmt: on


def _polynomial(coefficients: tuple[float, ...], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Polynomial in x with coefficients in ascending order."""
    return jnp.polyval(jnp.asarray(coefficients[::-1], x.dtype), x, unroll=len(coefficients))


def log_viscoelastic_restitution(beta: ArrayLike, *, clipped: bool = True) -> Float[Array, "..."]:
    """Natural logarithm of `viscoelastic_restitution`, accurate also for eps close to 1.

    Arguments and validity: see `viscoelastic_restitution`.
    """
    beta = jnp.asarray(beta, dtype=jnp.result_type(float, beta))
    fit = _CLIPPED if clipped else _UNCLIPPED
    positive = beta > 0
    # The derivative of sqrt at 0 is infinite: replace the argument there, not only the result.
    root = jnp.where(positive, jnp.sqrt(jnp.where(positive, beta, 1.0)), 0.0)
    x = root if fit.in_sqrt_beta else beta
    p = (fit.decay * fit.kappa - C1) + beta * _polynomial(fit.p, x)
    q = 1 + beta * _polynomial(fit.q, x)
    return beta * p / q - fit.decay * jnp.log1p(fit.kappa * beta)


def viscoelastic_restitution(beta: ArrayLike, *, clipped: bool = True) -> Float[Array, "..."]:
    """Coefficient of restitution of viscoelastic spheres, by a rational fit to `jaxgran.impact`.

    ``eps = 1 - C1 beta + C2 beta^2 + (4/15) beta^(5/2) - ...`` (the last term only if clipped);
    ``eps -> (3/2)^(2/3) beta^(-5/3)`` (clipped) or ``5.158 beta^(-5)`` for heavy damping.

    Args:
        beta: ``(3/2) A alpha^(2/5) v^(1/5)``, dimensionless, >= 0, any shape.
        clipped: whether the contact ends at zero force (True, the default) or at zero overlap.

    Returns:
        eps, in (0, 1], same shape. Relative error against `jaxgran.impact`: below 1e-9 for beta
        up to 1e4 (clipped) and below 1e-7 for beta up to 40 (unclipped); below 3e-5 for larger
        beta. The first two derivatives are finite down to beta = 0, where the first is -C1.

    Raises:
        ValueError: for a negative beta, unless it is traced.

    Reference: Brilliantov & Poeschel, Self-diffusion in granular gases, Eqs. (4)-(6).

    >>> restitution = jaxgran.viscoelastic_restitution(jnp.array([0.0, 0.1, 1.0]))
    >>> [round(float(eps), 4) for eps in restitution]
    [1.0, 0.8929, 0.3939]
    """
    NON_NEGATIVE.check("beta", beta, "It is (3/2) A alpha^(2/5) v^(1/5).")
    return jnp.exp(log_viscoelastic_restitution(beta, clipped=clipped))


VISCOELASTIC_EXPONENT = 0.2
"""Exponent of the speed in beta."""


class ReducedViscoelastic(ReducedLaw):
    """`Viscoelastic` in reduced units.

    Attributes:
        beta: dissipation ``(3/2) A alpha^(2/5) v^(1/5)`` at the reference speed.
        length: length ``(v^2/alpha)^(2/5)`` at the reference speed, in diameters.
        clipped: see `Viscoelastic`.
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
        return self.beta * normal_speed**VISCOELASTIC_EXPONENT


class Viscoelastic(RestitutionLaw):
    """Viscoelastic spheres, with the force ``F = rho xi^(3/2) + (3/2) A rho sqrt(xi) xi_dot``.

    Args:
        youngs_modulus: Y, Pa, > 0.
        poisson_ratio: nu, in (-1, 0.5).
        dissipative_constant: A, s, >= 0; 0 makes the spheres elastic.
        clipped: whether the contact ends at zero force (True: spheres without adhesion cannot
            pull) or at zero overlap (False: the convention of the paper's series).

    Raises:
        ValueError: for a value outside its range.

    The law is valid for impacts that are slow enough to leave no plastic deformation and fast
    enough for adhesion to be negligible.

    Reference: Brilliantov & Poeschel, Self-diffusion in granular gases, Eqs. (1)-(2).

    >>> glass = jaxgran.Viscoelastic(5e7, poisson_ratio=0.22, dissipative_constant=3e-6)
    >>> f"{float(glass.dissipative_constant):g} s"
    '3e-06 s'
    """

    youngs_modulus: Float[Array, ""] = eqx.field(converter=number_named("youngs_modulus"))
    poisson_ratio: Float[Array, ""] = eqx.field(converter=number_named("poisson_ratio"))
    dissipative_constant: Float[Array, ""] = eqx.field(
        converter=number_named("dissipative_constant")
    )
    clipped: bool = eqx.field(static=True, default=True)

    domains: ClassVar[dict[str, Domain]] = domains_of("Viscoelastic")
    advice: ClassVar[dict[str, str]] = ADVICE

    def __check_init__(self):
        check_bool(clipped=self.clipped)

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
        """Return the law of two spheres that collide as a sphere and a flat wall of this material.

        The effective radius and mass are twice as large for a sphere and a wall as for two spheres,
        so that ``alpha``, proportional to ``Y sqrt(R_eff)/m_eff``, is smaller by a factor sqrt(2).
        """
        return eqx.tree_at(lambda law: law.youngs_modulus, self, self.youngs_modulus / 2**0.5)

    def on_wall(
        self, *, diameter: ArrayLike, mass: ArrayLike, speed: ArrayLike
    ) -> ReducedViscoelastic:
        return self.of_wall().reduced(diameter=diameter, mass=mass, speed=speed)


VARIANT_SPEED = 0.1
"""Normal speed at which a `ViscoelasticVariant` has the eps of the viscoelastic law, m/s."""


class ReducedVariant(ReducedViscoelastic):
    """`ViscoelasticVariant` in reduced units.

    Attributes:
        exponent: of the speed in beta.
        spread: standard deviation of eps before it is clipped.
    """

    exponent: Float[Array, ""]
    spread: Float[Array, ""]

    def dissipation(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.beta * normal_speed**self.exponent

    def loss_powers(
        self, normal_speed: Float[Array, "..."], count: int
    ) -> Float[Array, "powers ..."]:
        # Moments of the positive part of a normal distribution, by partial integration.
        mean = self.loss(normal_speed)
        has_spread = self.spread > 0
        width = jnp.where(has_spread, self.spread, 1.0)
        ratio = mean / width
        share = jnp.where(has_spread, jax.scipy.stats.norm.cdf(ratio), 1.0)
        density = jnp.where(has_spread, width * jax.scipy.stats.norm.pdf(ratio), 0.0)
        square = jnp.where(has_spread, width**2, 0.0)
        powers = [share, mean * share + density]
        for k in range(2, count + 1):
            powers.append(mean * powers[-1] + (k - 1) * square * powers[-2])
        return jnp.stack([jnp.ones_like(mean), *powers[1:]])


class ViscoelasticVariant(Viscoelastic):
    """Viscoelastic spheres, or spheres of another law: an alternative explanation of a curve.

    ``beta = (3/2) A alpha^(2/5) v_0^(1/5) (v/v_0)^exponent`` at the normal speed v, with v_0 = .1
    m/s: 1/5 is the viscoelastic law, 0 a constant eps. In each impact an independent normal deviate
    of standard deviation `spread` is added to eps(v); sums above 1 become 1.
    """

    exponent: Float[Array, ""] = eqx.field(converter=float_array, default=VISCOELASTIC_EXPONENT)
    spread: Float[Array, ""] = eqx.field(converter=float_array, default=0.0)

    domains: ClassVar[dict[str, Domain]] = Viscoelastic.domains | {
        "exponent": Domain(),
        "spread": NON_NEGATIVE,
    }

    @classmethod
    def from_law(cls, law: Viscoelastic) -> "ViscoelasticVariant":
        """Return a variant that is a given law."""
        return cls(**{f.name: getattr(law, f.name) for f in dataclasses.fields(Viscoelastic)})

    def reduced(
        self, *, diameter: ArrayLike, mass: ArrayLike, speed: ArrayLike
    ) -> ReducedViscoelastic:
        known = super().reduced(diameter=diameter, mass=mass, speed=speed)
        steeper = (speed / VARIANT_SPEED) ** (self.exponent - VISCOELASTIC_EXPONENT)
        beta = known.beta * steeper
        return ReducedVariant(beta, known.length, known.clipped, self.exponent, self.spread)


class ConstantRestitution(RestitutionLaw, ReducedLaw):
    """Constant coefficient of restitution, as in Haff's law.

    Args:
        coefficient: e, in [0, 1].

    Raises:
        ValueError: for e outside [0, 1].

    >>> grains = jaxgran.ConstantRestitution(0.9)
    >>> round(float(gas.replace(temperature=1.0).restitution(0.1)), 4), float(grains.coefficient)
    (0.9076, 0.9)
    """

    coefficient: Float[Array, ""] = eqx.field(converter=number_named("coefficient"))

    domains: ClassVar[dict[str, Domain]] = domains_of("ConstantRestitution")
    advice: ClassVar[dict[str, str]] = ADVICE

    def reduced(self, *, diameter: ArrayLike, mass: ArrayLike, speed: ArrayLike) -> ReducedLaw:
        return self

    def restitution(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.broadcast_to(self.coefficient, normal_speed.shape)


class RestitutionSeries(RestitutionLaw, ReducedLaw):
    """Series in powers of the speed, ``eps(v) = 1 + sum_k c_k v^(gamma_k)``, v in m/s.

    The series is not restricted to [0, 1]: check that eps is physical for the normal speeds of
    the gas, up to about five times sqrt(2 T).

    Args:
        coefficients: c_k, (m/s)^(-gamma_k), shape (terms,).
        exponents: gamma_k, shape (terms,).

    Raises:
        ValueError: for different shapes, or values that are not finite.

    >>> law = jaxgran.RestitutionSeries(coefficients=[-0.1], exponents=[0.2])  # 1 - .1 v^(1/5)
    >>> law.coefficients.shape
    (1,)
    """

    coefficients: Float[Array, "terms"] = eqx.field(converter=number_named("coefficients"))
    exponents: Float[Array, "terms"] = eqx.field(converter=number_named("exponents"))

    domains: ClassVar[dict[str, Domain]] = {"coefficients": ANY, "exponents": ANY}
    lists: ClassVar[tuple[str, ...]] = ("coefficients", "exponents")

    def __check_init__(self):
        shape = self.coefficients.shape
        if shape != self.exponents.shape or self.coefficients.ndim < 1 or shape[-1] < 1:
            raise ValueError(
                "coefficients and exponents must be lists of the same length, 1 or more, got "
                f"the shapes {shape} and {self.exponents.shape}"
            )

    @classmethod
    def from_viscoelastic(
        cls, law: Viscoelastic, *, diameter: ArrayLike, mass: ArrayLike, num_terms: int = 2
    ) -> "RestitutionSeries":
        """Return the truncated series in powers of beta of given viscoelastic spheres.

        Args:
            law: the material.
            diameter: sigma, m, > 0.
            mass: m, kg, > 0, of either sphere.
            num_terms: number of powers of beta, 1 to 5; the paper has 2.

        Raises:
            ValueError: if num_terms is not 1 to 5.

        Reference: Brilliantov & Poeschel, Self-diffusion in granular gases, Eq. (1).
        """
        if not 1 <= num_terms <= len(UNCLIPPED_SERIES):
            raise ValueError(
                f"num_terms must be 1 to {len(UNCLIPPED_SERIES)}, got {num_terms}. "
                "For more accuracy use the Viscoelastic law itself."
            )
        beta = law.reduced(diameter=diameter, mass=mass, speed=1.0).beta
        powers = jnp.arange(1, num_terms + 1)
        return cls(jnp.asarray(UNCLIPPED_SERIES[:num_terms]) * beta**powers, powers / 5)

    def reduced(self, *, diameter: ArrayLike, mass: ArrayLike, speed: ArrayLike) -> ReducedLaw:
        return RestitutionSeries(self.coefficients * speed**self.exponents, self.exponents)

    def restitution(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        return 1 - self.loss(normal_speed)

    def loss(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        terms = zip(self.coefficients, self.exponents, strict=True)
        return jnp.asarray(-sum(c * normal_speed**gamma for c, gamma in terms))


SHARE_ERROR = 3.0
"""Standard deviation of the logarithms of the drops of a `RestitutionSpline` in fits."""


class RestitutionSpline(RestitutionLaw):
    """Law without a formula: a monotone curve through values of eps at given speeds.

    ``eps(v) = exp(-L(v))``, where L is a monotone cubic spline of ln v (Fritsch & Butland) and a
    straight line outside the knots, down to L = 0. L increases with v: eps decreases, and stays in
    (0, 1]. The parameters are ``drops``: L at the first knot, and its increments from each knot to
    the next.

    In fits ``p = (dL/d ln v)/L_last``, with L at the last knot, has a smoothness prior: over a
    factor of ten in v it changes by `smoothness` (one standard deviation of a random walk), since a
    curve T(t) averages over speeds. Viscoelastic spheres have p = 1/5 at the last knot and .13 at a
    tenth of its speed, a constant eps has p = 0. A wide prior keeps those drops finite that the
    data do not see: ``ln(drop/L_last)`` has its mean where ``L ~ v^(1/5)``, and a standard
    deviation of 3.

    Args:
        speeds: knots, normal approach speeds, m/s, > 0, increasing, two or more;
            `visited_speeds` gives the range that a measured curve determines.
        values: eps at the knots, in (0, 1], not increasing; by default from
            ``L = 0.1 (v/v_last)^(1/5)``. A fit begins with a multiple of this L that cools as the
            curve does.
        smoothness: standard deviation of p over a factor of ten in v, > 0.

    Raises:
        ValueError: for speeds that do not increase or values that increase.

    Reference: Fritsch & Butland, SIAM J. Sci. Stat. Comput. 5, 300 (1984).

    >>> law = jaxgran.RestitutionSpline([1e-3, 1e-2, 1e-1], [0.97, 0.95, 0.92])
    >>> round(float(law.restitution(jnp.asarray(1e-2))), 6)
    0.95
    >>> low, high = jaxgran.RestitutionSpline.visited_speeds(curve.temperature)
    >>> f"{low:.2g} to {high:.2g} m/s"
    '0.027 to 0.39 m/s'
    """

    speeds: Float[Array, "knots"]
    drops: Float[Array, "knots"]
    smoothness: float = eqx.field(static=True)

    domains: ClassVar[dict[str, Domain]] = {"drops": NON_NEGATIVE}
    lists: ClassVar[tuple[str, ...]] = ("drops",)
    constants: ClassVar[tuple[str, ...]] = ("speeds",)

    def __init__(
        self,
        speeds: UserNumber,
        values: UserNumber | None = None,
        smoothness: float = 0.3,
    ):
        self.speeds = float_array(speeds, "speeds")
        knots = np.asarray(self.speeds, float)
        if knots.ndim != 1 or knots.size < 2 or np.any(np.diff(knots) <= 0) or knots[0] <= 0:
            raise ValueError(f"speeds must be two or more increasing numbers > 0, got {speeds!r}")
        self.smoothness = checked_float("smoothness", smoothness, POSITIVE)
        default = np.exp(-0.1 * np.cumsum(_typical_shares(knots)))
        eps = float_array(default if values is None else values, "values")
        drops = -jnp.diff(jnp.log(eps), prepend=0.0)
        if drops.shape != knots.shape or not any_traced(drops) and not np.all(drops >= 0):
            raise ValueError(
                f"values must be {knots.size} numbers in (0, 1], one for each speed, that do not "
                f"increase with the speed, got {values!r}"
            )
        self.drops = drops

    @staticmethod
    def visited_speeds(temperature: ArrayLike) -> tuple[float, float]:
        """Return the range of normal impact speeds, m/s, that determines how a gas cools.

        At one temperature the speeds v of impacts are distributed as ``v exp(-v^2/(4 T))`` and
        their losses as ``v^3 exp(-v^2/(4 T))``. The range is from the 5 % quantile of the losses at
        the lowest T to the 95 % quantile at the highest.

        Args:
            temperature: all T of a curve, m^2/s^2, > 0.
        """
        T = np.asarray(temperature)
        T = T[T > 0]
        low, high = 2 * np.sqrt(np.array([0.35536, 4.74386]) * [T.min(), T.max()])
        return float(low), float(high)

    def prior_residuals(self) -> Float[Array, "residuals"]:
        x = jnp.log(self.speeds)
        decades = (x[2:] - x[:-2]) / (2 * np.log(10))
        shares = self.drops / jnp.sum(self.drops)
        slopes = shares[1:] / jnp.diff(x)
        smooth = jnp.diff(slopes) / (self.smoothness * jnp.sqrt(decades))
        unusual = jnp.log(shares / _typical_shares(self.speeds)) / SHARE_ERROR
        return jnp.concatenate([smooth, unusual])

    def restitution(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        return 1 - self.loss(normal_speed)

    def loss(self, normal_speed: Float[Array, "..."]) -> Float[Array, "..."]:
        x = jnp.log(self.speeds)
        y = jnp.cumsum(self.drops)
        width = jnp.diff(x)
        slope = jnp.diff(y) / width
        # Weighted harmonic means of the slopes on both sides, 0 where one of them is.
        left = width[:-1] + 2 * width[1:]
        right = 2 * width[:-1] + width[1:]
        sums = left * slope[1:] + right * slope[:-1]
        products = (left + right) * slope[1:] * slope[:-1]
        inner = products / jnp.where(sums > 0, sums, 1.0)
        at_knots = jnp.concatenate([slope[:1], inner, slope[-1:]])
        log_speed = jnp.log(jnp.maximum(normal_speed, jnp.finfo(y.dtype).tiny))
        inside = jnp.clip(log_speed, x[0], x[-1])
        i = jnp.searchsorted(x[1:-1], inside)
        h = width[i]
        t = (inside - x[i]) / h
        first = at_knots[i]
        last = at_knots[i + 1]
        cubic = first + last - 2 * slope[i]
        value = y[i] + h * t * (first + t * (slope[i] - first - (1 - t) * cubic))
        outside = jnp.where(log_speed <= x[0], at_knots[0], at_knots[-1]) * (log_speed - inside)
        log_loss = value + outside
        # jnp.maximum would halve the slope where eps is 1.
        return -jnp.expm1(-jnp.where(log_loss < 0, 0.0, log_loss))


def _typical_shares(speeds: Any) -> Any:
    """Return the drops of ``L = (v/v_last)^(1/5)`` at some speeds."""
    xp = jnp if isinstance(speeds, jax.Array) else np
    return xp.diff((speeds / speeds[-1]) ** 0.2, prepend=0.0)


def mean_loss(law: ReducedLaw, like: Float[Array, ""]) -> Float[Array, ""]:
    """Mean loss ``I = <1 - eps^2>``, weighted by the energy of the normal motion.

    Args:
        law: law of restitution; the average is taken at its reference speed.
        like: a number whose dtype the result has.
    """

    def weighted_loss(g: Array) -> Array:
        loss = law.loss(g)
        return g**2 / 2 * loss * (2 - loss)

    return impact_average(weighted_loss, like)
