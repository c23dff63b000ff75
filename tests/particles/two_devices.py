"""Replicas on two CPU devices: python -m tests.particles.two_devices MODEL."""

import sys

import jax
import jax.numpy as jnp
import numpy as np


def main(name):
    jax.config.update("jax_num_cpu_devices", 2)
    jax.config.update("jax_enable_x64", True)
    import jaxgran

    law = jaxgran.Viscoelastic(5e7, 0.22, 3e-6)
    gas = jaxgran.Gas(law, diameter=2e-3, mass=1e-5, packing_fraction=0.1, temperature=0.01)
    times, sizes = jnp.array([0.01, 0.03]), {"DSMC": 500, "HardSpheres": 50, "SoftSpheres": 50}

    def curve(replicas):
        model = getattr(jaxgran, name)(sizes[name], replicas=replicas)
        return jaxgran.cool(gas, times, model=model, key=jax.random.key(4), progress=False)

    two, three = curve(2), curve(3)
    for field in ("temperature", "collisions", "displacement"):
        each = [np.asarray(getattr(c.replicas, field)) for c in (two, three)]
        np.testing.assert_array_equal(each[0], each[1][:2], field)
    if two.particles is not None:
        np.testing.assert_array_equal(two.particles.velocity, three.particles.velocity[:2])
    # A replica alone, with its key.
    model, key = getattr(jaxgran, name)(sizes[name]), jax.random.fold_in(jax.random.key(4), 1)
    alone = jaxgran.cool(gas, times, model=model, key=key, progress=False)
    np.testing.assert_array_equal(alone.temperature, two.replicas.temperature[1])
    assert not np.array_equal(*two.replicas.temperature)
    print("independent on", jax.device_count(), "devices")


if __name__ == "__main__":
    main(sys.argv[1])
