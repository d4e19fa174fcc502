"""Specs: YAML and back, and errors that name the remedy."""

from __future__ import annotations

import pytest

from agentspec.registry import REGISTRY, Entry, Registry, SpecError
from agentspec.spec import MODULE_KINDS, AgentSpec


def test_yaml_round_trip() -> None:
    spec = AgentSpec.from_yaml(
        "memory: {name: base, window: 7}\nreasoning: react\nlayout: snapshot\n"
        "sampling: {temperature: 0.7, stop: ['x']}\nbudget: {calls: 9}\n"
    )
    assert spec.memory.params == {"window": 7} and spec.sampling.stop == ("x",) and spec.budget.calls == 9
    assert AgentSpec.from_yaml(spec.to_yaml()) == spec
    assert spec.label == "react+base (snapshot)"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("reasoning: raect\n", "unknown reasoning 'raect'; did you mean react"),
        ("memory: {name: base, windw: 3}\n", "no parameter 'windw'; did you mean window"),
        ("reasonin: react\n", "unknown key 'reasonin' in spec; did you mean reasoning"),
        ("memory: [base]\n", "expected a name or a mapping"),
        ("layout: diary\n", "layout must be"),
        ("sampling: {temperatur: 1}\n", "did you mean temperature"),
        ("sampling: {temperature: -1}\n", "out of range"),
        ("memory: {name: base\n", "malformed YAML in the given text at line 2"),
        ("- react\n- base: 1\n", "a spec is a mapping"),
    ],
)
def test_errors_name_the_remedy(text: str, message: str) -> None:
    with pytest.raises(SpecError, match=message.replace("(", r"\(")):
        AgentSpec.from_yaml(text)


def test_missing_file() -> None:
    with pytest.raises(SpecError, match="no such YAML file"):
        AgentSpec.from_yaml("nowhere.yaml")


def test_needs_are_checked_before_a_run() -> None:
    REGISTRY.register("reasoning", "scorer", Entry("agentspec.reasoning.direct:Direct", needs=("score",)))
    try:
        spec = AgentSpec.from_data({"reasoning": "scorer"})
        with pytest.raises(SpecError, match="needs score, which backend x does not offer"):
            spec.check(frozenset({"choices"}), "backend x")
        spec.check(frozenset({"score"}), "backend x")
    finally:
        del REGISTRY.entries["reasoning"]["scorer"]


def test_names_cannot_be_taken_over() -> None:
    registry = Registry()
    registry.register("memory", "a", Entry("m:A"))
    registry.register("memory", "a", Entry("m:A"))
    with pytest.raises(SpecError, match="already registered"):
        registry.register("memory", "a", Entry("m:B"))


@pytest.mark.parametrize(("kind", "name"), [(k, n) for k in MODULE_KINDS for n in REGISTRY.entries[k]])
def test_every_registered_module_can_be_imported(kind: str, name: str) -> None:
    assert callable(REGISTRY.get(kind, name).load())
