"""Checkpoints of runs, and files that are written whole or not at all."""

import errno
import hashlib
import io
import json
import os
import signal
import subprocess
import sys
from functools import partial

import jax
import numpy as np
import pytest

import jaxgran
from jaxgran.data import checkpoint
from jaxgran.data.checkpoint import describe_run, differences
from jaxgran.particles import run as particle_run
from tests.beads import assert_same, glass_beads
from tests.test_contract import CASES

ODD = {
    "odd": np.array([np.nan, -0.0, np.inf, 5e-324, 1 / 3]),
    "empty": np.zeros((0, 3)),
    "single": np.linspace(0, 1, 6, dtype=np.float32).reshape(2, 3),
    "whole": np.arange(-2, 3, dtype=np.int32),
    "truth": (np.array([True, False]), np.uint8(200)),
    "nothing": None,
}


def odd(particles):
    return ODD


def resumed(path):
    """The curve of a run that saves odd numbers of all types."""
    return CASES["DSMC"].run(checkpoint=path, save=odd)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run that has ended, and the content of its checkpoint."""
    path = tmp_path_factory.mktemp("run") / "run.eqx"
    curve = resumed(path)
    assert [file.name for file in path.parent.iterdir()] == ["run.eqx"]
    return curve, path.read_bytes()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.eqx"


def assert_refused(path, content, words):
    path.write_bytes(content)
    with pytest.raises(ValueError, match=words):
        resumed(path)


@pytest.mark.slow  # at the usual level of optimisation: at the lowest one XLA flushes 5e-324
def test_round_trip_bit_for_bit(finished, path):
    curve, data = finished
    path.write_bytes(data)
    for name in (path, str(path)):
        assert_same(resumed(name), curve)
    saved = jax.tree.map(lambda x: np.asarray(x)[0, 0], curve.replicas.saved)
    assert_same(saved, jax.tree.map(np.asarray, ODD))


def test_other_runs_are_refused(finished, path):
    line, _, body = finished[1].partition(b"\n")
    for name, value in (
        ("format", "7"),
        ("version of jaxgran", "0.0.7"),
        ("times", "absent"),
        ("types and shapes of the state", "float64"),
    ):
        header = json.loads(line)
        header["scene"][name] = value
        changed = json.dumps(header).encode() + b"\n" + body
        words = f"run.eqx belongs to another run: {name} was {value} and is"
        assert_refused(path, changed, words)


def test_damaged_files_are_told_or_harmless(finished, path):
    curve, data = finished
    for part in (0.0, 0.001, 0.3, 0.9, 0.999):
        words = "run.eqx is (damaged|not a jaxgran checkpoint)"
        assert_refused(path, data[: int(part * len(data))], words)
    rng, told = np.random.default_rng(0), 0
    for end in 50 * [data.index(b"\n"), len(data)]:  # half of them in the header
        damaged = bytearray(data)
        damaged[rng.integers(end)] ^= rng.integers(1, 256)
        path.write_bytes(damaged)
        try:
            loaded = resumed(path)
        except ValueError as error:
            assert str(path) in str(error)
            told += 1
        else:  # white space of the header
            assert_same(loaded, curve)
    assert told > 93


def test_files_of_others_are_refused(path):
    archive = io.BytesIO()
    np.savez(archive, leaf_0=np.zeros(3))
    headers = (b"3", b"[]", b"{}", b'{"format": 2}', b"[" * 100_000)
    contents = (b"t,T\n0,1\n", b"\x89PNG\r\n\x1a\n", b"\x00" * 100, archive.getvalue())
    for content in (*contents, *(header + b"\n" for header in headers)):
        assert_refused(path, content, "run.eqx is not a jaxgran checkpoint")


def test_nothing_is_unpickled(finished, path):
    header = json.loads(finished[1].partition(b"\n")[0])
    body = io.BytesIO()
    np.save(body, np.array([{}]), allow_pickle=True)
    header["digest"] = hashlib.sha256(body.getvalue()).hexdigest()
    content = json.dumps(header).encode() + b"\n" + body.getvalue()
    assert_refused(path, content, "run.eqx is damaged")


CURVE = jaxgran.CoolingCurve(times=[0.1, 0.2, 0.3], temperature=[3e-3, 2e-3, 1e-3])


def test_folders_that_are_not_there(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    for name in ("none/curve.csv", "file/curve.npz", "folder"):
        path = tmp_path / name
        with pytest.raises(OSError, match="could not write") as error:
            jaxgran.write_curve(path, CURVE, {}, overwrite=True)
        assert str(path) in str(error.value) and error.value.filename == str(path)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["file", "folder"]


@pytest.mark.parametrize("stage", ["numpy.savez_compressed", "os.fsync", "os.replace"])
@pytest.mark.parametrize("fault", [OSError(errno.ENOSPC, "No space left"), KeyboardInterrupt()])
def test_whatever_ends_the_writing_the_old_file_stays(tmp_path, monkeypatch, stage, fault):
    path = tmp_path / "curve.npz"
    jaxgran.write_curve(path, CURVE, {})
    before = path.read_bytes()

    def fail(file, *args, **arrays):
        if stage == "numpy.savez_compressed":
            file.write(b"half")
        raise fault

    monkeypatch.setattr(stage, fail)
    with pytest.raises(type(fault)) as error:
        jaxgran.write_curve(path, CURVE, {"N": "3"}, overwrite=True)
    if isinstance(fault, OSError):
        assert error.value.errno == errno.ENOSPC and str(path) in str(error.value)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["curve.npz"]


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


OWN_LAW = """
import jax, jax.numpy as jnp
from jaxgran.extend import ReducedLaw, RestitutionLaw
from jaxgran.data.checkpoint import describe_run
def slow(v): return FACTOR * jnp.ones_like(v)
class Own(RestitutionLaw, ReducedLaw):
    function: object
    domains = {}
    def reduced(self, *, diameter, mass, speed): return self
    def restitution(self, normal_speed): return self.function(normal_speed)
