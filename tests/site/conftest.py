"""A fresh environment in which the wheel of this version is installed."""

import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def wheel(tmp_path_factory):
    """The wheel, made as an installer makes it."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


@pytest.fixture(scope="session")
def fresh(wheel, tmp_path_factory):
    """The programs of an environment with the wheel and what it depends on.

    The dependencies are those of this environment. Its folder is a line of a .pth file, so that
    an editable installation of jaxgran in it is not found.
    """
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder)
    paths = {"base": str(folder), "platbase": str(folder)}
    installed = sysconfig.get_path("purelib", vars=paths)
    scripts = Path(sysconfig.get_path("scripts", vars=paths))
    pip = [sys.executable, "-m", "pip", "--python", str(scripts / "python"), "install", "--no-deps"]
    subprocess.run([*pip, "--no-index", str(wheel)], check=True, capture_output=True)
    dependencies = sysconfig.get_path("purelib"), sysconfig.get_path("platlib")
    (Path(installed) / "dependencies.pth").write_text("\n".join(dependencies), encoding="utf-8")
    return scripts


@pytest.fixture
def run(fresh, tmp_path):
    """A function that runs a program of the fresh environment in an empty folder."""
    paths = os.pathsep.join([str(fresh), os.environ["PATH"]])
    bare = {key: x for key, x in os.environ.items() if not key.startswith("PYTHON")}
    bare["PATH"] = paths
    # Programs that other tests have compiled are not compiled again.
    bare["JAX_COMPILATION_CACHE_DIR"] = os.environ["JAXGRAN_TEST_PROGRAMS"]
    bare["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    bare["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"

    def run(*arguments, program="python"):
        command = [str(fresh / program), *map(str, arguments)]
        done = subprocess.run(command, cwd=tmp_path, env=bare, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run
