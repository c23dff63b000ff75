"""Averages and closed forms, each against an independent number."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran import kinetics
from jaxgran.restitution import ReducedViscoelastic


def test_constants_of_the_expansion():
    # Checked values of the corrected expansion; the third series coefficient has nine digits.
    np.testing.assert_allclose(kinetics.COOLING_RATE[3], 0.831934150151502, rtol=1e-14)
    np.testing.assert_allclose(kinetics.TWO_TERM, 2.301752786151829, rtol=1e-14)
    np.testing.assert_allclose(kinetics.EXPANSION_P, 0.5661271900235634, rtol=1e-14)
    np.testing.assert_allclose(kinetics.EXPANSION_R, 4.142724172222288, rtol=1e-9)


def test_averages_of_constant_restitution():
    # Closed forms for a_2 = 0, in share = S_d / sqrt(2 pi): share (1 - e^2)/2, share (1 + e)/d.
    for d in (2, 3):
        e = 0.7
        law = jaxgran.ConstantRestitution(e)
        rates = kinetics.Rates.of(kinetics.averages(law, jnp.ones(()), d), jnp.zeros(()))
        share = {2: 2 * np.pi, 3: 4 * np.pi}[d] / np.sqrt(2 * np.pi)
        np.testing.assert_allclose(rates.cooling, share * (1 - e**2) / 2, rtol=1e-12)
        np.testing.assert_allclose(rates.relaxation, share * (1 + e) / d, rtol=1e-12)
        expected = (d + 1.5 + e**2) * rates.cooling  # van Noije & Ernst 1998, Eq. (12)
        np.testing.assert_allclose(rates.fourth_moment, expected, rtol=1e-12)


def test_averages_agree_with_sampled_impacts():
    # Impacts of a Maxwellian gas sampled directly: g exp(-g^2/2), eps of the fast law.
    law = ReducedViscoelastic(jnp.asarray(0.4), jnp.asarray(0.0), True)
    g = np.sqrt(-2 * np.log(np.random.default_rng(0).random(1_000_000)))
    loss = 1 - np.asarray(law.restitution(jnp.asarray(g))) ** 2
    sampled = 4 * np.pi / (2 * np.sqrt(2 * np.pi)) * np.mean(loss * g**2 / 2)
    rates = kinetics.Rates.of(kinetics.averages(law, jnp.ones(()), 3), jnp.zeros(()))
    # 1e6 samples with a relative scatter of 1.2.
    np.testing.assert_allclose(rates.cooling, sampled, rtol=4e-3)


# a_2 of the homogeneous cooling state, from stochastic simulation (errors 2e-4 to 4e-4).
@pytest.mark.parametrize(
    "d, e, a2",
    [(3, 0.5, 0.0476), (3, 0.8, -0.0145), (3, 0.9, -0.0152), (2, 0.5, 0.0733), (2, 0.9, -0.0301)],
)
def test_stationary_kurtosis(d, e, a2):
    gas = jaxgran.Gas(
        jaxgran.ConstantRestitution(e),
        diameter=1.0,
        mass=1.0,
        packing_fraction=0.01,
        temperature=1.0,
        dimension=d,
    )
    curve = jaxgran.cool(gas, jnp.array([300.0]) * gas.mean_free_time)
    assert curve.sonine is not None
    # The Sonine theory neglects a_3: at e = .5 it is 11 % (3D) and 15.4 % (2D) above simulation.
    np.testing.assert_allclose(curve.sonine[0], a2, rtol=0.16)


def test_rate_table_is_exact_over_decades(beads):
    laws = [
        beads(0.15).reduced_law,
        beads(2.0).reduced_law,
        jaxgran.ConstantRestitution(0.5),
        jaxgran.RestitutionSeries([-0.2], [0.5]),
        jaxgran.RestitutionSeries([-0.1], [1.0]),
    ]
    # Over five decades the series are exact to 1e-11; over twelve, to 1e-7 where least so.
    for law in laws:
        for duration, tolerance in ((1e-3, 1e-11), (1.0, 1e-11), (1e5, 1e-11), (1e12, 1e-7)):

            def direct(speed, law=law):
                return kinetics.averages(law, speed, 3)

            table = kinetics.RateTable.of(direct, jnp.asarray(duration), 3, law.num_nodes)
            x = jnp.linspace(table.lowest, 0.0, 300)
            error = jax.vmap(table)(x)[:, 0, 0] / jax.vmap(direct)(jnp.exp(x / 2))[:, 0, 0] - 1
            assert jnp.max(jnp.abs(error)) < tolerance


def test_no_gas_leaves_its_rate_table(beads):
    # Outside, a Chebyshev series means nothing. Gases from nearly elastic to plastic, all horizons.
    def floor_and_end(beta, tau):
        gas = beads(1.0)
        gas = gas.replace(dissipative_constant=gas.value("dissipative_constant") * beta)
        law, duration = gas.reduced_law, tau / gas.collision_frequency
        duration = duration * gas.impact_speed / gas.path_length
        table = kinetics.RateTable.of(lambda v: kinetics.averages(law, v, 3), duration, 3, 20)
        times = tau[None] * gas.mean_free_time
        curve = jaxgran.cool(gas, times, model=jaxgran.KineticTheory(softness=False))
        return table.lowest, jnp.log(curve.temperature[0] / gas.temperature)

    betas, taus = jnp.meshgrid(jnp.geomspace(1e-3, 10.0, 25), jnp.geomspace(1e-2, 1e4, 25))
    lowest, reached = jax.vmap(floor_and_end)(betas.ravel(), taus.ravel())
    assert jnp.all(reached > lowest)
    assert jnp.all(lowest > 5 * reached - 4.0)  # nor is the table needlessly long


@pytest.mark.parametrize("e", [0.99, 0.9, 0.5, 0.0])
def test_haff(e):
    gas = jaxgran.Gas(
        jaxgran.ConstantRestitution(e),
        diameter=1.0,
        mass=1.0,
        packing_fraction=0.1,
        temperature=1.0,
    )
    tau = jnp.geomspace(1e-3, 1e8, 100)
    curve = jaxgran.cool(gas, tau * gas.mean_free_time, model=jaxgran.KineticTheory(sonine=False))
    # Asked: 1e-8. The solver's rtol is 1e-9 and its error adds up over eleven decades.
    np.testing.assert_allclose(curve.temperature, kinetics.haff(tau, e), rtol=1e-8)


def test_two_term_solution(beads):
    gas = beads(0.15)
    tau = jnp.geomspace(0.1, 1e9, 60)
    model = jaxgran.KineticTheory(softness=False, averages="paper")
    curve = jaxgran.cool(gas, tau * gas.mean_free_time, model=model)
    theta = curve.temperature / gas.temperature
    exact = kinetics.two_term_time(theta, gas.delta)
    np.testing.assert_allclose(exact, tau, rtol=2e-8)  # five thirds of the error of T
    with pytest.raises(ValueError, match=r"delta must lie in \(0, 0.4345\), got 0.5"):
        kinetics.two_term_time(0.5, 0.5)


def test_expansion_is_right_to_its_order(beads):
    # The first neglected term is delta^(5/2): the error must fall so, with a bounded coefficient.
    for clipped in (True, False):
        ratios = []
        for delta in (1e-3, 1e-2):
            gas = beads(0.15)
            scale = delta / gas.delta
            law = jaxgran.Viscoelastic(
                5e7, 0.22, gas.value("dissipative_constant") * scale, clipped
            )
            gas = jaxgran.Gas(
                law,
                diameter=gas.diameter,
                mass=gas.mass,
                packing_fraction=0.05,
                temperature=gas.temperature,
            )
            tau = jnp.geomspace(0.01, 1e4, 40) / delta
            model = jaxgran.KineticTheory(sonine=False, softness=False)
            theta = jaxgran.cool(gas, tau * gas.mean_free_time, model=model).temperature / 0.01
            formula = kinetics.paper_temperature(tau, delta, clipped=clipped)
            ratios.append(float(jnp.max(jnp.abs(formula / theta - 1))) / delta**2.5)
        assert max(ratios) < 2.0, ratios


def test_printed_expansion_breaks_the_initial_condition():
    # The reason for the correction: at t = 0 the printed form is off by 2 q delta.
    printed = kinetics.paper_temperature(0.0, 0.1, corrected=False)
    np.testing.assert_allclose(printed, 1 + 2 * kinetics.TWO_TERM * 0.1, rtol=1e-12)
    np.testing.assert_allclose(kinetics.paper_temperature(0.0, 0.1), 1.0, rtol=1e-12)


def test_paper_averages_are_the_first_two_terms(beads):
    gas = beads(0.002)
    law = gas.reduced_law
    exact = kinetics.averages(law, jnp.ones(()), 3)[:, 0]
    paper = kinetics.paper_averages(law, jnp.ones(()), 3)[:, 0]
    # The next term of 1 - eps^2 is O(beta^(3/2)) relative to the first: 0.23 * 9e-5.
    np.testing.assert_allclose(paper[0], exact[0], rtol=5e-5)
    np.testing.assert_allclose(paper[2], exact[2], rtol=1e-7)
    with pytest.raises(ValueError, match="Viscoelastic law, got ConstantRestitution"):
        kinetics.paper_averages(jaxgran.ConstantRestitution(0.9), jnp.ones(()), 3)


def test_velocity_relaxation_as_printed(beads):
    # The paper's Eq. (32) with its own coefficients: 1 - 3/4 Gamma(21/10) C1 delta 4^.1 + ...
    from math import gamma

    from jaxgran.restitution import C1

    gas = beads(0.15)
    paper = kinetics.paper_averages(gas.reduced_law, jnp.ones(()), 3)[2, 0]
    elastic = kinetics.paper_averages(beads(0.0).reduced_law, jnp.ones(()), 3)[2, 0]
    small = float(gas.delta) * 4**0.1
    printed = 1 - 0.75 * gamma(2.1) * C1 * small + 27 / 40 * gamma(2.2) * C1**2 * small**2
    np.testing.assert_allclose(paper / elastic, printed, rtol=1e-12)


def test_displacement_of_constant_restitution():
    for d, e in ((3, 0.6), (2, 0.9)):
        gas = jaxgran.Gas(
            jaxgran.ConstantRestitution(e),
            diameter=1.0,
            mass=1.0,
            packing_fraction=0.1,
            temperature=1.0,
            dimension=d,
        )
        tau = jnp.geomspace(0.01, 1e6, 50)
        model = jaxgran.KineticTheory(sonine=False)
        curve = jaxgran.cool(gas, tau * gas.mean_free_time, model=model)
        collisions = kinetics.haff_collisions(tau, e, d)
        formula = kinetics.constant_displacement(collisions, e, d) * gas.mean_free_time**2
        # The solver's rtol is 1e-9, its atol too: of the ballistic start it sees less.
        np.testing.assert_allclose(curve.collisions, collisions, rtol=1e-7)
        np.testing.assert_allclose(curve.displacement, formula, rtol=1e-6)


def test_first_order_of_viscoelastic_gas(beads):
    # Over six decades of u: T, a_2 and <dr^2> less their leading terms, over delta, tend to the
    # closed forms' coefficients as sqrt(delta), the order of the clipped contact's first trace.
    u = jnp.asarray([10.0, 1e2, 1e4, 1e6])
    for delta in (1e-4, 1e-3):
        gas = beads(1.5 * 2**0.1 * delta)
        tau = (u - 1) / (kinetics.COOLING_RATE[3] * delta)
        model = jaxgran.KineticTheory(softness=False, rtol=1e-11)
        curve = jaxgran.cool(gas, tau * gas.mean_free_time, model=model)
        leading = 54 / (kinetics.COOLING_RATE[3] * delta) * (u ** (1 / 6) - 1)
        unit = gas.temperature * gas.mean_free_time**2
        exact = curve.displacement / unit - leading
        formula = kinetics.paper_displacement(tau, delta) - leading
        np.testing.assert_allclose(exact, formula, rtol=0.3 * delta**0.5)
        kurtosis = -kinetics.SONINE * delta * (curve.temperature / gas.temperature) ** 0.1
        np.testing.assert_allclose(curve.sonine, kurtosis, rtol=2 * delta**0.5)
        printed = kinetics.paper_displacement(tau, delta, corrected=False) - leading
        assert jnp.all(jnp.abs(printed / exact - 1) > 0.1)
