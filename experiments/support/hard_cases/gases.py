"""Hard cases of whole gases: limits of dissipation, density, size, temperature and units."""

import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.closed_forms import haff
from experiments.support.hard_cases.rows import (
    PRECISIONS,
    Case,
    Row,
    box,
    finite,
    precision,
    slope_of,
    spheres,
    theory,
    unit_gas,
    worst,
)
from experiments.support.scenes import beads
from jaxgran.particles.neighbours import search_pairs, with_offsets
from jaxgran.theory.equations import COOLING_RATE

DSMC, HARD, SOFT = jaxgran.DSMC, jaxgran.HardSpheres, jaxgran.SoftSpheres
MAXWELLIAN = jaxgran.KineticTheory(softness=False, order=2, correlations=False, sonine=False)


def _taus(gas, *taus):
    return np.asarray(taus) * float(gas.mean_free_time)


def _run(model, gas, times, free=None):
    """Return T/T_0 of a particle model at some times, and d ln T in a named float of the gas."""
    first = float(gas.temperature)
    if free is None:
        return np.asarray(jaxgran.cool(gas, times, model=model).temperature) / first, None
    value, slope = slope_of(
        lambda x: jaxgran.cool(gas.replace(**{free: x}), times, model=model), gas.value(free)
    )
    return value / first, slope / value


def elastic_limit() -> list[Row]:
    """Test A = 0, and A so small that ln T is linear in it."""
    rows, free = [], "dissipative_constant"
    for name in PRECISIONS:
        with precision(name):
            gas = beads(0.05, 0.1)
            times = jnp.asarray(_taus(gas, 0.1, 1.0, 10.0))
            tau = np.asarray(times) / float(gas.mean_free_time)
            per_delta = -5 / 3 * COOLING_RATE[3] * tau
            exact = per_delta * float(gas.delta) / float(gas.value(free))
            value, slope = theory(gas.replace(**{free: 0.0}), times, free)
            # The solver's rtol is 1e-9 or 1e-5; times in float32 have a round-off of up to 1e-6.
            allowed = 1e-12 if name == "float64" else 1e-6
            slope_ok = 1e-7 if name == "float64" else 1e-4
            errors = float(np.max(np.abs(value))), allowed, worst(slope, exact), slope_ok
            rows.append(Row("KineticTheory, A = 0", name, *errors))
            weak = gas.replace(**{free: 1e-7 * gas.value(free)})  # beta = 1e-8
            value, slope = theory(weak, times, free)
            error = float(np.max(np.abs(value - exact * float(weak.value(free)))))
            # |ln T| is at most 1e-7: its square is left out, and T has round-off.
            allowed = 1e-13 if name == "float64" else 1.2e-7
            errors = error, allowed, worst(slope, exact), slope_ok
            rows.append(Row("KineticTheory, beta = 1e-8", name, *errors))
    found = []
    for name in PRECISIONS:
        with precision(name):
            weak = beads(0.05, 1e-5)
            times = jnp.asarray(_taus(weak, 1e2, 1e3, 1e4))
            value, slope = theory(weak, times, free)
            found.append((np.asarray(value, float), np.asarray(slope, float)))
    # In float32, 1 - eps = 1e-5 would have an error of 1 %; -expm1(ln eps) has none.
    errors = worst(found[1][0], found[0][0]), 3e-4, worst(found[1][1], found[0][1]), 3e-4
    rows.append(Row("KineticTheory, beta = 1e-5", "float32", *errors))
    gas = beads(0.05, 0.1)
    times = _taus(gas, 1.0)
    still, slope = gas.replace(**{free: 0.0}), 0.0
    exact = -5 / 3 * COOLING_RATE[3] * float(gas.delta) / float(gas.value(free))
    # T stays constant up to round-off. The derivative is proportional to the number of impacts,
    # which scatters by 2 % (2000 impacts) and 14 % (50).
    for kind, size, noise in ((DSMC, 4000, 0.1), (HARD, 100, 0.5)):
        value, slope = _run(kind(size), still, times, free)
        errors = worst(value, 1.0), 1e-11, worst(slope, exact), noise
        rows.append(Row(kind.__name__, "float64", *errors))
    soft = beads(0.05, 0.1, 0.02).replace(**{free: 0.0})
    curve = jaxgran.cool(soft, [0.0, float(soft.mean_free_time)], model=SOFT(100))
    assert curve.elastic_energy is not None
    held = np.asarray(1.5 * soft.mass * curve.temperature + curve.elastic_energy)
    # The energy error of the time steps: 1e-4 in 100 mean free times.
    rows.append(Row("SoftSpheres, energy", "float64", worst(held[1], held[0]), 1e-4))
    return rows


