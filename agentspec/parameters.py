"""Presets and parameter checks of modules: what a module's constructor may be given, and what it makes of it."""

from __future__ import annotations

import inspect
import math
import types
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from agentspec.actions import suggest
from agentspec.registry import SpecError


def settings(method: str, presets: Mapping[str, Mapping[str, Any]], preset: str, given: Mapping[str, Any]) -> Any:
    """The parameters of `preset`, replaced by those that were given (are not `None`).

    Raises:
        SpecError: no such preset.
    """
    if preset not in presets:
        raise SpecError(f"{method} has no preset {preset!r}{suggest(str(preset), presets)}")
    chosen = dict(presets[preset])
    for name, value in given.items():
        if value is not None:
            chosen[name] = value
    return chosen


def at_least(method: str, lowest: int, **values: int | None) -> None:
    """Refuse counts that are too small (`None` is no limit).

    Raises:
        SpecError: naming the parameter.
    """
    for name, value in values.items():
        if value is not None and value < lowest:
            raise SpecError(f"{method}: {name} must be at least {lowest}, got {value}")


def one_of(method: str, **values: tuple[str, tuple[str, ...]]) -> None:
    """Refuse a value that is none of its alternatives: `name=(value, alternatives)`.

    Raises:
        SpecError: naming the parameter and what it may be.
    """
    for name, (value, allowed) in values.items():
        if value not in allowed:
            raise SpecError(f"{method}: {name} must be one of {', '.join(allowed)}; got {value!r}")


def without_effect(method: str, needed: str, **given: bool) -> None:
    """Refuse parameters that were given although they would change nothing: `name=whether it was given`.

    Args:
        method: the module.
        needed: what they need to have an effect, as it is written in a spec.
        given: parameter -> whether it differs from its default.

    Raises:
        SpecError: naming them and what they need.
    """
    idle = [name for name, is_given in given.items() if is_given]
    if idle:
        raise SpecError(f"{method}: {', '.join(idle)} would change nothing without {needed}; add it, or leave them out")


def parameters_of(target: Any) -> list[str]:
    """Names of the keyword parameters of a module class (`services` is the scaffold's)."""
    return [p for p in inspect.signature(target).parameters if p != "services"]


def check_parameters(where: str, target: Any, params: Mapping[str, Any]) -> None:
    """Refuse parameters that a class does not take, or takes as another type, and numbers that mean nothing.

    No number is NaN, no `*tokens` is negative, no `*temperature` negative or infinite; other ranges are the class's.

    Raises:
        SpecError: naming the parameter, with the nearest known ones or the type expected.
    """
    accepted = parameters_of(target)
    for key in params:
        if key not in accepted:
            raise SpecError(f"{where} has no parameter {key!r}{suggest(str(key), accepted)}")
    check_types(where, target.__init__ if inspect.isclass(target) else target, params)
    for key, value in params.items():
        if isinstance(value, int | float):
            if math.isnan(value) or (key.endswith("temperature") and not 0 <= value < math.inf):
                raise SpecError(f"{where}: {key} is {value}; expected a finite number of at least 0")
            if key.endswith("tokens") and value < 0:
                raise SpecError(f"{where}: {key} is {value}; expected at least 0")


def check_types(where: str, annotated: Any, values: Mapping[str, Any]) -> None:
    """Refuse values whose annotation says otherwise.

    Args:
        where: what the values belong to.
        annotated: a function or class with annotations; those that cannot be resolved are not checked.
        values: name -> value, as read from YAML.

    Raises:
        SpecError: naming the value, its type and the type expected.
    """
    try:
        hints = get_type_hints(annotated)
    except NameError:
        return
    for name, value in values.items():
        if name in hints and not fits(value, hints[name]):
            raise SpecError(f"{where}: {name} must be {_named(hints[name])}, got {value!r}")


def fits(value: Any, kind: Any) -> bool:  # noqa: PLR0911  # one line per type
    """Whether a value read from YAML is of a type; types that YAML cannot express are taken on trust.

    >>> fits(3, float), fits(True, int), fits([1, "a"], list[int]), fits(None, int | None)
    (True, False, False, True)
    """
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return any(fits(value, a) for a in arguments)
    if origin is Literal:
        return any(value == a and type(value) is type(a) for a in arguments)
    if origin in (list, tuple, set, frozenset, Sequence):
        items = [a for a in arguments if a is not Ellipsis]
        return isinstance(value, list | tuple) and (not items or all(any(fits(v, a) for a in items) for v in value))
    if origin in (dict, Mapping) or kind in (dict, Mapping):
        return isinstance(value, Mapping)
    if kind is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if kind in (str, bool, type(None)):
        return isinstance(value, kind)
    return True


def _named(kind: Any) -> str:
    names = {int: "a whole number", float: "a number", str: "a text", bool: "true or false", type(None): "null"}
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return " or ".join(map(_named, arguments))
    if origin is Literal:
        return " or ".join(map(repr, arguments))
    if origin in (list, tuple, Sequence):
        return "a list"
    if origin in (dict, Mapping):
        return "a mapping"
    return names.get(kind, str(kind))
