"""Where do the coefficients of the fitted restitution law come from, and how accurate is it?

    python experiments/accuracy/derive_restitution.py [--record] [--out DIR]

Solves the equation of motion of an impact for some 200 values of beta and fits
``ln eps + decay ln(1 + kappa beta)`` by ``beta P(z) / Q(z)``, z = sqrt(beta). The fit minimises the
largest error (Lawson's reweighting of a linearised least-squares fit). Prints the coefficients that
``jaxgran/scene/restitution_table.py`` contains, and draws eps and the error of the package's law.
"""

import jax
import numpy as np
from matplotlib.figure import Figure

from experiments.support.record import script_parser, write_picture, write_results
from jaxgran.plotting import COLOURS
from jaxgran.scene.contact import impact
from jaxgran.scene.laws import C1, viscoelastic_restitution

ROUNDS = 300


def samples(clipped: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return values of beta, and eps of an impact at each."""
    top = 3e4 if clipped else 40.0
    s = (1 - np.cos((np.arange(160) + 0.5) * np.pi / 160)) / 2
    beta = np.concatenate([s / (1 - s), np.geomspace(1, top, 50)])
    beta = np.sort(beta[beta <= top])
    solve = jax.jit(lambda b: impact(b, clipped=clipped, rtol=1e-13).restitution)
    return beta, np.array([float(solve(b)) for b in beta])


def fit_rational(
    beta: np.ndarray,
    target: np.ndarray,
    slope: float,
    powers_p: list[int],
    powers_q: list[int],
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the largest error, and the coefficients of P and Q without the constant ones."""
    z = np.sqrt(beta)[:, None]
    basis_p, basis_q = z ** np.array(powers_p), z ** np.array(powers_q)
    denominator, lawson = np.ones_like(beta), np.ones_like(beta)
    best = (np.inf, np.array([]), np.array([]))
    for _ in range(ROUNDS):
        weight = (lawson / denominator)[:, None]
        matrix = np.concatenate([beta[:, None] * basis_p, -target[:, None] * basis_q], axis=1)
        matrix = matrix * weight
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


def main() -> None:
    options = script_parser(__doc__, "derive_restitution", smoke=False).parse_args()
    jax.config.update("jax_enable_x64", True)
    # beta P and Q have the same degree, so that their ratio tends to a constant.
    shapes = {
        "clipped": (True, 0.7, 5 / 3, [2, *range(3, 9)], [2, *range(4, 11)]),
        "unclipped": (False, 0.7, 5.0, list(range(2, 21, 2)), list(range(2, 23, 2))),
    }
    largest = {}
    for name, (clipped, kappa, decay, powers_p, powers_q) in shapes.items():
        beta, restitution = samples(clipped)
        target = np.log(restitution) + decay * np.log1p(kappa * beta)
        slope = decay * kappa - C1
        error, p, q = fit_rational(beta, target, slope, powers_p, powers_q)
        largest[name] = {"error": float(error), "beta_to": float(beta[-1])}
        print(f"{name}: largest relative error {error:.1e} over 0 <= beta <= {beta[-1]:g}")
        for title, powers, values in (("P", powers_p, p), ("Q", powers_q, q)):
            print("  " + title, {k: float(v) for k, v in zip(powers, values, strict=True)})
    write_results("derive_restitution", options, None, largest=largest)
    write_picture(draw(), "derive_restitution", options)


def draw() -> Figure:
    """Draw eps by the equation of motion, and the relative error of the package's fit."""
    figure = Figure(figsize=(7.5, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for clipped, words, style in ((True, "force clipped at 0", "-"), (False, "unclipped", "--")):
        beta, exact = samples(clipped)
        law = np.asarray(viscoelastic_restitution(beta, clipped=clipped))
        left.plot(beta, exact, style, color=COLOURS["viscoelastic"], label=words)
        right.plot(beta, np.abs(law / exact - 1), style, color=COLOURS["viscoelastic"], lw=1)
    left.set(xscale="log", yscale="log", xlabel=r"$\beta$", ylabel=r"$\varepsilon$")
    left.legend(frameon=False)
    right.set(xscale="log", yscale="log", xlabel=r"$\beta$", ylabel="error of the fitted law")
    right.set_ylim(1e-14, 1e-6)
    for axes in (left, right):
        axes.set_xlim(1e-4, 3e4)
        axes.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    main()
