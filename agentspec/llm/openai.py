"""A model behind an OpenAI-compatible chat-completions endpoint: a commercial API, or one's own vLLM server.

What the protocol cannot do is said, not hidden. A plain server reports no token ids, so its records can be evaluated
and priced but not trained on; a vLLM server (``server="vllm"``) reports ids and log-probabilities, constrains choices
and continues an assistant turn. (vLLM reports log-probabilities of the unmodified model unless it is started with
``--logprobs-mode processed_logprobs``; training needs those of the sampling distribution.)

Choices without server support: the model answers freely; an answer that equals one of the choices up to case, space and
punctuation is taken as that choice, and any other is returned as it is, for the parser of actions to report.

Models that reason do not take every parameter of the protocol. Which ones an endpoint rejects is learnt from its 400
answer: the parameter is left out from then on, with one note in the log, and stands in :attr:`OpenAILLM.rejected`; a
method that needs it (samples that vote need a temperature) refuses to go on with that reason. ``max_tokens`` becomes
``max_completion_tokens`` in the same way, ``n`` becomes as many requests, stop strings are cut afterwards.

Failures that may pass (429, 5xx, time-outs, broken connections) are tried again after a growing, jittered pause, or
the one the server asks for; the jitter comes from the request's seed. Others are raised at once with what to do about
them.
"""

from __future__ import annotations

import asyncio
import email.utils
import logging
import os
import random
import re
import time
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from agentspec.llm.base import ContextOverflowError, LLMError, Message, Request
from agentspec.llm.pictures import LARGEST, data_url, fitted, refuse_pictures
from agentspec.llm.recorder import derive_seed
from agentspec.types import Completion, LLMCall, Picture, Usage

_DEFAULT_URL = "https://api.openai.com/v1"
_RETRIED = frozenset({408, 409, 429, 500, 502, 503, 504, 529})
_LONGEST_PAUSE_S = 60.0
_LEARNT = -1.0  # in place of a pause: the request was mended and is made again at once
_OPTIONAL = ("temperature", "top_p", "stop", "n", "seed", "logprobs", "presence_penalty", "chat_template_kwargs")
"""Parameters a request can do without, in the order in which they are looked for in a refusal."""

_REFUSED = re.compile(
    r"unsupported|not supported|does not support|unrecognized|unknown|not permitted|extra inputs|unexpected|only the "
    r"default|deprecated|not allowed|must be 1\b|invalid.{0,20}(parameter|value)|not compatible",
    re.IGNORECASE,
)
_LOG = logging.getLogger(__name__)
_CONTEXT = re.compile(r"context.{0,20}(length|window)|maximum.{0,20}(context|tokens)|too many (input )?tokens", re.I)


