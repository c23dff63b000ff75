"""Waiting for compiled code in a way that the user can interrupt."""

import queue
import threading
import time
from collections.abc import Callable
from typing import TypeVar

import jax

T = TypeVar("T")


SHARE_WAITED = 0.02
"""Share of a waiting time by which it may be too long."""

SHORTEST_PAUSE, LONGEST_PAUSE = 1e-5, 1e-3
"""Seconds between two looks at whether an array is computed."""


def waited_for(arrays: T) -> T:
    """The same arrays, once they are computed; an interruption ends the waiting at once."""
    pending = [leaf for leaf in jax.tree.leaves(arrays) if hasattr(leaf, "is_ready")]
    began = time.perf_counter()
    while not all(leaf.is_ready() for leaf in pending):
        pause = SHARE_WAITED * (time.perf_counter() - began)
        time.sleep(min(max(pause, SHORTEST_PAUSE), LONGEST_PAUSE))
    return jax.block_until_ready(arrays)


def in_thread(function: Callable[[], T]) -> T:
    """The result of a function that is called in a thread of its own.

    An interruption from the keyboard ends the waiting at once; the thread, which Python cannot end,
    then goes on in the background. No JAX transformation and no JAX configuration of the calling
    thread is under way in that thread.
    """
    results: queue.SimpleQueue[tuple[bool, object]] = queue.SimpleQueue()

    def call() -> None:
        try:
            results.put((True, function()))
        except BaseException as error:
            results.put((False, error))

    threading.Thread(target=call, daemon=True).start()
    succeeded, result = results.get()
    if not succeeded:
        assert isinstance(result, BaseException)
        raise result
    return result  # type: ignore[return-value]


def outside_of_transformations(function: Callable[[], T]) -> T:
    """Call a function in a thread of its own, where no JAX transformation is under way."""
    x64 = jax.config.read("jax_enable_x64")

    def call() -> T:
        with jax.enable_x64(x64):
            return function()

    return in_thread(call)
