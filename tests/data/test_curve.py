"""Curve files: what is read and written, and what is refused."""

import dataclasses
import tempfile
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxgran
from jaxgran.data.files import header_count
from tests.beads import glass_beads

DATA = Path(__file__).parents[2] / "experiments" / "data"
HEADER = "# eta: 0.05\n# diameter: 0.002\n# density: 2500\n# Y: 5e7\n# nu: 0.22\n# T0: 0.01\n"
ROWS = "t,T,T_err\n0,0.01,0\n1,0.005,1e-5\n2,0.003,1e-5\n3,0.002,1e-5\n"


@pytest.fixture
def write(tmp_path):
    def write(text):
        path = tmp_path / "curve.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def test_measured_curves_are_read():
    curve, header = jaxgran.read_curve(DATA / "lammps_cooling_dilute.csv")
    assert curve.times.shape == curve.temperature.shape == curve.displacement.shape == (61,)  # pyright: ignore
    assert header["N"] == "4000" and header_count(header, "N") == 4000
    gas = jaxgran.read_gas(header)
    assert float(gas.packing_fraction) == 0.05
    assert float(gas.value("dissipative_constant")) == 0.0  # A is for the fit to find
    np.testing.assert_allclose(gas.mass, np.pi / 6 * 2500 * 8e-9)


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
    jaxgran.write_curve(tmp_path / "theory.npz", theory, {"T0": "1 m"})
    copy, header = jaxgran.read_curve(tmp_path / "theory.npz")
    assert header == {"T0": "1 m"} and eqx.tree_equal(copy, theory)


def test_what_is_no_file_of_a_curve_is_refused(tmp_path):
    np.savez(tmp_path / "other.npz", a=np.ones(3))
    for name, words in (
        ("other.npz", "not a file that this version of jaxgran.write_curve wrote"),
        ("none.npz", "no such file"),
        ("none.csv", "no such file; check the path"),
        ("", "not a text file"),
    ):
        with pytest.raises(ValueError, match=words):
            jaxgran.read_curve(tmp_path / name)


def test_nothing_is_written_over(write):
    path = write(HEADER + ROWS)
    curve, header = jaxgran.read_curve(path)
    with pytest.raises(ValueError, match="exists; choose another name or set overwrite=True"):
        jaxgran.write_curve(path, curve, {})
    assert path.read_text() == HEADER + ROWS
    jaxgran.write_curve(path, curve, header, overwrite=True)
    assert jaxgran.read_curve(path)[1] == header


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "the file is empty; it needs the columns"),
        (b"\x89PNG\r\n\x1a\n\x00\x00\xff\xfe", "not a text file but a binary one; give a CSV"),
        ("t,T_err\n1,2\n", "missing: T; name them t,T"),
        ("when,T\n1,2\n", "missing: t; not known: when"),
        ("t,T,T\n1,2,3\n", "each once"),
        (HEADER + "t,T\n0,1\n1,x\n2,.1\n3,.05\n", "line 9: expected 2 finite numbers .* got '1,x'"),
        (HEADER + "t,T\n0,1\n1\n2,.1\n3,.05\n", "line 9: expected 2 finite"),
        ("t,T\n0,1\n1,.5\n1,.3\n", r"line 4: t is 1 after 1; times must increase: sort the rows"),
        ("t,T\n-1,1\n2,.5\n3,.3\n", "line 2: t is -1, it must be a positive number"),
        ("t,T\n0,1\n1,0\n2,.3\n", "line 3: T is 0, it must be a positive number"),
        ("t,T,T_err\n0,1,0\n1,.5,0\n2,.3,.1\n", "line 3: T_err is 0"),
        ("t,T,msd\n0,1,0\n1,.5,-1\n2,.3,.1\n", "line 3: msd is -1"),
        ("t,T\n0,1\n1,.5\n", "2 rows of numbers, at least 3 are needed"),
        (HEADER, "line 7: the file ends without columns; it needs t,T"),
    ],
)
def test_bad_files_are_refused(text, message, write):
    path = write(text)
    with pytest.raises(ValueError, match=message) as error:
        jaxgran.read_curve(path)
    assert "curve.csv" in str(error.value)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"Y": None, "T0": None}, "the header lacks Y, T0"),
        ({"Y": "soft"}, "header line Y: 'soft' is not a finite number"),
        ({"Y": "-1"}, "youngs_modulus must lie in"),
        ({"eta": "0.9"}, "packing_fraction must lie in"),
        ({"dimension": "4"}, "dimension must be 2 or 3"),
        ({"dimension": "2.9"}, "dimension: must be a whole number from 1 to 1e.12, got '2.9'"),
    ],
)
def test_bad_headers_are_refused(change, message):
    header = dict(line[2:].split(": ") for line in HEADER.splitlines())
    header = {k: v for k, v in (header | change).items() if v is not None}
    with pytest.raises(ValueError, match=message):
        jaxgran.read_gas(header)


