"""Pictures of fits; needs matplotlib (the `experiments` extra).

May import `data` and `fitting`; is imported by experiments only.
"""

import textwrap
from pathlib import Path

import numpy as np

from jaxgran.data.curve import CoolingCurve
from jaxgran.data.files import write_whole
from jaxgran.fitting.result import Fit

try:
    from matplotlib.figure import Figure
except ModuleNotFoundError as error:  # pragma: no cover
    raise ModuleNotFoundError(
        'jaxgran.plotting needs matplotlib: pip install "jaxgran[experiments]"'
    ) from error

MOST_DRAWN = 1000
"""Points that are drawn of a longer curve, evenly spaced in the logarithm of time."""

INK, DATA, MODEL, GUIDE = "#222222", "#20639b", "#d1495b", "#8d99ae"


def plot_fit(result: Fit, curve: CoolingCurve, title: str, path: str | Path) -> None:
    """Draw the data with error bars, the fitted curve, power laws as guides, and the residuals.

    Args:
        result: of `jaxgran.fit`.
        curve: the measured curve.
        title: above the picture.
        path: of the file; its suffix is the format, PNG without one.
    """
    further = [
        (
            curve.rotational_temperature,
            curve.rotational_temperature_error,
            result.curve.rotational_temperature,
            result.rotation_residuals,
            r"rotational temperature $T_\mathrm{rot}$ (m$^2$/s$^2$)",
            "lower left",
        ),
        (
            curve.displacement,
            curve.displacement_error,
            result.curve.displacement,
            result.displacement_residuals,
            r"mean square displacement $\langle\Delta r^2\rangle$ (m$^2$)",
            "upper left",
        ),
    ]
    further = [panel for panel in further if panel[3] is not None]
    figure = Figure(figsize=(max(8.0, 4.0 + 4.0 * len(further)), 6.4), layout="constrained")
    axes = figure.subplots(
        2,
        1 + len(further),
        sharex=True,
        squeeze=False,
        gridspec_kw={"height_ratios": [3, 1]},
    )
    wrapped = [textwrap.fill(line, 84) for line in title.splitlines()]
    figure.suptitle("\n".join(wrapped), color=INK, fontsize=11)
    fitted = f"{result.model.name}, fitted"
    top, bottom = axes[:, 0]
    measured, error = curve.temperature, curve.temperature_error
    _draw(top, curve.times, measured, error, result.curve.temperature, fitted)
    _draw_residuals(bottom, curve.times, result.residuals)
    top.set_ylabel(r"temperature $T=\langle v^2\rangle/d$ (m$^2$/s$^2$)")
    _draw_power_laws(top, result.curve)
    T = np.asarray(curve.temperature)
    top.set_ylim(0.6 * float(T[-1]), 1.6 * float(T.max()))
    top.legend(frameon=False, loc="lower left")
    for (top, bottom), panel in zip(axes[:, 1:].T, further, strict=True):
        measured, error, computed, residuals, label, corner = panel
        _draw(top, curve.times, measured, error, computed, fitted)
        _draw_residuals(bottom, curve.times, residuals)
        top.set_ylabel(label)
        top.legend(frameon=False, loc=corner)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
    picture_format = Path(path).suffix.lstrip(".") or "png"
    write_whole(path, lambda f: figure.savefig(f, dpi=150, format=picture_format))


def _draw(axis, times, measured, error, computed, fitted: str) -> None:
    """Measured values with error bars, and the fitted curve, at t > 0."""
    shown = _shown(times)
    t, measured, computed = (np.asarray(x)[shown] for x in (times, measured, computed))
    error = None if error is None else np.asarray(error)[shown]
    label = "measured" if len(times) <= MOST_DRAWN else f"measured: {t.size} of {len(times)}"
    axis.errorbar(t, measured, error, fmt="o", ms=3.5, color=DATA, label=label, zorder=2)
    axis.plot(t, computed, color=MODEL, lw=1.6, label=fitted, zorder=3)
    axis.set(xscale="log", yscale="log")


def _shown(times) -> np.ndarray:
    """Indices of the times that are drawn: those after 0, or `MOST_DRAWN` of them."""
    times = np.asarray(times)
    (shown,) = np.nonzero(times > 0)
    if shown.size <= MOST_DRAWN:
        return shown
    t = times[shown]
    return shown[np.unique(np.searchsorted(t[:-1], np.geomspace(t[0], t[-1], MOST_DRAWN)))]


def _draw_residuals(axis, times, residuals) -> None:
    shown = _shown(times)
    axis.axhspan(-1, 1, color=GUIDE, alpha=0.25, lw=0)
    axis.axhline(0, color=MODEL, lw=1)
    axis.plot(np.asarray(times)[shown], np.asarray(residuals)[shown], "o", ms=3.5, color=DATA)
    axis.set(xlabel="time t (s)", ylabel="residual / error")


def _draw_power_laws(axis, curve: CoolingCurve) -> None:
    """Guides to the eye: the late power laws of viscoelastic spheres and of Haff's law."""
    t = np.asarray(curve.times)
    late = t[(t > 0) & (t >= t[-1] / 30)]
    end = float(np.asarray(curve.temperature)[-1])
    for power, style, label in ((-5 / 3, "--", r"$t^{-5/3}$"), (-2.0, ":", r"$t^{-2}$")):
        values = end * (late / t[-1]) ** power
        axis.plot(late, values, style, color=INK, lw=1, label=label, zorder=1)
