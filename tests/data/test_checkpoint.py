import errno
import hashlib
import io
import json
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.data import checkpoint, files
from jaxgran.data.checkpoint import describe_run, differences, load, save
from jaxgran.data.files import write_atomically

ABC = {"name": "abc"}


class State(NamedTuple):
    time: jax.Array
    rest: dict


def state():
    rest = {
        "odd": np.array([np.nan, -0.0, np.inf, 5e-324, 1 / 3]),
        "empty": np.zeros((0, 3)),
        "single": jnp.linspace(0, 1, 6, dtype=jnp.float32).reshape(2, 3),
        "whole": jnp.arange(-2, 3, dtype=jnp.int32),
        "truth": (np.array([True, False]), np.uint8(200)),
        "nothing": None,
    }
    return State(jnp.asarray(0.1), rest)


def same_bits(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(map(np.asarray, jax.tree.leaves(a)), jax.tree.leaves(b), strict=True):
        assert x.dtype == np.asarray(y).dtype and x.shape == np.shape(y)
        assert x.tobytes() == np.asarray(y).tobytes()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.eqx"


def test_round_trip_bit_for_bit(path):
    for scene in ({}, ABC):
        save(path, scene, state())
        same_bits(load(path, scene, state()), state())
    save(str(path), ABC, jnp.ones(3))  # written over
    same_bits(load(str(path), ABC, jnp.zeros(3)), jnp.ones(3))
    assert [file.name for file in path.parent.iterdir()] == ["run.eqx"]


def test_other_scenes_are_refused(path):
    save(path, ABC, state())
    other = {"name": "abd", "N": "3"}
    with pytest.raises(ValueError, match="run.eqx .* name was abc and is abd; N was absent and is"):
        load(path, other, state())
    with pytest.raises(ValueError, match="run.eqx belongs to another run"):
        load(path, ABC, (state(), jnp.zeros(3)))
    with pytest.raises(ValueError, match="run.eqx belongs to another run"):
        load(path, ABC, jnp.zeros(3))


@pytest.mark.parametrize(
    "like",
    [
        np.zeros((2, 3)),  # another shape of as many numbers
        np.zeros((3, 2), np.float32),
        [np.zeros((3, 2)), 0],
    ],
)
def test_other_arrays_are_refused(path, like):
    save(path, ABC, np.ones((3, 2)))
    with pytest.raises(ValueError, match="run.eqx belongs to another run"):
        load(path, ABC, like)
    same_bits(load(path, ABC, np.zeros((3, 2))), np.ones((3, 2)))


def test_other_formats_are_refused(path, monkeypatch):
    monkeypatch.setattr(checkpoint, "FORMAT", "7")
    save(path, ABC, state())
    monkeypatch.undo()
    with pytest.raises(ValueError, match="run.eqx belongs to another run: format was 7 and is 5"):
        load(path, ABC, state())


def test_other_versions_are_refused(path, monkeypatch):
    monkeypatch.setattr(checkpoint, "version", lambda package: "0.0.7")
    save(path, ABC, state())
    monkeypatch.undo()
    with pytest.raises(ValueError, match="another run: version of jaxgran was 0.0.7 and is"):
        load(path, ABC, state())


@pytest.mark.parametrize("part", [0.0, 0.001, 0.3, 0.9, 0.999])
def test_truncated_files_are_refused(path, part):
    save(path, ABC, state())
    data = path.read_bytes()
    path.write_bytes(data[: int(part * len(data))])
    with pytest.raises(ValueError, match="run.eqx is (damaged|no checkpoint of jaxgran)"):
        load(path, ABC, state())


def test_a_damaged_byte_is_told_or_harmless(path):
    save(path, ABC, state())
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    told = 0
    for _ in range(300):
        damaged = bytearray(data)
        damaged[rng.integers(len(data))] ^= rng.integers(1, 256)
        path.write_bytes(damaged)
        try:
            loaded = load(path, ABC, state())
        except ValueError as error:
            assert str(path) in str(error)
            told += 1
        else:  # white space of the header
            same_bits(loaded, state())
    assert told > 280


def test_files_of_others_are_refused(path):
    with pytest.raises(ValueError, match="run.eqx is no checkpoint .* No such file"):
        load(path, ABC, state())
    with pytest.raises(ValueError, match=f"{path.parent.name} is no checkpoint"):
        load(path.parent, ABC, state())
    for content in (b"t,T\n0,1\n", b"\x89PNG\r\n\x1a\n", b"\x00" * 100):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="run.eqx is no checkpoint"):
            load(path, ABC, state())
    np.savez(path, leaf_0=np.zeros(3))
    with pytest.raises(ValueError, match="run.eqx is no checkpoint"):
        load(path, ABC, state())
    for header in (b"3", b"[]", b"{}", b'{"format": 2}', b"[" * 100_000):
        path.write_bytes(header + b"\n")
        with pytest.raises(ValueError, match="run.eqx is no checkpoint"):
            load(path, ABC, state())


