"""The shipped configurations parse and are sound; a mistake in one is a line and exit code 2."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("trl")

from trl import GRPOConfig

from agentspec.episode import Job, Runner
from agentspec.extends import merged
from agentspec.llm.scripted import ScriptedLLM
from agentspec.prompting import static_prompt
from agentspec.reasoning.react import FORMAT
from agentspec.records.folder import last_complete_checkpoint
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.types import Task
from recipes.common import CONFIGS, run_recipe
from trainers.ahead import KNOWN, OURS
from trainers.arguments import parse_config, read_config
from trainers.checks import notes
from trainers.config import ScaffoldConfig
from trainers.run import train

ROOT = Path(__file__).resolve().parents[1]
ON_CPU = ["--use_cpu", "true", "--bf16", "false", "--report_to", "none"]


def parsed(name: str, *overrides: str) -> Any:
    config = parse_config(["--config", str(CONFIGS / name), *overrides], default="none.yaml")
    config.check()
    return config


def test_every_shipped_config_is_sound(tmp_path: Path) -> None:
    names = sorted(p.name for p in CONFIGS.glob("*.yaml"))
    assert {"quickstart_cpu.yaml", "qwen3_4b_paper.yaml", "supo_cpu.yaml"} <= set(names)
    for name in names:
        config = parsed(name, *ON_CPU, "--output_dir", str(tmp_path))
        assert config.output_dir == str(tmp_path) and config.use_cpu and not config.bf16


def test_the_quick_start(tmp_path: Path) -> None:
    config = parsed("quickstart_cpu.yaml")
    assert config.model == "smollm2-135m" and config.adapter and config.use_cpu
    assert config.rewards == {"earning_delta": 1.0} and config.loss_type in ("dapo", "cispo")
    assert list(notes(config)) == []
    # Whole groups, of rollouts that are compared with each other.
    assert rollouts_per_update(config) % config.num_generations == 0
    assert parse_config([], default=CONFIGS / "quickstart_cpu.yaml").output_dir == config.output_dir


def rollouts_per_update(config: Any) -> int:
    return int(config.per_device_train_batch_size * config.gradient_accumulation_steps)


def test_the_paper_s_setting() -> None:
    config = parsed("qwen3_4b_paper.yaml", *ON_CPU)
    name, options = config.world
    assert config.model == "Qwen/Qwen3-4B" and name == "deliverybench"
    assert options["max_steps"] == 40
    assert config.num_generations == 4 and rollouts_per_update(config) == 32
    assert config.rewards == {"earning_delta": 1.0} and config.estimator == "grpo"
    assert config.use_vllm and config.vllm_mode == "colocate"
    # vLLM does not constrain answers to choices, so the actions are written out.
    assert options["action_mode"] == "native"


def tokens(text: str) -> int:
    """About what a tokenizer that splits numbers into digits makes of a text."""
    return len(re.findall(r"\d|[A-Za-z]+|[^\w\s]+|\n+", text))


def test_the_paper_s_setting_has_room_for_a_model_that_thinks() -> None:
    """It had 512 tokens for thought and action together, and a window that 28 of its 40 observations fill."""
    config = parsed("qwen3_4b_paper.yaml", *ON_CPU)
    name, options = config.world
    run = Runner(AgentSpec.from_data({"reasoning": "rule_based"}), ScriptedLLM(["-"]))
    (episode,) = run.run([Job(Task(name, 0, options))])
    first = episode.transitions[0].input
    static = tokens(static_prompt(first, FORMAT))
    seen = [tokens(step.input.text) for step in episode.transitions]
    assert len(seen) == 40 and static + sum(seen) > config.vllm_max_model_length
    for spec in (config.spec, *map(AgentSpec.from_data, config.eval_specs)):
        room = spec.sampling.with_room().max_tokens
        assert spec.sampling.reasoning_tokens >= 1024 and room == spec.sampling.max_tokens + 1536
        # So many turns stand in a prompt at most, the open one among them; a memory adds its budget.
        held = spec.max_turns + 1 if spec.layout == "conversation" else 1
        most = max(sum(seen[i : i + held]) for i in range(len(seen)))
        assert static + most + spec.recall_tokens + held * room <= config.vllm_max_model_length


def test_overrides_win_and_structures_can_be_given() -> None:
    config = parsed("quickstart_cpu.yaml", "--max_steps", "7", "--agent", '{"reasoning": "react"}')
    assert config.max_steps == 7 and config.spec.reasoning.name == "react"


# --- one file extends another ----------------------------------------------------------------------------------------


def write_yaml(folder: Path, **files: str) -> Path:
    folder.mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / f"{name}.yaml").write_text(text)
    return folder


def test_a_file_extends_another_one_beside_it(tmp_path: Path) -> None:
    deep = write_yaml(tmp_path, base="learning_rate: 0.5\nmax_steps: 3\nrewards: {success: 1.0, earning_delta: 2.0}\n")
    folder = write_yaml(
        deep / "below",
        middle="extends: ../base.yaml\nmax_steps: 4\nagent: {reasoning: react, memory: {name: base, window: 3}}\n",
        top="extends: middle.yaml\nrewards: {success: null}\nagent: {memory: {window: 9}}\neval_specs: [{}]\n",
    )
    assert read_config(folder / "top.yaml") == {
        "learning_rate": 0.5,
        "max_steps": 4,
        "rewards": {"earning_delta": 2.0},
        "agent": {"reasoning": "react", "memory": {"name": "base", "window": 9}},
        "eval_specs": [{}],
    }
    config = parse_config(["--max_steps", "7", *ON_CPU], default=folder / "top.yaml")
    assert (config.max_steps, config.learning_rate, config.rewards) == (7, 0.5, {"earning_delta": 2.0})


def test_another_module_brings_its_own_parameters() -> None:
    base = {"agent": {"memory": {"name": "summary", "every": 8}, "layout": "snapshot"}}
    assert merged(base, {"agent": {"memory": {"name": "base"}}}) == {
        "agent": {"memory": {"name": "base"}, "layout": "snapshot"}
    }
    assert merged(base, {"agent": {"memory": {"name": "summary", "every": 4}}})["agent"]["memory"]["every"] == 4
    assert merged(base, {"agent": {"memory": "none"}})["agent"]["memory"] == "none"
    assert base["agent"]["memory"] == {"name": "summary", "every": 8}  # is left as it was


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"top": "extends: top.yaml\n"}, "cannot extend itself"),
        ({"top": "extends: a.yaml\n", "a": "extends: top.yaml\n"}, "cannot extend itself"),
        ({"top": "extends: none.yaml\n"}, "no such YAML file"),
        ({"top": "extends: [a.yaml]\n", "a": ""}, "expected the path of one YAML file"),
        ({"top": "extends: a.yaml\n", "a": "learning_rte: 1\n"}, "did you mean learning_rate"),
        ({"top": "- 1\n"}, "expected a mapping"),
    ],
)
def test_what_cannot_be_extended(tmp_path: Path, files: dict[str, str], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        read_config(write_yaml(tmp_path, **files) / "top.yaml")


def test_what_ships_is_found_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    default = CONFIGS / "quickstart_cpu.yaml"
    shipped = read_config(default)
    assert read_config("quickstart_cpu", shelf=CONFIGS) == read_config("quickstart_cpu.yaml", shelf=CONFIGS) == shipped
    (tmp_path / "mine.yaml").write_text("extends: quickstart_cpu\nmax_steps: 1\n")
    assert parse_config(["--config", "mine.yaml", *ON_CPU], default=default).max_steps == 1
    # A file of one's own comes before what ships.
    (tmp_path / "quickstart_cpu.yaml").write_text("extends: cpu.yaml\noutput_dir: mine\n")
    assert read_config("quickstart_cpu.yaml", shelf=CONFIGS)["output_dir"] == "mine"
    with pytest.raises(SpecError, match="did you mean retroformer_cpu"):
        read_config("retroformer", shelf=CONFIGS)


def test_names_are_checked_before_torch_is_imported(tmp_path: Path) -> None:
    """In a process of its own: this one has torch already."""
    cases = {
        "--agent {reasoning: raect}": "did you mean react",
        "--agent nosuch.yaml": "no such YAML file",
        "--environment {name: deliverybnch}": "did you mean deliverybench",
        "--environment {name: deliverybench, options: {sise: 1}}": "did you mean size",
        "--rewards {earnings: 1}": "did you mean earning_delta",
        "--validation_specs [{memory: bsae}]": "did you mean base",
        "--estimator grop": "did you mean grpo",
        "--loss-type dapoo": "did you mean dapo",
        "--model no-such-model": "no model 'no-such-model'",
        "--learning_rat 1": "did you mean --learning_rate",
        "--config quickstart": "did you mean quickstart_cpu",
    }
    code = f"""
