"""The controller of the lengths of windows of hard spheres."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran.particles.hard.window_length import MIN_IMPACTS, WindowController, longest_window


def next_length(num_impacts, duration=1.0, share=0.1, num_spheres=1000):
    """The length after one of 1 that lasted for a duration."""
    controller = WindowController(share, num_spheres)
    return float(controller.after(jnp.array(1.0), jnp.array(duration), jnp.array(num_impacts)))


@pytest.mark.parametrize(
    "num_impacts, ratio", [(100, 1.0), (50, 2**0.3), (200, 2**-0.3), (0, 1.5), (10**6, 0.5)]
)
def test_a_window_with_too_few_impacts_is_followed_by_a_longer_one(num_impacts, ratio):
    np.testing.assert_allclose(next_length(num_impacts), ratio)


def test_a_window_cut_short_by_an_end_changes_nothing():
    assert next_length(0, duration=0.4) == 1.0
    np.testing.assert_allclose(next_length(100, duration=0.8), 0.8)


def test_few_spheres_still_have_some_impacts_in_each_window():
    np.testing.assert_allclose(next_length(2 * MIN_IMPACTS, num_spheres=20), 1.0)


def test_the_longest_window_follows_one_with_few_impacts():
    rng = np.random.default_rng(0)
    for mean in (float(MIN_IMPACTS), 40.0, 1000.0):
        fewest = np.quantile(rng.poisson(mean, 10**5), 0.023)  # two standard deviations
        after = next_length(int(2 * fewest), share=2 * mean / 1000)
        np.testing.assert_allclose(after, longest_window(mean), rtol=0.05)
