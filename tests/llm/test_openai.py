"""The HTTP backend against a loopback server: requests as the protocol wants them, retries, errors with a remedy."""

from __future__ import annotations

import asyncio
import json
import sys
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from agentspec.llm.base import LLM, ContextOverflowError, LLMError, Sampled, assistant, system, user
from agentspec.llm.openai import OpenAILLM, match_choice
from agentspec.types import Usage
from tests.llm.helpers import request

httpx = pytest.importorskip("httpx")


def answer(*texts: str, **extra: Any) -> dict[str, Any]:
    choices = [{"index": i, "message": {"content": t}, "finish_reason": "stop"} for i, t in enumerate(texts)]
    usage = {"prompt_tokens": 10, "completion_tokens": 2, "prompt_tokens_details": {"cached_tokens": 4}}
    return {"choices": choices, "usage": usage} | extra


class Server:
    """Answers request number ``i`` with ``script[i]`` (the last for all later ones): (status, body, headers)."""

    def __init__(self) -> None:
        self.script: list[Any] = [answer("hi")]
        self.bodies: list[dict[str, Any]] = []
        self.headers: list[dict[str, str]] = []
        self.delay: Callable[[int], float] = lambda i: 0.0
        self.active = self.most_active = 0
        self._lock = threading.Lock()
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["content-length"])))
                with outer._lock:
                    number = len(outer.bodies)
                    outer.bodies.append(body | {"path": self.path})
                    outer.headers.append({k.lower(): v for k, v in self.headers.items()})
                    outer.active += 1
                    outer.most_active = max(outer.most_active, outer.active)
                threading.Event().wait(outer.delay(number))
                with outer._lock:
                    outer.active -= 1
                step = outer.script[min(number, len(outer.script) - 1)]
                status, content, headers = step if isinstance(step, tuple) else (200, step, {})
                data = content.encode() if isinstance(content, str) else json.dumps(content).encode()
                try:
                    self.send_response(status)
                    for name, value in (headers | {"content-length": str(len(data))}).items():
                        self.send_header(name, value)
                    self.end_headers()
                    self.wfile.write(data)
                except OSError:
                    pass  # the client has hung up, as the time-out test wants

            def log_message(self, *args: Any) -> None:
                pass

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.http.server_port}/v1"
        threading.Thread(target=self.http.serve_forever, args=(0.01,), daemon=True).start()


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    yield server
    server.http.shutdown()
    server.http.server_close()


def llm(at: Server, **kwargs: Any) -> OpenAILLM:
    settings = {"base_url": at.url, "api_key": "sk-secret", "first_pause_s": 0.001, "timeout_s": 10.0}
    return OpenAILLM("model-x", **(settings | kwargs))


def ask(backend: OpenAILLM, *messages, **kwargs):
    async def main():
        try:
            return await backend.generate(request(messages or (system("s"), user("u")), **kwargs))
        finally:
            await backend.aclose()

    return asyncio.run(main())


def error(status: int, message: str, **headers: str):
    return status, {"error": {"message": message}}, headers


def test_request_and_answer(server):
    backend = llm(server)
    assert isinstance(backend, LLM)
    call = ask(backend, seed=2**40 + 5, temperature=0.5, top_p=0.9, max_tokens=7, stop=("\n",), id=3)
    (body,) = server.bodies
    assert body == {
        "path": "/v1/chat/completions",
        "model": "model-x",
        "messages": [{"role": "system", "content": "s"}, {"role": "user", "content": "u"}],
        "temperature": 0.5,
        "top_p": 0.9,
        "n": 1,
        "seed": 5,  # the low 31 bits: some servers take no more
        "max_tokens": 7,
        "stop": ["\n"],
    }
    assert server.headers[0]["authorization"] == "Bearer sk-secret"
    assert (call.id, call.text, call.model, call.prompt_ids) == (3, "hi", "model-x", ())
    assert call.usage == Usage(10, 2, 4)


def test_environment_gives_key_and_address(server, monkeypatch):
    monkeypatch.setenv("OPENAI_BASE_URL", server.url + "/")
    monkeypatch.setenv("OPENAI_API_KEY", "sk-env")
    assert ask(OpenAILLM("m")).text == "hi"
    assert server.headers[0]["authorization"] == "Bearer sk-env"
    monkeypatch.delenv("OPENAI_BASE_URL")
    monkeypatch.delenv("OPENAI_API_KEY")
    with pytest.raises(LLMError, match=r"no API key.*OPENAI_API_KEY"):
        OpenAILLM("m")


def test_n_is_asked_for_and_filled_up(server):
    # The server gives two of three; the third is asked for with another seed.
    server.script = [answer("a", "b"), answer("c", "d")]
    call = ask(llm(server), n=3, seed=1)
    assert [c.text for c in call.completions] == ["a", "b", "c"]
    assert [b["n"] for b in server.bodies] == [3, 1]
    assert server.bodies[0]["seed"] != server.bodies[1]["seed"]
    assert call.usage == Usage(20, 4, 8)


