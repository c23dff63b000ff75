"""The contract of a model: what holds for each model of this package and for a user's own.

All runs of a model have the same shapes, so that three compiled programs serve nearly all tests: a
run, a run with tangents, and a run of a gas with all elements, of which those not under test have
no effect.

Deliberate faults in the package, and the tests here that found each:

1. sign: `1 - eps` for `1 + eps` in the impulse of hard spheres: momentum, energy, 21 others.
2. index: the normal of a hard wall along the next axis: the element container.
3. missing term: the energy that drag takes from hard spheres: the element drag.
4. factor: <dr^2> times diameter in place of its square: displacement, units.
5. missing factor: Enskog's g_2 in the collision frequency: agreement with kinetic theory.
6. missing term: the derivative in the times: derivatives beside kinetic theory.
7. factor: half the derivative along the material: derivative and difference.
8. random numbers: replicas of DSMC begin with the velocities of the first: replicas and keys.
9. status: soft spheres that are nan are no failure: a start that is not finite.
10. checkpoint: a run resumes at its first time: an interrupted run.
11. frame: the drift of a start stays in the run, or out of the positions: the frame, boosted.
12. sign: second part of the energy that soft contacts dissipate: energy.
13. factor: the force of soft spheres with half the mass: energy.
14. factor: drag at half its rate in kinetic theory: the element drag.
15. random numbers: replicas of DSMC share those of their collisions: replicas and keys.
"""

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran import Rough, StokesDrag, Walls, WhiteNoise
from jaxgran.data.quantities import QUANTITIES
from jaxgran.scene.parameters import PARAMETER_UNITS
from tests.beads import assert_same, beads, glass_beads, lattice, total_energy
from tests.own_model import HaffLaw

N, REPLICAS = 64, 2
TAUS = np.array([0.0, 0.02, 0.5, 2.0])
SHORT = 2
"""Index of the last time before chaos: .5 mean free times."""

BEADS = glass_beads(0.3, packing_fraction=0.2)
ALL = ("surface", "container", "drag", "drive")
OF_SOFT_SPHERES = ("friction", "container", "drag")


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """A model, a gas for it, the float in which curves are differentiated, and its elements."""

    model: jaxgran.extend.AbstractModel
    elements: tuple[str, ...]
    gas: jaxgran.Gas = BEADS
    parameter: str = "dissipative_constant"
    elastic: float = 0.0

    @functools.cached_property
    def times(self):
        return TAUS * float(self.gas.mean_free_time)

    @property
    def save(self):
        return "particles" if self.model.saves else None

    def run(self, gas=None, times=None, start=None, **options):
        """The curve of a gas; spheres start from `start`, or at random if it is None."""
        model = options.pop("model", self.model)
        if start is not None:
            model = dataclasses.replace(model, start=start)
        gas, times = self.gas if gas is None else gas, self.times if times is None else times
        options = {"save": self.save, "progress": False} | options
        return jaxgran.cool(gas, times, model=model, **options)

    def scaled(self, log_scale, gas=None):
        """The gas with its parameter multiplied by exp(log_scale)."""
        gas = self.gas if gas is None else gas
        return gas.replace(**{self.parameter: gas.value(self.parameter) * jnp.exp(log_scale)})

    def curve_and_slope(self, gas=None, times=None, start=None, **options):
        """A curve and its derivative in the logarithm of the parameter."""
        start = self.start if start is None else start

        def of(log_scale):
            return self.run(self.scaled(log_scale, gas), times, start, **options)

        return jax.jvp(of, (0.0,), (1.0,))

    @functools.cached_property
    def base(self):
        return self.run()

    @functools.cached_property
    def start(self):
        """The particles at t = 0 of the base run, or None for a model without positions."""
        if not self.model.has_positions:
            return None
        return jax.tree.map(lambda x: x[0], self.base.saved)

    @functools.cached_property
    def start_between_walls(self):
        """Particles at T_0 some time after a lattice, by the program of gases with all elements."""
        if not self.model.has_positions:
            return None
        gas = given_elements(self)
        curve = self.run(gas, [6 * TIMES[-1]], lattice(gas, N, REPLICAS), save=None)
        heat = jnp.sqrt(gas.temperature / curve.replicas.temperature[:, -1:, None])
        velocity = heat * curve.particles.velocity
        return curve.particles._replace(velocity=velocity, angular_velocity=None)

    @functools.cached_property
    def reference(self):
        return self.curve_and_slope()


