"""Objects as JSON and back."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran._utils.json_tree import NotStorable, from_json, to_json
from jaxgran.fitting.parameters import KnownTime


def restored(value):
    return from_json(json.loads(json.dumps(to_json(value), allow_nan=False)))


def test_objects_come_back():
    trees = [None, True, 3, 0.1, -np.inf, "text", [1, (2, 3.0)], {"a": (), 1: KnownTime(0.0, 1.0)}]
    for tree in trees:
        assert restored(tree) == tree and type(restored(tree)) is type(tree)
    for array in (np.arange(6.0).reshape(2, 3), np.array([np.nan, 1.0]), jnp.zeros((0, 2))):
        found = restored(array)
        np.testing.assert_array_equal(found, array)
        assert found.dtype == array.dtype and type(found) is type(array)
    curve = jaxgran.CoolingCurve(jnp.array([0.1, 1.0]), jnp.array([2.0, 1.0]))
    np.testing.assert_array_equal(restored(curve).temperature, curve.temperature)


def test_single_numbers_of_numpy_become_those_of_python():
    for value, expected in ((np.float32(1.5), 1.5), (np.int64(2), 2), (np.bool_(True), True)):
        assert restored(value) == expected and type(restored(value)) is type(expected)


@pytest.mark.parametrize(
    "value", [1j, np.complex64(1j), {1, 2}, len, np.array([1j]), np.array(["a"]), jax.random.key(0)]
)
def test_other_objects_are_refused(value):
    with pytest.raises(NotStorable):
        to_json(value)


@pytest.mark.parametrize("value", [jaxgran.ConstantRestitution(0.9), KnownTime(0.0, 1.0)])
def test_fields_of_another_version_are_refused(value):
    stored = to_json(value)
    name, _ = stored["fields"].popitem()
    with pytest.raises(ValueError, match=f"another version .* and now .*{name}"):
        from_json(stored)
    with pytest.raises(ValueError, match="another version"):
        from_json({**stored, "fields": to_json(value)["fields"] | {"further": 1.0}})


@pytest.mark.parametrize("place", ["jaxgran.data.gone:Curve", "jaxgran.data.curve:Gone"])
def test_classes_that_have_gone_are_refused(place):
    with pytest.raises(ValueError, match="another version .* is unknown"):
        from_json({"class": place, "fields": {}})


def test_classes_of_others_are_refused():
    with pytest.raises(ValueError, match="is not a class of jaxgran"):
        from_json({"class": "pathlib:Path", "fields": {}})
