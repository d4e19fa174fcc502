"""The language of actions: one call with literal arguments, `MOVE(12.5m, -3m, pace="accel")`.

`scan_call` finds where a call ends, `parse_call` reads it, `render_call` writes one. Names are matched without case,
through the schema's aliases, and whatever joins their words (`view orders`, `view-orders`). Numbers followed by a unit
of the schema are multiplied by its factor. Arguments are read by Python's own expression parser restricted to literals;
nothing is ever evaluated. What chat models get wrong about literals is understood: words without quotes, `name: value`,
`true` and `null`.
"""

from __future__ import annotations

import ast
import difflib
import functools
import itertools
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from agentspec.types import Action, ActionError, ActionSchema

MAX_LENGTH = 4000
"""Longer calls are refused: no action is this long, and deeply nested input must not reach the parser."""

_QUOTED = re.compile(r"(\"(?:\\.|[^\"\\])*\"|'(?:\\.|[^'\\])*')", re.DOTALL)
_WORDS_ALONE = re.compile(r"\s*[A-Za-z][^\"'()\[\]{}=\n]*[ :;>][^\"'()\[\]{}=\n]*\w\s*")
_PERCENT = re.compile(r"(?<=\d)\s?%(?=\s*(?:,|$))")
_COLON = re.compile(r"(^|[(,]\s*)([A-Za-z_]\w*)\s*:\s*")
_OPENING, _CLOSING = {"(": ")", "[": "]", "{": "}"}, frozenset(")]}")
_NUMBERS = ("int", "float")
_MANY = ("list", "any")
_WORDS = {"true": True, "false": False, "none": None, "null": None}


@dataclass(frozen=True)
class Call:
    """A call found in a text: its name and arguments as written, and the offset after its closing bracket."""

    name: str
    arguments: str
    text: str
    end: int


def suggest(name: str, known: Iterable[Any]) -> str:
    """`"; did you mean A, B?"` for the nearest known names, or the list of all when none is near."""
    names = [str(k) for k in known]
    lowered = {k.casefold(): k for k in names}
    near = [lowered[k] for k in difflib.get_close_matches(name.casefold(), list(lowered), n=3, cutoff=0.6)]
    if near:
        return f"; did you mean {', '.join(near)}?"
    return f"; known: {', '.join(sorted(names))}"


def known_name(name: str, schema: ActionSchema) -> str | None:
    """The canonical name that `name` stands for, up to case, joining signs and a prefix (`functions.MOVE`)."""
    found = _names(schema).get(_squash(name))
    prefix, _, last = name.rpartition(".")
    return found or (None if " " in prefix.strip() else _names(schema).get(_squash(last)))


def _names(schema: ActionSchema) -> dict[str, str]:
    return _squashed(tuple(schema.actions), tuple(schema.aliases.items()))


@functools.lru_cache(maxsize=32)
def _squashed(names: tuple[str, ...], aliases: tuple[tuple[str, str], ...]) -> dict[str, str]:
    return {_squash(alias): name for alias, name in aliases} | {_squash(name): name for name in names}


def _squash(name: str) -> str:
    return re.sub(r"[\s_\-]+", "", name).upper()


def scan_arguments(text: str, start: int) -> int | None:
    """Offset after the bracket that closes the one at `start`; `None` if it is never closed (or after 4000 signs)."""
    stack: list[str] = []
    quote = ""
    i, limit = start, min(len(text), start + MAX_LENGTH)
    while i < limit:
        sign = text[i]
        if quote:
            if sign == "\\":
                i += 1
            elif sign == quote:
                quote = ""
        elif sign == '"' or (sign == "'" and not text[i - 1].isalnum()):
            quote = sign
        elif sign in _OPENING:
            stack.append(_OPENING[sign])
        elif sign in _CLOSING:
            if stack.pop() != sign:
                return None
            if not stack:
                return i + 1
        i += 1
    return None


def scan_call(text: str, name: re.Match[str]) -> Call | None:
    """The call whose name and opening bracket `name` matched (group 1: the name); `None` if it is not closed."""
    end = scan_arguments(text, name.end() - 1)
    if end is None:
        return None
    return Call(name.group(1), text[name.end() : end - 1], text[name.start(1) : end], end)


