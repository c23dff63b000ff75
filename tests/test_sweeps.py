"""Sweeps in one process: members, stores, saved values, failures and invalid input."""

import dataclasses
import inspect
import re
import shutil
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran import observables
from tests.beads import assert_same, glass_beads, hard_gas, without
from tests.sweep_process import TIMES, members

GAS, GASES = glass_beads(), members(5)
A = GASES.value("dissipative_constant")
DSMC = jaxgran.DSMC(64, replicas=2)


def sweep(gases=GASES, times=TIMES, **options):
    return jaxgran.sweep(gases, times, progress=False, **options)


def dense(*packing):
    return jax.vmap(lambda phi: GAS.replace(packing_fraction=phi))(jnp.array(packing))


def forward(particles):
    v = particles.velocity
    assert v.shape == (64, 3)
    edges = jnp.linspace(0.0, 3.0, 8)
    f = observables.velocity_distribution(v, edges)
    return {"T": observables.temperature(v), "num": jnp.sum(v[:, 0] > 0), "f": [edges[1:], f]}


SAVED = {"times": (0.05, 0.1), "model": DSMC, "save": forward, "chunk": 2}
"""Options of sweeps of particles, which share a program."""


def twice(particles):
    return 2 * observables.temperature(particles.velocity)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("sweep") / "sweep.zarr"
    return path, sweep(store=path, chunk=2)


@pytest.fixture(scope="module")
def store_of_saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "sweep.zarr"
    return path, sweep(store=path, **SAVED)


def files(path):
    return {p: p.read_bytes() for p in path.rglob("*") if p.is_file()}


@pytest.mark.slow
def test_members_are_the_curves_of_cool():
    curves = sweep(chunk=2)
    for i, a in enumerate(A):
        curve = jaxgran.cool(GAS.replace(dissipative_constant=a), TIMES)
        # Under jax.vmap rounding differs, within the tolerance of the ODE solver.
        np.testing.assert_allclose(curves.temperature[i], curve.temperature, rtol=1e-9)
        np.testing.assert_allclose(curves.diffusion[i], curve.diffusion, rtol=1e-9)
    assert curves.times.shape == curves.temperature.shape == (5, 3)
    assert not np.any(curves.status)


@pytest.mark.slow
def test_keys_of_members_do_not_depend_on_their_number():
    same, key = jax.tree.map(lambda x: jnp.broadcast_to(x[:1], x.shape), GASES), jax.random.key(1)
    curves = sweep(same, key=key, **SAVED)
    assert len(np.unique(curves.temperature[:, -1])) == len(A)
    fewer = sweep(jax.tree.map(lambda x: x[:2], same), key=key, **SAVED)
    np.testing.assert_allclose(fewer.temperature, curves.temperature[:2], rtol=1e-13)
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(2))
    given = sweep(jax.tree.map(lambda x: x[0], GASES), key=keys, **SAVED)
    np.testing.assert_allclose(given.temperature, fewer.temperature, rtol=1e-13)


@pytest.mark.slow
def test_saved_values_are_those_of_cool_for_each_member(store_of_saved):
    curves = store_of_saved[1]
    # Round-off of the conversion of units.
    np.testing.assert_allclose(curves.saved["T"], curves.temperature, rtol=1e-12)
    np.testing.assert_allclose(curves.saved_error["T"], curves.temperature_error, rtol=1e-9)
    assert curves.replicas.saved["f"][1].shape == (5, 2, 2, 7)
    assert jnp.issubdtype(curves.replicas.saved["num"].dtype, jnp.integer)
    gas, key = jax.tree.map(lambda x: x[2], GASES), jax.random.fold_in(jax.random.key(0), 2)
    curve = jaxgran.cool(gas, (0.05, 0.1), model=DSMC, save=forward, key=key, progress=False)
    # The same random numbers: chaos has not made the rounding visible after few collisions.
    member = jax.tree.map(lambda x: x[2], curves)
    for part in ("saved", "saved_error", "replicas"):
        one, other = getattr(member, part), getattr(curve, part)
        assert jax.tree.structure(one) == jax.tree.structure(other)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), one, other)


