"""Waiting that an interruption ends."""

import signal
import threading
import time

import jax
import jax.numpy as jnp
import pytest

from jaxgran._utils import waiting


@jax.jit
def some_seconds():
    # Not of scalars: JAX does not return before such programs have ended.
    return jax.lax.fori_loop(0, 3000, lambda i, x: 0.99 * x @ x, jnp.eye(300))


@pytest.mark.parametrize(
    "wait",
    [
        lambda: waiting.in_thread(lambda: time.sleep(5)),
        lambda: waiting.block_until_ready(some_seconds()),
    ],
)
def test_waiting_can_be_interrupted(wait):
    some_seconds.lower().compile()

    def interrupt(*_):
        raise KeyboardInterrupt

    old = signal.signal(signal.SIGALRM, interrupt)
    before = set(threading.enumerate())
    began = time.monotonic()
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.3)
        with pytest.raises(KeyboardInterrupt):
            wait()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, old)
    assert time.monotonic() - began < 1.5
    # XLA aborts a process that ends while a thread of Python still waits for it.
    for thread in set(threading.enumerate()) - before:
        thread.join(20)