CONSTANT = dataclasses.replace(beads(0.2, 0.1), law=jaxgran.ConstantRestitution(0.9))
CASES = {
    "kinetic theory": Case(jaxgran.KineticTheory(), ALL),
    "own model": Case(HaffLaw(), (), CONSTANT, "coefficient", 1.0),
    "DSMC": Case(jaxgran.DSMC(N, replicas=REPLICAS), ALL),
    "hard spheres": Case(jaxgran.HardSpheres(N, replicas=REPLICAS), ALL),
    "soft spheres": Case(jaxgran.SoftSpheres(N, replicas=REPLICAS), OF_SOFT_SPHERES),
}
RATE = 0.3 / float(BEADS.mean_free_time)
TIMES = np.array([0.0, 0.5, 1.0]) * float(BEADS.mean_free_time)
"""Times and a rate of gases with elements."""

SIDE = BEADS.box_side(N)
NO_LIMIT = 1e9
"""A friction of rough spheres that never slide; with less the same program lets them."""

HOST = re.compile(r"callback|infeed|outfeed|host_transfer|\bsend\b|\brecv\b|send-done|recv-done")

METRE, SECOND, KILOGRAM = 37.0, 0.013, 8.1
SCALES = {"m": METRE, "s": SECOND, "kg": KILOGRAM, "Pa": KILOGRAM / METRE / SECOND**2}
SCALES |= {"J": KILOGRAM * METRE**2 / SECOND**2}
"""How many of other units make one of the SI."""


def in_other_units(value, unit):
    """A value in SI, whose unit is a product of powers as in m^2/s^2, in the other units."""
    return value * eval(unit.replace("^", "**"), {}, SCALES)


def known(curve, convert=lambda value, unit: value):
    """The quantities of a curve but for errors, which are differences of replicas."""
    return {
        name: convert(getattr(curve, name), quantity.unit)
        for name, quantity in QUANTITIES.items()
        if getattr(curve, name) is not None and not name.endswith("_error")
    }


def check_same(found, expected, slope_accuracy=1e-5, **convert):
    """Check that two curves with their derivatives agree in all known quantities.

    Rounding grows some hundredfold in a mean free time; it may also let soft spheres project their
    tangents a block earlier or later.
    """
    for one, other, tolerance in zip(found, expected, (1e-9, slope_accuracy), strict=True):
        one, other = known(one), known(other, **convert)
        assert one.keys() == other.keys()
        for name, values in other.items():
            size = np.nanmax(np.abs(values), initial=0.0)
            np.testing.assert_allclose(
                one[name], values, rtol=tolerance, atol=tolerance * size, err_msg=name
            )


def boosted(start, gas):
    drift = jnp.array([[[3.0, -2.0, 0.5]]]) * jnp.sqrt(gas.temperature)
    return start._replace(velocity=start.velocity + drift)


def translated(start, gas):
    shift = jnp.array([[[4.0, 1.0, -3.0]]]) * gas.diameter
    return start._replace(position=(start.position + shift) % start.box_side)


def permuted(start, gas):
    order = np.random.default_rng(0).permutation(N)
    return start._replace(position=start.position[:, order], velocity=start.velocity[:, order])


def rotated(start, gas):
    """A quarter turn about the z axis."""
    x, v = start.position, start.velocity
    position = jnp.stack([start.box_side - x[..., 1], x[..., 0], x[..., 2]], -1)
    velocity = jnp.stack([-v[..., 1], v[..., 0], v[..., 2]], -1)
    return start._replace(position=position, velocity=velocity)


