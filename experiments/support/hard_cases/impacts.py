"""Hard cases of single impacts and of a few spheres."""

import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import jaxgran
from experiments.support.hard_cases.rows import (
    PRECISIONS,
    Case,
    Row,
    box,
    finite,
    flagged,
    precision,
    refusal,
    slope_of,
    spheres,
    unit_gas,
    worst,
)
from experiments.support.scenes import beads
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.run import MIN_BOX
from jaxgran.scene import contact
from jaxgran.scene.laws import C1, viscoelastic_restitution

HARD, SOFT = jaxgran.HardSpheres, jaxgran.SoftSpheres


def wide_range_of_beta() -> list[Row]:
    """Test an impact by its equation of motion and by the fitted law, over 11 decades of beta."""
    rows = []
    betas = np.array([1e-8, 1e-6, 1e-4, 1e-2, 0.3, 1.0, 10.0, 100.0, 1e3])
    for clipped, some in ((True, betas), (False, betas[:7])):
        solved = jax.jit(
            jax.vmap(
                lambda beta, clipped=clipped: jax.jvp(
                    lambda b: contact.impact(b, clipped=clipped).restitution, (beta,), (1.0,)
                )
            )
        )
        exact, slope = (np.asarray(x) for x in solved(jnp.asarray(some)))
        small = some <= 1e-4
        # The series' next term, 4/15 beta^(5/2), is 3e-11 at most.
        series = 1 - C1 * some[small] + 0.6 * C1**2 * some[small] ** 2
        words = "clipped" if clipped else "unclipped, to 10"
        rows.append(
            Row(
                f"equation of motion, {words}",
                "float64",
                worst(exact[small], series),
                5e-11,  # that, and the solver's 1e-11
                worst(slope[small], 1.2 * C1**2 * some[small] - C1),
                1e-6,  # (2/3) beta^(3/2) at 1e-4
            )
        )
        for name in PRECISIONS:
            with precision(name):
                law = partial(viscoelastic_restitution, clipped=clipped)
                at = jnp.asarray(some, jnp.result_type(float))
                value, along = jax.jvp(law, (at,), (jnp.ones_like(at),))
            # Fitted to 1e-9 (clipped) and 1e-7 (unclipped); derivatives have one or two digits
            # fewer. In float32 round-off gives a relative error of about 1e-7 |ln eps|.
            best = {("float64", True): (2e-9, 1e-6), ("float64", False): (1e-7, 1e-5)}
            value_ok, slope_ok = best.get((name, clipped), (5e-6, 1e-4))
            errors = worst(value, exact), value_ok, worst(along, slope), slope_ok
            rows.append(Row(f"fast law, {words}", name, *errors))
    return rows


def creeping_rebound() -> list[Row]:
    """Test the unclipped impact at beta = 1e3, whose rebound is very slow."""
    eps = float(contact.impact(1e3, clipped=False).restitution)
    # The asymptote's next term is of order beta^(-5/2).
    return [Row("equation of motion", "float64", worst(eps, 5.15838170427e-15), 1e-4)]


def _pair(gas, speed, offset=0.0, gap=1.0, origin=None):
    """Return two spheres that approach along x, with an impact parameter along y.

    Args:
        gas: the scene, with a box for two spheres.
        speed: relative speed.
        offset: impact parameter in diameters.
        gap: distance that the pair approaches before contact, in diameters.
        origin: centre of mass; by default the centre of the box.
    """
    side, sigma = box(gas, 2), float(gas.diameter)
    apart = sigma * np.sqrt(1 - offset**2) + gap * sigma
    middle = np.full(gas.dimension, side / 2) if origin is None else np.asarray(origin, float)
    half = np.zeros(gas.dimension)
    half[:2] = apart / 2, offset * sigma / 2
    velocity = np.zeros((2, gas.dimension))
    velocity[:, 0] = speed / 2, -speed / 2
    position = np.mod(np.stack([middle - half, middle + half]), side)
    return spheres(position, velocity, side)


def _pair_temperature(speed, dimension=3):
    return speed**2 / (4 * dimension)


