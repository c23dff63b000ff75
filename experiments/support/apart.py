"""Measurements that need a process of their own: cores, devices and the peak of its memory."""

import json
import os
import subprocess
import sys

from experiments.support.record import EXPERIMENTS


def alone(script: str, *arguments: str) -> dict:
    """What a script prints in its last line, as JSON, in a process of its own.

    Args:
        script: its file.
        arguments: of its command line.
    """
    environment = dict(os.environ)
    folders = [str(EXPERIMENTS.parent), environment.get("PYTHONPATH", "")]
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, folders))
    command = [sys.executable, script, *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])
