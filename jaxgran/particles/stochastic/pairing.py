"""Which pairs of particles are drawn in a step of DSMC."""

from functools import cache
from math import gcd, pi, sqrt
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, UInt

from jaxgran.scene.geometry import sphere_surface

CEILING = 5.0
"""Relative speed, in sqrt(2 T), up to which the collision rate is right; beyond, it is constant.

A Maxwellian gas misses 2e-6 of its collisions by this, and 1e-5 of its losses. A run counts what it
misses.
"""


class Scheme(NamedTuple):
    """Static sizes of one step.

    Attributes:
        dimension: d.
        num_particles: N.
        first: number of disjoint random pairs.
        second: number of pairs that are formed next, of a particle of a first pair and a new one.
    """

    dimension: int
    num_particles: int
    first: int
    second: int

    @classmethod
    def of(cls, dimension: int, num_particles: int, step: float) -> "Scheme":
        """The scheme with so many collisions per particle and step.

        Were M pairs drawn one after the other with replacement, ``2 M (M - 1) / N`` of them would
        on average share a particle with an earlier pair. The scheme has as many of these, which
        makes the step second order.
        """
        accepted = sphere_surface(dimension) / sqrt(2 * pi) / (2 ** (dimension - 1) * CEILING)
        pairs = max(round(step * num_particles / (2 * accepted)), 1)
        second = round(2 * pairs * (pairs - 1) / num_particles)
        return cls(dimension, num_particles, pairs - second, second)

    @property
    def own_step(self) -> float:
        """``dt sqrt(T/T_0)`` of a step, in which each particle meets the N - 1 others alike."""
        candidates = 2 * (self.first + self.second) / (self.num_particles - 1)
        return candidates / (2 ** (self.dimension - 1) * CEILING)


@cache
def _strides(num_particles: int) -> np.ndarray:
    """Numbers coprime to N that are so small that their product with N fits into 32 bits."""
    top = min(num_particles, 2**32 // num_particles - 1)
    return np.array([s for s in range(1, max(top, 2)) if gcd(s, num_particles) == 1], np.uint32)


def draw(
    bits: UInt[Array, "4"], scheme: Scheme
) -> tuple[Int[Array, "first"], Int[Array, "first"], Int[Array, "second"]]:
    """Indices of the particles of the first pairs, and of the new particles of the second pairs.

    Since particles are exchangeable, evenly spaced indices will do, as long as any two particles
    meet with about the same probability: the first particles of the pairs are a + s l for random a
    and s, their partners stand a random number of places further on. Every particle is drawn with
    the same probability. Every pair is, too, if N is prime. Else pairs whose distance shares a
    large divisor with N (one in a hundred at N = 1000) are up to 1.7 times as likely, and the
    probabilities scatter by 6 % (14 % at N = 64).
    """
    n, first, second = scheme.num_particles, scheme.first, scheme.second
    strides = jnp.asarray(_strides(n))
    stride = strides[bits[0] % len(strides)]
    apart = first + second + bits[1] % (n - 2 * first - second + 1)

    def particle(place):
        return ((bits[2] % n + stride * place) % n).astype(jnp.int32)

    place = jnp.arange(first, dtype=jnp.uint32)
    # The new ones stand in between, also at a random distance.
    fresh = first + bits[3] % (apart - (first + second) + 1) + jnp.arange(second, dtype=jnp.uint32)
    return particle(place), particle(place + apart), particle(fresh)