print(describe_run(law=Own(jax.tree_util.Partial(slow))))
"""


@pytest.mark.slow
def test_a_users_law_is_described_alike_in_another_process(tmp_path):
    def described(factor):
        script = tmp_path / "own.py"
        script.write_text(OWN_LAW.replace("FACTOR", factor))
        return subprocess.check_output([sys.executable, script])

    assert described("0.9") == described("0.9") != described("0.8")


def test_files_keep_permissions_and_follow_links(tmp_path):
    curve = jaxgran.CoolingCurve([0.1, 0.2, 0.3, 0.4], [4e-3, 3e-3, 2e-3, 1e-3])
    target, link = tmp_path / "target.csv", tmp_path / "link.csv"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to(target)
    jaxgran.write_curve(link, curve, {}, overwrite=True)
    assert link.is_symlink() and target.read_text().startswith("t,T")
    assert target.stat().st_mode & 0o777 == 0o640
    old = os.umask(0o022)
    try:
        jaxgran.write_curve(tmp_path / "new.csv", curve, {})
    finally:
        os.umask(old)
    assert (tmp_path / "new.csv").stat().st_mode & 0o777 == 0o644


def test_a_termination_saves_the_run_and_then_ends_the_process(tmp_path, monkeypatch):
    ended = []
    calls = []
    ready = particle_run.block_until_ready
    path = tmp_path / "run.ckpt"
    gas = glass_beads(0.3, packing_fraction=0.1)
    times = float(gas.mean_free_time) * np.asarray([1.0, 2.0, 3.0])
    cool = partial(jaxgran.cool, gas, times, model=jaxgran.DSMC(200), progress=False)
    whole = cool()

    def ready_and_terminated(tree):
        calls.append(0)
        if len(calls) == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        return ready(tree)

    monkeypatch.setattr(checkpoint.signal, "raise_signal", ended.append)
    monkeypatch.setattr(particle_run, "block_until_ready", ready_and_terminated)
    with pytest.raises(KeyboardInterrupt):
        cool(checkpoint=path)
    assert ended == [signal.SIGTERM] and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    calls = [0] * 3
    continued = cool(checkpoint=path)
    np.testing.assert_array_equal(continued.temperature, whole.temperature)