def test_nothing_is_unpickled(path):
    save(path, ABC, np.zeros(1))
    header = json.loads(path.read_bytes().split(b"\n")[0])
    body = io.BytesIO()
    np.save(body, np.array([{}]), allow_pickle=True)
    header["digest"] = hashlib.sha256(body.getvalue()).hexdigest()
    path.write_bytes(json.dumps(header).encode() + b"\n" + body.getvalue())
    with pytest.raises(ValueError, match="run.eqx is damaged"):
        load(path, ABC, np.zeros(1))


def test_folders_that_are_not_there(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    for path in (
        tmp_path / "none" / "run.eqx",
        tmp_path / "file" / "run.eqx",
        tmp_path / "folder",
    ):
        with pytest.raises(OSError, match="could not write") as error:
            save(path, ABC, state())
        assert str(path) in str(error.value) and error.value.filename == str(path)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["file", "folder"]


@pytest.mark.parametrize("stage", ["write", "fsync", "replace"])
def test_a_full_disk_keeps_the_old_file(path, monkeypatch, stage):
    save(path, ABC, state())
    before = path.read_bytes()

    def full(*args):
        raise OSError(errno.ENOSPC, "No space left on device")

    def write(file):
        file.write(b"half")
        if stage == "write":
            full()

    if stage != "write":
        monkeypatch.setattr(files.os, stage, full)
    with pytest.raises(OSError, match="No space left") as error:
        write_atomically(path, write)
    assert error.value.errno == errno.ENOSPC and str(path) in str(error.value)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["run.eqx"]


@pytest.mark.parametrize("what", [KeyboardInterrupt, MemoryError, ZeroDivisionError])
def test_any_end_of_writing_keeps_the_old_file(path, what):
    save(path, ABC, state())
    before = path.read_bytes()

    def write(file):
        file.write(b"half")
        raise what

    with pytest.raises(what):
        write_atomically(path, write)
    assert path.read_bytes() == before
    same_bits(load(path, ABC, state()), state())


def test_descriptions_tell_everything_apart():
    key = jax.random.key
    trees = [
        {"a": 1.0, "b": np.arange(3)},
        {"a": np.nextafter(1.0, 2), "b": np.arange(3)},  # any number
        {"a": 1.0, "b": np.array([0, 1, 3])},
        {"a": 1, "b": np.arange(3)},  # any type
        {"a": True, "b": np.arange(3)},
        {"a": 1.0, "b": np.arange(3)[None]},  # any shape
        {"a": 1.0, "c": np.arange(3)},  # any structure
        {"a": 1.0},
        0.0,
        -0.0,
        0,  # the bits of 0.0
        jaxgran.DSMC(10),
        jaxgran.DSMC(10, replicas=2),  # any static choice
        key(0),
        key(1),
    ]
    words = [describe_run(run=tree) for tree in trees]
    for i, first in enumerate(words):
        for j, second in enumerate(words):
            assert (first == second) == (i == j), (first, second)
            assert bool(differences(first, second)) == (i != j)


def observable(number, factor=1.0):
    def save(particles, power=2):
        return factor * number * particles**power

    return save


def recursive():
    def again(x):
        return again(x - 1) if x > 0 else x

    return again


def test_descriptions_of_functions_hold_what_they_keep():
    assert describe_run(save=observable(3)) == describe_run(save=observable(3))
    (words,) = differences(describe_run(save=observable(3)), describe_run(save=observable(4)))
    assert words == "save.number was 3 and is 4"
    assert differences(describe_run(save=observable(3)), describe_run(save=observable(3, 2.0)))
    assert "save.default 0" in describe_run(save=observable(3))
    # What jax.jit has wrapped is the function.
    assert describe_run(save=jax.jit(observable(3))) == describe_run(save=observable(3))
    assert differences(
        describe_run(save=jax.jit(observable(3))), describe_run(save=jax.jit(recursive()))
    )
    assert describe_run(save=recursive()) == describe_run(save=recursive())
