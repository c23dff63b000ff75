"""Laws with vectors, networks and splines, and fits of many parameters."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.interpolate

import jaxgran
from jaxgran.fitting.reasons import describe_search
from tests.beads import glass_beads
from tests.fitting.curves import A, fitted, synthetic


class Network(jaxgran.extend.RestitutionLaw):
    """A law whose exponent of loss is a network: it has arrays, and a function among its leaves."""

    net: eqx.nn.MLP

    def restitution(self, normal_speed):
        return jnp.exp(-0.1 * jnp.exp(jnp.vectorize(lambda v: self.net(jnp.log(v)))(normal_speed)))


WEIGHT = "net.layers[0].weight"
NETWORK = Network(eqx.nn.MLP("scalar", "scalar", 3, 1, activation=jnp.tanh, key=jax.random.key(0)))


def gas_of(law):
    return dataclasses.replace(glass_beads(), law=law)


@pytest.mark.parametrize(
    "model", [jaxgran.KineticTheory(), pytest.param(jaxgran.DSMC(200), marks=pytest.mark.slow)]
)
def test_networks_are_laws(model):
    gas = gas_of(NETWORK)
    times = jnp.array([0.5, 2.0]) * gas.mean_free_time

    def last(weight):
        changed = gas.replace(**{WEIGHT: weight})
        return jaxgran.cool(changed, times, model=model, progress=False).temperature[-1] / 0.01

    weight, along = gas.value(WEIGHT), jnp.array([[1.0], [-0.5], [2.0]])
    value_and_slope = jax.jit(lambda weight: jax.jvp(last, (weight,), (along,)))
    forward = value_and_slope(weight)[1]
    if model.stochastic:
        slope = jnp.sum(jax.grad(jax.jit(last))(weight) * along)
    else:
        more, less = (value_and_slope(weight + step * along)[0] for step in (1e-4, -1e-4))
        slope = (more - less) / 2e-4
    np.testing.assert_allclose(forward, slope, rtol=1e-8 if model.stochastic else 1e-5)


def test_names_of_the_arrays_of_a_law():
    gas = gas_of(NETWORK)
    names = [WEIGHT, "net.layers[0].bias"]
    assert [name for name in gas.domains if name in names] == names
    assert jnp.all(gas.replace(**{WEIGHT: jnp.ones((3, 1))}).value(WEIGHT) == 1)
    with pytest.raises(ValueError, match="got 'tanh'"):
        gas_of(Network("tanh"))
    with pytest.raises(ValueError, match="SoftSpheres needs .*Viscoelastic"):
        jaxgran.cool(gas, [1.0], model=jaxgran.SoftSpheres(64))


SERIES = gas_of(jaxgran.RestitutionSeries([-0.2, 0.03], [0.2, 0.4]))


@pytest.mark.slow
def test_vectors_are_fitted_by_least_squares_and_by_gradient_descent():
    curve, guess = synthetic(SERIES), SERIES.replace(coefficients=[-0.15, 0.0])
    options = {"free": ("coefficients",), "progress": False, "num_particles": 10**7}
    best = fitted(guess, curve, **options)
    assert best.names == ("coefficients",)
    assert best.element_names == ("coefficients[0]", "coefficients[1]")
    estimate, error = best.value("coefficients")
    np.testing.assert_allclose(estimate, SERIES.value("coefficients"), atol=1e-4)
    assert error.shape == (2,) and best.value("coefficients[1]") == (estimate[1], error[1])
    assert "coefficients[1]" in repr(best)
    result = fitted(guess, curve, solver=optax.adam(0.01), **options)
    np.testing.assert_allclose(result.estimate, best.estimate, atol=0.5 * best.standard_error.max())
    assert result.converged and result.chi2 < 1
    trace = result.trace
    assert trace.loss.shape == (result.iterations,)
    assert trace.parameters.shape == (result.iterations, 2)
    assert trace.reason in repr(result)
    short = fitted(guess, curve, solver=optax.adam(0.01), max_steps=3, **options)
    assert not short.converged and "3, was reached" in short.trace.reason


@pytest.mark.slow  # compiles a search
def test_a_descent_that_diverges_says_what_to_do():
    curve, guess = synthetic(SERIES), SERIES.replace(coefficients=[-0.18, 0.0])
    options = {"free": ("coefficients",), "solver": optax.sgd(1.0), "progress": False}
    with pytest.raises(RuntimeError, match=r"at step 1.*Lower the learning rate.*clip_by_global"):
        fitted(guess, curve, **options)
    result = fitted(guess, curve, throw=False, **options)
    assert not result.converged and "diverges" in result.trace.reason
    np.testing.assert_allclose(result.estimate, [-0.18, 0.0], atol=1e-12)


def spline_gas(curve, num_knots=8):
    speeds = jaxgran.RestitutionSpline.visited_speeds(curve.temperature)
    return gas_of(jaxgran.RestitutionSpline(np.geomspace(*speeds, num_knots)))


def test_spline():
    speeds, values = [1e-3, 1e-2, 3e-2, 1e-1], [0.97, 0.95, 0.9, 0.85]
    law = jaxgran.RestitutionSpline(speeds, values)
    inside, pchip = np.geomspace(1e-2, 3e-2, 5), scipy.interpolate.PchipInterpolator
    v = np.geomspace(1e-9, 1e3, 200)
    restitution = jax.jit(lambda law, v: (law.restitution(v), law.loss(v)))
    eps, loss = map(np.asarray, restitution(law, np.concatenate([v, speeds, inside])))
    np.testing.assert_allclose(loss, 1 - eps, atol=1e-15)
    eps, at_knots, between = np.split(eps, [200, 204])
    np.testing.assert_allclose(at_knots, values, rtol=1e-12)
    cubic = pchip(np.log(speeds), -np.log(values))(np.log(inside))
    np.testing.assert_allclose(between, np.exp(-cubic))
    assert np.all(np.diff(eps) <= 0) and np.all((eps > 0) & (eps <= 1))
    assert eps[0] == 1.0
    slope = jax.jit(jax.grad(law.restitution))
    assert jnp.isfinite(slope(0.0)) and jnp.isfinite(slope(1e-2))
    # A power law of eps is smooth.
    power = jaxgran.RestitutionSpline(speeds, (np.asarray(speeds) / 5e-4) ** -0.1)
    smoothness, of_drops = np.split(np.asarray(power.prior_residuals()), [2])
    np.testing.assert_allclose(smoothness, 0.0, atol=1e-10)
    assert np.max(np.abs(of_drops)) < 0.5
    eps, _ = restitution(power, np.concatenate([v, speeds, inside]))
    np.testing.assert_allclose(eps[:200], np.minimum((v / 5e-4) ** -0.1, 1.0), rtol=1e-9)


def test_a_spline_may_lose_nothing():
    law = jaxgran.RestitutionSpline([1e-3, 1e-2, 3e-2, 1e-1], [1.0, 1.0, 1.0, 0.8])
    v = np.array([1e-5, 1e-3, 2e-2, 3e-2, 1e-1, 0.2])
    eps, slope = jax.jvp(law.restitution, (jnp.asarray(v),), (jnp.ones(6),))
    np.testing.assert_allclose(eps[:4], 1.0, atol=1e-15)
    assert eps[4] == pytest.approx(0.8) and 0 < eps[5] < 0.8
    assert np.all(np.isfinite(slope))


@pytest.mark.minutes
def test_a_law_is_learnt_from_a_curve(caplog):
    true = glass_beads(0.15)
    curve = synthetic(true)
    result = fitted(spline_gas(curve), curve, free="law", num_particles=10**7)
    band = jaxgran.restitution_band(result)
    eps = true.restitution(band.speeds)
    assert np.all((band.low < eps) & (eps < band.high))
    assert np.all((band.high - band.low)[2:-2] < 0.04)
    assert {"measurement", "smoothness", "model"} <= {*result.error_budget}
    assert result.undetermined == ()
    chi2, p, compared = band.compare(true.replace(dissipative_constant=1e-7), A)
    assert chi2 < 0.3 and p > 0.5  # the curve has no noise
    np.testing.assert_allclose(compared.value(A), true.value(A), rtol=0.02)
    chi2, p, _ = band.compare(gas_of(jaxgran.ConstantRestitution(0.9)), "coefficient")
    assert chi2 > 10 and p < 1e-6
    wide = jaxgran.RestitutionSpline(np.geomspace(1e-4, 1.0, 8))
    words = r"knots at 0.0001, .* outside the impact speeds 0.01 to"
    with jax.log_compiles(), pytest.warns(UserWarning, match=words):
        fitted(gas_of(wide), curve, free="law", num_particles=10**7)
    assert "Compiling" not in caplog.text  # other knots share the programs
    with pytest.raises(ValueError, match="number of the law"):
        jaxgran.restitution_band(fitted(true, curve, free=("temperature",)))


def test_a_law_is_learnt_from_impacts_alone():
    law = jaxgran.RestitutionSpline([1e-3, 1e-2, 1e-1])
    drops = jaxgran.DropTest([2e-3, 2e-2, 8e-2], [0.9, 0.85, 0.8], [0.01] * 3)
    result = jaxgran.fit(jaxgran.Measurement(gas_of(law), drops), free="law", progress=False)
    assert result.converged
    # Another minimum is given with each number of the law.
    several = dataclasses.replace(result, other_minima=np.array([[0.1, 0.2, 0.3]]))
    (words,) = describe_search(several)
    assert "drops[0] = 0.1, drops[1] = 0.2, drops[2] = 0.3" in words


@pytest.mark.minutes
@pytest.mark.slow  # compiles derivatives of runs
def test_a_law_is_learnt_through_simulations():
    curve = synthetic(glass_beads(0.15), num_points=12, relative_error=0.02)
    learner, model = spline_gas(curve, 4), jaxgran.DSMC(500, replicas=2)
    options = {"model": model, "free": "law", "progress": False, "num_particles": 10_000}
    result = fitted(learner, curve, solver=optax.adam(0.1), max_steps=30, **options)
    assert result.trace.loss[-1] < 0.05 * result.trace.loss[0]
    band = jaxgran.restitution_band(result)
    eps = glass_beads(0.15).restitution(band.speeds)
    assert np.all(np.abs(np.log(np.log(band.restitution) / np.log(eps))) < 0.3)
    assert np.all(result.standard_error > 0)
