"""Plans of experiments: twins, truths, additions, and the range to expect."""

import dataclasses
from functools import partial

import numpy as np
import pytest

import jaxgran
from jaxgran.fitting import candidates, twins
from jaxgran.fitting.alternatives import Alternative
from jaxgran.fitting.kinds import initial_rate
from jaxgran.fitting.measured_rows import with_errors_that_count
from jaxgran.fitting.plan import _at_its_fit
from jaxgran.fitting.twins import Truth, _computed_curve, twin
from tests.beads import glass_beads, without

TIMES = np.geomspace(0.1, 10.0, 10)
GAS = glass_beads()


def planned(gas=GAS, times=TIMES, error=0.02, **options) -> jaxgran.Measurement:
    """A planned curve of 250 grains, with errors of T."""
    curve = jaxgran.cool(gas, times)
    curve = dataclasses.replace(
        curve,
        temperature_error=error * curve.temperature,
        rotational_temperature=None,
        displacement=None,
    )
    options = {"num_particles": 250, "errors_measured": True} | options
    return jaxgran.Measurement(gas, curve, **options)


SMOOTH = planned()
BOXED = planned(
    dataclasses.replace(GAS, container=jaxgran.Walls(0.05, restitution=0.9)),
    priors={"wall_coefficient": (0.9, 0.05)},
)
ROUGH = planned(
    dataclasses.replace(GAS, surface=jaxgran.Rough(-0.3)),
    priors={"tangential_restitution": (-0.3, 0.2)},
)


with_impacts = partial(candidates.beside, label="impacts", further=candidates.normal_impacts)
with_second_density = partial(
    candidates.beside, label="second density", further=candidates.second_density
)


def names_of(measurement) -> list[str]:
    return [candidate.name for candidate in candidates.standard_candidates(measurement)]


def test_additions_that_do_not_apply_are_left_out():
    common = ["N x 4", "a second density", "20 normal impacts", "half the errors", "duration x 10"]
    for measurement in (SMOOTH, BOXED, ROUGH):
        assert {*common} <= {*names_of(measurement)}
    of_walls = {"container x 2", "eps_w known to +-0.02"}
    of_roughness = {"T_rot measured", "beta_t known to +-0.05", "no friction: declared"}
    of_roughness |= {"20 oblique impacts"}
    absences = {"no walls: declared", "no roughness: declared", "no drag: declared"}
    special = of_walls | of_roughness | absences
    assert special & {*names_of(SMOOTH)} == absences
    assert special & {*names_of(BOXED)} == of_walls | absences - {"no walls: declared"}
    assert special & {*names_of(ROUGH)} == of_roughness | absences - {"no roughness: declared"}
    declared = dataclasses.replace(SMOOTH, absent=("drag", "walls"))
    assert special & {*names_of(declared)} == {"no roughness: declared"}
    bare = jaxgran.Measurement(GAS, jaxgran.CoolingCurve(TIMES, SMOOTH.curve.temperature))
    assert not {"half the errors", "twice the points", "N x 4"} & {*names_of(bare)}


def test_additions_change_what_they_say():
    longer = candidates.with_duration(SMOOTH, 4.0)
    assert np.allclose(longer.curve.times, np.geomspace(0.1, 40.0, 10))
    late = planned(times=np.array([0.0, 1.0, 3.0]), priors={"t0": (1.0, 0.1)})
    assert np.allclose(candidates.with_duration(late, 4.0).curve.times, [0.0, 1.0, 9.0])
    error = candidates.with_more_points(SMOOTH).curve.temperature_error
    assert np.allclose(error, SMOOTH.curve.temperature_error / 2**0.5)
    boxed = candidates.in_larger_box(BOXED)
    assert boxed.num_particles == 2000 and np.isclose(boxed.gas.value("wall_side"), 0.1)
    measured = dataclasses.replace(BOXED, priors={"wall_side": (0.05, 0.001)})
    side, error = candidates.in_larger_box(measured).priors["wall_side"]
    assert np.allclose((side, error), (0.1, 0.002))
    known = candidates.with_prior(ROUGH, "tangential_restitution", 0.1).priors
    assert float(known["tangential_restitution"][1]) == 0.1
    dense = candidates.second_density(SMOOTH)
    assert np.isclose(dense.gas.packing_fraction, 0.15)
    assert np.allclose(dense.curve.times, TIMES / 3)
    thin = candidates.second_density(
        planned(glass_beads(packing_fraction=0.12), priors={"packing_fraction": (0.12, 0.006)})
    )
    assert np.isclose(thin.priors["packing_fraction"][1], 0.002)
    dense_gas = glass_beads(packing_fraction=0.12)
    dense_box = dataclasses.replace(dense_gas, container=jaxgran.Walls(0.05, restitution=0.9))
    few = candidates.second_density(
        dataclasses.replace(planned(dense_gas), gas=dense_box, num_particles=20)
    )
    assert few.num_particles == 7
    assert np.isclose(few.gas.packing_fraction, 0.12 * 7 / 20)  # a part of a grain has no volume