def _hard_impact(gas, free, speed, offset=0.0, **place):
    """Return T after over T before one impact of hard spheres, and its projected derivative."""
    start = _pair(gas, speed, offset, **place)
    times = [2.0 * float(gas.diameter) / speed]  # before they meet the next images
    model = HARD(2, start=start)
    value, slope = slope_of(
        lambda x: jaxgran.cool(gas.replace(**{free: x}), times, model=model), gas.value(free)
    )
    return value[0] / _pair_temperature(speed), slope[0] / value[0]


def _soft_impact(gas, free, speed, offset=0.0, steps=40):
    """Return the ratio for soft spheres, with the plain derivative, exact for one impact."""
    duration = float(gas.contact_duration) * (speed / float(gas.impact_speed)) ** -0.2
    gap = 2.37 * speed * duration / steps / float(gas.diameter)
    start = _pair(gas, speed, offset, gap=gap)
    # An oblique impact lasts a little longer, as its normal speed is lower.
    times = [4 * duration]
    model = SOFT(2, start=start, projection=None, steps_per_contact=steps)
    value, slope = slope_of(
        lambda x: jaxgran.cool(gas.replace(**{free: x}), times, model=model), gas.value(free)
    )
    return value[0] / _pair_temperature(speed), slope[0] / value[0]


@cache
def _stiff_pair_gas(beta: float = 0.1):
    """Return spheres so stiff that they do not rotate about each other during a contact."""
    return beads(0.02, beta, 1e-6)


def _exact(gas, speed, free):
    """Return eps^2 of an impact, and the derivative of ln eps^2 in a float of the gas."""

    def log_square(x):
        return 2 * jnp.log(gas.replace(**{free: x}).restitution(speed))

    value, slope = jax.value_and_grad(log_square)(gas.value(free))
    return float(jnp.exp(value)), float(slope)


def speeds_over_eighteen_decades() -> list[Row]:
    """Test one impact from 1e-12 to 1e6 of the thermal speed."""
    rows, free = [], "dissipative_constant"
    factors = {"float64": np.geomspace(1e-12, 1e6, 4), "float32": np.array([1e-6, 1.0, 1e6])}
    for name in PRECISIONS:
        found, exact = [], []
        for factor in factors[name]:
            reference = beads(0.02, 0.1)
            speed = factor * float(reference.impact_speed)
            exact.append(_exact(reference, speed, free))
            with precision(name):
                found.append(_hard_impact(beads(0.02, 0.1), free, speed))
        value, slope = np.array(found).T
        value_exact, _ = np.array(exact).T
        allowed = 1e-8 if name == "float64" else 1e-5  # of the fitted law, and round-off
        # A projected derivative is that of a gas; for one pair only finiteness is required.
        rows.append(
            Row("HardSpheres", name, worst(value, value_exact), allowed, finite(slope), 0.0)
        )
    found = []
    gas = _stiff_pair_gas()
    speeds = np.geomspace(1e-8, 1e6, 3) * float(gas.impact_speed)
    for speed in speeds:
        value, slope = _soft_impact(gas, free, speed)
        exact = _exact(gas, speed, free)
        found.append([value / exact[0] - 1, slope / exact[1] - 1])
    value, slope = np.max(np.abs(found), axis=0)
    # At 40 steps eps scatters by 2e-4 to 5e-4 with the phase of the step at first touch; the
    # smallest eps^2 here is 0.06.
    rows.append(Row("SoftSpheres, from 1e-8 on", "float64", value, 6e-3, slope, 0.05))
    return rows


def onset_and_end() -> list[Row]:
    """Test the force and its derivative at first touch and at the end of contact."""
    rows = []
    for name in PRECISIONS:
        with precision(name):
            force = partial(contact.contact_force, elastic_constant=1.0, dissipative_constant=0.2)
            at = [(0.0, 1.0), (0.0, -1.0), (-1e-30, 1.0), (0.3, -1.0), (1e-30, 1.0)]
            xi, rate = jnp.asarray(at).T
            values = force(xi, rate)
            slopes = jax.vmap(jax.grad(force, argnums=(0, 1)))(xi, rate)
        # 0 at touch; 0 up to round-off at the end of contact, xi = 1.5 A |rate|; just inside
        # 0.3 sqrt(xi).
        exact = np.array([0.0, 0.0, 0.0, 0.0, 0.3 * 1e-15])
        error = float(np.max(np.abs(np.asarray(values) - exact)))
        finite = 0.0 if np.all(np.isfinite(slopes)) else np.nan
        rows.append(Row("contact force", name, error, 1e-7, finite, 0.0))
    errors = {}
    for steps in (20, 40, 80):
        errors[steps] = np.mean(_phases(steps), axis=0)
    orders = np.log2(np.abs(errors[20] / errors[80])) / 2
    bias, slope_bias = np.abs(errors[40])
    # The mean over phases is of second order: 1.2e-5 at 50 steps, 2e-5 at 40.
    rows.append(Row("SoftSpheres, eps at 40 steps", "float64", bias, 6e-5, slope_bias, 1e-2))
    # The finest mean, over 32 phases, has a standard error of 1e-5, a third of an order.
    rows.append(Row("SoftSpheres, order below 2", "float64", max(2 - orders[0], 0.0), 0.5))
    return rows


