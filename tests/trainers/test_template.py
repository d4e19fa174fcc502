"""Variables of the chat template (thinking off, say) reach every prompt of a training run."""

from __future__ import annotations

from pathlib import Path

from agentspec.llm.base import user
from agentspec.llm.chat import render
from agentspec.llm.local import LocalLLM
from tests.tiny import tiny_model, tiny_tokenizer
from trainers.config import ScaffoldConfig
from trainers.policy import load_policy


def test_thinking_can_be_switched_off_in_training(tmp_path: Path) -> None:
    tokenizer = tiny_tokenizer()
    tiny_model(tokenizer).save_pretrained(tmp_path / "model")
    tokenizer.save_pretrained(tmp_path / "model")
    given = {"output_dir": str(tmp_path / "run"), "model": str(tmp_path / "model"), "use_cpu": True, "bf16": False}
    for variables, silent in (({"enable_thinking": False}, True), (None, False)):
        model, loaded = load_policy(ScaffoldConfig(**given, chat_template_kwargs=variables))
        written = loaded.decode(render([user("hi")], loaded))
        assert ("</think>" in written) == silent
        sampled_with = LocalLLM(model, loaded, name="policy").chat.render([user("hi")])
        assert loaded.decode(sampled_with) == written
