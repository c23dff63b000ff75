"""Headers of curve files: the gas, its elements, priors, and what is known besides."""

import re

import numpy as np
import pytest
from pytest import approx

import jaxgran
from jaxgran import read_measurement
from jaxgran.cli.options import parse_settings
from jaxgran.data.header import gas_of_header
from jaxgran.data.header_lines import header_in_si
from jaxgran.data.measurement_header import priors_of_header
from tests.data.curve_files import (
    GAS,
    PLAIN,
    ROUGH,
    SPEED_XY,
    TIMES,
    T,
    assert_plain,
    gas_of,
    header_of,
    said,
    text_of,
)


def test_eta_follows_from_N_and_the_container():
    gas = gas_of(eta=None, container_side=0.09, wall_restitution=0.9)
    assert float(gas.packing_fraction) == pytest.approx(2000 * np.pi / 6 * (0.003 / 0.09) ** 3)


@pytest.mark.parametrize(
    "keys",
    [
        {"container_side": "9 cm"},
        {"container_side": "90 ± 1 mm"},
        {"container_side": "9", "length_unit": "cm"},
        {"container_side": "9 x 9 x 9 cm"},
    ],
)
def test_a_side_has_the_unit_that_was_given(keys):
    sides = header_in_si(keys)["container_side"]
    np.testing.assert_allclose([float(side) for side in sides.split("x")], 0.09)


def test_an_error_in_per_cent_needs_its_value():
    assert header_in_si({"phi": "0.04", "phi_err": "5 %"})["eta_err"] == "0.002"
    assert float(header_in_si({"T_scale_err": "2 %"})["T_scale_err"]) == approx(0.02)
    # Behind the scale it is an error of the scale, alone a part of it.
    assert float(header_in_si({"T_scale": "2.00 ± 0.03"})["T_scale_err"]) == approx(0.015)
    assert float(header_in_si({"T_scale": "2 ± 3 %"})["T_scale_err"]) == approx(0.03)
    assert float(header_in_si({"T_scale": "2", "T_scale_err": "0.03"})["T_scale_err"]) == 0.03


@pytest.mark.parametrize("scale", ["2.00 +- .03", "2.00(3)", "2,00 ± 0,03"])
def test_the_scale_of_T_is_a_known_key_whose_error_is_a_part_of_it(scale, write):
    measurement = read_measurement(write(text_of(T_scale=scale)))  # a warning would be an error
    assert measurement.calibration_error == approx(0.015)
    assert parse_settings([f"T_scale={scale}"]) == {"T_scale": scale}
    with pytest.raises(ValueError, match="T_scale: the value must not be 0"):
        header_in_si({"T_scale": "0 ± 0.03"})


def test_frames_are_counted_per_second_whatever_the_unit_of_times():
    assert float(header_in_si({"time_unit": "ms", "frame_rate": "500"})["frame_rate"]) == 500
    assert float(header_in_si({"frame_rate": "0.5 kHz"})["frame_rate"]) == approx(500)
    assert header_in_si({"camera_err": "2 %"})["camera_err"] == "2 %"
    with pytest.raises(ValueError, match="density_err is a part of density, which .* lacks"):
        header_in_si({"density_err": "2 %"})


def test_a_header_says_what_is_known_of_the_measurement(write):
    known = {"replicas": 3, "tracked": 120, "errors": "measured", "absent": "walls, drag"}
    measurement = read_measurement(write(text_of(**known, eta_err=0.002)), {"N": 500})
    assert measurement.num_particles == 500 and measurement.replicas == 3
    assert measurement.tracked == 120 and measurement.errors_measured
    assert measurement.absent == ("walls", "drag")
    assert measurement.priors["packing_fraction"] == pytest.approx((0.04, 0.002))
    plain = read_measurement(write(PLAIN))
    assert plain.tracked is None and not plain.errors_measured
    with pytest.raises(ValueError, match="errors: .*any or measured, got 'of T'"):
        read_measurement(write(text_of(errors="of T")))


def test_a_guess_is_where_a_fit_starts():
    assert float(gas_of(beta_t="guess").value("tangential_restitution")) == 0


