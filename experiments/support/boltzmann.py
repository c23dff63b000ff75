"""The homogeneous Boltzmann equation by random collisions, in NumPy, without jaxgran's code.

An event pairs two random blocks of spheres, sphere by sphere. A pair collides along a random unit
vector with probability |g|/g_max, where g is its normal speed. Only some thousandth of the gas
takes part in one event, so that time is continuous to that order.
"""

from collections.abc import Callable
from math import gamma, pi
from typing import NamedTuple

import numpy as np

BLOCK = 4096
FASTEST = 6.5
"""g_max in units of sqrt(T): 4e-6 of pairs of a Maxwellian gas are faster."""

POOL = 1 << 18
"""Number of unit vectors and random numbers drawn at once; reads start at random places."""

RENEWED = 512
"""Number of events after which these numbers are replaced."""


class Moments(NamedTuple):
    """Moments at one time: T over its initial value, a_2, a_3, D n sigma^(d-1)/sqrt(2 T)."""

    temperature: float
    sonine: float
    third_sonine: float
    diffusion: float


class Boltzmann:
    """A gas of mass 1 and n sigma^(d-1) = 1 with T = 1 at the start.

    Attributes:
        collisions: per sphere.
        time: t in units of 1/(n sigma^(d-1) sqrt(T_0)).
    """

    def __init__(
        self, restitution: float | Callable[[np.ndarray], np.ndarray], d: int, blocks: int, seed=0
    ):
        """Args: eps, or a function of the normal speed; d; number of blocks; seed."""
        self.rng = np.random.Generator(np.random.SFC64(seed))
        self.restitution, self.d, self.n = restitution, d, blocks * BLOCK
        self.velocity = self.rng.standard_normal((blocks, d, BLOCK), dtype=np.float32)
        self.scale, self.collisions, self.time, self.events = 1.0, 0.0, 0.0, 0
        self._rescale(first=True)
        self.since = 0.0  # scaled time during which spheres move at their current velocities
        self.moved = np.zeros_like(self.velocity)
        surface = 2 * pi ** (d / 2) / gamma(d / 2)
        self.step = 4 * BLOCK / (self.n * FASTEST * surface)

    def run(self, collisions: float) -> None:
        """Continue for the given number of collisions per sphere."""
        end = self.collisions + collisions
        while self.collisions < end:
            hits = 0
            # T falls by some per cent between rescalings.
            while hits < 0.1 * self.n and self.collisions + hits / self.n < end:
                hits += 2 * self._event()
                self.since += self.step
            self.time += self.since / self.scale
            self.collisions += hits / self.n
            self.moved += self.since * self.velocity
            self.since = 0.0
            self._rescale()

    def forget(self) -> None:
        """Reset the displacements."""
        self.moved[:] = 0

    @property
    def moments(self) -> Moments:
        """Return the moments at the end of a run."""
        d, square = self.d, np.sum(self.velocity.astype(float) ** 2, axis=1)
        mean = np.mean(square)
        square *= d / mean
        a2 = float(np.mean(square**2) / (d * (d + 2)) - 1)
        a3 = float(1 + 3 * a2 - np.mean(square**3) / (d * (d + 2) * (d + 4)))
        product = np.einsum("bdi,bdi->", self.velocity, self.moved, dtype=float) / self.n
        return Moments(self.scale**2 * mean / d, a2, a3, float(product) / d / (2 * mean / d) ** 0.5)

    def _rescale(self, first: bool = False) -> None:
        self.velocity -= np.mean(self.velocity, axis=(0, 2), dtype=float)[:, None]
        root = np.mean(self.velocity.astype(float) ** 2) ** 0.5
        self.velocity /= root
        self.scale *= 1.0 if first else float(root)

    def _event(self) -> int:
        if self.events % RENEWED == 0:
            self._renew()
        self.events += 1
        i, j = self.rng.choice(len(self.velocity), 2, replace=False)
        shift, at = self.rng.integers(BLOCK), self.rng.integers(POOL - BLOCK)
        normal, chance = self.normals[:, at : at + BLOCK], self.chances[at : at + BLOCK]
        other = np.roll(self.velocity[j], shift, axis=1)
        speed = np.einsum("di,di->i", self.velocity[i] - other, normal)
        hit = np.abs(speed) > FASTEST * chance
        eps = self.restitution
        if callable(eps):
            eps = eps(np.abs(speed) * np.float32(self.scale))
        kick = (hit * speed * ((1 + eps) / 2)).astype(np.float32) * normal
        self.velocity[i] -= kick
        self.velocity[j] += np.roll(kick, -shift, axis=1)
        kick *= np.float32(self.since)
        self.moved[i] += kick
        self.moved[j] -= np.roll(kick, -shift, axis=1)
        return int(np.count_nonzero(hit))

    def _renew(self) -> None:
        normals = self.rng.standard_normal((self.d, POOL), dtype=np.float32)
        self.normals = normals / np.sqrt(np.sum(normals**2, axis=0))
        self.chances = self.rng.random(POOL, dtype=np.float32)
