"""Typed answers: JSON out of whatever a model wrote around it, checked against a schema.

A schema is a dataclass, a mapping of field names to types, or a type such as `list[str]`. Models wrap JSON into prose,
fences and reasoning blocks, so every JSON value of the text is tried, outermost first, and the first one that fits the
schema is the answer. Nothing is converted silently except whole numbers where a float is asked for.

    parse = json_of({"keep": bool, "notes": list[str]})
    parse('Sure. ```json\\n{"keep": true, "notes": ["a"]}\\n```')   # {'keep': True, 'notes': ['a']}

An answer that is a list of operations need not be right as a whole: with `whole=False` the items of its lists that fit
are read where others do not (`Parser.salvage`). Lists in which the place counts, or of which one item makes sense only
with all others, are read whole.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import re
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from agentspec.visible import visible

T = TypeVar("T")

_STARTS = re.compile(r"[\[{]")
_MOST_STARTS = 64  # values tried in one text; a longer search only serves texts that are no answer
HUGE = 1e300
"""Numbers from here on are no answer to any question."""
THE_ANSWER = "the answer"

_NAMES = {str: "string", int: "whole number", float: "number", bool: "true or false", dict: "object", list: "list"}


class ParseError(ValueError):
    """A text that is no answer; the message says what was found and what is expected, in words for the model."""


@dataclass(frozen=True)
class Parser(Generic[T]):
    """How to read an answer, what to call a good one, and how often to ask again.

    Args:
        read: text -> value; raises `ParseError`.
        expected: what a good answer looks like, for the request to repair a bad one.
        repairs: further calls that may be made for an answer that cannot be read: 0 or 1.
        salvage: text that `read` refuses -> what of it can be used, and how many items were left out; raises
            `ParseError`. `None`: an answer is read whole or not at all.
    """

    read: Callable[[str], T]
    expected: str
    repairs: int = 1
    salvage: Callable[[str], tuple[T, int]] | None = None

    def __call__(self, text: str) -> T:
        return self.read(text)


def json_of(schema: Any, *, repairs: int = 1, whole: bool = True) -> Parser[Any]:
    """A parser of JSON answers.

    Args:
        schema: a dataclass (the value is an instance), a mapping of field name to type (the value is a dict), or a
            type. Types are `str`, `int`, `float`, `bool`, `list[X]`, `tuple[X, ...]`, `dict[str, X]`, `Literal[...]`,
            `X | None`, `Any`, dataclasses and mappings, nested as deep as wanted. Fields that the schema does not
            have are ignored; a dataclass's defaults fill in fields that are missing.
        repairs: see `Parser`.
        whole: whether one item that does not fit voids the answer; `False` only for a dataclass or mapping whose lists
            hold items that are of use without each other.
    """

    def read(text: str) -> Any:
        problem = "there is no JSON in it"
        for raw in _values(visible(text)[0]):
            try:
                return check(_replace_surrogates(raw) if "\\u" in text else raw, schema)
            except ParseError as error:
                if problem.startswith("there is no JSON"):
                    problem = str(error)
            except RecursionError:
                problem = "it is nested too deeply"
        raise ParseError(problem)

    def salvage(text: str) -> tuple[Any, int]:
        found: list[tuple[Any, int, int]] = []
        for raw in _values(visible(text)[0]):
            with contextlib.suppress(ParseError, RecursionError):
                found.append(_what_fits(_replace_surrogates(raw) if "\\u" in text else raw, schema))
        if not found:
            raise ParseError("nothing of it can be used")
        value, dropped, _ = max(reversed(found), key=lambda one: one[2])  # of several drafts the fullest, then the last
        return value, dropped

    return Parser(read, f"JSON of the form {describe(schema)}", repairs, None if whole else salvage)


def _what_fits(raw: Any, schema: Any) -> tuple[Any, int, int]:
    """The answer without the items of its lists that do not fit; how many these are, and how many fit; a null is none.

    Raises:
        ParseError: something else does not fit, or no item is left of an answer that is nothing but lists.
    """
    kinds = get_type_hints(schema) if dataclasses.is_dataclass(schema) else dict(schema)
    many = [name for name, kind in kinds.items() if get_origin(kind) in (list, tuple)]
    given = {k: [] if v is None and k in many else v for k, v in raw.items()} if isinstance(raw, dict) else {}
    lists = {
        name: get_args(kind)[0] for name, kind in kinds.items() if name in many and isinstance(given.get(name), list)
    }
    kept = {name: [item for item in given[name] if _fits(item, kind)] for name, kind in lists.items()}
    dropped = sum(len(given[name]) - len(items) for name, items in kept.items())
    if not any(kept.values()) and not kinds.keys() - lists.keys():
        raise ParseError("none of its items fits")
    return check({**given, **kept} if lists else raw, schema), dropped, sum(map(len, kept.values()))


def _fits(item: Any, kind: Any) -> bool:
    try:
        check(item, kind)
    except ParseError:
        return False
    return True


def _values(text: str) -> Iterator[Any]:
    """The JSON objects and lists of a text, outermost first; what lies inside a value is no value of its own.

    Strings may hold line breaks, which models write; halves of surrogate pairs, which no file or prompt can hold, are
    replaced.
    """
    decoder = json.JSONDecoder(strict=False)
    end = 0
    for number, match in enumerate(_STARTS.finditer(text)):
        if number >= _MOST_STARTS:
            return
        if match.start() < end:
            continue
        try:
            value, end = decoder.raw_decode(text, match.start())
        except (ValueError, RecursionError):
            continue
        yield value


def _replace_surrogates(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode("utf-8", "replace").decode()
    if isinstance(value, list):
        return [_replace_surrogates(v) for v in value]
    if isinstance(value, dict):
        return {_replace_surrogates(k): _replace_surrogates(v) for k, v in value.items()}
    return value


def check(value: Any, schema: Any, where: str = THE_ANSWER) -> Any:  # noqa: PLR0911, PLR0912  # one line per type
    """The JSON value as the schema has it.

    Raises:
        ParseError: naming the field, what is expected and what was found.
    """
    if isinstance(schema, Mapping):
        return _check_fields(value, schema, {}, where)
    if dataclasses.is_dataclass(schema) and isinstance(schema, type):
        hints = get_type_hints(schema)
        defaults = {f.name: f for f in dataclasses.fields(schema) if _has_default(f)}
        fields = {f.name: hints[f.name] for f in dataclasses.fields(schema) if f.init}
        given = _check_fields(value, fields, defaults, where)
        try:
            return schema(**given)
        except (TypeError, ValueError) as error:  # the class's own checks
            raise ParseError(f"{where}: {error}") from error
    origin, arguments = get_origin(schema), get_args(schema)
    if schema is Any:
        return value
    if origin in (Union, types.UnionType):
        return _check_union(value, arguments, where)
    if origin is Literal:
        if value in arguments and type(value) in {type(a) for a in arguments}:
            return value
    elif origin in (list, tuple, Sequence) and isinstance(value, list):
        items = [check(v, arguments[0], f"item {i + 1} of {where}") for i, v in enumerate(value)]
        return tuple(items) if origin is tuple else items
    elif origin in (dict, Mapping) and isinstance(value, dict):
        return {k: check(v, arguments[1], f"{k!r} of {where}") for k, v in value.items()}
    elif schema is float and isinstance(value, int | float) and not isinstance(value, bool):
        if abs(value) < HUGE:  # not so for NaN, infinity, and whole numbers that no float holds
            return float(value)
    elif schema in (None, type(None)):
        if value is None:
            return None
    elif schema is int:
        if isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63:  # what tables and arrays hold
            return value
    elif isinstance(schema, type) and isinstance(value, schema):
        return value
    raise ParseError(f"{where} must be {describe(schema)}, not {_shown(value)}")


def _check_union(value: Any, alternatives: Sequence[Any], where: str) -> Any:
    for alternative in alternatives:
        try:
            return check(value, alternative, where)
        except ParseError:
            continue
    raise ParseError(f"{where} must be {' or '.join(map(describe, alternatives))}, not {_shown(value)}")


def _check_fields(value: Any, fields: Mapping[str, Any], defaults: Mapping[str, Any], where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ParseError(f"{where} must be {describe(dict(fields))}, not {_shown(value)}")
    missing = [name for name in fields if name not in value and name not in defaults]
    if missing:
        raise ParseError(f"{where} lacks {', '.join(map(repr, missing))}")
    within = "" if where == THE_ANSWER else f" of {where}"
    return {name: check(value[name], kind, f"{name!r}{within}") for name, kind in fields.items() if name in value}


def _has_default(field: dataclasses.Field[Any]) -> bool:
    return field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING


def describe(schema: Any) -> str:  # noqa: PLR0911  # one line per type
    """The schema in words for a model.

    >>> describe({"keep": bool, "notes": list[str]})
    '{"keep": true or false, "notes": [string, ...]}'
    """
    if dataclasses.is_dataclass(schema) and isinstance(schema, type):
        hints = get_type_hints(schema)
        schema = {f.name: hints[f.name] for f in dataclasses.fields(schema) if f.init}
    if isinstance(schema, Mapping):
        return "{" + ", ".join(f'"{name}": {describe(kind)}' for name, kind in schema.items()) + "}"
    origin, arguments = get_origin(schema), get_args(schema)
    if origin in (Union, types.UnionType):
        return " or ".join(map(describe, arguments))
    if origin is Literal:
        return " or ".join(json.dumps(a) for a in arguments)
    if origin in (list, tuple, Sequence):
        return f"[{describe(arguments[0])}, ...]"
    if origin in (dict, Mapping):
        return f"{{name: {describe(arguments[1])}, ...}}"
    if schema in (None, type(None)):
        return "null"
    return _NAMES.get(schema, "any value")


def _shown(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 60 else text[:57] + "..."