@pytest.mark.slow
def test_a_store_has_labels_and_units_for_xarray(store, store_of_saved):
    xarray = pytest.importorskip("xarray")
    found = xarray.open_zarr(store[0])
    np.testing.assert_array_equal(found.temperature, store[1].temperature)
    np.testing.assert_array_equal(found.dissipative_constant, A)
    np.testing.assert_array_equal(found.time, TIMES)
    assert found.temperature.dims == ("member", "time")
    assert found.dissipative_constant.dims == ("member",)
    assert float(found.initial_temperature) == 0.01 and found.diameter.units == "m"
    assert found.dissipative_constant.units == "s" and found.temperature.units == "m^2/s^2"
    assert found.status.dims == ("member",) and not np.any(found.status)
    path, curves = store_of_saved
    found = xarray.open_zarr(path)
    assert found["saved.f.1"].dims == ("member", "time", "saved.f.1.axis0")
    assert found["saved_of_replicas.num"].dims == ("member", "replica", "time")
    np.testing.assert_array_equal(found["saved_error.f.1"], curves.saved_error["f"][1])
    np.testing.assert_array_equal(found["saved_of_replicas.num"], curves.replicas.saved["num"])
    assert "units" not in found["saved.T"].attrs  # a user's function determines them


@pytest.mark.slow
def test_only_unfinished_chunks_are_computed(store_of_saved, tmp_path):
    zarr = pytest.importorskip("zarr")
    options = SAVED | {"store": tmp_path / "s.zarr"}
    assert sweep(**options).temperature.shape == (5, 2)
    # As after a kill within the second chunk: its status is written last.
    group = zarr.open_group(options["store"], mode="r+")
    group["saved.T"][:], group["temperature"][:], group["status"][2:4] = -5.0, -5.0, -1
    curves, whole = sweep(**options), store_of_saved[1]
    np.testing.assert_array_equal(curves.temperature[2:4], whole.temperature[2:4])
    np.testing.assert_array_equal(curves.saved["T"][2:4], whole.saved["T"][2:4])
    np.testing.assert_array_equal(curves.temperature[jnp.array([0, 1, 4])], -5.0)


def test_a_finished_store_is_read(store, store_of_saved):
    assert_same(sweep(store=store[0]), store[1])
    path, curves = store_of_saved
    assert_same(sweep(**(SAVED | {"store": path, "chunk": None})), curves)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"times": (0.1, 1.0, 11.0)}, "another sweep, with another times. Name another store"),
        ({"model": jaxgran.KineticTheory(corrections=without("softness"))}, "with another model"),
        ({"key": jax.random.key(7)}, "with another key"),
        ({"gases": jax.tree.map(lambda x: x[:4], GASES)}, "with another gases, key"),
        ({"chunk": 3}, "with another chunk"),
        ({"times": (0.05, 0.1), "model": DSMC, "save": twice}, "with another .*save"),
    ],
)
def test_a_store_of_another_sweep_is_refused(store, changed, message):
    before = files(store[0])
    with pytest.raises(ValueError, match=message):
        sweep(**({"store": store[0]} | changed))
    assert files(store[0]) == before


def test_a_store_of_another_version_is_refused(store, tmp_path):
    path = shutil.copytree(store[0], tmp_path / "old.zarr")
    about = path / "zarr.json"
    about.write_text(re.sub('(version of jaxgran": ")[^"]*', r"\g<1>0.0.9", about.read_text()))
    with pytest.raises(ValueError, match="with another version of jaxgran"):
        sweep(store=path)


def test_other_files_and_folders_are_refused_and_left_alone(tmp_path):
    pytest.importorskip("zarr")
    (tmp_path / "notes.txt").write_text("mine")
    for path in (tmp_path / "notes.txt", tmp_path):
        with pytest.raises(ValueError, match="not the store .*Name another folder"):
            sweep(store=path)
    assert files(tmp_path) == {tmp_path / "notes.txt": b"mine"}


def test_members_that_fail_are_nan_and_do_not_end_the_others():
    sweep = inspect.unwrap(jaxgran.sweep)  # which the check of its annotations calls
    with pytest.warns(UserWarning, match="members 0 to 1 .* is 1") as warned:
        curves = sweep(dense(0.05, 0.9, 0.1), progress=False, **SAVED)
    assert np.isnan(curves.temperature[1]).all() and np.all(curves.temperature[::2] > 0)
    number = curves.replicas.saved["num"]
    assert not np.any(number[1]) and np.all(number[::2] > 0)
    assert warned[0].filename == __file__  # the line of the caller
    assert list(curves.status) == [0, 8192, 0]
    assert "does not support" in jaxgran.explain_status(curves.status[1])


def test_gases_share_one_search_for_pairs():
    sized_for_all = sys.modules["jaxgran.sweeps"]._sized_for_all
    model = jaxgran.HardSpheres(5000)
    dilute, dense = (hard_gas(packing_fraction=phi) for phi in (0.05, 0.4))
    assert [model.sized_for(gas)._sizes.engine for gas in (dilute, dense)] == ["sweep", "cells"]
    both = sized_for_all(model, [dilute, dense], 2.0)
    assert both.neighbours == both._sizes.engine == "cells"
    cells = dataclasses.replace(model, neighbours="cells").sized_for(dense)
    assert both._sizes.capacity.lookahead == cells._sizes.capacity.lookahead


