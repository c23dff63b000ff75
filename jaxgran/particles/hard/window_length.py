"""How long windows are, so that each has a wanted number of impacts."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

MIN_IMPACTS = 10
"""Smallest number of impacts of two spheres that a window should have, in all replicas together."""

FIRST_WINDOW = 0.125
"""Length of the first window, over that with the wanted impacts at the rate of a gas.

It is short, as many spheres are near contact at random positions.
"""

WINDOW_EXPONENT = 0.3
"""Damping exponent of the controller.

The length changes by ``(wanted / executed impacts)^0.3``, as the number of impacts scatters.
"""

MIN_CHANGE, MAX_CHANGE = 0.5, 1.5
"""Least and largest ratio of the lengths of two successive windows."""


def longest_window(num_impacts: float) -> float:
    """Return the longest window of a run over the mean one.

    It follows a window whose number of impacts is two standard deviations too small.

    Args:
        num_impacts: mean number of impacts in a window, >= `MIN_IMPACTS`.
    """
    fewest = num_impacts - 2 * num_impacts**0.5
    return (num_impacts / fewest) ** WINDOW_EXPONENT


class WindowController(NamedTuple):
    """Chooses the lengths of windows by the number of impacts in the last one.

    Impacts are counted for each sphere: an impact of two spheres counts twice, an impact on a wall
    once.

    Attributes:
        share: wanted impacts of a sphere in a window.
        num_spheres: number of spheres in all replicas.
    """

    share: float
    num_spheres: int

    def first(self, frequency: Float[Array, ""]) -> Float[Array, ""]:
        """Return the length of the first window.

        Args:
            frequency: of the impacts of a sphere.
        """
        return FIRST_WINDOW * self.share / frequency

    def after(
        self, length: Float[Array, ""], duration: Float[Array, ""], num_impacts: Int[Array, ""]
    ) -> Float[Array, ""]:
        """Return the length of the next window.

        Args:
            length: of the last window, as this controller chose it.
            duration: of the last window, which an end or a drive may have shortened.
            num_impacts: in the last window.
        """
        wanted = max(self.share * self.num_spheres, 2 * MIN_IMPACTS)
        executed = jnp.maximum(num_impacts, 2).astype(length.dtype)
        ratio = (wanted / executed) ** WINDOW_EXPONENT
        ratio = jnp.clip(ratio, MIN_CHANGE, MAX_CHANGE)
        # The last, short window before an end says nothing about the rate of impacts.
        is_full = duration > 0.5 * length
        return jnp.where(is_full, duration * ratio, length)