def _phases(steps: int, count: int = 32):
    """Return errors of eps and of its derivative in ln A over the phases of a time step."""
    gas = _stiff_pair_gas()
    sigma, speed = float(gas.diameter), 2 * float(jnp.sqrt(gas.temperature))
    side = box(gas, 2)
    golden = np.mod(np.arange(count) * 0.6180339887498949, 1.0)
    gap = speed * float(gas.contact_duration) / steps * (2 + 10 * golden)
    position = np.full((count, 2, 3), side / 2)
    position[:, 0, 0] -= (sigma + gap) / 2
    position[:, 1, 0] += (sigma + gap) / 2
    velocity = np.zeros_like(position)
    velocity[:, :, 0] = speed / 2, -speed / 2
    start = jaxgran.Particles(*map(jnp.asarray, (position, velocity, side)))
    settings = {"replicas": count, "start": start, "steps_per_contact": steps}
    model = SOFT(2, projection=None, **settings).sized_for(gas)
    assert model.plan is not None
    # In a gas few pairs are in contact at a time; here all are.
    plan = model.plan._replace(capacity=Capacity(*[4 * count] * 5))
    model = dataclasses.replace(model, plan=plan)
    times = [6 * float(gas.contact_duration)]
    a = gas.value("dissipative_constant")

    def eps(log_a):
        curve = jaxgran.cool(
            gas.replace(dissipative_constant=a * jnp.exp(log_a)), times, model=model
        )
        assert curve.replicas is not None
        ratio = jnp.sqrt(curve.replicas.temperature[:, 0] / _pair_temperature(speed))
        return ratio, jax.lax.stop_gradient(ratio)

    _, slope, value = jax.jvp(eps, (0.0,), (1.0,), has_aux=True)
    exact, exact_slope = _exact(gas, speed, "dissipative_constant")
    eps_exact = np.sqrt(exact)
    slope_exact = 0.5 * exact_slope * float(a) * eps_exact
    return np.stack([np.asarray(value) - eps_exact, np.asarray(slope) - slope_exact], axis=1)


def angles() -> list[Row]:
    """Test head-on, oblique and grazing impacts."""
    rows, e = [], 0.7
    offsets = {"float64": (0.0, 0.6, 0.999, 1 - 1e-9), "float32": (0.0, 0.6, 0.999)}
    for name in PRECISIONS:
        errors = []
        with precision(name):
            gas = unit_gas(jaxgran.ConstantRestitution(e), 2 * np.pi / 6 / 10.0**3)
            for b in offsets[name]:
                value, slope = _hard_impact(gas, "coefficient", 2.0, b)
                normal = 1 - b * b
                left = 1 - (1 - e * e) * normal
                errors.append([value / left - 1, slope])
        value = np.max(np.abs(errors), axis=0)[0]
        # In float32 the position of an impact has an error of 1e-6 in a box of ten diameters.
        allowed = 1e-12 if name == "float64" else 1e-5
        rows.append(Row("HardSpheres", name, value, allowed, finite(errors), 0.0))
    gas, errors = _stiff_pair_gas(), []
    speed, a = float(gas.impact_speed), float(gas.value("dissipative_constant"))
    for b in (0.0, 0.6, 0.99):
        value, slope = _soft_impact(gas, "dissipative_constant", speed, b)
        normal = 1 - b * b
        square, log_slope = _exact(gas, speed * np.sqrt(normal), "dissipative_constant")
        left = 1 - (1 - square) * normal
        errors.append([value / left - 1, a * (slope - log_slope * square * normal / left)])
    value, slope = np.max(np.abs(errors), axis=0)
    # At 40 steps eps scatters by 2e-4 with the phase of the step at first touch.
    rows.append(Row("SoftSpheres", "float64", value, 1e-3, slope, 2e-2))
    return rows


