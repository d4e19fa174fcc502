"""Adapters by call: each call is answered by its own adapter, and the model is left as a trainer left it."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

import pytest
import torch

from agentspec.llm.base import LLMError, Request, Sampled, assistant, system, user
from agentspec.llm.local import LocalLLM
from agentspec.llm.local.adapters import UNTAGGED, adapter_for
from agentspec.types import CallTag, LLMCall
from tests.llm.helpers import request
from tests.tiny import tiny_model, tiny_tokenizer

ROUTES = {"reflection.*": "reflector", "reasoning.*/decide": "actor"}


def two_adapters() -> Any:
    """A tiny PEFT model with adapters ``actor`` (active, trainable) and ``reflector`` of different random weights."""
    from peft import LoraConfig, get_peft_model

    tokenizer = tiny_tokenizer()
    torch.manual_seed(0)
    model = get_peft_model(tiny_model(tokenizer), LoraConfig(target_modules=["q_proj", "v_proj"]), "actor")
    # The second sits on other modules: some layers have one adapter only.
    model.add_adapter("reflector", LoraConfig(target_modules=["v_proj", "down_proj"]))
    with torch.no_grad():
        for name, p in model.named_parameters():
            if "lora_B" in name:
                p.normal_(std=0.3)
    return model.eval(), tokenizer


def backend(**kwargs: Any) -> LocalLLM:
    model, tokenizer = two_adapters()
    return LocalLLM(model, tokenizer, name="two", **({"adapters": ROUTES} | kwargs))


def tagged(path: str, *messages: Any, **kwargs: Any) -> Request:
    """A request whose tag has ``path``."""
    plain = request(messages or (system("rules " * 30), user("hello")), **({"max_tokens": 6} | kwargs))
    return replace(plain, tag=replace(plain.tag, module=path.split("/", maxsplit=1)[0], purpose=path.split("/")[1]))


def plain_logprobs(llm: LocalLLM, call: LLMCall, adapter: str) -> list[float]:
    """Log-probabilities of the completion by an ordinary forward with ``adapter`` set."""
    before = llm.model.active_adapter
    llm.model.set_adapter(adapter)
    (completion,) = call.completions
    with torch.no_grad():
        ids = torch.tensor([[*call.prompt_ids, *completion.token_ids]])
        logits = llm.model(ids, use_cache=False).logits[0, len(call.prompt_ids) - 1 : -1].log_softmax(-1)
    llm.model.set_adapter(before)
    return logits.gather(1, torch.tensor(completion.token_ids)[:, None])[:, 0].tolist()


def together(llm: LocalLLM, *requests: Request) -> list[LLMCall]:
    async def main() -> list[LLMCall]:
        return list(await asyncio.gather(*map(llm.generate, requests)))

    return asyncio.run(main())


def test_each_call_of_a_batch_is_answered_by_its_adapter() -> None:
    llm = backend()
    calls = together(
        llm,
        tagged("reflection.retroformer/reflect", seed=1),
        tagged("reasoning.direct/decide", id=1, seed=1),
        tagged("reflection.retroformer/reflect", id=2, seed=2),
        tagged("memory.flat/summary", id=3, seed=1),  # no pattern: what is active, the actor
    )
    for call, adapter in zip(calls, ["reflector", "actor", "reflector", "actor"], strict=True):
        assert call.completions[0].logprobs == pytest.approx(plain_logprobs(llm, call, adapter), abs=1e-4)
    other = plain_logprobs(llm, calls[0], "actor")
    assert max(abs(a - b) for a, b in zip(calls[0].completions[0].logprobs, other, strict=True)) > 0.05


@pytest.mark.parametrize("active", ["actor", "reflector"])
def test_the_model_is_left_as_the_trainer_left_it(active: str) -> None:
    llm = backend()
    llm.model.set_adapter(active)
    # A trainer's own choice of what learns, which no switch of PEFT's would give.
    chosen = {name: i % 3 == 0 for i, (name, _) in enumerate(llm.model.named_parameters())}
    for name, p in llm.model.named_parameters():
        p.requires_grad = chosen[name]
    weights = {name: p.clone() for name, p in llm.model.state_dict().items()}
    together(llm, tagged("reflection.x/y"), tagged("reasoning.x/decide", id=1))
    assert llm.model.active_adapter == active
    assert llm.model.active_adapters == [active]
    layers = [m for m in llm.model.modules() if hasattr(m, "lora_A")]
    assert layers and all(m.active_adapters == [active] for m in layers)
    assert {name: p.requires_grad for name, p in llm.model.named_parameters()} == chosen
    assert all(torch.equal(weights[name], p) for name, p in llm.model.state_dict().items())


def test_several_active_adapters_are_active_again_also_after_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    llm = backend(adapters={"reflection.*": "reflector"})
    together(llm, tagged("other/x"))
    llm.model.base_model.set_adapter(["actor", "reflector"])

    def broken(segments: Any) -> Any:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(llm._engine.model, "forward", broken)
    with pytest.raises(LLMError, match="out of memory"):
        together(llm, tagged("reflection.x/y"))
    assert llm.model.active_adapters == ["actor", "reflector"]
    assert llm.model.active_adapter == "actor"


def test_keys_and_values_are_kept_per_adapter() -> None:
    llm = backend()
    first = together(llm, tagged("reflection.x/y", seed=3))[0]
    other = together(llm, tagged("reasoning.x/decide", seed=3))[0]
    assert (first.usage.cached_tokens, other.usage.cached_tokens) == (0, 0)
    # Each finds its own again, although the other one ran in between.
    for path, before, adapter in (("reflection.x/y", first, "reflector"), ("reasoning.x/decide", other, "actor")):
        turn = assistant(Sampled.of(before.completions[0]))
        (later,) = together(llm, tagged(path, system("rules " * 30), user("hello"), turn, user("go on")))
        assert later.usage.cached_tokens >= len(before.prompt_ids)
        assert later.completions[0].logprobs == pytest.approx(plain_logprobs(llm, later, adapter), abs=1e-4)


def test_a_trained_adapter_drops_what_was_cached() -> None:
    llm = backend()
    together(llm, tagged("reflection.x/y"))
    with torch.no_grad():
        for name, p in llm.model.named_parameters():
            if "lora_B.reflector" in name:
                p.add_(0.1)
    (call,) = together(llm, tagged("reflection.x/y"))
    assert call.usage.cached_tokens == 0
    assert call.completions[0].logprobs == pytest.approx(plain_logprobs(llm, call, "reflector"), abs=1e-4)


def test_without_routes_the_active_adapter_answers() -> None:
    llm = backend(adapters=None)
    for adapter in ("reflector", "actor"):
        llm.model.set_adapter(adapter)
        (call,) = together(llm, tagged("reflection.x/y"))
        assert call.usage.cached_tokens == 0
        assert call.completions[0].logprobs == pytest.approx(plain_logprobs(llm, call, adapter), abs=1e-4)


def test_scores_come_from_what_answers_everything() -> None:
    # The active adapter is the actor; "*" names the reflector, "reflection.*" alone does not reach a scoring.
    for routes, adapter in (({"*": "reflector"}, "reflector"), ({"reflection.*": "reflector"}, "actor")):
        llm = backend(adapters=routes)
        prompt = (user("hello"),)
        (score,) = asyncio.run(llm.score(prompt, ["yes"]))
        ids = llm.chat.encode("yes")
        llm.model.set_adapter(adapter)
        with torch.no_grad():
            logits = llm.model(torch.tensor([[*llm.chat.render(prompt), *ids]])).logits[0].log_softmax(-1)
        expected = sum(float(logits[i - len(ids) - 1, t]) for i, t in enumerate(ids))
        assert score == pytest.approx(expected, abs=1e-4)


def test_the_first_pattern_wins() -> None:
    routes = {"reflection.*/reflect": "a", "reflection.*": "b", "*": "c"}
    tags = [CallTag("reflection.x", "reflect", ""), CallTag("reflection.x", "judge", ""), CallTag("memory", "x", "")]
    assert [adapter_for(t.path, routes) for t in tags] == ["a", "b", "c"]
    assert adapter_for("reflection.x/reflect", {}) == ""
    assert adapter_for(UNTAGGED, routes) == "c"


def test_adapters_the_model_does_not_have_are_refused() -> None:
    with pytest.raises(LLMError, match=r"unknown adapter\(s\) critic; the model has actor, reflector"):
        backend(adapters={"*": "critic"})
    tokenizer = tiny_tokenizer()
    with pytest.raises(LLMError, match="no PEFT model"):
        LocalLLM(tiny_model(tokenizer), tokenizer, name="plain", adapters={"*": "actor"})
