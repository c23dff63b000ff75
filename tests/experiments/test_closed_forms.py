"""Closed forms, each against an independent number or the equations it solves."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from experiments.support import closed_forms as forms
from jaxgran import KineticTheory
from tests.beads import curves_of, glass_beads, hard_gas, theory_curve, without

RATE = 0.831934150151502
"""Initial cooling rate of viscoelastic spheres, 1/tau_0 in units of delta/tau_c: checked value."""


def test_constants_of_the_expansion():
    # Checked values of the corrected expansion; the third series coefficient has nine digits.
    q, p, r = 2.301752786151829, 0.5661271900235634, 4.142724172222288
    np.testing.assert_allclose(forms.EXPANSION_P, p, rtol=1e-14)
    np.testing.assert_allclose(forms.EXPANSION_R, r, rtol=1e-9)
    delta = 1e-3
    expected = -5 / 3 * RATE * delta * (1 - q * delta - p * delta**1.5 + r * delta**2)
    slope = jax.grad(forms.paper_temperature)(0.0, delta)
    np.testing.assert_allclose(slope, expected, rtol=1e-13)
    gas = glass_beads(1.5 * 2**0.1 * delta)
    rate = jaxgran.KineticTheory().cooling_rate(gas) * gas.mean_free_time
    np.testing.assert_allclose(rate, -expected, rtol=1e-5)  # 1 - eps = 2e-3 is off by 4e-9


TAUS = np.geomspace(1e-3, 1e8, 100)
HAFF = {"corrections": without("sonine", "correlations"), "rtol": 1e-9}
"""Settings of kinetic theory with which constant restitution obeys Haff's law."""


@pytest.mark.parametrize("e", [0.99, 0.9, 0.5, 0.0])
@pytest.mark.figures
def test_haff(e, record):
    curve = theory_curve(hard_gas(e), TAUS, **HAFF)
    # Asked: 1e-8. The solver's rtol is 1e-9 and its error adds up over eleven decades.
    exact = forms.haff(TAUS, e)
    np.testing.assert_allclose(curve.temperature, exact, rtol=1e-8)
    record("haff", eps=e, error=float(jnp.max(jnp.abs(curve.temperature / exact - 1))))


@pytest.mark.parametrize(
    "taus",
    [
        np.zeros(1),  # the start alone
        np.array([1e-12, 2.0]),  # padded
        np.linspace(1.0, 1.01, 100),  # more than a window in one step
        np.linspace(1e-3, 10.0, 100_000),
    ],
)
def test_times_of_every_kind(taus):
    curve = theory_curve(hard_gas(0.5), taus, **HAFF)
    np.testing.assert_allclose(curve.temperature, forms.haff(taus, 0.5), rtol=1e-8)


@pytest.mark.slow
def test_expansion_is_right_to_its_order():
    # The first neglected term is delta^(5/2): the error must fall so, with a bounded coefficient.
    for clipped in (True, False):
        ratios = []
        for delta in (1e-3, 1e-2):
            gas = glass_beads(0.15)
            A = gas.value("dissipative_constant") * delta / gas.delta
            gas = dataclasses.replace(gas, law=jaxgran.Viscoelastic(5e7, 0.22, A, clipped))
            tau = jnp.geomspace(0.01, 1e4, 40) / delta
            curve = theory_curve(
                gas, tau, corrections=without("sonine", "softness", "correlations")
            )
            theta = curve.temperature / 0.01
            formula = forms.paper_temperature(tau, delta, clipped=clipped)
            ratios.append(float(jnp.max(jnp.abs(formula / theta - 1))) / delta**2.5)
        assert max(ratios) < 2.0, ratios


@pytest.mark.slow
def test_displacement_of_constant_restitution():
    for d, e in ((3, 0.6), (2, 0.9)):
        gas = hard_gas(e, dimension=d)
        tau = jnp.geomspace(0.01, 1e6, 50)
        curve = theory_curve(gas, tau, corrections=without("sonine", "correlations"), rtol=1e-9)
        # Brilliantov & Poeschel, Eqs. (45), (46); of dD/dt = T - D/tau_v, 1/tau_v = nu (1 + e)/d,
        # follows <dr^2> = (2 d/k) (N - (1 - exp(-k N))/k) with k = (1 + e)^2/(2 d).
        loss, k = (1 - e**2) / (2 * d), (1 + e) ** 2 / (2 * d)
        collisions = jnp.log1p(loss * tau) / loss
        formula = 2 * d / k * (collisions + jnp.expm1(-k * collisions) / k) * gas.mean_free_time**2
        # The solver's atol is its rtol, too: of the ballistic start it sees less.
        np.testing.assert_allclose(curve.collisions, collisions, rtol=1e-7)
        np.testing.assert_allclose(curve.displacement, formula, rtol=1e-6)


def test_first_order_of_viscoelastic_gas():
    # Over six decades of u: T, a_2 and <dr^2> less their leading terms, over delta, tend to the
    # closed forms' coefficients as sqrt(delta), the order of the clipped contact's first trace.
    u = jnp.asarray([10.0, 1e2, 1e4, 1e6])
    for delta in (1e-4, 1e-3):
        gas = glass_beads(1.5 * 2**0.1 * delta)
        tau = (u - 1) / (RATE * delta)
        options = {"corrections": without("softness", "correlations"), "order": 2}
        curve = theory_curve(gas, tau, rtol=1e-11, **options)
        leading = 54 / (RATE * delta) * (u ** (1 / 6) - 1)
        unit = gas.temperature * gas.mean_free_time**2
        exact = curve.displacement / unit - leading
        formula = forms.paper_displacement(tau, delta) - leading
        np.testing.assert_allclose(exact, formula, rtol=0.3 * delta**0.5)
        kurtosis = -forms.SONINE_COEFFICIENT * delta * (curve.temperature / gas.temperature) ** 0.1
        np.testing.assert_allclose(curve.sonine, kurtosis, rtol=2 * delta**0.5)
        printed = forms.paper_displacement(tau, delta, corrected=False) - leading
        assert jnp.all(jnp.abs(printed / exact - 1) > 0.1)


@pytest.mark.slow
def test_stiff_solver_for_nearly_elastic_gases():
    gas = glass_beads(1e-6)
    tau = jnp.geomspace(1.0, 1e9, 20)
    (curve,) = curves_of(gas, tau, KineticTheory(solver=diffrax.Kvaerno5(), rtol=1e-7))
    formula = forms.paper_temperature(tau, gas.delta)
    # The expansion is right to delta here; softness 0.8 % of the rate, a_2 less.
    np.testing.assert_allclose(curve.temperature / gas.temperature, formula, rtol=0.03)
