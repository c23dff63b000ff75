"""Plots of curves and fits; needs matplotlib (the extras `notebook` and `experiments`).

`jaxgran.plot_curve`, `jaxgran.plot_fit` and `jaxgran.plot_plan` import this module when they are
first used.
"""

import textwrap
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from jaxgran._utils.extras import import_extra
from jaxgran.data.curve import CoolingCurve, above_noise
from jaxgran.data.files import write_atomically
from jaxgran.fitting.plan import OPEN_WIDTH, Plan
from jaxgran.fitting.result import Fit
from jaxgran.scene.parameters import symbol_of

import_extra("matplotlib")
from matplotlib.axes import Axes  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

MAX_DRAWN = 1000
"""Largest number of points drawn; of a longer curve, points evenly spaced in log time are drawn."""

COLOURS = {
    "measured": "#222222",
    "guide": "#7f7f7f",
    "kinetic theory": "#0072b2",
    "DSMC": "#56b4e9",
    "hard spheres": "#e69f00",
    "soft spheres": "#d55e00",
    "elastic": "#999999",
    "constant restitution": "#cc79a7",
    "viscoelastic": "#009e73",
}
"""Colours of all pictures by meaning: measurements (in an experiment, in LAMMPS, by finite
differences), guides to the eye, models by their names, kinds of gases. The palette is by M.
Okabe and K. Ito, Color Universal Design (2008), which colour-blind people can distinguish; lines
and points also differ in style, for pictures in grey."""

INK = COLOURS["measured"]


def colour_of(model: str) -> str:
    """Return the colour of a model by its name; grey for models of users."""
    return COLOURS.get(model, "#5f5f5f")


LABELS = {
    "temperature": r"temperature $T=\langle v^2\rangle/d$ (m$^2$/s$^2$)",
    "rotational_temperature": r"rotational temperature $T_\mathrm{rot}$ (m$^2$/s$^2$)",
    "displacement": r"mean square displacement $\langle\Delta r^2\rangle$ (m$^2$)",
}
"""Labels of axes by quantity."""


def plot_curve(curve: CoolingCurve, axes: Axes | None = None, **style: Any) -> Axes:
    """Plot T against t on logarithmic axes, with error bars if T has errors.

    Args:
        curve: one curve, measured or computed.
        axes: matplotlib axes; by default the current axes of pyplot.
        style: options of matplotlib's `errorbar`, such as label="hard spheres", color="C1",
            fmt="o".

    Returns:
        The axes.

    Raises:
        ValueError: for a batch of curves, as `jax.vmap` returns it.
    """
    curve.check_single()
    if axes is None:
        from matplotlib import pyplot

        axes = pyplot.gca()  # a notebook displays it
    style = {"lw": 1.8, "elinewidth": 1.0} | style
    _draw_with_errors(axes, curve, "temperature", **style)
    axes.set_xlabel("time t (s)")
    return axes


def _draw_with_errors(axes: Axes, curve: CoolingCurve, name: str, **style: Any) -> None:
    """Draw a quantity at t > 0 on logarithmic axes, with error bars if it has errors."""
    shown = _drawn_indices(curve.times)
    t, values = (np.asarray(x)[shown] for x in (curve.times, getattr(curve, name)))
    error = getattr(curve, f"{name}_error")
    error = None if error is None else np.asarray(error)[shown]
    axes.errorbar(t, values, error, **style)
    axes.set(xscale="log", yscale="log", ylabel=LABELS[name])


