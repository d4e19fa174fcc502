"""The scripted backend is a full one: ids, constraints, stop strings, and answers that depend on the request alone."""

from __future__ import annotations

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agentspec.llm.base import LLM, ContextOverflowError, LLMError, Sampled, assistant, system, user
from agentspec.llm.scripted import ByteTokenizer, ScriptedLLM
from tests.llm.helpers import request

END = ByteTokenizer.END


def ask(llm: ScriptedLLM, *messages, **kwargs):
    return asyncio.run(llm.generate(request(messages or (user("u"),), **kwargs)))


def test_list_answers_by_call_number_and_starts_again():
    llm = ScriptedLLM(["a", "b"])
    assert isinstance(llm, LLM)
    assert [ask(llm, id=i).text for i in (0, 1, 2)] == ["a", "b", "a"]


def test_tokens_are_bytes_and_end_of_turn():
    call = ask(ScriptedLLM(["hé"]))
    # user = 258, "u" = 117, end = 256, assistant = 259
    assert call.prompt_ids == (258, 117, END, 259)
    (completion,) = call.completions
    assert completion.token_ids == (104, 0xC3, 0xA9, END)
    assert completion.logprobs == (0.0,) * 4
    assert completion.finish_reason == "stop"
    assert (call.usage.input_tokens, call.usage.output_tokens) == (4, 4)


def test_function_sees_the_request_and_gives_n_texts():
    llm = ScriptedLLM(lambda r: [f"{r.messages[-1].text}{i}" for i in range(r.sampling.n)])
    assert [c.text for c in ask(llm, n=3).completions] == ["u0", "u1", "u2"]
    with pytest.raises(LLMError, match="list of 2 texts"):
        ask(ScriptedLLM([["only one"]]), n=2)


def test_choices_record_what_was_allowed():
    call = ask(ScriptedLLM(["go"]), choices=("go", "gone"))
    (completion,) = call.completions
    # g and o are forced; after "go" either the turn ends or "n" (110) follows.
    assert completion.allowed == ((103,), (111,), (110, END))
    assert completion.finish_reason == "choice"
    with pytest.raises(LLMError, match="none of the choices"):
        ask(ScriptedLLM(["stay"]), choices=("go",))


def test_stop_string_cuts_the_text_not_the_tokens():
    (completion,) = ask(ScriptedLLM(["think\nact"]), stop=("\n", "act")).completions
    assert completion.text == "think"
    assert completion.token_ids == tuple(b"think\n")


def test_max_tokens_cuts():
    (completion,) = ask(ScriptedLLM(["hello"]), max_tokens=3).completions
    assert (completion.text, completion.token_ids, completion.finish_reason) == ("hel", tuple(b"hel"), "length")


def test_prompts_extend():
    llm = ScriptedLLM(["yes"])
    first = ask(llm, system("s"), user("u"))
    turn = assistant(Sampled.of(first.completions[0]))
    later = ask(llm, system("s"), user("u"), turn, user("v"))
    start = first.prompt_ids + first.completions[0].token_ids
    assert later.prompt_ids[: len(start)] == start
    assert later.prompt_ids.count(END) == 4
    continued = ask(llm, user("u"), assistant("because "))
    assert continued.prompt_ids == (258, 117, END, 259, *b"because ")


def test_score_default_and_function():
    assert asyncio.run(ScriptedLLM(["x"]).score([user("u")], ["ab", ""])) == (-2.0, 0.0)
    llm = ScriptedLLM(["x"], score=lambda messages, text: {"a": -1.0}.get(text, -9.0))
    assert asyncio.run(llm.score([user("u")], ["a", "b"], episode="e")) == (-1.0, -9.0)


def test_context_and_script_errors():
    # 4 prompt tokens + 7 new > 10
    with pytest.raises(ContextOverflowError, match=r"4 tokens.*7.*10"):
        ask(ScriptedLLM(["x"], max_context=10), max_tokens=7)
    with pytest.raises(ValueError, match="function or a non-empty list"):
        ScriptedLLM("text")


@given(st.text())
def test_byte_tokenizer_is_reversible(text):
    tokenizer = ByteTokenizer()
    encodable = text.encode("utf-8", "ignore").decode()
    assert tokenizer.decode(tokenizer.encode(encodable)) == encodable
