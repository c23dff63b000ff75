"""Is the paper's series of eps, Eqs. (1), (5) and (6), correct, and up to which beta?

    python experiments/paper/paper_restitution.py [--smoke] [--out DIR]

Integrates the equation of motion of single impacts for both conditions at which contact can end
(xi = 0 and F = 0), obtains the coefficients of the series from them by a fit, and measures the
errors of the truncated series.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from experiments.support import paper
from jaxgran.scene.contact import impact
from jaxgran.scene.laws import C1, C2, C_CLIP, UNCLIPPED_SERIES, viscoelastic_restitution

NAME = "paper_restitution"
PRINTED = (1.15344, 0.79826)
RAMIREZ = (0.48358, 0.28528)
"""Third and fourth coefficients of Ramirez et al., PRE 60, 4465 (1999), as often quoted."""


@dataclass(frozen=True)
class Config:
    rtol: float = 1e-13  # tolerance of the solver of an impact
    num_impacts: int = 60  # values of beta in the picture
    lowest: float = 1e-3
    highest: float = 2.0
    fit_top: float = 0.3  # the series are fitted to impacts up to this beta
    fit_degree: int = 16  # in beta, or in its root where contact is clipped


SMOKE = Config(num_impacts=16, fit_degree=12)


def restitutions(betas: np.ndarray, clipped: bool, rtol: float) -> np.ndarray:
    solve = jax.jit(lambda b: impact(b, clipped=clipped, rtol=rtol).restitution)
    return np.array([float(solve(b)) for b in betas])


def series(betas: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    return 1 + betas[:, None] ** np.arange(1, len(coefficients) + 1) @ np.array(coefficients)


def recovered(config: Config) -> dict[str, list[float]]:
    """Fit coefficients of beta^(1/2), beta, ... (clipped) or beta, beta^2, ... to impacts."""
    # A least-squares fit on Chebyshev nodes, twice as many as coefficients.
    nodes = (
        1 - np.cos((np.arange(2 * config.fit_degree) + 0.5) / config.fit_degree * np.pi / 2)
    ) / 2
    found = {}
    for clipped in (True, False):
        x = nodes * (config.fit_top**0.5 if clipped else config.fit_top)
        lost = restitutions(x**2 if clipped else x, clipped, config.rtol) - 1
        powers = np.arange(1, config.fit_degree + 1)
        matrix = (x / x.max())[:, None] ** powers
        fitted = np.linalg.lstsq(matrix, lost, rcond=None)[0] / x.max() ** powers
        found["clipped" if clipped else "unclipped"] = paper.listed(fitted[:6])
    return found


def main() -> None:
    options = paper.options(__doc__, NAME)
    config = SMOKE if options.smoke else Config()
    clock = paper.Clock()
    betas = np.geomspace(config.lowest, config.highest, config.num_impacts)
    clipped = restitutions(betas, True, config.rtol)
    unclipped = restitutions(betas, False, config.rtol)
    fast = np.asarray(viscoelastic_restitution(jnp.asarray(betas)))
    coefficients = recovered(config)
    two = series(betas, (-C1, C2))

    figure = paper.figure(
        "The paper's two terms of ε hold to 1 % up to β = 0.25, for both ends of contact",
        columns=2,
    )
    left, right = figure.axes
    left.plot(betas, clipped, color=paper.INK, label="equation of motion, ends at F = 0")
    left.plot(
        betas,
        unclipped,
        "--",
        color=paper.ELASTIC,
        label="equation of motion, ends at ξ = 0 (paper)",
    )
    left.plot(betas, two, color=paper.VISCOELASTIC, label="paper, Eq. (1): two terms")
    five = series(betas, UNCLIPPED_SERIES)
    left.plot(betas, five, ":", color=paper.INK, label="five terms")
    paper.caption(
        left,
        "One impact",
        xlabel="dissipation  β = (3/2) A α$^{2/5}$ v$^{1/5}$",
        ylabel="restitution  ε",
        xscale="log",
        ylim=(-0.02, 1.02),
    )
    ramirez = series(betas, (-C1, C2, -RAMIREZ[0], RAMIREZ[1]))
    errors = {
        "two_terms_unclipped": np.abs(two - unclipped),
        "two_terms_clipped": np.abs(two - clipped),
        "ramirez_four_terms": np.abs(ramirez - unclipped),
        "four_terms": np.abs(series(betas, UNCLIPPED_SERIES[:4]) - unclipped),
        "fast_law": np.abs(fast - clipped),
    }
    looks = {
        "two_terms_unclipped": ("two terms, from ε that ends at ξ = 0", paper.VISCOELASTIC, "-"),
        "two_terms_clipped": ("two terms, from ε that ends at F = 0", paper.VISCOELASTIC, ":"),
        "ramirez_four_terms": ("four terms of Ramírez et al. 1999", paper.ELASTIC, "-"),
        "four_terms": ("four terms, corrected", paper.GUIDE, "-."),
        "fast_law": ("the package's fast law, from F = 0", paper.INK, "-"),
    }
    for name, error in errors.items():
        label, color, style = looks[name]
        seen = error > 1e-13
        right.plot(betas[seen], error[seen], style, color=color, label=label)
    paper.caption(
        right,
        "Difference from the equation of motion",
        xlabel="dissipation  β",
        ylabel="error of ε",
        xscale="log",
        yscale="log",
        ylim=(1e-13, 30),
    )
    orders = {
        name: float(np.mean(paper.slope(betas[:10], errors[name][:10])[1]))
        for name in ("two_terms_unclipped", "two_terms_clipped", "ramirez_four_terms")
    }
    relative = {
        name: np.abs(two / eps - 1) for name, eps in (("F = 0", clipped), ("xi = 0", unclipped))
    }
    one_per_cent = {
        name: float(np.exp(np.interp(np.log(0.01), np.log(miss), np.log(betas))))
        for name, miss in relative.items()
    }
    print("recovered from impacts:", {k: [round(c, 6) for c in v] for k, v in coefficients.items()})
    print(f"orders of the error in beta: {orders}; 1 % reached at beta = {one_per_cent}")
    paper.write(
        figure,
        options,
        NAME,
        config,
        clock,
        recovered=coefficients,
        closed_forms=[C1, C2, C_CLIP],
        orders=orders,
        two_terms_good_to_one_per_cent=one_per_cent,
        fast_law_error=float(errors["fast_law"].max()),
        beta=paper.listed(betas),
        restitution_clipped=paper.listed(clipped),
        restitution_unclipped=paper.listed(unclipped),
    )


if __name__ == "__main__":
    main()
