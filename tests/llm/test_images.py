"""Pictures from an observation to a model: in the newest turn, sent as data URLs, refused by models that cannot see."""

from __future__ import annotations

import asyncio
import base64
import io
from typing import Any

import numpy as np
import pytest
from PIL import Image

from agentspec.context import Context
from agentspec.episode import Job, Runner, make_env
from agentspec.llm.base import LLMError, Picture, assistant, system, user
from agentspec.llm.chat import render
from agentspec.llm.pictures import data_url, fitted, opened, picture
from agentspec.llm.scripted import ScriptedLLM
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.types import Task
from tests.llm.helpers import request
from tests.llm.test_openai import Server, answer, ask, llm, server  # noqa: F401  (a fixture)

SEEING = AgentSpec.from_data({"reasoning": "direct", "perception": {"name": "generic", "images": True}})
MAP = Task("deliverybench", 0, {"size": "tiny", "images": True, "action_mode": "menu"})


def pixels(height: int, width: int) -> Any:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3)).astype(np.uint8)


def decoded(url: str) -> Any:
    kind, _, data = url.partition(",")
    assert kind == "data:image/png;base64"
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))))


def test_a_picture_keeps_its_pixels() -> None:
    array = pixels(5, 7)
    shown = picture(array)
    assert (shown.width, shown.height) == (7, 5) and np.array_equal(np.asarray(opened(shown)), array)
    assert np.array_equal(decoded(data_url(shown)), array)
    assert user("look", shown).text == "look" and shown == picture(array)
    for wrong in (array.astype(float), array[..., 0], array[:0]):
        with pytest.raises(ValueError, match="expected uint8"):
            picture(wrong)


def test_large_pictures_are_scaled_down_in_proportion() -> None:
    shown = picture(pixels(30, 100))
    small = fitted(shown, 50)
    assert (small.width, small.height) == (50, 15)  # 100 x 30 halved
    assert fitted(shown, 100) is shown
    assert (fitted(picture(pixels(1, 200)), 50).width, fitted(picture(pixels(1, 200)), 50).height) == (50, 1)


@pytest.mark.parametrize("layout", ["conversation", "snapshot"])
def test_pictures_stand_in_the_newest_step_only(layout: Any) -> None:
    context = Context(layout)
    first, second = picture(pixels(4, 4)), picture(pixels(6, 6))

    def where(messages: Any) -> list[tuple[str, list[Picture]]]:
        found = [(m.text, [p for p in m.content if isinstance(p, Picture)]) for m in messages]
        return [(text, shown) for text, shown in found if shown]

    context.pictures = (first,)
    context.prompt("s", "one")
    # A thought between observation and action: the picture stays with the observation.
    assert where(context.think(["hm"], "act")) == [("one", [first])]
    context.close(["GO"])
    assert where(context.messages) == []  # what a summary is made of
    context.pictures = (second,)
    assert where(context.prompt("s", "two")) == [("two", [second])]
    context.pictures = ()
    assert where(context.prompt("s", "two")) == []


def test_a_restored_conversation_shows_the_picture_again() -> None:
    context = Context()
    context.pictures = (picture(pixels(4, 4)),)
    before = context.prompt("s", "one")
    blob = context.snapshot()
    context.think(["hm"], "act")
    context.restore(blob)
    assert context.prompt("s", "one") == before


def test_an_endpoint_is_sent_image_parts(server: Server) -> None:  # noqa: F811
    shown = picture(pixels(30, 100))
    ask(llm(server, max_image_side=50, image_detail="low"), system("s"), user("what is this?", shown), max_tokens=3)
    (body,) = server.bodies
    assert body["messages"][0] == {"role": "system", "content": "s"}  # a turn of text stays a text
    image, text = body["messages"][1]["content"]
    assert text == {"type": "text", "text": "what is this?"}
    assert image["type"] == "image_url" and image["image_url"]["detail"] == "low"
    assert decoded(image["image_url"]["url"]).shape == (15, 50, 3)


def test_the_map_of_deliverybench_reaches_an_endpoint(server: Server) -> None:  # noqa: F811
    env = make_env(MAP)
    observation, info = env.reset(seed=0)
    first = info["action_schema"].choices[0]
    after, *_, told = env.step(first)
    expected = [observation["image"], after["image"]]
    server.script = [answer(first), answer(told["action_schema"].choices[0])]
    [played] = Runner(SEEING, llm(server), max_steps=2).run([Job(MAP)])
    assert played.status == "completed" and len(server.bodies) == 2
    for body, drawn in zip(server.bodies, expected, strict=True):
        sent = [p for m in body["messages"] if isinstance(m["content"], list) for p in m["content"]]
        [image] = [p for p in sent if p["type"] == "image_url"]  # of this step; what was seen before is not sent again
        assert np.array_equal(decoded(image["image_url"]["url"]), drawn) and drawn.shape == (480, 720, 3)


def test_models_that_cannot_see_are_refused_at_the_start(server: Server) -> None:  # noqa: F811
    for backend in (ScriptedLLM(["x"]), llm(server, images=False)):
        with pytest.raises(SpecError, match=r"perception 'generic' needs images.*set `images: False`"):
            Runner(SEEING, backend).run([Job(MAP)])
    assert server.bodies == []
    seen: list[int] = []

    def script(request: Any) -> str:
        seen.append(sum(isinstance(p, Picture) for m in request.messages for p in m.content))
        return str(request.sampling.choices[0])

    [played] = Runner(SEEING, ScriptedLLM(script, images=True), max_steps=3).run([Job(MAP)])
    assert played.status == "completed" and seen == [1, 1, 1]
    # A scripted agent has no model: it may perceive what it does not look at.
    [scripted] = Runner(AgentSpec.from_data({**SEEING.to_data(), "reasoning": "random"}), max_steps=1).run([Job(MAP)])
    assert scripted.status == "completed"


def test_a_picture_is_never_dropped_silently() -> None:
    messages = (user("look", picture(pixels(4, 4))),)
    with pytest.raises(LLMError, match="reads text only"):
        asyncio.run(ScriptedLLM(["x"]).generate(request(messages)))
    pytest.importorskip("transformers")
    from tests.tiny import tiny_tokenizer

    with pytest.raises(LLMError, match=r"holds 1 pictures and .* reads text only"):
        render((*messages, assistant("so")), tiny_tokenizer())


def test_an_environment_without_a_picture_says_so() -> None:
    task = Task("deliverybench", 0, {"size": "tiny"})
    with pytest.raises(ValueError, match="shows no picture; turn it on"):
        spec = SEEING.build(recorder=_recorder())
        env = make_env(task)
        spec.perception.perceive(task, *env.reset(seed=0))


def _recorder() -> Any:
    from agentspec.llm.recorder import Recorder

    return Recorder(ScriptedLLM(["x"]), episode="e", seed=0)