def given_elements(case, **elements):
    """A gas with all elements of a model; those not given have no effect.

    All scenes of a model have the same structure, and thereby the same compiled program.
    """
    if case.model.elements == OF_SOFT_SPHERES:
        walls = Walls(SIDE, restitution=elastic_law(), tangential_damping=0.0, friction=0.0)
        idle = {"surface": jaxgran.Frictional(0.0, 0.0)}
        gas = BEADS
    else:
        walls = Walls(SIDE, restitution=1.0, tangential_restitution=-1.0)
        idle = {"surface": Rough(-1.0, friction=NO_LIMIT), "drive": WhiteNoise(0.0)}
        gas = BEADS.replace(dissipative_constant=0.0)
    idle |= {"container": walls, "drag": StokesDrag(0.0)}
    return dataclasses.replace(gas, **idle | elements)


def elastic_law(A=0.0):
    return jaxgran.Viscoelastic(5e7, 0.22, A)


def cooled_with(case, **elements):
    """A gas with elements, and its curve at 0, .5 and 1 mean free times."""
    gas = given_elements(case, **elements)
    curve = case.run(gas, TIMES, case.start_between_walls)
    assert int(curve.status) == 0
    if curve.dissipated_energy is not None and "drive" not in elements:
        total = total_energy(gas, curve)
        # The steps of friction and of walls add errors of their own.
        np.testing.assert_allclose(total, total[0], rtol=4 * ledger_accuracy(case))
    return gas, curve


def check_near_theory(case, found, **elements):
    """Check T/T_0 and T_rot/T_0 of 128 spheres within some three times their noise."""
    expected = energies(*cooled_with(CASES["kinetic theory"], **elements))
    np.testing.assert_allclose(found, expected, atol=0.12)


def ledger_accuracy(case):
    """Round-off, or the time steps of soft spheres."""
    return 5e-5 if isinstance(case.model, jaxgran.SoftSpheres) else 1e-12


def energies(gas, curve):
    """T/T_0 with the energy of contacts, and T_rot/T_0."""
    T = curve.temperature
    if curve.elastic_energy is not None:
        T = T + 2 / 3 * curve.elastic_energy / gas.mass
    return np.asarray(T / T[0]), np.asarray(curve.rotational_temperature / curve.temperature[0])


def check_surface(case):
    # Perfectly rough and elastic: what spins gain, velocities lose.
    perfectly = Rough(1.0, rotational_temperature=0.4 * BEADS.temperature, friction=NO_LIMIT)
    T, R = energies(*cooled_with(case, surface=perfectly))
    np.testing.assert_allclose(T + R, 1.4, rtol=1e-6)
    assert R[2] > R[1] > R[0]
    half = dataclasses.replace(perfectly, tangential_restitution=0.0)
    T, R = energies(*cooled_with(case, surface=half))
    assert np.all(np.diff(T + R) < -0.05)
    check_near_theory(case, (T, R), surface=half)


def check_friction(case):
    rough = jaxgran.Frictional(0.5, 0.5, rotational_temperature=0.01 * BEADS.temperature)
    smooth, rubbed = cooled_with(case), cooled_with(case, surface=rough)
    assert energies(*rubbed)[1][2] > 0.02
    assert rubbed[1].dissipated_energy[2] > 1.05 * smooth[1].dissipated_energy[2]


def check_container(case):
    soft = "friction" in case.model.elements
    law = elastic_law(1e-5) if soft else jaxgran.ConstantRestitution(0.8)
    idle = given_elements(case).container
    lossy = dataclasses.replace(idle, restitution=law)
    elastic, _ = energies(*cooled_with(case))
    damped = energies(*cooled_with(case, container=lossy))
    assert np.all((damped[0] - elastic)[1:] < -0.02)
    if not soft:  # impacts of spheres are elastic
        np.testing.assert_allclose(elastic, 1.0, rtol=1e-9)
        check_near_theory(case, damped, container=lossy)