@pytest.mark.minutes  # programs of particles are compiled
def test_a_chunk_is_run_again_if_a_member_overflows_its_arrays(monkeypatch):
    module = sys.modules["jaxgran.sweeps"]
    sized_for_all = module._sized_for_all

    def short_below_1(model, gases, spare):
        model = sized_for_all(model, gases, 2.0)
        names = "capacity", "equilibration_capacity"
        few = {name: getattr(model._sizes, name)._replace(pairs=20) for name in names}
        short = dataclasses.replace(model, _sizes=model._sizes._replace(**few))
        return short if spare < 1 else model

    def curves(*factors):
        monkeypatch.setattr(module, "SPARE_FACTORS", factors)
        pair = jax.tree.map(lambda x: x[:2], GASES)
        return sweep(pair, (0.01,), model=jaxgran.HardSpheres(100))

    monkeypatch.setattr(module, "_sized_for_all", short_below_1)
    short, whole = curves(0.5), curves(2.0)
    assert np.all(short.status == 1) and np.isnan(short.temperature).all()  # lists are full
    assert not np.any(whole.status)
    np.testing.assert_array_equal(curves(0.5, 2.0).temperature, whole.temperature)


@pytest.mark.minutes  # a program of particles is compiled
def test_particles_with_positions(tmp_path):
    xarray = pytest.importorskip("xarray")
    options = {"model": jaxgran.HardSpheres(50, replicas=2), "save": "particles"}
    gases = GAS.replace(packing_fraction=jnp.array([0.05, 0.04]))  # one float with an axis
    options |= {"gases": gases, "times": (0.05, 0.1), "store": tmp_path / "sweep.zarr"}
    curves = sweep(**options)
    assert curves.saved.position.shape == (2, 2, 2, 50, 3)
    found = xarray.open_zarr(options["store"])
    position = found["saved.position"]
    assert position.dims == ("member", "time", "replica", "particle", "axis")
    assert position.units == "m" and found["saved.velocity"].units == "m/s"
    assert found["saved.box_side"].dims == ("member", "time")
    T = np.mean(np.square(found["saved.velocity"].values), axis=(2, 3, 4))
    np.testing.assert_allclose(T, curves.temperature, rtol=1e-12)  # round-off of units
    assert_same(sweep(**options), curves)


TWO_LENGTHS = GAS.replace(temperature=jnp.ones(3), diameter=jnp.ones(2))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"model": "auto"}, "model must be a jaxgran model, got 'auto'"),
        ({"chunk": 0}, "chunk must be"),
        ({"store": 3}, "store must be a path, got 3"),
        ({"key": 3}, "key must be a key .* or an array of keys"),
        ({"gases": {"dissipation": A}}, "got a dict. Build it by jax.vmap"),
        ({"gases": GAS}, "no parameter of gases has a leading axis"),
        ({"gases": jax.tree.map(lambda x: x[:0], GASES)}, "one length, at least 1, got .* 0"),
        ({"gases": TWO_LENGTHS}, "one length, at least 1, got .*diameter 2.* temperature 3"),
        ({"key": jax.random.split(jax.random.key(0))}, "key 2, .*dissipative_constant 5"),
        ({"gases": GAS.replace(temperature=jnp.ones((2, 2)))}, r"has shape \(2, 2\).*ravel"),
        ({"gases": dense(2.0, 3.0)}, "supports no member .*; member 0: packing_fraction"),
        ({"save": lambda p: {"a.b": p.velocity}, "model": DSMC}, "the key 'a.b': keys name arrays"),
        ({"save": lambda p: None, "model": DSMC}, "must return a pytree of arrays, got None"),
        ({"save": lambda p: "words", "model": DSMC}, "must return numbers, got 'words'"),
    ],
)
def test_invalid_input_is_refused_before_a_store_is_created(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        sweep(**({"store": tmp_path / "sweep.zarr"} | options))
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_ambiguous_wall_sides_are_refused():
    walls = jaxgran.Walls([0.05, 0.06, 0.07], restitution=0.9)
    box = dataclasses.replace(GAS, container=walls)
    curves = sweep(jax.vmap(lambda a: box.replace(dissipative_constant=a))(A))
    assert curves.temperature.shape == (5, 3)
    with pytest.raises(ValueError, match="one box .*or 3 cubes"):
        sweep(box.replace(temperature=jnp.ones(3) * 0.01))
