"""Derivatives by differences of whole runs."""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.gradients.differences import by_differences
from jaxgran.gradients.rule import Records, Result, differentiable
from tests.beads import curves_of, glass_beads, soft_beads

TIMES = jnp.array([0.0, 1e-3, 0.3, 2.0, 50.0])


class Haff(NamedTuple):
    """A gas that cools as viscoelastic spheres do, by Haff's law, of the material (alpha, A)."""

    material: tuple
    collision_frequency: jax.Array = jnp.ones(())

    def log_loss(self, material):
        return 0.4 * jnp.log(material[0]) + jnp.log(material[1])


def temperature(alpha, constant, t):
    return (1 + constant * alpha**0.4 * t) ** (-5 / 3)


def run(scene, times, start, others, directions=None) -> Result:
    """The course of that gas, as a run of two replicas; it knows its derivative in time."""
    alpha, constant = scene.material

    def at(t):
        T = temperature(alpha, constant, t) * jnp.ones(2)
        values = {"temperature": T, "collisions": jnp.log1p(constant * t) * T**0}
        if directions is None:
            return Records(values, {}, {})
        rate = jax.grad(temperature, 2)(alpha, constant, t)
        rates = {"temperature": rate * T**0, "collisions": 0 * T}
        unknown = jnp.zeros((len(directions[0]), 2))
        return Records(values, rates, {name: unknown for name in values})

    return Result(jax.vmap(at)(times), None, jnp.zeros((), jnp.int32))


def of_haff(step):
    rule = differentiable(
        by_differences(run, run, step),
        material=lambda scene: scene.material,
        frequency=lambda scene: scene.collision_frequency,
    )

    def records(numbers, times=TIMES):
        return rule(Haff(tuple(numbers)), times, None, None).records.values

    return records


AT = jnp.array([3.0, 0.2])


@pytest.mark.parametrize("step", [0.1, 0.5])
def test_a_gas_of_haff_has_its_derivative_for_any_step(step):
    slopes = jax.jit(jax.jacfwd(of_haff(step)))(AT)
    expected = jax.jit(jax.jacfwd(lambda x: temperature(*x, TIMES)))(AT)
    found = np.asarray(slopes["temperature"])
    # g loses digits where T is near 1.
    np.testing.assert_allclose(found[:, 0], expected, rtol=1e-11, atol=1e-14)
    # In the time, too, which the run itself knows.
    along = jax.jit(lambda t: jax.jvp(partial(of_haff(step), AT), (t,), (jnp.ones_like(t),)))
    _, in_time = along(TIMES)
    by_theory = jax.jit(jax.vmap(jax.grad(temperature, 2), (None, None, 0)))(*AT, TIMES)
    np.testing.assert_allclose(in_time["temperature"][:, 0], by_theory, rtol=1e-12)
    # Other records are differences in ln A, that of a logarithm too large by its third derivative.
    exact = 0.2 * TIMES / (1 + 0.2 * TIMES)
    got = 0.2 * slopes["collisions"][:, 0, 1]
    np.testing.assert_allclose(got, exact, rtol=1.001 * (np.sinh(step) / step - 1), atol=1e-14)


def test_a_fault_of_any_run_is_one_of_the_derivative():
    def failing(*inputs):
        return run(*inputs)._replace(status=jnp.asarray(4, jnp.int32))

    found = by_differences(run, failing, 0.3)
    inputs = Haff(tuple(AT)), TIMES, None, None
    assert int(found(*inputs, (jnp.ones(1), jnp.zeros(1))).status) == 4
    assert int(found(*inputs).status) == 0