@pytest.mark.parametrize(
    "first", [error(429, "slow down"), error(500, "oops"), error(503, "busy"), (502, "<html>", {})]
)
def test_passing_failures_are_retried(server, first):
    server.script = [first, first, answer("hi")]
    assert ask(llm(server)).text == "hi"
    assert len(server.bodies) == 3
    assert server.bodies[0] == server.bodies[2]


def test_the_pause_is_the_servers_or_grows_with_seeded_jitter(server, monkeypatch):
    pauses: list[float] = []
    sleep = asyncio.sleep

    async def note(seconds: float, *args: Any) -> None:
        if seconds > 0.01:
            pauses.append(seconds)
        await sleep(0)

    monkeypatch.setattr("agentspec.llm.openai.asyncio.sleep", note)
    script = [error(429, "x", **{"retry-after": "7"}), error(500, "x"), error(500, "x"), answer("hi")]
    for _ in range(2):
        server.bodies.clear()
        server.script = script
        ask(llm(server, first_pause_s=1.0), seed=4)
    first, again = pauses[:3], pauses[3:]
    assert first == again
    assert first[0] == 7.0
    # 1 s x 2^attempt x (0.5 ... 1.5)
    assert 1.0 <= first[1] <= 3.0
    assert 2.0 <= first[2] <= 6.0


def test_gives_up_with_the_last_problem(server):
    server.script = [error(500, "broken pipe in the cellar")]
    with pytest.raises(LLMError, match=r"3 attempts.*HTTP 500: broken pipe in the cellar.*max_retries"):
        ask(llm(server, max_retries=2))


def test_time_out_is_retried_then_named(server):
    server.delay = lambda i: 3.0 if i == 0 else 0.0
    assert ask(llm(server, timeout_s=1.0)).text == "hi"
    server.delay = lambda i: 3.0
    with pytest.raises(LLMError, match=r"no answer within 1"):
        ask(llm(server, timeout_s=1.0, max_retries=0))


def test_a_missing_library_is_told_before_anything_is_asked(monkeypatch):
    monkeypatch.setitem(sys.modules, "httpx", None)  # importing it raises ImportError
    with pytest.raises(LLMError, match=r"needs httpx; run `pip install 'agentspec-rl\[openai\]'`"):
        OpenAILLM("m", base_url="http://127.0.0.1:9/v1")


def test_no_server():
    backend = OpenAILLM("m", base_url="http://127.0.0.1:9/v1", max_retries=1, first_pause_s=0.001)
    with pytest.raises(LLMError, match="connection failed"):
        ask(backend)


@pytest.mark.parametrize(
    ("status", "message", "expected"),
    [
        (401, "Incorrect API key provided: sk-secret", "HTTP 401.*OPENAI_API_KEY"),
        (403, "no access", "OPENAI_API_KEY"),
        (404, "The model `model-x` does not exist", "check `model` and `base_url`"),
        (400, "temperature must be below 2", "temperature must be below 2"),
        (429, "insufficient_quota: pay first", "no quota left"),
    ],
)
def test_refusals_are_not_retried_and_say_what_to_do(server, status, message, expected):
    server.script = [error(status, message)]
    with pytest.raises(LLMError, match=expected) as caught:
        ask(llm(server))
    assert len(server.bodies) == 1
    assert "sk-secret" not in str(caught.value)


@pytest.mark.parametrize(
    "message", ["This model's maximum context length is 8192 tokens", "prompt exceeds the context window"]
)
def test_long_prompts_are_an_overflow(server, message):
    server.script = [error(400, message)]
    with pytest.raises(ContextOverflowError, match="smaller budget"):
        ask(llm(server))


@pytest.mark.parametrize("content", ["<html>hello</html>", {"object": "list"}, {"choices": []}])
def test_not_an_api(server, content):
    server.script = [(200, content, {})]
    with pytest.raises(LLMError, match=r"without `choices`.*/v1"):
        ask(llm(server))


def test_concurrency_is_bounded(server):
    server.delay = lambda i: 0.03
    backend = llm(server, max_concurrency=2)

    async def main():
        calls = [backend.generate(request([user("u")], id=i)) for i in range(8)]
        result = await asyncio.gather(*calls)
        await backend.aclose()
        return result

    assert len(asyncio.run(main())) == 8
    assert server.most_active == 2


def test_client_survives_a_new_event_loop(server):
    backend = llm(server)
    for _ in range(2):
        assert asyncio.run(backend.generate(request([user("u")]))).text == "hi"


def test_choices_are_matched_up_to_case_space_and_punctuation(server):
    server.script = [answer(' "Go North." '), answer("fly")]
    backend = llm(server)
    (found,) = ask(backend, choices=("go north", "go")).completions
    assert (found.text, found.finish_reason) == ("go north", "choice")
    (raw,) = ask(backend, choices=("go north", "go")).completions
    assert (raw.text, raw.finish_reason) == ("fly", "stop")
    # Not one choice but two: the answer stays as it is.
    assert match_choice("A B", ["a-b", "a b."]) == ("A B", False)


