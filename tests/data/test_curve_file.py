"""Curve files: what is read and written, and what is refused."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxgran
from jaxgran.data.header import gas_of_header
from jaxgran.data.measurement_header import priors_of_header
from tests.beads import glass_beads

HEADER = "# eta: 0.05\n# diameter: 0.002\n# density: 2500\n# Y: 5e7\n# nu: 0.22\n# T0: 0.01\n"
ROWS = "t,T,T_err\n0,0.01,0\n1,0.005,1e-3\n2,0.003,1e-3\n3,0.002,1e-3\n"


def test_measured_curves_are_read():
    measurement = jaxgran.example_measurement()
    curve, gas = measurement.curve, measurement.gas
    assert curve.times.shape == curve.temperature.shape == curve.displacement.shape == (61,)  # pyright: ignore
    assert measurement.num_particles == 4000
    assert float(gas.packing_fraction) == 0.05
    assert float(gas.dissipative_constant) == 3e-6
    np.testing.assert_allclose(gas.mass, np.pi / 6 * 2500 * 8e-9)


def test_an_unknown_example_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match='name .*"dilute" or "dense", got \'granular\''):
        jaxgran.example_measurement("granular")


def test_everything_that_was_computed_is_kept(tmp_path):
    gas = glass_beads()
    times = gas.mean_free_time * jnp.array([1.0, 2.0, 3.0])
    theory = jaxgran.cool(gas, times)
    jaxgran.write_curve(tmp_path / "theory.csv", theory, {"N": "10"})
    copy, header = jaxgran.read_curve(tmp_path / "theory.csv")
    assert header == {"N": "10"}
    # No field but the status, which says that nothing failed, may be lost.
    for name, value in vars(dataclasses.replace(theory, status=None)).items():
        np.testing.assert_array_equal(getattr(copy, name), value, err_msg=name)
    jaxgran.write_curve(tmp_path / "theory.npz", theory, {"note": "1 m"})
    copy, header = jaxgran.read_curve(tmp_path / "theory.npz")
    assert header == {"note": "1 m"} and eqx.tree_equal(copy, theory)


def test_an_archive_of_others_is_refused(tmp_path):
    words = "jaxgran.write_curve"
    np.savez(tmp_path / "other.npz", a=np.ones(3))
    with pytest.raises(ValueError, match=words):
        jaxgran.read_curve(tmp_path / "other.npz")


def test_nothing_is_written_over(tmp_path):
    path = tmp_path / "curve.csv"
    path.write_text(HEADER + ROWS)
    curve, header = jaxgran.read_curve(path)
    with pytest.raises(ValueError, match="exists; .* overwrite=True"):
        jaxgran.write_curve(path, curve, {})
    assert path.read_text() == HEADER + ROWS
    jaxgran.write_curve(path, curve, header, overwrite=True)
    assert jaxgran.read_curve(path)[1] == header


number = st.floats(allow_nan=True, allow_infinity=True) | st.floats(1e-6, 1e6)


@pytest.mark.filterwarnings("ignore::UserWarning")  # questions about unusual values
@given(st.lists(st.tuples(number, number, number), max_size=6))
@settings(max_examples=100, deadline=None)
def test_any_rows_are_read_or_refused_with_a_reason(read, rows):
    text = "t,T,T_err\n" + "".join(f"{t!r},{x!r},{e!r}\n" for t, x, e in rows)
    good = len(rows) >= 3 and bool(np.all(np.isfinite(rows)))
    if good:
        t, x, e = np.array(rows).T
        first = e[0] > 0 or (t[0] == 0 and e[0] == 0)
        good = (
            t[0] >= 0 and np.all(np.diff(t) > 0) and np.all(x > 0) and first and np.all(e[1:] > 0)
        )
    if good:
        np.testing.assert_array_equal(read(text)[0].temperature, np.array(rows)[:, 1])
    else:
        with pytest.raises(ValueError, match="curve.csv"):
            read(text)


@given(st.binary(max_size=200))
@settings(max_examples=100, deadline=None)
def test_any_bytes_are_read_or_refused(read, data):
    try:
        read(data)
    except ValueError as error:
        assert "curve.csv" in str(error)


# --- columns that are not T, and units that are not SI

IN_MM = HEADER.replace("0.002", "2")
UNITS = "# length_unit: mm\n# time_unit: ms\n"
TIMES, T = np.array([0.0, 1.0, 2.0, 3.0]), np.array([1e-2, 5e-3, 3e-3, 2e-3])


@pytest.mark.parametrize("dimension", [2, 3])
def test_what_stands_in_for_the_temperature(read, dimension):
    header = HEADER + f"# dimension: {dimension}\n"
    # Of a Maxwellian gas of T = 1: the mean speed, and means of one and two squared components.
    mean_speed = {2: ("mean_speed", (np.pi / 2) ** 0.5), 3: ("mean_speed_xyz", (8 / np.pi) ** 0.5)}
    moments = dict([mean_speed[dimension]]) | {"vx2": 1, "v2_xy": 2}
    for name, moment in moments.items():
        power = 0.5 if name.startswith("mean_speed") else 1.0
        measured = moment * T**power
        curve, said = read(f"{header}t,{name},{name}_err\n", TIMES, measured, 0.01 * measured)
        np.testing.assert_allclose(curve.temperature, T, rtol=1e-12)
        relative = curve.temperature_error / curve.temperature
        np.testing.assert_allclose(relative, 0.01 / power, rtol=1e-12)
        assert said["T_from"].startswith("T = ")
        # The dimension is a number, however it is written.
        same, _ = read(f"{header[:-1]}.0\nt,{name}\n", TIMES, measured)
        np.testing.assert_array_equal(same.temperature, curve.temperature)
    gas, _ = gas_of_header(said)
    energy = 0.5 * dimension * float(gas.mass) * T
    curve, said = read(f"{header}t,energy\n", TIMES, energy)
    np.testing.assert_allclose(curve.temperature, T, rtol=1e-12)


def test_units_of_the_header(read, tmp_path):
    """mm and ms: velocities are as in SI, lengths and times are not."""
    errors = "# diameter_err: 0.02\n# A: 3e-3\n"
    curve, header = read(f"{IN_MM}{UNITS}{errors}t,T\n", TIMES * 1e3, T)
    assert float(gas_of_header(header)[0].diameter) == pytest.approx(2e-3)
    assert priors_of_header(header)["diameter"] == pytest.approx((2e-3, 2e-5))
    assert float(header["A"]) == pytest.approx(3e-6)
    # What is written is SI, and says so by having no units.
    given = {
        "diameter": 2,
        "diameter_err": 0.02,
        "T0": "1e-8",
        "length_unit": "mm",
        "time_unit": "ms",
    }
    for suffix in (".csv", ".npz"):
        for written in (header, given):
            jaxgran.write_curve(tmp_path / f"copy{suffix}", curve, written, overwrite=True)
            copy, again = jaxgran.read_curve(tmp_path / f"copy{suffix}")
            np.testing.assert_array_equal(copy.times, curve.times)
            np.testing.assert_array_equal(copy.temperature, curve.temperature)
            assert "length_unit" not in again
            assert float(again["diameter"]) == pytest.approx(2e-3)
    _, header = read(f"{IN_MM}{UNITS}# force_unit: N\nt,T\n", TIMES * 1e3, T)
    assert header["force_unit"] == "N"