@pytest.mark.slow
@pytest.mark.minutes
def test_soft_spheres_have_the_difference_of_two_runs():
    gas = soft_beads(0.05, 0.3, packing_fraction=0.15)
    times = jnp.array([0.5, 1.0]) * gas.mean_free_time  # before rounding has grown

    def ratios(log_scale, **options):
        """T over T_0 of each replica, as a function of ln A."""
        model = jaxgran.SoftSpheres(30, replicas=2, steps_per_contact=12, **options)
        changed = gas.replace(
            dissipative_constant=gas.value("dissipative_constant") * jnp.exp(log_scale)
        )
        return (
            model.simulate(changed, times, jaxgran.extend.Run()).replicas.temperature
            / gas.temperature
        )

    f = partial(ratios, differences=0.3)
    value, slope = jax.jvp(f, (0.0,), (1.0,))
    more, less, base = (np.asarray(ratios(x)) for x in (0.3, -0.3, 0.0))
    np.testing.assert_allclose(value, base, rtol=1e-9)
    # exp(0.3) times A, computed in two ways: the runs round differently, which chaos grows.
    difference = (np.log(more**-0.6 - 1) - np.log(less**-0.6 - 1)) / 0.6
    np.testing.assert_allclose(slope, -base * (1 - base**0.6) / 0.6 * difference, rtol=1e-6)
    reverse = jax.grad(lambda x: jnp.sum(f(x)))(0.0)
    np.testing.assert_allclose(reverse, jnp.sum(slope), rtol=1e-12)


def test_what_differences_do_not_know_is_refused():
    gas = glass_beads(0.15)
    dragged = dataclasses.replace(gas, drag=jaxgran.StokesDrag(1.0))
    for kind in (jaxgran.SoftSpheres, jaxgran.HardSpheres):
        with pytest.raises(ValueError, match="gas has drag"):
            kind(50, differences=0.3).check_scene(dragged)
    model = jaxgran.SoftSpheres(30, steps_per_contact=12, differences=0.3)

    def temperature(A):
        changed = gas.replace(dissipative_constant=A)
        return model.simulate(changed, jnp.array([1e-3]), jaxgran.extend.Run()).temperature

    with pytest.raises(ValueError, match="this gas has no loss"):
        jax.jvp(temperature, (0.0,), (1.0,))


def bias(times, share):
    """Bias of a slope by the share of the energy in a flow, which begins with none at t = 0.

    a c (1 + (c/b)^2), fitted to differences of runs, of the error c of a clock that counts the
    flow as heat: 1.6 of its share, on average over the time.
    """
    t, flow = np.insert(times, 0, 0.0), np.insert(share, 0, 0.0)
    clock = 1.6 * np.cumsum(np.diff(t) * (flow[1:] + flow[:-1]) / 2) / np.maximum(t[1:], 1e-300)
    return 3.0 * clock * (1 + (clock / 0.14) ** 2)


def test_the_bias_follows_from_the_energy_of_the_flow():
    model, gas = jaxgran.HardSpheres(500), glass_beads(0.5, packing_fraction=0.2)
    share, times = np.linspace(0.04, 0.06, 200), np.linspace(0.0, 2.0, 200)
    of_replicas = jnp.stack([1.2 * share, 0.8 * share])
    # Up to a first time that is not 0 the flow grows from none.
    for first in (0, 1, 199):
        found = model.derivative_bias(gas, jnp.asarray(times[first:]), of_replicas[:, first:])
        np.testing.assert_allclose(found, bias(times[first:], share[first:]), rtol=1e-12)


@pytest.mark.slow
def test_the_curve_tells_the_bias_where_the_gas_has_a_flow():
    """0 in a box below L_c; above it, from the flow of the run itself."""
    gas = glass_beads(0.5, packing_fraction=0.2)
    models = (jaxgran.HardSpheres(n, replicas=2) for n in (64, 500))
    small, large = curves_of(gas, np.geomspace(0.3, 30.0, 12), *models)
    assert gas.box_side(64) < gas.critical_box < gas.box_side(500)
    assert np.all(small.derivative_bias == 0)
    expected = bias(large.times, np.mean(large.replicas.flow_share, axis=0))
    # Compiled apart, the two differ by rounding.
    np.testing.assert_allclose(large.derivative_bias, expected, rtol=1e-12)
    # Vortices hold .06 of the energy at last; heat alone scatters it by .005.
    assert large.flow_share[-1] > 0.03 and large.derivative_bias[-1] > 0.03
