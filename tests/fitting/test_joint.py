"""Several measurements of one material."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran import read_measurement
from jaxgran.fitting.kinds import WALLS_ADDED
from jaxgran.fitting.setup import Request, build_problem
from jaxgran.scene.laws import ViscoelasticVariant
from tests.beads import glass_beads
from tests.data.curve_files import IN_MM, PLAIN, TIMES, T, text_of
from tests.fitting.curves import A, deviation, in_range, synthetic


def drop_test(gas, key, num=20, error=0.005, onto_plate=False):
    speed = jnp.geomspace(0.02, 1.0, num)
    if onto_plate:
        # A plate doubles the effective radius and the effective mass.
        gas = gas.replace(youngs_modulus=gas.value("youngs_modulus") / np.sqrt(2))
    eps = gas.restitution(speed) + error * jax.random.normal(key, (num,))
    return jaxgran.DropTest(speed, eps, jnp.full(num, error), "plate" if onto_plate else "sphere")


def of_drops(gas, test):
    return jaxgran.Measurement(gas, test)


@pytest.mark.parametrize("onto_plate", [False, True])
def test_a_drop_test_gives_its_constant(onto_plate):
    gas = glass_beads(0.15)
    unknown = gas.replace(dissipative_constant=2 * gas.value(A))
    one, two = (
        of_drops(unknown, drop_test(gas, jax.random.key(k), onto_plate=onto_plate)) for k in (0, 1)
    )
    result = jaxgran.fit({"one": one, "two": two})
    error = float(result.value(A)[1])
    assert deviation(result, gas) < 3 and error < 0.05 / 3 * gas.value(A)
    assert result.p_value > 0.01 and result.converged
    assert result.weights["one"][0] == pytest.approx(0.5, abs=0.01)
    alone = jaxgran.fit(one)
    assert "is consistent with these impacts, which determine A: " in alone.verdict
    assert float(alone.standard_error[0]) == pytest.approx(2**0.5 * error, rel=0.05)
    assert alone.grade == "determined"


@pytest.mark.slow
@pytest.mark.parametrize("is_skewed", [False, True])
def test_the_error_bar_of_few_impacts_whose_eps_scatters_holds(is_skewed):
    gas = glass_beads(0.15)
    speed = np.geomspace(0.05, 1.0, 8)
    eps = np.asarray(gas.restitution(speed))
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(100):
        noise = 1 - rng.exponential(size=8) if is_skewed else rng.normal(size=8)
        test = jaxgran.DropTest(speed, eps + 0.02 * noise, np.full(8, 0.003), scatters=True)
        result = jaxgran.fit(of_drops(gas, test), quick=True)
        held += deviation(result, gas) < 1.96
    assert 88 <= held <= 99


@pytest.mark.slow
def test_eps_of_a_gas_scatters_as_that_of_its_impacts():
    gas = glass_beads(0.1)
    law = ViscoelasticVariant.from_law(gas.law)
    grains = dataclasses.replace(gas, law=dataclasses.replace(law, spread=0.1))
    curve = synthetic(grains, relative_error=0.003)
    cooled = jaxgran.Measurement(gas, curve, num_particles=10**7, errors_measured=True)
    speed = jnp.geomspace(0.02, 0.2, 200)
    eps = gas.restitution(speed) + 0.1 * jax.random.normal(jax.random.key(0), (200,))
    drops = jaxgran.DropTest(speed, eps.clip(0.0, 1.0), jnp.full(200, 0.01))
    offs = []
    for scatters in (False, True):
        test = dataclasses.replace(drops, scatters=scatters)
        result = jaxgran.fit({"gas": cooled, "drops": of_drops(gas, test)}, quick=True)
        offs.append(float(result.estimate[0] / gas.value(A) - 1))
    assert any("eps of the impacts scatters by 0.088" in x for x in result.reasons)
    # Impacts of eps above 1 became 1, which lowers the scatter and A a little.
    assert abs(offs[1]) < 0.03 and offs[0] > 0.08


def test_a_restitution_that_is_flat_is_not_viscoelastic():
    """As golf balls bounce: eps is .895 at all speeds from 1.9 to 4 m/s."""
    speed = np.linspace(1.9, 4.0, 12)
    noise = 0.002 * np.array(jax.random.normal(jax.random.key(3), (12,)))
    test = jaxgran.DropTest(speed, 0.895 + noise, np.full(12, 0.002), onto="plate")
    gas = glass_beads(0.15).replace(dissipative_constant=0.0)  # as files give it
    result = jaxgran.fit(of_drops(gas, test))
    assert result.p_value < 1e-4 and result.value(A)[0] > 0
    assert result.grade == "not consistent"
    constant = dataclasses.replace(gas, law=jaxgran.ConstantRestitution(0.8))
    assert jaxgran.fit(of_drops(constant, test)).p_value > 0.01


@pytest.mark.slow
def test_curves_and_drops_together():
    dilute = glass_beads(0.15)
    dense = dilute.replace(packing_fraction=0.15)
    hot = dense.replace(temperature=4 * dense.temperature)
    curves = {
        "dilute": (dilute, synthetic(dilute, jax.random.key(3), relative_error=0.03)),
        "dense": (dense, synthetic(hot, jax.random.key(4), relative_error=0.03)),
    }
    known = {"errors_measured": True, "num_particles": 10**7}
    data = {label: jaxgran.Measurement(*pair, **known) for label, pair in curves.items()}
    data["drops"] = of_drops(dilute, drop_test(dilute, jax.random.key(5)))
    result = jaxgran.fit(data, separate=("temperature",))
    assert deviation(result, dilute) < 3 and result.p_value > 0.01
    T_0, spread = result.value("dense: temperature")
    assert abs(T_0 - float(hot.temperature)) < 3 * spread < 0.2 * T_0
    assert result.names == (A, "dilute: temperature", "dense: temperature")
    assert sum(share[0] for share in result.weights.values()) == pytest.approx(1)
    assert in_range(result, dilute.value(A))
    assert not any(x.preferred for x in result.alternatives)
    # Contacts of the dense gas last too long.
    assert "although the fit to these measurements is good" in result.verdict
    # Alone each curve knows less.
    for label in curves:
        alone = jaxgran.fit(data[label], free=(A, "temperature"), quick=True)
        assert alone.standard_error[0] > result.value(A)[1]
    # A curve of another material does not go with the others.
    other = dilute.replace(dissipative_constant=1.3 * dilute.value(A))
    data["drops"] = of_drops(dilute, drop_test(other, jax.random.key(5)))
    contradicted = jaxgran.fit(data, separate=("temperature",))
    assert contradicted.p_value < 1e-4
    assert "is not consistent" in contradicted.verdict


@pytest.mark.slow
@pytest.mark.parametrize(
    ("error", "words"),
    [(0.1, ", and the impacts determine A: "), (0.01, ", which together determine A: ")],
)
def test_the_verdict_says_what_determines_a(error, words):
    gas = glass_beads(0.15)
    known = {"errors_measured": True, "num_particles": 10**7, "absent": ("walls", "roughness")}
    curve = jaxgran.Measurement(
        gas, synthetic(gas, jax.random.key(3), relative_error=error), **known
    )
    drops = of_drops(gas, drop_test(gas, jax.random.key(5)))
    result = jaxgran.fit({"curve": curve, "drops": drops})
    assert "is consistent with these measurements" + words in result.verdict
    assert (result.weights["drops"][0] > 0.8) == ("and the impacts" in words)


def test_two_copies_are_one_measurement(write):
    first = read_measurement(write(PLAIN))
    for other in (PLAIN, IN_MM.replace("t,T,", "t (ms),T (mm^2/s^2),"), text_of("t,T", (TIMES, T))):
        copies = {"a": first, "b": read_measurement(write(other))}
        with pytest.raises(ValueError, match="'a' and 'b' .*same values"):
            jaxgran.fit(copies)


@pytest.mark.slow
@pytest.mark.parametrize("order", [("box", "drops"), ("drops", "box")])
def test_a_drop_test_may_come_first(order):
    """The parameters of a fit are those of its curves, whatever comes first."""
    dilute = glass_beads()
    walls = jaxgran.Walls(0.1, restitution=0.9)
    box = dataclasses.replace(dilute, container=walls)
    times = np.geomspace(1.0, 30.0, 12) * float(box.mean_free_time)
    curve = jaxgran.cool(box, times, progress=False)
    data = {
        "box": jaxgran.Measurement(box, jaxgran.CoolingCurve(times, curve.temperature)),
        "drops": of_drops(dilute, drop_test(dilute, jax.random.key(5))),
    }
    free = (A, "wall_restitution")
    result = jaxgran.fit({x: data[x] for x in order}, free=free, quick=True, progress=False)
    assert result.names == (A, "wall_coefficient")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("second_diameter", "ratio"),
    [(1.0, 1.0), pytest.param(1.5, 0.5**0.5, id="other grains")],
)
def test_curves_of_the_same_grains_share_the_error_of_their_density(second_diameter, ratio):
    """The density of the same grains is not known better by being told twice."""
    gas = glass_beads(0.1)
    diameter = second_diameter * np.asarray(gas.diameter)
    other = gas.replace(diameter=diameter, mass=jaxgran.sphere_mass(diameter, 2500.0))
    data = {}
    for label, own, num in (("first", gas, 40), ("second", other, 30)):
        prior = {"density": (2500.0, 1250.0)}
        curve = synthetic(own, num_points=num)
        data[label] = jaxgran.Measurement(own, curve, num_particles=10**8, priors=prior)
    alone = jaxgran.fit(data["first"], quick=True)
    both = jaxgran.fit(data, quick=True)
    found = float(both.standard_error[0] / alone.standard_error[0])
    # Errors of the measurement and of theory, which do average, are a tenth of the density's part.
    assert found == pytest.approx(ratio, abs=0.05)


@pytest.mark.slow
def test_an_effect_that_one_curve_tells_stays_possible_in_another():
    """Walls that one file describes, or excludes, do not exclude walls of another container."""
    gas = glass_beads(0.1)
    in_box = dataclasses.replace(gas, container=jaxgran.Walls(0.05, restitution=0.7))
    told = jaxgran.Measurement(in_box, synthetic(in_box), num_particles=300)
    untold = dataclasses.replace(told, gas=gas, data=synthetic(in_box, num_points=30))
    both = jaxgran.fit({"told": told, "untold": untold}, progress=False)
    walls = next(x for x in both.alternatives if x.name == WALLS_ADDED)
    assert walls.preferred and in_range(both, gas.value(A))
    assert "constant restitution" not in both.headline  # walls explain the data better
    free = dataclasses.replace(told, gas=gas, data=synthetic(gas), absent=("walls",))
    other = dataclasses.replace(free, data=synthetic(gas, num_points=30), absent=())
    both = jaxgran.fit({"free": free, "other": other}, progress=False)
    assert any(x.effect == "walls" for x in both.alternatives)
    assert any("walls (free)" in reason for reason in both.reasons)
    boxed = {"told": told, "untold": untold}
    assert any("far from walls (untold)" in x for x in jaxgran.fit(boxed, quick=True).reasons)


def test_a_second_effect_of_one_curve_keeps_the_first_one_of_the_others():
    gas = glass_beads(0.1)
    measurements = {
        "a": jaxgran.Measurement(gas, synthetic(gas), num_particles=300),
        "b": jaxgran.Measurement(gas, synthetic(gas, num_points=30), num_particles=300),
    }
    request = Request(measurements, jaxgran.KineticTheory(), (A,), (), {}, None, quick=True)
    problem, _, _ = build_problem(request)
    known = {label: {"wall_coefficient": 0.5} for label in measurements}
    problem = dataclasses.replace(problem, fixed=known)
    both = problem.extend_fixed({"a": {"drag_rate": 0.1}})
    assert both["a"] == {"wall_coefficient": 0.5, "drag_rate": 0.1} and both["b"] == known["b"]
