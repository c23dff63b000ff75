"""The gases of most tests, and their particles."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran

SI = {"diameter": 2e-3, "mass": 1e-5, "temperature": 0.01}


def beads(packing_fraction, beta, contact_fraction=None, dimension=3) -> jaxgran.Gas:
    """Beads of 2 mm with Y = 1e7 Pa, or that of a contact duration over mean free time."""
    gas = jaxgran.Gas(
        jaxgran.Viscoelastic(1e7, 0.22, 1e-6),
        diameter=2e-3,
        mass=jaxgran.sphere_mass(2e-3, 2500.0),
        packing_fraction=packing_fraction,
        temperature=0.01,
        dimension=dimension,
    )
    if contact_fraction is not None:
        stiffer = (float(gas.contact_fraction) / contact_fraction) ** 2.5
        gas = gas.replace(youngs_modulus=stiffer * gas.value("youngs_modulus"))
    return gas.replace(dissipative_constant=1e-6 * beta / float(gas.thermal_beta))


def glass_beads(beta: float = 0.15, dimension: int = 3, **values) -> jaxgran.Gas:
    """A gas of 2 mm beads whose impacts at the thermal speed have a given beta."""
    gas = beads(0.05, beta, dimension=dimension)
    gas = gas.replace(youngs_modulus=5e7, dissipative_constant=1e-6)
    return gas.replace(dissipative_constant=1e-6 * beta / gas.thermal_beta).replace(**values)


def soft_beads(fraction=0.02, beta=0.15, dimension=3, packing_fraction=0.05) -> jaxgran.Gas:
    """Glass beads whose contacts last a given part of the mean free time."""
    return beads(packing_fraction, beta, fraction, dimension)


def hard_gas(law=0.9, packing_fraction=0.05, dimension=3, **values) -> jaxgran.Gas:
    """A gas of diameter, mass and temperature 1: SI and reduced units are the same."""
    if not isinstance(law, jaxgran.extend.RestitutionLaw):
        law = jaxgran.ConstantRestitution(law)
    values = {"diameter": 1.0, "mass": 1.0, "temperature": 1.0} | values
    return jaxgran.Gas(law, packing_fraction=packing_fraction, dimension=dimension, **values)


def theory_curve(gas, taus, **settings) -> jaxgran.CoolingCurve:
    """The curve of kinetic theory at times in mean free times."""
    return jaxgran.cool(gas, taus * gas.mean_free_time, model=jaxgran.KineticTheory(**settings))


def without(*names) -> frozenset[str]:
    """All corrections of kinetic theory but these."""
    return jaxgran.KineticTheory.all_corrections - {*names}


def lattice(gas, n, replicas=1) -> jaxgran.Particles:
    """Spheres near the sites of a cubic lattice, at T: a start that needs no equilibration."""
    rng, d, side = np.random.default_rng(0), gas.dimension, float(gas.box_side(n))
    sites = int(np.ceil(n ** (1 / d)))
    grid = np.stack(np.meshgrid(*[np.arange(sites)] * d), -1).reshape(-1, d)[:n]
    room = 0.45 * (side / sites - float(gas.diameter))
    position = side / sites * (grid + 0.5) + room * rng.uniform(-1, 1, (replicas, n, d))
    velocity = rng.normal(size=(replicas, n, d))
    velocity -= velocity.mean(axis=1, keepdims=True)
    velocity *= np.sqrt(gas.temperature / np.mean(velocity**2, axis=(1, 2), keepdims=True))
    return jaxgran.Particles(jnp.asarray(position), jnp.asarray(velocity), gas.box_side(n))


def spheres(position, velocity, side) -> jaxgran.Particles:
    """Given spheres as a start with one replica."""
    x, v = (jnp.asarray(np.asarray(x, float)[None]) for x in (position, velocity))
    return jaxgran.Particles(x, v, jnp.asarray(float(side)))


def least_distance(x, side) -> float:
    """The least distance between two of some points in a periodic box."""
    i, j = np.triu_indices(len(x), 1)
    apart = np.asarray(x[i] - x[j])
    return np.min(np.linalg.norm(apart - side * np.round(apart / side), axis=1))


def curves_of(gas, taus, *models, **options) -> list[jaxgran.CoolingCurve]:
    """Curves of some models, at times in mean free times."""
    times = np.asarray(taus, float) * float(gas.mean_free_time)
    return [jaxgran.cool(gas, times, model=model, progress=False, **options) for model in models]


def total_energy(gas, curve):
    """Energy per particle, J, with what was dissipated; soft contacts hold some of it."""
    twice = gas.dimension * curve.temperature
    if curve.rotational_temperature is not None:
        twice = twice + {2: 1, 3: 3}[gas.dimension] * curve.rotational_temperature
    parts = [curve.elastic_energy, curve.dissipated_energy]
    return np.asarray(0.5 * gas.mass * twice + sum(x for x in parts if x is not None))


def assert_same(a, b):
    """Check that two trees have one structure, and arrays of the same types, shapes and bits."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(map(np.asarray, jax.tree.leaves(a)), jax.tree.leaves(b), strict=True):
        assert x.dtype == np.asarray(y).dtype and x.shape == np.shape(y)
        assert x.tobytes() == np.asarray(y).tobytes()
