"""Where do the coefficients of the fitted eps(beta) and c(beta) come from, how accurate are they?

    python experiments/accuracy/derive_coefficients.py [--only derive_restitution derive_softness]
        [--record] [--out DIR]

derive_restitution: solves the equation of motion of an impact for some 200 values of beta and fits
``ln eps + decay ln(1 + kappa beta)`` by ``beta P(z) / Q(z)``, z = sqrt(beta). The fit minimises the
largest error (Lawson's reweighting of a linearised least-squares fit). Prints the coefficients that
``jaxgran/scene/restitution_table.py`` contains, and draws eps and the error of the package's law.

derive_softness: soft contacts slow the cooling by c(beta) contact durations over mean free times.
Solves the equation of motion of an impact in the variables of `jaxgran.scene.contact.impact`, with
its derivative in an outward acceleration, the centrifugal one of an oblique impact. Prints
c/(d - 1) at some beta, the coefficients of `jaxgran.theory.density` and the largest relative
error of the fit, and draws both.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from experiments.support.plots import GUIDE, INK, THEORY, VISCOELASTIC, caption, panels
from experiments.support.record import Options, run_parts
from jaxgran.scene.contact import impact
from jaxgran.scene.laws import C1, viscoelastic_restitution
from jaxgran.theory.density import MEAN_OVERLAP, softness_coefficient

ROUNDS = 300
BETAS = np.geomspace(1e-3, 8.0, 40)


def samples(clipped: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return values of beta, and eps of an impact at each."""
    top = 3e4 if clipped else 40.0
    s = (1 - np.cos((np.arange(160) + 0.5) * np.pi / 160)) / 2
    beta = np.concatenate([s / (1 - s), np.geomspace(1, top, 50)])
    beta = np.sort(beta[beta <= top])
    solve = jax.jit(lambda b: impact(b, clipped=clipped, rtol=1e-13).restitution)
    return beta, np.array([float(solve(b)) for b in beta])


def fit_rational(
    beta: np.ndarray, target: np.ndarray, slope: float, powers_p: list[int], powers_q: list[int]
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the largest error, and the coefficients of P and Q without the constant ones."""
    z = np.sqrt(beta)[:, None]
    basis_p, basis_q = z ** np.array(powers_p), z ** np.array(powers_q)
    denominator, lawson = np.ones_like(beta), np.ones_like(beta)
    best = (np.inf, np.array([]), np.array([]))
    for _ in range(ROUNDS):
        weight = (lawson / denominator)[:, None]
        matrix = weight * np.hstack([beta[:, None] * basis_p, -target[:, None] * basis_q])
        scale = np.abs(matrix).max(axis=0)
        right = (target - beta * slope) * weight[:, 0]
        x = np.linalg.lstsq(matrix / scale, right, rcond=1e-15)[0] / scale
        p, q = x[: len(powers_p)], x[len(powers_p) :]
        denominator = 1 + basis_q @ q
        error = np.abs(beta * (slope + basis_p @ p) / denominator - target)
        if denominator.min() > 0 and error.max() < best[0]:
            best = (error.max(), p, q)
        lawson = lawson * (0.1 + error / error.max()) ** 0.3
        lawson /= lawson.mean()
    return best


def derive_restitution(_: Options) -> dict:
    # beta P and Q have the same degree, so that their ratio tends to a constant.
    shapes = {
        "clipped": (True, 0.7, 5 / 3, [2, *range(3, 9)], [2, *range(4, 11)]),
        "unclipped": (False, 0.7, 5.0, list(range(2, 21, 2)), list(range(2, 23, 2))),
    }
    (figure, (left, right)), largest = panels(2, size=(3.75, 3.2)), {}
    for (name, (clipped, kappa, decay, *powers)), style in zip(shapes.items(), "-:", strict=True):
        beta, restitution = samples(clipped)
        target = np.log(restitution) + decay * np.log1p(kappa * beta)
        error, *values = fit_rational(beta, target, decay * kappa - C1, *powers)
        largest[name] = {"error": float(error), "beta_to": float(beta[-1])}
        for letter, each, found in zip("PQ", powers, values, strict=True):
            print(f"{name}, {letter}:", dict(zip(each, found.tolist(), strict=True)))
        law = np.asarray(viscoelastic_restitution(beta, clipped=clipped))
        left.plot(beta, restitution, style, color=VISCOELASTIC, label=name)
        right.plot(beta, np.abs(law / restitution - 1), style, color=VISCOELASTIC, lw=1)
    labels = {"xlabel": r"$\beta$", "xscale": "log", "yscale": "log", "xlim": (1e-4, 3e4)}
    caption(left, ylabel=r"$\varepsilon$", **labels)
    caption(right, ylabel="error of the fitted law", ylim=(1e-14, 1e-6), **labels)
    return {"largest": largest, "picture": figure}


def soft_impact(beta: float) -> tuple[float, float]:
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
    options: dict = {"rtol": 1e-12, "atol": 1e-14, "first_step": 1e-3, "max_step": 0.2}
    found = solve_ivp(rates, (0, 400), [0, 1, 0, 0, 0, 0], "DOP853", events=apart, **options)
    y, _, lost, dy, _, more = found.y_events[0][0]  # type: ignore[index]
    return lost + 0.8 * y**5, more + 4 * y**4 * dy


def derive_softness(_: Options) -> dict:
    nodes = np.concatenate([[1e-4], np.geomspace(1e-3, 12, 70)])
    loss, slope = np.array([soft_impact(beta) for beta in nodes]).T
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

    def in_package(beta: np.ndarray) -> np.ndarray:
        return np.asarray(softness_coefficient(jnp.asarray(beta), 2))

    found = least_squares(lambda p: fit(p, BETAS) / c - 1, [0.5, 0.0, 1.0, 0.0]).x
    figure, (axes,) = panels(size=(5.5, 3.6))
    fine = np.geomspace(BETAS[0], BETAS[-1], 300)
    axes.plot(fine, in_package(fine), color=THEORY, label="the fit")
    axes.plot(BETAS, c, "o", color=INK, ms=3.5, label="average over simulated impacts")
    axes.axhline(MEAN_OVERLAP, color=GUIDE, ls="--", lw=1, label=r"$\beta\to 0$")
    labels = {"xlabel": r"$\beta_T$", "ylabel": r"$c/(d-1)$", "ylim": (0, 1.1)}
    caption(axes, legend="lower left", xscale="log", **labels)
    return {
        "c_over_d_minus_1": {f"{beta:g}": exact(beta) for beta in (1e-3, 0.1, 0.3, 0.5, 1.0, 3.0)},
        "numerator": found[:2],
        "denominator": found[2:],
        "error_of_this_fit": np.max(np.abs(fit(found, BETAS) / c - 1)),
        "error_of_the_package": np.max(np.abs(in_package(BETAS) / c - 1)),
        "picture": figure,
    }


if __name__ == "__main__":
    run_parts(__doc__, derive_restitution, derive_softness, smoke=False)
