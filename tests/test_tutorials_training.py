"""What the tutorials say is so: their code runs, their tables name what there is."""

from __future__ import annotations

import inspect
import json
import re
import runpy
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("trl")
pytest.importorskip("httpx")

from datasets import Dataset

from agentspec.cli import main
from agentspec.llm.openai import OpenAILLM
from agentspec.llm.pricing import Prices
from agentspec.registry import SpecError
from agentspec.trajectory import read_trajectories
from agentspec.types import Usage
from recipes.common import CONFIGS
from rewards import RewardSet
from tests.llm.test_openai import Server, answer
from tests.tiny import tiny_model, tiny_tokenizer
from tests.toy_env import TOY
from tests.trainers.builders import CPU_RUN
from tests.trainers.played import toy_tasks
from trainers.arguments import read_config
from trainers.audit import audit
from trainers.config import ScaffoldConfig
from trainers.grpo import ScaffoldGRPOTrainer
from trainers.rollouts import task_rows

TUTORIALS = Path(__file__).resolve().parents[1] / "docs" / "tutorials"


def blocks(page: str, language: str) -> list[str]:
    """The code blocks of a page."""
    return re.findall(rf"```{language}\n(.*?)```", (TUTORIALS / page).read_text(encoding="utf-8"), re.DOTALL)


def rows(page: str, heading: str) -> list[str]:
    """First cells of the table under a heading."""
    text = (TUTORIALS / page).read_text(encoding="utf-8").split(f"## {heading}\n")[1].split("\n## ")[0]
    return [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("| `")]


