"""The members of a sweep: gases that share a structure and differ in floats and keys."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from jaxgran.models.base import AbstractModel
from jaxgran.scene.gas import Gas

Keys = Key[Array, "members"]

SIDES = "wall_side"
"""The float that is one number or d of them."""

INITIAL = "initial_"

RECORDED = ("temperature", "rotational_temperature")
"""Floats of a gas that are quantities of a curve, too."""


class Label(NamedTuple):
    """Values of a float: with a first axis of members, or one for all."""

    values: np.ndarray
    of_members: bool


class Batch(NamedTuple):
    """Gases with a leading axis of members on every float, and a key for each.

    Attributes:
        gases: a `Gas` whose leaves have a first axis of members.
        keys: one for each member.
        swept: names of the floats that were given with an axis of members.
    """

    gases: Gas
    keys: Keys
    swept: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.keys)

    def member(self, i: int) -> Gas:
        """One gas, with all of its floats checked.

        Raises:
            ValueError: for a float outside its range.
        """
        gas = jax.tree.map(lambda x: x[i], self.gases)
        return gas.replace(**{name: gas.value(name) for name in gas.domains})

    def labels(self) -> dict[str, "Label"]:
        """The swept floats by name; T and T_rot at t = 0 are "initial_" ones, beside records."""
        each = {
            f"{INITIAL}{name}" if name in RECORDED else name: np.asarray(self.gases.value(name))
            for name in self.swept
        }
        return {
            name: Label(values[0], False) if np.all(values == values[:1]) else Label(values, True)
            for name, values in each.items()
        }

    def taken(self, rows: np.ndarray) -> tuple[Gas, Keys]:
        """The gases and keys of some members."""
        return jax.tree.map(lambda x: x[rows], (self.gases, self.keys))


def batched(gases: Any, key: Any) -> Batch:
    """The members that a user gives, every leaf with a leading axis of the same length.

    Raises:
        ValueError: for anything but a gas, for a batch whose leaves have different lengths, and
            where nothing has an axis of members.
    """
    if not isinstance(gases, Gas):
        raise ValueError(f"gases must be a jaxgran.Gas with batched floats, got {_kind(gases)}")
    keys = _checked_keys(key)
    lengths = {} if keys.ndim == 0 else {"key": len(keys)}
    swept = {name: np.shape(gases.value(name))[0] for name in _swept(gases)}
    lengths |= swept
    if not lengths:
        raise ValueError(
            "no float of gases has a leading axis, and there is one key: build gases by jax.vmap("
            "lambda a: gas.replace(dissipative_constant=a))(values), give an array of keys, or "
            "take jaxgran.cool for one gas"
        )
    if len(set(lengths.values())) > 1 or 0 in lengths.values():
        said = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(
            f"the leading axes of a sweep must have one length, at least 1, got {said}: give "
            "every swept float one value for each member"
        )
    number = next(iter(lengths.values()))
    members = jnp.arange(number)
    if keys.ndim == 0:
        keys = jax.vmap(lambda i: jax.random.fold_in(keys, i))(members)
    same = {name: gases.value(name) for name in gases.domains if name not in swept}
    repeated = {name: jnp.broadcast_to(x, (number, *x.shape)) for name, x in same.items()}
    gases = gases.replace(**repeated)
    return Batch(gases, keys, tuple(swept))


def _kind(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"a {type(value).__name__}: stack the floats of its gases into one Gas"
    if isinstance(value, dict):
        return "a dict: take jax.vmap(lambda a: gas.replace(dissipative_constant=a))(values)"
    return type(value).__name__


def _checked_keys(key: Any) -> Key[Array, "..."]:
    """One key or a row of them, typed."""
    if key is None:
        return jax.random.key(0)
    if isinstance(key, jax.Array):
        if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.ndim <= 1:
            return key
        if key.dtype == jnp.uint32 and key.ndim in (1, 2):
            return jax.random.wrap_key_data(key)
    raise ValueError(
        f"key must be a key such as jax.random.key(5), or a row of keys, got {key!r:.60}"
    )


def _swept(gases: Gas) -> list[str]:
    """Names of the floats that have an axis of members.

    Raises:
        ValueError: for floats with further axes, and for wall sides of which it cannot be told
            whether they are those of one box or of several cubes.
    """
    ndims = {name: np.ndim(gases.value(name)) for name in gases.domains}
    single = {name: int(name in gases.law.lists) for name in ndims if name != SIDES}
    plain = [name for name in single if ndims[name] > single[name]]
    for name, ndim in ndims.items():
        if ndim - single.get(name, 1) > 1:
            raise ValueError(
                f"{name} has shape {np.shape(gases.value(name))}, and a sweep has one axis of "
                "members: flatten the others, as in jnp.meshgrid(...)[0].ravel()"
            )
    if SIDES not in ndims or ndims[SIDES] == 0:
        return plain
    length = np.shape(gases.value(SIDES))[0]
    if ndims[SIDES] == 2 or length != gases.dimension or len(plain) == len(single):
        return [*plain, SIDES]
    if not plain:
        return plain  # one box of d sides
    raise ValueError(
        f"{SIDES} of shape {np.shape(gases.value(SIDES))} may be the sides of one box or those of "
        f"{length} cubes: give every float of gases an axis of members, as jax.vmap returns them"
    )


def first_valid(batch: Batch, model: AbstractModel) -> int:
    """The first member that a model takes.

    Raises:
        ValueError: what is wrong with the first one, if the model takes none.
    """
    first = None
    for i in range(len(batch)):
        refused = refusal(batch, i, model)
        if refused is None:
            return i
        first = first or refused
    assert first is not None
    raise ValueError(f"{type(model).__name__} takes no member of this sweep; member 0: {first}")


def refusal(batch: Batch, i: int, model: AbstractModel) -> str | None:
    """Why a model does not take a member, in words; None if it does."""
    try:
        model.check_scene(batch.member(i))
    except ValueError as error:
        return str(error)
    return None