def touching_coincident_corner() -> list[Row]:
    """Test a pair that touches, coincides, or collides across a corner of the box."""
    rows, e = [], 0.7
    for name in PRECISIONS:
        with precision(name):
            gas = unit_gas(jaxgran.ConstantRestitution(e), 2 * np.pi / 6 / 10.0**3)
            # 8 and 7 are exact in both precisions: the distance is exactly 1.
            x = [[7.0, 5.0, 5.0], [8.0, 5.0, 5.0]]
            toward, away = ([[s, 0.0, 0.0], [-s, 0.0, 0.0]] for s in (1.0, -1.0))
            ratios = [
                jaxgran.cool(gas, [0.5], model=HARD(2, start=spheres(x, v, 10.0)))
                for v in (toward, away)
            ]
            touch = [float(curve.temperature[0]) / _pair_temperature(2.0) for curve in ratios]
            error = worst(touch, [e * e, 1.0])
            corner = _hard_impact(gas, "coefficient", 2.0, 0.6, origin=(0.0, 0.0, 0.0))
        left = 1 - (1 - e * e) * 0.64
        allowed = 1e-12 if name == "float64" else 1e-5  # round-off in a box of ten
        rows.append(Row("HardSpheres, touching", name, error, allowed))
        slope = finite(corner[1])
        rows.append(Row("HardSpheres, corner", name, worst(corner[0], left), allowed, slope, 0.0))
        rows.append(refusal("HardSpheres, coincident", name, _coincident_hard, "must not overlap"))
        rows.append(
            refusal("SoftSpheres, coincident", name, _coincident_soft, "coincident spheres")
        )
    rows.append(_coincident_in_jit())
    gas = _stiff_pair_gas()
    speed, side = float(gas.impact_speed), box(gas, 2)
    gap = 2.37 * speed * float(gas.contact_duration) / 40 / float(gas.diameter)
    ends = [
        jaxgran.cool(
            gas,
            [4 * float(gas.contact_duration)],
            model=SOFT(2, start=_pair(gas, speed, 0.6, gap=gap, origin=(o, o, o))),
        ).temperature[0]
        for o in (side / 2, 0.0)
    ]
    # The phase of the step at first touch is the same up to the round-off of positions, about
    # 1e-16 over 1e-6.
    rows.append(Row("SoftSpheres, corner", "float64", worst(ends[1], ends[0]), 1e-8))
    return rows


