"""Waiting for compiled code in a way that the user can interrupt."""

import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import jax

T = TypeVar("T")

_HERE = threading.local()


@contextmanager
def stopped_by(stop: threading.Event) -> Iterator[None]:
    """In this thread, which an interruption from the keyboard does not reach, an event stands for
    it: `waited_for` raises KeyboardInterrupt once it is set."""
    _HERE.stop = stop
    try:
        yield
    finally:
        _HERE.stop = None


def waited_for(arrays: T) -> T:
    """The same arrays, once they are computed; an interruption ends the waiting at once.

    Looking again and again whether they are ready would take 3 to 8 % of a run's time.

    Raises:
        KeyboardInterrupt: in a thread within `stopped_by`, too, once its event is set.
    """
    arrays = in_thread(lambda: jax.block_until_ready(arrays))
    if (stop := getattr(_HERE, "stop", None)) is not None and stop.is_set():
        raise KeyboardInterrupt
    return arrays


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
    x64, device = jax.config.read("jax_enable_x64"), chosen_device()

    def call() -> T:
        with jax.enable_x64(x64), jax.default_device(device):
            return function()

    return in_thread(call)


def chosen_device() -> Any:
    """The device that `jax.default_device` has set in this thread, or None."""
    return jax.config.jax_default_device  # type: ignore[attr-defined]