def plastic_and_elastic() -> list[Row]:
    """Test constant restitution 0 and 1."""
    rows, free = [], "coefficient"
    for name in PRECISIONS:
        with precision(name):
            errors = []
            for e in (0.0, 1.0):
                gas = unit_gas(jaxgran.ConstantRestitution(e), 0.05)
                times = jnp.asarray(_taus(gas, 0.1, 10.0, 1000.0))
                tau = np.asarray(times / gas.mean_free_time, float)
                value, slope = theory(gas, times, free, MAXWELLIAN)
                along = 4 * e / 6 * tau / (1 + (1 - e * e) / 6 * tau)
                exact = np.log(np.asarray(haff(tau, e)))
                errors.append(
                    [np.max(np.abs(value - exact)), worst(np.asarray(slope) + 1, along + 1)]
                )
        value, slope = np.max(errors, axis=0)
        # Ten times the solver's rtol, 1e-9 and 1e-5.
        allowed = 1e-8 if name == "float64" else 2e-4
        rows.append(Row("KineticTheory, Haff", name, value, allowed, slope, 10 * allowed))
    for e in (0.0, 1.0):
        gas = unit_gas(jaxgran.ConstantRestitution(e), 0.05)
        times = _taus(gas, 5.0)
        expected = float(haff(5.0, e))
        # At e = 0 a_2 is near .1, which Haff's law neglects: an error of some per cent. The energy
        # loss of 100 spheres scatters by 10 %.
        for kind, size, noise in ((DSMC, 4000, 0.05), (HARD, 100, 0.4)):
            value, slope = _run(kind(size), gas, times, free)
            errors = worst(value, expected), noise if e == 0 else 1e-11, finite(slope), 0.0
            rows.append(Row(f"{kind.__name__}, e = {e:g}", "float64", *errors))
    return rows


def _deepest_overlap(particles) -> float:
    """Return the deepest overlap of two spheres of diameter 1; 0 if none overlap."""
    d = particles.position.shape[-1]
    position = particles.position.reshape(-1, d)
    side, n = particles.box_side, len(position)
    pairs = with_offsets(
        position, side, search_pairs(position, side, 1.02, 1, (20 * n, n), "scipy")
    )
    apart = position[pairs.i] - position[pairs.j] - pairs.offset
    distance = np.linalg.norm(np.asarray(apart), axis=-1)[: int(pairs.count)]
    return max(1 - float(np.min(distance, initial=1.0)), 0.0)


def collapse() -> list[Row]:
    """Test three spheres in a row and a dense cluster, which would collide infinitely often."""
    rows = []
    for name in PRECISIONS:
        with precision(name):
            gas = unit_gas(jaxgran.ConstantRestitution(0.05), 3 * np.pi / 6 / 10.0**3)
            x = [[2.0, 5, 5], [5.0, 5, 5], [8.5, 5, 5]]
            v = [[1.0, 0, 0], [0.0, 0, 0], [-1.0, 0, 0]]
            model = HARD(3, start=spheres(x, v, 10.0))
            curve = jaxgran.cool(gas, [8.0], model=model)
        assert curve.collisions is not None and float(curve.collisions[-1]) < 100
        # Round-off of positions in a box of ten diameters: 1e-15 and 1e-6.
        allowed = 1e-9 if name == "float64" else 1e-5
        overlap = _deepest_overlap(curve.particles)
        rows.append(Row("HardSpheres, three in a row", name, overlap, allowed))
    gas = unit_gas(jaxgran.ConstantRestitution(0.3), 0.5, 2)
    curve = jaxgran.cool(gas, _taus(gas, 20.0), model=HARD(100))
    assert curve.dissipated_energy is not None
    ledger = float(curve.temperature[-1] + curve.dissipated_energy[-1]) - 1
    overlap = _deepest_overlap(curve.particles)
    rows.append(Row("HardSpheres, 2D cluster", "float64", max(overlap, abs(ledger)), 1e-9))
    return rows


