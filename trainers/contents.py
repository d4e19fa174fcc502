"""Digests of a recorded episode by class of field: what a receipt states of it, so that an edit can be named.

A digest of a whole file says that something was edited; these say in which record, and what: the sampled tokens, their
log-probabilities, a constraint, a reward. Every field of the record counts in exactly one class, those that a later
format adds in `other fields`.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping
from typing import Any

from agentspec.files import digest

OTHER = "other fields"
OBSERVATIONS, ACTIONS, REWARDS = "observations", "actions", "rewards"

EPISODE = {
    **dict.fromkeys(("format", "task", "rollout", "seed", "policy", "status", "error"), "identity"),
    "spec": "spec",
    "versions": "versions",
    "metrics": "metrics",
    "instruction": OBSERVATIONS,
}
STEP = {
    **dict.fromkeys(("step", "text", "choices", "state", "next_text"), OBSERVATIONS),
    **dict.fromkeys(
        ("action", "error", "valid", "rationale", "candidates", "decision_calls", "turn", "trace"), ACTIONS
    ),
    **dict.fromkeys(("reward", "terminated", "truncated", "info"), REWARDS),
}
CALL = {
    **dict.fromkeys(("id", "tag", "model"), "calls"),
    **dict.fromkeys(("prompt", "prompt_ids"), "prompts"),
    "sampling": "sampling (temperature, top_p, top_k)",
    **dict.fromkeys(("usage", "latency_s"), "usage and times"),
}
COMPLETION = {
    "text": "completion texts",
    "token_ids": "tokens",
    "logprobs": "log-probabilities",
    "allowed": "constraints",
    "finish_reason": "finish reasons",
    "credit": "credits",
}


def contents(record: Mapping[str, Any]) -> dict[str, str]:
    """Class of field -> 12 hex digits over everything of that class in one recorded episode.

    Args:
        record: the parsed line of a trajectory file, whole or damaged.
    """
    parts: dict[str, list[Any]] = defaultdict(list)
    for name in sorted(record):
        value = record[name]
        if name == "steps" and _records(value):
            for step in value:
                _sort(step, STEP, parts)
        elif name == "calls" and _records(value):
            for call in value:
                completions = call.get("completions")
                known = _records(completions)
                _sort({k: v for k, v in call.items() if not (known and k == "completions")}, CALL, parts)
                for completion in completions if known else ():
                    _sort(completion, COMPLETION, parts)
                parts["calls"].append(len(completions) if known else None)
        else:
            parts[EPISODE.get(name, OTHER)].append([name, value])
    return {name: short_digest(values) for name, values in sorted(parts.items())}


def _sort(data: Mapping[str, Any], classes: Mapping[str, str], parts: dict[str, list[Any]]) -> None:
    for name in sorted(data):
        parts[classes.get(name, OTHER)].append([name, data[name]])


def _records(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(v, dict) for v in value)


def field_digests(data: Mapping[str, Any]) -> dict[str, str]:
    """`field` -> digest, and `field.key` for each key of a field that is a mapping."""
    found: dict[str, str] = {}
    for name, value in data.items():
        if isinstance(value, Mapping):
            found |= {f"{name}.{key}": short_digest(inner) for key, inner in value.items()}
        else:
            found[name] = short_digest(value)
    return found


def differing(recorded: Any, found: Mapping[str, str]) -> list[str]:
    """Names whose digests differ, or that only one of the two has."""
    if not isinstance(recorded, Mapping):
        return sorted(found)
    return sorted(name for name in {*recorded, *found} if recorded.get(name) != found.get(name))


def short_digest(value: Any) -> str:
    """12 hex digits over JSON data."""
    return digest(json.dumps(value, sort_keys=True, separators=(",", ":")))[:12]