def test_bad_particle_numbers_are_refused():
    for n in ("0", "-5", "3.5", "many", "inf", "nan"):
        with pytest.raises(ValueError, match="header line N"):
            header_count({"N": n}, "N")


number = st.floats(allow_nan=True, allow_infinity=True) | st.floats(1e-6, 1e6)


@pytest.mark.filterwarnings("ignore::UserWarning")  # questions about unusual values
@given(st.lists(st.tuples(number, number, number), max_size=6))
@settings(max_examples=300, deadline=None)
def test_any_rows_are_read_or_refused_with_a_reason(rows):
    text = "t,T,T_err\n" + "".join(f"{t!r},{x!r},{e!r}\n" for t, x, e in rows)
    good = len(rows) >= 3 and bool(np.all(np.isfinite(rows)))
    if good:
        t, x, e = np.array(rows).T
        first = e[0] > 0 or (t[0] == 0 and e[0] == 0)
        good = (
            t[0] >= 0 and np.all(np.diff(t) > 0) and np.all(x > 0) and first and np.all(e[1:] > 0)
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "curve.csv"
        path.write_text(text)
        if good:
            curve, _ = jaxgran.read_curve(path)
            np.testing.assert_array_equal(curve.temperature, np.array(rows)[:, 1])
        else:
            with pytest.raises(ValueError, match="curve.csv"):
                jaxgran.read_curve(path)


@given(st.binary(max_size=200))
@settings(max_examples=200, deadline=None)
def test_any_bytes_are_read_or_refused(data):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "curve.csv"
        path.write_bytes(data)
        try:
            jaxgran.read_curve(path)
        except ValueError as error:
            assert "curve.csv" in str(error)


# --- columns that are not T, and units that are not SI

IN_MM = HEADER.replace("0.002", "2")
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
    header = HEADER + f"# dimension: {dimension}\n"
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
        same, _ = read(header[:-1] + ".0\n", f"t,{name}", TIMES, measured)
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
    curve, header = read(IN_MM + UNITS + errors, "t,T,msd,msd_err", *columns)
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
    head = IN_MM.replace("diameter: 2", "diameter: 0.2").replace("T0: 0.01", "T0: 100")
    curve, header = read(head + "# length_unit: cm\n# force_unit: N\n", "t,T", TIMES, T * 1e4)
    np.testing.assert_allclose(curve.temperature, T, rtol=1e-12)
    assert float(header["T0"]) == pytest.approx(0.01)
    assert header["force_unit"] == "N" and "length_unit" not in header


@pytest.mark.parametrize(
    "header, names, message",
    [
        ("# length_unit: s\n", "t,T", "length_unit: 's' is not known as a unit of m; write a unit"),
        ("", "t,energy", "column energy needs the mass of a particle: add diameter and density"),
        ("", "t,speed", "missing: T; not known: speed; .* there may be mean_speed, vx2, v2_xy"),
        ("", "t,vx2_err", "missing: T; not known: vx2_err"),
        ("", "t,T,vx2", "T and vx2 each give the temperature; keep one"),
    ],
)
def test_what_is_not_said_is_asked_for(read, header, names, message):
    with pytest.raises(ValueError, match=message):
        read(header, names, *[TIMES, T, T][: names.count(",") + 1])


def test_values_of_no_granular_gas_are_warned_of(read):
    _, header = read(IN_MM, "t,T", TIMES, T)  # 2 m, for 2 mm
    with pytest.warns(UserWarning, match="diameter is 2 m, and usual is .*: is it in mm"):
        jaxgran.read_gas(header)


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