def thin_and_dense() -> list[Row]:
    """Test packing fractions from 1e-4 to .45 in 3D, to .6 in 2D."""
    rows, free = [], "coefficient"
    for d, packings in ((3, (1e-4, 0.45)), (2, (1e-4, 0.6))):
        for name in PRECISIONS:
            values = []
            with precision(name):
                for phi in (0.05, *packings):
                    gas = unit_gas(jaxgran.ConstantRestitution(0.8), phi, d)
                    times = jnp.asarray(_taus(gas, 0.1, 10.0, 1000.0))
                    values.append(theory(gas, times, free, MAXWELLIAN))
            value, slope = (np.asarray([v[k] for v in values]) for k in (0, 1))
            exact = np.log(np.asarray(haff(np.array([0.1, 10.0, 1000.0]), 0.8, d)))
            allowed = 1e-8 if name == "float64" else 2e-4
            errors = float(np.max(np.abs(value - exact))), allowed
            rows.append(
                Row(f"KineticTheory, {d}D", name, *errors, worst(slope[1:], slope[:1]), allowed)
            )
        for phi in packings:
            gas = unit_gas(jaxgran.ConstantRestitution(0.9), phi, d)
            curve = jaxgran.cool(gas, _taus(gas, 5.0), model=HARD(100))
            assert curve.collisions is not None and curve.dissipated_energy is not None
            ledger = abs(float(d / 2 * curve.temperature[0] + curve.dissipated_energy[0]) - d / 2)
            expected = haff(5.0, 0.9, d)
            # 250 impacts scatter by 6 %; in a dense inelastic gas there are more than Enskog's
            # frequency predicts.
            error = worst(curve.temperature[0], expected)
            rows.append(Row(f"HardSpheres, {d}D, phi = {phi:g}", "float64", error, 0.15))
            rows.append(Row(f"HardSpheres, {d}D, ledger", "float64", ledger, 1e-12))
    # At phi = 1e-4 contacts of .02 mean free times would be deeper than a sphere.
    for phi, contact in ((1e-4, 2e-4), (0.45, 0.02)):
        gas = beads(phi, 0.1, contact)
        curve = jaxgran.cool(gas, _taus(gas, 0.0, 2.0), model=SOFT(100))
        # Kinetic theory of hard spheres; 100 impacts scatter the loss, .16, by 10 %.
        expected = float(jnp.exp(theory(gas, jnp.asarray(_taus(gas, 2.0)), "diameter")[0][0]))
        error = worst(curve.temperature[1] / curve.temperature[0], expected)
        rows.append(Row(f"SoftSpheres, 3D, phi = {phi:g}", "float64", error, 0.1))
    return rows


def two_particles() -> list[Row]:
    """Test N = 2 in every particle model."""
    rows = []
    for name in PRECISIONS:
        with precision(name):
            gas = beads(0.02, 0.1, 0.05)
            times = _taus(gas, 0.0, 3.0)
            # Pairs of hard and soft spheres in float32 are run in the case of the smallest box.
            for kind in (DSMC, HARD, SOFT) if name == "float64" else (DSMC,):
                value, _ = _run(kind(2), gas, times)
                # Two particles gain no energy and keep some.
                wrong = np.max(value) - 1 if np.min(value) > 0 else np.nan
                rows.append(Row(kind.__name__, name, max(float(wrong), 0.0), 1e-5))
    return rows


def million_particles() -> list[Row]:
    """Test N = 1e6: DSMC for 5 mean free times; spheres for .2, from a perturbed lattice."""
    gas, rows, n = beads(0.05, 0.15, 0.02), [], 1_000_000
    times = _taus(gas, 5.0)
    value, _ = _run(DSMC(n), gas, times)
    expected = np.exp(theory(gas, jnp.asarray(times), "diameter")[0])
    rows.append(Row("DSMC", "float64", worst(value, expected), 2e-3))  # noise, higher Sonine orders
    side = box(gas, n)
    grid = (np.arange(100) + 0.5) * side / 100
    place = np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), -1).reshape(-1, 3)
    random = np.random.default_rng(0)
    place = np.mod(place + random.uniform(-0.1, 0.1, place.shape) * float(gas.diameter), side)
    velocity = random.normal(size=place.shape) * float(jnp.sqrt(gas.temperature))
    velocity -= velocity.mean(axis=0)
    start = spheres(place, velocity, side)
    first = float(np.mean(velocity**2))
    for kind in (HARD, SOFT):
        curve = jaxgran.cool(gas, _taus(gas, 0.2), model=kind(n, start=start))
        assert curve.dissipated_energy is not None
        kept = 1.5 * float(gas.mass) * float(curve.temperature[0]) + float(
            curve.dissipated_energy[0]
        )
        if curve.elastic_energy is not None:
            kept += float(curve.elastic_energy[0])
        # The energy balance of hard spheres closes up to round-off, that of soft spheres to 1e-3 of
        # the work done in contacts of 40 steps.
        kept /= 1.5 * float(gas.mass) * first
        rows.append(Row(kind.__name__, "float64", worst(kept, 1.0), 1e-4))
    return rows