def plot_fit(result: Fit, axes: Any = None) -> np.ndarray:
    """Plot the measured T with error bars, the fitted T, power laws as guides, and the residuals.

    Args:
        result: of `jaxgran.fit`, of one curve.
        axes: two matplotlib axes, for T and for the residuals; by default of a new figure.

    Returns:
        Both axes, shape (2,).

    Raises:
        ValueError: if `axes` are not two, or for a fit of several measurements or of a drop test.
    """
    if axes is None:
        from matplotlib import pyplot

        shapes = {"sharex": True, "gridspec_kw": {"height_ratios": [3, 1]}}
        _, axes = pyplot.subplots(2, 1, figsize=(6.4, 6.4), layout="constrained", **shapes)
    axes = np.asarray(axes)
    if axes.shape != (2,):
        raise ValueError(
            f"axes must be two, for T and for the residuals, got shape {axes.shape}. Make them by "
            "matplotlib.pyplot.subplots(2, sharex=True)."
        )
    _draw_fit(axes, result, "temperature")
    curve = _measured(result)
    T = np.asarray(curve.temperature)[above_noise(curve)]
    axes[0].set_ylim(0.6 * float(np.min(T)), 1.6 * float(T.max()))
    _draw_power_laws(axes[0], result.curve)
    axes[0].legend(frameon=False, loc="lower left")
    return axes


def save_fit(result: Fit, title: str, path: str | Path) -> None:
    """Write the picture of a fit: `plot_fit`, with panels for T_rot and <dr^2> if they were fitted.

    Args:
        result: of `jaxgran.fit`, of one curve.
        title: above the picture.
        path: of the file; its suffix is the format, PNG without one.
    """
    names = "rotational_temperature", "displacement"
    further = [name for name in names if name in result.residuals.get("", {})]
    width = max(8.0, 4.0 + 4.0 * len(further))
    figure = Figure(figsize=(width, 6.4))  # a constrained layout draws it twice, in half a second
    figure.subplots_adjust(0.8 / width, 0.08, 1 - 0.15 / width, 0.93, 0.25, 0.08)
    heights = {"height_ratios": [3, 1]}
    axes = figure.subplots(2, 1 + len(further), sharex=True, squeeze=False, gridspec_kw=heights)
    plot_fit(result, axes[:, 0])
    for name, panel in zip(further, axes[:, 1:].T, strict=True):
        _draw_fit(panel, result, name)
        corner = "upper left" if name == "displacement" else "lower left"
        panel[0].legend(frameon=False, loc=corner)
    _save(figure, title, path)


def save_curves(curves: dict[str, tuple[CoolingCurve, CoolingCurve | None]], title: str, path):
    """Write a picture of one or several curves: measured points and computed lines.

    Args:
        curves: by label; a measured curve and the one fitted to it, or a computed curve and None.
        title: above the picture.
        path: of the file; its suffix is the format, PNG without one.
    """
    figure = Figure(figsize=(8.0, 5.4), layout="constrained")
    axes = figure.subplots()
    shades = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#222222"]
    for shade, marker, (label, (curve, computed)) in zip(
        cycle(shades), cycle("osD^v<>"), curves.items(), strict=False
    ):
        points = {} if computed is None else {"fmt": marker, "ms": 3.5, "lw": 0}
        plot_curve(curve, axes, color=shade, label=label, **points)
        if computed is not None:
            plot_curve(computed, axes, color=shade)
    axes.legend(frameon=False, loc="lower left")
    _save(figure, title, path)


def plot_plan(plan: Plan, axes: Axes | None = None) -> Axes:
    """Plot the range to expect of an experiment as it is and with each addition, the best on top.

    Args:
        plan: of `jaxgran.plan`.
        axes: matplotlib axes; by default the current axes of pyplot.

    Returns:
        The axes.
    """
    if axes is None:
        from matplotlib import pyplot

        axes = pyplot.gca()
    rows = [*([] if plan.pair is None else [plan.pair]), *plan.additions, plan.present]
    highest = max([x.high for x in rows if x.width < OPEN_WIDTH], default=plan.truth)
    end = 1.1 * max(highest, plan.truth)
    for place, row in enumerate(rows):
        colour = INK if row is plan.present else COLOURS["kinetic theory"]
        high = min(row.high, end)
        axes.plot([row.low, high], [place, place], "-", lw=5, color=colour, solid_capstyle="butt")
        if high < row.high:
            axes.plot([high], [place], ">", color=colour, clip_on=False)
    axes.axvline(plan.truth, color=COLOURS["guide"], lw=1.2)
    axes.set_yticks(range(len(rows)), [row.name for row in rows])
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlim(0, end)
    unit = f" ({plan.unit})" if plan.unit else ""
    axes.set_xlabel(f"95 % range of {symbol_of(plan.parameter)} to expect{unit}")
    return axes


