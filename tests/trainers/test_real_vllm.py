"""vLLM itself, where it is installed: on a GPU, or the build for CPUs (TRL 1.16 takes vLLM 0.22 to 0.31).

    pip install "vllm<0.32"
    python -m pytest -m slow tests/trainers/test_real_vllm.py

Weights are pushed into a server over NCCL, which takes a GPU of its own: here the server is only asked.
"""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

pytest.importorskip("vllm", reason="vLLM is not installed")
pytest.importorskip("trl")

from datasets import Dataset

from agentspec.llm.base import system, user
from agentspec.llm.local import LocalLLM
from agentspec.llm.local.sampling import filter_top
from agentspec.llm.models import resolve
from agentspec.llm.vllm import trl_backend
from agentspec.records.log import RunLog
from agentspec.trajectory import read_trajectories
from agentspec.types import Completion, Sampling
from rewards.base import REWARDS, RewardEntry
from tests.llm.helpers import request
from tests.trainers.builders import CPU_RUN
from tests.trainers.played import toy_tasks
from trainers.audit import audit
from trainers.config import ScaffoldConfig
from trainers.grpo import ScaffoldGRPOTrainer
from trainers.policy import load_policy
from trainers.rollouts import task_rows

pytestmark = pytest.mark.slow

MODEL = "smollm2-135m"
ON_CPU = not torch.cuda.is_available()
# In one process, so that its weights can be reached; on a CPU with a small cache, and threads that are not pinned.
ENGINE = {"VLLM_ENABLE_V1_MULTIPROCESSING": "0"}
SMALL = {"VLLM_CPU_KVCACHE_SPACE": "1", "VLLM_CPU_OMP_THREADS_BIND": "nobind"}


@pytest.fixture
def one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    import trl.generation.vllm_generation as generation

    for name, value in {**ENGINE, **SMALL}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(generation, "LLM", partial(generation.LLM, dtype="float32"))
    if ON_CPU:
        # Its CPU kernels pack the weights once and take no new ones: multiply plainly.
        def plainly(layer: Any, remove_weight: bool) -> None:
            layer.cpu_linear = torch.nn.functional.linear

        monkeypatch.setattr("vllm.model_executor.layers.utils.dispatch_cpu_unquantized_gemm", plainly)


def recomputed(model: Any, prompt: tuple[int, ...], completion: Completion, sampling: Sampling) -> list[float]:
    """Log-probabilities of a completion in the distribution it is sampled from, by the model's ordinary forward."""
    ids = torch.tensor([[*prompt, *completion.token_ids]], device=model.device)
    with torch.no_grad():
        logits = model(ids).logits[0, len(prompt) - 1 : -1].float()
    found = []
    for line, token in zip(logits, completion.token_ids, strict=True):
        logprobs = torch.log_softmax(line / (sampling.temperature or 1.0), -1)
        if sampling.temperature > 0 and (sampling.top_k or sampling.top_p < 1):
            logprobs = filter_top(logprobs, sampling.top_k, sampling.top_p)
        found.append(float(logprobs[token]))
    return found


def largest_difference(a: Any, b: Any) -> float:
    return max(abs(x - y) for x, y in zip(a, b, strict=True))


@pytest.mark.usefixtures("one_process")
def test_every_round_is_sampled_from_the_weights_of_the_trainer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(REWARDS, "token_sum", RewardEntry("tests.trainers.fake_vllm:token_sum", "for tests"))
    settings = {
        **CPU_RUN,
        "model": MODEL,
        "adapter": "smollm2-135m-courier",
        "output_dir": str(tmp_path),
        "agent": {"reasoning": "direct", "sampling": {"max_tokens": 12}},
        "rewards": {"token_sum": 1.0},
        "num_generations": 4,
        "per_device_train_batch_size": 8,
        "max_steps": 3,
        "learning_rate": 1e-3,
        "save_strategy": "no",
        "use_cpu": ON_CPU,
        "use_vllm": True,
        "vllm_mode": "colocate",
        "vllm_max_model_length": 1024,
        "vllm_gpu_memory_utilization": 0.2,
    }
    config = ScaffoldConfig(**settings)
    policy, tokenizer = load_policy(config)
    run = ScaffoldGRPOTrainer(
        policy, config, train_dataset=Dataset.from_list(task_rows(toy_tasks(menu=False))), processing_class=tokenizer
    )
    run.train()
    differences = [r["sampling/logp_difference_max"] for r in RunLog(tmp_path).read("metrics.jsonl") if "reward" in r]
    assert len(differences) == 3 and max(differences) < 1e-3
    assert [v for receipt in audit(tmp_path) for v in receipt.violations] == []
    # That says something: the weights moved by far more than that.
    calls = [c for t in read_trajectories(tmp_path / "trajectories" / "000000.jsonl") for c in t.calls]
    model = run.model.eval()
    moved = [
        largest_difference(completion.logprobs, recomputed(model, call.prompt_ids, completion, call.sampling))
        for call in calls
        for completion in call.completions
    ]
    assert max(moved) > 0.05


@pytest.fixture
def server(tmp_path: Path) -> Iterator[str]:
    """The address of a server of the bundled model."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [str(Path(sys.executable).with_name("vllm")), "serve", str(resolve(MODEL).path)]
    options = "--logprobs-mode processed_logprobs --max-logprobs -1 --max-model-len 1024 --dtype float32"
    environment = {**os.environ, **SMALL, "VLLM_SERVER_DEV_MODE": "1"}
    with open(tmp_path / "server.log", "w") as log:
        process = subprocess.Popen(
            [*command, *options.split(), "--port", str(port)], env=environment, stdout=log, stderr=log
        )
        try:
            yield f"http://127.0.0.1:{port}"
        finally:
            process.terminate()
            process.wait(60)


def test_what_a_server_reports_is_what_it_sampled_from(server: str) -> None:
    from trl.generation.vllm_client import VLLMClient

    local = LocalLLM.load(MODEL, dtype="float32", device="cpu")
    client = VLLMClient(base_url=server, connection_timeout=300)
    backend = trl_backend(SimpleNamespace(mode="server", vllm_client=client), local.tokenizer)
    kinds = [{}, {"temperature": 0.7}, {"top_p": 0.9}, {"top_k": 20}, {"temperature": 0.0}]
    asked = [
        request([system("Be brief."), user("What to eat?")], id=i, seed=i, n=2, max_tokens=24, stop=("\n",), **kind)
        for i, kind in enumerate(kinds)
    ]

    async def main() -> list[Any]:
        return list(await asyncio.gather(*map(backend.generate, asked)))

    first, again = asyncio.run(main()), asyncio.run(main())
    assert backend.max_context == 1024
    for call, same in zip(first, again, strict=True):
        assert [c.token_ids for c in call.completions] == [c.token_ids for c in same.completions]
        for completion in call.completions:
            expected = recomputed(local.model, call.prompt_ids, completion, call.sampling)
            assert largest_difference(completion.logprobs, expected) < 1e-3
