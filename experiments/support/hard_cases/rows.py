"""Common parts of the hard cases: rows of the table, precisions, values with derivatives."""

import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxgran

PRECISIONS = ("float64", "float32")

HARD_THEORY = jaxgran.KineticTheory(softness=False, order=2, correlations=False)


class Row(NamedTuple):
    """The result of one model in one case, in one precision.

    Attributes:
        model: name of the model, and the part of the case if there are several.
        precision: float64 or float32.
        error: error of the value, relative unless the case defines it otherwise.
        allowed: the largest error; the case gives the reason.
        slope_error, slope_allowed: these two for a derivative; None if there is none.
        status: "ok", or the error or status that the case expects.
    """

    model: str
    precision: str
    error: float
    allowed: float
    slope_error: float | None = None
    slope_allowed: float | None = None
    status: str = "ok"

    @property
    def passed(self) -> bool:
        """Return whether all errors are allowed; nan is never allowed."""
        slope = self.slope_error is None or self.slope_error <= (self.slope_allowed or 0.0)
        return bool(self.error <= self.allowed and slope)


class Case(NamedTuple):
    """One hard case.

    Attributes:
        name: name of the case.
        elsewhere: failures of other simulations.
        here: behaviour of jaxgran, and its limits.
        run: function that computes the rows.
        heavy: whether it takes a minute or more.
    """

    name: str
    elsewhere: str
    here: str
    run: Callable[[], list[Row]]
    heavy: bool = False


@contextmanager
def precision(name: str) -> Iterator[None]:
    """Return a context in which new numbers have this precision."""
    with jax.enable_x64(name == "float64"):
        yield


def worst(found, exact) -> float:
    """Return the largest relative difference; nan if any number is not finite."""
    found, exact = np.asarray(found, np.float64), np.asarray(exact, np.float64)
    size = np.where(exact == 0, 1.0, np.abs(exact))
    return float(np.max(np.abs(found - exact) / size))


def finite(*values) -> float:
    """Return 0 if all numbers are finite, otherwise nan: for estimated derivatives."""
    return 0.0 if all(np.all(np.isfinite(value)) for value in values) else np.nan


def refusal(model: str, name: str, call: Callable, asked: str) -> Row:
    """Return a row that passes if the error message of the call matches the regex `asked`."""
    try:
        with precision(name), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            call()
    except (ValueError, RuntimeError, OSError) as error:
        words = re.sub(r"/\S*/", "", " ".join(str(error).split()))  # folders differ from run to run
        found = re.search(asked, words)
        return Row(model, name, 0.0 if found else np.inf, 0.0, status=f"error: {words}")
    return Row(model, name, np.inf, 0.0, status="no error")


def flagged(model: str, name: str, values, codes, bad: int, asked: str) -> Row:
    """Return a row of a batch: member `bad` must be nan with a status, the others finite."""
    values, codes = np.asarray(values), np.asarray(codes)
    words = jaxgran.explain_status(int(codes[bad]))
    others = np.delete(np.arange(len(codes)), bad)
    right = np.all(np.isnan(values[bad])) and re.search(asked, words)
    right = right and np.all(codes[others] == 0) and np.all(np.isfinite(values[others]))
    return Row(model, name, 0.0 if right else np.inf, 0.0, status=f"member {bad}: {words}")


@eqx.filter_jit
def theory(gas: jaxgran.Gas, times, free: str, model=HARD_THEORY) -> tuple:
    """Return ln(T/T_0) by kinetic theory, and its derivative in a float of the gas."""

    def log_ratio(value):
        changed = gas.replace(**{free: value})
        return jnp.log(jaxgran.cool(changed, times, model=model).temperature / gas.temperature)

    return jax.jvp(log_ratio, (gas.value(free),), (jnp.ones_like(gas.value(free)),))


def slope_of(run: Callable, at) -> tuple:
    """Return T of a particle model as a function of one number, and its derivative."""
    at = jnp.asarray(at, jnp.result_type(float))

    def temperature(x):
        curve = run(x)
        return curve.temperature, jax.lax.stop_gradient(curve.temperature)

    _, slope, value = jax.jvp(temperature, (at,), (jnp.ones_like(at),), has_aux=True)
    return np.asarray(value), np.asarray(slope)


def unit_gas(law, packing_fraction: float, dimension: int = 3) -> jaxgran.Gas:
    """Return a gas of diameter, mass and temperature 1."""
    return jaxgran.Gas(
        law,
        diameter=1.0,
        mass=1.0,
        packing_fraction=packing_fraction,
        temperature=1.0,
        dimension=dimension,
    )


def spheres(position, velocity, side) -> jaxgran.Particles:
    """Return given particles as a start with one replica."""
    arrays = (np.asarray(x, float)[None] for x in (position, velocity))
    place, speed = map(jnp.asarray, arrays)
    return jaxgran.Particles(place, speed, jnp.asarray(float(side)))


def box(gas: jaxgran.Gas, num_particles: int) -> float:
    """Return the side of the box, m."""
    return float(gas.box_side(num_particles))