def deep_cold() -> list[Row]:
    """Test T/T_0 down to 1e-12 (theory), 1e-6 (DSMC, hard spheres) and 1e-4 (soft spheres)."""
    rows, free, e = [], "coefficient", 0.5
    gamma = (1 - e * e) / 6
    for name in PRECISIONS:
        with precision(name):
            gas = unit_gas(jaxgran.ConstantRestitution(e), 0.05)
            times = jnp.asarray(_taus(gas, 1.0, 1e3, 1.01e6 / gamma))
            value, slope = theory(gas, times, free, MAXWELLIAN)
            tau = np.asarray(times / gas.mean_free_time, float)
            exact = np.log(np.asarray(haff(tau, e)))
            assert exact[-1] < np.log(1e-12)
            # Relative to ln T = -28, by a solver with an rtol of 1e-9 and 1e-5.
            allowed = 1e-7 if name == "float64" else 3e-3
            error = float(np.max(np.abs(value - exact)))
            along = worst(slope, 4 * e / 6 * tau / (1 + gamma * tau))
            rows.append(Row("KineticTheory, 1e-12", name, error, allowed, along, allowed))
            end = [float(gas.mean_free_time) * 2e3 / gamma]
            expected = float(haff(2e3 / gamma, e))
            # With a_2 = .048 the gas cools 1 % more slowly than Haff's law, and late T goes as the
            # inverse square of the rate. 4000 particles of DSMC and 50 spheres in one small box
            # also scatter.
            value, slope = _run(DSMC(4000), gas, end, free)
            assert slope is not None and value[0] < 1e-6
            # The derivative is a small difference of terms that are ten times larger: 2 % of T are
            # 20 % of it.
            errors = abs(float(np.log(value[0] / expected))), 0.1
            along = worst(slope[0], along_of(e, 2e3 / gamma))
            rows.append(Row(f"DSMC, {expected:.0e}", name, *errors, along, 0.3))
            value, _ = _run(HARD(50), gas, end)
            error = abs(float(np.log(value[0] / expected)))
            rows.append(Row(f"HardSpheres, {expected:.0e}", name, error, 1.5))
    gas = beads(0.05, 0.9, 0.05)
    tau = 3e3
    end = _taus(gas, 0.0, tau)
    curve = jaxgran.cool(gas, end, model=SOFT(50, steps_per_contact=20))
    theta = np.asarray(curve.temperature) / float(gas.temperature)
    assert curve.elastic_energy is not None and curve.dissipated_energy is not None
    held = curve.elastic_energy + curve.dissipated_energy
    held = held / (1.5 * gas.mass * gas.temperature)
    expected = float(jnp.exp(theory(gas, jnp.asarray(end), "diameter")[0][1]))
    ledger = abs(float(theta[1] + held[1] - theta[0] - held[0]))
    rows.append(Row("SoftSpheres, ledger", "float64", ledger, 5e-3))  # 20 steps per contact
    rows.append(
        Row(
            f"SoftSpheres, {theta[1]:.0e}",
            "float64",
            abs(float(np.log(theta[1] / expected))),
            0.7,  # T of 50 spheres depends by tens of per cent on their initial state
        )
    )
    return rows


def along_of(e, tau):
    """Return d ln T / d e by Haff's law in 3D."""
    return 4 * e / 6 * tau / (1 + (1 - e * e) / 6 * tau)


MATERIALS = {  # Y in Pa, nu, density in kg/m^3
    "steel": (2e11, 0.3, 7800.0),
    "glass": (7e10, 0.22, 2500.0),
    "ice": (9e9, 0.33, 917.0),
    "soft gel": (1e4, 0.49, 1000.0),
}


