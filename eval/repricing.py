"""Dollars of finished episodes by the price table of today.

A store keeps what each module's calls took of each model (`usage_of`); what that costs is worked out when it is read,
so a changed price plays nothing anew and no table mixes prices of different days. Two things keep the cost that they
had when they were played: scorings, which are no calls, and episodes of stores that were written before usage was kept.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from agentspec.llm.pricing import Prices
from agentspec.types import LLMCall, Usage

TOKENS = ("input_tokens", "cached_tokens", "output_tokens")
TAKEN = ("calls", "input_tokens", "output_tokens", "cost", "latency_s")
"""What an episode's row says of each module."""


def usage_of(calls: Iterable[LLMCall]) -> list[dict[str, Any]]:
    """Tokens by module and model: `{module, model, input_tokens, cached_tokens, output_tokens, cost}` each."""
    sums: dict[tuple[str, str], dict[str, Any]] = {}
    for call in calls:
        name = call.tag.module, call.model
        row = sums.setdefault(name, {"module": name[0], "model": name[1], **dict.fromkeys(TOKENS, 0), "cost": 0.0})
        for key in (*TOKENS, "cost"):
            row[key] += getattr(call.usage, key)
    return list(sums.values())


def repriced(record: Mapping[str, Any], prices: Prices) -> Mapping[str, Any]:
    """A store's record with the costs of its episode, in all and by module, by `prices`.

    Models that a table of prices leaves out cost nothing; the episode names them (`unpriced`).
    """
    usage, episode = record.get("usage"), record["episode"]
    if not usage:
        return record
    modules = {name: {**sums, "cost": 0.0} for name, sums in episode.get("modules", {}).items()}
    change, free = 0.0, set()
    for row in usage:
        model, used = str(row.get("model", "")), {key: row.get(key, 0) for key in TOKENS}
        cost = prices.cost(model, Usage(**used))
        change += cost - row.get("cost", 0.0)
        sums = modules.setdefault(str(row.get("module", "")), dict.fromkeys(TAKEN, 0) | used)
        sums["cost"] += cost
        if prices.table and prices.price(model) is None:
            free.add(model)
    costs: dict[str, Any] = {"cost": episode["cost"] + change} if episode.get("cost") is not None else {}
    if free:
        costs["unpriced"] = sorted(free)
    return {**record, "episode": {**episode, "modules": modules, **costs}}


def unpriced_note(rows: Iterable[Mapping[str, Any]]) -> str:
    """What to write beside costs where some models have no price; empty where all have one, or nobody gave prices."""
    models = sorted({model for row in rows for model in row.get("unpriced", ())})
    return f"No price is given for {', '.join(models)}: calls of these models count as $0." if models else ""
