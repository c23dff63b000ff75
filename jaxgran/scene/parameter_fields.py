"""Where the parameters of a gas are, by name: in its law, its elements, or the gas itself."""

from collections.abc import Callable
from operator import attrgetter, itemgetter
from typing import Any, NamedTuple

import equinox as eqx
import jax

from jaxgran._utils.validation import ANY, Domain
from jaxgran.scene.elements import Element
from jaxgran.scene.laws import RestitutionLaw
from jaxgran.scene.parameters import PREFIXES
from jaxgran.scene.walls import Walls


class ParameterField(NamedTuple):
    """Place of a parameter in a module, and its range.

    Attributes:
        path: functions such as `operator.attrgetter`, which lead from the module to the parameter.
        domain: allowed values.
    """

    path: tuple[Callable[[Any], Any], ...]
    domain: Domain

    def get(self, module: Any) -> Any:
        """Return the parameter of a module."""
        for part_of in self.path:
            module = part_of(module)
        return module

    def within(self, name: str) -> "ParameterField":
        """Return the place in a module that has the module of this field as an attribute."""
        return ParameterField((attrgetter(name), *self.path), self.domain)


def fields_by_name(domains: dict[str, Domain]) -> dict[str, ParameterField]:
    """Return the place and range of parameters that are attributes."""
    return {name: ParameterField((attrgetter(name),), x) for name, x in domains.items()}


def law_fields(law: RestitutionLaw) -> dict[str, ParameterField]:
    """Return the parameters of a law: those in its `domains`, then all further arrays.

    The name of an array in a part of the law is its path, "net.layers[0].weight".
    """
    fields = fields_by_name(law.domains)
    for keys, leaf in jax.tree_util.tree_flatten_with_path(law)[0]:
        name = jax.tree_util.keystr(keys).removeprefix(".")
        if name not in (*fields, *law.constants) and eqx.is_inexact_array(leaf):
            fields[name] = ParameterField(tuple(map(_part_at, keys)), ANY)
    return fields


def _part_at(key: Any) -> Callable[[Any], Any]:
    """Return a function that takes a part of a tree at a key of `jax.tree_util`."""
    if isinstance(key, jax.tree_util.GetAttrKey):
        return attrgetter(key.name)
    if isinstance(key, jax.tree_util.SequenceKey):
        return itemgetter(key.idx)
    return itemgetter(key.key)


def element_fields(element: Element) -> dict[str, ParameterField]:
    """Return the parameters of an element, which for walls include the parameters of their law.

    Names have the prefix of the element, as "wall_side".
    """
    fields = fields_by_name(element.domains)
    if isinstance(element, Walls):
        law = fields_by_name(element.restitution.domains)
        fields |= {name: field.within("restitution") for name, field in law.items()}
    prefix = PREFIXES.get(type(element).__name__, "")
    return {prefix + name: field for name, field in fields.items()}
