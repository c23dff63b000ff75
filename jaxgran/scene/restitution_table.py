"""Coefficient of restitution of viscoelastic spheres: its series and a rational fit to it."""

from math import gamma, pi, sqrt
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxgran.checks.validation import NOT_NEGATIVE

C1 = gamma(3 / 5) * sqrt(pi) / (2 ** (1 / 5) * 5 ** (2 / 5) * gamma(21 / 10))
"""First coefficient of the restitution series, 1.153448858; Brilliantov & Poeschel, Eq. (5)."""

C2 = 3 / 5 * C1**2
"""Second coefficient of the restitution series, 0.798266561; Brilliantov & Poeschel, Eq. (6)."""

UNCLIPPED_SERIES = (-C1, C2, -0.522882568, 0.348742675, -0.233098132)
"""Coefficients of beta, beta^2, ... if contact ends at zero overlap, the paper's convention."""

C_CLIP = 4 / 15
"""Coefficient of beta^(5/2), the lowest term that changes if contact ends at zero force."""


class _RationalFit(NamedTuple):
    # eps = (1 + kappa beta)^(-decay) exp(beta P / Q). The power is the asymptotic decay for heavy
    # damping. P = decay kappa - C1 + beta p(x) and Q = 1 + beta q(x), with x = sqrt(beta) or
    # x = beta and coefficients in ascending order, were fitted to `contact.impact` by
    # experiments/accuracy/derive_restitution.py. There is no odd power of sqrt(beta) below the
    # beta^(5/2) of the series, so that the first two derivatives at beta = 0 are finite.
    kappa: float
    decay: float
    in_sqrt_beta: bool
    p: tuple[float, ...]
    q: tuple[float, ...]


_CLIPPED = _RationalFit(
    kappa=0.7,
    decay=5 / 3,
    in_sqrt_beta=True,
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

_UNCLIPPED = _RationalFit(
    kappa=0.7,
    decay=5.0,
    in_sqrt_beta=False,
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


def _polynomial(coefficients: tuple[float, ...], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Polynomial in x with coefficients in ascending order."""
    return jnp.polyval(jnp.asarray(coefficients[::-1], x.dtype), x, unroll=len(coefficients))


def log_viscoelastic_restitution(beta: ArrayLike, *, clipped: bool = True) -> Float[Array, "..."]:
    """Natural logarithm of `viscoelastic_restitution`, accurate also where eps is close to 1.

    Args, validity: as `viscoelastic_restitution`.
    """
    beta = jnp.asarray(beta, dtype=jnp.result_type(float, beta))
    fit = _CLIPPED if clipped else _UNCLIPPED
    positive = beta > 0
    # The derivative of sqrt at 0 is infinite: its argument is replaced there, not only its result.
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
        clipped: whether contact ends where the force vanishes (default) or where the overlap does.

    Returns:
        eps, in (0, 1], same shape. Relative error against `jaxgran.impact`: below 1e-9 for beta
        up to 1e4 (clipped) and below 1e-7 for beta up to 40 (unclipped); below 3e-5 beyond. The
        first two derivatives are finite down to beta = 0, where the first is -C1.

    Reference: Brilliantov & Poeschel, Self-diffusion in granular gases, Eqs. (4)-(6).

    >>> found = jaxgran.viscoelastic_restitution(jnp.array([0.0, 0.1, 1.0]))
    >>> [round(float(eps), 4) for eps in found]
    [1.0, 0.8929, 0.3939]
    """
    NOT_NEGATIVE.check("beta", beta, "It is (3/2) A alpha^(2/5) v^(1/5).")
    return jnp.exp(log_viscoelastic_restitution(beta, clipped=clipped))
