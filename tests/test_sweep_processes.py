"""Sweeps over several processes with two CPU devices each, on the loopback address."""

import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxgran
from tests.sweep_process import TIMES, members

ROOT = Path(__file__).parents[1]


def run(processes, store, number, die_at=-1):
    """Return exit codes, the chunks that each process reports as written, and the outputs."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "tests.sweep_process", str(port)]
    rest = [str(x) for x in (processes, store, number, die_at)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "cwd": ROOT}
    started = [subprocess.Popen([*command, str(i), *rest], **pipes) for i in range(processes)]
    outputs = [process.communicate(timeout=300) for process in started]
    chunks = [
        [int(line.split()[1]) for line in out.splitlines() if line.startswith("chunk")]
        for out, _ in outputs
    ]
    return [process.returncode for process in started], chunks, outputs


@pytest.fixture(scope="module")
def expected():
    return jaxgran.sweep(members(10), TIMES, chunk=2, progress=False)


def check(store, expected):
    # The same program, on another number of devices.
    stored = jaxgran.sweep(members(10), TIMES, store=store, progress=False)
    np.testing.assert_allclose(stored.temperature, expected.temperature, rtol=1e-12)
    assert not np.any(stored.status)


@pytest.mark.minutes
def test_a_sweep_is_resumed_after_a_process_was_killed(tmp_path, expected):
    store = tmp_path / "sweep.zarr"
    codes, chunks, outputs = run(2, store, 10, die_at=3)
    assert codes[1] == -signal.SIGKILL and codes[0] != 0
    assert "another task died" in outputs[0][1]
    assert chunks == [[0, 2, 4], [1]]
    codes, again, outputs = run(2, store, 10)
    # No chunk is lost or computed twice.
    assert codes == [0, 0] and sum(again, []) == [3]
    for out, _ in outputs:  # all devices, devices of the process, members
        assert "done 4 2 (10, 3)" in out
    check(store, expected)
