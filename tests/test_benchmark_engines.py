"""The benchmark of engines against a loopback server; phases of the local engine; the float32 GGUF file."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("torch")
pytest.importorskip("transformers")
pytest.importorskip("httpx")

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from agentspec.llm.base import LLMError
from agentspec.llm.local.cache import Slot
from agentspec.llm.local.forward import Segment
from agentspec.llm.local.rows import Job
from agentspec.types import Sampling
from benchmarks import engines
from benchmarks.gradient_error import differences, errors, gradients, in_float64
from benchmarks.measuring import Ceilings, ceilings
from benchmarks.phases import Phases, Work
from benchmarks.rollouts import FixedLengthLLM, tiny
from tests.tiny import tiny_model, tiny_tokenizer

WORLD = {"steps": 3, "words": 4}


class Loopback:
    """A server with OpenAI's completions, an engine of our own behind it."""

    def __init__(self) -> None:
        self.engine = engines.Ours(*tiny())
        self.bodies: list[dict[str, Any]] = []
        self.status = 200
        self.missing = 0
        self._lock = threading.Lock()
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self._send(200, {"data": [{"id": "tiny"}]} if self.path == "/v1/models" else {})

            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["content-length"])))
                with outer._lock:
                    outer.bodies.append(body)
                    job = Job("", body["prompt"], Sampling(temperature=0.0, max_tokens=body["max_tokens"]))
                    outer.engine.llm._engine.run([job])
                usage = {"completion_tokens": body["max_tokens"] - outer.missing}
                self._send(outer.status, {"choices": [{"text": job.completions[0].text}], "usage": usage})

            def _send(self, status: int, content: Any) -> None:
                data = json.dumps(content).encode()
                self.send_response(status)
                self.send_header("content-length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            def log_message(self, *args: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def loopback() -> Iterator[Loopback]:
    server = Loopback()
    yield server
    server.close()


def test_both_engines_get_the_same_turns_and_write_the_same(
    loopback: Loopback, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = ["engines", "--model", "tiny", "--server", f"other={loopback.url}", "--json"]
    arguments += ["--rollouts", "2", "--turns", "3", "--answer", "3", "--words", "4", "--repeats", "2"]
    monkeypatch.setattr("sys.argv", arguments)
    engines.main()
    result = json.loads(capsys.readouterr().out)
    assert set(result["engines"]) == {engines.OURS, "other"}
    for measured in result["engines"].values():
        assert measured["same_answers"] == 1.0
        assert measured["seconds"] > 0 and measured["prefill_tokens_per_s"] > 0
    assert result["engines"][engines.OURS]["ratio"] == 1.0
    # Warm-up, then two repeats of two replays of 2 x 3 turns.
    bodies = loopback.bodies[1:]
    assert len(bodies) == 2 * 2 * 6
    assert {b["max_tokens"] for b in bodies} == {1, 3}
    assert all(b["prompt"] and b["min_tokens"] == b["max_tokens"] and b["temperature"] == 0 for b in bodies)
    # No replay's prompts are in any cache.
    salts = [b["prompt"][0] for b in bodies]
    assert [salts[i * 6 : (i + 1) * 6] for i in range(4)] == [[engines.FIRST_SALT + i] * 6 for i in range(4)]


def test_prompts_grow_by_what_was_answered_and_none_ends_a_turn() -> None:
    ours = engines.Ours(*tiny())
    recording = engines.record(ours, WORLD, 2, 3, salt=201)
    ends = ours.llm.chat.stop_ids
    for turns in recording:
        assert [len(t.answer) for t in turns] == [3, 3, 3]
        for before, after in pairwise(turns):
            known = (*before.prompt, *before.answer)
            assert after.prompt[: len(known)] == known
        assert not any(set(t.answer) & set(ends) for t in turns)
    # Counted by hand: all positions of a trie over the longest prompts, without what the engine wrote.
    nodes = {p[:i] for p in (turns[-1].prompt for turns in recording) for i in range(1, len(p) + 1)}
    assert engines.least_read(recording) == len(nodes) - 2 * 2 * 3


def test_another_answer_is_seen() -> None:
    recording = [[engines.Turn((1,), (10, 11)), engines.Turn((1, 2), (12, 13))]]
    assert engines.share_same([["10 11", " 12 13 "]], recording, lambda ids: " ".join(map(str, ids))) == 1.0
    assert engines.share_same([["10 11", "12 14"]], recording, lambda ids: " ".join(map(str, ids))) == 0.5


def test_what_servers_may_get_wrong(loopback: Loopback) -> None:
    server = engines.servers([f"a={loopback.url}"], logprobs=True)["a"]
    turns = [[engines.Turn((200, 7), (0, 0))]]
    asyncio.run(engines.replay(server, turns))
    assert loopback.bodies[-1]["logprobs"] == 1
    loopback.missing = 1
    with pytest.raises(LLMError, match="wrote 1 tokens where 2"):
        asyncio.run(engines.replay(server, turns))
    loopback.status = 500
    with pytest.raises(LLMError, match="status 500"):
        asyncio.run(engines.replay(server, turns))
    with pytest.raises(LLMError, match="start the server"):
        engines.servers(["b=http://127.0.0.1:9"], logprobs=False)
    with pytest.raises(LLMError, match="expected NAME=URL"):
        engines.servers(["nonsense"], logprobs=False)


def test_work_is_what_a_forward_multiplies() -> None:
    """Counted by torch: the products of a forward with some logits, attention aside."""
    tokenizer = tiny_tokenizer()
    llm = FixedLengthLLM(tiny_model(tokenizer).eval(), tokenizer, 4)
    model = llm._engine.model
    work = Work.of(model.model)
    assert work.size == 4 * (work.every + work.wanted)

    def packed(x: Any, *_: Any, out_shape: Any, **__: Any) -> int:
        return int(2 * torch.Size(out_shape).numel() * x[-1])

    with model.session(), model.adapter(""):
        counting = FlopCounterMode(display=False, custom_mapping={torch.ops.mkldnn._linear_pointwise: packed})
        with counting:
            model.forward([Segment(Slot(model.layers, 64), list(range(40)), 0, logits=8)])
    counted = sum(n for op, n in counting.get_flop_counts()["Global"].items() if "attention" not in str(op))
    assert counted == 2 * (work.every * 40 + work.wanted * 8)


def test_phases_tell_reading_from_writing() -> None:
    llm = FixedLengthLLM(*(m.eval() if hasattr(m, "eval") else m for m in tiny()), 4)
    phases = Phases(llm)
    jobs = [Job(str(i), [200 + i, *range(20)], Sampling(max_tokens=5)) for i in range(3)]
    llm._engine.run(jobs)
    at = Ceilings(flops=1e12, copied=1e12, read=1e3)  # reading weights decides
    summary = phases.summary(at)
    assert summary["prefill"]["tokens"] == 3 * 21 and summary["prefill"]["forwards"] == 1
    # The first of five tokens is drawn where the prompt ends.
    assert summary["decode"]["tokens"] == 3 * 4 and summary["decode"]["forwards"] == 4
    least = 4 * phases.work.size / at.read
    assert summary["decode"]["utilisation"] == pytest.approx(least / summary["decode"]["cpu_s"])
    assert phases.work.least(1000, 1, Ceilings(1e3, 1.0, 1e12)) == pytest.approx(
        2 * (phases.work.every * 1000 + phases.work.wanted) / 1e3
    )
    phases.clear()
    assert phases.summary(at)["prefill"]["tokens"] == 0


def test_gradients_are_compared_by_norm_and_beside_float64() -> None:
    a = {"w": torch.tensor([3.0, 4.0]), "v": torch.tensor([0.3, 0.0])}
    b = {"w": torch.tensor([3.0, 4.0]), "v": torch.tensor([0.0, 0.3])}
    found = differences(b, a)
    assert found["max_rel_grad_diff"] == pytest.approx(2**0.5)
    whole = (25 + 0.09) ** 0.5
    assert found["max_rel_grad_diff_at"] == {"parameter": "v", "share_of_gradient": pytest.approx(0.3 / whole)}
    assert found["rel_grad_diff"] == pytest.approx(0.3 * 2**0.5 / whole)
    tokenizer = tiny_tokenizer()
    trainer = SimpleNamespace(model=tiny_model(tokenizer))
    before = {n: p.clone() for n, p in trainer.model.named_parameters()}
    ids = torch.arange(40)[None]

    def update() -> None:
        trainer.model(input_ids=ids, labels=ids).loss.backward()

    update()
    single = gradients(trainer)
    exact = in_float64(trainer, update)
    assert {g.dtype for g in exact.values()} == {torch.float64} and {g.dtype for g in single.values()} == {
        torch.float32
    }
    apart = errors({"ours": single}, exact)
    assert 0 < apart["ours_error"] < 1e-5 and apart["ours_error"] <= apart["ours_max_error"]
    # Afterwards the model is, bit for bit, what it was.
    assert all(torch.equal(p, before[n]) for n, p in trainer.model.named_parameters())
    update()
    again = gradients(trainer)
    assert all(torch.equal(again[n], g) for n, g in single.items())


def test_ceilings_are_positive() -> None:
    found = ceilings(torch.device("cpu"))
    assert min(found.flops, found.copied, found.read) > 1e6


def test_the_gguf_file_holds_what_was_dequantised(tmp_path: Path) -> None:
    gguf = pytest.importorskip("gguf")
    from benchmarks.gguf_float32 import write_float32

    rng = np.random.default_rng(0)
    weight, norm = rng.normal(size=(4, 64)).astype(np.float32), np.ones(64, np.float32)
    packed = gguf.quants.quantize(weight, gguf.GGMLQuantizationType.Q4_1)
    writer = gguf.GGUFWriter(tmp_path / "small.gguf", "llama")
    writer.add_file_type(gguf.LlamaFileType.MOSTLY_Q4_1)
    writer.add_token_list(["a", "b"])
    writer.add_block_count(1)
    writer.add_tensor("blk.0.ffn_up.weight", packed, raw_dtype=gguf.GGMLQuantizationType.Q4_1)
    writer.add_tensor("output_norm.weight", norm)
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()
    write_float32(tmp_path / "small.gguf", tmp_path / "float32.gguf")
    reader = gguf.GGUFReader(tmp_path / "float32.gguf")
    found = {t.name: t for t in reader.tensors}
    assert {t.tensor_type for t in found.values()} == {gguf.GGMLQuantizationType.F32}
    expected = gguf.quants.dequantize(packed, gguf.GGMLQuantizationType.Q4_1)
    assert np.array_equal(found["blk.0.ffn_up.weight"].data, expected)
    assert reader.fields["tokenizer.ggml.tokens"].contents() == ["a", "b"]
    assert reader.fields["general.file_type"].contents() == gguf.LlamaFileType.ALL_F32
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []
