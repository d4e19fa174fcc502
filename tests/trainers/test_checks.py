"""Every inherited field is read, fixed or refused; what is refused names where it is set instead."""

from __future__ import annotations

import math
import re
import runpy
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from datetime import date
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("trl")

import accelerate
import transformers
import trl
import yaml
from trl import GRPOConfig

from agentspec.cli.errors import is_expected
from agentspec.declaration import Declaration
from agentspec.registry import REGISTRY, Entry, SpecError
from trainers.ahead import OURS, check_names
from trainers.arguments import parse_config
from trainers.checks import check_reporters, notes
from trainers.config import ScaffoldConfig
from trainers.fields import FIXED, REFUSED, USED, field_rules

ROOT = Path(__file__).resolve().parents[2]
INHERITED = [f.name for f in fields(GRPOConfig)]
RULES = field_rules(GRPOConfig)


def config(tmp_path: Path, **changes: Any) -> ScaffoldConfig:
    return ScaffoldConfig(output_dir=str(tmp_path), use_cpu=True, bf16=False, report_to=[], **changes)


HOSTILE = ([[1]], {"a": 1}, date(2020, 1, 1))


@pytest.mark.parametrize("heading", [*OURS, *USED])
def test_a_value_of_the_wrong_kind_is_one_line(tmp_path: Path, heading: str) -> None:
    """Whatever a YAML file holds, under any of the names: it works, or our own check says why not."""
    source = tmp_path / "c.yaml"
    for name in {**OURS, **USED}[heading].split():
        for value in HOSTILE:
            given = {"output_dir": str(tmp_path), "use_cpu": True, "bf16": False, "report_to": "none", name: value}
            source.write_text(yaml.safe_dump(given), encoding="utf-8")
            with expected_errors_only(f"{name}: {value!r}"):
                parse_config(["--config", str(source)], default=source).check()


@contextmanager
def expected_errors_only(what: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        assert is_expected(error), f"{what} ended in {type(error).__name__}: {error}"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lora_r": 1.5}, "lora_r must be a whole number, got 1.5"),
        ({"adapter": ["x"]}, "adapter must be a text, got "),
        ({"eval_specs": {"reasoning": "direct"}}, "eval_specs must be a list or a text or null"),
        ({"eval_specs": [{"reasoning": "directt"}]}, "unknown reasoning 'directt'; did you mean direct"),
        ({"eval_sampling": {"temperatur": 0.0}}, "unknown key 'temperatur' in sampling; did you mean temperature"),
        ({"eval_tasks": -1}, "eval_tasks is -1; expected a number of at least 0"),
        ({"train_calls": []}, "train_calls is empty, so nothing would be trained"),
        ({"train_credits": []}, "train_credits is empty, so nothing would be trained"),
    ],
)
def test_what_would_fail_after_training_is_told_before(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=re.escape(message)):
        config(tmp_path, **changes).check()


CONFIGURATIONS = (ROOT / "recipes" / "configs").glob("[!t]*.yaml")  # those that begin with `transfer` are studies


@pytest.mark.parametrize("name", sorted(p.stem for p in CONFIGURATIONS))
def test_every_shipped_configuration_is_read(tmp_path: Path, name: str) -> None:
    source = ROOT / "recipes" / "configs" / f"{name}.yaml"
    on_cpu = ["--use_cpu", "true", "--bf16", "false", "--use_vllm", "false"]
    given = parse_config(["--config", str(source), "--output_dir", str(tmp_path), *on_cpu], default=source)
    assert given.output_dir == str(tmp_path) and given.spec.label


def test_one_text_is_a_list_of_one(tmp_path: Path) -> None:
    given = config(tmp_path, train_calls="reasoning.*", lora_targets="q_proj")
    assert (given.train_calls, given.lora_targets) == (["reasoning.*"], ["q_proj"])


# --- the table -------------------------------------------------------------------------------------------------------


