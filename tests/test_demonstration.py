"""An expert's answers to what memories ask: in the declared form, in every memory, unchanged where it counts."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import pytest

from agentspec.demonstration import play_expert
from agentspec.registry import REGISTRY
from agentspec.reworded import reworded
from agentspec.spec import AgentSpec
from agentspec.types import Task

NOTES = ["The door is open.", "The key is red.", "Next: go forward."]
WORLDS = {
    "minigrid": {"level": "MiniGrid-MemoryS13Random-v0", "observation": "compact", "action_mode": "menu"},
    "deliverybench": {"size": "tiny", "observation": "compact", "action_mode": "menu"},
}
MEMORIES = [name for name, entry in REGISTRY.all("memory").items() if not entry.declaration.extra]


@pytest.mark.parametrize(
    ("example", "told"),
    [
        ('{"facts": ["One thing.", "Another thing."]}', {"facts": NOTES}),
        ('{"op": "add", "id": 3, "text": "It is so."}', {"op": "add", "id": 3, "text": " ".join(NOTES)}),
        (
            '{"calls": [{"to": "task", "text": "One thing."}, {"to": "self", "text": "More of it.", "n": [1]}]}',
            {"calls": [{"to": "task", "text": NOTES[0]}, {"to": "self", "text": " ".join(NOTES[1:]), "n": [1]}]},
        ),
    ],
)
def test_json_keeps_its_form_and_gets_other_content(example: str, told: Any) -> None:
    assert json.loads(reworded(example, NOTES)) == told


def test_texts_keep_bullets_labels_and_the_tags_that_are_asked_for() -> None:
    lines = "".join(f"- {note}\n" for note in NOTES)
    sheet = "<sheet>\n- One thing.\n- Another.\n</sheet>"
    assert reworded(sheet, NOTES) == lines.strip()
    assert reworded(sheet, NOTES, "Put it between <sheet> and </sheet>.") == f"<sheet>\n{lines}</sheet>"
    assert reworded("Facts: it is 3.\nGoal: the target.", NOTES) == f"Facts: {NOTES[0]}\nGoal: {' '.join(NOTES[1:])}"
    assert reworded("Any text.", NOTES) == " ".join(NOTES)


def test_without_anything_to_say_the_form_stays() -> None:
    assert json.loads(reworded('{"facts": ["One thing."], "at": 2}', [])) == {"facts": [], "at": 2}
    assert json.loads(reworded('{"text": "One thing."}', [])) == {"text": "Nothing yet."}
    assert reworded("- One thing.", []) == "- Nothing yet." and reworded("", []) == "Nothing yet."


@pytest.fixture(scope="module")
def tokenizer() -> Any:
    pytest.importorskip("trl")
    from tests.tiny import tiny_tokenizer

    return tiny_tokenizer()


def played(tokenizer: Any, memory: dict[str, Any], task: Task, **agent: Any) -> Any:
    data = {"reasoning": "direct", "layout": "snapshot", "embedder": "hash", "memory": memory, **agent}
    [episode] = play_expert(AgentSpec.from_data(data), tokenizer, [task])
    return episode


def parameters(name: str) -> list[dict[str, Any]]:
    """Preset `rl`, alone and with each small set that makes a memory ask all it can; without what an expert has not."""
    entry = REGISTRY.get("memory", name)
    preset = {"preset": "rl"} if entry.presets else {}
    found = [preset | small for small in ({}, *entry.declaration.small)]
    without_score = dict(value for need, value in entry.waived.items() if need == "score")
    return [params | (without_score if "score" in entry.needs_with(params) else {}) for params in found]


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("name", MEMORIES)
def test_the_expert_answers_every_memory(tokenizer: Any, name: str, world: str) -> None:
    if world == "minigrid":
        pytest.importorskip("minigrid")
    entry = REGISTRY.get("memory", name)
    for params in parameters(name):
        task = Task(world, 1, {**WORLDS[world], "max_steps": 8})
        episode = played(tokenizer, {"name": name, **params}, task, scope=entry.declaration.scope or "episode")
        written = {c.tag.purpose: c.text for c in episode.calls if c.tag.module.startswith("memory.")}
        assert len(episode.transitions) == 8 and not episode.metrics["problems"], (params, written)
        assert set(written) <= set(entry.purposes)


def shape(data: Any) -> Any:
    """What must not change: keys, numbers, single words; of lists their first item."""
    if isinstance(data, dict):
        return {key: shape(value) for key, value in data.items()}
    if isinstance(data, list):
        return [shape(item) for item in data[:1]]
    return "a text" if isinstance(data, str) and " " in data.strip() else data


@pytest.mark.parametrize("name", REGISTRY.all("memory"))
def test_every_declared_example_can_be_filled(name: str) -> None:
    for purpose in REGISTRY.get("memory", name).purposes.values():
        told = reworded(purpose.example, NOTES, purpose.example)
        try:
            example = json.loads(purpose.example)
        except ValueError:
            assert all(note in told for note in NOTES) and purpose.example
        else:
            assert shape(json.loads(told)) == shape(example)


SAID = {
    "base": "2630fe3ca94ef8eb",
    "summary": "258e6810f6d63611",
    "sheet": "8702c7bb11a19ff0",
    "bare sheet": "46b1942392862fc3",
}
"""Digests of what the expert said in the study of transfer between memories, whose starts were trained on it."""


def test_the_study_s_demonstrations_do_not_change(tokenizer: Any) -> None:
    pytest.importorskip("minigrid")
    scaffolds: dict[str, dict[str, Any]] = {
        "base": {"name": "base", "window": 6, "observation_tokens": 48},
        "summary": {"name": "summary", "every": 3, "summary_tokens": 900},
        "sheet": {"name": "dynamic_cheatsheet", "every": 3, "sheet_tokens": 900},
        "bare sheet": {
            "name": "dynamic_cheatsheet",
            "preset": "rl",
            "every": 3,
            "sheet_tokens": 900,
            "step_tokens": 48,
        },
    }
    found = {}
    for label, memory in scaffolds.items():
        said = []
        for seed in range(6):
            task = Task("minigrid", seed, {**WORLDS["minigrid"], "max_steps": 14})
            said += [[c.tag.path, c.tag.step, c.text] for c in played(tokenizer, memory, task).calls]
        found[label] = hashlib.sha256(json.dumps(said).encode()).hexdigest()[:16]
    assert found == SAID
