"""Commands of LAMMPS for the contact law of a gas."""

import dataclasses

import pytest

import jaxgran
from jaxgran.data.lammps import contact_law
from tests.beads import glass_beads

GAS = glass_beads()
WALLED = dataclasses.replace(GAS, container=jaxgran.Walls(0.05, restitution=GAS.law))


def test_pairs_of_sizes_have_their_own_damping():
    lines = jaxgran.lammps_commands(GAS, [2e-3, 4e-3]).splitlines()
    damping = {}
    for line in lines:
        if line.startswith("pair_coeff"):
            _, i, j, _, stiffness, eta, *_ = line.split()
            damping[i + j] = float(eta)
            rho = float(jaxgran.elastic_constant(GAS.youngs_modulus, 0.22, 2e-3))
            assert float(stiffness) == pytest.approx(rho / (2e-3 / 4) ** 0.5)
    # eta is proportional to the inverse of the effective mass.
    assert damping["12"] / damping["11"] == pytest.approx((1 / 8 + 1) / 2)
    assert damping["22"] / damping["11"] == pytest.approx(1 / 8)
    assert lines[-1] == f"timestep {float(GAS.contact_duration) / 100:.6g}"


def test_walls_and_friction_have_their_lines():
    rubbing = dataclasses.replace(GAS, surface=jaxgran.Frictional(3.0, friction=0.4))
    assert "tangential linear_nohistory 3.0 0.4" in jaxgran.lammps_commands(rubbing)
    lines = jaxgran.lammps_commands(WALLED).splitlines()
    walls = [line for line in lines if line.startswith("fix walls_")]
    assert [line.split()[-3] for line in walls] == ["xplane", "yplane", "zplane"]
    assert contact_law(GAS.law, float(GAS.mass), None) in walls[0]


def test_walls_have_the_damping_of_the_given_diameter():
    larger = GAS.replace(diameter=4e-3, mass=8 * GAS.mass)
    lines = jaxgran.lammps_commands(WALLED, [4e-3]).splitlines()
    walls = [line for line in lines if line.startswith("fix walls_")]
    assert contact_law(GAS.law, float(larger.mass), None) in walls[0]


def test_contacts_end_at_no_force_or_at_no_overlap():
    assert "limit_damping" in contact_law(GAS.law, 1e-5, None)
    pulling = dataclasses.replace(GAS.law, clipped=False)
    sticky = jaxgran.lammps_commands(dataclasses.replace(GAS, law=pulling))
    assert "contacts end at xi = 0" in sticky and "limit_damping" not in sticky


@pytest.mark.parametrize(
    ("gas", "diameters", "message"),
    [
        (dataclasses.replace(GAS, law=jaxgran.ConstantRestitution(0.9)), None, "ConstantRestit"),
        (dataclasses.replace(GAS, surface=jaxgran.Rough(0.5)), None, "Frictional"),
        (
            dataclasses.replace(GAS, container=jaxgran.Walls(0.05, restitution=0.9)),
            None,
            "give the walls a jaxgran.Viscoelastic",
        ),
        (WALLED, [1e-3, 2e-3], "2 sizes have different masses"),
        (GAS, [1e-3, -2e-3], "diameters must"),
        (GAS, [], "at least one"),
    ],
)
def test_what_lammps_lacks_is_refused(gas, diameters, message):
    with pytest.raises(ValueError, match=message):
        jaxgran.lammps_commands(gas, diameters)
