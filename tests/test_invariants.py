"""A curve and its derivative do not depend on units, frame, place and names."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxgran
from tests.beads import glass_beads

GAS = glass_beads(0.3, packing_fraction=0.1)
TIMES = np.array([0.3, 1.0]) * float(GAS.mean_free_time)
SPHERES = [jaxgran.SoftSpheres, jaxgran.HardSpheres]
MODELS = [jaxgran.KineticTheory(), jaxgran.DSMC(20), *SPHERES]

pytestmark = pytest.mark.slow
few = settings(max_examples=5, deadline=None, derandomize=True)
scales = st.floats(0.01, 100.0)
shifts = st.tuples(*3 * [st.floats(-5.0, 5.0)])


def curve_and_slope(gas, times, model):
    """T/T_0, <dr^2>/sigma^2 and collisions, and their derivatives in ln A."""

    def of(log_scale):
        A = gas.value("dissipative_constant") * jnp.exp(log_scale)
        curve = jaxgran.cool(
            gas.replace(dissipative_constant=A), times, model=model, progress=False
        )
        T, R = curve.temperature / gas.temperature, curve.displacement / gas.diameter**2
        return jnp.stack([T, R, curve.collisions])

    return jnp.stack(jax.jvp(of, (0.0,), (1.0,)))


@functools.cache
def start_of(kind):
    return jaxgran.cool(GAS, [0.0], model=kind(20), progress=False).particles


@functools.cache
def reference(model_or_kind):
    if not isinstance(model_or_kind, type):
        return curve_and_slope(GAS, TIMES, model_or_kind)
    model = model_or_kind(20, start=start_of(model_or_kind))
    return curve_and_slope(GAS, TIMES, model)


def check_same(found, expected):
    # Rounding grows some hundredfold in the mean free time that is followed.
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-10, atol=1e-12)
    # It may also let soft spheres project their tangents a block earlier or later.
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-6, atol=1e-8)


def check_start(kind, **changed):
    model = kind(20, start=start_of(kind)._replace(**changed))
    check_same(curve_and_slope(GAS, TIMES, model), reference(kind))


@pytest.mark.parametrize("model", MODELS, ids=lambda model: getattr(model, "__name__", model.name))
@few
@given(length=scales, duration=scales, mass=scales)
def test_units(model, length, duration, mass):
    """Spheres begin at a given state: ten collisions before it would let rounding grow to 1e-8."""
    value = GAS.value
    gas = GAS.replace(
        diameter=value("diameter") * length,
        mass=value("mass") * mass,
        temperature=value("temperature") * (length / duration) ** 2,
        youngs_modulus=value("youngs_modulus") * mass / (length * duration**2),
        dissipative_constant=value("dissipative_constant") * duration,
    )
    scaled = model
    if model in SPHERES:
        start = start_of(model)
        scaled = model(
            20,
            start=start._replace(
                position=start.position * length,
                velocity=start.velocity * length / duration,
                box_side=start.box_side * length,
            ),
        )
    found = curve_and_slope(gas, TIMES * duration, scaled)
    check_same(found, reference(model))


@pytest.mark.parametrize("kind", SPHERES)
@few
@given(drift=shifts)
def test_galilean_shift(kind, drift):
    drift = np.asarray(drift)[None, None] * np.sqrt(GAS.temperature)
    velocity = start_of(kind).velocity + drift
    check_start(kind, velocity=velocity)


@pytest.mark.parametrize("kind", SPHERES)
@few
@given(shift=shifts)
def test_translation_across_the_box(kind, shift):
    start = start_of(kind)
    shift = np.asarray(shift)[None, None] * float(GAS.diameter)
    position = (start.position + shift) % start.box_side
    check_start(kind, position=position)


@pytest.mark.parametrize("kind", SPHERES)
@few
@given(seed=st.integers(0, 1000))
def test_permutation_of_particles(kind, seed):
    order = np.random.default_rng(seed).permutation(20)
    start = start_of(kind)
    check_start(kind, position=start.position[:, order], velocity=start.velocity[:, order])