def _coincident_in_jit() -> Row:
    """Test a batch with one coincident start, for which compiled code cannot raise."""
    gas = unit_gas(jaxgran.ConstantRestitution(0.7), 2 * np.pi / 6 / 10.0**3)
    sized = HARD(2).sized_for(gas)

    def run(x):
        place = jnp.array([[[5.0, 5.0, 5.0], [5.0, 5.0, 5.0]]]).at[0, 1, 0].add(x)
        velocity = jnp.array([[[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]])
        start = jaxgran.Particles(place, velocity, jnp.asarray(10.0))
        curve = jaxgran.cool(gas, [0.1], model=dataclasses.replace(sized, start=start))
        return curve.temperature, curve.status

    values, codes = jax.jit(jax.vmap(run))(jnp.array([0.0, 1.5]))
    return flagged("HardSpheres, coincident in vmap", "float64", values, codes, 0, "overlap")


def _coincident_hard():
    gas = unit_gas(jaxgran.ConstantRestitution(0.7), 2 * np.pi / 6 / 10.0**3)
    start = spheres(np.full((2, 3), 5.0), [[1.0, 0, 0], [-1.0, 0, 0]], 10.0)
    jaxgran.cool(gas, [0.1], model=HARD(2, start=start))


def _coincident_soft():
    gas = beads(0.02, 0.1, 0.05)
    side = box(gas, 2)
    start = spheres(np.full((2, 3), side / 2), np.zeros((2, 3)), side)
    jaxgran.cool(gas, [1e-6], model=SOFT(2, start=start))


def smallest_box() -> list[Row]:
    """Test two spheres that collide with each other and their images in the smallest box."""
    rows = []
    phi = float(2 * np.pi / 6 / (MIN_BOX * (1 + 1e-6)) ** 3)
    for name in PRECISIONS:
        with precision(name):
            gas = unit_gas(jaxgran.ConstantRestitution(1.0), phi)
            side = box(gas, 2)
            x = np.array([[0.1, 0.2, 0.3], [1.2, 1.1, 1.3]])
            v = np.array([[1.0, 0.7, -0.4], [-1.0, -0.7, 0.4]])
            # An elastic pair exchanges its normal velocities, which leaves T unchanged.
            model = HARD(2, start=spheres(x, v, side))
            hard = jaxgran.cool(gas, [1.0, 20.0], model=model)
            assert hard.collisions is not None and float(hard.collisions[-1]) > 5
            error = worst(hard.temperature, np.sum(v**2) / 6)
        rows.append(Row("HardSpheres", name, error, 1e-13 if name == "float64" else 1e-5))
        with precision(name):
            gas = beads(phi, 0.2, 0.05)
            curve = jaxgran.cool(gas, [0.0, 5 * float(gas.mean_free_time)], model=SOFT(2))
            assert curve.elastic_energy is not None and curve.dissipated_energy is not None
            held = 1.5 * gas.mass * curve.temperature + curve.elastic_energy
            held = np.asarray((held + curve.dissipated_energy) / (1.5 * gas.mass))
        # The energy balance of a run of 80 collisions at 40 steps closes to 1e-3.
        rows.append(Row("SoftSpheres, ledger", name, worst(held[1], held[0]), 2e-3))
    return rows


def three_and_four_at_once() -> list[Row]:
    """Test three and four spheres in contact, compared with a general ODE solver."""
    gas = beads(0.02, 0.2, 0.05)
    rows = []
    for count in (3, 4):
        side, sigma = box(gas, count), float(gas.diameter)
        corner = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])[:count]
        corner *= sigma / np.sqrt(8)
        # Just apart, and approaching the centre at different speeds: all pairs come into contact.
        speed = float(gas.impact_speed)
        velocity = -corner / sigma * np.array([1.0, 1.3, 0.8, 1.1])[:count, None] * speed
        place = 1.0001 * corner + side / 2
        end = 3 * float(gas.contact_duration)
        exact = _contacts(gas, place, velocity, end)
        errors = []
        for steps in (40, 160):
            model = SOFT(count, steps_per_contact=steps, start=spheres(place, velocity, side))
            last = jaxgran.cool(gas, [end], model=model).particles
            assert last is not None
            errors.append(float(np.max(np.abs(np.asarray(last.velocity[0]) - exact)) / speed))
        # Six first touches at 40 steps, each with an error of some 3e-4 of a velocity, which is at
        # least of first order in the step.
        rows.append(Row(f"SoftSpheres, {count} bodies, 40 steps", "float64", errors[0], 3e-3))
        rows.append(Row(f"SoftSpheres, {count} bodies, 160 steps", "float64", errors[1], 4e-4))
    return rows


def _contacts(gas, position, velocity, end):
    """Return velocities of spheres without a box after a time, by SciPy."""
    law, m, sigma = gas.law, float(gas.mass), float(gas.diameter)
    rho = float(contact.elastic_constant(law.youngs_modulus, law.poisson_ratio, sigma))
    a = float(law.dissipative_constant)
    shape = position.shape

    def rates(_, state):
        x, v = state.reshape(2, *shape)
        r, w = x[:, None] - x[None], v[:, None] - v[None]
        distance = np.sqrt(np.sum(r * r, -1)) + np.eye(len(x))
        normal = r / distance[..., None]
        xi = np.maximum(sigma - distance, 0.0) * (1 - np.eye(len(x)))
        force = rho * np.sqrt(xi) * np.maximum(xi - 1.5 * a * np.sum(w * normal, -1), 0.0)
        return np.concatenate([v, np.sum(force[..., None] * normal, 1) / m]).ravel()

    first = np.concatenate([position, velocity]).ravel()
    options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-15, "max_step": end / 3000}
    return solve_ivp(rates, (0, end), first, **options).y[:, -1].reshape(2, *shape)[1]