def test_only_errors_that_a_fit_counts_are_planned():
    """Errors by the grains stay out of a plan, whatever changes; errors of a fit belong to it."""
    of_grains = planned(error=(2 / 3 / 250) ** 0.5, errors_measured=False)
    counted = with_errors_that_count(of_grains)
    assert (
        counted.curve.temperature_error is None and candidates.with_smaller_errors(counted) is None
    )
    assert with_errors_that_count(SMOOTH).curve.temperature_error is not None
    noise = np.exp(0.05 * np.random.default_rng(0).normal(size=TIMES.size))
    noisy = jaxgran.CoolingCurve(TIMES, noise * SMOOTH.curve.temperature)
    base = _at_its_fit(jaxgran.Measurement(GAS, noisy, num_particles=10**5), None)
    relative = np.asarray(base.curve.temperature_error / base.curve.temperature)
    assert np.allclose(relative, relative[0]) and 0.02 < relative[0] < 0.1


@pytest.mark.slow
def test_a_plan_of_T_0_gives_its_range_with_a_second_density():
    """T_0 belongs to each curve there, and A comes first in that fit."""
    changes = {"second density": with_second_density}
    free = ("temperature", "dissipative_constant")
    found = jaxgran.plan(SMOOTH, candidates=changes, free=free)
    (second,) = found.additions
    assert found.parameter == "temperature"
    assert second.gain > 0.5 and second.width < 2 * found.present.width


@pytest.mark.slow
def test_amplitudes_of_effects_do_not_depend_on_the_first_row():
    """The rate to which drag and walls refer is the rate at the start of the gas."""
    for times in (TIMES, np.linspace(3.0, 10.0, 8)):
        log_T = np.log(np.asarray(jaxgran.cool(GAS, times).temperature) / float(GAS.temperature))
        assert initial_rate(times, log_T) == pytest.approx(_computed_curve(GAS).rate, rel=0.05)


def test_additions_keep_the_labels_of_a_user():
    def also_drops(measurement):
        drops = jaxgran.DropTest([0.1, 0.2], [0.9, 0.88], [0.01, 0.01])
        return {"flight": measurement, "drops": jaxgran.Measurement(measurement.gas, drops)}

    precise = candidates.combined(also_drops, candidates.with_smaller_errors, SMOOTH)
    assert isinstance(precise, dict) and [*precise] == ["flight", "drops"]
    expected = candidates.with_smaller_errors(SMOOTH)
    error = np.asarray(precise["flight"].curve.temperature_error)
    np.testing.assert_array_equal(error, expected.curve.temperature_error)
    # The curve is there once, whatever its label, and no drop test replaces another.
    three = candidates.combined(with_impacts, also_drops, SMOOTH)
    assert isinstance(three, dict) and [*three] == ["curve", "impacts", "drops"]
    twice = candidates.combined(also_drops, also_drops, SMOOTH)
    assert isinstance(twice, dict) and [*twice] == ["flight", "drops", "drops 2"]


def test_additions_are_combined_in_both_orders():
    both = candidates.combined(with_impacts, candidates.with_smaller_errors, SMOOTH)
    reverse = candidates.combined(candidates.with_smaller_errors, with_impacts, SMOOTH)
    for found in (both, reverse):
        assert isinstance(found, dict) and [*found] == ["curve", "impacts"]
        error = found["curve"].curve.temperature_error
        assert np.allclose(error, SMOOTH.curve.temperature_error / 2)
    three = candidates.combined(with_impacts, with_second_density, SMOOTH)
    assert isinstance(three, dict) and {*three} == {"curve", "impacts", "second density"}
    assert (
        candidates.combined(candidates.in_larger_box, candidates.with_smaller_errors, SMOOTH)
        is None
    )


def test_combined_additions_keep_every_measurement():
    def with_more_impacts(m):
        return with_impacts(m) | {"impacts 2": with_impacts(m)["impacts"]}

    found = candidates.combined(with_more_impacts, with_impacts, SMOOTH)
    assert isinstance(found, dict)
    assert [*found] == ["curve", "impacts", "impacts 2", "impacts 3"]


def test_an_addition_to_no_curve_is_no_pair():
    def without_errors(m):
        curve = dataclasses.replace(m.curve, temperature_error=None)
        return with_impacts(dataclasses.replace(m, data=curve))

    assert candidates.combined(without_errors, candidates.with_smaller_errors, SMOOTH) is None


