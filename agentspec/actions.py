"""Text -> :class:`~agentspec.types.Action`, without ever raising.

The language is that of function calls with literal arguments: ``MOVE(12.5m, -3m, pace="accel")``. A model may wrap the
call in a Markdown fence or in JSON (``{"action": "MOVE(...)"}``) and may end it with punctuation. Names are matched
without case and through the schema's aliases. Numbers followed by a unit of the schema are multiplied by its factor.
Arguments are read by Python's own expression parser restricted to literals; nothing is ever evaluated. A text that is
no action becomes an :class:`~agentspec.types.ActionError` whose message tells the agent what to write instead.
"""

from __future__ import annotations

import ast
import difflib
import functools
import json
import re
from typing import Any

from agentspec.types import Action, ActionError, ActionSchema

MAX_LENGTH = 4000
"""Longer texts are refused: no action is this long, and deeply nested input must not reach the parser."""

_CALL = re.compile(r"\s*([A-Za-z_][A-Za-z0-9_]*)\s*\((.*)\)\s*", re.DOTALL)
_FENCE = re.compile(r"^```[A-Za-z]*[ \t]*\n(.*?)\n?```$", re.DOTALL)
_TRAILING = " \t\r\n;.,!?:；。，！？：、"
_QUOTED = re.compile(r"(\"(?:\\.|[^\"\\])*\"|'(?:\\.|[^'\\])*')", re.DOTALL)


def unwrap(text: str) -> str:
    """The action call inside ``text``: fence stripped, JSON opened, first line, trailing punctuation removed."""
    text = text.strip()
    fenced = _FENCE.match(text)
    if fenced:
        text = fenced.group(1).strip()
    if text.startswith("{"):
        call = _from_json(text)
        if call is not None:
            return call.strip().rstrip(_TRAILING)
    first_line = text.splitlines()[0] if text else ""
    return first_line.strip().rstrip(_TRAILING)


def _from_json(text: str) -> str | None:
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(data, dict):
        return None
    action = data.get("action", data.get("action_call"))
    if isinstance(action, dict):
        action = action.get("action_call")
    return action if isinstance(action, str) else None


def parse_action(text: str, schema: ActionSchema) -> Action | ActionError:
    """Parse ``text`` against ``schema``; never raises.

    With ``schema.choices`` a text that is one of the choices (up to case and surrounding space) is the action of that
    text; anything else is still tried as a call. Argument *values* are the environment's to judge; here only the form
    is checked: a known name, literal arguments, no unknown or missing parameter.
    """
    if len(text) > MAX_LENGTH:
        return ActionError(
            "PARSE_TOO_LONG", f"the answer has {len(text)} characters; write one action only", text[:200]
        )
    choice = _match_choice(text, schema)
    if choice is not None:
        return Action(choice, text=choice)
    call = unwrap(text)
    match = _CALL.fullmatch(call)
    if match is None:
        return ActionError("PARSE_NOT_CALL", _not_a_call(call, schema), text)
    name = match.group(1).upper()
    name = schema.aliases.get(name, name)
    spec = schema.actions.get(name)
    if spec is None:
        return ActionError("PARSE_UNKNOWN", f"there is no action {name}{suggest(name, schema.actions)}", text)
    try:
        args, kwargs = _arguments(match.group(2), schema)
    except (SyntaxError, ValueError, TypeError, RecursionError, MemoryError) as error:
        return ActionError(
            "PARSE_ARGS", f"the arguments of {name} cannot be read ({error}); write {spec.example}", text
        )
    return Action(name, args, kwargs, call)


def _match_choice(text: str, schema: ActionSchema) -> str | None:
    if not schema.choices:
        return None
    wanted = " ".join(text.split()).casefold()
    return next((c for c in schema.choices if c.casefold() == wanted), None)


def _not_a_call(call: str, schema: ActionSchema) -> str:
    if schema.choices:
        shown = "; ".join(schema.choices[:6])
        return f"{call[:60]!r} is not one of the listed actions; answer with one of them, word for word: {shown}"
    names = ", ".join(schema.actions)
    return f"{call[:60]!r} is not an action; answer with one call NAME(arguments), NAME one of: {names}"


def suggest(name: str, known: Any) -> str:
    """``"; did you mean A, B?"`` for the nearest known names, or the list of all when none is near."""
    names = [str(k) for k in known]
    lowered = {k.casefold(): k for k in names}
    near = [lowered[k] for k in difflib.get_close_matches(name.casefold(), list(lowered), n=3, cutoff=0.6)]
    if near:
        return f"; did you mean {', '.join(near)}?"
    return f"; known: {', '.join(sorted(names))}"


def _arguments(text: str, schema: ActionSchema) -> tuple[tuple[Any, ...], dict[str, Any]]:
    tree = ast.parse(f"f({_apply_units(text, schema)})", mode="eval").body
    if not isinstance(tree, ast.Call) or not isinstance(tree.func, ast.Name):
        raise ValueError("not a list of arguments")
    args = tuple(_literal(node) for node in tree.args)
    kwargs: dict[str, Any] = {}
    for keyword in tree.keywords:
        if keyword.arg is None:
            raise ValueError("** is not allowed")
        kwargs[keyword.arg] = _literal(keyword.value)
    return args, kwargs


def _apply_units(text: str, schema: ActionSchema) -> str:
    """Multiply every ``number unit`` outside quotes by the unit's factor."""
    if not schema.units:
        return text
    pattern = _unit_pattern(tuple(schema.units))
    parts = _QUOTED.split(text)
    parts[::2] = [pattern.sub(lambda m: repr(float(m.group(1)) * schema.units[m.group(2)]), p) for p in parts[::2]]
    return "".join(parts)


@functools.lru_cache(maxsize=32)
def _unit_pattern(units: tuple[str, ...]) -> re.Pattern[str]:
    """A number that is not part of a word, followed by one of ``units``."""
    names = "|".join(re.escape(u) for u in sorted(units, key=len, reverse=True))
    return re.compile(rf"(?<![\w.])(\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|\.\d+)\s*({names})\b")


def _literal(node: ast.AST) -> Any:
    """The value of a literal expression: constants, signed numbers, containers, joined strings."""
    if isinstance(node, ast.Constant) and isinstance(node.value, (int, float, str, bool, type(None))):
        return node.value
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
        value = _literal(node.operand)
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            return -value if isinstance(node.op, ast.USub) else value
    if isinstance(node, (ast.List, ast.Tuple)):
        return [_literal(item) for item in node.elts]
    if isinstance(node, ast.Dict) and all(key is not None for key in node.keys):
        pairs = zip([k for k in node.keys if k is not None], node.values, strict=True)
        return {_literal(k): _literal(v) for k, v in pairs}
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        left, right = _literal(node.left), _literal(node.right)
        if isinstance(left, str) and isinstance(right, str):
            return left + right
    raise ValueError(f"only literal values are allowed, not {type(node).__name__}")
