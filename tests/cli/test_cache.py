"""The cache of compiled programs."""

import os
import subprocess
import sys

import jax
import pytest

from jaxgran.cli.main import main


@pytest.fixture
def cache_of(monkeypatch):
    """A function that runs a command as in a new process; it returns the folder of its programs."""
    monkeypatch.delenv("JAXGRAN_NO_CACHE", raising=False)
    monkeypatch.setenv("XLA_FLAGS", "")
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)

    def cache_of(folder):
        monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
        assert main(["choose", "none.toml", "--until", "1"]) == 2
        return jax.config.values["jax_compilation_cache_dir"]

    yield cache_of
    jax.config.update("jax_compilation_cache_dir", before)


def test_the_compilation_cache_is_used_if_possible(tmp_path, monkeypatch, cache_of):
    (tmp_path / "file").write_text("")
    assert cache_of(tmp_path / "file") is None
    monkeypatch.setenv("JAXGRAN_NO_CACHE", "1")
    assert cache_of(tmp_path) is None
    monkeypatch.setenv("JAXGRAN_NO_CACHE", "0")
    programs = tmp_path / "jaxgran" / "compiled"
    assert cache_of(tmp_path) == str(programs)
    assert programs.stat().st_mode & 0o777 == 0o700
    assert cache_of(tmp_path / "others") == str(programs)  # one is set already


def test_a_cache_folder_that_others_can_write_is_not_used(tmp_path, cache_of):
    shared = tmp_path / "jaxgran" / "compiled"
    shared.mkdir(parents=True)
    shared.chmod(0o777)
    assert cache_of(tmp_path) is None


@pytest.mark.slow
def test_the_second_run_of_a_command_compiles_nothing(scene):
    """Run the command in separate processes, without a display; 30 s."""
    environment = {"XDG_CACHE_HOME": str(scene), "PATH": os.environ["PATH"], "HOME": str(scene)}
    environment |= {"PYTHONPATH": os.pathsep.join(sys.path)}
    cache = scene / "jaxgran" / "compiled"

    def run(*more):
        line = "import sys; from jaxgran.cli.main import main; sys.exit(main(sys.argv[1:]))"
        command = [sys.executable, "-c", line, "cool", "scene.toml", "--until", "1", "--overwrite"]
        done = subprocess.run(
            [*command, *more], env=environment, cwd=scene, capture_output=True, text=True
        )
        assert done.returncode == 0 and not done.stderr
        return {path.name for path in cache.glob("*-cache")}

    assert not run("--no-cache")
    first = run()
    assert first and run() == first
