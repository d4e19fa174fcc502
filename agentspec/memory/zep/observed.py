"""Facts without a model: the fields of a structured state, and whatever else is known by rule."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from agentspec.memory.zep.temporal import TemporalGraph, fields_of
from agentspec.services import Services, Time


def read_state(graph: TemporalGraph, state: Mapping[str, Any], at: Time, services: Services) -> None:
    """Facts out of a structured state; a field with another value ends the fact of the former one."""
    put(
        graph,
        ((who, what, f"{who}: {what} is {value}") for who, what, value in fields_of(state, "the agent")),
        at,
        services,
    )


def put(graph: TemporalGraph, facts: Iterable[tuple[str, str, str]], at: Time, services: Services) -> None:
    """Facts as (subject, field, what is so); one that says something else of a field ends the one there was."""
    for subject, field, text in facts:
        id = graph.entity(subject)
        if id is None:
            id = services.new_id()
            graph.add_entity(id, subject)
        open_ = [e for e in graph.of((id,)) if e.data["triple"][1] == field and e.data["invalid"] is None]
        if any(e.text == text for e in open_):
            continue
        new = graph.add_fact(services.new_id(), text, at, (id, field, id), at.total)
        for old in open_:
            if old.id in graph.facts and new.id in graph.facts:
                graph.contradict(new.id, old.id, at.total)