class OpenAILLM:
    """An :class:`~agentspec.llm.base.LLM` over HTTP.

    Args:
        model: the server's name of the model.
        base_url: address of the API; default ``OPENAI_BASE_URL``, else OpenAI's.
        api_key: the key; default the environment variable ``api_key_env``. Own servers often need none.
        api_key_env: which environment variable holds the key.
        server: ``"openai"``, or ``"vllm"`` to use what vLLM adds to the protocol.
        choices: how a vLLM server is asked for constrained output: ``structured_outputs``, or ``guided_choice`` for
            versions before 0.12.
        max_tokens_key: ``max_completion_tokens`` for OpenAI's reasoning models.
        extra_body: further fields of every request.
        template_kwargs: variables of the server's chat template (``{"enable_thinking": False}``), sent as
            ``chat_template_kwargs``, which vLLM and SGLang know.
        timeout_s: per attempt.
        max_retries: attempts after the first.
        max_concurrency: requests in flight at once.
        first_pause_s: pause before the first retry; it doubles with each.
        max_context: context window in tokens, where the server's is known.
        images: whether the model sees; `False` refuses pictures before the first episode.
        max_image_side: pictures are scaled down until their longer side has at most this many pixels.
        image_detail: the protocol's `detail` of pictures (`low`, `high`, `auto`); empty: not sent.
    """

    def __init__(
        self,
        model: str,
        *,
        base_url: str | None = None,
        api_key: str | None = None,
        api_key_env: str = "OPENAI_API_KEY",
        server: Literal["openai", "vllm"] = "openai",
        choices: Literal["structured_outputs", "guided_choice"] = "structured_outputs",
        max_tokens_key: Literal["max_tokens", "max_completion_tokens"] = "max_tokens",
        extra_body: Mapping[str, Any] | None = None,
        template_kwargs: Mapping[str, Any] | None = None,
        timeout_s: float = 120.0,
        max_retries: int = 6,
        max_concurrency: int = 16,
        first_pause_s: float = 0.5,
        max_context: int = 128_000,
        images: bool = True,
        max_image_side: int = LARGEST,
        image_detail: str = "",
    ) -> None:
        if server not in ("openai", "vllm"):
            raise ValueError(f"unknown server {server!r}; expected 'openai' or 'vllm'")
        if choices not in ("structured_outputs", "guided_choice"):
            raise ValueError(f"unknown way of choices {choices!r}; expected 'structured_outputs' or 'guided_choice'")
        import_httpx()
        self.name = model
        self.max_context = max_context
        self.base_url = (base_url or os.environ.get("OPENAI_BASE_URL") or _DEFAULT_URL).rstrip("/")
        self._key = api_key or os.environ.get(api_key_env, "")
        self._key_env = api_key_env
        if not self._key and self.base_url == _DEFAULT_URL:
            raise LLMError(f"no API key for {self.base_url}; set {api_key_env}, or `base_url` to your own server")
        self._vllm = server == "vllm"
        self._choices = choices
        self._max_tokens_key = max_tokens_key
        self._extra = dict(extra_body or {})
        if template_kwargs:
            self._extra["chat_template_kwargs"] = dict(template_kwargs)
        self.rejected: dict[str, str] = {}
        self._timeout = timeout_s
        self._retries = max_retries
        self._concurrency = max_concurrency
        self._first_pause = first_pause_s
        self._loop: asyncio.AbstractEventLoop | None = None
        self._client: Any = None
        self._slots = asyncio.Semaphore(max_concurrency)
        self._largest = max_image_side
        self._detail = {"detail": image_detail} if image_detail else {}
        own = {"token_ids", "logprobs"} if self._vllm else set()
        sees = {"images"} if images else set()
        self.capabilities = frozenset({"choices", "n"} | own | sees)

    async def generate(self, request: Request) -> LLMCall:
        """Ask the server for ``n`` completions; asks again for the rest where it gives fewer.

        Raises:
            ContextOverflowError: the server says the prompt is too long.
            LLMError: any other refusal, or all attempts failed.
        """
        began = time.perf_counter()
        sampling = request.sampling
        if "images" not in self.capabilities:
            refuse_pictures(request.messages, f"{self.name} (`images: false`)")
        if sampling.top_k and not self._vllm:
            raise LLMError(f"top_k={sampling.top_k} is not part of the OpenAI protocol; set it to 0, or `server: vllm`")
        completions: list[Completion] = []
        usage = Usage()
        prompt_ids: tuple[int, ...] = ()
        while len(completions) < sampling.n:
            answer = await self._ask(request, len(completions))
            got = [self._completion(c, request) for c in answer["choices"]]
            completions.extend(got[: sampling.n - len(completions)])
            usage = _add(usage, answer.get("usage") or {})
            prompt_ids = tuple(answer.get("prompt_token_ids") or ())
        latency = time.perf_counter() - began
        return LLMCall(request.id, request.tag, prompt_ids, tuple(completions), sampling, usage, latency, self.name)

    async def score(
        self, messages: Sequence[Message], continuations: Sequence[str], *, episode: str = ""
    ) -> tuple[float, ...]:
        """Not possible over this protocol.

        Raises:
            LLMError: always.
        """
        raise LLMError(
            f"{self.name} at {self.base_url} cannot score given continuations (the chat protocol has no such call); "
            "use the `local` backend, or a method that needs no `score`"
        )

    def count_tokens(self, text: str) -> int:
        """An estimate: a token per four bytes."""
        return -(-len(text.encode("utf-8")) // 4)

    def enter(self, episode: str) -> None:
        """Nothing to do: the server batches."""

    def leave(self, episode: str) -> None:
        """Nothing to do."""

    async def aclose(self) -> None:
        """Close the connections."""
        if self._client is not None:
            await self._client.aclose()
            self._client = self._loop = None

    def _body(self, request: Request, have: int) -> dict[str, Any]:
        sampling = request.sampling
        body: dict[str, Any] = {
            "model": self.name,
            "messages": [{"role": m.role, "content": self._content(m)} for m in request.messages],
            "temperature": sampling.temperature,
            "top_p": sampling.top_p,
            "n": sampling.n - have,
            "seed": derive_seed(request.seed, have) & 0x7FFFFFFF if have else request.seed & 0x7FFFFFFF,
            self._max_tokens_key: sampling.max_tokens,
        }
        if sampling.stop:
            body["stop"] = list(sampling.stop)
        if self._vllm:
            body |= {"logprobs": True, "return_token_ids": True}
            if sampling.top_k:
                body["top_k"] = sampling.top_k
            if sampling.choices:
                listed = list(sampling.choices)
                native = self._choices == "structured_outputs"
                body |= {"structured_outputs": {"choice": listed}} if native else {"guided_choice": listed}
            if request.messages[-1].role == "assistant":
                body |= {"continue_final_message": True, "add_generation_prompt": False}
        body |= self._extra
        return {key: value for key, value in body.items() if key not in self.rejected}

    def _learn(self, problem: str, body: dict[str, Any]) -> bool:
        """Whether a refusal names a parameter that can be left out or renamed; it is, from now on."""
        if "max_completion_tokens" in problem and "max_tokens" in body:
            self._max_tokens_key = "max_completion_tokens"
            body["max_completion_tokens"] = body.pop("max_tokens")
            return True
        if not _REFUSED.search(problem):
            return False
        for name in _OPTIONAL:
            if name in body and re.search(rf"\b{name}\b", problem):
                self.rejected.setdefault(name, problem)
                del body[name]
                _LOG.warning(
                    "%s at %s does not take `%s` (%s); it is left out from now on",
                    self.name,
                    self.base_url,
                    name,
                    problem,
                )
                return True
        return False

    def _content(self, message: Message) -> str | list[dict[str, Any]]:
        """A turn as the protocol writes it: text, or parts where there are pictures."""
        if not any(isinstance(part, Picture) for part in message.content):
            return message.text
        parts: list[dict[str, Any]] = []
        for part in message.content:
            if isinstance(part, Picture):
                url = {"url": data_url(fitted(part, self._largest))}
                parts.append({"type": "image_url", "image_url": url | self._detail})
            else:
                parts.append({"type": "text", "text": part if isinstance(part, str) else part.text})
        return parts

    def _completion(self, choice: Mapping[str, Any], request: Request) -> Completion:
        text = (choice.get("message") or {}).get("content") or ""
        if "stop" in self.rejected:
            cuts = [text.index(stop) for stop in request.sampling.stop if stop in text]
            text = text[: min(cuts)] if cuts else text
        ids = tuple(choice.get("token_ids") or ())
        entries = (choice.get("logprobs") or {}).get("content") or ()
        logprobs = tuple(float(e["logprob"]) for e in entries)
        if len(logprobs) != len(ids):
            # Log-probabilities without the tokens they belong to are of no use to anyone downstream.
            logprobs = ()
        reason = "length" if choice.get("finish_reason") == "length" else "stop"
        if request.sampling.choices:
            text, found = match_choice(text, request.sampling.choices)
            reason = "choice" if found else reason
        return Completion(text, ids, logprobs, (), reason)

    async def _ask(self, request: Request, have: int) -> dict[str, Any]:
        """One answer of the server, after as many attempts as it takes."""
        import_httpx()
        self._adopt_loop()
        body = self._body(request, have)
        jitter = random.Random(derive_seed("retry", request.seed, request.id, have))
        problem = ""
        for attempt in range(self._retries + 1):
            async with self._slots:
                answer, problem, pause = await self._attempt(body)
                while answer is None and pause == _LEARNT:
                    answer, problem, pause = await self._attempt(body)
            if answer is not None:
                return answer
            if attempt < self._retries:
                backoff = self._first_pause * 2**attempt * (0.5 + jitter.random())
                await asyncio.sleep(min(_LONGEST_PAUSE_S, max(pause, backoff)))
        raise LLMError(
            f"{self.name} at {self.base_url} did not answer in {self._retries + 1} attempts; the last: {problem}. "
            "Check the server, or raise `max_retries` or `timeout_s`, or lower `max_concurrency`"
        )

    async def _attempt(self, body: dict[str, Any]) -> tuple[dict[str, Any] | None, str, float]:
        """The answer, or why there is none yet and how long the server asks to wait."""
        httpx = import_httpx()
        try:
            response = await self._client.post(f"{self.base_url}/chat/completions", json=body)
        except httpx.TimeoutException:
            return None, f"no answer within {self._timeout:g} s", 0.0
        except httpx.TransportError as error:
            return None, f"the connection failed ({error or type(error).__name__})", 0.0
        if response.status_code != 200:
            problem = self._redact(f"HTTP {response.status_code}: {_message(response)}")
            if response.status_code in (400, 422) and self._learn(problem, body):
                return None, problem, _LEARNT
            if response.status_code not in _RETRIED or "insufficient_quota" in response.text:
                raise self._refusal(response.status_code, problem)
            return None, problem, _retry_after(response.headers.get("retry-after"))
        try:
            answer = response.json()
        except ValueError:
            answer = None
        if not isinstance(answer, dict) or not isinstance(answer.get("choices"), list) or not answer["choices"]:
            raise LLMError(
                f"{self.base_url} answered without `choices`: {self._redact(response.text[:200])!r}; is this the "
                "address of an OpenAI-compatible API (it usually ends in /v1)?"
            )
        return answer, "", 0.0

    def _refusal(self, status: int, problem: str) -> LLMError:
        where = f"{self.name} at {self.base_url}"
        if _CONTEXT.search(problem) and status in (400, 413, 422):
            return ContextOverflowError(
                f"{where}: the prompt does not fit ({problem}); shorten it (a memory with a smaller budget, a "
                "summary), lower `max_tokens`, or use a model with a longer context"
            )
        remedies = {
            401: f"the API key is missing or wrong; set {self._key_env}",
            403: f"the API key may not use this model; check the account behind {self._key_env}",
            404: "there is no such model or address; check `model` and `base_url` (it usually ends in /v1)",
            429: "the account has no quota left",
        }
        return LLMError(f"{where}: {problem}; {remedies.get(status, 'the server does not accept the request')}")

    def _redact(self, text: str) -> str:
        return text.replace(self._key, "***") if self._key else text

    def _adopt_loop(self) -> None:
        """Connections and semaphores belong to one event loop; a new one gets new ones."""
        loop = asyncio.get_running_loop()
        if self._loop is loop:
            return
        httpx = import_httpx()
        headers = {"Authorization": f"Bearer {self._key}"} if self._key else {}
        limits = httpx.Limits(max_connections=self._concurrency)
        self._client = httpx.AsyncClient(headers=headers, timeout=self._timeout, limits=limits)
        self._slots = asyncio.Semaphore(self._concurrency)
        self._loop = loop


def import_httpx() -> Any:
    """The HTTP library, which only this backend needs.

    Raises:
        LLMError: it is not installed.
    """
    try:
        import httpx
    except ImportError:
        raise LLMError("the `openai` backend needs httpx; run `pip install 'agentspec-rl[openai]'`") from None
    return httpx


def match_choice(text: str, choices: Sequence[str]) -> tuple[str, bool]:
    """The choice that equals ``text`` up to case, space and punctuation and True; else ``text`` and False."""
    if text in choices:
        return text, True
    found = [c for c in choices if _plain(c) == _plain(text)]
    return (found[0], True) if len(found) == 1 else (text, False)


def _plain(text: str) -> str:
    return re.sub(r"[\W_]+", "", text.casefold())


def _add(usage: Usage, reported: Mapping[str, Any]) -> Usage:
    details = reported.get("prompt_tokens_details") or {}
    return Usage(
        usage.input_tokens + int(reported.get("prompt_tokens") or 0),
        usage.output_tokens + int(reported.get("completion_tokens") or 0),
        usage.cached_tokens + int(details.get("cached_tokens") or 0),
    )


def _message(response: Any) -> str:
    """The server's own words for what went wrong."""
    try:
        error = response.json().get("error", {})
        return str(error.get("message") if isinstance(error, dict) else error)[:500] or response.text[:500]
    except (ValueError, AttributeError):
        return str(response.text[:500])


def _retry_after(value: str | None) -> float:
    """Seconds of a Retry-After header, which is a number or a date."""
    if not value:
        return 0.0
    try:
        return max(0.0, float(value))
    except ValueError:
        pass
    try:
        return max(0.0, email.utils.parsedate_to_datetime(value).timestamp() - time.time())
    except (TypeError, ValueError):
        return 0.0