def test_every_field_of_the_installed_trl_has_one_row() -> None:
    assert set(INHERITED) <= set(RULES), f"new in TRL {trl.__version__}: give them a row in trainers/fields.py"
    rows = [n for names in (*USED.values(), *REFUSED.values()) for n in names.split()] + list(FIXED)
    assert len(rows) == len(set(rows))
    # None of our own fields hides one of TRL's that is refused.
    redeclared = set(ScaffoldConfig.__annotations__) & set(INHERITED)
    assert {n: RULES[n].status for n in redeclared} == {"vllm_importance_sampling_mode": "used"}


def test_the_page_is_current() -> None:
    script = runpy.run_path(str(ROOT / "docs" / "update_training_fields.py"))
    text = script["PAGE"].read_text(encoding="utf-8")
    assert text == script["page"](GRPOConfig), "run `python docs/update_training_fields.py`"


def test_fields_that_are_called_used_are_named_by_who_uses_them() -> None:
    """Outside the dataclasses that declare them: `max_steps` must occur in a trainer, say."""
    declare = {"training_args.py", "grpo_config.py", "fields.py"}
    folders = [Path(m.__file__ or "").parent for m in (transformers, trl, accelerate)]
    files = [*folders[0].glob("trainer*.py"), *folders[0].glob("integrations/*.py"), *folders[1].rglob("*.py")]
    files += [*folders[2].rglob("*.py"), *(ROOT / "trainers").glob("*.py"), folders[0] / "modeling_utils.py"]
    text = "\n".join(p.read_text(encoding="utf-8") for p in files if p.name not in declare)
    # What TrainingArguments itself turns into settings of torch, of the logger or of accelerate.
    at_once = {"tf32", "log_level", "log_level_replica", "log_on_each_node", "ddp_backend", "ddp_timeout", "local_rank"}
    missing = [n for names in USED.values() for n in names.split() if f".{n}" not in text and n not in at_once]
    assert missing == []


# --- refusals --------------------------------------------------------------------------------------------------------


def test_the_defaults_are_not_refused(tmp_path: Path) -> None:
    config(tmp_path).check()
    config(tmp_path, eval_strategy="steps", eval_steps=2, save_steps=2).check()


def test_a_module_that_cannot_be_played_again_is_refused(tmp_path: Path) -> None:
    declaration = Declaration(untrainable="its prompts hold the date")
    REGISTRY.register("memory", "dated", Entry("agentspec.memory.base:BaseMemory", declaration))
    try:
        with pytest.raises(
            SpecError, match=r"agent\.memory .dated. cannot be trained through: its prompts hold the date"
        ):
            config(tmp_path, agent={"memory": "dated"}).check()
    finally:
        REGISTRY.unregister("memory", "dated")


@pytest.mark.parametrize("name", [n for n, rule in RULES.items() if rule.status != "used" and n in INHERITED])
def test_a_field_that_nobody_reads_is_refused(tmp_path: Path, name: str) -> None:
    given = config(tmp_path)
    setattr(given, name, "something else")
    with pytest.raises(SpecError) as caught:
        given.check()
    assert name in str(caught.value) and RULES[name].why in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "remedy"),
    [
        ({"temperature": 0.7}, "agent: {sampling: {...}}"),
        ({"top_p": 0.9}, "agent: {sampling: {...}}"),
        ({"generation_kwargs": {"top_k": 3}}, "agent: {sampling: {...}}"),
        ({"reward_weights": [1.0]}, "set `rewards: {name: weight}`"),
        ({"model_init_kwargs": {"dtype": "float16"}}, "`model`, `adapter` and `bf16`"),
        ({"label_smoothing_factor": 0.1}, "no labels"),
        ({"use_transformers_paged": True}, "`batching`"),
        ({"max_completion_length": 64}, "agent: {sampling: {max_tokens: ...}}"),
        ({"off_policy_mask_threshold": 0.5}, "per row"),
        ({"entropy_coef": 0.01}, "no gradient"),
        ({"use_adaptive_entropy": True}, "no gradient"),
        ({"adapter": "smollm2-135m-courier", "lora_r": 64}, "lora_r is 64, which changes nothing: beside adapter"),
        ({"adapter": "smollm2-135m-courier", "lora_layers": 2}, "lora_layers is 2, which changes nothing: beside"),
        ({"adapter": "smollm2-135m-courier", "lora_targets": ["q_proj"]}, "lora_targets is ['q_proj'], which changes"),
        ({"agent": {"reasoning": {"name": "tot", "temperature": 0}}}, "tot: temperature must be above 0, got 0"),
        ({"agent": {"reasoning": {"name": "rap", "temperature": 0}}}, "rap: temperature must be above 0, got 0"),
        ({"agent": {"reasoning": {"name": "rap", "temperature": math.inf}}}, "temperature is inf"),
        ({"agent": {"sampling": {"temperature": math.inf}}}, "temperature=inf"),
        ({"rewards": {}}, "rewards is {}, which pays nothing"),
    ],
)
def test_a_setting_without_effect_says_where_it_is_set(tmp_path: Path, changes: dict[str, Any], remedy: str) -> None:
    with pytest.raises(SpecError) as caught:
        config(tmp_path, **changes).check()
    assert remedy in str(caught.value)


