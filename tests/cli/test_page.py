"""Reports as pages."""

import jax
import numpy as np
import pytest

import jaxgran
from jaxgran.cli.plan import read_experiment
from tests.cli.scenes import EXPERIMENT, SCENE


@pytest.mark.slow
@pytest.mark.minutes
def test_reports_are_single_pages(scene, run):
    (scene / "flight.toml").write_text(SCENE + EXPERIMENT)
    assert run("plan", "flight.toml", "--report")[0] == 0
    header = {"eta": 0.05, "diameter": 2e-3, "density": 2500, "Y": 5e7, "nu": 0.22, "T0": 0.01}
    measured = read_experiment(scene / "flight.toml")
    # A run of 250 grains, measured with errors of 2 %.
    model = jaxgran.DSMC(250)
    run_of_N = jaxgran.cool(measured.gas, measured.curve.times, model=model, key=jax.random.key(1))
    noise = 1 + 0.02 * np.random.default_rng(0).standard_normal(measured.curve.times.size)
    T = np.asarray(run_of_N.temperature) * noise
    curve = jaxgran.CoolingCurve(measured.curve.times, T, temperature_error=0.02 * T)
    jaxgran.write_curve("flown.csv", curve, header | {"N": 250, "absent": "walls"})
    options = "--report", "--imitate", 2, "--out", "."
    status, out, _ = run("fit", "flown.csv", *options)
    assert status == 0 and "of 2 imitations, its median width is" in out
    for name, words, pictures in (
        ("flight-plan.html", "Which range of A will this experiment give", 1),
        ("flown-kinetic-theory.html", "What to measure next", 2),
    ):
        page = (scene / name).read_text()
        assert words in page and page.count("data:image/png;base64,iVBOR") == pictures
        assert "<script" not in page and str(scene) not in page
