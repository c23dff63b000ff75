"""Sweeps in one process: members, stores, failures and invalid input."""

import dataclasses
import json
import shutil
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran._utils import status
from jaxgran.models.spheres import Plan
from jaxgran.sweep import Program, Store

TIMES = (0.1, 1.0, 10.0)
A = jnp.geomspace(1e-6, 1e-5, 5)


@pytest.fixture(scope="module")
def gas():
    law = jaxgran.Viscoelastic(5e7, 0.22, 1e-6)
    return jaxgran.Gas(law, diameter=2e-3, mass=1e-5, packing_fraction=0.05, temperature=0.01)


@pytest.fixture(scope="module")
def gases(gas):
    return jax.vmap(lambda a: gas.replace(dissipative_constant=a))(A)


def sweep(gases, times=TIMES, **options):
    return jaxgran.sweep(gases, times, progress=False, **options)


def one(gases, i):
    return jax.tree.map(lambda x: x[i], gases)


@pytest.fixture(scope="module")
def stored(gases, tmp_path_factory):
    path = tmp_path_factory.mktemp("sweep") / "sweep.zarr"
    return path, sweep(gases, store=path, chunk=2)


def copied(stored, tmp_path):
    return shutil.copytree(stored[0], tmp_path / "copy.zarr")


def files(path):
    return {p: p.read_bytes() for p in path.rglob("*") if p.is_file()}


def test_members_are_the_curves_of_cool(gases):
    curves = sweep(gases, chunk=2)
    for i in range(len(A)):
        curve = jaxgran.cool(one(gases, i), TIMES)
        # Under jax.vmap rounding differs, within the tolerance of the ODE solver.
        np.testing.assert_allclose(curves.temperature[i], curve.temperature, rtol=1e-9)
        np.testing.assert_allclose(curves.diffusion[i], curve.diffusion, rtol=1e-9)
    assert curves.times.shape == curves.temperature.shape == (5, 3)
    assert not np.any(curves.status)


def test_only_some_floats_have_an_axis(gas, gases):
    some = gas.replace(temperature=jnp.array([0.01, 0.02]))
    curves = sweep(some)
    curve = jaxgran.cool(gas.replace(temperature=0.02), TIMES)
    np.testing.assert_allclose(curves.temperature[1], curve.temperature, rtol=1e-9)


@pytest.mark.slow
def test_particles_with_replicas_and_keys(gas):
    model, keys = jaxgran.DSMC(200, replicas=2), jax.random.split(jax.random.key(3), 3)
    curves = sweep(gas, model=model, key=keys, chunk=2)
    assert curves.replicas.temperature.shape == (3, 2, 3)
    for i, key in enumerate(keys):
        curve = jaxgran.cool(gas, TIMES, model=model, key=key, progress=False)
        # The same random numbers: chaos has not made the rounding visible after few collisions.
        np.testing.assert_allclose(
            curves.replicas.temperature[i, :, 0], curve.replicas.temperature[:, 0], rtol=1e-6
        )
    first = sweep(gas, model=model, key=keys[:1])
    np.testing.assert_array_equal(first.temperature[0], curves.temperature[0])


def test_keys_of_members_do_not_depend_on_their_number(gas, gases):
    model, key = jaxgran.DSMC(200), jax.random.key(1)
    same = jax.tree.map(lambda x: jnp.broadcast_to(x[:1], x.shape), gases)
    curves = sweep(same, model=model, key=key, chunk=2)
    assert len(np.unique(curves.temperature[:, -1])) == len(A)
    fewer = sweep(jax.tree.map(lambda x: x[:2], same), model=model, key=key, chunk=1)
    # Programs for other numbers of members may add in another order; other keys differ by per cent.
    np.testing.assert_allclose(fewer.temperature, curves.temperature[:2], rtol=1e-13)


