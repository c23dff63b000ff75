"""Curves as tables of xarray and pandas, which are imported here when they are asked for."""

from importlib import import_module
from typing import Any

import numpy as np

UNITS = {
    "times": "s",
    "temperature": "m^2/s^2",
    "temperature_error": "m^2/s^2",
    "displacement": "m^2",
    "displacement_error": "m^2",
    "sonine": "1",
    "third_sonine": "1",
    "collisions": "1",
    "diffusion": "m^2/s",
    "rotational_temperature": "m^2/s^2",
    "rotational_temperature_error": "m^2/s^2",
    "velocity_correlation": "m^2/s^2",
    "elastic_energy": "J",
    "dissipated_energy": "J",
    "regularised": "1",
    "flow_share": "1",
    "derivative_bias": "1",
}
"""Units of the quantities of a curve, by the names of its fields."""


def needed(name: str, extra: str = "notebook") -> Any:
    """A module of an extra.

    Raises:
        ModuleNotFoundError: if it is not installed, naming the extra.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        if error.name != name:
            raise
        raise ModuleNotFoundError(
            f'this needs {name}: pip install "jaxgran[{extra}]"', name=name
        ) from None


def quantities(curve: Any) -> dict[str, np.ndarray]:
    """What is known at each time, by name, without the times.

    Raises:
        ValueError: for several curves in one, as `jax.vmap` returns them.
    """
    if np.ndim(curve.times) != 1:
        raise ValueError(
            f"the times of this curve have shape {np.shape(curve.times)}: take one curve, as in "
            "jax.tree.map(lambda x: x[0], curves)"
        )
    known = {name: getattr(curve, name, None) for name in UNITS if name != "times"}
    return {name: np.asarray(values) for name, values in known.items() if values is not None}


def dataset(curve: Any) -> Any:
    """The `xarray.Dataset` of `CoolingCurve.to_xarray`."""
    xarray = needed("xarray")

    def described(name: str, *dims: str, values: np.ndarray) -> tuple:
        return dims, values, {"units": UNITS[name], "long_name": name.replace("_", " ")}

    found = {name: described(name, "time", values=x) for name, x in quantities(curve).items()}
    if curve.replicas is not None:
        for name in found.keys() & UNITS.keys():
            values = getattr(curve.replicas, name)
            if values is not None:
                each = described(name, "replica", "time", values=np.asarray(values))
                found[f"{name}_of_replicas"] = each
    if curve.particles is not None:
        for name, unit in (("position", "m"), ("velocity", "m/s")):
            values = np.asarray(getattr(curve.particles, name))
            found[name] = (("replica", "particle", "axis"), values, {"units": unit})
    found |= _saved(curve)
    time = described("times", "time", values=np.asarray(curve.times))
    attributes = {} if curve.status is None else {"status": int(curve.status)}
    return xarray.Dataset(found, coords={"time": time}, attrs=attributes)


def _saved(curve: Any) -> dict[str, tuple]:
    """What ``save=`` made of the particles, by name: dimensions, values and attributes."""
    from jaxgran.data import curve as curves  # which imports this module
    from jaxgran.data import saved

    whole, found = isinstance(curve.saved, curves.Particles), {}
    for name, leaf in saved.leaves(curve).items():
        unit = saved.unit(name, whole)
        attributes = {} if unit is None else {"units": unit}
        found[name] = saved.dimensions(name, np.ndim(leaf), whole), np.asarray(leaf), attributes
    return found


def frame(curve: Any) -> Any:
    """The `pandas.DataFrame` of `CoolingCurve.to_pandas`."""
    pandas = needed("pandas")
    columns = quantities(curve)
    return pandas.DataFrame(columns, index=pandas.Index(np.asarray(curve.times), name="times"))
