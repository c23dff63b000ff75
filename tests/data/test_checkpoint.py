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


def assert_refused(path, words, scene=ABC, like=None):
    with pytest.raises(ValueError, match=words):
        load(path, scene, state() if like is None else like)


def test_round_trip_bit_for_bit(path):
    for scene in ({}, ABC):
        save(path, scene, state())
        same_bits(load(path, scene, state()), state())
    save(str(path), ABC, jnp.ones(3))  # written over
    same_bits(load(str(path), ABC, jnp.zeros(3)), jnp.ones(3))
    assert [file.name for file in path.parent.iterdir()] == ["run.eqx"]


def test_other_runs_are_refused(path, monkeypatch):
    save(path, ABC, state())
    words = "run.eqx .* name was abc and is abd; N was absent and is"
    assert_refused(path, words, scene={"name": "abd", "N": "3"})
    for like in (state(), jnp.zeros(3)), jnp.zeros(3):
        assert_refused(path, "run.eqx belongs to another run", like=like)
    save(path, ABC, np.ones((3, 2)))
    # Another shape of as many numbers, another type, another structure.
    for like in np.zeros((2, 3)), np.zeros((3, 2), np.float32), [np.zeros((3, 2)), 0]:
        assert_refused(path, "run.eqx belongs to another run", like=like)
    same_bits(load(path, ABC, np.zeros((3, 2))), np.ones((3, 2)))
    for name, value, words in (
        ("FORMAT", "7", "format was 7 and is 5"),
        ("version", lambda package: "0.0.7", "version of jaxgran was 0.0.7 and is"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(checkpoint, name, value)
            save(path, ABC, state())
        assert_refused(path, f"run.eqx belongs to another run: {words}")


def test_damaged_files_are_told_or_harmless(path):
    save(path, ABC, state())
    data = path.read_bytes()
    for part in (0.0, 0.001, 0.3, 0.9, 0.999):
        path.write_bytes(data[: int(part * len(data))])
        assert_refused(path, "run.eqx is (damaged|no checkpoint of jaxgran)")
    rng, told = np.random.default_rng(0), 0
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
    assert_refused(path, "run.eqx is no checkpoint .* No such file")
    assert_refused(path.parent, f"{path.parent.name} is no checkpoint")
    archive = io.BytesIO()
    np.savez(archive, leaf_0=np.zeros(3))
    headers = (b"3", b"[]", b"{}", b'{"format": 2}', b"[" * 100_000)
    contents = (b"t,T\n0,1\n", b"\x89PNG\r\n\x1a\n", b"\x00" * 100, archive.getvalue())
    for content in (*contents, *(header + b"\n" for header in headers)):
        path.write_bytes(content)
        assert_refused(path, "run.eqx is no checkpoint")


def test_nothing_is_unpickled(path):
    save(path, ABC, np.zeros(1))
    header = json.loads(path.read_bytes().split(b"\n")[0])
    body = io.BytesIO()
    np.save(body, np.array([{}]), allow_pickle=True)
    header["digest"] = hashlib.sha256(body.getvalue()).hexdigest()
    path.write_bytes(json.dumps(header).encode() + b"\n" + body.getvalue())
    assert_refused(path, "run.eqx is damaged", like=np.zeros(1))


def test_folders_that_are_not_there(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    for name in ("none/run.eqx", "file/run.eqx", "folder"):
        path = tmp_path / name
        with pytest.raises(OSError, match="could not write") as error:
            save(path, ABC, state())
        assert str(path) in str(error.value) and error.value.filename == str(path)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["file", "folder"]


@pytest.mark.parametrize("stage", ["write", "fsync", "replace"])
@pytest.mark.parametrize("fault", [OSError(errno.ENOSPC, "No space left"), KeyboardInterrupt()])
def test_whatever_ends_the_writing_the_old_file_stays(path, monkeypatch, stage, fault):
    save(path, ABC, state())
    before = path.read_bytes()

    def fail(*args):
        raise fault

    def write(file):
        file.write(b"half")
        if stage == "write":
            fail()

    if stage != "write":
        monkeypatch.setattr(files.os, stage, fail)
    with pytest.raises(type(fault)) as error:
        write_atomically(path, write)
    if isinstance(fault, OSError):
        assert error.value.errno == errno.ENOSPC and str(path) in str(error.value)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["run.eqx"]


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


def described(function):
    return describe_run(save=function)


def test_descriptions_of_functions_hold_what_they_keep():
    three = described(observable(3))
    assert three == described(observable(3)) and "save.default 0" in three
    assert differences(three, described(observable(4))) == ["save.number was 3 and is 4"]
    assert differences(three, described(observable(3, 2.0)))
    # What jax.jit has wrapped is the function.
    assert described(jax.jit(observable(3))) == three
    assert differences(described(jax.jit(observable(3))), described(jax.jit(recursive())))
    assert described(recursive()) == described(recursive())
