"""``vllm.LLM`` as far as TRL and the scaffold use it, over a copy of the tiny model.

It samples from the weights that were pushed into it, and refuses to while it sleeps. TRL's own code runs on top of it.
"""

from __future__ import annotations

import copy
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from trl.generation.vllm_generation import VLLMGeneration


class FakeVLLM:
    """Starts with all weights zero: whatever it samples well, it was given.

    Args:
        model: the policy, a PEFT model or not.
        stop: the id that ends a completion.
        bias: added to every log-probability it reports, as kernels that differ from the trainer's would.
    """

    def __init__(self, model: Any, stop: int, bias: float = 0.0) -> None:
        base = copy.deepcopy(model)
        self.model = base.unload() if hasattr(base, "unload") else base
        self.model.requires_grad_(False).eval()
        self.stop, self.bias = stop, bias
        self.awake = {"weights", "kv_cache"}
        self.pushes = 0
        self._forget()
        inner = SimpleNamespace(model_runner=SimpleNamespace(model=self))
        self.llm_engine = SimpleNamespace(
            model_config=SimpleNamespace(max_model_len=4096),
            model_executor=SimpleNamespace(driver_worker=inner),
            add_request=self.add_request,
            step=self.step,
        )
        self._asked: list[tuple[str, Any, Any]] = []

    def _forget(self) -> None:
        for parameter in self.model.parameters():
            parameter.zero_()

    def wake_up(self, tags: list[str]) -> None:
        self.awake |= set(tags)

    def sleep(self, level: int) -> None:
        assert level == 2
        self.awake = set()
        self._forget()

    def reset_prefix_cache(self) -> None:
        self.pushes += 1  # TRL calls it once at the end of every push

    def load_weights(self, pairs: list[tuple[str, torch.Tensor]]) -> None:
        assert "weights" in self.awake
        known = dict(self.model.named_parameters())
        for name, weight in pairs:
            assert known[name].shape == weight.shape, name
            known[name].copy_(weight.detach())

    def add_request(self, name: str, prompt: Any, parameters: Any) -> None:
        self._asked.append((name, prompt["prompt_token_ids"], parameters))

    def step(self) -> list[Any]:
        """Answers everything at once."""
        assert self.awake == {"weights", "kv_cache"}
        asked, self._asked = self._asked, []
        return [
            SimpleNamespace(request_id=name, finished=True, outputs=[self._sample(ids, p, n) for n in range(p.n)])
            for name, ids, p in asked
        ]

    @torch.no_grad()
    def _sample(self, prompt: list[int], parameters: Any, number: int) -> Any:
        generator = torch.Generator().manual_seed(parameters.seed + number)
        ids, logprobs = list(prompt), []
        for _ in range(parameters.max_tokens):
            logits = self.model(input_ids=torch.tensor([ids])).logits[0, -1]
            values = (logits.float() / (parameters.temperature or 1.0)).log_softmax(-1)
            drawn = torch.multinomial(values.exp(), 1, generator=generator)
            token = int(drawn if parameters.temperature else values.argmax())
            ids.append(token)
            logprobs.append({token: SimpleNamespace(logprob=float(values[token]) + self.bias)})
            if token == self.stop:
                break
        reason = "stop" if ids[-1] == self.stop else "length"
        return SimpleNamespace(token_ids=ids[len(prompt) :], logprobs=logprobs, finish_reason=reason)


def use_fake_vllm(monkeypatch: pytest.MonkeyPatch, stop: int, bias: float = 0.0) -> None:
    """Trainers that are made with ``use_vllm`` from now on get a :class:`FakeVLLM`, in TRL's own ``VLLMGeneration``."""

    def start(generation: VLLMGeneration) -> None:
        generation.llm = FakeVLLM(generation.model, stop, bias)
        if generation.enable_sleep_mode:
            generation.llm.sleep(level=2)
        generation._llm_weights_sleeping = generation.enable_sleep_mode

    module = ModuleType("vllm")
    module.__spec__ = ModuleSpec("vllm", None)
    module.SamplingParams = lambda **fields: SimpleNamespace(**fields)  # type: ignore[attr-defined]
    sampling = ModuleType("vllm.sampling_params")
    sampling.RequestOutputKind = SimpleNamespace(FINAL_ONLY="final")  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "vllm", module)
    monkeypatch.setitem(sys.modules, "vllm.sampling_params", sampling)
    monkeypatch.setattr(VLLMGeneration, "_init_vllm", start)
    monkeypatch.setattr("trl.generation.vllm_generation.empty_cache", lambda: None)


def token_sum(trajectory: Any) -> tuple[float, ...]:
    """A reward that differs between rollouts of an untrained model, which earns nothing."""
    sums = [sum(c.completions[0].token_ids) for c in trajectory.calls]
    return tuple(float(s % 7) for s in sums[: len(trajectory.transitions)])
