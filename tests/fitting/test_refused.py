"""Calls of fits that are refused, and what is said."""

import jax
import numpy as np
import optax
import optimistix as optx
import pytest

import jaxgran
from tests.beads import glass_beads

GAS = glass_beads(0.15)
A = "dissipative_constant"
TIMES = np.geomspace(0.1, 100.0, 40)
T = 0.01 / (1 + TIMES) ** (5 / 3)
CURVE = jaxgran.CoolingCurve(TIMES, T, temperature_error=0.01 * T)
FEW = jaxgran.CoolingCurve([0.0, 0.1, 0.2], [0.01, 0.009, 0.008], temperature_error=[0, 1e-4, 1e-4])
NO_VALUES = jaxgran.CoolingCurve(TIMES, T, displacement_error=T)
BARE = jaxgran.CoolingCurve([0.1, 0.2, 0.3], [0.01, 0.009, 0.008])
DROPS = jaxgran.DropTest([0.1, 0.3], [0.92, 0.9], [0.01, 0.01])
TWO = {"a": DROPS, "b": DROPS}
DSMC = jaxgran.DSMC(100, replicas=2)
SPLINE = jaxgran.RestitutionSpline([0.01, 0.03, 0.1, 0.3])
SPHERES = jaxgran.SoftSpheres(100, replicas=2)


def fixed():
    class Fixed(jaxgran.RestitutionLaw):
        def restitution(self, normal_speed):
            return 0.9

    return Fixed()


def with_law(law):
    return jaxgran.Gas(law, diameter=2e-3, mass=1e-5, packing_fraction=0.05, temperature=0.01)


REFUSED = [
    ({"free": "amplitude"}, "no float 'amplitude'"),
    ({"free": ()}, "free must be a tuple"),
    ({"free": ("temperature", "temperature")}, "different names"),
    ({"free": "law", "gas": with_law(fixed())}, 'free="law", but the law Fixed has no floats'),
    ({"solver": "simplex"}, "solver must be a least-squares solver or a minimiser"),
    ({"solver": "adam"}, "gradient transformation of optax"),
    ({"solver": optax.lbfgs()}, "line search"),
    ({"max_steps": 0}, "max_steps must be a whole number >= 1, or None, got 0"),
    ({"num_particles": -5}, "num_particles must be a whole number >= 1, or None, got -5"),
    ({"absent": ("gravity",)}, "absent must be a tuple of walls, roughness, drag"),
    (
        {"data": FEW, "free": (A, "temperature", "packing_fraction")},
        "2 points .* cannot determine 3 parameters; free fewer",
    ),
    ({"data": NO_VALUES}, "displacement_error without the values"),
    # priors
    ({"priors": [("packing_fraction", 0.05, 0.01)]}, "priors must be a dictionary of names"),
    ({"priors": {"phi": (0.05, 0.01)}}, "no float 'phi' in this gas; it has .*, and density"),
    ({"priors": {"packing_fraction": 0.05}}, r"packing_fraction needs \(value, standard error\)"),
    ({"priors": {"packing_fraction": (0.05, -0.01)}}, "error of packing_fraction must lie in"),
    ({"priors": {"packing_fraction": (0.05, 0.0)}}, "Leave out values that are known exactly"),
    ({"priors": {"packing_fraction": (1.5, 0.1)}}, "priors: packing_fraction must lie in"),
    ({"priors": {A: (0.0, 1e-7)}}, "lies on the end of its range"),
    # t0
    ({"free": (A, "t0"), "model": DSMC}, "t0 is fitted through kinetic theory only"),
    ({"priors": {"t0": (0.0, 1.0)}, "model": DSMC}, "t0 is fitted through kinetic theory only"),
    ({"data": {"a": CURVE, "b": CURVE}, "free": (A, "t0")}, "each has its own t0"),
    # models with noise
    (
        {"model": DSMC, "free": (A, "temperature"), "priors": {"temperature": (0.01, 1e-4)}},
        "leave temperature out of free",
    ),
    ({"model": jaxgran.SoftSpheres(100)}, "replicas >= 2"),
    ({"model": jaxgran.SoftSpheres(100, replicas=2, projection=None)}, "projection"),
    ({"model": SPHERES, "solver": optx.BFGS(1e-8, 1e-8)}, "least squares"),
    (
        {"model": DSMC, "start": GAS.replace(dissipative_constant=0.0)},
        "cannot start at dissipative_constant = 0.0",
    ),
    (
        {"model": DSMC, "gas": with_law(SPLINE), "free": "law"},
        r"needs KineticTheory\(\) or a solver of optax",
    ),
    # several measurements
    ({"data": {}}, "data is empty"),
    ({"data": TWO, "priors": {"c: mass": (1.0, 0.1)}}, "no measurement 'c'; there are"),
    ({"data": TWO, "num_particles": {"c": 10}}, "no measurement 'c'; there are a, b"),
    ({"data": TWO, "gas": {"a": GAS}}, "the same labels"),
    ({"data": TWO, "separate": (A,)}, "different names"),
    ({"data": TWO, "model": jaxgran.DSMC(10)}, "a model without noise"),
    ({"data": {"a": DROPS, "b": BARE}}, "the curve of 'b' has no errors"),
    ({"data": {"a": DROPS, "b": 3}}, "measurement 'b' must be a jaxgran.CoolingCurve or a"),
    ({"data": DROPS, "model": DSMC}, "drop tests are fitted by a model without noise"),
    ({"data": DROPS, "free": (A, "t0")}, "t0 needs a cooling curve"),
]


@pytest.mark.parametrize("change, message", REFUSED)
def test_fits_are_refused(change, message):
    asked = {"gas": GAS, "data": CURVE} | change
    with pytest.raises(ValueError, match=message):
        jaxgran.fit(asked.pop("gas"), asked.pop("data"), progress=False, **asked)


def test_a_traced_gas_is_refused_by_a_fit_through_particles():
    with pytest.raises(ValueError, match="one curve at a time"):
        jax.jit(lambda gas: jaxgran.fit(gas, CURVE, model=SPHERES).chi2)(GAS)


LIKELIHOODS = [
    ({"model": jaxgran.DSMC(10)}, "a likelihood needs a model without noise, got DSMC"),
    ({"clock": 0.0}, "clock must lie in"),
    ({"curve": 3}, "curve must be a jaxgran.CoolingCurve"),
]


@pytest.mark.parametrize("change, message", LIKELIHOODS)
def test_likelihoods_are_refused(change, message):
    asked = {"curve": CURVE} | change
    with pytest.raises(ValueError, match=message):
        jaxgran.log_likelihood(GAS, asked.pop("curve"), **asked)


SPLINES = [
    (([1.0],), "two or more increasing"),
    (([0.1, 1.0], [0.8, 0.9]), "that decrease"),
    (([0.1, 1.0], [1.0, 0.9]), r"in \(0, 1\)"),
    (([0.1, 1.0], [0.9, 0.8, 0.7]), "must be 2 numbers"),
    (([0.1, 1.0], [0.9, 0.8], 0.0), "smoothness"),
]


@pytest.mark.parametrize("arguments, message", SPLINES)
def test_splines_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        jaxgran.RestitutionSpline(*arguments)
