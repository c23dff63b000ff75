import numpy as np
import pytest

from jaxgran import Domain


def test_ends_of_a_domain():
    Domain(0.0, 1.0, True, True).check("share", np.array([0.0, 1.0]))
    half_open = Domain(0.0, 1.0, high_allowed=True)
    half_open.check("share", 1.0)
    with pytest.raises(ValueError, match=r"share must lie in \(0, 1\], got 0"):
        half_open.check("share", [1.0, 0.0])
    for value in (np.nan, np.inf, -np.inf):
        with pytest.raises(ValueError, match="must lie in"):
            Domain().check("share", value)
