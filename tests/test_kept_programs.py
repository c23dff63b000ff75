"""Programs that are kept in files: another process, here a second wrapper, need not trace them."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.checks import kept_programs
from jaxgran.checks.kept_programs import keep_in, kept, kept_in_one


class Found(NamedTuple):
    name: str
    value: jax.Array


class Own(eqx.Module):
    """A class that is no part of jaxgran, as a user's law is."""

    scale: float = eqx.field(static=True)


@pytest.fixture
def folder(tmp_path):
    keep_in(tmp_path)
    yield tmp_path
    keep_in(None)


def wrapped(traced: list, wrap=kept):
    def scaled(x, name, factor=2.0):
        traced.append(name)
        scale = factor.scale if isinstance(factor, Own) else factor
        return Found(name, scale * jnp.linalg.svd(x, compute_uv=False))

    return wrap(scaled)


def test_a_second_process_does_not_trace(folder):
    traced = []
    first = wrapped(traced)(jnp.eye(2), "a")
    second = wrapped(traced)(jnp.eye(2), "a")
    assert traced == ["a"] and first.name == second.name == "a"
    assert np.array_equal(first.value, second.value) and np.all(first.value == 2)
    assert second.value.dtype == first.value.dtype
    (file,) = folder.iterdir()
    assert file.name.startswith("scaled-") and file.suffix == ".program"


@pytest.mark.parametrize(
    "x, name, factor",
    [
        (jnp.eye(3), "a", 2.0),
        (jnp.eye(2, dtype=jnp.float32), "a", 2.0),
        (jnp.eye(2), "b", 2.0),
        (jnp.eye(2), "a", 3.0),
    ],
)
def test_other_arguments_are_another_program(folder, x, name, factor):
    traced = []
    wrapped(traced)(jnp.eye(2), "a", 2.0)
    found = wrapped(traced)(x, name, factor)
    assert traced == ["a", name] and found.name == name and found.value.shape == x.shape[:1]
    assert np.all(found.value == factor) and len([*folder.iterdir()]) == 2


def test_other_code_is_another_program(folder, monkeypatch):
    traced = []
    wrapped(traced)(jnp.eye(2), "a")
    before = kept_programs._surroundings()
    monkeypatch.setattr(kept_programs, "_surroundings", lambda: (*before[:-1], "edited"))
    wrapped(traced)(jnp.eye(2), "a")
    assert traced == ["a", "a"]


def test_the_source_is_read(tmp_path, monkeypatch):
    before = kept_programs._source()
    assert before == kept_programs._source()
    (tmp_path / "more.py").write_text("")
    monkeypatch.setattr(kept_programs, "__file__", str(tmp_path / "checks" / "kept_programs.py"))
    empty = kept_programs._source()
    (tmp_path / "more.py").write_text("x = 1")
    assert len({before, empty, kept_programs._source()}) == 3


@pytest.mark.parametrize("damage", [b"", b"x" * 40, None])
def test_a_damaged_file_is_made_again(folder, damage):
    traced = []
    wrapped(traced)(jnp.eye(2), "a")
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(whole[:-100] if damage is None else damage)
    assert np.all(wrapped(traced)(jnp.eye(2), "a").value == 2)
    assert traced == ["a", "a"]
    wrapped(traced)(jnp.eye(2), "a")
    assert traced == ["a", "a"] and file.stat().st_size > 1000


def test_what_a_user_wrote_is_not_kept(folder):
    traced = []
    assert np.all(wrapped(traced)(jnp.eye(2), "a", Own(3.0)).value == 3)
    assert np.all(wrapped(traced)(jnp.eye(2), "a", Own(4.0)).value == 4)
    assert not [*folder.iterdir()]


def test_traced_arguments_are_as_ever(folder):
    traced = []
    function = wrapped(traced)
    slope = jax.grad(lambda x: function(x * jnp.eye(2), "a").value.sum())(1.0)
    assert slope == 4 and not [*folder.iterdir()]


def test_few_operations_are_as_they_are_where_nothing_is_kept():
    traced = []
    plain, compiled = wrapped(traced, kept_in_one), wrapped(traced, kept)
    for function in (plain, plain, compiled, compiled):
        assert np.all(function(jnp.eye(2), "a").value == 2)
    assert len(traced) == 3  # each call of the plain one, one trace of the other


def test_old_files_make_room(folder, monkeypatch):
    monkeypatch.setattr(kept_programs, "MOST_KEPT", 2)
    for name in "abc":
        wrapped([])(jnp.eye(2), name)
    assert len([*folder.iterdir()]) == 2


def test_a_folder_that_cannot_be_written_is_no_fault(tmp_path):
    (tmp_path / "file").write_text("")
    keep_in(tmp_path / "file")
    try:
        assert np.all(wrapped([])(jnp.eye(2), "a").value == 2)
    finally:
        keep_in(None)


def test_numbers_of_a_gas_are_the_same_where_programs_are_kept(beads, folder):
    gas = beads(0.15)
    names = ("mean_free_path", "mean_free_time", "contact_fraction", "critical_box", "thermal_beta")
    there = [float(getattr(gas, name)) for name in names]
    assert {file.name.split("-")[0] for file in folder.iterdir()} >= {*names}
    keep_in(None)
    # To round-off: XLA may join operations.
    assert np.allclose(there, [float(getattr(gas, name)) for name in names], rtol=1e-14, atol=0)


def test_a_fit_is_the_same_where_programs_are_kept(beads, folder):
    gas = beads(0.15)
    cooled = jaxgran.cool(gas, jnp.geomspace(0.01, 10.0, 12))
    curve = jaxgran.CoolingCurve(
        cooled.times, cooled.temperature, temperature_error=0.01 * cooled.temperature
    )
    first, second = jaxgran.fit(gas, curve), jaxgran.fit(gas, curve)
    keep_in(None)
    plain = jaxgran.fit(gas, curve)
    assert jax.tree.structure(first) == jax.tree.structure(plain)
    for one, other, third in zip(*map(jax.tree.leaves, (first, second, plain)), strict=True):
        assert np.array_equal(one, other, equal_nan=True) and one.dtype == third.dtype
    # The search ends where its steps are below a hundredth of the error.
    assert np.allclose(first.estimate, plain.estimate, rtol=1e-9)