def test_vllm_gives_ids_logprobs_and_constraints(server):
    choice = {
        "message": {"content": "go"},
        "finish_reason": "stop",
        "token_ids": [5, 6],
        "logprobs": {"content": [{"token": "g", "logprob": -0.5}, {"token": "o", "logprob": 0.0}]},
    }
    server.script = [{"choices": [choice], "prompt_token_ids": [1, 2, 3]}]
    backend = llm(server, server="vllm")
    assert {"token_ids", "logprobs"} <= backend.capabilities
    turn = assistant("I ", Sampled("go", (9,)))
    call = ask(backend, user("u"), turn, choices=("go", "stay"), top_k=5)
    (completion,) = call.completions
    assert (completion.token_ids, completion.logprobs, call.prompt_ids) == ((5, 6), (-0.5, 0.0), (1, 2, 3))
    (body,) = server.bodies
    assert body["structured_outputs"] == {"choice": ["go", "stay"]}
    assert (body["top_k"], body["return_token_ids"], body["continue_final_message"]) == (5, True, True)
    assert body["messages"][-1] == {"role": "assistant", "content": "I go"}
    ask(llm(server, server="vllm", choices="guided_choice", extra_body={"min_p": 0.1}), choices=("go",))
    assert (server.bodies[-1]["guided_choice"], server.bodies[-1]["min_p"]) == (["go"], 0.1)


def test_what_the_protocol_cannot_do_is_said(server):
    backend = llm(server)
    assert "score" not in backend.capabilities
    with pytest.raises(LLMError, match="cannot score"):
        asyncio.run(backend.score([user("u")], ["x"]))
    with pytest.raises(LLMError, match="top_k"):
        ask(backend, top_k=3)
    with pytest.raises(ValueError, match="unknown server"):
        llm(server, server="vlm")
    assert backend.count_tokens("12345") == 2


@pytest.mark.parametrize(
    ("parameter", "message"),
    [
        ("temperature", "Unsupported value: 'temperature' does not support 0.5 with this model."),
        ("top_p", "Unsupported parameter: 'top_p' is not supported with this model."),
        ("stop", "Unsupported parameter: 'stop' is not supported with this model."),
        ("seed", "Extra inputs are not permitted: seed"),
    ],
)
def test_a_parameter_that_is_rejected_is_left_out_from_then_on_with_one_note(server, caplog, parameter, message):
    server.script = [error(400, message), answer("one"), answer("two STOP three")]
    backend = llm(server)
    wanted = {"temperature": 0.5, "top_p": 0.9, "stop": ("STOP",)}
    first, _ = ask(backend, user("x"), **wanted), ask(backend, user("x"), **wanted)
    assert first.text == "one"
    assert [parameter in body for body in server.bodies] == [True, False, False]
    assert message in backend.rejected[parameter] and len(caplog.records) == 1
    for other in {"temperature", "top_p", "seed"} - {parameter}:
        assert other in server.bodies[-1]


def test_stop_strings_that_are_rejected_are_cut_here(server):
    server.script = [error(400, "Unsupported parameter: 'stop' is not supported"), answer("yes STOP no")]
    assert ask(llm(server), user("x"), stop=("STOP",)).text == "yes "


def test_several_samples_of_an_endpoint_that_gives_one(server):
    server.script = [error(400, "Invalid value: 'n' must be 1 for this model"), answer("a"), answer("b"), answer("c")]
    call = ask(llm(server), user("x"), n=3)
    assert [c.text for c in call.completions] == ["a", "b", "c"] and "n" not in server.bodies[-1]


def test_max_tokens_takes_its_new_name_where_asked_for(server):
    said = "Unsupported parameter: 'max_tokens' is not supported with this model. Use 'max_completion_tokens' instead."
    server.script = [error(400, said), answer("a")]
    backend = llm(server)
    ask(backend, user("x"), max_tokens=7), ask(backend, user("x"), max_tokens=7)
    assert [(b.get("max_tokens"), b.get("max_completion_tokens")) for b in server.bodies] == [
        (7, None),
        (None, 7),
        (None, 7),
    ]
    assert not backend.rejected


def test_other_refusals_are_still_refusals(server):
    server.script = [error(400, "the messages are malformed")]
    with pytest.raises(LLMError, match="malformed"):
        ask(llm(server), user("x"))
    assert len(server.bodies) == 1


def test_template_variables_reach_the_server(server):
    ask(llm(server, template_kwargs={"enable_thinking": False}), user("x"))
    assert server.bodies[0]["chat_template_kwargs"] == {"enable_thinking": False}


def test_reasoning_has_room_of_its_own():
    from agentspec.types import Sampling

    assert Sampling().max_tokens >= 1024
    assert Sampling(max_tokens=100, reasoning_tokens=400).with_room() == Sampling(max_tokens=500)
    assert Sampling(max_tokens=100, reasoning_tokens=400, choices=("a",)).with_room().max_tokens == 100
