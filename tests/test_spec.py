"""Specs: YAML and back, and errors that name the remedy."""

from __future__ import annotations

import pytest

from agentspec.declaration import Declaration
from agentspec.registry import REGISTRY, Entry, SpecError
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
        ("memory: base\nmemory: none\n", "memory stands twice, in the mapping at line 1; keep one"),
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
    REGISTRY.register("reasoning", "scorer", Entry("agentspec.reasoning.direct:Direct", Declaration(needs=("score",))))
    try:
        spec = AgentSpec.from_data({"reasoning": "scorer"})
        with pytest.raises(SpecError, match="needs score, which backend x does not offer"):
            spec.check(frozenset({"choices"}), "backend x")
        spec.check(frozenset({"score"}), "backend x")
    finally:
        REGISTRY.unregister("reasoning", "scorer")


@pytest.mark.parametrize(("kind", "name"), [(k, n) for k in MODULE_KINDS for n in REGISTRY.entries[k]])
def test_every_registered_module_can_be_imported(kind: str, name: str) -> None:
    assert callable(REGISTRY.get(kind, name).load())


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"budget": {"calls": "many"}}, "budget: calls must be a whole number or null, got 'many'"),
        ({"budget": {"cost": True}}, "budget: cost must be a number or null"),
        ({"sampling": {"temperature": "hot"}}, "sampling: temperature must be a number"),
        ({"max_turns": "x"}, "max_turns must be a whole number, got 'x'"),
        ({"max_turns": -1}, "max_turns must be at least 0"),
        ({"recall_tokens": 1.5}, "recall_tokens must be a whole number"),
        ({"recall": "sometimes"}, "recall must be 'newest' or 'kept'"),
        ({"scope": ["run"]}, "scope must be 'episode' or 'run'"),
        ({"embedder": "minilmm"}, "unknown embedder 'minilmm'"),
        ({"reasoning": {"name": "mad", "preset": "papper"}}, "mad has no preset 'papper'; did you mean paper"),
        ({"reasoning": {"name": "tot", "breadth": "wide"}}, "reasoning 'tot': breadth must be"),
        ({"memory": {"name": "base", "window": 0}}, "memory 'base': memory base: window must be at least 1"),
        ({"memory": {"name": "base", "window": True}}, "memory 'base': window must be a whole number"),
        ({"memory": {"name": "base", "windw": 1}}, "has no parameter 'windw'; did you mean window"),
        ({"perception": {"name": "generic", "images": "yes"}}, "images must be true or false"),
        ({"roles": {"memory.*": {"adaptor": "x"}}}, "roles: 'memory.\\*': expected {model: NAME}"),
        ({"roles": {"memory.*": {"model": 3}}}, "roles: 'memory.\\*': expected {model: NAME}"),
        (
            {"roles": {"memory.*": {"model": "x", "dtyp": "y"}}},
            "roles: 'memory.\\*': unknown key 'dtyp'.*did you mean dtype",
        ),
        ({"roles": {"memory.*": "x"}}, "roles"),
        ({"roles": {"reflection.mad": {"model": "x"}}}, "matches none of the modules"),
        ({"roles": {"memory.*": {"model": "x", "endpoint": "u", "adapter": "a"}}}, "leave `adapter` out"),
        ({"imports": [3]}, "imports must be a list"),
    ],
)
def test_a_spec_is_checked_whole(data: dict, message: str) -> None:
    with pytest.raises(SpecError, match=message.replace("{", r"\{").replace("}", r"\}")):
        AgentSpec.from_data(data)


def test_a_module_that_a_policy_replaces_is_checked_all_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    from agentspec.cli import main

    with pytest.raises(SystemExit):
        main(["run", "--policy", "rule-based", "--spec", "reasoning: {name: lats, preset: cheap}"])
    assert "lats has no preset 'cheap'" in capsys.readouterr().err
