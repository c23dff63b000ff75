"""Fits of oblique impacts: A, beta_t and Coulomb's mu."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxgran
from jaxgran.fitting.report import report
from tests.beads import glass_beads, spheres
from tests.fitting.curves import A, synthetic

ROUGH = dataclasses.replace(glass_beads(0.15), surface=jaxgran.Rough(0.5, friction=0.2))
NAMES = (A, "tangential_restitution", "friction")
TRUE = np.array([float(ROUGH.value(name)) for name in NAMES])
GUESS = ROUGH.replace(dissipative_constant=1e-6, tangential_restitution=0.0, friction=0.9)


def impacts(gas, seed, num=20, noise=0.02, onto="sphere", of_centres=False):
    """Impacts at angles up to 80 degrees, with noise."""
    rng = np.random.default_rng(seed)
    speed = np.exp(rng.uniform(np.log(0.05), np.log(0.5), num))
    sideways = speed * np.tan(np.radians(rng.uniform(10, 80, num)))
    error = np.full(num, noise)
    test = jaxgran.DropTest(
        speed, np.full(num, 0.9), error, onto, sideways, np.full(num, 0.1), error, of_centres
    )
    eps, eps_t = np.asarray(test.computed(gas)), np.asarray(test.computed_tangential(gas))
    return dataclasses.replace(
        test,
        restitution=eps + noise * rng.standard_normal(num),
        tangential_restitution=eps_t + noise * rng.standard_normal(num),
    )


def of(gas, test):
    return jaxgran.Measurement(gas, test)


def with_errors_of_v_t(test, rng):
    """Speeds as measured: v_t within 5 %."""
    v_t = np.asarray(test.tangential_speed)
    found = v_t * (1 + 0.05 * rng.standard_normal(v_t.size))
    eps_t = np.asarray(test.tangential_restitution) * v_t / found
    return dataclasses.replace(
        test,
        tangential_speed=found,
        tangential_restitution=eps_t,
        tangential_speed_error=0.05 * v_t,
    )


def with_errors_of_angles(test, rng):
    """Speeds as measured: the angle from the normal within 2 degrees."""
    v, v_t = np.asarray(test.speed), np.asarray(test.tangential_speed)
    error = np.radians(2)
    angle = np.arctan2(v_t, v) + error * rng.standard_normal(v.size)
    found, found_t = np.hypot(v, v_t) * (np.cos(angle), np.sin(angle))
    return dataclasses.replace(
        test,
        speed=found,
        restitution=np.asarray(test.restitution) * v / found,
        tangential_speed=found_t,
        tangential_restitution=np.asarray(test.tangential_restitution) * v_t / found_t,
        speed_error=error * found_t,
        tangential_speed_error=error * found,
        tangential_correlation=np.full(v.size, -1.0),
    )


@pytest.mark.minutes
@pytest.mark.parametrize("measured", [with_errors_of_v_t, with_errors_of_angles])
def test_errors_of_speeds_and_angles_are_in_the_error_bars(measured):
    off = []
    for seed in range(40):
        test = measured(impacts(ROUGH, seed), np.random.default_rng(1000 + seed))
        result = jaxgran.fit(of(GUESS, test), free=NAMES, quick=True)
        off.append((result.estimate - TRUE) / result.standard_error)
    held = np.sum(np.abs(off) < 1.96, axis=0)
    assert np.all(held >= 0.88 * 40), held
    # beta_t is .54 standard errors too large with errors of v_t: impacts near the sliding limit.
    assert np.all(np.abs(np.mean(off, axis=0)) < 0.7), np.mean(off, axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("onto, of_centres", [("sphere", False), ("plate", True)])
def test_oblique_impacts_give_all_three_constants(onto, of_centres):
    test = impacts(ROUGH, 1, onto=onto, of_centres=of_centres)
    result = jaxgran.fit(of(GUESS, test), free=("A", "beta_t", "friction"))
    assert result.names == NAMES and result.converged and result.p_value > 0.01
    np.testing.assert_array_less(np.abs(result.estimate - TRUE) / result.standard_error, 3)
    np.testing.assert_array_less(result.standard_error / TRUE, [0.1, 0.15, 0.05])
    assert "degrees from the normal" in report(result)


@pytest.mark.slow
def test_the_rule_of_impact_is_that_of_hard_spheres():
    """Two spheres collide in a simulation: eps and eps_t are those that a drop test computes."""
    gas = ROUGH
    sigma, v = float(gas.diameter), 0.2
    offsets = np.array([0.2, 0.5, 0.8])  # impact parameter over diameter
    for b in offsets:
        x = np.array([[0.01, 0.01, 0.01], [0.01 + 1.5 * sigma, 0.01 + b * sigma, 0.01]])
        velocity = np.array([[v / 2, 0, 0], [-v / 2, 0, 0]])
        start = spheres(x, velocity, 0.05)
        model = jaxgran.HardSpheres(2, replicas=1, start=start)
        hit = (1.5 * sigma - sigma * np.sqrt(1 - b**2)) / v
        phi = np.pi / 3 * (sigma / 0.05) ** 3
        hot = gas.replace(temperature=v**2 / 12, packing_fraction=phi)
        after = jaxgran.cool(hot, [2 * hit], model=model, progress=False).particles
        moved = np.asarray(after.velocity[0, 0] - after.velocity[0, 1])
        turn = np.asarray(after.angular_velocity[0]).sum(axis=0)
        n = np.array([-np.sqrt(1 - b**2), -b, 0])
        u = moved - sigma / 2 * np.cross(turn, n)
        before = np.array([v, 0, 0])
        u_n, sideways = -before @ n, before - (before @ n) * n
        u_t = np.linalg.norm(sideways)
        one = np.ones(1)
        test = jaxgran.DropTest([u_n], 0.9 * one, one, "sphere", [u_t], 0.1 * one, one)
        np.testing.assert_allclose(u @ n / u_n, test.computed(hot), rtol=1e-6)
        eps_t = u @ sideways / u_t**2
        np.testing.assert_allclose(eps_t, test.computed_tangential(hot)[0], atol=1e-6)


def test_the_published_pair_of_alumina_and_glass():
    """e_n = .98 and mu = .092 at 3.85 m/s: Kharaz, Gorham & Salman, Powder Technol. 120 (2001)."""
    law = jaxgran.ConstantRestitution(0.98)
    pair = dataclasses.replace(ROUGH, law=law, surface=jaxgran.Rough(0.0, friction=0.092))
    rng = np.random.default_rng(2)
    angle = np.radians(np.linspace(4, 80, 20))
    error = np.full(20, 0.01)
    test = jaxgran.DropTest(
        3.85 * np.cos(angle), np.full(20, 0.98), error, "plate", 3.85 * np.sin(angle),
        np.full(20, 0.7), error, of_centres=True,
    )  # fmt: skip
    measured = np.asarray(test.computed_tangential(pair)) + 0.01 * rng.standard_normal(20)
    eps = 0.98 + 0.01 * rng.standard_normal(20)
    test = dataclasses.replace(test, restitution=eps, tangential_restitution=measured)
    guess = pair.replace(coefficient=0.9, friction=0.5, tangential_restitution=0.3)
    result = jaxgran.fit(of(guess, test), free=("eps", "friction", "beta_t"))
    for value, error, true in zip(
        result.estimate, result.standard_error, (0.98, 0.092, 0.0), strict=True
    ):
        assert abs(value - true) < 3 * error
    assert result.standard_error[0] < 0.003 and result.standard_error[1] < 0.004


@pytest.mark.minutes
@pytest.mark.filterwarnings("ignore:this curve does not determine")
def test_a_curve_with_oblique_impacts_determines_a():
    """T(t) alone does not tell roughness from A; impacts do."""
    curve = synthetic(ROUGH, jax.random.key(1), relative_error=0.02, quantities=("temperature",))
    known = {"errors_measured": True, "num_particles": 10**6}
    measured = jaxgran.Measurement(GUESS, curve, **known)
    data = {"curve": measured, "drops": of(GUESS, impacts(ROUGH, 3))}
    alone = jaxgran.fit(measured, free=NAMES, quick=True)
    assert alone.standard_error[0] > 0.1 * TRUE[0] and alone.standard_error[1] > 0.2
    result = jaxgran.fit(data, free=NAMES)
    np.testing.assert_array_less(np.abs(result.estimate - TRUE) / result.standard_error, 3.5)
    assert result.standard_error[0] < 0.05 * TRUE[0] and not result.undetermined
    assert result.weights["drops"][2] > 0.5
