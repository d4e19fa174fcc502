"""Text -> `Action`, without ever raising, and when two actions are the same.

`parse_action` is what environments call on the text they are given and methods on what a model wrote: both read by the
same rules (`agentspec.reading`), so that an answer means the same to the one who asked for it and to the one who
executes it. `canonical` compares actions by what they do: names and defaults filled in, numbers rounded to the
environment's resolution.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

from agentspec.literals import MAX_LENGTH, suggest
from agentspec.reading import read
from agentspec.types import Action, ActionError, ActionSchema, Parameter

__all__ = ["MAX_LENGTH", "canonical", "parse_action", "same_action", "suggest"]


def parse_action(text: str, schema: ActionSchema) -> Action | ActionError:
    """The action that `text` means; never raises.

    With `schema.choices` one of the choices is the action of that text; anything else is still tried as a call.
    Argument *values* are the environment's to judge; here only the form is: a known name and literal arguments.
    """
    return read(text, schema).action


def canonical(action: Action, schema: ActionSchema) -> Hashable:
    """Equal for actions that do the same, however they were written.

    Positional arguments get their parameter's name, omitted ones its `default`; numbers are rounded to its `resolution`
    (60 equals 60.0), texts lose case and outer space, and a single value equals the list of it where a list may stand
    (`type` list or any).
    """
    spec = schema.actions.get(action.name)
    if spec is None:
        return (action.name.casefold(), tuple(map(_plain, action.args)), _sorted(action.kwargs))
    names = list(spec.parameters)
    arguments: dict[str, Any] = {str(names[i] if i < len(names) else i): a for i, a in enumerate(action.args)}
    arguments |= action.kwargs
    for name, parameter in spec.parameters.items():
        if arguments.get(name) is None:
            arguments[name] = parameter.default
        if arguments[name] is None:
            del arguments[name]
        else:
            arguments[name] = _value(arguments[name], parameter)
    return (action.name.casefold(), tuple(sorted((k, _plain(v)) for k, v in arguments.items())))


def same_action(one: Action | ActionError, other: Action | ActionError, schema: ActionSchema) -> bool:
    """Whether both are actions and do the same."""
    if not isinstance(one, Action) or not isinstance(other, Action):
        return False
    return canonical(one, schema) == canonical(other, schema)


def _value(value: Any, parameter: Parameter) -> Any:
    if isinstance(value, str) and parameter.type in ("int", "float"):
        try:
            value = float(value)
        except ValueError:
            return value
    if isinstance(value, list):
        values = [_value(item, parameter) for item in value]
        return values[0] if len(values) == 1 and parameter.type in ("list", "any") else values
    if isinstance(value, int | float) and not isinstance(value, bool) and parameter.resolution:
        return round(float(value) / parameter.resolution)
    return value


def _plain(value: Any) -> Hashable:
    """Hashable and the same for equal numbers and texts."""
    if isinstance(value, bool) or value is None:
        return str(value)
    if isinstance(value, int | float):
        return f"{float(value):.9g}"
    if isinstance(value, list | tuple):
        return tuple(map(_plain, value))
    if isinstance(value, dict):
        return _sorted(value)
    return " ".join(str(value).split()).casefold()


def _sorted(values: Any) -> Hashable:
    return tuple(sorted((str(k), repr(_plain(v))) for k, v in values.items()))