@pytest.fixture
def my_rewards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with the reward of the tutorial."""
    (tmp_path / "my_rewards.py").write_text(blocks("own_reward.md", "python")[0])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p != str(tmp_path)])
    monkeypatch.delitem(sys.modules, "my_rewards", raising=False)
    yield tmp_path
    sys.modules.pop("my_rewards", None)


def trained(folder: Path, **settings: Any) -> None:
    """Two updates of two tasks, with validation."""
    config = ScaffoldConfig(
        output_dir=str(folder),
        agent={"reasoning": "direct", "sampling": {"max_tokens": 8}},
        **{"per_device_train_batch_size": 2, "gradient_accumulation_steps": 2, "num_generations": 2, "max_steps": 2},
        **{"save_steps": 1, "eval_strategy": "steps", "eval_steps": 1, **CPU_RUN, **settings},
    )
    tokenizer = tiny_tokenizer()
    data = Dataset.from_list(task_rows(toy_tasks()))
    trainer = ScaffoldGRPOTrainer(
        tiny_model(tokenizer), config, train_dataset=data, eval_dataset=data, processing_class=tokenizer
    )
    trainer.train()
    trainer.save_model(str(folder))


# --- own reward ------------------------------------------------------------------------------------------------------


def test_the_reward_of_the_tutorial_pays_per_step(my_rewards: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["run", "--env", TOY, "--policy", "seller", "--llm", "backend=scripted", "--llm", "script=['SELL()']"]
    assert main([*command, "--out", "episodes.jsonl"]) == 0
    [trajectory] = read_trajectories("episodes.jsonl")
    written = [call.usage.output_tokens for call in trajectory.calls]
    assert len(written) == 5 and min(written) > 0  # one call per step
    score = RewardSet({"my_rewards:brief": 0.5}).score(trajectory)
    assert score is not None and score.terms["my_rewards:brief"] == pytest.approx([-0.01 * n for n in written])
    assert score.total == pytest.approx(-0.005 * sum(written))
    # The page's own way to try it: env and earning together need a balance, which the toy has.
    capsys.readouterr()
    (my_rewards / "score.py").write_text(blocks("own_reward.md", "python")[1])
    runpy.run_path("score.py")
    assert "my_rewards:brief" in capsys.readouterr().out


@pytest.mark.parametrize("page", ["own_reward.md", "logging.md"])
def test_the_configuration_of_a_page_is_read_as_it_stands(page: str, tmp_path: Path) -> None:
    """Written into a file anywhere."""
    (tmp_path / "mine.yaml").write_text(blocks(page, "yaml")[0])
    assert read_config(tmp_path / "mine.yaml", shelf=CONFIGS)["model"] == "smollm2-135m"


def test_a_run_trains_on_it_and_the_audit_agrees(my_rewards: Path) -> None:
    (my_rewards / "mine.yaml").write_text(
        f"extends: {CONFIGS}/cpu.yaml\n" + blocks("own_reward.md", "yaml")[0].split("\n", 1)[1]
    )
    config = read_config(my_rewards / "mine.yaml")
    assert config["rewards"] == {"earning_delta": 1.0, "my_rewards:brief": 0.5}
    trained(my_rewards / "run", rewards={"env": 1.0, "my_rewards:brief": 0.5})
    first = json.loads((my_rewards / "run" / "metrics.jsonl").read_text().splitlines()[0])
    assert first["rewards/my_rewards:brief/mean"] < 0
    assert first["reward"] == pytest.approx(first["rewards/env/mean"] + 0.5 * first["rewards/my_rewards:brief/mean"])
    assert [v for receipt in audit(my_rewards / "run") for v in receipt.violations] == []


def test_a_reward_that_is_not_there(my_rewards: Path) -> None:
    for name, message in (
        ("my_rewards:breif", "there is no 'breif' in the module 'my_rewards'"),
        ("no_such_module:brief", "no module 'no_such_module'"),
        ("earning_dleta", "did you mean earning_delta"),
    ):
        with pytest.raises(SpecError, match=message):
            RewardSet({name: 1.0})


# --- endpoints and prices --------------------------------------------------------------------------------------------


def test_the_command_asks_and_prices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    server = Server()
    server.script = [answer("SELL()")]
    monkeypatch.setenv("OPENAI_API_KEY", "sk-x")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "prices.yaml").write_text(blocks("endpoints_and_prices.md", "yaml")[0])
    words = blocks("endpoints_and_prices.md", "bash")[0].split("agentspec ", 1)[1].replace("\\\n", " ")
    command = [w.strip('"') for w in re.findall(r'"[^"]*"|\S+', words)]
    assert command[:3] == ["run", "--policy", "gpt-5-mini"]
    assert main([*command, "--env", TOY, "--llm", f"base_url={server.url}"]) == 0
    assert server.bodies[0]["model"] == "gpt-5-mini" and "max_completion_tokens" in server.bodies[0]
    first, second = read_trajectories(tmp_path / "episodes.jsonl")
    # Every answer: 10 input tokens, 4 of them cached, and 2 output tokens, at the price of the longer name.
    each = (6 * 0.25 + 4 * 0.025 + 2 * 2.00) / 1e6
    for trajectory in (first, second):
        assert trajectory.metrics["cost"] == pytest.approx(each * len(trajectory.calls))
        assert trajectory.calls[0].usage.cost == pytest.approx(each)
    assert "seed 0 step 0: SELL()" in capsys.readouterr().err  # as it plays


def test_the_longest_name_counts_and_others_are_free(tmp_path: Path) -> None:
    (tmp_path / "prices.yaml").write_text(blocks("endpoints_and_prices.md", "yaml")[0])
    prices = Prices.from_yaml(tmp_path / "prices.yaml")
    usage = Usage(input_tokens=1_000_000, output_tokens=0)
    costs = [prices.cost(name, usage) for name in ("gpt-5", "gpt-5-mini-2025", "my-model")]
    assert costs == [1.25, 0.25, 0.0]


def test_the_table_of_settings_is_the_backend_s() -> None:
    text = (TUTORIALS / "endpoints_and_prices.md").read_text(encoding="utf-8")
    told = dict(re.findall(r"^\| `(\w+)` \| ([^|]*) \|", text, re.MULTILINE))
    parameters = inspect.signature(OpenAILLM.__init__).parameters
    assert set(told) <= set(parameters)
    for name in ("timeout_s", "max_retries", "max_concurrency", "max_context"):
        assert float(told[name]) == parameters[name].default
    for name in ("api_key_env", "server", "max_tokens_key"):
        assert told[name].strip("`") == parameters[name].default


# --- logging ---------------------------------------------------------------------------------------------------------


def test_every_figure_that_is_logged_is_described(tmp_path: Path) -> None:
    run = tmp_path / "run"
    trained(run)
    logged = {name for line in (run / "metrics.jsonl").read_text().splitlines() for name in json.loads(line)}
    told = [name for cell in rows("logging.md", "Figures of an update") for name in re.findall(r"`([^`]+)`", cell)]
    patterns = {name: re.compile(re.sub(r"NAME|MODULE|PURPOSE", r"[^/]+", name)) for name in told}
    assert [n for n in logged if not any(p.fullmatch(n) for p in patterns.values())] == []
    assert [n for n, p in patterns.items() if not any(map(p.fullmatch, logged))] == []
    evaluated = json.loads((run / "evaluations.jsonl").read_text().splitlines()[0])
    assert {"eval_reward", "eval_unscorable"} <= set(evaluated)
    # The files, and the page's reader.
    for cell in rows("logging.md", "In the folder"):
        pattern = cell.strip("`").replace("-N", "-*").rstrip("/")
        assert list(run.glob(pattern)), cell
    (tmp_path / "reading.py").write_text(blocks("logging.md", "python")[0])
    curve = runpy.run_path(str(tmp_path / "reading.py"))["curve"]
    assert [step for step, _ in curve(str(run))] == [1, 2]
    assert "extends" in blocks("logging.md", "yaml")[0]