def test_store_has_labels_and_units_for_xarray(stored, gases):
    xarray = pytest.importorskip("xarray")
    path, curves = stored
    found = xarray.open_zarr(path)
    np.testing.assert_array_equal(found.temperature, curves.temperature)
    np.testing.assert_array_equal(found.dissipative_constant, A)
    assert found.temperature.dims == ("member", "time")
    assert found.dissipative_constant.dims == ("member",)
    assert float(found.initial_temperature) == 0.01 and found.diameter.units == "m"
    assert found.dissipative_constant.units == "s" and found.temperature.units == "m^2/s^2"
    np.testing.assert_array_equal(found.time, TIMES)


def test_a_sweep_is_resumed_chunk_by_chunk(gases, stored, tmp_path, monkeypatch):
    path, written, write = tmp_path / "sweep.zarr", [], Store.write

    def killed(self, number, records):
        if len(written) == 1:
            raise KeyboardInterrupt
        written.append(number)
        write(self, number, records)

    monkeypatch.setattr(Store, "write", killed)
    with pytest.raises(KeyboardInterrupt):
        sweep(gases, store=path, chunk=2)
    rest = []
    monkeypatch.setattr(Store, "write", lambda s, n, r: (rest.append(n), write(s, n, r)))
    curves = sweep(gases, store=path)
    assert written == [0] and rest == [1, 2]
    np.testing.assert_array_equal(curves.temperature, stored[1].temperature)


def test_members_that_fail_are_nan_and_do_not_end_the_others(gases):
    steps = jaxgran.KineticTheory(max_steps=16)  # enough for few of them
    curves = sweep(gases, (0.1, 1.0, 1e6), model=steps)
    assert np.any(curves.status == status.MAX_STEPS_REACHED.bit)
    dense = jax.vmap(lambda phi: one(gases, 0).replace(packing_fraction=phi))
    with pytest.warns(UserWarning, match="members 0 to 2 .* first of them is 1"):
        curves = sweep(dense(jnp.array([0.05, 0.9, 0.1])), (0.01,))
    assert curves.status[1] != 0 and np.all(curves.status[::2] == 0)
    assert np.isnan(curves.temperature[1]).all() and np.all(curves.temperature[::2] > 0)


@pytest.mark.slow  # a program of particles is compiled
def test_unsupported_members_are_nan(gases):
    bad = jax.vmap(lambda phi: one(gases, 0).replace(packing_fraction=phi))
    dense = bad(jnp.array([0.05, 0.6, 0.1]))
    with pytest.warns(UserWarning, match="members 0 to 2 .* first of them is 1: .*too dense"):
        curves = sweep(dense, (0.01,), model=jaxgran.HardSpheres(50))
    assert list(curves.status) == [0, status.UNSUPPORTED.bit, 0]
    assert np.isnan(curves.temperature[1]).all() and np.all(curves.temperature[::2] > 0)
    assert "does not support" in jaxgran.explain_status(curves.status[1])


@pytest.mark.slow  # two programs of particles are compiled
def test_a_chunk_is_run_again_if_a_member_overflows_its_arrays(gas, gases):
    model = jaxgran.HardSpheres(100)
    long = model.sized_for(gas)
    few = {name: getattr(long.plan, name)._replace(pairs=20) for name in Plan._fields[2:]}
    short = dataclasses.replace(long, plan=long.plan._replace(**few))
    program = Program.create(long, jnp.array([0.01]), 1, [])
    args = jax.tree.map(lambda x: x[:1], gases), jax.random.split(jax.random.key(2), 1)
    overflowed = program._replace(models=(short,)).run(*args)
    assert overflowed["status"] & status.LIST_FULL.bit and np.isnan(overflowed["temperature"]).all()
    repeated = program._replace(models=(short, long)).run(*args)
    np.testing.assert_array_equal(repeated["temperature"], program.run(*args)["temperature"])
    assert repeated["status"] == 0


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (lambda g: {"times": (0.1, 1.0, 11.0)}, "another sweep: times was"),
        (lambda g: {"model": jaxgran.KineticTheory(softness=False)}, "another sweep: model"),
        (lambda g: {"key": jax.random.key(7)}, "another sweep: keys"),
        (lambda g: {"gases": jax.tree.map(lambda x: x[:4], g)}, "another sweep: gases"),
        (lambda g: {"chunk": 3}, "another sweep: chunk was 2 and is 3"),
    ],
)
def test_store_of_another_sweep_is_refused(gases, stored, tmp_path, changed, message):
    path = copied(stored, tmp_path)
    before = files(path)
    with pytest.raises(ValueError, match=message):
        sweep(**({"gases": gases, "store": path} | changed(gases)))
    assert files(path) == before


