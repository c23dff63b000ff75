"""Are a_2, a_3 and D of kinetic theory those of direct simulation?

    python experiments/accuracy/sonine_coefficients.py [--eps 0.5 0.9 ...] [--particles 200000]

The homogeneous cooling state at constant eps, in two and three dimensions, by a direct simulation
that is written here in NumPy and shares no code with jaxgran. Prints the simulated a_2 and a_3 with
their standard errors, and what kinetic theory differs by.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.scenes import hard_beads

RELAXING, MEASURED = 20, 60  # collisions per particle, before and while a_2 and a_3 are recorded
BLOCKS = 12


def collide(velocity: np.ndarray, eps: float, rng: np.random.Generator) -> int:
    """Random disjoint pairs, which collide with a probability that goes as their normal speed."""
    n, d = velocity.shape
    pairs = rng.permutation(n).reshape(2, -1)
    normal = rng.standard_normal((n // 2, d))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    approach = np.sum((velocity[pairs[0]] - velocity[pairs[1]]) * normal, axis=1)
    normal *= np.sign(approach)[:, None]
    speed = np.abs(approach)
    hit = rng.random(n // 2) * 6.0 < speed  # of a gas of T = 1: 3e-5 of pairs are faster than 6
    kick = ((1 + eps) / 2 * speed[hit])[:, None] * normal[hit]
    velocity[pairs[0][hit]] -= kick
    velocity[pairs[1][hit]] += kick
    return 2 * int(np.sum(hit))


def simulated(d: int, eps: float, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """a_2 and a_3 with their standard errors, from the scatter of blocks."""
    rng = np.random.default_rng(seed)
    velocity = rng.standard_normal((n, d))
    collisions, records, found = 0, [], np.zeros(2)
    while collisions < (RELAXING + MEASURED) * n:
        velocity -= np.mean(velocity, axis=0)
        velocity /= np.sqrt(np.mean(velocity**2))
        before = collisions
        while collisions - before < n // 4:
            collisions += collide(velocity, eps, rng)
        if collisions > RELAXING * n:
            square = np.sum(velocity**2, axis=1)
            square *= d / np.mean(square)
            fourth, sixth = np.mean(square**2) / (d * (d + 2)), np.mean(square**3)
            found = np.array([fourth - 1, 0.0])
            found[1] = 1 + 3 * found[0] - sixth / (d * (d + 2) * (d + 4))
            records.append(found)
    blocks = np.array([np.mean(b, axis=0) for b in np.array_split(np.array(records), BLOCKS)])
    return np.mean(blocks, axis=0), np.std(blocks, axis=0, ddof=1) / BLOCKS**0.5


def theory(d: int, eps: float) -> np.ndarray:
    gas = hard_beads(0.01, eps, d)
    loss = (1 - eps**2) / (2 * d)
    times = jnp.expm1(60 * loss * jnp.array([0.5, 1.0])) / loss * gas.mean_free_time
    curve = jaxgran.cool(gas, times, model=jaxgran.KineticTheory(correlations=False))
    assert curve.sonine is not None and curve.third_sonine is not None
    return np.array([curve.sonine[-1], curve.third_sonine[-1]])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--eps", type=float, nargs="+", default=[0.1, 0.4, 0.6, 0.85])
    parser.add_argument("--particles", type=int, default=200_000)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for d in (3, 2):
        for eps in options.eps:
            value, error = simulated(d, eps, options.particles // 2 * 2, seed=1)
            off = theory(d, eps) - value
            print(
                f"d = {d}, eps = {eps:g}: "
                + "; ".join(
                    f"a_{k} = {v:.5f} +- {e:.5f}, theory {o:+.5f} ({100 * o / v:+.1f} %)"
                    for k, v, e, o in zip((2, 3), value, error, off, strict=True)
                ),
                flush=True,
            )


if __name__ == "__main__":
    main()
