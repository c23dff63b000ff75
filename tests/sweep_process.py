"""One process of a sweep over several processes.

    python -m tests.sweep_process PORT INDEX PROCESSES STORE MEMBERS [DIE_AT]

Prints the number of each chunk that it has computed; kills itself before chunk DIE_AT is written.
"""

import os
import signal
import sys

import jax

TIMES = (0.1, 1.0, 10.0)
CHUNK = 2


def members(number):
    import jax.numpy as jnp

    from tests.beads import glass_beads

    values = jnp.geomspace(1e-6, 1e-5, number)
    return jax.vmap(lambda a: glass_beads().replace(dissipative_constant=a))(values)


def main(port, index, processes, store, number, die_at=-1):
    jax.config.update("jax_num_cpu_devices", 2)
    jax.config.update("jax_enable_x64", True)
    # JAX ends the other processes this long after one has died.
    seconds = 100 if die_at < 0 else 5
    address = f"127.0.0.1:{port}"
    jax.distributed.initialize(address, processes, index, heartbeat_timeout_seconds=seconds)
    import jaxgran

    gases, module = members(number), sys.modules["jaxgran.sweeps"]
    values, run_chunk = gases.value("dissipative_constant").tolist(), module._run_chunk

    def reported(models, members, *rest):
        chunk = values.index(members[0].value("dissipative_constant")[0]) // CHUNK
        arrays = run_chunk(models, members, *rest)
        if chunk == die_at:
            os.kill(os.getpid(), signal.SIGKILL)
        print("chunk", chunk, flush=True)
        return arrays

    setattr(module, "_run_chunk", reported)  # noqa: B010
    curve = jaxgran.sweep(gases, TIMES, store=store, chunk=CHUNK, progress=False)
    print("done", jax.device_count(), jax.local_device_count(), curve.temperature.shape, flush=True)


if __name__ == "__main__":
    port, index, processes, store, number, *die_at = sys.argv[1:]
    main(int(port), int(index), int(processes), store, int(number), *map(int, die_at))
