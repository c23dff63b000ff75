import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran.particles.neighbours import rows_where

rows_where = jax.jit(rows_where, static_argnums=1)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 1.0])
@pytest.mark.parametrize("length", [1, 32, 33, 1000])
def test_rows_where_a_mask_holds(length, share):
    for seed, size in enumerate((1, 7, length, length + 40)):
        mask = np.random.default_rng(seed).random(length) < share
        rows, count = rows_where(jnp.asarray(mask), size)
        there = np.flatnonzero(mask)
        expected = np.full(size, length)
        expected[: len(there)] = there[:size]
        np.testing.assert_array_equal(rows, expected)
        assert count == len(there)