def check_drag(case):
    drag = StokesDrag(RATE, rotational_rate=2 * RATE)
    if "friction" in case.model.elements:
        (T, _), (idle, _) = (energies(*cooled_with(case, **x)) for x in ({"drag": drag}, {}))
        np.testing.assert_allclose(T * np.exp(2 * RATE * TIMES), idle, rtol=0.1)
        return
    smooth = Rough(-1.0, rotational_temperature=0.4 * BEADS.temperature, friction=NO_LIMIT)
    gas, curve = cooled_with(case, drag=drag, surface=smooth)
    T, R = energies(gas, curve)
    np.testing.assert_allclose(T, np.exp(-2 * RATE * TIMES), rtol=1e-6)
    np.testing.assert_allclose(R, 0.4 * np.exp(-4 * RATE * TIMES), rtol=1e-6)
    if case.model.stochastic:
        with pytest.raises(ValueError, match="End before"):
            case.run(gas, [40 / RATE], save=None)


def check_drive(case):
    gas, curve = cooled_with(case, drive=WhiteNoise(10 * RATE * BEADS.temperature))
    gained = np.asarray(curve.temperature / gas.temperature) - 1
    # By 3 from kicks of N replicas 3 = 384 components: a standard error of .28.
    allowed = 0.9 if case.model.stochastic else 1e-6
    np.testing.assert_allclose(gained, 10 * RATE * curve.times, atol=allowed)
    if curve.dissipated_energy is not None:
        np.testing.assert_allclose(curve.dissipated_energy, 0.0, atol=1e-20)


ELEMENTS = {
    "surface": (check_surface, Rough(0.2, rotational_temperature=4e-3)),
    "friction": (check_friction, jaxgran.Frictional(0.5, 0.3, rotational_temperature=4e-3)),
    "container": (check_container, Walls(SIDE, restitution=0.8)),
    "drag": (check_drag, StokesDrag(RATE)),
    "drive": (check_drive, WhiteNoise(0.01 * RATE)),
}
"""A check of each element, and one that models without it refuse."""


SPHERES = "hard spheres", "soft spheres"
"""Cases whose programs take longest to compile."""


def of_models(which=lambda case: True, slow=()):
    """Parametrise a test over the models that `which` selects, of which some are slow.

    The scope keeps the tests of a model together, which share its compiled programs.
    """
    marks = {name: pytest.mark.slow for name in slow}
    rows = [
        pytest.param(case, id=name, marks=marks.get(name, ()))
        for name, case in CASES.items()
        if which(case)
    ]
    return pytest.mark.parametrize("case", rows, scope="module")


def is_stochastic(case):
    return case.model.stochastic


def has_positions(case):
    return case.model.has_positions


