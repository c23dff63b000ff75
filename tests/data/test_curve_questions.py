"""Questions about files whose header and columns contradict each other."""

import re

import numpy as np
import pytest

from jaxgran import read_measurement
from tests.data.curve_files import GAS, SPEED_XY, TIMES, T, said, text_of

QUESTIONED = {
    "twice T": (text_of("t,T", (TIMES, 2 * T)), "1.9.* times .*T0 = 0.02.*twice T.*by 0.5"),
    "<v^2>": (text_of("t,T", (TIMES, 3 * T)), "<v.2>, not divided by the dimension.*by 0.333"),
    "projected speeds": (
        text_of("t,mean_speed", (TIMES, SPEED_XY), T0=0.02 * np.pi**2 / 16),
        "A 37 % too large: name the column mean_speed_xy",
    ),
    "projected speeds, true T0": (
        text_of("t,mean_speed", (TIMES, SPEED_XY)),
        "name the column mean_speed_xy, or multiply T by 1.62",
    ),
    "T of disks over 3": (text_of("t,T", (TIMES, 2 / 3 * T), dimension=2), "multiply it by 1.5"),
    "one component over 3": (text_of("t,T", (TIMES, T / 3)), "one component over 3.* by 3"),
    "T/T0, T0: 1": (text_of("t,T", (TIMES, T / 0.02), T0=1), "T0 is 1 m.*divided by its first"),
    "the energy of all": (
        text_of("t,energy", (TIMES, 3000 * float(GAS.mass) * T)),
        "energy of all N .*total_energy, or multiply it by 0.0005",
    ),
    "T0 in kelvin, too": (
        text_of("t,T", (TIMES, 1e17 * T), T0=2e15),
        "T0 is 2e.15 m.2/s.2, .*kelvin times 1.38e-23 J/K over the mass",
    ),
    "an error larger than its value": (
        text_of(nu_err=0.4),
        "nu_err is 0.4, larger than nu itself, 0.3",
    ),
    "T/T0": (text_of("t,T", (TIMES, T / 0.02)), "is the column T over T0.*multiply it by 0.02"),
    "kelvin, untold": (
        text_of("t,T", (TIMES, T * float(GAS.mass) / 1.380649e-23)),
        "T is .*e.16 m.2/s.2, .*0 to 900",
    ),
    "energy": (text_of("t,T", (TIMES, 1.5 * float(GAS.mass) * T)), "energy of a particle, in J"),
    "T in mm^2/s^2": (text_of("t,T", (TIMES, 1e6 * T)), "T is .* mm.2/s.2"),
    "t in ms": (text_of("t,T", (1e3 * TIMES, T)), "mean free times .* is t in ms"),
    "t in steps": (text_of("t,T", (np.round(1e5 * TIMES), T)), "mean free times .* in steps"),
    "a late clock": (text_of("t,T", (TIMES + 1000, T)), "T is T0 .* at t = 1000 s.*--free A t0"),
    "density in g/cm^3": (text_of(density=1.2), "density is 1.2 kg/m.3.* in g/cm.3.*density: 1200"),
    "diameter in mm": (
        text_of(diameter=3),
        "diameter is 3 m, .*mm.*diameter: 0.003",
    ),
    "Y_err in Pa, Y in GPa": (text_of(Y="0.02 GPa", Y_err=1e6), "Y_err is 1e.15 Pa, larger than Y"),
    "errors of other runs": (text_of(N=2e9), "T_err is at least .* larger .* N = 2e.09 particles"),
    "N of one": (text_of(N=1), "T_err is .* smaller .* N = 1 "),
}
"""Files whose header and columns contradict each other, and the question that is asked."""


@pytest.mark.parametrize("content, question", QUESTIONED.values(), ids=QUESTIONED)
def test_files_are_questioned(content, question, write):
    words = said(write(content))[2]
    assert re.search(question, words.replace("\n", " ")), words


def test_speeds_of_drop_tests_are_asked_about(tmp_path):
    (tmp_path / "drops.csv").write_text("v,eps,eps_err\n10,0.92,0.01\n100,0.9,0.01\n")
    with pytest.warns(UserWarning, match="v is 100 m/s, .*0 to 8: .*cm/s"):
        read_measurement(tmp_path / "drops.csv", gas=GAS)