def parse_call(call: Call, schema: ActionSchema) -> Action | ActionError:
    """Read a call; only the form of its arguments is judged, their values are the environment's affair."""
    name = known_name(call.name, schema)
    if name is None:
        problem = f"there is no action {call.name.upper()}{suggest(call.name, schema.actions)}"
        return ActionError("PARSE_UNKNOWN", problem, call.text[:200])
    try:
        attached = call.text[len(call.name) :].startswith("(")
        arguments = _quoted_alone(call.arguments, name, schema) if attached else call.arguments
        args, kwargs = _fitted(*_arguments(arguments, schema), name, schema)
    except (SyntaxError, ValueError, TypeError, RecursionError, MemoryError) as error:
        example = schema.actions[name].example or name
        reason = error.msg if isinstance(error, SyntaxError) else error
        return ActionError(
            "PARSE_ARGS", f"the arguments of {name} cannot be read ({reason}); write {example}", call.text[:200]
        )
    return Action(name, args, kwargs, call.text)


def render_call(name: str, args: Iterable[Any], kwargs: Mapping[str, Any], schema: ActionSchema) -> str:
    """The call as text. Strings that hold a number (with or without a unit) are written without quotes."""
    parts = [_shown(value, schema) for value in args]
    parts += [f"{key}={_shown(value, schema)}" for key, value in kwargs.items()]
    return f"{name}({', '.join(parts)})"


def _shown(value: Any, schema: ActionSchema) -> str:
    if isinstance(value, str):
        units = "|".join(re.escape(u) for u in schema.units)
        if re.fullmatch(rf"\s*[-+]?(\d+(\.\d*)?|\.\d+)\s*({units})?\s*", value):
            return value.strip()
        return json.dumps(value, ensure_ascii=False)
    return repr(value)


def _quoted_alone(arguments: str, name: str, schema: ActionSchema) -> str:
    """The arguments; words without quotes get them where the action takes one text: `PICKUP(apple 1)`."""
    known = schema.actions[name].parameters
    only = next(iter(known), "")
    named = re.match(rf"\s*{only}\s*[:=]\s*", arguments)
    words = arguments[named.end() :] if named else arguments
    if len(known) != 1 or known[only].type != "str" or not _WORDS_ALONE.fullmatch(words):
        return arguments
    return f"{only}={json.dumps(words.strip())}" if named else json.dumps(words.strip())


def _arguments(text: str, schema: ActionSchema) -> tuple[tuple[Any, ...], dict[str, Any]]:
    text = _apply_units(_outside_quotes(text.strip(), lambda part: _PERCENT.sub("", part)), schema)
    try:
        tree = ast.parse(f"f({text})", mode="eval").body
    except SyntaxError:
        named = _outside_quotes(text, lambda part: _COLON.sub(r"\1\2=", part))
        tree = ast.parse(f"f({named})", mode="eval").body
    if not isinstance(tree, ast.Call) or not isinstance(tree.func, ast.Name):
        raise ValueError("not a list of arguments")
    args = tuple(literal(node) for node in tree.args)
    kwargs: dict[str, Any] = {}
    for keyword in tree.keywords:
        if keyword.arg is None:
            raise ValueError("** is not allowed")
        kwargs[keyword.arg] = literal(keyword.value)
    return args, kwargs