class TestContract:
    @of_models(slow=SPHERES)
    def test_the_start_is_that_of_the_gas(self, case):
        curve = case.base
        assert not curve.status
        assert float(curve.temperature[0]) == pytest.approx(float(case.gas.temperature), rel=1e-12)
        for name in ("collisions", "displacement", "dissipated_energy"):
            if (values := getattr(curve, name)) is not None:
                assert float(values[0]) == 0

    @of_models(slow=SPHERES)
    def test_energy_is_lost_and_accounted_for(self, case):
        curve, gas = case.base, case.gas
        inside = total_energy(gas, dataclasses.replace(curve, dissipated_energy=None))
        assert np.all(np.diff(inside) <= 1e-3 * inside[0]) and inside[-1] < 0.9 * inside[0]
        if curve.dissipated_energy is not None:
            total = total_energy(gas, curve)
            np.testing.assert_allclose(total, total[0], rtol=ledger_accuracy(case))
        if curve.saved is not None:
            T = jnp.mean(jaxgran.observables.temperature(curve.saved.velocity), axis=1)
            np.testing.assert_allclose(T, curve.temperature, rtol=1e-10)
            if case.model.has_positions:
                last = jax.tree.map(lambda x: x[-1], curve.saved)
                jax.tree.map(np.testing.assert_array_equal, last, curve.particles)

    @of_models(is_stochastic)
    def test_momentum_is_conserved(self, case):
        mean = np.mean(case.base.saved.velocity, axis=2)
        np.testing.assert_allclose(mean, 0.0, atol=1e-12 * float(case.gas.temperature) ** 0.5)

    @of_models()
    def test_elastic_gas_keeps_its_energy(self, case):
        gas = case.gas.replace(**{case.parameter: case.elastic})
        total = total_energy(gas, case.run(gas))
        np.testing.assert_allclose(total, total[0], rtol=ledger_accuracy(case))

    @of_models(lambda case: case.gas is BEADS)
    def test_displacement_is_that_of_the_particles(self, case):
        curve, gas = case.base, case.gas
        ballistic = 3 * gas.temperature * curve.times[1] ** 2
        # .02 collisions per particle lower it by as much.
        assert float(curve.displacement[1]) == pytest.approx(float(ballistic), rel=0.03)
        if case.model.has_positions:
            x, side = curve.saved.position, gas.box_side(N)
            moved = (x[SHORT] - x[0] + side / 2) % side - side / 2
            square = jnp.mean(jnp.sum(moved**2, axis=-1))
            assert float(curve.displacement[SHORT]) == pytest.approx(float(square), rel=1e-9)

    @of_models(is_stochastic)
    def test_agrees_with_kinetic_theory(self, case):
        curve, theory = case.base, CASES["kinetic theory"].base
        # Some 120 collisions of 128 spheres: 4 standard errors.
        assert float(curve.collisions[-1]) == pytest.approx(float(theory.collisions[-1]), rel=0.36)
        assert float(curve.temperature[-1]) == pytest.approx(
            float(theory.temperature[-1]), rel=4 * 0.8 / (N * REPLICAS) ** 0.5
        )

    @of_models(is_stochastic)
    def test_replicas_and_keys_are_independent(self, case):
        each = case.base.replicas.temperature
        velocity = np.asarray(case.base.saved.velocity)
        again, other = case.run(), case.run(key=jax.random.key(1))
        assert abs(np.corrcoef(*velocity[0].reshape(REPLICAS, -1))[0, 1]) < 0.3
        # Who has not collided yet: of 64 by chance .13, and .7 where pairs are the same.
        change = np.linalg.norm(velocity[SHORT] - velocity[0], axis=-1)
        free = change < 1e-9 * float(case.gas.temperature) ** 0.5
        assert abs(np.corrcoef(*free)[0, 1]) < 0.4
        assert each[0, -1] != each[1, -1]
        np.testing.assert_array_equal(again.replicas.temperature, each)
        assert not np.any(np.isin(other.replicas.temperature[:, -1], each[:, -1]))

    @of_models(slow=SPHERES)
    def test_units_do_not_matter(self, case):
        gas, start = case.gas, case.start
        names = PARAMETER_UNITS.keys() & gas.domains.keys()
        floats = {name: in_other_units(gas.value(name), PARAMETER_UNITS[name]) for name in names}
        gas, times = gas.replace(**floats), in_other_units(case.times, "s")
        if start is not None:
            start = start._replace(
                position=in_other_units(start.position, "m"),
                velocity=in_other_units(start.velocity, "m/s"),
                box_side=in_other_units(start.box_side, "m"),
            )
        found = case.curve_and_slope(gas, times, start)
        check_same(found, case.reference, convert=in_other_units)

    @pytest.mark.parametrize(
        "change", [boosted, translated, permuted, rotated], ids=lambda change: change.__name__
    )
    @of_models(has_positions, slow=SPHERES)
    def test_frame_and_names_do_not_matter(self, case, change):
        start = change(case.start, case.gas)
        found = case.curve_and_slope(start=start)
        check_same(found, case.reference)
        if change is boosted:
            velocity = found[0].saved.velocity
            momentum = np.mean(velocity, axis=2)
            speed = float(np.max(np.abs(momentum)))
            np.testing.assert_allclose(momentum, momentum[:1] + 0 * momentum, atol=1e-13 * speed)
            drift = start.velocity[:1, :1] - case.start.velocity[:1, :1]
            before, side = case.reference[0].saved, start.box_side
            np.testing.assert_allclose(velocity, before.velocity + drift[None], atol=1e-9 * speed)
            moved = found[0].saved.position - before.position
            moved = moved - drift[None] * found[0].times[:, None, None, None]
            np.testing.assert_allclose(moved, side * np.round(moved / side), atol=1e-9 * side)

    @of_models(slow=(*SPHERES, "DSMC"))
    def test_vmap_and_jit_are_a_loop(self, case):
        """In one program without calls to the host; a member out of range alone is nan."""
        model, times = case.model, case.times
        if case.model.has_positions:
            model = dataclasses.replace(model.sized_for(case.gas), start=case.start)

        def curve(x):
            gas = case.gas.replace(**{case.parameter: x})
            return case.run(gas, times, model=model, save=None)

        x = case.gas.value(case.parameter)
        values = jnp.stack([x, 0.5 * x, -x])
        program = jax.jit(jax.vmap(lambda x: jax.jvp(curve, (x,), (x,)))).lower(values)
        assert HOST.search(program.as_text()) is None
        along = program.compile()(values)
        for k in range(2):
            found = jax.tree.map(lambda leaf, k=k: leaf[k], along)
            factor = jnp.log(values[k] / x)
            expected = case.reference if k == 0 else case.curve_and_slope(case.scaled(factor))
            check_same(found, expected, slope_accuracy=1e-5)
        assert not np.any(along[0].status[:2])
        assert "range" in jaxgran.explain_status(int(along[0].status[2]))
        assert np.all(np.isnan(along[0].temperature[2]))

    @pytest.mark.minutes
    @of_models(has_positions)
    def test_a_batch_outside_of_jit_is_compiled_once(self, case, caplog):
        model = dataclasses.replace(case.model.sized_for(case.gas), start=case.start)
        batch = jax.vmap(lambda x: case.run(case.scaled(x), model=model, save=None).temperature)
        at_once = batch(jnp.zeros(2))
        with jax.log_compiles():
            np.testing.assert_array_equal(batch(jnp.zeros(2)), at_once)
        assert not caplog.records
        np.testing.assert_allclose(at_once[0], case.base.temperature, rtol=1e-9)

    def test_a_call_to_the_host_would_be_found(self):
        program = jax.jit(lambda x: jax.pure_callback(np.sin, x, x)).lower(1.0)
        assert HOST.search(program.as_text()) is not None

    @of_models(is_stochastic, slow=SPHERES)  # of kinetic theory: test_solver
    def test_reverse_is_forward(self, case):
        weights = jnp.arange(1.0, 5.0)

        def loss(log_scale):
            curve = case.run(case.scaled(log_scale), start=case.start)
            return jnp.sum(weights * curve.temperature)

        forward = jnp.sum(weights * case.reference[1].temperature)
        assert float(jax.grad(loss)(0.0)) == pytest.approx(float(forward), rel=1e-10)

    @of_models(lambda case: not case.model.stochastic)
    def test_derivative_is_a_difference(self, case):
        h = 1e-3
        less, more = (case.run(case.scaled(s * h)) for s in (-1, 1))
        slope = case.reference[1]
        for name in ("temperature", "displacement", "collisions"):
            if (a := getattr(more, name)) is not None:
                difference = (a - getattr(less, name)) / (2 * h)
                size = float(jnp.max(jnp.abs(difference)))
                np.testing.assert_allclose(getattr(slope, name), difference, atol=1e-5 * size)

    @of_models(is_stochastic, slow=SPHERES)
    def test_projected_derivative_is_a_difference(self, case):
        h, off = 1e-3, []
        for key in jax.random.split(jax.random.key(3), 5):
            start = None
            if case.model.has_positions:
                start = jax.tree.map(lambda x: x[0], case.run(key=key).saved)
            less, more = (case.run(case.scaled(s * h), start=start, key=key) for s in (-1, 1))
            _, slope = case.curve_and_slope(start=start, key=key)
            difference = (more.temperature - less.temperature)[: SHORT + 1] / (2 * h)
            error = jnp.max(jnp.abs(slope.temperature[: SHORT + 1] - difference))
            off.append(float(error / jnp.max(jnp.abs(difference))))
        # Projected derivatives keep the temperature of a gas alone, not each velocity: of 24 starts
        # of soft spheres half were off by less than .07, a fifth by more than .15.
        assert np.median(off) < 0.15, off
        # What projected derivatives do not know is nan.
        slope = case.reference[1]
        assert np.all(np.isnan(slope.sonine)) and np.all(np.isnan(slope.velocity_correlation))
        assert np.all(np.isnan(slope.displacement))
        if case.model.has_positions:
            assert np.all(np.isnan(slope.particles.velocity))

    @of_models(is_stochastic)
    def test_derivatives_agree_with_kinetic_theory(self, case):
        """Along the parameter, the density and the times at once: each gives a third or more."""

        def log_temperature(x, case=case):
            gas = case.gas.replace(packing_fraction=case.gas.packing_fraction * jnp.exp(x))
            curve = case.run(case.scaled(x, gas), jnp.asarray(case.times) * jnp.exp(x))
            return jnp.log(curve.temperature[-1])

        _, slope = jax.jvp(log_temperature, (0.0,), (1.0,))
        more, less = (log_temperature(x, CASES["kinetic theory"]) for x in (0.01, -0.01))
        # The rate of cooling is measured in some 120 collisions.
        assert float(slope) == pytest.approx(float(more - less) / 0.02, rel=0.25)

    @of_models(is_stochastic)
    def test_an_interrupted_run_resumes_bit_for_bit(self, case, tmp_path, monkeypatch):
        path, updates = tmp_path / "run.ckpt", []
        whole = case.run(start=case.start)
        saved = {"checkpoint": path, "start": case.start}

        def update(bar, amount):
            updates.append(amount)
            if len(updates) == 2:
                raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr("tqdm.tqdm.update", update)
            with pytest.raises(KeyboardInterrupt):
                case.run(**saved)
        resumed = case.run(**saved)
        assert_same(resumed, whole)
        other = {"DSMC": {"step": 0.04}, "hard spheres": {"contact_time": 1e-4}}
        setting = other.get(case.model.name, {"steps_per_contact": 50})
        for change in (
            {"model": dataclasses.replace(case.model, **setting)},
            {"gas": case.scaled(0.1)},
            {"times": 2 * case.times},
            {"key": jax.random.key(1)},
        ):
            with pytest.raises(ValueError, match="belongs to another run.* was .* and is"):
                case.run(**saved | change)

    @of_models(has_positions)
    def test_a_start_that_is_not_finite_is_a_failure(self, case):
        velocity = case.start.velocity.at[0, 3, 1].set(jnp.nan)
        start = case.start._replace(velocity=velocity)
        with pytest.raises(RuntimeError, match="not a finite number"):
            case.run(start=start)
        curve = case.run(start=start, throw=False)
        assert int(curve.status) != 0 and np.all(np.isnan(curve.temperature[1:]))

    @pytest.mark.slow
    def test_too_few_steps_are_a_failure(self):
        case = CASES["kinetic theory"]
        model = jaxgran.KineticTheory(max_steps=2)
        with pytest.raises(RuntimeError, match="largest number of steps"):
            case.run(model=model)
        curve = case.run(model=model, throw=False)
        assert int(curve.status) != 0 and np.all(np.isnan(curve.temperature))

    @pytest.mark.parametrize("element", ELEMENTS)
    @of_models(slow=SPHERES)
    def test_element_keeps_the_ledger_or_is_refused(self, case, element):
        assert (element in case.model.elements) == (element in case.elements)
        check, refused = ELEMENTS[element]
        if element in case.elements:
            check(case)
            return
        field = "surface" if element == "friction" else element
        gas = dataclasses.replace(case.gas, **{field: refused})
        supporting = [x.model for x in CASES.values() if element in x.model.elements]
        kinds = "|".join(type(model).__name__ for model in supporting)
        with pytest.raises(ValueError, match=f"does not support `{field}.*Use .*({kinds})"):
            case.run(gas)
