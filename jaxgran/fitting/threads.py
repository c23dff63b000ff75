"""Fits that do not depend on each other, two at the same time."""

import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

NUM_THREADS = 2
"""Number of fits at the same time: more of them wait for one interpreter."""


@contextmanager
def quiet_threads() -> Iterator[ThreadPoolExecutor]:
    """Give threads in which fits say nothing; an interruption leaves out those not begun.

    Filters of warnings belong to the process: they are set once, and not by each fit.
    """
    threads = ThreadPoolExecutor(NUM_THREADS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            yield threads
        finally:
            threads.shutdown(cancel_futures=True)
