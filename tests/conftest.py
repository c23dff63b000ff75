import gc
import os
import shutil
import tempfile
from functools import partial
from importlib.metadata import version
from pathlib import Path

import pytest

PROGRAMS = "JAXGRAN_TEST_PROGRAMS"
"""An environment variable: the folder of programs compiled in this run of the tests. Runs one after
the other may share a given one."""

MAX_MAPS_AFTER_A_FILE = 12_000
"""Memory maps above which a process clears its caches after a file of tests. Linux allows 65530;
each of thousands of compiled functions takes tens."""

MAX_MAPS = 40_000
"""Memory maps above which a process clears its caches after each slow test: XLA crashes without a
message if it gets no further map."""

FAST_COMPILATION = ["--xla_backend_optimization_level=0"]
"""Flags of XLA for the default tests, which mostly compile: in three fifths of the time with them.

Long tests run at the level that users have: some of them compare numbers to round-off.
"""

if tuple(map(int, version("jax").split(".")[:2])) < (0, 11):
    FAST_COMPILATION.append("--xla_cpu_use_fusion_emitters=false")

gc.set_threshold(100_000)  # tracing makes many objects that stay

RESULTS: dict[str, list[dict]] = {}
"""Results of tests in this session, by the name of the file to record them in."""


def pytest_addoption(parser):
    parser.addoption(
        "--record",
        action="store_true",
        help="keep what tests with the marker `figures` find in experiments/recorded/tests, from "
        "which the page on accuracy is made; in one process (-n 0)",
    )


@pytest.fixture
def record():
    """Keep numbers that a document quotes: called at the end of a test, when all has held."""

    def keep(name, **numbers):
        RESULTS.setdefault(name, []).append(numbers)

    return keep


def pytest_sessionfinish(session, exitstatus):
    if session.config.option.record and exitstatus == 0:
        from experiments.support.record import RECORDED, save

        for name, rows in RESULTS.items():
            save(RECORDED / "tests" / f"{name}.json", rows=rows)


def pytest_configure(config):
    """Share compiled programs between the workers of this run of the tests."""
    worker = hasattr(config, "workerinput")
    if config.option.record and (worker or getattr(config.option, "dist", "no") != "no"):
        raise pytest.UsageError("--record needs all tests in one process: add -n 0")
    if not worker:
        os.environ["MPLBACKEND"] = "agg"  # no window
        if config.option.markexpr == "not slow":
            flags = [*FAST_COMPILATION, os.environ.get("XLA_FLAGS", "")]
            os.environ["XLA_FLAGS"] = " ".join(flags)
        for name in ("JAX_COMPILATION_CACHE_DIR", "JAXGRAN_NO_CACHE"):
            os.environ.pop(name, None)
        if PROGRAMS not in os.environ:
            os.environ[PROGRAMS] = tempfile.mkdtemp(prefix="jaxgran-tests-")
            config.add_cleanup(partial(shutil.rmtree, os.environ[PROGRAMS], ignore_errors=True))


@pytest.hookimpl(trylast=True)  # after what measures the coverage of lines has begun
def pytest_sessionstart(session):
    config = session.config
    if hasattr(config, "workerinput") or getattr(config.option, "dist", "no") == "no":
        _import()  # not where workers do it, who wait until then


def _import():
    """Import jaxgran so that the types and shapes of all annotations are checked.

    Under jax.vmap and in pytrees of tracers annotations hold for one member.
    """
    import jax
    from jaxtyping import install_import_hook

    import tests.annotations  # noqa: F401

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_numpy_rank_promotion", "raise")
    with install_import_hook("jaxgran", "tests.annotations.check"):
        import jaxgran  # noqa: F401
        from jaxgran.cli.cache import use_compilation_cache

    assert use_compilation_cache(Path(os.environ[PROGRAMS]))


@pytest.fixture(scope="module")
def write(tmp_path_factory):
    """A function that writes a file of given text or bytes, and rows of numbers."""
    path = tmp_path_factory.mktemp("file") / "curve.csv"

    def write(content, *columns):
        for row in zip(*columns, strict=True):
            content += ",".join(f"{x:.17g}" for x in row) + "\n"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


@pytest.fixture(scope="module")
def read(write):
    """A function that reads the curve of a file of given text or bytes, and rows of numbers."""
    import jaxgran

    return lambda content, *columns: jaxgran.read_curve(write(content, *columns))


@pytest.fixture(autouse=True, scope="module")
def forget_compiled_code():
    yield
    _forget_beyond(MAX_MAPS_AFTER_A_FILE, where_unknown=True)


@pytest.fixture(autouse=True)
def forget_within_a_file(request):
    yield
    if request.node.get_closest_marker("slow"):
        _forget_beyond(MAX_MAPS)


def _forget_beyond(most: int, where_unknown: bool = False):
    maps = Path("/proc/self/maps")
    count = len(maps.read_bytes().splitlines()) if maps.exists() else None
    if where_unknown if count is None else count > most:
        import jax

        jax.clear_caches()