def order_that_flips() -> list[Row]:
    """Test three spheres in a row whose impacts are simultaneous up to round-off."""
    rows, e = [], 0.6
    for name in PRECISIONS:
        shifts = (1e-13, -1e-13, 0.0) if name == "float64" else (3e-6, -3e-6, 0.0)
        errors = []
        with precision(name):
            gas = unit_gas(jaxgran.ConstantRestitution(e), 3 * np.pi / 6 / 10.0**3)
            for shift in shifts:
                x = [[3.0, 5, 5], [5.0, 5, 5], [7.0 + shift, 5, 5]]
                v = [[1.0, 0, 0], [0.0, 0, 0], [-1.0, 0, 0]]
                model = HARD(3, contact_time=0.0, start=spheres(x, v, 10.0))
                value, slope = slope_of(
                    lambda y, model=model, gas=gas: jaxgran.cool(
                        gas.replace(coefficient=y), [2.0], model=model
                    ),
                    e,
                )
                errors.append([value[0], slope[0]])
        exact = [_row_of_three(e), (_row_of_three(e + 1e-6) - _row_of_three(e - 1e-6)) / 2e-6]
        errors = np.array(errors)
        allowed = 1e-11 if name == "float64" else 1e-4  # round-off of positions in a box of ten
        # A projected derivative is exact for one impact and an estimate for several: it must be
        # finite, and the same in either order.
        rows.append(
            Row(
                "HardSpheres",
                name,
                worst(errors[:, 0], exact[0]),
                allowed,
                worst(errors[:, 1], errors[0, 1]),
                allowed,
            )
        )
    return rows


def _row_of_three(e):
    """Return T after all impacts of a row of three, resolved one after another."""
    v = np.array([1.0, 0.0, -1.0])
    pair = 0
    while v[0] > v[1] or v[1] > v[2]:
        if v[pair] > v[pair + 1]:
            kick = 0.5 * (1 + e) * (v[pair] - v[pair + 1])
            v[pair], v[pair + 1] = v[pair] - kick, v[pair + 1] + kick
        pair = 1 - pair
    return np.sum(v**2) / 9


IMPACTS = [
    Case(
        "beta from 1e-8 to 1e3 in one impact",
        "truncated series leave [0, 1]; the singularity of sqrt(xi) lowers the order of the solver",
        "regular variables; the end of contact is located; gases use a fit to such impacts",
        wide_range_of_beta,
    ),
    Case(
        "unclipped impact at beta = 1e3",
        "the rebound is slow, and is cut off",
        "right, but takes some seconds: use the fitted law there",
        creeping_rebound,
        heavy=True,
    ),
    Case(
        "impact speeds from 1e-12 to 1e6 of thermal",
        "absolute tolerances, a fixed step",
        "relative throughout; overlaps of soft spheres must exceed the round-off of positions",
        speeds_over_eighteen_decades,
    ),
    Case(
        "sqrt(xi) onset and the end of contact",
        "nan derivatives, order 1 or 3/2 in the mean",
        "guarded roots; mean error of second order, its scatter of order 3/2",
        onset_and_end,
    ),
    Case(
        "head-on, oblique, grazing",
        "cancellation in the impact time of grazing pairs",
        "a formula without cancellation; impacts shallower than round-off are left out",
        angles,
    ),
    Case(
        "touching, coincident, across a corner",
        "0/0 normals, missed contacts, pairs lost at the boundary",
        "right, or refused by an error that names the reason",
        touching_coincident_corner,
    ),
    Case(
        "own image in the smallest box",
        "a sphere touches a partner and its image, one of them is lost",
        "boxes of 2.1 diameters or more are right, and conserve energy",
        smallest_box,
    ),
    Case(
        "three and four bodies in contact",
        "event-driven codes resolve pairs only",
        "soft spheres resolve it; models of instantaneous impacts leave it out",
        three_and_four_at_once,
    ),
    Case(
        "near-simultaneous impacts whose order flips",
        "the result depends on the machine",
        "both orders are right; of simultaneous impacts that of the first listed pair is first",
        order_that_flips,
    ),
]
