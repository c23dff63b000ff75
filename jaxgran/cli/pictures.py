"""The import of matplotlib, which takes as long as a fit, while that is made."""

from concurrent.futures import Future, ThreadPoolExecutor
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

PLOTTING = "jaxgran.plotting"


def plotting_later() -> "Future[ModuleType]":
    """`jaxgran.plotting`, imported in a thread beside work that is not Python's.

    Raises:
        ModuleNotFoundError: without matplotlib, before that work is done in vain.
    """
    if find_spec("matplotlib") is None:
        import_module(PLOTTING)  # raises, and says what to install
    pool = ThreadPoolExecutor(1)
    module = pool.submit(_plotting)
    pool.shutdown(wait=False)
    return module


def _plotting() -> ModuleType:
    module = import_module(PLOTTING)
    module.read_fonts()
    return module