import sys
from recipes.common import CONFIGS
from trainers.arguments import parse_config
for option, expected in {cases!r}.items():
    try:
        parse_config(option.split(" ", 1), default=CONFIGS / "quickstart_cpu.yaml")
    except ValueError as error:
        assert expected in str(error), (option, error)
    except Exception as error:
        assert expected in str(error) and type(error).__name__ == "ModelNotFoundError", (option, error)
    else:
        raise AssertionError(option)
assert not {{"torch", "transformers", "trl"}} & sys.modules.keys()
"""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_field_is_known_ahead() -> None:
    assert {f.name for f in fields(ScaffoldConfig)} == KNOWN


def test_structures_are_given_as_json_or_yaml() -> None:
    for text in (
        '{"reasoning": "react", "sampling": {"temperature": 1e-1}}',
        "{reasoning: react, sampling: {temperature: 0.1}}",
    ):
        config = parse_config(["--agent", text, *ON_CPU], default=CONFIGS / "quickstart_cpu.yaml")
        assert config.spec.reasoning.name == "react" and config.spec.sampling.temperature == 0.1


# --- the command line ------------------------------------------------------------------------------------------------


def test_options_are_never_abbreviated(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="unknown option '--learning_rat'; did you mean --learning_rate"):
        parse_config(["--learning_rat", "1", *ON_CPU], default=CONFIGS / "quickstart_cpu.yaml")
    assert parse_config(["--learning_rate", "1", *ON_CPU], default=CONFIGS / "cpu.yaml").learning_rate == 1


def test_no_parser_of_the_project_takes_abbreviations() -> None:
    calls = []
    for folder in ("agentspec", "trainers", "recipes", "eval", "benchmarks", "docs"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("ArgumentParser"):
                    calls.append(path)
                    settings = {k.arg: ast.unparse(k.value) for k in node.keywords}
                    assert settings.get("allow_abbrev") == "False", f"{path}:{node.lineno}"
    assert len(calls) > 5


def test_help_begins_with_what_is_ours(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        parse_config(["--help"], default=CONFIGS / "quickstart_cpu.yaml")
    assert caught.value.code == 0
    text = capsys.readouterr().out
    places = [text.index(f"\n{heading}:") for heading in (*OURS, "TRL: loss", "TRL: vLLM")]
    assert places == sorted(places) and text.index("--config FILE") < places[0]
    ours = {f.name for f in fields(ScaffoldConfig)} - {f.name for f in fields(GRPOConfig)}
    assert {name for names in OURS.values() for name in names.split()} <= ours
    assert [name for name in ours if f"--{name} " not in text[: text.index("TRL: ")]] == []
    assert "--temperature" not in text and "--learning_rate" in text  # what is refused is not offered


# --- mistakes --------------------------------------------------------------------------------------------------------


def written(tmp_path: Path, text: str) -> str:
    path = tmp_path / "config.yaml"
    path.write_text(f"output_dir: {tmp_path / 'run'}\nuse_cpu: true\nbf16: false\nreport_to: none\n{text}")
    return str(path)


MISTAKES = {
    "unknown key": ("learning_rte: 1.0\n", "unknown key 'learning_rte'; did you mean learning_rate"),
    "malformed YAML": ("rewards: {earning_delta: 1.0\n", "malformed YAML"),
    "missing model": ("model: no-such-model-here\n", "no-such-model-here"),
    "train_calls without match": ("agent: {reasoning: direct}\ntrain_calls: ['reflection.*']\n", "match no call"),
    "unknown reward": ("rewards: {earnings: 1.0}\n", "earning_delta"),
    "unknown module": ("agent: {reasoning: raect}\n", "react"),
    "refused loss": ("loss_type: luspo\n", "not offered"),
    "wrong kind of value": ("max_steps: many\n", "invalid int value: 'many'"),
    "missing adapter": ("model: smollm2-135m\nadapter: no-such-adapter\n", "no-such-adapter"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line_and_exit_code_2(
    tmp_path: Path, mistake: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text, expected = MISTAKES[mistake]
    path = written(tmp_path, text)
    with pytest.raises(SystemExit) as caught:
        run_recipe(lambda: train(parse_config(["--config", path], default="")))
    assert caught.value.code == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and expected in err and "Traceback" not in err, err


def test_a_missing_config_file_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        run_recipe(lambda: parse_config(["--config", str(tmp_path / "none.yaml")], default=""))
    assert caught.value.code == 2
    assert "none.yaml" in capsys.readouterr().err


def test_a_recipe_says_no_as_a_program(tmp_path: Path) -> None:
    path = written(tmp_path, "learning_rte: 1.0\n")
    command = [sys.executable, "-m", "recipes.grpo_delivery", "--config", path]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("agentspec: error: ") and done.stderr.count("\n") == 1, done.stderr


def test_a_config_without_value_for_config_is_refused() -> None:
    with pytest.raises(SpecError, match="--config"):
        parse_config(["--config"], default="")


# --- which checkpoint a run resumes from -----------------------------------------------------------------------------


def checkpoint(folder: Path, step: int, *files: str) -> Path:
    path = folder / f"checkpoint-{step}"
    path.mkdir(parents=True)
    for name in files:
        (path / name).write_text("{}")
    return path


def test_a_half_written_checkpoint_is_passed_over(tmp_path: Path) -> None:
    assert last_complete_checkpoint(tmp_path / "nothing") is None
    checkpoint(tmp_path, 12, "model.safetensors", "trainer_state.json")  # killed before its last file
    assert last_complete_checkpoint(tmp_path) is None
    whole = checkpoint(tmp_path, 9, "trainer_state.json", "scaffold_state.json")
    checkpoint(tmp_path, 10, "scaffold_state.json")  # killed while it was deleted
    checkpoint(tmp_path, 8, "trainer_state.json", "scaffold_state.json")
    (tmp_path / "checkpoint-best").mkdir()
    # By number, not by name: 9 < 10 < 12.
    assert last_complete_checkpoint(tmp_path) == whole