def attributes(**changed):
    def change(path):
        header = json.loads((path / "zarr.json").read_text())
        header["attributes"] |= changed
        (path / "zarr.json").write_text(json.dumps(header))

    return change


def header_of(name, **changed):
    def change(path):
        path = path / name / "zarr.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changed))

    return change


def cut(name):
    def change(path):
        (path / name).write_bytes((path / name).read_bytes()[:-9])

    return change


def one_bit(path):
    values = path / "temperature" / "c" / "1" / "0"
    held = bytearray(values.read_bytes())
    held[-9] ^= 1
    values.write_bytes(held)


def gone(name):
    return lambda path: (
        shutil.rmtree(path / name) if (path / name).is_dir() else ((path / name).unlink())
    )


DAMAGED = r"copy.zarr: chunk 1 \(members 2 to 3\) is incomplete or was changed"
NO_STORE = "copy.zarr is not the store of a sweep .*. Name another folder, or remove it"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (cut("temperature/c/1/0"), DAMAGED),
        (gone("temperature/c/1/0"), DAMAGED),
        (one_bit, DAMAGED),
        (gone("temperature"), "is damaged: it has no array 'temperature' .*. Copy the store again"),
        (cut("temperature/zarr.json"), "is damaged: it has no array 'temperature'"),
        (header_of("temperature", shape=[4, 3]), r"'temperature' of float64 and shape \(4, 3\)"),
        (header_of("diffusion", data_type="float32"), "an array 'diffusion' of float32"),
        (header_of("finished", shape=[2]), r"an array 'finished' of uint64 and shape \(2,\)"),
        (cut("finished/c/1"), "is damaged: it has a damaged array 'finished'"),
        (gone("dissipative_constant"), "no array 'dissipative_constant'"),
        (gone("time/c/0"), "other values in 'time'"),
        (attributes(version="0.0.9"), "written by jaxgran 0.0.9 .*Finish the sweep with that"),
        (attributes(format=2), "in format 2, this is .* with format 1, .*or name another store"),
        (attributes(chunk="two"), NO_STORE),
        (attributes(chunk=0), NO_STORE),
        (attributes(description=[1]), NO_STORE),
        (cut("zarr.json"), NO_STORE),
        (gone("zarr.json"), NO_STORE),
    ],
)
def test_stores_of_another_version_and_incomplete_stores_are_refused(
    gases, stored, tmp_path, change, message
):
    path = copied(stored, tmp_path)
    change(path)
    before = files(path)
    with pytest.raises(ValueError, match=message):
        sweep(gases, store=path)
    assert files(path) == before


def test_other_files_and_folders_are_refused_and_left_alone(gases, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="notes.txt is not the store of a sweep .it is a file"):
        sweep(gases, store=tmp_path / "notes.txt")
    with pytest.raises(ValueError, match="is not the store of a sweep .No group found"):
        sweep(gases, store=tmp_path)
    assert files(tmp_path) == {tmp_path / "notes.txt": b"mine"}
    with pytest.raises(ValueError, match="store must be a path, got 3"):
        sweep(gases, store=3)


