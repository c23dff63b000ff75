"""How much do soft contacts slow the cooling? Derive the coefficient c(beta), and fit it.

    python experiments/accuracy/derive_softness.py [--record] [--out DIR]

Solves the equation of motion of an impact in the variables of `jaxgran.scene.contact.impact`, with
its derivative in an outward acceleration, the centrifugal one of an oblique impact. Prints
c/(d - 1) at some beta, the coefficients of `jaxgran.theory.equations` and the largest relative
error of the fit, and draws both.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from experiments.support.record import script_parser, write_picture
from jaxgran.plotting import COLOURS, INK
from jaxgran.theory.equations import MEAN_OVERLAP, softness_coefficient

BETAS = np.geomspace(1e-3, 8.0, 40)


def impact(beta: float) -> tuple[float, float]:
    """Return 1 - eps^2, and its derivative in an outward acceleration in units of v^2/X."""

    def rates(s, z):
        y, w, _, dy, dw, _ = z
        stress = y * y + beta * w
        slower = -4 * y * dy * stress - 2 * y * y * (2 * y * dy + beta * dw) - 2 * y
        lost, more = 4 * beta * (y * w) ** 2, 8 * beta * y * w * (dy * w + y * dw)
        return [w, -2 * y * y * stress, lost, dw, slower, more]

    def apart(s, z):
        return z[0] - max(-beta * z[1], 0.0) ** 0.5

    apart.terminal, apart.direction = True, -1  # type: ignore[attr-defined]
    options: dict[str, Any] = {"rtol": 1e-12, "atol": 1e-14, "first_step": 1e-3, "max_step": 0.2}
    found = solve_ivp(rates, (0, 400), [0, 1, 0, 0, 0, 0], "DOP853", events=apart, **options)
    y, _, lost, dy, _, more = found.y_events[0][0]  # type: ignore[index]
    return lost + 0.8 * y**5, more + 4 * y**4 * dy


def main() -> None:
    options = script_parser(__doc__, "derive_softness", smoke=False).parse_args()
    nodes = np.concatenate([[1e-4], np.geomspace(1e-3, 12, 70)])
    loss, slope = np.array([impact(beta) for beta in nodes]).T
    loss, slope = (CubicSpline(np.sqrt(nodes), x / nodes) for x in (loss, slope))
    g, weights = np.polynomial.legendre.leggauss(200)
    g, weights = 4.5 * (g + 1), 4.5 * weights

    def exact(beta: float) -> float:
        b, gauss = beta * g**0.2, np.exp(-(g**2) / 2)
        lost = np.sum(weights * g**3 * gauss * loss(np.sqrt(b)) * b)
        return -float(np.sum(weights * g**1.8 * gauss * slope(np.sqrt(b)) * b) / lost)

    c = np.array([exact(beta) for beta in BETAS])

    def fit(p: np.ndarray, beta: np.ndarray) -> np.ndarray:
        return MEAN_OVERLAP * (1 + beta * (p[0] + p[1] * beta)) / (1 + beta * (p[2] + p[3] * beta))

    found = least_squares(lambda p: fit(p, BETAS) / c - 1, [0.5, 0.0, 1.0, 0.0]).x
    for beta in (1e-3, 0.1, 0.3, 0.5, 1.0, 3.0):
        print(f"c/(d - 1) at beta = {beta:g}: {exact(beta):.5f}")
    print("numerator", found[:2], "denominator", found[2:])
    print(f"largest error of this fit {np.max(np.abs(fit(found, BETAS) / c - 1)):.1e}")
    error = np.max(np.abs(np.asarray(softness_coefficient(jnp.asarray(BETAS), 2)) / c - 1))
    print(f"largest error of jaxgran.theory.equations.softness_coefficient {error:.1e}")
    write_picture(draw(c), "derive_softness", options)


def draw(c: np.ndarray) -> Figure:
    """Draw c/(d - 1) at BETAS by quadrature, and by the package's fit."""
    figure = Figure(figsize=(5.5, 3.6), layout="constrained")
    axes = figure.subplots()
    fine = np.geomspace(BETAS[0], BETAS[-1], 300)
    colour = COLOURS["kinetic theory"]
    axes.plot(
        fine, np.asarray(softness_coefficient(jnp.asarray(fine), 2)), color=colour, label="the fit"
    )
    axes.plot(BETAS, c, "o", color=INK, ms=3.5, label="average over simulated impacts")
    axes.axhline(MEAN_OVERLAP, color=COLOURS["guide"], ls="--", lw=1)
    axes.text(BETAS[-1], MEAN_OVERLAP + 0.02, r"$\beta\to 0$", color=COLOURS["guide"], ha="right")
    axes.set(xscale="log", xlabel=r"$\beta_T$", ylabel=r"$c/(d-1)$", ylim=(0, 1.1))
    axes.legend(frameon=False, loc="lower left")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    main()