def save_plan(plan: Plan, title: str, path: str | Path) -> None:
    """Write the picture of a plan, `plot_plan`.

    Args:
        plan: of `jaxgran.plan`.
        title: above the picture.
        path: of the file; its suffix is the format, PNG without one.
    """
    figure = Figure(figsize=(8.0, 1.8 + 0.3 * len(plan.additions)), layout="constrained")
    plot_plan(plan, figure.subplots())
    _save(figure, title, path)


def _save(figure: Figure, title: str, path: str | Path) -> None:
    wrapped = [textwrap.fill(line, 84) for line in title.splitlines()]
    figure.suptitle("\n".join(wrapped), color=INK, fontsize=11)
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
    picture_format = Path(path).suffix.lstrip(".") or "png"
    write_atomically(path, lambda f: figure.savefig(f, dpi=150, format=picture_format))


def _measured(result: Fit) -> CoolingCurve:
    if [*result.measurements] != [""]:
        raise ValueError(
            f"expected a fit of one curve, got one of {', '.join(result.measurements)}. Draw each "
            "of these curves, and result.curve, by jaxgran.plot_curve."
        )
    return result.measurements[""].curve


def _draw_fit(axes: Any, result: Fit, name: str) -> None:
    """Draw a measured quantity with error bars, the fitted one and the residuals, at t > 0."""
    top, bottom = axes
    curve = _measured(result)
    shown = _drawn_indices(curve.times)
    parts = curve.times, getattr(result.curve, name), result.residuals[""][name]
    t, computed, residuals = (np.asarray(x)[shown] for x in parts)
    number = np.size(curve.times)
    model = result.model_name
    label = "measured" if number <= MAX_DRAWN else f"measured: {t.size} of {number}"
    _draw_with_errors(top, curve, name, fmt="o", ms=3.5, color=INK, label=label, zorder=2)
    top.plot(t, computed, color=colour_of(model), lw=1.8, label=f"{model}, fitted", zorder=3)
    bottom.axhspan(-1, 1, color=COLOURS["guide"], alpha=0.2, lw=0)
    bottom.axhline(0, color=colour_of(model), lw=1.4)
    bottom.plot(t, residuals, "o", ms=3.5, color=INK)
    bottom.set(xlabel="time t (s)", ylabel="independent residual")


def _drawn_indices(times) -> np.ndarray:
    """Return the indices of the times after 0, at most `MAX_DRAWN` of them."""
    times = np.asarray(times)
    (shown,) = np.nonzero(times > 0)
    if shown.size <= MAX_DRAWN:
        return shown
    t = times[shown]
    return shown[np.unique(np.searchsorted(t[:-1], np.geomspace(t[0], t[-1], MAX_DRAWN)))]


def _draw_power_laws(axis, curve: CoolingCurve) -> None:
    """Draw labelled guides to the eye: the late law of viscoelastic spheres and Haff's law.

    They begin at 0.8 of the largest T and end in the last point. They are left out if the curve has
    not fallen far enough to differ from them.
    """
    t, T = (np.asarray(x, float) for x in (curve.times, curve.temperature))
    top = 0.8 * float(T.max())
    if not T[-1] < 0.3 * top:
        return
    laws = (-5 / 3, "--", r"$t^{-5/3}$", "right", -4), (-2.0, ":", r"$t^{-2}$", "left", 4)
    for power, style, label, side, shift in laws:
        first = t[-1] * (T[-1] / top) ** (-1 / power)
        times = np.geomspace(first, t[-1], 50)
        grey = {"color": COLOURS["guide"]}
        axis.plot(times, T[-1] * (times / t[-1]) ** power, style, lw=1.2, zorder=1, **grey)
        place = {"xytext": (shift, 2), "textcoords": "offset points", "ha": side, "va": "center"}
        axis.annotate(label, (first, top), **place, **grey)
