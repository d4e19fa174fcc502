"""Worlds as tools of stock TRL: schemas that TRL derives, episodes played through them, and two updates."""

from __future__ import annotations

import inspect

import pytest

from agentspec.interop.trl import dataset, environment_factory
from agentspec.registry import SpecError

EMPTY = {"level": "MiniGrid-Empty-5x5-v0", "observation": "compact", "max_steps": 12}


def schemas(tools):
    from transformers.utils import get_json_schema

    members = inspect.getmembers(type(tools), predicate=inspect.isfunction)
    names = [n for n, _ in members if not n.startswith("_") and n not in ("reset", "get_reward")]
    return {n: get_json_schema(getattr(tools, n))["function"] for n in names}


def test_every_action_is_a_tool_with_typed_parameters():
    pytest.importorskip("minigrid")
    grid = schemas(environment_factory("minigrid", EMPTY)())
    assert set(grid) == {"turn_left", "turn_right", "forward", "pick_up", "drop", "toggle", "done"}
    assert grid["forward"]["description"] == "Move one cell in the direction you face."
    city = schemas(environment_factory("deliverybench", {"size": "tiny"})())
    turn = city["turn_around"]["parameters"]
    assert turn["properties"]["direction"]["enum"] == ["left", "right"]
    assert turn["properties"]["angle"]["type"] == "number" and turn["required"] == ["angle"]
    house = schemas(environment_factory("alfred", {})())
    assert house["pickup"]["parameters"]["required"] == ["object"]
    assert house["pickup"]["parameters"]["properties"]["object"]["type"] == "string"


def test_an_episode_through_the_tools():
    pytest.importorskip("minigrid")
    tools = environment_factory("minigrid", EMPTY)()
    assert "In front: nothing" in tools.reset(seed=3, prompt="rows carry more than the seed")
    # From the upper left corner, facing east, the goal of 5x5 is two cells right and two down: F F R F F.
    for step in (tools.forward, tools.forward, tools.turn_right, tools.forward):
        assert "over" not in step()
    assert tools.get_reward() == 0.0
    assert tools.forward().endswith("The episode is over.")
    assert tools.get_reward() == pytest.approx(1 - 0.9 * 5 / 12)
    assert tools.forward() == "The episode is over."
    tools.reset(seed=3)
    assert tools.get_reward() == 0.0


def test_arguments_reach_the_world_as_a_call():
    city = environment_factory("deliverybench", {"size": "tiny"})()
    city.reset(seed=0)
    before = city._game.info["state"]
    city.turn_around(angle=90, direction="left")
    assert city._game.info["error"] == "" and city._game.info["state"] != before
    city.turn_around(angle=90)
    assert city._game.info["error"] == ""  # an optional parameter left out
    with pytest.raises(TypeError, match="angle"):
        city.turn_around()


def test_a_metric_can_be_the_score_and_a_menu_is_one_tool():
    pytest.importorskip("minigrid")
    with pytest.raises(SpecError, match="no score 'sucess'; expected one of return, success"):
        environment_factory("minigrid", EMPTY, score="sucess")
    made = environment_factory("minigrid", EMPTY | {"action_mode": "menu"}, score="success")
    assert list(schemas(made())) == ["act"]
    tools = made()
    tools.reset(seed=0)
    for action in ("go forward", "go forward", "turn right", "go forward", "go forward"):
        tools.act(action)
    assert tools.get_reward() == 1.0


def test_stock_trl_trains_two_updates(monkeypatch, tmp_path):
    pytest.importorskip("minigrid")
    trl = pytest.importorskip("trl")
    torch = pytest.importorskip("torch")
    from datasets import Dataset
    from trl.trainer import grpo_trainer

    from tests.tiny import tiny_model, tiny_tokenizer

    monkeypatch.setenv("TRL_EXPERIMENTAL_SILENCE", "1")
    called = []

    def parse(tokenizer, ids, **_):
        # A random model writes no tool call; what it samples picks one, so that its choices decide its reward.
        name = ("forward", "forward", "turn_right", "turn_left")[ids[0] % 4]
        called.append(name)
        call = {"type": "function", "function": {"name": name, "arguments": {}}}
        return {"role": "assistant", "content": "", "tool_calls": [call]}

    monkeypatch.setattr(grpo_trainer, "parse_response", parse)
    tokenizer = tiny_tokenizer()
    tokenizer.response_template = {}
    model = tiny_model(tokenizer, num_hidden_layers=1, hidden_size=32, intermediate_size=32)
    before = {name: value.clone() for name, value in model.named_parameters()}
    trainer = trl.GRPOTrainer(
        model,
        args=trl.GRPOConfig(
            output_dir=str(tmp_path),
            max_steps=2,
            per_device_train_batch_size=8,
            num_generations=8,
            max_completion_length=1 << 20,
            max_tool_calling_iterations=12,
            generation_kwargs={"min_new_tokens": 2, "max_new_tokens": 2},
            learning_rate=1e-3,
            report_to=[],
            use_cpu=True,
            bf16=False,
            gradient_checkpointing=False,
            save_strategy="no",
            logging_steps=1,
            seed=0,
        ),
        train_dataset=Dataset.from_list(dataset("minigrid", EMPTY, count=4)),
        processing_class=tokenizer,
        environment_factory=environment_factory("minigrid", EMPTY),
    )
    trainer.train()
    logs = [row for row in trainer.state.log_history if "rewards/Minigrid/mean" in row]
    assert trainer.state.global_step == 2 and len(logs) == 2
    assert len(called) >= 2 * 8 * 5 and all(0 <= row["rewards/Minigrid/mean"] < 1 for row in logs)
    assert any(row["reward_std"] > 0 for row in logs)
    assert any(not torch.equal(before[name], value) for name, value in model.named_parameters())
