"""The packed forward over architectures: what it computes is the model's own, and what it cannot compute is refused."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from agentspec.llm.base import LLMError, Sampled, assistant, user
from agentspec.llm.local import LocalLLM
from tests.llm.test_local import CHOICES, ask, close, converse_all, recomputed, tiny
from tests.tiny import tiny_tokenizer


def _architectures() -> dict[str, Any]:
    import transformers as t

    small = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 3, "num_attention_heads": 4}
    small |= {"vocab_size": 300, "max_position_embeddings": 512}
    gqa = small | {"num_key_value_heads": 2, "head_dim": 8}
    return {
        "llama": lambda: t.LlamaForCausalLM(t.LlamaConfig(**gqa)),
        "gemma2": lambda: t.Gemma2ForCausalLM(t.Gemma2Config(**gqa, sliding_window=16, query_pre_attn_scalar=8)),
        "gemma3": lambda: t.Gemma3ForCausalLM(t.Gemma3TextConfig(**gqa, sliding_window=16, query_pre_attn_scalar=8)),
        "mistral": lambda: t.MistralForCausalLM(t.MistralConfig(**gqa, sliding_window=16)),
        "gpt_oss": lambda: t.GptOssForCausalLM(
            t.GptOssConfig(**gqa, sliding_window=16, num_local_experts=2, num_experts_per_tok=1)
        ),
        "gpt2": lambda: t.GPT2LMHeadModel(t.GPT2Config(n_embd=32, n_layer=2, n_head=4, vocab_size=300)),
        "phi3": lambda: t.Phi3ForCausalLM(t.Phi3Config(**small, num_key_value_heads=2, pad_token_id=0)),
    }


@pytest.mark.parametrize("name", list(_architectures()))
def test_architectures(name):
    # Sliding windows, soft caps, sinks, learned positions: the prompt is longer than the window of 16.
    torch.manual_seed(0)
    model = _architectures()[name]().eval()
    llm = LocalLLM(model, tiny_tokenizer(), name=name)
    first = ask(llm, user("a prompt of some length"), max_tokens=20)
    turn = assistant(Sampled.of(first.completions[0]))
    later = ask(llm, user("a prompt of some length"), turn, user("more"), choices=CHOICES)
    assert later.usage.cached_tokens >= len(first.prompt_ids)
    for call in (first, later):
        assert close(call.completions[0].logprobs, recomputed(llm, call))


@pytest.mark.parametrize("name", ["llama", "gemma2", "mistral", "gpt_oss"])
def test_writing_rows_as_one_padded_batch(name, monkeypatch):
    # What an accelerator does; the CPU takes rows one by one.
    torch.manual_seed(0)
    model = _architectures()[name]().eval()
    expected = converse_all(LocalLLM(model, tiny_tokenizer(), name=name), ["a", "bbb", "cccccc"])
    monkeypatch.setattr("agentspec.llm.local.attention._BATCHED_FROM", {"cpu": 2})
    got = converse_all(LocalLLM(model, tiny_tokenizer(), name=name), ["a", "bbb", "cccccc"])
    for x, y in zip(got, expected, strict=True):
        assert [c.completions[0].token_ids for c in x] == [c.completions[0].token_ids for c in y]
        assert all(close(a.completions[0].logprobs, b.completions[0].logprobs) for a, b in zip(x, y, strict=True))


def test_architectures_that_do_not_fit_are_refused():
    import transformers as t

    recurrent = t.MambaForCausalLM(t.MambaConfig(hidden_size=16, num_hidden_layers=1, vocab_size=300, state_size=4))
    with pytest.raises(LLMError, match=r"MambaForCausalLM.*openai"):
        LocalLLM(recurrent, tiny_tokenizer(), name="m")


def test_a_wrong_forward_is_noticed_before_it_is_used(monkeypatch):
    llm = tiny()
    monkeypatch.setattr("agentspec.llm.local.attention._causal_mask", lambda *a: None)
    with pytest.raises(LLMError, match="does not compute Qwen3ForCausalLM"):
        ask(llm)