def test_invalid_input_is_refused_before_a_store_is_created(gas, gases, tmp_path):
    path = tmp_path / "sweep.zarr"
    wrong = [
        ({"times": (1.0, 0.1)}, "times must increase, got 0.1 after 1"),
        ({"model": "auto"}, "model must be a jaxgran model, got 'auto'"),
        ({"chunk": "2"}, "chunk must be a whole number >= 1"),
        ({"gases": {"dissipation": A}}, "a dict: use jax.vmap"),
        ({"save": lambda p: p.velocity}, "KineticTheory has no particles"),
        ({"save": "velocities", "model": jaxgran.DSMC(100)}, 'or "particles", got'),
    ]
    for options, message in wrong:
        with pytest.raises(ValueError, match=message):
            sweep(**({"gases": gases, "store": path} | options))
    with pytest.raises(TypeError, match="parameters"):
        sweep(gases, parameters={"dissipation": A})
    assert not any(tmp_path.iterdir())


def test_ragged_batches_and_unknown_names_are_refused(gas, gases):
    ragged = gas.replace(temperature=jnp.ones(3), diameter=jnp.ones(2))
    with pytest.raises(
        ValueError, match="one length, at least 1, got .*diameter 2.* temperature 3"
    ):
        sweep(ragged)
    with pytest.raises(ValueError, match="one length.*key 2, .*dissipative_constant 5"):
        sweep(gases, key=jax.random.split(jax.random.key(0)))
    with pytest.raises(ValueError, match="one length, at least 1, got .* 0"):
        sweep(jax.tree.map(lambda x: x[:0], gases))
    with pytest.raises(ValueError, match="no float 'dissipation' in this gas; it has youngs"):
        jax.vmap(lambda a: gas.replace(dissipation=a))(A)
    with pytest.raises(ValueError, match="no float of gases has a leading axis"):
        sweep(gas)
    with pytest.raises(ValueError, match="a list: stack the floats"):
        sweep([gas, gas])
    with pytest.raises(ValueError, match=r"temperature has shape \(2, 2\).*ravel"):
        sweep(gas.replace(temperature=jnp.ones((2, 2))))
    with pytest.raises(ValueError, match="key must be a key .* or an array of keys"):
        sweep(gases, key=3)
    with pytest.raises(ValueError, match="chunk must be"):
        sweep(gases, chunk=0)
    with pytest.raises(ValueError, match="supports no member of this sweep; member 0: temperature"):
        sweep(jax.vmap(lambda T: gas.replace(temperature=T))(jnp.array([-1.0, -2.0])))


@pytest.mark.slow
def test_lists_have_the_axis_of_members_first():
    law = jaxgran.RestitutionSeries((-0.1, -0.1), (0.0, 0.2))
    gas = jaxgran.Gas(law, diameter=2e-3, mass=1e-5, packing_fraction=0.05, temperature=0.01)
    lists = jax.vmap(lambda c: gas.replace(coefficients=jnp.stack([-0.1, c])))
    lists = lists(jnp.array([-0.1, -0.2, -0.3]))
    curves = sweep(lists)
    alone = jaxgran.cool(gas.replace(coefficients=[-0.1, -0.3]), TIMES)
    np.testing.assert_allclose(curves.temperature[2], alone.temperature, rtol=1e-9)


@pytest.mark.slow
def test_ambiguous_wall_sides_are_refused(gas):
    walls = jaxgran.Walls([0.05, 0.06, 0.07], restitution=0.9)
    box = dataclasses.replace(gas, container=walls)
    curves = sweep(jax.vmap(lambda a: box.replace(dissipative_constant=a))(A))
    assert curves.temperature.shape == (5, 3)
    with pytest.raises(ValueError, match="sides of one box or those of 3 cubes"):
        sweep(box.replace(temperature=jnp.ones(3) * 0.01))


def test_a_valid_sweep_gives_no_warning(gases, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sweep(gases, store=tmp_path / "sweep.zarr")