def si_units() -> list[Row]:
    """Test steel, glass, ice and gel, 10 um to 10 cm, um/s to 10 m/s, in reduced units."""
    rows, free = [], "dissipative_constant"
    scenes = [
        (material, diameter, speed)
        for material in MATERIALS
        for diameter, speed in ((1e-5, 1e-6), (1e-5, 10.0), (0.1, 1e-6), (0.1, 10.0))
    ]
    reference = beads(0.05, 0.15)
    taus = (0.1, 10.0, 1000.0)
    exact, along = theory(reference, jnp.asarray(_taus(reference, *taus)), free)
    along = along * float(reference.value(free))
    for name in PRECISIONS:
        values, slopes, runs = [], [], []
        with precision(name):
            for material, diameter, speed in scenes:
                gas = _of_material(material, diameter, speed)
                value, slope = theory(gas, jnp.asarray(_taus(gas, *taus)), free)
                values.append(value)
                slopes.append(slope * gas.value(free))
                runs.append(_run(DSMC(200), gas, _taus(gas, 3.0))[0][0])
            value = float(np.max(np.abs(np.asarray(values) - np.asarray(exact))))
            # float64: round-off of a dozen products and powers. float32: the solver's rtol of 1e-5.
            allowed = 1e-9 if name == "float64" else 5e-4
            rows.append(
                Row("KineticTheory", name, value, allowed, worst(slopes, along[None]), allowed)
            )
            # The same random numbers, and so the same collisions until round-off changes one.
            spread = worst(runs, runs[0])
            rows.append(Row("DSMC", name, spread, 1e-9 if name == "float64" else 1e-3))
            for kind in (HARD, SOFT):
                rows.append(Row(kind.__name__, name, *_same_in_units(kind, name)))
    return rows


def _of_material(material, diameter, speed, contact=None):
    """Return a gas of beta = .15; `contact` is t_c/tau_c, to which Y is adapted."""
    youngs, poisson, density = MATERIALS[material]
    gas = jaxgran.Gas(
        jaxgran.Viscoelastic(youngs, poisson, 1e-6),
        diameter=diameter,
        mass=jaxgran.sphere_mass(diameter, density),
        packing_fraction=0.05,
        temperature=speed**2,
    )
    if contact is not None:
        stiffer = (float(gas.contact_fraction) / contact) ** 2.5
        gas = gas.replace(youngs_modulus=stiffer * float(gas.value("youngs_modulus")))
    return gas.replace(dissipative_constant=1e-6 * 0.15 / float(gas.thermal_beta))


def _same_in_units(kind, name) -> tuple[float, float]:
    """Compare T after a mean free time of two gases with equal reduced units.

    Returns the relative difference and the largest one allowed.
    """
    ends = []
    for material, diameter, speed in (("soft gel", 1e-5, 1e-6), ("steel", 0.1, 10.0)):
        gas = _of_material(material, diameter, speed, 0.02)
        side, sigma = box(gas, 50), float(gas.diameter)
        random = np.random.default_rng(1)
        cell = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3)[:50]
        place = (cell + 0.5) * side / 4 + random.uniform(-0.1, 0.1, (50, 3)) * sigma
        velocity = random.normal(size=(50, 3)) * float(jnp.sqrt(gas.temperature))
        start = spheres(place, velocity, side)
        curve = jaxgran.cool(gas, _taus(gas, 1.0), model=kind(50, start=start))
        ends.append(float(curve.temperature[0] / gas.temperature))
    # Round-off of 1e-16 or 1e-7 grows by e^3 per impact, of which a sphere has one or two.
    return worst(ends[1], ends[0]), 1e-10 if name == "float64" else 1e-3


GASES = [
    Case(
        "A = 0 and A -> 0",
        "division by A; 1 - eps lost to cancellation",
        "exact at 0, with the derivative; weak dissipation is accurate, in float32 too",
        elastic_limit,
    ),
    Case(
        "constant eps = 0 and 1",
        "logarithms of 0, stuck pairs, drifting energy",
        "neither is special; a_2 of kinetic theory errs by some per cent at 0",
        plastic_and_elastic,
    ),
    Case(
        "inelastic collapse",
        "infinitely many impacts in a finite time: a hang",
        "impacts within 1e-5 mean free times of the last one are elastic, and counted",
        collapse,
    ),
    Case(
        "phi from 1e-4 to .45 (3D), .6 (2D)",
        "no initial state without overlaps; neighbour lists of all pairs or of none",
        "right; soft spheres are slow where flights are long; beyond .48 (3D), .65 (2D) a random "
        "initial state is refused",
        thin_and_dense,
    ),
    Case(
        "N = 2",
        "means over N - 1, pairs drawn with themselves",
        "right: no energy is gained, and some is kept",
        two_particles,
    ),
    Case(
        "N = 1e6",
        "32-bit counters, memory of N^2",
        "memory and time linear in N",
        million_particles,
        heavy=True,
    ),
    Case(
        "T/T_0 down to 1e-12, 1e-6, 1e-4",
        "fixed time steps and neighbour lists stop the run; T underflows",
        "ln T is integrated; time steps, neighbour lists and windows adapt to the temperature",
        deep_cold,
    ),
    Case(
        "SI values of steel, glass, ice, gel",
        "1e21 next to 1e-13: digits are lost, float32 overflows",
        "reduced units are used inside: the same curve up to round-off",
        si_units,
    ),
]