def test_what_is_set_with_effect_is_accepted(tmp_path: Path) -> None:
    config(tmp_path, loss_type="dr_grpo", max_completion_length=64).check()  # its constant length
    config(tmp_path, lora_r=64).check()
    # Greedy calls that are not trained: lessons, while actions are.
    reflection = {"name": "retroformer", "temperature": 0.0}
    config(tmp_path, agent={"reasoning": "direct", "reflection": reflection, "scope": "run"}).check()


def test_naming_an_unread_field_is_refused_even_at_its_default(tmp_path: Path) -> None:
    """`temperature: 1.0` beside an agent at 0.7 would mislead; the default of a fixed field is harmless."""
    with pytest.raises(SpecError, match=r"c\.yaml: `temperature` is not read"):
        check_names(["learning_rate", "temperature"], "c.yaml")
    check_names(["scale_rewards", "learning_rate", "model"], "c.yaml")
    path = tmp_path / "c.yaml"
    path.write_text("use_cpu: true\nbf16: false\n")
    with pytest.raises(SpecError, match="command line: `max_tool_calling_iterations` is not read"):
        parse_config(["--config", str(path), "--max-tool-calling-iterations", "3"], default="")


def test_where_logs_go_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    found: dict[str, Any] = {"tensorboard": None, "wandb": object()}
    monkeypatch.setattr("trainers.checks.importlib.util.find_spec", lambda name: found[name])

    class Reporting:
        report_to = ["wandb", "tensorboard"]  # noqa: RUF012

    with pytest.raises(SpecError, match=r"report_to names tensorboard.*pip install 'agentspec-rl\[tensorboard\]'"):
        check_reporters(Reporting())
    Reporting.report_to = ["wandb"]
    check_reporters(Reporting())


@pytest.mark.parametrize(
    "changes",
    [
        {"reference": "base"},
        {"loss_type": "cispo", "epsilon": 0.9, "epsilon_high": 5.0},
        {"memory_carry": "best"},
        {"actor_adapter": "somewhere"},
        {"actor_temperature": 0.7},
        {"lora_r": 0, "lora_layers": 2},
        {"lora_r": 0, "lora_targets": ["q_proj"]},
        {"lora_r": 0, "lora_alpha": 32},
        {"mask_truncated": ["memory.nothing"]},
        {"validation_specs": [{"reasoning": "cot"}]},
        {"validation_tasks": 4},
        {"vllm_mode": "server"},
        {"vllm_importance_sampling_correction": False},
        {"vllm_importance_sampling_clip_max": 2.0},
        {"vllm_importance_sampling_clip_min": 0.5},
        {"vllm_importance_sampling_mode": "token_mask"},
        {"vllm_gpu_memory_utilization": 0.5},
        {"vllm_server_port": 9000},
        {"vllm_batch_invariant": True},
        {"use_vllm": True, "vllm_importance_sampling_correction": False, "vllm_importance_sampling_clip_max": 2.0},
        {"use_vllm": True, "vllm_server_port": 9000},
        {"use_vllm": True, "vllm_mode": "server", "vllm_max_model_length": 512},
    ],
    ids=str,
)
def test_a_setting_that_nobody_would_read_is_refused(tmp_path: Path, changes: dict[str, Any]) -> None:
    with pytest.raises(SpecError, match=next(reversed(changes)) if "epsilon" not in changes else "epsilon"):
        config(tmp_path, **changes).check()


