"""One process of a sweep over several processes.

    python -m tests.sweeps.process PORT INDEX PROCESSES STORE MEMBERS [DIE_AT]

Prints the number of each chunk that it has written; kills itself while it writes chunk DIE_AT.
"""

import os
import signal
import sys

import jax


def members(number):
    import jax.numpy as jnp

    import jaxgran

    law = jaxgran.Viscoelastic(5e7, 0.22, 1e-6)
    gas = jaxgran.Gas(law, diameter=2e-3, mass=1e-5, packing_fraction=0.05, temperature=0.01)
    values = jnp.geomspace(1e-6, 1e-5, number)
    return jax.vmap(lambda a: gas.replace(dissipative_constant=a))(values)


TIMES = (0.1, 1.0, 10.0)


def main(port, index, processes, store, size, die_at=-1):
    jax.config.update("jax_num_cpu_devices", 2)
    jax.config.update("jax_enable_x64", True)
    # JAX ends the other processes this long after one has died.
    seconds = 100 if die_at < 0 else 5
    address = f"127.0.0.1:{port}"
    jax.distributed.initialize(address, processes, index, heartbeat_timeout_seconds=seconds)
    import jaxgran
    from jaxgran.sweep import Store

    write = Store.write

    def reported(self, number, records):
        if number == die_at:
            self.group["temperature"][self.rows(number)] = records["temperature"]
            os.kill(os.getpid(), signal.SIGKILL)
        write(self, number, records)
        print("chunk", number, flush=True)

    Store.write = reported
    curve = jaxgran.sweep(members(size), TIMES, store=store, chunk=2, progress=False)
    print("done", jax.device_count(), jax.local_device_count(), curve.temperature.shape, flush=True)


if __name__ == "__main__":
    port, index, processes, store, number, *die_at = sys.argv[1:]
    main(int(port), int(index), int(processes), store, int(number), *map(int, die_at))
