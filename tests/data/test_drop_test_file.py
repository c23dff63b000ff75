"""Drop tests of oblique impacts in files, and what makes a drop test."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran import read_measurement
from tests.beads import glass_beads

ROUGH = jaxgran.Gas(
    glass_beads().law,
    diameter=2e-3,
    mass=1e-5,
    packing_fraction=0.05,
    temperature=0.01,
    surface=jaxgran.Rough(0.3, friction=0.2),
    container=jaxgran.Walls(0.05, restitution=0.8, tangential_restitution=0.1),
)
SIGMA = 2e-3
VELOCITIES = "nx,ny,nz,vx,vy,vz,vx_after,vy_after,vz_after,v_err"


@pytest.fixture
def drops_of(tmp_path):
    """Read the drop test of a text."""

    def read(text, **header):
        (tmp_path / "drops.csv").write_text(text)
        data = read_measurement(tmp_path / "drops.csv", header, gas=ROUGH).data
        assert isinstance(data, jaxgran.DropTest)
        return data

    return read


def test_each_kind_of_columns_gives_the_same_impacts(drops_of):
    plain = drops_of("v_n,v_t,eps,eps_err,eps_t,eps_t_err\n0.3,0.4,0.9,0.01,0.2,0.02\n")
    assert plain.is_oblique and plain.num_values == 2 and not plain.of_centres
    tilt = np.degrees(np.arctan2(0.4, 0.3))
    radians = f"50,{np.radians(tilt):.15g},.9,.01,.2,.02"
    for text in (
        f"v,angle,eps,eps_err,eps_t,eps_t_err\n0.5,{tilt:.15g},0.9,0.01,0.2,0.02\n",
        f"v (cm/s),angle (rad),eps,eps_err,eps_t,eps_t_err\n{radians}\n",
    ):
        test = drops_of(text)
        for name in ("speed", "tangential_speed", "restitution", "tangential_restitution"):
            np.testing.assert_allclose(getattr(test, name), getattr(plain, name), rtol=1e-12)
    centres = drops_of(
        "v_n,v_n_err,v_t,eps,eps_err,eps_t_center,eps_t_center_err\n.3,.01,.4,.9,.01,.8,.02\n",
        onto="plate",
    )
    assert centres.of_centres and centres.onto == "plate"
    np.testing.assert_allclose(centres.speed_error, 0.01)


def test_errors_of_angles_are_angles(drops_of):
    rows = "0.3,0.01,30,1,0.9,0.01,0.2,0.02\n0.3,0.01,60,1,0.9,0.01,0.2,0.02\n"
    names = "v,v_err,angle,angle_err{},eps,eps_err,eps_t,eps_t_err\n"
    plain = drops_of(names.format("") + rows)
    degrees = drops_of(names.format(" (deg)") + rows)
    np.testing.assert_allclose(degrees.tangential_speed_error, plain.tangential_speed_error)
    # Of an angle alone both speeds have one error: their correlation is -1, and no less.
    only = "v,angle,angle_err,eps,eps_err,eps_t,eps_t_err\n"
    each = "".join(f"0.3,{x},1,0.9,0.01,0.2,0.02\n" for x in np.linspace(3, 87, 50))
    np.testing.assert_allclose(drops_of(only + each).tangential_correlation, -1.0)


def test_a_part_of_no_column_is_refused(drops_of):
    with pytest.raises(ValueError, match="v_err is a part of v, which is not among the columns"):
        drops_of(VELOCITIES + " (%)\n" + ",".join("1" * 10) + "\n")


def test_another_sphere_in_the_header_is_asked_about(drops_of):
    text = "v,eps,eps_err\n0.3,0.9,0.01\n0.4,0.9,0.01\n"
    with pytest.warns(UserWarning, match="diameter is 0.006 in this header, but 0.002 in the gas"):
        drops_of(text, diameter="6 mm")
    with pytest.warns(UserWarning, match="unknown header keys: eps_scatter"):
        drops_of(text, eps_scatter="yes")


def test_errors_of_speeds_and_angles_are_those_of_both_components(drops_of):
    test = drops_of("v_n,v_t,v_t_err,eps,eps_err,eps_t,eps_t_err\n.3,.4,.02,.9,.01,.2,.02\n")
    assert test.speed_error is None
    np.testing.assert_allclose(test.tangential_speed_error, 0.02)
    # The spheres slide where mu = .01: 1 - eps_t is proportional to v_n/v_t.
    sliding = ROUGH.replace(friction=0.01)
    np.testing.assert_allclose(test.errors(sliding)[1], np.hypot(0.02, 0.02 / 0.4))
    sticking = ROUGH.replace(friction=1e6)
    np.testing.assert_allclose(test.errors(sticking)[1], np.hypot(0.02, 0.3 * 0.02 / 0.4))
    tilted = "v,angle,eps,eps_err,eps_t,eps_t_err,angle_err{}\n.5,60,.9,.01,.2,.02,2{}\n"
    test = drops_of(tilted.format("", ""))
    np.testing.assert_allclose(test.speed_error, 0.5 * np.sin(np.pi / 3) * np.radians(2))
    np.testing.assert_allclose(test.tangential_speed_error, 0.5 * 0.5 * np.radians(2))
    np.testing.assert_allclose(test.tangential_correlation, -1)
    both = drops_of(tilted.format(",v_err", ",.01"))
    variance = np.square(test.speed_error) + (0.01 * 0.5) ** 2
    np.testing.assert_allclose(np.square(both.speed_error), variance)
    assert np.all(np.asarray(both.tangential_correlation) > -1)


def test_a_header_line_says_that_eps_scatters(drops_of):
    for text in (
        "v,eps,eps_err\n.1,.9,.1\n",
        f"# spin_before: 0\n{VELOCITIES}\n0,0,1,0,0.1,-1,0,0.1,.9,.01\n",
    ):
        assert drops_of(text, eps_scatters="yes").scatters
        assert not drops_of(text).scatters


def rough_impact(before, spin, normal, eps, beta_t, q=0.4):
    """Velocity and spin of a sphere after an impact on a plate, by momentum and torque alone."""
    u = before - SIGMA / 2 * np.cross(spin, normal)
    along = (u @ normal) * normal
    push = -(1 + eps) * along - q / (1 + q) * (1 + beta_t) * (u - along)
    # The torque of the push at the contact, -(sigma/2) n, over q m sigma^2/4.
    turn = np.cross(-SIGMA / 2 * normal, push) * 4 / (q * SIGMA**2)
    return before + push, spin + turn


def test_velocities_and_spins_give_both_restitutions(drops_of):
    rng = np.random.default_rng(0)
    normal = np.array([2.0, -1.0, 2.0]) / 3
    before = np.array([-0.5, 0.3, -0.2])
    head = "nx,ny,nz,vx,vy,vz,vx_after,vy_after,vz_after,v_err"
    spins = "wx (rad/s),wy (rad/s),wz (rad/s)"
    spins += ",wx_after (rad/s),wy_after (rad/s),wz_after (rad/s),w_err (rad/s)"
    for spin in (np.zeros(3), 200 * rng.standard_normal(3)):
        after, spin_after = rough_impact(before, spin, normal, 0.9, 0.3)
        cells = [*normal, *before, *after, 1e-3, *spin, *spin_after, 1.0]
        text = f"{head},{spins}\n{','.join(f'{x:.17g}' for x in cells)}\n"
        test = drops_of(text, diameter="2 mm", onto="plate")
        np.testing.assert_allclose(test.restitution, 0.9)
        np.testing.assert_allclose(test.tangential_restitution, -0.3)
    after, _ = rough_impact(before, np.zeros(3), normal, 0.9, 0.3)
    text = f"{head}\n{','.join(f'{x:.17g}' for x in (*normal, *before, *after, 1e-3))}\n"
    test = drops_of(text, spin_before=0, onto="plate")
    assert test.of_centres
    beta_t = dict(friction=1e6, tangential_restitution=0.3)
    computed = test.computed_tangential(ROUGH.replace(**beta_t))
    np.testing.assert_allclose(test.tangential_restitution, computed)


def test_a_table_of_beta_t_is_asked_about(drops_of):
    lines = [f"0.1,{0.05 * k},0.9,0.01,{0.9 - 0.15 * k:.3f},0.02" for k in range(1, 11)]
    text = "\n".join(["v_n,v_t,eps,eps_err,eps_t,eps_t_err", *lines]) + "\n"
    with pytest.warns(UserWarning, match="eps_t falls as .* is it beta_t = -eps_t"):
        drops_of(text)


OBLIQUE = "v_n,v_t,eps,eps_err,eps_t,eps_t_err\n"


@pytest.mark.parametrize(
    "text, message",
    [
        ("v,eps,eps_err\n.1,1.3,.1\n", "line 2: eps is 1.3, .* 0 to 1.2"),
        ("v,eps,eps_err\n.1,-.1,.1\n", "line 2: eps is -0.1, .* 0 to 1.2"),
        (
            "v,angle,eps,eps_err,eps_t,eps_t_err\n.1,95,.9,.1,.2,.1\n",
            "line 2: angle is 95, allowed are 0 to 90. It is from the normal, in degrees",
        ),
        (OBLIQUE + ".1,.1,.9,.1,1.5,.1\n", "line 2: eps_t is 1.5, .* -1.2 to 1.2"),
        (OBLIQUE + ".1,0,.9,.1,.5,.1\n", "tangential_speed must lie in .* normal impacts are"),
        ("v_n,v_t,eps,eps_err,beta_t\n", "column beta_t .*write eps_t"),
        (
            "v_n,v_t,eps,eps_err,eps_t,eps_t_err,eps_t_center\n",
            "two definitions of the tangential restitution",
        ),
        ("v,eps,eps_err,eps_t\n", "have eps_t without the tangential speed: give v_n,v_t, or v,an"),
        ("v_n,v_t,eps,eps_err\n", "a drop test needs v_n,v_t,eps,eps_err,eps_t,eps_t_err"),
        ("vx,vy,vz,vx_after,vy_after,vz_after,v_err\n", r"no normal \(nx, ny, nz\): add nx,ny,nz"),
        (f"{VELOCITIES}\n0,0,1,0,0,-1,0,0,.9,.01\n", "if the spheres do not rotate .* spin_bef"),
        (f"{VELOCITIES}\n0,0,2,0,0,-1,0,0,.9,.01\n", "the normal nx,ny,nz has the length 2"),
        (
            f"# spin_before: 0\n{VELOCITIES}\n0,0,1,0,0,1,0,0,.9,.01\n",
            "vx,vy,vz lead away from the partner",
        ),
        (
            f"{VELOCITIES},wx,wy,wz,wx_after,wy_after,wz_after,w_err\n"
            "0,0,1,0,0,-1,0,0,.9,.01,0,0,0,0,0,0,1\n",
            r"column wx is an angular velocity without a unit .* write wx \(rad/s\)",
        ),
        ("# eps_scatters: .1\nv,eps,eps_err\n.1,.9,.1\n", "eps_scatters: must be yes or no, got"),
        ("# onto: floor\nv,eps,eps_err\n.1,.9,.1\n", "must be one of sphere, plate, wall, got 'fl"),
    ],
)
def test_bad_impacts_are_refused(drops_of, text, message):
    with pytest.raises(ValueError, match=message):
        drops_of(text)


def test_speeds_in_another_unit_are_asked_about(drops_of):
    with pytest.warns(UserWarning, match=r"v_n is 30 m/s, .* is it in cm/s\? Then write v_n \(cm"):
        drops_of(OBLIQUE + "30,1,.9,.1,.2,.1\n")


def test_traced_errors_and_restitutions_are_taken_unchecked():
    """A derivative in what was measured may be needed, as in the error of a fit."""
    oblique = {"tangential_speed": [0.1], "tangential_restitution": [0.2]}

    def errors(error, restitution):
        known = {"speed_error": [0.01], "correlation": [0.5]}
        drops = jaxgran.DropTest([0.1], restitution, error, **known)
        tangential = jaxgran.DropTest([0.1], restitution, error, **oblique, tangential_error=error)
        return drops._error_with(drops.restitution), tangential.tangential_error

    given = jnp.array([0.01]), jnp.array([0.9])
    plain, tangential = errors(*given)
    traced, _ = jax.jit(errors)(*given)
    np.testing.assert_allclose(traced, plain, rtol=1e-6)  # single precision
    slope = jax.jacobian(lambda error: errors(error, given[1])[1])(given[0])
    assert np.shape(tangential) == (1,) and slope[0, 0] == 1.0


def test_impacts_need_the_elements_on_which_they_depend():
    smooth = glass_beads()
    oblique = jaxgran.DropTest(
        [0.1], [0.9], [0.01], tangential_speed=[0.1], tangential_restitution=[0.2],
        tangential_error=[0.01],
    )  # fmt: skip
    with pytest.raises(ValueError, match="eps_t needs rough spheres .* `beta_t: guess`"):
        jaxgran.Measurement(smooth, oblique)
    with pytest.raises(ValueError, match="need the walls of the gas"):
        jaxgran.Measurement(smooth, jaxgran.DropTest([0.1], [0.9], [0.01], "wall"))
    with pytest.raises(ValueError, match="onto .*sphere, plate, wall, got True"):
        jaxgran.DropTest([0.1], [0.9], [0.01], True)
    with pytest.raises(ValueError, match="tangential_speed_error needs oblique impacts: give tang"):
        jaxgran.DropTest([0.1], [0.9], [0.01], tangential_speed_error=[0.1])
    with pytest.raises(ValueError, match="together, got tangential_speed"):
        jaxgran.DropTest([0.1], [0.9], [0.01], tangential_speed=[0.1])
    wall = jaxgran.DropTest([0.1], [0.9], [0.01], "wall")
    assert float(wall.computed(jaxgran.Measurement(ROUGH, wall).gas)[0]) == pytest.approx(0.8)


def test_a_header_with_N_and_a_container_needs_no_eta(tmp_path):
    path = tmp_path / "drops.csv"
    header = "# diameter: 6 mm\n# density: 2500\n# Y: 5e7\n# nu: 0.22\n# wall_restitution: 0.9\n"
    path.write_text(f"{header}# N: 20\n# container_side: 5 cm\nv,eps,eps_err\n.1,.9,.01\n")
    measurement = read_measurement(path)
    volume = 20 * np.pi / 6 * 6e-3**3
    assert measurement.gas.packing_fraction < volume / (0.05 - 6e-3) ** 3 * 1.01
    assert "T0" not in measurement.header  # which holds what the file says