def test_every_error_of_a_header_is_a_prior():
    keys = {"wall_restitution": "0.9", "wall_restitution_err": "0.02", "beta_t": "0.5"}
    assert priors_of_header(keys) == {"wall_coefficient": (0.9, 0.02)}
    priors = priors_of_header({"diameter": "2e-3", "diameter_err": "1e-5", "density": "2500"})
    assert priors["diameter"] == (2e-3, 1e-5) and priors["density"][0] == 2500
    assert priors["density"][1] < 1  # so that the mass follows the diameter


def test_a_setting_counts_before_anything_is_read(write):
    speeds = text_of("t,mean_speed", (TIMES, SPEED_XY))
    measurement = read_measurement(write(speeds), {"dimension": 2})
    np.testing.assert_allclose(measurement.curve.temperature, T, rtol=1e-7)
    energies = text_of("t,energy", (TIMES, 1.5 * float(GAS.mass) * T), density=None)
    measurement = read_measurement(write(energies), {"density": "1.2 g/cm^3"})
    np.testing.assert_allclose(measurement.curve.temperature, T, rtol=1e-7)
    milli = text_of("t,T", (1e3 * TIMES, T))
    told = {"time_unit": "ms", "speed_unit": "m/s", "T0": "0.02 m^2/s^2"}
    measurement = read_measurement(write(milli), told)
    np.testing.assert_allclose(measurement.curve.times, TIMES, rtol=1e-7)
    np.testing.assert_allclose(measurement.curve.temperature, T, rtol=1e-7)


@pytest.mark.parametrize("text", ["# T: 293 K (room)\n", "# D: 3 mm\n", "# t: noon\n"])
def test_names_of_columns_are_free_in_the_header(text, write):
    curve, gas, words = said(write(text + PLAIN))
    assert_plain(curve, gas)
    assert f"ignoring unknown header keys: {text[2]}" in words


@pytest.mark.parametrize(
    "text", ["8 x 6 x 4 cm", "80x60x40 mm", "0.08 × 0.06 × 0.04"], ids=["cm", "mm", "metres"]
)
def test_a_container_has_three_sides(text):
    header = header_of(container_side=text, wall_restitution=0.9, eta=None)
    gas = gas_of_header(header_in_si(header))[0]
    np.testing.assert_allclose(gas.value("wall_side"), [0.08, 0.06, 0.04])
    volume = 2000 * np.pi / 6 * 0.003**3
    assert float(gas.packing_fraction) == approx(volume / (0.08 * 0.06 * 0.04))


def test_constant_restitution_has_a_key():
    gas = gas_of(eps=0.9, Y=None, nu=None)
    assert isinstance(gas.law, jaxgran.ConstantRestitution)
    assert float(gas.value("coefficient")) == 0.9
    with pytest.raises(ValueError, match="gives eps, .* and Y, nu of viscoelastic"):
        gas_of(eps=0.9)
    with pytest.raises(ValueError, match="lacks nu; .* eps: VALUE"):
        gas_of(nu=None)


FLOATS = {
    "beta_t": "tangential_restitution",
    "T_rot_0": "rotational_temperature",
    "container_side": "wall_side",
    "wall_restitution": "wall_coefficient",
    "wall_beta_t": "wall_tangential_restitution",
    "gamma": "drag_rate",
}
"""Floats of the gas that keys of headers give, where their names differ."""


ELEMENTS = ("surface", "container", "drag", "drive")
FRICTION = {"friction": "0.3", "tangential_damping": "0.5", "T_rot_0": "2e-3"}


@pytest.mark.parametrize("keys, elements", [(ROUGH, ELEMENTS), (FRICTION, ("friction",))])
def test_elements_are_read_from_a_header(keys, elements):
    gas = gas_of(**keys)
    assert gas.elements == elements and float(gas.value("inertia")) == 0.4
    for key, text in keys.items():
        assert float(gas.value(FLOATS.get(key, key))) == float(text)


def test_a_header_may_say_that_there_is_nothing_of_it():
    assert gas_of(gravity=0, aspect_ratio=1).elements == ()


def test_unknown_header_keys_are_told():
    _, (question,) = gas_of_header(header_of(**{"mu": "0.5", "A comment of some words": "x"}))
    assert re.match("ignoring unknown header keys: mu. Known keys are eta.*friction", question)
