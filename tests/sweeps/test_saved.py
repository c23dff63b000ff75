"""Values that a sweep saves from the particles of its members (option save)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran import observables
from jaxgran._utils import status
from jaxgran.sweep import Store
from tests.beads import glass_beads

TIMES = (0.05, 0.1)
MODEL = jaxgran.DSMC(50, replicas=2)
EDGES = jnp.linspace(0.0, 3.0, 8)


def save(particles):
    v = particles.velocity
    assert v.shape == (50, 3)
    f = observables.velocity_distribution(v, EDGES)
    return {"T": observables.temperature(v), "forward": jnp.sum(v[:, 0] > 0), "f": (EDGES[1:], f)}


def twice(particles):
    return 2 * observables.temperature(particles.velocity)


@pytest.fixture(scope="module")
def gases():
    packing = jnp.array([0.05, 0.04, 0.06])
    return jax.vmap(lambda phi: glass_beads().replace(packing_fraction=phi))(packing)


def sweep(gases, **options):
    return jaxgran.sweep(gases, TIMES, **({"model": MODEL, "progress": False} | options))


@pytest.fixture(scope="module")
def stored(gases, tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "sweep.zarr"
    return path, sweep(gases, save=save, store=path, chunk=2)


def test_saved_values_are_those_of_cool_for_each_member(gases, stored):
    curves = stored[1]
    # Round-off of the conversion of units.
    np.testing.assert_allclose(curves.saved["T"], curves.temperature, rtol=1e-12)
    np.testing.assert_allclose(curves.replicas.saved["T"], curves.replicas.temperature, rtol=1e-12)
    np.testing.assert_allclose(curves.saved_error["T"], curves.temperature_error, rtol=1e-9)
    assert curves.saved["f"][1].shape == (3, 2, 7)
    assert curves.replicas.saved["f"][1].shape == (3, 2, 2, 7)
    forward = curves.replicas.saved["forward"]
    assert jnp.issubdtype(forward.dtype, jnp.integer)
    np.testing.assert_array_equal(curves.saved["forward"], jnp.mean(forward, axis=1))
    one = jax.tree.map(lambda x: x[2], gases)
    key = jax.random.fold_in(jax.random.key(0), 2)
    curve = jaxgran.cool(one, TIMES, model=MODEL, save=save, key=key, progress=False)
    assert jax.tree.structure(curves.saved) == jax.tree.structure(curve.saved)
    # The same random numbers: chaos has not made the rounding visible after few collisions.
    for many, single in (
        (curves.saved, curve.saved),
        (curves.replicas.saved, curve.replicas.saved),
    ):
        for a, b in zip(jax.tree.leaves(many), jax.tree.leaves(single), strict=True):
            np.testing.assert_allclose(a[2], b, rtol=1e-6)


def test_store_has_labels_for_xarray(stored):
    path, curves = stored
    found = pytest.importorskip("xarray").open_zarr(path)
    for name, axes in {"T": (), "forward": (), "f.1": ("saved.f.1.axis0",)}.items():
        assert found[f"saved.{name}"].dims == ("member", "time", *axes)
        assert found[f"saved_error.{name}"].dims == ("member", "time", *axes)
        each = found[f"saved_of_replicas.{name}"]
        assert each.dims == ("member", "replica", "time", *axes)
    np.testing.assert_array_equal(found["saved.f.1"], curves.saved["f"][1])
    np.testing.assert_array_equal(found["saved_error.T"], curves.saved_error["T"])
    np.testing.assert_array_equal(
        found["saved_of_replicas.forward"], curves.replicas.saved["forward"]
    )
    assert "units" not in found["saved.T"].attrs  # a user's function determines them


def test_a_sweep_with_saved_values_is_resumed(gases, stored, tmp_path, monkeypatch):
    path, written, write = tmp_path / "sweep.zarr", [], Store.write

    def killed(self, number, records):
        if written:
            self.group["saved.T"][self.rows(number)] = records["saved.T"]
            raise KeyboardInterrupt
        written.append(number)
        write(self, number, records)

    monkeypatch.setattr(Store, "write", killed)
    with pytest.raises(KeyboardInterrupt):
        sweep(gases, save=save, store=path, chunk=2)
    rest = []
    monkeypatch.setattr(Store, "write", lambda s, n, r: (rest.append(n), write(s, n, r)))
    curves = sweep(gases, save=save, store=path)
    assert (written, rest) == ([0], [1])
    assert jax.tree.structure(curves) == jax.tree.structure(stored[1])
    for a, b in zip(jax.tree.leaves(curves), jax.tree.leaves(stored[1]), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_store_with_other_saved_values_is_refused(gases, stored):
    with pytest.raises(ValueError, match="another sweep: save was .*test_saved.save .* absent"):
        sweep(gases, store=stored[0])
    with pytest.raises(ValueError, match="save was .*test_saved.save .* is .*test_saved.twice"):
        sweep(gases, save=twice, store=stored[0])


def test_unsupported_members_are_nan_or_0(gases):
    dense = jnp.array([0.05, 0.9, 0.06])
    bad = jax.vmap(lambda gas, phi: gas.replace(packing_fraction=phi))(gases, dense)
    with pytest.warns(UserWarning, match="the first of them is 1"):
        curves = sweep(bad, save=save, chunk=2)
    assert list(curves.status) == [0, status.UNSUPPORTED.bit, 0]
    assert np.isnan(curves.saved["T"][1]).all() and np.isfinite(curves.saved["T"][::2]).all()
    assert np.all(curves.replicas.saved["forward"][1] == 0)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda p: {"a.b": p.velocity}, "the key 'a.b': keys name arrays"),
        (lambda p: {"a/b": p.velocity}, "the key 'a/b'"),
        (lambda p: jax.random.key(1), "must return numbers, got an array of key"),
        (lambda p: "words", "must return numbers, got 'words'"),
        (lambda p: None, "must return arrays, in any tree, got None"),
    ],
)
def test_values_that_cannot_be_saved_are_refused(gases, tmp_path, function, message):
    with pytest.raises(ValueError, match=message):
        sweep(gases, save=function, store=tmp_path / "sweep.zarr")
    assert not any(tmp_path.iterdir())


@pytest.mark.slow  # a program of particles is compiled
def test_particles_with_positions(gases, tmp_path):
    xarray = pytest.importorskip("xarray")
    path = tmp_path / "sweep.zarr"
    model = jaxgran.HardSpheres(50, replicas=2)
    curves = sweep(gases, model=model, save="particles", store=path)
    assert curves.saved.position.shape == (3, 2, 2, 50, 3)
    found = xarray.open_zarr(path)
    position = found["saved.position"]
    assert position.dims == ("member", "time", "replica", "particle", "axis")
    assert position.units == "m" and found["saved.velocity"].units == "m/s"
    np.testing.assert_array_equal(position, curves.saved.position)
    assert found["saved.box_side"].dims == ("member", "time")
    T = np.mean(np.square(found["saved.velocity"].values), axis=(2, 3, 4))
    np.testing.assert_allclose(T, curves.temperature, rtol=1e-12)  # round-off of units
    again = sweep(gases, model=model, save="particles", store=path)
    np.testing.assert_array_equal(again.saved.position, curves.saved.position)