def _fitted(
    args: tuple[Any, ...], kwargs: dict[str, Any], name: str, schema: ActionSchema
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """The arguments, with a point given as one value taken apart where the action takes its numbers one by one:
    `MOVE((3, 4))`, `MOVE(to=[3, 4])`, `MOVE({"x": 3, "y": 4})`.

    Raises:
        ValueError: a list or an object stands where a number or a word must, or a number of a point is missing.
    """
    parameters = schema.actions[name].parameters
    point = list(itertools.takewhile(lambda p: parameters[p].required and parameters[p].type in _NUMBERS, parameters))
    if len(point) > 1:
        args, kwargs = _taken_apart(args, kwargs, point, parameters, schema)
        missing = [p for p in point[len(args) :] if p not in kwargs]
        if missing:
            raise ValueError(f"it needs {' and '.join(missing)}")
    if len(parameters) == 1 and len(args) > 1 and not kwargs and parameters[next(iter(parameters))].type in _MANY:
        args = (list(args),)  # ACCEPT_ORDER(3, 7)
    for p, value in (*zip(parameters, args, strict=False), *kwargs.items()):
        if p in parameters and parameters[p].type in _NUMBERS and isinstance(value, str):
            _number(value, p, schema)
    single = {p for p, known in parameters.items() if known.type in _NUMBERS or known.enum}
    names = itertools.chain(parameters, itertools.repeat(""))
    return (
        tuple(_alone(value, p) if p in single else value for value, p in zip(args, names, strict=False)),
        {p: _alone(value, p) if p in single else value for p, value in kwargs.items()},
    )


def _number(text: str, name: str, schema: ActionSchema) -> float:
    """The number that a text holds, with a unit or without.

    Raises:
        ValueError: it holds none.
    """
    try:
        return float(_apply_units(text.strip(), schema))
    except ValueError:
        raise ValueError(f"{name} must be a number, not {text[:40]!r}") from None


def _taken_apart(
    args: tuple[Any, ...], kwargs: dict[str, Any], point: list[str], known: Mapping[str, Any], schema: ActionSchema
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """A point in the first argument, or in the only one of a name that the action does not know, as its numbers."""
    loose = [key for key, value in kwargs.items() if key not in known and isinstance(value, list | dict)]
    given = args[0] if args else kwargs[loose[0]] if len(loose) == 1 else None
    if isinstance(given, dict):
        given = [{str(key).casefold(): value for key, value in given.items()}.get(p) for p in point]
    if not isinstance(given, list) or len(given) != len(point) or None in given or set(point) & set(kwargs):
        return args, kwargs
    numbers = [_number(v, p, schema) if isinstance(v, str) else v for v, p in zip(given, point, strict=True)]
    return (*numbers, *args[1:]), kwargs if args else {k: v for k, v in kwargs.items() if k != loose[0]}


def _alone(value: Any, name: str) -> Any:
    """A list of one value as that value."""
    while isinstance(value, list) and len(value) == 1:
        value = value[0]
    if isinstance(value, list | dict):
        raise ValueError(f"{name} must be one value, not {str(value)[:40]}")
    return value


def _apply_units(text: str, schema: ActionSchema) -> str:
    """Multiply every `number unit` outside quotes by the unit's factor."""
    if not schema.units:
        return text
    pattern = _unit_pattern(tuple(schema.units))
    return _outside_quotes(
        text, lambda part: pattern.sub(lambda m: repr(float(m.group(1)) * schema.units[m.group(2)]), part)
    )


def _outside_quotes(text: str, change: Any) -> str:
    parts = _QUOTED.split(text)
    parts[::2] = [change(part) for part in parts[::2]]
    return "".join(parts)


@functools.lru_cache(maxsize=32)
def _unit_pattern(units: tuple[str, ...]) -> re.Pattern[str]:
    """A number that is not part of a word, followed by one of `units`."""
    names = "|".join(re.escape(u) for u in sorted(units, key=len, reverse=True))
    return re.compile(rf"(?<![\w.])(\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|\.\d+)\s*({names})\b")


def literal(node: ast.AST) -> Any:
    """The value of a literal expression: constants, signed numbers, containers, joined strings, bare words.

    Raises:
        ValueError: anything else.
    """
    if isinstance(node, ast.Constant) and isinstance(node.value, (int, float, str, bool, type(None))):
        return node.value
    if isinstance(node, ast.Name) and not node.id.startswith("__"):
        return _WORDS.get(node.id.casefold(), node.id)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
        value = literal(node.operand)
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            return -value if isinstance(node.op, ast.USub) else value
    if isinstance(node, (ast.List, ast.Tuple, ast.Set)):
        return [literal(item) for item in node.elts]
    if isinstance(node, ast.Dict) and all(key is not None for key in node.keys):
        pairs = zip([k for k in node.keys if k is not None], node.values, strict=True)
        return {literal(k): literal(v) for k, v in pairs}
    if isinstance(node, ast.BinOp) and isinstance(node.op, (ast.Add, ast.Sub)):
        left, right = literal(node.left), literal(node.right)
        if isinstance(left, str) and isinstance(right, str):
            # "ab" + "cd" is one text; e-scooter without quotes is one word.
            return left + right if isinstance(node.op, ast.Add) else f"{left}-{right}"
    raise ValueError(f"only literal values are allowed, not {type(node).__name__}")
