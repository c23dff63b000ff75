"""The state of a homogeneous gas: T, a_2, a_3, D, <dr^2>, collisions and the moments of spins."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Moments(NamedTuple):
    """State of a homogeneous gas, in variables that stay of order one while T falls by decades.

    Attributes:
        log_temperature: ln(T/T_0).
        sonine: a_2.
        collisions: number of collisions per particle.
        diffusion: D / sqrt(T/T_0), which cooling does not shrink; None where it is not asked for.
        displacement: <dr^2>; None likewise.
        third_sonine: a_3; None at order 2.
        diffusion_shape: ``<S_1(c^2) v.dr>/d`` over sqrt(T/T_0), S_1 = d/2 + 1 - c^2; None at
            order 2.
        rotation: T_rot/T of rough spheres; None for smooth spheres.
        spin_correlation: T_rot/T times ``a_11 = <v^2 w^2>/(<v^2> <w^2>) - 1``; None for smooth
            spheres and Gaussian spins.
        spin_kurtosis: (T_rot/T)^2 times ``a_02 = d_rot/(d_rot + 2) <w^4>/<w^2>^2 - 1``. Both
            products stay finite where the spins begin at 0.
        size_ratio: ``q = ln(T_1/T_2)`` of small and large spheres, see `jaxgran.theory.sizes`; None
            for equal ones.
    """

    log_temperature: Float[Array, "..."]
    sonine: Float[Array, "..."]
    collisions: Float[Array, "..."]
    diffusion: Float[Array, "..."] | None = None
    displacement: Float[Array, "..."] | None = None
    third_sonine: Float[Array, "..."] | None = None
    diffusion_shape: Float[Array, "..."] | None = None
    rotation: Float[Array, "..."] | None = None
    spin_correlation: Float[Array, "..."] | None = None
    spin_kurtosis: Float[Array, "..."] | None = None
    size_ratio: Float[Array, "..."] | None = None

    @property
    def spins(self) -> "Spins | None":
        """T_rot/T and the moments of the spins, 0 where they are Gaussian; None if smooth."""
        if self.rotation is None:
            return None
        if self.spin_correlation is None or self.spin_kurtosis is None:
            return Spins.gaussian(self.rotation)
        return Spins(self.rotation, self.spin_correlation, self.spin_kurtosis)


class Spins(NamedTuple):
    """Moments of the spins of rough spheres, or their rates of change: see `Moments`."""

    rotation: Any
    correlation: Any
    kurtosis: Any

    @classmethod
    def gaussian(cls, rotation: Array) -> "Spins":
        """Return the moments of Gaussian spins."""
        return cls(rotation, jnp.zeros_like(rotation), jnp.zeros_like(rotation))

    def damped(self, rate: Any) -> "Spins":
        """Return the rates of change where T_rot decays at a rate."""
        return Spins(-rate * self.rotation, -rate * self.correlation, -2 * rate * self.kurtosis)
