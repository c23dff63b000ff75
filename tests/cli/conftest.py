"""A folder with a scene and measurements, and commands run in this process."""

import shutil

import numpy as np
import pytest

from tests.cli.scenes import SCENE


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "folder").mkdir()
    (tmp_path / "bad.toml").write_text("eta : 0.05\n")
    (tmp_path / "tables.toml").write_text(SCENE + "[walls]\nside = 0.1\n")
    (tmp_path / "guess.toml").write_text(SCENE + 'beta_t = "guess"\n')
    (tmp_path / "no_A.toml").write_text(SCENE.replace("A = 3e-6", ""))
    return tmp_path


@pytest.fixture
def run(capsys):
    """A function that runs a command and returns its exit status, output and errors."""

    from jaxgran.cli.main import main

    def run(*arguments):
        status = main([str(argument) for argument in arguments])
        return status, *capsys.readouterr()

    return run


@pytest.fixture(scope="session")
def files(tmp_path_factory):
    """Two curves (errors of 2 %) and a drop test of one material; a drop test of another one."""
    import jax.numpy as jnp

    import jaxgran
    from jaxgran.data.header import gas_of_header

    folder, rng = tmp_path_factory.mktemp("measured"), np.random.default_rng(1)
    for name, phi in {"thin": 0.02, "dense": 0.08}.items():
        header = dict(line.split(" = ") for line in SCENE.splitlines()) | {"eta": str(phi)}
        gas, _ = gas_of_header(header)
        del header["A"]
        curve = jaxgran.cool(gas, jnp.geomspace(0.1, 50.0, 40))
        noisy = curve.temperature * (1 + 0.02 * rng.normal(size=40))
        rows = jaxgran.CoolingCurve(curve.times, noisy, temperature_error=0.02 * noisy)
        jaxgran.write_curve(folder / f"{name}.csv", rows, header)
    speed = np.geomspace(0.01, 1.0, 20)
    for name, A in {"drops": 3e-6, "others": 6e-6}.items():
        eps = gas.replace(dissipative_constant=A).restitution(speed)
        eps = np.minimum(eps + 0.004 * rng.normal(size=20), 1.0)
        lines = [f"{v:.6g},{e:.6g},0.004" for v, e in zip(speed, eps, strict=True)]
        (folder / f"{name}.csv").write_text("\n".join(["v,eps,eps_err", *lines]) + "\n")
    header = "# diameter: 2 mm\n# density: 2500\n# Y: 50 MPa\n# nu: 0.22\n"
    (folder / "alone.csv").write_text(header + (folder / "drops.csv").read_text())
    return folder


@pytest.fixture
def measured(scene, files):
    shutil.copytree(files, scene, dirs_exist_ok=True)
    return scene
