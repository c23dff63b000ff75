"""Columns that are not T, and units that are not SI."""

import jax
import numpy as np
import pytest

import jaxgran

HEADER = "# eta: 0.05\n# diameter: 2\n# density: 2500\n# Y: 5e7\n# nu: 0.22\n# T0: 0.01\n"
UNITS = "# length_unit: mm\n# time_unit: ms\n"
TIMES, T = np.array([0.0, 1.0, 2.0, 3.0]), np.array([1e-2, 5e-3, 3e-3, 2e-3])


@pytest.fixture
def read(tmp_path):
    def read(header, names, *columns):
        rows = "\n".join(",".join(f"{x:.17g}" for x in row) for row in zip(*columns, strict=True))
        path = tmp_path / "curve.csv"
        path.write_text(f"{header}{names}\n{rows}\n")
        return jaxgran.read_curve(path)

    return read


def moments(dimension):
    """Means over Maxwellian velocities of <v^2>/d = 1: speed, one and two squared components."""
    v = np.asarray(jax.random.normal(jax.random.key(dimension), (400_000, dimension)))
    return {
        "mean_speed": np.mean(np.linalg.norm(v, axis=1)),
        "vx2": np.mean(v[:, 0] ** 2),
        "v2_xy": np.mean(v[:, 0] ** 2 + v[:, 1] ** 2),
    }


@pytest.mark.parametrize("dimension", [2, 3])
def test_what_stands_in_for_the_temperature(read, dimension):
    header = HEADER.replace("2\n", "2e-3\n", 1) + f"# dimension: {dimension}\n"
    for name, moment in moments(dimension).items():
        power = 0.5 if name == "mean_speed" else 1.0
        measured = moment * T**power
        curve, said = read(header, f"t,{name},{name}_err", TIMES, measured, 0.01 * measured)
        # Means over 400000 particles: .2 % at 1.5 standard errors of the worst of them.
        np.testing.assert_allclose(curve.temperature, T, rtol=5e-3)
        relative = curve.temperature_error / curve.temperature
        np.testing.assert_allclose(relative, 0.01 / power, rtol=1e-12)
        assert said["T_from"].startswith("T = ")
        # The dimension is a number, however it is written.
        same, _ = read(
            header.replace(f"dimension: {dimension}", f"dimension: {dimension}.0"),
            f"t,{name}",
            TIMES,
            measured,
        )
        np.testing.assert_array_equal(same.temperature, curve.temperature)
    gas = jaxgran.read_gas(said)
    energy = 0.5 * dimension * float(gas.mass) * T
    curve, said = read(header, "t,energy", TIMES, energy)
    np.testing.assert_allclose(curve.temperature, T, rtol=1e-12)


def test_units_of_the_header(read, tmp_path):
    """mm and ms: velocities are as in SI, lengths and times are not."""
    msd = np.array([0.0, 1e-6, 2e-6, 3e-6])
    errors = "# diameter_err: 0.02\n# A: 3e-3\n"
    columns = TIMES * 1e3, T, msd * 1e6, 0.1 * msd * 1e6
    curve, header = read(HEADER + UNITS + errors, "t,T,msd,msd_err", *columns)
    np.testing.assert_allclose(curve.times, TIMES, rtol=1e-12)
    np.testing.assert_allclose(curve.temperature, T, rtol=1e-12)
    np.testing.assert_allclose(curve.displacement, msd, rtol=1e-12)
    np.testing.assert_allclose(curve.displacement_error, 0.1 * msd, rtol=1e-12)
    assert float(jaxgran.read_gas(header).diameter) == pytest.approx(2e-3)
    assert jaxgran.read_priors(header)["diameter"] == pytest.approx((2e-3, 2e-5))
    assert float(header["A"]) == pytest.approx(3e-6)
    # What is written is SI, and says so by having no units.
    jaxgran.write_curve(tmp_path / "copy.csv", curve, header)
    copy, again = jaxgran.read_curve(tmp_path / "copy.csv")
    np.testing.assert_array_equal(copy.times, curve.times)
    assert again == header
    # Centimetres and seconds: T is in cm^2/s^2.
    head = HEADER.replace("diameter: 2", "diameter: 0.2").replace("T0: 0.01", "T0: 100")
    curve, header = read(head + "# length_unit: cm\n", "t,T", TIMES, T * 1e4)
    np.testing.assert_allclose(curve.temperature, T, rtol=1e-12)
    assert float(header["T0"]) == pytest.approx(0.01)


@pytest.mark.parametrize(
    "header, names, message",
    [
        ("# length_unit: s\n", "t,T", "length_unit: 's' is not known as a unit of m; write a unit"),
        ("", "t,energy", "column energy needs the mass of a particle: add diameter and density"),
        ("", "t,speed", "missing: T; not known: speed; .* there may be mean_speed, vx2, v2_xy"),
        ("", "t,vx2_err", "missing: T; not known: vx2_err"),
    ],
)
def test_what_is_not_said_is_asked_for(read, header, names, message):
    with pytest.raises(ValueError, match=message):
        read(header, names, TIMES, T)


def test_values_of_no_granular_gas_are_warned_of(read):
    _, header = read(HEADER, "t,T", TIMES, T)  # 2 m, for 2 mm
    with pytest.warns(UserWarning, match="diameter is 2 m, and usual is .*: is it in mm"):
        jaxgran.read_gas(header)


def test_only_the_units_leave_the_header(read):
    _, header = read(HEADER + "# force_unit: N\n# time_unit: s\n", "t,T", TIMES, T)
    assert header["force_unit"] == "N" and "time_unit" not in header


def test_one_temperature_only(read):
    with pytest.raises(ValueError, match="T and vx2 each give the temperature; keep one"):
        read("", "t,T,vx2", TIMES, T, T)


def test_priors_of_the_header_are_checked():
    for header, message in (
        ({"eta_err": "0.01"}, "gives eta_err without eta"),
        ({"eta": "0.05", "eta_err": "-0.01"}, "eta_err: must be a positive number"),
        ({"eta": "0.05", "eta_err": "some"}, "not a finite number"),
        ({"diameter": "2e-3", "diameter_err": "1e-5"}, "diameter_err without density"),
    ):
        with pytest.raises(ValueError, match=message):
            jaxgran.read_priors(header)
    header = {"diameter": "2e-3", "diameter_err": "1e-5", "density": "2500"}
    priors = jaxgran.read_priors(header)
    assert priors["diameter"] == (2e-3, 1e-5) and priors["density"][0] == 2500
    assert priors["density"][1] < 1  # so that the mass follows the diameter
