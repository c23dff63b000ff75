import os

import jax
import pytest
from jaxtyping import install_import_hook

# The types and shapes of all annotations are checked while the tests run. Under jax.vmap and in
# pytrees of tracers annotations hold for one member.
with install_import_hook("jaxgran", "beartype.beartype"):
    import jaxgran

os.environ["JAXGRAN_NO_CACHE"] = "1"  # of the user; a test has its own
os.environ["MPLBACKEND"] = "agg"  # no window
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")


def glass_beads(beta: float = 0.15, dimension: int = 3, **values) -> jaxgran.Gas:
    """A gas of 2 mm beads whose impacts at the thermal speed have a given beta."""
    gas = jaxgran.Gas(
        jaxgran.Viscoelastic(5e7, 0.22, 1e-6),
        diameter=0.002,
        mass=jaxgran.sphere_mass(0.002, 2500.0),
        packing_fraction=0.05,
        temperature=0.01,
        dimension=dimension,
    )
    return gas.replace(dissipative_constant=1e-6 * beta / gas.thermal_beta).replace(**values)


@pytest.fixture
def beads():
    return glass_beads


@pytest.fixture(autouse=True, scope="module")
def forget_compiled_code():
    # Thousands of compiled functions in one process exhaust its memory maps.
    yield
    jax.clear_caches()
