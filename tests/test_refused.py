"""Scenes, laws, settings, runs and fits that are refused, and what is said."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest

import jaxgran
from jaxgran import observables
from jaxgran.extend import ReducedLaw, RestitutionLaw
from tests.beads import SI, glass_beads, hard_gas, spheres
from tests.own_model import HaffLaw

NAN, INF = float("nan"), float("inf")
GAS, GRAINS = glass_beads(0.15), hard_gas(0.9, 0.02, **SI)
HOT = dataclasses.replace(GAS, drive=jaxgran.WhiteNoise(1e8))
A, T_0, PHI = "dissipative_constant", "temperature", "packing_fraction"
TIMES = np.geomspace(0.1, 100.0, 40)
T = 0.01 / (1 + TIMES) ** (5 / 3)
CURVE = jaxgran.CoolingCurve(TIMES, T, temperature_error=0.01 * T)
FEW = jaxgran.CoolingCurve([0.0, 0.1, 0.2], [0.01, 0.009, 0.008], temperature_error=[0, 1e-4, 1e-4])
NO_VALUES = jaxgran.CoolingCurve(TIMES, T, displacement_error=T)
DROPS = jaxgran.DropTest([0.1, 0.3], [0.92, 0.9], [0.01, 0.01])
DSMC, SOFT = jaxgran.DSMC(100, replicas=2), jaxgran.SoftSpheres(20)
SPLINE = hard_gas(jaxgran.RestitutionSpline([0.01, 0.03, 0.1, 0.3]), **SI)
ELASTIC = GAS.replace(dissipative_constant=0.0)
SPHERES = jaxgran.SoftSpheres(100, replicas=2)
HEATING = hard_gas(jaxgran.RestitutionSeries([0.1], [0.2]))
POINTS = jnp.ones((10, 3))
SIDE = GAS.box_side(20)
ROUGH = jaxgran.Rough(0.1)
OF_TWO = hard_gas(0.8, 0.1)
TOUCHING, APART = (
    spheres([[1.0, 1.0, 1.0], [x, 1.0, 1.0]], np.zeros((2, 3)), OF_TWO.box_side(2))
    for x in (1.5, 2.1)
)


class NoRestitution(RestitutionLaw):
    """A law that lacks a member."""


class NotReduced(RestitutionLaw):
    """A law whose reduced law is itself, which is none."""

    def reduced(self, *, diameter, mass, speed):
        return self

    def restitution(self, normal_speed):
        return jnp.exp(-normal_speed)


class InMetres(NotReduced, ReducedLaw):
    """A law that takes speeds in units of a reference speed for speeds in m/s."""


class OfMass(NotReduced, ReducedLaw):
    """A law with a float called like one of the gas."""

    mass: float = 1.0
    domains = {"mass": jaxgran.extend.Domain()}

    def restitution(self, normal_speed):
        return 0.9 * jnp.ones_like(normal_speed)


class BelowZero(RestitutionLaw):
    """A law that is meant for slow impacts."""

    slope: float

    def restitution(self, normal_speed):
        return 1 - self.slope * normal_speed


class Fixed(RestitutionLaw):
    """A law without floats."""

    def restitution(self, normal_speed):
        return 0.9


class Open(RestitutionLaw):
    """A law whose float has a range of its own."""

    coefficient: float
    domains = {"coefficient": jaxgran.extend.Domain(0.0, 1.0)}

    def restitution(self, normal_speed):
        return self.coefficient


FIXED = hard_gas(Fixed(), **SI)


def gas_with(**fields):
    return dataclasses.replace(GRAINS, **fields)


def between_walls(side=SIDE, restitution=GAS.law, surface=None, **tangential):
    walls = jaxgran.Walls(side, restitution=restitution, **tangential)
    return dataclasses.replace(GAS, container=walls, surface=surface)


def steady_state(eps, strength):
    return jaxgran.steady_state(hard_gas(eps, drive=jaxgran.WhiteNoise(strength)))


def cool(gas=GAS, times=(0.1,), **options):
    return jaxgran.cool(gas, times, progress=False, **options)


def choose(*tolerance, **options):
    return jaxgran.choose_model(GAS, [0.1], *tolerance, **options)


def measured(data=CURVE, gas=GAS, **known):
    return jaxgran.Measurement(gas, data, **known)


def fit(measurement=None, **options):
    measurement = measured() if measurement is None else measurement
    return jaxgran.fit(measurement, progress=False, **options)


HOT_SPINS = jaxgran.Rough(0.5, rotational_temperature=1e6)
STICKY = jaxgran.Rough(0.5, friction=0.0)
HAFF = {"model": HaffLaw(), "free": ("coefficient",)}
"""A fit of `GRAINS` that compiles in no time."""


def slip(field, point, value):
    """Return a measurement with a number that cannot be measured."""
    slipped = getattr(CURVE, field).at[point].set(value)
    return measured(dataclasses.replace(CURVE, **{field: slipped}))


SCENES = [
    # gases
    (lambda: jaxgran.impact(-0.1), r"beta must lie in \[0, inf\), got -0.1"),
    (lambda: gas_with(packing_fraction=0.0), r"packing_fraction .* \(0, 0.74048\), got 0"),
    (lambda: gas_with(diameter=-1e-3), "diameter .* metres"),
    (lambda: gas_with(mass=0.0), "mass .* kilograms"),
    (lambda: gas_with(temperature=-1.0), "temperature"),
    (lambda: gas_with(dimension=4), "dimension must be 2 or 3, got 4"),
    (lambda: gas_with(law=0.9), "law must be a restitution law"),
    (lambda: GRAINS.replace(temprature=1.0), "Gas has no parameter 'temprature'; it has coef"),
    (lambda: GRAINS.replace(packing_fraction=0.9), "packing_fraction must lie in"),
    (
        lambda: jaxgran.steady_state(
            gas_with(drive=jaxgran.WhiteNoise(1e-3), surface=jaxgran.Frictional(0.5, 0.5))
        ),
        "steady state of a gas with friction is not known",
    ),
    (lambda: cool(between_walls().replace(wall_side=1.25 * GAS.diameter)), r"must lie in \(2.1"),
    (
        lambda: cool(dataclasses.replace(GAS, surface=HOT_SPINS)),
        "overlap by .* to which the gas heats up",
    ),
    (lambda: GRAINS.delta, "delta belongs to the Viscoelastic law"),
    (lambda: jaxgran.sphere_mass(-1.0, 2500.0), "diameter"),
    # laws
    (lambda: jaxgran.Viscoelastic(-1.0, 0.3, 1e-6), r"youngs_modulus .*\(0, inf\), got -1"),
    (lambda: jaxgran.Viscoelastic(1e7, 0.5, 1e-6), r"poisson_ratio .*\(-1, 0.5\), got 0.5"),
    (lambda: jaxgran.Viscoelastic(1e7, 0.3, -1e-9), r"dissipative_constant .*\[0, inf\)"),
    (lambda: jaxgran.Viscoelastic(NAN, 0.3, 0.0), "got nan"),
    (lambda: jaxgran.ConstantRestitution(1.1), r"coefficient .*\[0, 1\], got 1.1"),
    (lambda: jaxgran.RestitutionSeries([0.1, 0.2], [0.2]), "same length"),
    (lambda: jaxgran.RestitutionSeries([INF], [0.2]), "got inf"),
    (lambda: Open(2.0), r"coefficient must lie in \(0, 1\), got 2"),
    # rough spheres, drag and walls
    (lambda: jaxgran.Rough(1.1), r"tangential_restitution .*\[-1, 1\], got 1.1"),
    (lambda: jaxgran.Rough(0.0, inertia=0.0), r"inertia must lie in \(0, 1\]"),
    (lambda: jaxgran.Rough(0.0, rotational_temperature=-1.0), "rotational_temperature"),
    (lambda: jaxgran.Rough(0.5, friction=-0.1), "friction must lie in"),
    (lambda: jaxgran.StokesDrag(-1.0), r"rate of the drag must lie in \[0, inf\), got -1"),
    (lambda: jaxgran.Walls(0.0, restitution=0.9), "side of the walls must lie in"),
    (lambda: jaxgran.Walls(0.1, restitution=1.2), "restitution of the walls must lie in"),
    (lambda: jaxgran.Walls(0.1, restitution="hard"), "restitution of the walls must be a num"),
    (lambda: between_walls(4.1e-3), r"walls / diameter must lie in \(2.1, inf\), got 2.05"),
    (lambda: between_walls([0.1, 0.1]), "must be one number or 3"),
    (lambda: between_walls(tangential_restitution=0.0), "needs rough spheres: add surface"),
    (lambda: jaxgran.Frictional(0.5, -0.1), "friction must lie in"),
    (lambda: jaxgran.Frictional(-0.5, 0.1), "tangential_damping must lie in"),
    (lambda: between_walls(friction=0.1), "no tangential_damping.*Give"),
    (
        lambda: between_walls(friction=-0.1, tangential_damping=0.5),
        "friction of the walls must lie in",
    ),
    (lambda: between_walls(friction=0.4, tangential_damping=0.8), "walls needs frictional spheres"),
    (
        lambda: gas_with(drag=jaxgran.StokesDrag(0.1, rotational_rate=0.2)),
        "rotational_rate .*rotate, .*0.2",
    ),
    (lambda: gas_with(surface=0.5), "jaxgran.Rough, .*jaxgran.Frictional"),
    (lambda: gas_with(drag=0.5), "jaxgran.StokesDrag .*got 0.5"),
    # drives
    (lambda: jaxgran.WhiteNoise(-1.0), "strength of the drive"),
    (lambda: gas_with(drive=1.0), r"expected a jaxgran\.WhiteNoise"),
    (lambda: steady_state(1.0, 0.01), "the drive at no temperature"),
    (lambda: steady_state(0.9, 0.0), "the drive at no"),
    (lambda: jaxgran.steady_state(GRAINS), "add drive=WhiteNoise"),
    # At T_0 they overlap by .4 %, in the steady state by more than theory can correct.
    (lambda: cool(HOT), "T_0, to which the gas heats up.*SoftSpheres"),
    (lambda: jaxgran.KineticTheory(initial_sonine=-0.5), "initial_sonine must lie in .*got -0.5"),
    (
        lambda: jaxgran.KineticTheory(initial_sonine=0.1, corrections=()),
        'initial_sonine = 0.1 needs "sonine" among',
    ),
    # settings of models
    (lambda: jaxgran.KineticTheory(order=4), "order must be 2 or 3, got 4"),
    (lambda: jaxgran.DSMC(1), "num_particles .*>= 2"),
    (lambda: jaxgran.DSMC(10, step=0.2), r"step must lie in \(0, 0.1\], got 0.2"),
    (lambda: jaxgran.DSMC(10, replicas=0), "replicas must be a whole number >= 1"),
    (lambda: jaxgran.HardSpheres(10.0), "num_particles must be a whole number >= 2"),
    (lambda: jaxgran.HardSpheres(10, contact_time=1.0), "contact_time must"),
    (lambda: jaxgran.HardSpheres(10, neighbours="best"), "neighbours must be one of"),
    (lambda: jaxgran.HardSpheres(10, differences=0.6), r"differences must lie in \(0, 0.5\]"),
    (lambda: jaxgran.SoftSpheres(10, differences=0.0), r"differences must lie in \(0, 0.5\]"),
    (lambda: jaxgran.SoftSpheres(10, differences=0.3, projection=None), "two kinds of derivative"),
    (lambda: jaxgran.SoftSpheres(10, projection=0.0), "projection must"),
    (lambda: jaxgran.SoftSpheres(10, steps_per_contact=5), "steps_per_contact"),
    # numbers
    (
        lambda: jaxgran.extend.Domain(0.0).check("speed", "steel", "Give m/s."),
        "in .0, inf., got .* Give",
    ),
    (
        lambda: jaxgran.extend.Domain(0.0, 1.0, high_allowed=True).check("share", [1.0, 0.0]),
        r"share must lie in \(0, 1\], got 0",
    ),
    *(
        (partial(jaxgran.extend.Domain().check, "share", x), "share must lie in")
        for x in (NAN, INF, -INF)
    ),
    (lambda: jaxgran.CoolingCurve(["steel"], [1.0]), "a number or an array"),
    (lambda: jaxgran.CoolingCurve([object()], [1.0]), "a number or an array"),
    (lambda: jaxgran.CoolingCurve([1.0, [2.0]], [1.0]), "a number or an array"),
]
CALLS = [
    (lambda: cool(GAS.replace(mass=[1.0, 2.0])), "mass .* shape .2,.*vmap"),
    (lambda: measured(gas=GAS.replace(mass=np.ones(4))), "vmap"),
    (lambda: cool(model=jaxgran.SoftSpheres), "got the class SoftSpheres"),
    (lambda: cool(model=3), "model must be a jaxgran model, got 3"),
    (
        lambda: cool(GAS.replace(diameter=1e-300), model=jaxgran.HardSpheres(20)),
        "diameter 1e-300 m .*small",
    ),
    (lambda: cool(model=SOFT, key=5), "jax.random.key.5., got 5"),
    (lambda: cool(model=SOFT, checkpoint=5), "checkpoint must be a path"),
    (lambda: cool(times=[1j]), "times must be a list of numbers"),
    *((partial(cool, times=[x]), f"finite and not negative, got {x}") for x in (-1, INF, NAN)),
    (lambda: cool(times=[0.0, 2.0, 2.0]), "must increase, got 2 after 2"),
    (lambda: cool(times=[]), r"a list of numbers, got shape \(0,\)"),
    (lambda: cool(model=SOFT, save="velocity"), 'a replica, or "particles"'),
    (lambda: cool(save=lambda p: 1), "KineticTheory has no particles"),
    # measurements
    (
        lambda: measured(None),
        "data .*CoolingCurve .*DropTest, got NoneType",
    ),
    (lambda: measured((TIMES, T)), "by jaxgran.CoolingCurve.t, T."),
    (lambda: measured(gas=None), "jaxgran.Gas, got None"),
    (lambda: measured(num_particles=-5), "num_particles .*>= 1, .*got -5"),
    (lambda: measured(replicas=0), "replicas .*>= 1, .*got 0"),
    (lambda: measured(num_particles=10, tracked=20), "tracked .*N = 10, got 20"),
    (lambda: measured(calibration_error=-0.1), "calibration_error must lie in"),
    (lambda: measured(errors_measured="no"), "errors_measured must be True"),
    (lambda: measured(absent=("gravity",)), "absent .*walls, roughness, drag"),
    (lambda: measured(absent="walls"), "absent .*walls, roughness, drag"),
    (lambda: measured(absent=5), "absent .*walls, roughness, drag.*got 5"),
    (lambda: measured(rounding={"temperature": [1e-6, 1e-6]}), "one for each time, got shape .2,"),
    (lambda: measured(guesses=("beta",)), "guesses .*got .'beta'"),
    (lambda: measured(NO_VALUES), "displacement_error without the values"),
    (lambda: measured(priors=[(PHI, 0.05, 0.01)]), "priors must be a dictionary"),
    (
        lambda: measured(priors={"phi": (0.05, 0.01)}),
        "Gas has no parameter 'phi'; it has .*, and density",
    ),
    (lambda: measured(priors={PHI: 0.05}), r"packing_fraction needs \(value, standard error\)"),
    (lambda: measured(priors={PHI: (0.05, -0.01)}), "error of packing_fraction must lie in"),
    (lambda: measured(priors={PHI: (0.05, 0.0)}), "Leave out values"),
    (lambda: measured(priors={PHI: (1.5, 0.1)}), "priors: packing_fraction must lie in"),
    (lambda: measured(priors={A: (0.0, 1e-7)}), "lies on the end of its range"),
    (lambda: measured(DROPS).curve, "a drop test, without a curve"),
    (lambda: fit(CURVE), "got a CoolingCurve. .*jaxgran.read_measurement"),
    (lambda: fit((TIMES, T)), "got a tuple. .*jaxgran.read_measurement"),
    (lambda: fit({}), "no measurement is given"),
    (lambda: fit({"a": measured(), "b": CURVE}), "'b' .*jaxgran.Measurement, got a Cool"),
    (lambda: fit({"a: b": measured()}), "labels of measurements .*without"),
    (lambda: SOFT.sized_for(GAS, spare=-1), "spare must lie in"),
    (lambda: cool(model=jaxgran.SoftSpheres(20, start=(1, 2))), "Particles"),
    (
        lambda: cool(OF_TWO, model=jaxgran.HardSpheres(2, start=TOUCHING)),
        "0.5 diameters apart.*overlap",
    ),
    (lambda: cool(OF_TWO, model=jaxgran.HardSpheres(3, start=APART)), "start.position has shape"),
    (lambda: cool(hard_gas(0.8, 0.09), model=jaxgran.HardSpheres(2, start=APART)), "start.box_s"),
    (lambda: jax.jit(partial(cool, model=SOFT))(GAS), "sized_for"),
    (
        lambda: SOFT.check(between_walls(surface=ROUGH, tangential_restitution=0.5)),
        "belongs to instantaneous impacts.*tangential_damping",
    ),
    (
        lambda: cool(between_walls(restitution=0.9), model=SOFT),
        "needs walls of the Viscoelastic law.*Use HardSpheres",
    ),
    (
        lambda: cool(between_walls(GAS.box_side(24)), model=SOFT),
        "of packing_fraction 0.05 need 0.833",
    ),
    (lambda: jaxgran.Viscoelastic("5e7", 0.2, 1e-6), "got '5e7'"),
    (lambda: GAS.replace(mass=True), "mass must be a number"),
    *(
        (partial(jaxgran.KineticTheory, x), "corrections must be")
        for x in ("sonine", ["sonine", "heat"], False, [[]])
    ),
    (lambda: jaxgran.DSMC(50, replicas=True), "whole number >= 1"),
    (lambda: jaxgran.SoftSpheres(20, projection="x"), "number"),
    (lambda: jaxgran.KineticTheory(rtol=-1), "rtol must lie in"),
    (lambda: jaxgran.KineticTheory(max_steps=0), "max_steps must be a whole number"),
    (lambda: GAS.box_side(-5), "num_particles must be a whole"),
    (lambda: jaxgran.viscoelastic_restitution(-1.0), "beta must lie in"),
    (lambda: jaxgran.RestitutionSeries([], []), "same length, 1 or more"),
    (lambda: hard_gas(OfMass()), "'mass'.*rename it"),
    (lambda: NoRestitution(), "define restitution"),
    (lambda: hard_gas(InMetres()), "0.04979 at 0.3 m/s .* leave `reduced`"),
    (lambda: cool(hard_gas(BelowZero(1.0))), "eps = -.* at a speed of"),
    (lambda: cool(hard_gas(BelowZero(jnp.nan))), "must be|must lie"),
    (lambda: cool(throw="no"), "throw must be True or"),
    (lambda: jaxgran.cool(GAS, [0.1], progress=5), "must be True"),
    (lambda: jaxgran.DropTest(np.ma.masked_all(1), [0.9], [0.01]), "are masked"),
    (lambda: jaxgran.read_particles(None), "name of a file, got None"),
    (lambda: jaxgran.read_curve("a.csv", [1]), "must be a dictionary"),
    (lambda: jaxgran.read_particles("a.gsd", dimension=4), "must be 2 or 3"),
    (lambda: cool(model=DSMC, trajectory="a.gsd"), "DSMC has no positions"),
    (lambda: cool(model=SOFT, trajectory="a.dcd"), ".gsd or .xyz, got 'a.dcd'"),
    (lambda: cool(model=SOFT, trajectory=3), "must be a path, got 3"),
    (lambda: hard_gas(NotReduced()), "must return a .*ReducedLaw"),
    (lambda: cool(checkpoint="run.ckpt"), "no run to be saved"),
    (
        lambda: jax.jit(partial(cool, model=DSMC, checkpoint="run.ckpt"))(GAS),
        "DSMC cannot write a checkpoint.*Set checkpoint=None",
    ),
    (lambda: cool(HEATING), "makes this gas heat up"),
    (lambda: cool(HEATING, model=DSMC), "makes this gas heat up"),
    # GPa taken for Pa
    (lambda: cool(GAS.replace(youngs_modulus=0.05)), "Check that youngs_modulus is in Pa"),
    (lambda: slip("temperature", 2, 1e308), r"1e\+308, which cannot be measured"),
    (lambda: slip("temperature", 2, 1e-320), "e-321, which cannot be measured"),
    (lambda: slip("times", -1, 1e308), r"1e\+308, which cannot be measured"),
    (lambda: slip("temperature_error", 1, 1e-300), "1e-300, which cannot be measured"),
    # observables
    (partial(observables.pair_correlation, POINTS, 1.0, [0.2, 0.1]), "increasing numbers >= 0"),
    (partial(observables.pair_correlation, POINTS, 1.0, [0.2, 0.51]), "last edge.* 0.5, got 0.51"),
    (partial(observables.pair_correlation, POINTS, 1.0, [0.1, 0.2], 11), "from 1 to 10, got 11"),
    (
        partial(observables.pair_correlation, POINTS[None], 1.0, [0.0, 0.1]),
        "got .1, 10, 3.: take particles.position.0",
    ),
    (partial(observables.structure_factor, POINTS, 1.0, 0), "num_shells must be a whole number"),
    (partial(observables.cell_density, POINTS, 1.0, 0), "cells .*>= 1, got 0"),
    (partial(observables.velocity_distribution, POINTS, [0.1]), "at least two increasing numbers"),
    # the choice of a model
    *((partial(choose, x), "tolerance must") for x in (0, -0.1, NAN, "2 %")),
    (lambda: choose(num_particles=1), "num_particles must be a whole number >= 2, an"),
    (lambda: cool(tolerance=0.1), 'go with model="auto"'),
    (lambda: jax.jit(partial(cool, model="auto"))(GAS), "choose_model outside"),
    (lambda: fit(model="auto"), "must be a jaxgran model, got .auto"),
    (
        lambda: jaxgran.log_likelihood(GAS, measured(), model=jaxgran.DSMC(10)),
        "without noise, got DSMC",
    ),
    (lambda: jaxgran.log_likelihood(GAS, CURVE), "measurement must be a jaxgran.Measurement"),
    (lambda: jaxgran.log_likelihood(GAS, measured(DROPS)), "a drop test, without a curve"),
    (
        lambda: jaxgran.log_likelihood(GAS, measured(priors={"t0": (1.0, 0.1)})),
        "log_likelihood has no t0: give the times since the start",
    ),
    (lambda: jaxgran.RestitutionSpline([1.0]), "two or more increasing"),
    (lambda: jaxgran.RestitutionSpline([0.1, 1.0], [0.8, 0.9]), "do not increase"),
    (lambda: jaxgran.RestitutionSpline([0.1, 1.0], [1.1, 0.9]), r"in \(0, 1\]"),
    (lambda: jaxgran.RestitutionSpline([0.1, 1.0], [0.9, 0.8, 0.7]), "must be 2 numbers"),
    (lambda: jaxgran.RestitutionSpline([0.1, 1.0], [0.9, 0.8], 0.0), "smoothness"),
]
OTHER_DROPS = dataclasses.replace(DROPS, restitution=DROPS.restitution - 0.01)
LATER = dataclasses.replace(CURVE, times=CURVE.times + 1.0)
TWO = {"a": measured(DROPS), "b": measured(OTHER_DROPS)}
DISAGREE = {
    "a": measured(DROPS, priors={"youngs_modulus": (5e7, 1e6)}),
    "b": measured(OTHER_DROPS, priors={"youngs_modulus": (6e7, 1e6)}),
}
FITS = [
    ({"free": "amplitude"}, "Gas has no parameter 'amplitude'"),
    ({"free": ()}, "free must be a tuple"),
    ({"free": (T_0, T_0)}, "different names"),
    (
        {"free": "law", "measurement": measured(gas=FIXED)},
        'free="law", .*Fixed has no parameters',
    ),
    ({"solver": "simplex"}, "solver must be .*optax"),
    (HAFF | {"measurement": measured(gas=GRAINS), "solver": optax.lbfgs()}, "line search"),
    ({"max_steps": 0}, "max_steps .*>= 1, .*got 0"),
    ({"quick": 1}, "quick must be True or False"),
    (
        {"measurement": measured(FEW), "free": (A, T_0, PHI)},
        "3 points .*3 parameters; free fewer",
    ),
    # t0
    ({"free": (A, "t0"), "model": DSMC}, "t0 .*kinetic theory only"),
    (
        {"measurement": measured(priors={"t0": (0.0, 1.0)}), "model": DSMC},
        "t0 .*kinetic theory only",
    ),
    (
        {"measurement": {"a": measured(), "b": measured(LATER)}, "free": (A, "t0")},
        "each has its own t0",
    ),
    # models with noise
    (
        {"measurement": measured(priors={T_0: (0.01, 1e-4)}), "model": DSMC, "free": (A, T_0)},
        "leave temperature out of",
    ),
    ({"model": jaxgran.SoftSpheres(100)}, "replicas >= 2"),
    ({"model": jaxgran.SoftSpheres(100, replicas=2, projection=None)}, "projection"),
    ({"model": SPHERES, "solver": optx.BFGS(1e-8, 1e-8)}, "solver must be a gradient transform"),
    ({"model": DSMC, "start": ELASTIC}, "start at dissipative_constant = 0.0"),
    (
        {"measurement": measured(gas=dataclasses.replace(GAS, surface=STICKY))}
        | {"free": (A, "friction")},
        "start at friction = 0.0",
    ),
    (
        {"measurement": measured(gas=SPLINE), "model": DSMC, "free": "law"},
        "KineticTheory.. or a solver of optax",
    ),
    (
        {"measurement": measured(gas=OF_TWO), "free": ("coefficient", T_0)}
        | {"model": jaxgran.HardSpheres(2, replicas=2, start=APART)},
        "temperature .*given start",
    ),
    # several measurements
    (
        {
            "measurement": {
                "a": measured(priors={"dissipative_constant": (1e-6, 1e-8)}),
                "b": measured(LATER),
            },
            "free": "youngs_modulus",
            "separate": (A,),
        },
        "dissipative_constant is fitted separately for each curve",
    ),
    ({"measurement": TWO, "free": A, "separate": (A,)}, "different names"),
    ({"measurement": TWO, "model": jaxgran.DSMC(10)}, "a model without noise"),
    ({"measurement": DISAGREE}, "different values .*5e.07 .* and 6e.07"),
    ({"measurement": {"": measured()}}, "labels of measurements are texts"),
    ({"measurement": measured(DROPS), "model": DSMC}, "drop tests .*a model without"),
    ({"measurement": measured(DROPS), "free": (A, "t0")}, "t0 needs a cooling curve"),
]
CALLS += [(partial(fit, **change), words) for change, words in FITS]


@pytest.mark.parametrize("call, words", [pytest.param(*row, id=row[1]) for row in SCENES + CALLS])
def test_refused(call, words):
    with pytest.raises((ValueError, TypeError), match=words) as error:
        call()
    assert error.type is ValueError or "abstract" in str(error.value)
