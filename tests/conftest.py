import os
import shutil
import tempfile
from functools import partial
from pathlib import Path

import jax
import pytest
from jaxtyping import install_import_hook

# The types and shapes of all annotations are checked while the tests run. Under jax.vmap and in
# pytrees of tracers annotations hold for one member.
with install_import_hook("jaxgran", "beartype.beartype"):
    import jaxgran
    from jaxgran.checks.kept_programs import keep_in
    from jaxgran.cli.programs import SWITCH, keep_programs

PROGRAMS = "JAXGRAN_TEST_PROGRAMS"
"""An environment variable: the folder of programs compiled in this run of the tests."""

QUICKLY = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
"""Flags of XLA. On a CPU its emitters of fusions take more than half of the time of a compilation:
without them it compiles a fit in 1.9 s in place of 5.1 s (jaxlib 0.10.1)."""

os.environ["MPLBACKEND"] = "agg"  # no window
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_configure(config):
    """What one file or worker has compiled serves the others, in this run of the tests alone."""
    if not hasattr(config, "workerinput"):
        os.environ[PROGRAMS] = tempfile.mkdtemp(prefix="jaxgran-tests-")
        config.add_cleanup(partial(shutil.rmtree, os.environ[PROGRAMS], ignore_errors=True))
        if config.option.markexpr == "not slow":
            # Tests mostly compile. The slow ones run what users run, with all optimisation.
            os.environ["XLA_FLAGS"] = f"{QUICKLY} {os.environ.get('XLA_FLAGS', '')}".strip()
    os.environ[SWITCH] = "0"
    keep_programs(Path(os.environ[PROGRAMS]))
    keep_in(None)  # every function is traced, as some tests change what is called in it
    os.environ[SWITCH] = "1"  # the user's own; a test has its own


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
