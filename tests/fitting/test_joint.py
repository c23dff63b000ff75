"""Several measurements of one material."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from tests.beads import glass_beads
from tests.fitting.curves import synthetic

A = ("dissipative_constant",)


def drop_test(gas, key=None, num=20, error=0.005, onto_plate=False):
    speed = jnp.geomspace(0.02, 1.0, num)
    scene = gas
    if onto_plate:
        # A plate doubles the effective radius and the effective mass.
        scene = gas.replace(youngs_modulus=gas.value("youngs_modulus") / np.sqrt(2))
    noise = 0.0 if key is None else error * jax.random.normal(key, (num,))
    eps = scene.restitution(speed) + noise
    return jaxgran.DropTest(speed, eps, jnp.full(num, error), onto_plate)


@pytest.mark.parametrize("onto_plate", [False, True])
def test_a_drop_test_gives_its_constant(onto_plate):
    gas = glass_beads(0.15)
    unknown = gas.replace(dissipative_constant=2 * gas.value("dissipative_constant"))
    one, two = (drop_test(gas, jax.random.key(k), onto_plate=onto_plate) for k in (0, 1))
    result = jaxgran.fit_jointly({"one": (unknown, one), "two": (unknown, two)})
    a, error = result.estimate[A[0]], result.standard_error[A[0]]
    truth = float(gas.value(A[0]))
    assert abs(a - truth) < 3 * error < 0.05 * truth
    assert result.agree and result.converged
    assert result.weight["one"][A[0]] == pytest.approx(0.5, abs=0.01)


@pytest.mark.slow
def test_curves_and_drops_together():
    dilute, dense = glass_beads(0.15), glass_beads(0.15).replace(packing_fraction=0.15)
    hot = dense.replace(temperature=4 * dense.temperature)
    sets = {
        "dilute": (dilute, synthetic(dilute, jax.random.key(0), relative_error=0.03)),
        "dense": (dense, synthetic(hot, jax.random.key(1), relative_error=0.03)),
        "drops": (dilute, drop_test(dilute, jax.random.key(2))),
    }
    result = jaxgran.fit_jointly(sets, separate=("temperature",))
    truth = float(dilute.value(A[0]))
    a, error = float(result.estimate[A[0]]), float(result.standard_error[A[0]])
    assert abs(a - truth) < 3 * error and result.agree
    T_0, spread = result.separate["dense"]["temperature"]
    assert abs(T_0 - float(hot.temperature)) < 3 * spread < 0.2 * T_0
    assert set(result.separate) == {"dilute", "dense"}
    assert sum(share[A[0]] for share in result.weight.values()) == pytest.approx(1)
    # Alone, with a clock known within 1.5 %, each curve knows less.
    for label in ("dilute", "dense"):
        gas, curve = sets[label]
        alone = jaxgran.fit(gas, curve, free=("dissipative_constant", "temperature"))
        weight = result.weight[label][A[0]]
        expected = error / weight**0.5
        assert float(alone.standard_error[0]) == pytest.approx(expected, rel=0.35)
    # A curve of another material does not go with the others.
    other = dilute.replace(dissipative_constant=1.3 * truth)
    sets["dilute"] = (dilute, synthetic(other, jax.random.key(0), relative_error=0.03))
    contradicted = jaxgran.fit_jointly(sets, separate=("temperature",))
    assert not contradicted.agree and contradicted.p_value < 1e-4
    worst = max(contradicted.decrease, key=contradicted.decrease.get)
    assert worst == "dilute"


@pytest.mark.parametrize(
    "change, message",
    [
        ({"measurements": {}}, "takes two or more measurements"),
        ({"shared": ()}, "different names"),
        ({"shared": ("phi",)}, "no float 'phi'"),
        ({"separate": A}, "different names"),
        ({"model": jaxgran.DSMC(10)}, "a model without noise"),
    ],
)
def test_bad_requests_are_refused(change, message):
    gas = glass_beads(0.15)
    asked = {"measurements": {"a": (gas, drop_test(gas)), "b": (gas, drop_test(gas))}} | change
    with pytest.raises(ValueError, match=message):
        jaxgran.fit_jointly(asked.pop("measurements"), **asked)


def test_a_curve_without_errors_has_no_weight():
    gas = glass_beads(0.15)
    bare = jaxgran.CoolingCurve(times=[0.1, 0.2, 0.3], temperature=[0.01, 0.009, 0.008])
    with pytest.raises(ValueError, match="the curve of 'b' has no errors"):
        jaxgran.fit_jointly({"a": (gas, drop_test(gas)), "b": (gas, bare)})
    with pytest.raises(ValueError, match="measurement 'b' must hold a jaxgran.CoolingCurve or a"):
        jaxgran.fit_jointly({"a": (gas, drop_test(gas)), "b": (gas, 3)})


def test_drop_tests_are_read(tmp_path):
    path = tmp_path / "drops.csv"
    path.write_text("# glass on glass\nv,eps,eps_err\n0.1,0.9,0.01\n0.2,0.88,0.01\n")
    drops = jaxgran.read_drop_test(path, onto_plate=True)
    np.testing.assert_array_equal(drops.speed, [0.1, 0.2])
    assert drops.onto_plate
    for text, message in (
        ("v,e\n1,2\n", "line 1: the columns are v, e; name them v,eps,eps_err"),
        ("v,eps,eps_err\n0.1,0.9\n", "line 2: expected 3 finite numbers .*, got '0.1,0.9'"),
        ("v,eps,eps_err\n", "no rows of numbers"),
        ("v,eps,eps_err\n0.1,1.9,0.01\n", r"restitution must lie in \(0, 1\], got 1.9"),
        ("v,eps,eps_err\n0.1,0.9,0\n", "error must lie in"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            jaxgran.read_drop_test(path)
    with pytest.raises(ValueError, match="no such file"):
        jaxgran.read_drop_test(tmp_path / "missing.csv")
    with pytest.raises(ValueError, match="lists of equal length"):
        jaxgran.DropTest([0.1, 0.2], [0.9], [0.01])
