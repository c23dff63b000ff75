import dataclasses
from pathlib import Path

import equinox as eqx
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


def test_an_archive_of_something_else_is_refused(tmp_path):
    np.savez(tmp_path / "other.npz", a=np.ones(3))
    with pytest.raises(
        ValueError, match="not a file that this version of jaxgran.write_curve wrote"
    ):
        jaxgran.read_curve(tmp_path / "other.npz")
    with pytest.raises(ValueError, match="no such file"):
        jaxgran.read_curve(tmp_path / "none.npz")


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
        ("  \n\n", "the file is empty"),
        (b"\x89PNG\r\n\x1a\n\x00\x00\xff\xfe", "not a text file but a binary one; give a CSV"),
        (b"t,T\n1,2\x00", "a binary one"),
        ("t,T_err\n1,2\n", "missing: T; name them t,T"),
        ("when,T\n1,2\n", "missing: t; not known: when"),
        ("t,T,T\n1,2,3\n", "each once"),
        ("t,T,err\n1,2,3\n", "not known: err"),
        (
            HEADER + "t,T\n0,1\n1,x\n2,.1\n3,.05\n",
            r"line 9: expected 2 finite numbers .* got '1,x'",
        ),
        (HEADER + "t,T\n0,1\n1,nan\n2,.1\n3,.05\n", "line 9: expected 2 finite numbers"),
        (HEADER + "t,T\n0,1\n1\n2,.1\n3,.05\n", "line 9: expected 2 finite"),
        ("t,T\n0,1\n1,.5\n1,.3\n", r"line 4: t is 1 after 1; times must increase: sort the rows"),
        ("t,T\n0,1\n2,.5\n1,.3\n", "line 4: t is 1 after 2"),
        ("t,T\n-1,1\n2,.5\n3,.3\n", "line 2: t is -1, it must be a positive number"),
        ("t,T\n0,1\n1,0\n2,.3\n", "line 3: T is 0, it must be a positive number"),
        ("t,T\n0,1\n1,-2\n2,.3\n", "line 3: T is -2"),
        ("t,T,T_err\n0,1,0\n1,.5,0\n2,.3,.1\n", "line 3: T_err is 0"),
        ("t,T,T_err\n0,1,0\n1,.5,-.1\n2,.3,.1\n", "line 3: T_err is -0.1"),
        ("t,T,T_err\n1,1,0\n2,.5,.1\n3,.3,.1\n", "line 2: T_err is 0"),
        ("t,T,msd\n0,1,0\n1,.5,-1\n2,.3,.1\n", "line 3: msd is -1"),
        ("t,T\n0,1\n1,.5\n", "2 rows of numbers, at least 3 are needed"),
        (HEADER, "line 7: the file ends without columns; it needs t,T"),
        (HEADER + "t,T\n", "0 rows of numbers"),
    ],
)
def test_bad_files_are_refused(text, message, write):
    path = write(text)
    with pytest.raises(ValueError, match=message) as error:
        jaxgran.read_curve(path)
    assert "curve.csv" in str(error.value)


def test_missing_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no such file; check the path"):
        jaxgran.read_curve(tmp_path / "nowhere.csv")
    with pytest.raises(ValueError, match="not a text file"):
        jaxgran.read_curve(tmp_path)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"Y": None}, "the header lacks Y; add lines such as '# Y: VALUE'"),
        ({"Y": None, "T0": None}, "the header lacks Y, T0"),
        ({"Y": "soft"}, "header line Y: 'soft' is not a finite number"),
        ({"Y": "-1"}, "youngs_modulus must lie in"),
        ({"nu": "0.7"}, "poisson_ratio must lie in"),
        ({"eta": "0.9"}, "packing_fraction must lie in"),
        ({"density": "0"}, "density must lie in"),
        ({"T0": "-3"}, "temperature must lie in"),
        ({"dimension": "4"}, "dimension must be 2 or 3"),
        ({"dimension": "2.9"}, "dimension: must be a whole number from 1 to 1e.12, got '2.9'"),
    ],
)
def test_bad_headers_are_refused(change, message):
    header = {
        "eta": ".05",
        "diameter": ".002",
        "density": "2500",
        "Y": "5e7",
        "nu": ".2",
        "T0": ".01",
    }
    header = {k: v for k, v in (header | change).items() if v is not None}
    with pytest.raises(ValueError, match=message):
        jaxgran.read_gas(header)


@pytest.mark.parametrize("n", ["0", "-5", "3.5", "many", "inf", "nan"])
def test_bad_particle_numbers_are_refused(n):
    with pytest.raises(ValueError, match="header line N"):
        header_count({"N": n}, "N")


number = st.floats(allow_nan=True, allow_infinity=True) | st.floats(1e-6, 1e6)


@pytest.mark.filterwarnings("ignore::UserWarning")  # questions about unusual values
@given(st.lists(st.tuples(number, number, number), max_size=6))
@settings(max_examples=300, deadline=None)
def test_any_rows_are_read_or_refused_with_a_reason(rows):
    import tempfile

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
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "curve.csv"
        path.write_bytes(data)
        try:
            jaxgran.read_curve(path)
        except ValueError as error:
            assert "curve.csv" in str(error)