@pytest.mark.slow
def test_twin_is_the_curve_of_the_truth_with_the_relative_errors():
    truth = Truth(
        "rough and larger", {"diameter": np.log(2.0)}, "", {"surface": jaxgran.Rough(0.0)}
    )
    gas = dataclasses.replace(
        GAS.replace(diameter=2 * GAS.diameter, mass=8 * GAS.mass), surface=jaxgran.Rough(0.0)
    )
    many = dataclasses.replace(SMOOTH, num_particles=10**7)
    found = twin(many, truth).curve
    gaussian = jaxgran.cool(
        gas, TIMES, model=jaxgran.KineticTheory(corrections=without("spin_cumulants"))
    )
    assert np.allclose(found.temperature, gaussian.temperature, rtol=1e-4)
    exact = jaxgran.cool(gas, TIMES, model=jaxgran.KineticTheory())
    assert np.allclose(found.temperature, exact.temperature, rtol=0.02)
    assert np.allclose(found.temperature_error, 0.02 * found.temperature)
    few = twin(dataclasses.replace(SMOOTH, num_particles=20)).curve
    assert np.all(few.temperature < twin(many).curve.temperature)
    drops = candidates.normal_impacts(SMOOTH)
    test = twin(drops).data
    assert isinstance(test, jaxgran.DropTest) and np.allclose(test.residuals(GAS), 0.0)
    oblique = twin(candidates.oblique_impacts(ROUGH)).data
    assert isinstance(oblique, jaxgran.DropTest) and np.allclose(oblique.residuals(ROUGH.gas), 0.0)


@pytest.mark.parametrize(
    ("measurement", "options", "message"),
    [
        (SMOOTH.curve, {}, "expected a jaxgran.Measurement, got a CoolingCurve"),
        (candidates.normal_impacts(SMOOTH), {}, "begins with a cooling curve"),
        (dataclasses.replace(SMOOTH, num_particles=None), {}, "needs N, the number of grains"),
        (planned(error=3.0), {}, "errors of T are 100 % or more"),
        (SMOOTH, {"candidates": [SMOOTH]}, "candidates must be a dictionary"),
        (SMOOTH, {"candidates": {}}, "candidates must be a dictionary"),
        (SMOOTH, {"candidates": {"mine": 3}}, "candidates must be a dictionary"),
    ],
)
def test_what_makes_no_experiment_is_refused(measurement, options, message):
    with pytest.raises(ValueError, match=message):
        jaxgran.plan(measurement, **options)


@pytest.mark.minutes
def test_plan_is_the_fit_of_noise_free_curves():
    def as_it_is(m):
        return m

    found = jaxgran.plan(
        SMOOTH,
        candidates={
            "the same": as_it_is,
            "no walls, drag, roughness": dataclasses.replace(
                SMOOTH, absent=("walls", "drag", "roughness")
            ),
            "not here": lambda m: None,
        },
    )
    best, same = found.additions
    assert best.gain > 2 and same.gain == pytest.approx(1.0)
    assert best.low <= found.truth <= best.high
    assert best.width == pytest.approx((best.high - best.low) / found.truth)
    assert found.present.smallest < found.present.median < found.present.largest
    assert found.pair is None and len(found.truths) == 5
    assert "no walls, drag, roughness" in repr(found).splitlines()[0]
    axes = jaxgran.plot_plan(found)
    assert len(axes.get_yticklabels()) == 3


@pytest.mark.slow
def test_refused_candidates_are_named():
    driven = dataclasses.replace(GAS, surface=jaxgran.Frictional(0.5, friction=0.2))
    mine = jaxgran.Measurement(driven, SMOOTH.curve, num_particles=250)
    with pytest.raises(ValueError, match="candidate 'mine': .*Frictional"):
        jaxgran.plan(SMOOTH, candidates={"mine": mine})
    with pytest.raises(ValueError, match="the measurement: .*gamma"):
        jaxgran.plan(SMOOTH, free=("gamma",))
    with pytest.raises(ValueError, match="'mine' must give a jaxgran.Measurement"):
        jaxgran.plan(SMOOTH, candidates={"mine": lambda m: 3})


@pytest.mark.slow
def test_the_width_of_a_negative_parameter_is_positive():
    known = dataclasses.replace(ROUGH, absent=("walls", "drag"))
    found = jaxgran.plan(known, free=("beta_t",), candidates={"the same": lambda m: m})
    assert found.truth == pytest.approx(-0.3, rel=1e-2)
    assert found.present.low < found.truth < found.present.high
    assert found.present.width > 0
    assert found.additions[0].gain == pytest.approx(1.0)


def test_an_effect_of_amplitude_0_is_no_truth(monkeypatch):
    """Its walls would be infinitely far away in single precision."""
    monkeypatch.setattr(twins, "ADDED_ELEMENTS", {"walls": pytest.fail})
    one = np.ones(1)
    numbers = {"amplitude": 0.0, "allowed": (0.0, 0.0), "improvement": 0.0}
    verdict = {"preferred": False, "distinguishable": True, "error_reduction_needed": 1.0}
    absent = Alternative("walls", ("walls",), **numbers, estimate=one, low=one, high=one, **verdict)
    curve = twins.FittedCurve(GAS, 1.0, 1e-4)
    assert twins._with_effect(absent, 0.0, curve) is None
