"""How many cores of a CPU a compiled program of a run takes."""

import jax


def options() -> dict[str, str | bool] | None:
    """Options of the compiler for a program that the host driver calls.

    Where a process has several CPU devices, runs go on side by side, one on each. XLA would divide
    the operations of every one among threads of all cores, which then wait for each other: two
    replicas of DSMC take 15 to 20 % longer so. A program of each device takes one core instead. For
    one device there are no options: a single run takes as long with them as without, within 6 %.
    """
    if jax.default_backend() != "cpu" or jax.local_device_count() == 1:
        return None
    return {"xla_cpu_multi_thread_eigen": False}
