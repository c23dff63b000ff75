"""What went wrong during a run, in words."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran


def test_statuses_are_explained():
    assert jaxgran.explain_status(None) == jaxgran.explain_status(jnp.zeros(3, int)) == "ok"
    words = jaxgran.explain_status(np.array([0, 32, 32 | 1]))
    assert "2 of 3 curves: the simulated time" in words and "1 of 3 curves: the neigh" in words
    for wrong in (-1, 1.5, "x", 2**15):
        with pytest.raises(ValueError, match="status must come from a curve"):
            jaxgran.explain_status(wrong)
