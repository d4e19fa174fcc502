"""A vision-language model through transformers' processor, on a tiny random one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("transformers")

import torch

from agentspec.episode import Job, Runner
from agentspec.llm import build_llm
from agentspec.llm.base import LLM, ContextOverflowError, LLMError, assistant, system, user
from agentspec.llm.pictures import picture
from agentspec.spec import AgentSpec
from agentspec.types import Task
from tests.llm.helpers import request
from tests.tiny import tiny_model, tiny_tokenizer

TEMPLATE = (
    "{% for m in messages %}<|im_start|>{{ m['role'] }}\n{% for c in m['content'] %}"
    "{% if c['type'] == 'image' %}<image>{% else %}{{ c['text'] }}{% endif %}{% endfor %}<|im_end|>\n{% endfor %}"
    "{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}"
)
RED, BLUE = (picture(np.full((40, 50, 3), colour, np.uint8)) for colour in ((255, 0, 0), (0, 0, 255)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A LLaVA with a CLIP of 2 x 2 patches and a two-layer Llama over bytes, saved as any model is."""
    import transformers as t

    path = tmp_path_factory.mktemp("vlm")
    tokenizer = tiny_tokenizer()
    tokenizer.add_special_tokens({"additional_special_tokens": ["<|im_start|>", "<image>"]})
    size = {"height": 28, "width": 28}
    images = t.CLIPImageProcessorPil(size=size, crop_size=size, do_center_crop=False)
    t.LlavaProcessor(
        image_processor=images,
        tokenizer=tokenizer,
        patch_size=14,
        vision_feature_select_strategy="full",
        num_additional_image_tokens=1,
        chat_template=TEMPLATE,
    ).save_pretrained(path)
    torch.manual_seed(0)
    vision = t.CLIPVisionConfig(
        hidden_size=16, intermediate_size=32, num_hidden_layers=2, num_attention_heads=2, image_size=28, patch_size=14
    )
    text = t.LlamaConfig(
        vocab_size=len(tokenizer),
        hidden_size=32,
        intermediate_size=64,
        num_hidden_layers=2,
        num_attention_heads=2,
        max_position_embeddings=4096,
        initializer_range=0.5,
    )
    config = t.LlavaConfig(
        vision_config=vision,
        text_config=text,
        image_token_id=tokenizer.convert_tokens_to_ids("<image>"),
        vision_feature_select_strategy="full",
        vision_feature_layer=-1,
    )
    t.LlavaForConditionalGeneration(config).save_pretrained(path)
    return path


@pytest.fixture(scope="module")
def llm(folder: Path) -> Any:
    return build_llm({"backend": "vision", "model": str(folder), "device": "cpu", "dtype": "float32"})


def ask(llm: Any, *messages: Any, **sampling: Any) -> Any:
    import asyncio

    return asyncio.run(llm.generate(request(messages, **{"max_tokens": 6, "temperature": 0.0} | sampling)))


def test_it_is_a_backend_that_sees(llm: Any) -> None:
    assert isinstance(llm, LLM) and "images" in llm.capabilities and "logprobs" not in llm.capabilities
    assert llm.max_context == 4096 and llm.count_tokens("abc") == 3
    call = ask(llm, system("s"), user("what?", RED))
    image = llm.tokenizer.convert_tokens_to_ids("<image>")
    # 2 x 2 patches and the class token stand in the picture's place.
    assert call.prompt_ids.count(image) == 5 and call.usage.input_tokens == len(call.prompt_ids)
    assert call.usage.output_tokens == len(call.completions[0].token_ids) > 0
    assert call.model == llm.name


def test_it_answers_what_transformers_does_and_looks_at_the_picture(llm: Any) -> None:
    from agentspec.llm.pictures import opened

    for shown in (RED, BLUE):
        call = ask(llm, user("what?", shown))
        text = "<|im_start|>user\n<image>what?<|im_end|>\n<|im_start|>assistant\n"
        inputs = llm.processor(text=[text], images=[opened(shown)], return_tensors="pt")
        with torch.no_grad():
            logits = llm.model(**inputs).logits[0, -1]
        assert call.prompt_ids == tuple(inputs["input_ids"][0].tolist())
        assert call.completions[0].token_ids[0] == int(logits.argmax())
    with torch.no_grad():
        pair = [
            llm.model(**llm.processor(text=[text], images=[opened(p)], return_tensors="pt")).logits[0, -1]
            for p in (RED, BLUE)
        ]
    assert not torch.equal(*pair)


def test_sampling_is_seeded_and_gives_as_many_as_asked(llm: Any) -> None:
    first = ask(llm, user("what?", RED), temperature=1.0, n=3, seed=5)
    state = torch.random.get_rng_state()
    again = ask(llm, user("what?", RED), temperature=1.0, n=3, seed=5)
    assert torch.equal(state, torch.random.get_rng_state())  # the process's own generator is left alone
    assert first.completions == again.completions and len(set(c.text for c in first.completions)) == 3
    assert len(ask(llm, user("what?"), n=2).completions) == 2  # greedy: the same twice


def test_choices_and_ends(llm: Any) -> None:
    call = ask(llm, user("go?", RED), choices=("go north", "go", "wait"), temperature=1.0, n=4)
    assert {c.text for c in call.completions} <= {"go north", "go", "wait"}
    assert {c.finish_reason for c in call.completions} == {"choice"}
    assert ask(llm, user("x"), max_tokens=3).completions[0].finish_reason == "length"
    continued = ask(llm, user("x", RED), assistant("So I go"))
    text = llm.tokenizer.decode(continued.prompt_ids)
    assert text.endswith("<|im_start|>assistant\nSo I go")


def test_what_it_cannot_do_is_said(llm: Any, tmp_path: Path) -> None:
    import asyncio

    with pytest.raises(ContextOverflowError, match="context is 4096"):
        ask(llm, user("x" * 5000))
    with pytest.raises(LLMError, match="without `score`"):
        asyncio.run(llm.score([user("x")], ["y"]))
    tokenizer = tiny_tokenizer()
    tiny_model(tokenizer).save_pretrained(tmp_path)
    tokenizer.save_pretrained(tmp_path)
    with pytest.raises(LLMError, match="`backend: local`"):
        build_llm({"backend": "vision", "model": str(tmp_path), "device": "cpu"})


def test_it_plays_deliverybench_from_the_map(llm: Any) -> None:
    spec = AgentSpec.from_data({"reasoning": "direct", "perception": {"name": "generic", "images": True}})
    task = Task("deliverybench", 0, {"size": "tiny", "images": True, "action_mode": "menu", "observation": "compact"})
    [played] = Runner(spec, llm, max_steps=2).run([Job(task)])
    assert played.status == "completed" and len(played.transitions) == 2
    assert all(t.decision.valid for t in played.transitions)
