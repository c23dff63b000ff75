"""Pictures of curves and fits; needs matplotlib (the `experiments` extra)."""

import textwrap
from pathlib import Path

import numpy as np

from jaxgran.checkpoint import write_whole
from jaxgran.choice import words
from jaxgran.curve import CoolingCurve
from jaxgran.estimate import Fit

try:
    from matplotlib.figure import Figure
except ModuleNotFoundError as error:  # pragma: no cover
    raise ModuleNotFoundError(
        'jaxgran.plotting needs matplotlib: pip install "jaxgran[experiments]"'
    ) from error

INK, DATA, MODEL, GUIDE = "#222222", "#20639b", "#d1495b", "#8d99ae"


def plot_fit(result: Fit, curve: CoolingCurve, title: str, path: str | Path) -> None:
    """Data with error bars, fit, power laws for the eye, and residuals, to a PNG file.

    Args:
        result: of `jaxgran.fit`.
        curve: the measured curve.
        title: above the picture.
        path: where to write it.
    """
    has_displacement = result.displacement_residuals is not None
    figure = Figure(figsize=(8.0, 6.4), layout="constrained")
    ratios = {"height_ratios": [3, 1]}
    if has_displacement:
        axes = figure.subplots(2, 2, sharex=True, gridspec_kw=ratios)
    else:
        axes = figure.subplots(2, 1, sharex=True, gridspec_kw=ratios)[:, None]
    wrapped = [textwrap.fill(line, 84) for line in title.splitlines()]
    figure.suptitle("\n".join(wrapped), color=INK, fontsize=11)
    t = np.asarray(curve.times)
    shown = t > 0
    t = t[shown]
    fitted = f"{words(result.model).lower()}, fitted"

    def column(top, bottom, measured, error, computed, residuals, name):
        measured, computed = np.asarray(measured)[shown], np.asarray(computed)[shown]
        error = None if error is None else np.asarray(error)[shown]
        top.errorbar(t, measured, error, fmt="o", ms=3.5, color=DATA, label="measured", zorder=2)
        top.plot(t, computed, color=MODEL, lw=1.6, label=fitted, zorder=3)
        top.set(xscale="log", yscale="log", ylabel=name)
        bottom.axhspan(-1, 1, color=GUIDE, alpha=0.25, lw=0)
        bottom.axhline(0, color=MODEL, lw=1)
        bottom.plot(t, np.asarray(residuals)[shown], "o", ms=3.5, color=DATA)
        bottom.set(xlabel="time t (s)", ylabel="residual / error")

    column(
        axes[0, 0],
        axes[1, 0],
        curve.temperature,
        curve.temperature_error,
        result.curve.temperature,
        result.residuals,
        r"temperature $T=\langle v^2\rangle/d$ (m$^2$/s$^2$)",
    )
    late = t >= t[-1] / 30
    end = float(np.asarray(result.curve.temperature)[-1])
    for power, style, label in ((-5 / 3, "--", r"$t^{-5/3}$"), (-2.0, ":", r"$t^{-2}$")):
        axes[0, 0].plot(
            t[late], end * (t[late] / t[-1]) ** power, style, color=INK, lw=1, label=label, zorder=1
        )
    top = 1.6 * float(np.asarray(curve.temperature).max())
    axes[0, 0].set_ylim(0.6 * float(np.asarray(curve.temperature)[-1]), top)
    axes[0, 0].legend(frameon=False, loc="lower left")
    if has_displacement:
        column(
            axes[0, 1],
            axes[1, 1],
            curve.displacement,
            curve.displacement_error,
            result.curve.displacement,
            result.displacement_residuals,
            r"mean square displacement $\langle\Delta r^2\rangle$ (m$^2$)",
        )
        axes[0, 1].legend(frameon=False, loc="upper left")
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
    picture_format = Path(path).suffix.lstrip(".") or "png"
    write_whole(path, lambda f: figure.savefig(f, dpi=150, format=picture_format))
