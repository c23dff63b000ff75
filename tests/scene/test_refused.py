"""Scenes, laws and elements that are refused, and what is said."""

import dataclasses

import pytest

import jaxgran
from tests.beads import SI, glass_beads, hard_gas

NAN, INF = float("nan"), float("inf")
GAS = hard_gas(0.9, 0.02, **SI)
HOT = dataclasses.replace(glass_beads(), drive=jaxgran.WhiteNoise(1e8))


def gas_with(**fields):
    return dataclasses.replace(GAS, **fields)


def between_walls(side, **tangential):
    return gas_with(container=jaxgran.Walls(side, restitution=0.9, **tangential))


def steady_state(eps, strength):
    return jaxgran.steady_state(hard_gas(eps, drive=jaxgran.WhiteNoise(strength)))


class Open(jaxgran.RestitutionLaw):
    """A law whose float has a range of its own."""

    coefficient: float
    domains = {"coefficient": jaxgran.Domain(0.0, 1.0)}

    def restitution(self, normal_speed):
        return self.coefficient


REFUSED = [
    (lambda: jaxgran.impact(-0.1), r"beta must lie in \[0, inf\), got -0.1"),
    # gases
    (lambda: gas_with(packing_fraction=0.0), r"packing_fraction .* \(0, 0.74048\), got 0"),
    (lambda: gas_with(packing_fraction=0.75), "close packing"),
    (lambda: gas_with(diameter=-1e-3), "diameter .* metres"),
    (lambda: gas_with(mass=0.0), "mass .* kilograms"),
    (lambda: gas_with(temperature=-1.0), "temperature"),
    (lambda: gas_with(temperature=INF), "temperature"),
    (lambda: gas_with(dimension=4), "dimension must be 2 or 3, got 4"),
    (lambda: gas_with(law=0.9), "law must be a restitution law"),
    (lambda: GAS.replace(temprature=1.0), "no float 'temprature' in this gas; it has coefficient"),
    (lambda: GAS.replace(packing_fraction=0.9), "packing_fraction must lie in"),
    (lambda: GAS.delta, "delta belongs to the Viscoelastic law"),
    (lambda: jaxgran.sphere_mass(-1.0, 2500.0), "diameter"),
    (lambda: jaxgran.sphere_mass("wide", 2500.0), "diameter"),
    # laws
    (lambda: jaxgran.Viscoelastic(-1.0, 0.3, 1e-6), r"youngs_modulus .*\(0, inf\), got -1"),
    (lambda: jaxgran.Viscoelastic(0.0, 0.3, 1e-6), "youngs_modulus"),
    (lambda: jaxgran.Viscoelastic(1e7, 0.5, 1e-6), r"poisson_ratio .*\(-1, 0.5\), got 0.5"),
    (lambda: jaxgran.Viscoelastic(1e7, -1.0, 1e-6), "poisson_ratio"),
    (lambda: jaxgran.Viscoelastic(1e7, 0.3, -1e-9), r"dissipative_constant .*\[0, inf\)"),
    (lambda: jaxgran.Viscoelastic(NAN, 0.3, 0.0), "got nan"),
    (lambda: jaxgran.Viscoelastic("steel", 0.3, 0.0), "number"),
    (lambda: jaxgran.ConstantRestitution(1.1), r"coefficient .*\[0, 1\], got 1.1"),
    (lambda: jaxgran.ConstantRestitution(-0.1), "coefficient"),
    (lambda: jaxgran.RestitutionSeries([0.1, 0.2], [0.2]), "same length"),
    (lambda: jaxgran.RestitutionSeries([INF], [0.2]), "got inf"),
    (lambda: Open(2.0), r"coefficient must lie in \(0, 1\), got 2"),
    # rough spheres, drag and walls
    (lambda: jaxgran.Rough(1.1), r"tangential_restitution must lie in \[-1, 1\], got 1.1"),
    (lambda: jaxgran.Rough(0.0, inertia=0.0), r"inertia must lie in \(0, 1\]"),
    (lambda: jaxgran.Rough(0.0, rotational_temperature=-1.0), "rotational_temperature"),
    (lambda: jaxgran.Rough(0.5, friction=-0.1), "friction must lie in"),
    (lambda: jaxgran.StokesDrag(-1.0), r"rate of the drag must lie in \[0, inf\), got -1"),
    (lambda: jaxgran.Walls(0.0, restitution=0.9), "side of the walls must lie in"),
    (lambda: jaxgran.Walls(0.1, restitution=1.2), "restitution of the walls must lie in"),
    (lambda: jaxgran.Walls(0.1, restitution="hard"), "restitution of the walls must be a num"),
    (lambda: between_walls(4.1e-3), r"walls / diameter must lie in \(2.1, inf\), got 2.05"),
    (lambda: between_walls([0.1, 0.1]), "must be one number or 3"),
    (lambda: between_walls(0.1, tangential_restitution=0.0), "needs rough spheres: add surface"),
    (
        lambda: gas_with(drag=jaxgran.StokesDrag(0.1, rotational_rate=0.2)),
        "rotational_rate of the drag needs spheres that rotate, got a rate of 0.2",
    ),
    (lambda: gas_with(surface=0.5), "expected a jaxgran.Rough, a jaxgran.Frictional or"),
    (lambda: gas_with(drag=0.5), "expected a jaxgran.StokesDrag or None, got 0.5"),
    # drives
    (lambda: jaxgran.WhiteNoise(-1.0), "strength of the drive"),
    (lambda: gas_with(drive=1.0), r"expected a jaxgran\.WhiteNoise"),
    (lambda: steady_state(1.0, 0.01), "losses balance the drive at no temperature"),
    (lambda: steady_state(0.9, 0.0), "balance the drive at no"),
    (lambda: jaxgran.steady_state(GAS), "add drive=WhiteNoise"),
    # At T_0 they overlap by .4 %, in the steady state by more than theory can correct.
    (lambda: jaxgran.cool(HOT, [1e-6]), "T_0, to which the gas heats up.*SoftSpheres"),
    (lambda: jaxgran.KineticTheory(initial_sonine=-0.5), "initial_sonine must lie in .*got -0.5"),
    (
        lambda: jaxgran.KineticTheory(initial_sonine=0.1, sonine=False),
        "initial_sonine = 0.1 needs sonine=True",
    ),
]


@pytest.mark.parametrize("call, message", REFUSED)
def test_scenes_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
