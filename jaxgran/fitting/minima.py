"""Minima of chi^2 besides the deepest one."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran.fitting.parameters import Parameters

AS_GOOD = 9.0
"""Difference of chi^2 up to which two minima count as equally good: three standard errors."""

SEVERAL, ROUGHNESSES = "tangential_restitution", (-0.6, 0.0, 0.6)
"""A parameter in which chi^2 has several minima where T_rot is measured, and where to search."""


def starts(
    parameters: Parameters, first: Float[Array, "p"], beside: Float[Array, "_"]
) -> Float[Array, "starts q"]:
    """Where to search for minima of chi^2: from the first guess and, where beta_t is free, from
    several beta_t. There are minima on both sides of the beta_t at which rotation takes most.

    Args:
        parameters: those of the gas.
        first: the first guess of these.
        beside: further parameters of the search.
    """
    flats = first[None]
    if SEVERAL in parameters.names:
        gas, began = parameters.gas(first), parameters.start(first)
        others = [gas.replace(**{SEVERAL: beta}) for beta in ROUGHNESSES]
        flats = jnp.stack([first, *(parameters.flat(other, began) for other in others)])
    return jnp.concatenate([flats, jnp.tile(beside, (len(flats), 1))], axis=1)


class Minima(NamedTuple):
    """Minima of chi^2 at which searches from several starts ended.

    Attributes:
        estimates: of the free parameters, SI.
        chi2: there, of all residuals, those of priors too.
    """

    estimates: Float[Array, "starts p"]
    chi2: Float[Array, "starts"]

    def as_good(
        self,
        estimate: Float[Array, "p"],
        standard_error: Float[Array, "p"],
        unit: float,
    ) -> Float[np.ndarray, "others p"]:
        """The estimates at minima that are not told from the deepest one: chi^2 is larger by less
        than `AS_GOOD`, and a parameter differs by more than its square root in standard errors.

        Args:
            estimate, standard_error: of the deepest one.
            unit: of chi^2, where errors turned out to be larger than they were said to be.
        """
        chi2 = np.asarray(self.chi2)
        near = chi2 - np.min(chi2) < AS_GOOD * unit
        away = np.asarray(self.estimates) - np.asarray(estimate)
        apart = np.max(np.abs(away) / np.asarray(standard_error), axis=1) > AS_GOOD**0.5
        found: list[np.ndarray] = []
        for other in np.asarray(self.estimates)[near & apart]:
            if not any(np.allclose(other, known, rtol=1e-3) for known in found):
                found.append(other)
        return np.array(found).reshape(-1, away.shape[1])


def minima_in_words(names: tuple[str, ...], others: Float[np.ndarray, "others p"]) -> str | None:
    """A clause about minima that are as good as that of a fit; None if there are none."""
    if not len(others):
        return None
    sets = (
        ", ".join(f"{name} = {value:.3g}" for name, value in zip(names, other, strict=False))
        for other in others
    )
    return f"chi^2 has another minimum as good, at {' and at '.join(sets)}"