@pytest.mark.parametrize(
    "changes",
    [
        {"estimator": "reward_to_go", "gamma": 1.5},
        {"estimator": "reward_to_go", "gamma": -1.0},
        {"estimator": "gigpo", "gigpo_weight": math.nan},
        {"epsilon": -0.2},
        {"beta": -1.0},
        {"top_entropy_quantile": 2.0},
        {"learning_rate": -1.0},
        {"loss_type": "dr_grpo", "max_completion_length": -5},
        {"num_iterations": 0},
        {"tokens_per_forward": -1},
        {"lora_layers": -1},
        {"env_timeout_s": 0.0},
        {"env_timeout_s": math.inf},
        {"eval_strategy": "steps", "eval_steps": 500, "validation_tasks": 0},
    ],
    ids=str,
)
def test_a_number_out_of_its_range_is_refused(tmp_path: Path, changes: dict[str, Any]) -> None:
    with pytest.raises(SpecError, match=f"{next(reversed(changes))} is .*; expected a number of at least"):
        config(tmp_path, **changes).check()


def test_fewer_tasks_than_a_round_takes_are_refused(tmp_path: Path) -> None:
    """The sampler drops a round that is not full: training would end at step 0 as if it had gone well."""
    sizes = {"num_generations": 2, "per_device_train_batch_size": 2, "gradient_accumulation_steps": 6}
    with pytest.raises(SpecError, match="train_tasks is 5, and a generation round takes 6 different tasks"):
        config(tmp_path, train_tasks=5, **sizes).check()
    config(tmp_path, train_tasks=6, **sizes).check()


def test_a_weight_that_is_no_number_is_refused(tmp_path: Path) -> None:
    """It would make every return NaN, and every advantage 0."""
    with pytest.raises(SpecError, match="reward 'env' has weight nan"):
        config(tmp_path, rewards={"env": math.nan}).check()


def test_a_cap_below_1_is_told(tmp_path: Path) -> None:
    told = [n for n in notes(config(tmp_path, loss_type="cispo")) if "epsilon_high 0.2" in n]
    assert len(told) == 1 and not list(notes(config(tmp_path, loss_type="cispo", epsilon_high=5.0)))


@pytest.mark.parametrize(
    ("changes", "rounds"),
    [
        ({"max_steps": 4}, 4),
        ({"max_steps": 4, "num_iterations": 2}, 2),
        ({"max_steps": 5, "num_iterations": 2}, 3),  # the third round gives one step
        ({"max_steps": 4, "steps_per_generation": 4}, 2),  # two steps of two micro-batches each
        ({"num_train_epochs": 2.0}, 6),  # 7 tasks, 2 a round: 3 whole rounds a pass
    ],
)
def test_how_many_rounds_a_run_plays(tmp_path: Path, changes: dict[str, Any], rounds: int) -> None:
    sizes = {"num_generations": 2, "per_device_train_batch_size": 2, "gradient_accumulation_steps": 2}
    if "steps_per_generation" in changes:
        sizes["per_device_train_batch_size"] = 1
    assert config(tmp_path, train_tasks=7, **{**sizes, "max_steps": -1, **changes}).rounds == rounds


def test_held_out_tasks_that_are_trained_on_are_told(tmp_path: Path) -> None:
    """Of ten layouts, training tasks 0 to 7 are eight; seeds 20000 to 20009 are all ten."""
    sizes = {"train_tasks": 8, "eval_tasks": 10, "environment": {"name": "minigrid", "options": {"suite": "paper"}}}
    assert [n for n in notes(config(tmp_path, **sizes)) if "8 of 10 tasks of the test split" in n]
    # Of the layouts of `practice`, Empty has one and another is met again; a level of many layouts repeats none.
    for options, seen in ({"suite": "practice"}, 2), ({"level": "BabyAI-PutNextS5N1-v0"}, 0):
        told = list(notes(config(tmp_path, **{**sizes, "environment": {"name": "minigrid", "options": options}})))
        assert [n for n in told if f"{seen} of 10 tasks of the test split" in n] == told
        assert len(told) == (seen > 0)
