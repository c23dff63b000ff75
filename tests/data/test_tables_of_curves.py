"""Curves as datasets of xarray and tables of pandas."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from tests.beads import assert_same


@pytest.fixture(scope="module")
def curve():
    """A curve of two replicas of three particles at four times, with numbers that all differ."""
    times = jnp.array([0.0, 1.0, 2.0, 5.0])
    each = jnp.array([[4.0, 3.0, 2.0, 1.0], [4.0, 2.0, 1.5, 0.5]])
    place = jnp.arange(18.0).reshape(2, 3, 3)
    return jaxgran.CoolingCurve.of_replicas(
        times,
        {"temperature": each, "collisions": each**2},
        particles=jaxgran.Particles(place, -place, jnp.array(20.0)),
        status=jnp.array(0),
    )


def test_a_dataset_has_names_dimensions_and_units(curve):
    data = curve.to_xarray()
    assert dict(data.sizes) == {"time": 4, "replica": 2, "particle": 3, "axis": 3}
    np.testing.assert_array_equal(data.temperature.sel(time=1.0), 2.5)
    assert data.temperature_of_replicas.dims == ("replica", "time")
    np.testing.assert_array_equal(data.collisions_of_replicas[1], curve.replicas.collisions[1])
    np.testing.assert_array_equal(data.velocity, curve.particles.velocity)
    assert data.temperature.attrs["units"] == "m^2/s^2" and data.time.attrs["units"] == "s"
    assert data.attrs["status"] == 0 and "sonine" not in data


def test_a_dataset_has_saved_values(curve, tmp_path):
    each = jnp.arange(16.0).reshape(2, 4, 2)  # replicas, times, and an axis of the user's
    saved = curve.with_saved({"S": (each, each[..., 0])})
    jaxgran.write_curve(tmp_path / "saved.npz", saved, {})
    same, _ = jaxgran.read_curve(tmp_path / "saved.npz")
    assert_same(same, saved)
    data = saved.to_xarray()
    again = jaxgran.CoolingCurve.from_xarray(data)
    assert repr(again) == repr(saved)
    np.testing.assert_array_equal(again.replicas.saved["S"][1], saved.replicas.saved["S"][1])
    np.testing.assert_array_equal(again.replicas.temperature, saved.replicas.temperature)
    assert data["saved.S.0"].dims == ("time", "saved.S.0.axis0")
    assert data["saved_of_replicas.S.1"].dims == ("replica", "time")
    np.testing.assert_array_equal(data["saved.S.0"], each.mean(0))
    np.testing.assert_allclose(data["saved_error.S.1"], 8 / 2)
    with pytest.raises(ValueError, match="key 'a.b'"):
        curve.with_saved({"a.b": each}).to_xarray()
    whole = jaxgran.Particles(*(jnp.ones((4, 2, 3, 3)) for _ in range(2)), 2 * jnp.ones(4))
    saved = dataclasses.replace(curve, saved=whole)
    jaxgran.write_curve(tmp_path / "particles.npz", saved, {})
    same, _ = jaxgran.read_curve(tmp_path / "particles.npz")
    assert isinstance(same.saved, jaxgran.Particles)
    np.testing.assert_array_equal(same.saved.velocity, whole.velocity)
    data = saved.to_xarray()
    assert data["saved.position"].dims == ("time", "replica", "particle", "axis")
    assert data["saved.velocity"].attrs["units"] == "m/s"


def test_a_frame_has_a_row_for_each_time(curve):
    table = curve.to_pandas()
    assert list(table.index) == [0.0, 1.0, 2.0, 5.0] and table.index.name == "times"
    np.testing.assert_array_equal(table["temperature"], curve.temperature)
    assert set(table.columns) == {"temperature", "temperature_error", "collisions"}


def test_a_table_of_pandas_comes_back(curve):
    again = jaxgran.CoolingCurve.from_pandas(curve.to_pandas())
    np.testing.assert_array_equal(again.times, curve.times)
    np.testing.assert_array_equal(again.temperature_error, curve.temperature_error)
    table = curve.to_pandas().reset_index().rename(columns={"times": "t", "temperature": "T"})
    named = jaxgran.CoolingCurve.from_pandas(table)
    np.testing.assert_array_equal(named.temperature, curve.temperature)
    with pytest.raises(ValueError, match="column speed"):
        jaxgran.CoolingCurve.from_pandas(table.rename(columns={"T": "speed"}))


def test_every_quantity_of_a_curve_has_a_unit(curve):
    no_number = ("replicas", "particles", "status", "saved", "saved_error")
    numbers = {name: jnp.arange(1.0, 5.0) for name in vars(curve) if name not in no_number}
    data = jaxgran.CoolingCurve(**numbers).to_xarray()
    assert len(data.variables) == len(numbers) > 10
    assert all(x.attrs["units"] for x in data.variables.values())


def test_a_batch_of_curves_is_refused(curve):
    two = jax.tree.map(lambda x: jnp.stack([x, x]), curve)
    for show in (two.to_xarray, two.to_pandas):
        with pytest.raises(ValueError, match="times .*have shape"):
            show()


@pytest.mark.parametrize("library", ["xarray", "pandas"])
def test_a_missing_library_is_reported(curve, library, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ModuleNotFoundError, match=f"needs {library}: pip install"):
        getattr(curve, f"to_{library}")()


def test_a_table_without_times_or_with_two_temperatures_is_refused():
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame({"T": [3.0, 2.0, 1.0]})
    with pytest.raises(ValueError, match="the table has no times"):
        jaxgran.CoolingCurve.from_pandas(table)
    table = table.assign(t=[0.0, 1.0, 2.0], temperature=[1.0, 1.0, 1.0])
    with pytest.raises(ValueError, match="are the same quantity: keep one"):
        jaxgran.CoolingCurve.from_pandas(table)
