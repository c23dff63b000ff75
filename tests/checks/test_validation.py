import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxgran import CoolingCurve, Domain


@pytest.mark.parametrize("value", ["steel", object(), [1.0, [2.0]]])
def test_what_is_no_number_is_refused(value):
    with pytest.raises(ValueError, match="expected a number or an array of numbers, got"):
        CoolingCurve([value], [1.0])
    with pytest.raises(ValueError, match=r"speed must be a number in \(0, inf\), got .* Give m/s"):
        Domain(0.0).check("speed", value, "Give m/s.")


def test_ends_of_a_domain():
    Domain(0.0, 1.0, True, True).check("share", np.array([0.0, 1.0]))
    half_open = Domain(0.0, 1.0, high_allowed=True)
    half_open.check("share", 1.0)
    with pytest.raises(ValueError, match=r"share must lie in \(0, 1\], got 0"):
        half_open.check("share", [1.0, 0.0])
    for value in (np.nan, np.inf, -np.inf):
        with pytest.raises(ValueError, match="must lie in"):
            Domain().check("share", value)


@given(st.floats(0.01, 0.99))
@settings(deadline=None)
def test_free_values_return(fraction):
    for domain in (Domain(), Domain(0.0), Domain(low=-1.0), Domain(-1.0, 0.5)):
        low, high = max(domain.low, -3.0), min(domain.high, 3.0)
        value = low + fraction * (high - low)
        free = domain.to_free(value)
        assert jnp.isfinite(free)
        # The logarithm of a distance of 1e-2 loses two digits.
        np.testing.assert_allclose(domain.from_free(free), value, rtol=1e-12, atol=1e-13)
