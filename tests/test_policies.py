"""Policies: how they are named, what they do to a scaffold, and when two are the same."""

from __future__ import annotations

from pathlib import Path

import pytest

from agentspec.llm.models import SHIPPED, ModelNotFoundError
from agentspec.policies import Policy, needs_model, weights_digest
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec


def test_parse(tmp_path: Path) -> None:
    assert Policy.parse("rule-based") == Policy("rule_based")
    assert Policy.parse("smollm2-135m") == Policy("smollm2-135m", "smollm2-135m")
    assert Policy.parse("tuned=smollm2-135m+runs/x") == Policy("tuned", "smollm2-135m", "runs/x")
    assert Policy.parse(str(tmp_path)).name == tmp_path.name  # a folder is called by its last part
    for text in ("=model", "name=", ""):
        with pytest.raises(SpecError, match="NAME=MODEL"):
            Policy.parse(text)


def test_a_mistyped_policy_is_told_the_nearest() -> None:
    for typo, meant in (("rulebased", "rule-based"), ("smollm2-135", "smollm2-135m")):
        with pytest.raises(ModelNotFoundError, match=f"no model '{typo}'.*; did you mean {meant}"):
            Policy.parse(typo).check()
    with pytest.raises(ModelNotFoundError) as told:
        Policy.parse("nothing").check()
    assert "did you mean" not in str(told.value)


def test_an_adapter_alone_helps_on_the_policy_s_model(tmp_path: Path) -> None:
    spec = AgentSpec.from_data({"memory": "summary", "roles": {"memory.*": {"adapter": "notes"}}})
    assert Policy("m", "some-model").apply(spec).roles == {"memory.*": {"adapter": "notes", "model": "some-model"}}
    # A policy that is itself an adapter: the helper stands on the same base.
    (tmp_path / "adapter_config.json").write_text('{"base_model_name_or_path": "owner/base"}')
    assert Policy("m", str(tmp_path)).apply(spec).roles["memory.*"]["model"] == "owner/base"
    with pytest.raises(SpecError, match="served by the backend 'openai'; name the model"):
        Policy("m", "some-model", backend={"backend": "openai"}).apply(spec)
    own = AgentSpec.from_data({"memory": "summary", "roles": {"memory.*": {"model": "x", "adapter": "notes"}}})
    assert Policy("m", "some-model").apply(own) is own


def test_a_scripted_policy_takes_the_place_of_reasoning() -> None:
    spec = AgentSpec.from_data({"reasoning": "react", "memory": {"name": "base", "window": 3}})
    played = Policy("random").apply(spec)
    assert played.reasoning.name == "random" and played.memory == spec.memory and not needs_model(played)
    assert Policy("m", "some-model").apply(spec) is spec and needs_model(spec)


def test_a_model_may_be_called_like_a_scripted_policy() -> None:
    assert Policy("random").scripted == "random"
    assert Policy("random", "some-model").scripted == ""


def test_settings_of_the_backend() -> None:
    assert Policy("m").settings() == {"backend": "local", "model": "m"}
    policy = Policy("x", "m", "a", {"dtype": "float32"})
    assert policy.settings() == {"backend": "local", "model": "m", "adapter": "a", "dtype": "float32"}
    scripted = Policy("x", backend={"backend": "scripted", "script": ["WAIT()"]})
    assert scripted.settings() == {"backend": "scripted", "script": ["WAIT()"]}


def test_retrained_weights_are_another_policy(tmp_path: Path) -> None:
    weights = tmp_path / "adapter_model.safetensors"
    weights.write_bytes(b"a" * 100)
    policy = Policy("tuned", "base", str(tmp_path))
    before = policy.identity()
    assert policy.identity() == before
    weights.write_bytes(b"a" * 99 + b"b")
    assert policy.identity() != before
    assert policy.identity()["adapter"] == f"weights:{weights_digest(tmp_path)}"
    (tmp_path / "optimizer.pt").write_bytes(b"a trainer's")
    before = policy.identity()
    assert before["adapter"] == f"weights:{weights_digest(tmp_path)}"
    for name in ("chat_template.jinja", "tokenizer.json"):  # they decide what the model is shown
        (tmp_path / name).write_text("other")
        assert policy.identity() != before
        before = policy.identity()


def test_weights_count_by_content_however_they_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "adapter_model.safetensors").write_bytes(b"a" * 100)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert Policy("x", "m", "~/run").identity() == Policy("y", "m", str(tmp_path / "run")).identity()
    named = Policy("x", "smollm2-135m", "smollm2-135m-courier").identity()["adapter"]
    assert named == f"weights:{weights_digest(SHIPPED / 'smollm2-135m-courier')}"
