"""Measurements that need a separate process: cores, devices and peak memory."""

import json
import os
import subprocess
import sys

from experiments.support.record import EXPERIMENTS


def alone(script: str, *arguments: str) -> dict:
    """Run a script in a separate process and return its last printed line, which is JSON.

    Args:
        script: file of the script.
        arguments: its command-line arguments.
    """
    environment = dict(os.environ)
    folders = [str(EXPERIMENTS.parent), environment.get("PYTHONPATH", "")]
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, folders))
    command = [sys.executable, script, *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])
