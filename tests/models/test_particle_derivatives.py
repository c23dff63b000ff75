"""Derivatives of runs of particles beside those of kinetic theory."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from tests.beads import glass_beads, soft_beads, without


def with_elements(num_particles) -> jaxgran.Gas:
    gas = glass_beads(packing_fraction=0.02)
    rate = 0.02 / float(gas.mean_free_time)
    side = gas.box_side(num_particles)
    return dataclasses.replace(
        gas,
        surface=jaxgran.Rough(0.0, rotational_temperature=4e-3),
        container=jaxgran.Walls(side, restitution=0.8, tangential_restitution=0.2),
        drag=jaxgran.StokesDrag(rate, rotational_rate=rate),
        drive=jaxgran.WhiteNoise(rate * gas.temperature),
    )


def logs_and_slopes(gas, model, taus, names, units):
    """Logarithms of quantities of a curve at each time, and their derivatives in floats.

    Args:
        gas, model, taus: of the run; times in mean free times.
        names: of the quantities.
        units: in which the floats are measured, by their names.
    """
    times = jnp.asarray(taus) * gas.mean_free_time

    def logs(steps):
        changes = zip(units.items(), steps, strict=True)
        changed = gas.replace(**{name: gas.value(name) + x * unit for (name, unit), x in changes})
        curve = jaxgran.cool(changed, times, model=model)
        values = jnp.log(jnp.stack([getattr(curve, name) for name in names]))
        return values, values

    slopes, values = jax.jacfwd(logs, has_aux=True)(jnp.zeros(len(units)))
    return np.asarray(values), np.asarray(slopes)


GASES = {
    # 1 % at N = 4e4, of some 10^4 collisions up to the first time.
    "DSMC": (
        glass_beads(),
        jaxgran.DSMC(20_000),
        jaxgran.KineticTheory(corrections=without("softness", "correlations")),
        (1, 5, 10, 50),
        ("dissipative_constant", "temperature", "packing_fraction"),
        {"temperature": (0.03, 0.003), "collisions": (0.03, 0.003)},
    ),
    # 8000 collisions scatter the rates by some 2 %, slopes in A by twice that.
    "soft spheres": (
        soft_beads(0.005, 0.3, packing_fraction=0.03),
        jaxgran.SoftSpheres(500, replicas=4, steps_per_contact=25),
        jaxgran.KineticTheory(),
        (2, 8),
        None,
        {"temperature": (0.08, 0.03), "collisions": (0.08, 0.03)},
    ),
}
"""A gas, two models, mean free times, floats or None for all, relative and absolute errors of
quantities."""


@pytest.mark.slow
@pytest.mark.parametrize("name", GASES)
def test_derivatives_of_smooth_spheres_are_those_of_theory(name):
    gas, *models, taus, floats, allowed = GASES[name]
    units = {name: gas.value(name) for name in floats or gas.domains}
    found, theory = (logs_and_slopes(gas, m, taus, allowed, units)[1] for m in models)
    for row, expected, (rtol, atol) in zip(found, theory, allowed.values(), strict=True):
        np.testing.assert_allclose(row, expected, rtol=rtol, atol=atol)


GIVEN = ("diameter", "mass", "youngs_modulus", "poisson_ratio", "wall_side")
"""Floats that are left out with elements."""

MORE = {"tangential_restitution": 0.05, "wall_tangential_restitution": 0.2}
"""What is allowed besides: spins of hard spheres before rough walls are not those of a mixed gas.
d ln T_rot/d beta_t at the last time is .345, .372 and .377 in three samples of 4000 hard spheres,
.34 in DSMC and .323 in theory; without walls .663, .664 and .668."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["DSMC", "HardSpheres"])
def test_derivatives_are_those_of_theory(kind):
    gas, hard = with_elements(500), kind == "HardSpheres"
    model = jaxgran.HardSpheres(500, replicas=8) if hard else jaxgran.DSMC(4000)
    units = {name: 1.0 for name in gas.domains if name not in GIVEN}
    names = "temperature", "rotational_temperature"
    (logs, found), (expected, theory) = (
        logs_and_slopes(gas, m, (3, 10), names, units) for m in (model, jaxgran.KineticTheory())
    )
    off = logs - expected
    # 3 standard errors of 4000 spheres and, of T, the layer before walls (error_model.WALL_ERROR),
    # which DSMC lacks as theory does; of T_rot theory's own 7 %.
    layer = 0.04 if hard else 0.02
    assert np.all(np.abs(off) < np.array([[0.04 + layer], [0.04 + 0.07]])), off
    for k, name in enumerate(units):
        # Theory itself is wrong by 5 % of T_rot/T, and by 2 % of the rate between walls; some 10^4
        # collisions scatter by 2 %, of the largest derivative.
        allowed = 0.12 + (MORE.get(name, 0.0) if hard else 0.0)
        slope, largest = theory[..., k], np.max(np.abs(theory[..., k]), axis=1, keepdims=True)
        assert np.all(np.abs(found[..., k] - slope) < allowed * largest + 0.01), name


@pytest.mark.slow
def test_what_is_not_known_is_nan():
    surface = jaxgran.Rough(0.0, rotational_temperature=4e-3)
    gas = dataclasses.replace(glass_beads(packing_fraction=0.02), surface=surface)
    times = jnp.array([0.5, 1.0]) * gas.mean_free_time

    def curve(beta):
        changed = gas.replace(tangential_restitution=beta)
        return jaxgran.cool(changed, times, model=jaxgran.DSMC(100))

    along = jax.jvp(curve, (0.0,), (1.0,))[1]
    assert np.all(np.isfinite(along.rotational_temperature))
    for name in ("sonine", "displacement", "velocity_correlation"):
        assert np.all(np.isnan(getattr(along, name)))
