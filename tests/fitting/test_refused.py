"""Calls of fits that are refused, and what is said."""

import jax
import numpy as np
import optax
import optimistix as optx
import pytest

import jaxgran
from tests.beads import SI, glass_beads, hard_gas

GAS = glass_beads(0.15)
A, T_0, PHI = "dissipative_constant", "temperature", "packing_fraction"
TIMES = np.geomspace(0.1, 100.0, 40)
T = 0.01 / (1 + TIMES) ** (5 / 3)
CURVE = jaxgran.CoolingCurve(TIMES, T, temperature_error=0.01 * T)
FEW = jaxgran.CoolingCurve([0.0, 0.1, 0.2], [0.01, 0.009, 0.008], temperature_error=[0, 1e-4, 1e-4])
NO_VALUES = jaxgran.CoolingCurve(TIMES, T, displacement_error=T)
BARE = jaxgran.CoolingCurve([0.1, 0.2, 0.3], [0.01, 0.009, 0.008])
DROPS = jaxgran.DropTest([0.1, 0.3], [0.92, 0.9], [0.01, 0.01])
TWO = {"a": DROPS, "b": DROPS}
DSMC = jaxgran.DSMC(100, replicas=2)
SPLINE = hard_gas(jaxgran.RestitutionSpline([0.01, 0.03, 0.1, 0.3]), **SI)
ELASTIC = GAS.replace(dissipative_constant=0.0)
SPHERES = jaxgran.SoftSpheres(100, replicas=2)


class Fixed(jaxgran.RestitutionLaw):
    def restitution(self, normal_speed):
        return 0.9


FIXED = hard_gas(Fixed(), **SI)


def fit(gas=GAS, data=CURVE, **options):
    return jaxgran.fit(gas, data, progress=False, **options)


def likelihood(curve=CURVE, **options):
    return jaxgran.log_likelihood(GAS, curve, **options)


FITS = [
    ({"free": "amplitude"}, "no float 'amplitude'"),
    ({"free": ()}, "free must be a tuple"),
    ({"free": (T_0, T_0)}, "different names"),
    ({"free": "law", "gas": FIXED}, 'free="law", but the law Fixed has no floats'),
    ({"solver": "simplex"}, "solver must be a least-squares solver or a minimiser"),
    ({"solver": "adam"}, "gradient transformation of optax"),
    ({"solver": optax.lbfgs()}, "line search"),
    ({"max_steps": 0}, "max_steps must be a whole number >= 1, or None, got 0"),
    ({"num_particles": -5}, "num_particles must be a whole number >= 1, or None, got -5"),
    ({"absent": ("gravity",)}, "absent must be a tuple of walls, roughness, drag"),
    ({"data": FEW, "free": (A, T_0, PHI)}, "2 points .* cannot determine 3 parameters; free fewer"),
    ({"data": NO_VALUES}, "displacement_error without the values"),
    # priors
    ({"priors": [(PHI, 0.05, 0.01)]}, "priors must be a dictionary of names"),
    ({"priors": {"phi": (0.05, 0.01)}}, "no float 'phi' in this gas; it has .*, and density"),
    ({"priors": {PHI: 0.05}}, r"packing_fraction needs \(value, standard error\)"),
    ({"priors": {PHI: (0.05, -0.01)}}, "error of packing_fraction must lie in"),
    ({"priors": {PHI: (0.05, 0.0)}}, "Leave out values that are known exactly"),
    ({"priors": {PHI: (1.5, 0.1)}}, "priors: packing_fraction must lie in"),
    ({"priors": {A: (0.0, 1e-7)}}, "lies on the end of its range"),
    # t0
    ({"free": (A, "t0"), "model": DSMC}, "t0 is fitted through kinetic theory only"),
    ({"priors": {"t0": (0.0, 1.0)}, "model": DSMC}, "t0 is fitted through kinetic theory only"),
    ({"data": {"a": CURVE, "b": CURVE}, "free": (A, "t0")}, "each has its own t0"),
    # models with noise
    ({"model": DSMC, "free": (A, T_0), "priors": {T_0: (0.01, 1e-4)}}, "leave temperature out of"),
    ({"model": jaxgran.SoftSpheres(100)}, "replicas >= 2"),
    ({"model": jaxgran.SoftSpheres(100, replicas=2, projection=None)}, "projection"),
    ({"model": SPHERES, "solver": optx.BFGS(1e-8, 1e-8)}, "least squares"),
    ({"model": DSMC, "start": ELASTIC}, "cannot start at dissipative_constant = 0.0"),
    ({"model": DSMC, "gas": SPLINE, "free": "law"}, "KineticTheory.. or a solver of optax"),
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
OTHERS = [
    (lambda: jax.jit(lambda gas: fit(gas, model=SPHERES).chi2)(GAS), "one curve at a time"),
    (lambda: likelihood(model=jaxgran.DSMC(10)), "needs a model without noise, got DSMC"),
    (lambda: likelihood(clock=0.0), "clock must lie in"),
    (lambda: likelihood(3), "curve must be a jaxgran.CoolingCurve"),
    (lambda: jaxgran.RestitutionSpline([1.0]), "two or more increasing"),
    (lambda: jaxgran.RestitutionSpline([0.1, 1.0], [0.8, 0.9]), "that decrease"),
    (lambda: jaxgran.RestitutionSpline([0.1, 1.0], [1.0, 0.9]), r"in \(0, 1\)"),
    (lambda: jaxgran.RestitutionSpline([0.1, 1.0], [0.9, 0.8, 0.7]), "must be 2 numbers"),
    (lambda: jaxgran.RestitutionSpline([0.1, 1.0], [0.9, 0.8], 0.0), "smoothness"),
]


@pytest.mark.parametrize("change, message", FITS)
def test_fits_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        fit(**change)


@pytest.mark.parametrize("call, message", OTHERS)
def test_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
