"""Actions that come as data: JSON objects and the tool-call forms of chat models, turned into the text of one call.

Understood are `{"action": "NAME(args)"}`, `{"action": "NAME", "args": {...}}` (or a list, or the parameters beside it),
`{"name": ..., "arguments": ...}` and what OpenAI, Hermes, Mistral and LangChain wrap around it, `{"NAME": {...}}`, and
the tags `<function=NAME>`, `<invoke name="NAME">`. A list of calls means its first.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from agentspec.literals import MAX_LENGTH, known_name, literal, render_call, scan_arguments
from agentspec.types import ActionSchema

WRAPPERS = ("tool_calls", "tool_call", "function_call", "function", "call", "actions")
NAMES = (
    "action",
    "action_call",
    "next_action",
    "final_action",
    "command",
    "tool",
    "tool_name",
    "action_name",
    "name",
    "type",
)
ARGUMENTS = (
    "args",
    "arguments",
    "parameters",
    "params",
    "kwargs",
    "tool_input",
    "action_input",
    "action_args",
    "input",
)
ASIDE = re.compile(
    r"(?:last|previous|prev|past|old|failed|rejected|considered|not|invalid)(?:_\w+)?|history|alternatives?|options?|"
    r"candidates?|examples?|observations?|memory|plan|future_plan|next_actions",
    re.IGNORECASE,
)
"""Keys beside or around an action whose values are not the one that is meant."""
THOUGHTS = ("thought", "thoughts", "reasoning", "rationale", "explanation", "analysis", "reason")
PLANS = ("plan", "future_plan")
MAX_PLAN = 500
"""Signs of a plan that are kept."""
MOST_OBJECTS = 16
"""Opening brackets that are tried before a text is taken to hold no data."""

_COMMENT = re.compile(r"[ \t]+//[^\n\"]*$", re.MULTILINE)
_FUNCTION = re.compile(
    r"<function=([\w.\-]+)>|<invoke\s+name=[\"']([\w.\-]+)[\"']\s*>|\bto=functions\.([\w\-]+)[^{}\n]*"
    r"|<tool_call>\s*([\w.\-]+)\s*(?=<arg_key>)|\[TOOL_CALLS\]\s*([\w.\-]+)\[ARGS\]"
    r"|<｜tool▁call▁begin｜>(?:function<｜tool▁sep｜>)?([\w.\-]+)|\bfunctions\.([\w\-]+):\d+"
)
_PARAMETER = re.compile(
    r"<(?:parameter(?:=([\w\-]+)|\s+name=[\"']([\w\-]+)[\"'])\s*|arg_key>\s*([\w\-]+)\s*</arg_key>\s*<arg_value)>"
    r"\s*(.*?)\s*</(?:parameter|arg_value)>",
    re.DOTALL | re.IGNORECASE,
)


@dataclass(frozen=True)
class Shape:
    """An action found as data: the text of its call (or of a menu entry), where it begins, and a thought beside it."""

    text: str
    start: int
    thought: str = ""


def find_shape(text: str, schema: ActionSchema, start: int = 0, *, loose: bool = True) -> Shape | None:
    """The first action given as data in `text` from `start` on; `loose`: also the only action that data hold anywhere,
    under whatever key.
    """
    tag = _FUNCTION.search(text, start)
    tagged = _from_tag(text, tag, schema) if tag else None
    tried, end = 0, start
    for match in re.finditer(r"[{\[]", text[start:]):
        at, tried = start + match.start(), tried + 1
        if (tagged and at > tagged.start) or tried > MOST_OBJECTS:
            break
        if at < end:
            continue  # within data whose only action, if any, was looked for
        data, after = _decode(text, at)
        if not isinstance(data, dict | list):
            continue
        found = from_data(data, schema) or _within(data, schema, loose=loose)
        if found is not None:
            return Shape(found, at, _thought(data))
        end = after
    return tagged


def without_data(text: str) -> str:
    """`text` without the JSON objects that begin its lines: what is told in one is no action beside it."""
    kept, at, tried = [], 0, 0
    for match in re.finditer(r"^[ \t`]*(?=\{)", text, re.MULTILINE):
        tried += 1
        if match.end() < at or tried > MOST_OBJECTS:
            continue
        data, after = _decode(text, match.end())
        if isinstance(data, dict) and data and all(isinstance(key, str) for key in data):
            kept.append(text[at : match.end()])
            at = after
    return "".join([*kept, text[at:]])


def _within(data: Any, schema: ActionSchema, *, loose: bool) -> str | None:
    """The only action inside `data` that names none itself; `None` if there is none, or if there are several."""
    found: list[str] = []
    waiting = [data]
    while waiting and len(found) < 2:
        value = waiting.pop(0)
        inner = from_data(value, schema) if isinstance(value, dict) and value is not data else None
        if inner is None and loose and isinstance(value, str) and _is_action(value, schema):
            inner = value.strip()
        if inner is not None:
            found += [inner] if inner not in found else []
        elif isinstance(value, dict):
            aside = (*THOUGHTS, *PLANS)
            waiting += [v for k, v in value.items() if not ASIDE.fullmatch(str(k)) and str(k).casefold() not in aside]
        elif isinstance(value, list):
            waiting += value
    return found[0] if len(found) == 1 else None


def _is_action(text: str, schema: ActionSchema) -> bool:
    """Whether `text` is one call, or an entry of the menu, and nothing else."""
    text = text.strip()
    call = re.match(r"([A-Za-z_][\w.]{0,60})\(", text)
    known = call is not None and known_name(call.group(1), schema) is not None
    return text in schema.choices or (known and call is not None and scan_arguments(text, call.end() - 1) == len(text))


def plan_of(text: str) -> str:
    """The plan beside an action, as in `{"action": "WAIT(60)", "plan": "then fetch order 3"}`; "" where there is none.

    `future_plan`, as DeliveryBench's own answers call it, and a list of steps will do.
    """
    start, end = text.find("{"), text.rfind("}")
    if not 0 <= start < end or not any(f'"{key}"' in text for key in PLANS):
        return ""
    try:
        data = json.loads(text[start : end + 1])
    except (ValueError, RecursionError):
        return ""
    plan = next((data[key] for key in PLANS if data.get(key)), "") if isinstance(data, dict) else ""
    if isinstance(plan, list):
        plan = "; ".join(step for step in plan if isinstance(step, str))
    return " ".join(plan.split())[:MAX_PLAN] if isinstance(plan, str) else ""


def _from_tag(text: str, tag: re.Match[str], schema: ActionSchema) -> Shape | None:
    name = known_name(next(g for g in tag.groups() if g), schema)
    if name is None:
        return None
    rest = (
        text[tag.end() : tag.end() + MAX_LENGTH].split("</function>", maxsplit=1)[0].split("</invoke>", maxsplit=1)[0]
    )
    kwargs: dict[str, Any] = {a or b or c: _scalar(value) for a, b, c, value in _PARAMETER.findall(rest)}
    brace = rest.find("{")
    data = _decode(rest, brace)[0] if not kwargs and brace >= 0 else None
    return Shape(_build(name, data if isinstance(data, dict) else kwargs, schema), tag.start())


def _scalar(text: str) -> Any:
    """A parameter between tags: JSON where it is a list or an object, otherwise the text itself."""
    if text[:1] in "[{":
        data = _decode(text, 0)[0]
        return text if data is None else data
    return text


def _decode(text: str, at: int) -> tuple[Any, int]:
    """The JSON (or Python) data that begins at offset `at`, and where it ends; `None` if it cannot be read."""
    try:
        data, end = json.JSONDecoder().raw_decode(text, at)
        return data, end
    except (ValueError, RecursionError):
        pass
    after = scan_arguments(text, at)
    if after is None:
        return None, at
    try:
        return literal(ast.parse(_COMMENT.sub("", text[at:after]), mode="eval").body), after
    except (SyntaxError, ValueError, TypeError, RecursionError, MemoryError):
        return None, at


def from_data(data: Any, schema: ActionSchema, depth: int = 0) -> str | None:  # noqa: PLR0911  # one line per shape
    """The text of the action that `data` stands for, or `None`."""
    if depth > 4 or not data:
        return None
    if isinstance(data, list):
        if isinstance(data[0], str) and depth:
            name = None if data[0] in schema.choices else known_name(data[0], schema)
            if name is not None:
                return _build(name, data[1:] if not isinstance(data[-1], str) else [], schema)
            return data[0] if "(" in data[0] or data[0] in schema.choices else None
        return from_data(data[0], schema, depth + 1) if isinstance(data[0], dict | list) else None
    if not isinstance(data, Mapping):
        return None
    keys = {str(key).casefold(): value for key, value in data.items()}
    for key in (*WRAPPERS, *NAMES):
        value = keys.get(key)
        if isinstance(value, dict | list):
            found = from_data(value, schema, depth + 1)
            if found is not None:
                return found
        elif isinstance(value, str) and (found := _named(key, value, keys, schema)) is not None:
            return found
    if len(data) == 1:
        ((only, value),) = data.items()
        name = known_name(str(only), schema)
        if name is not None:
            return _build(name, value, schema)
    return None


def _named(key: str, value: str, keys: Mapping[str, Any], schema: ActionSchema) -> str | None:
    """The action named by `value` under `key`, with its arguments from beside it."""
    value = value.strip()
    name = known_name(value, schema)
    if name is None or value.casefold() in map(str.casefold, schema.choices):
        # A whole call, a menu entry, or what shall be reported as unknown; a bare "name" may be anything's.
        return value or None if key not in ("name", "call", "function", "type") or "(" in value else None
    given = next((keys[a] for a in ARGUMENTS if a in keys), None)
    if given is None:
        known = {p.casefold(): p for p in schema.actions[name].parameters}
        given = {known[k]: v for k, v in keys.items() if k in known and k != key}
    if isinstance(given, str):
        decoded = _decode(given.strip(), 0)[0] if given.strip()[:1] in ("{", "[") else None
        if decoded is None and given.strip():
            return f"{name}({given.strip()})"
        given = decoded
    return _build(name, given, schema)


def _build(name: str, given: Any, schema: ActionSchema) -> str:
    if isinstance(given, Mapping):
        return render_call(name, (), {str(k): v for k, v in given.items() if str(k).isidentifier()}, schema)
    if isinstance(given, list):
        alone = len(schema.actions[name].parameters) == 1 and len(given) > 1
        return render_call(name, (given,) if alone else given, {}, schema)
    return render_call(name, () if given is None else (given,), {}, schema)


def _thought(data: Any) -> str:
    if not isinstance(data, Mapping):
        return ""
    return next((str(v) for k, v in data.items() if str(k).casefold() in THOUGHTS and isinstance(v, str)), "")
