"""The command line: what it prints, what it writes, and how it says no."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from PIL import Image

from agentspec.carry import MemoryBank
from agentspec.cli import expected_errors, fail, main
from agentspec.cli.arguments import key_values, labelled_spec, parse_seeds
from agentspec.cli.errors import is_expected, one_line
from agentspec.policies import Policy
from agentspec.registry import REGISTRY, SpecError
from agentspec.trajectory import read_trajectories
from rewards import REWARDS
from tests.toy_env import TOY, ToyEnv

ROOT = Path(__file__).resolve().parents[1]
SELL = ["--policy", "seller", "--llm", "backend=scripted", "--llm", "script=['SELL()']"]


class DrawnEnv(ToyEnv):
    """The toy with pictures: a bar as high as the price."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None, **settings: Any) -> None:
        super().__init__(**settings)
        self.render_mode = render_mode

    def render(self) -> Any:
        frame = np.zeros((20, 20, 3), np.uint8)
        frame[: 2 * self.prices[self.t]] = 255
        return frame if self.render_mode else None


DRAWN = "agentspec-test/Drawn-v0"
if DRAWN not in gymnasium.registry:
    gymnasium.register(DRAWN, entry_point=DrawnEnv)


class ForgetfulEnv(ToyEnv):
    """The toy without snapshots."""

    snapshot = None  # type: ignore[assignment]


FORGETFUL = "agentspec-test/Forgetful-v0"
if FORGETFUL not in gymnasium.registry:
    gymnasium.register(FORGETFUL, entry_point=ForgetfulEnv)


def prices(seed: int) -> list[int]:
    env = ToyEnv()
    env.reset(seed=seed)
    return env.prices[:5]


def refused(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """The one line of an error; asserts that it is one line and that the exit code is 2."""
    with pytest.raises(SystemExit) as caught:
        main(argv)
    assert caught.value.code == 2
    out, err = capsys.readouterr()
    assert err.startswith("agentspec: error: ") and err.count("\n") == 1 and "Traceback" not in err
    assert out == ""
    return err


# --- run -------------------------------------------------------------------------------------------------------------


def test_run_ends_with_the_outcome_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--env", TOY, *SELL, "--seed", "3", "--json"]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert json.loads(last) == {
        "net_earnings": float(sum(prices(3))),  # sells at all five prices
        "deliveries": 0,  # the toy declares these two
        "return": float(sum(prices(3))),
        "steps": 5,
    }


def test_several_episodes_end_with_their_mean(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--env", TOY, *SELL, "--episodes", "2", "--json"]) == 0
    first, second, mean = map(json.loads, capsys.readouterr().out.splitlines())
    assert (first["seed"], second["seed"]) == (0, 1)
    assert mean["net_earnings"] == (sum(prices(0)) + sum(prices(1))) / 2
    assert mean["episodes"] == 2 and mean["failed"] == 0


@pytest.mark.parametrize("env", ["CartPole-v1", "MiniGrid-Empty-5x5-v0", "minigrid:MiniGrid-Empty-5x5-v0"])
def test_environments_of_gymnasium_run(env: str, capsys: pytest.CaptureFixture[str]) -> None:
    if "MiniGrid" in env:
        pytest.importorskip("minigrid")
    assert main(["run", "--env", env, "--policy", "random", "--episodes", "2", "--json"]) == 0
    first, second, mean = map(json.loads, capsys.readouterr().out.splitlines())
    assert first["status"] == second["status"] == "completed" and mean["episodes"] == 2
    assert mean["steps"] == (first["steps"] + second["steps"]) / 2 and first["steps"] > 5
    if env == "CartPole-v1":
        assert first["return"] == first["steps"]  # one point for every step the pole stands


def test_an_unknown_environment_names_the_nearest_of_all(capsys: pytest.CaptureFixture[str]) -> None:
    for name, remedy in (
        ("CartPol-v1", "did you mean CartPole-v1"),
        ("no_such_module:X-v0", "there is no module 'no_such_module'"),
        ("Pendulum-v1", "expected a discrete or text action space"),
    ):
        assert remedy in refused(capsys, "run", "--env", name, "--policy", "random")


def test_run_prints_a_line_for_people(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--env", TOY, *SELL]) == 0
    assert f"seed 0: net earnings ($) {sum(prices(0))}.00" in capsys.readouterr().out


def test_the_same_seed_writes_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        command = ["run", "--env", TOY, *SELL, "--seed", "4", "--episodes", "2", "--out", str(tmp_path / name)]
        assert main([*command, "--option", "menu=false"]) == 0
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    trajectories = list(read_trajectories(tmp_path / "a"))
    assert [t.task.seed for t in trajectories] == [4, 5]
    assert trajectories[0].policy == "seller" and trajectories[0].task.options == {"menu": False}


def test_sampling_and_spec_reach_the_agent(tmp_path: Path) -> None:
    out = tmp_path / "t.jsonl"
    command = ["run", "--env", TOY, *SELL, "--out", str(out), "--spec", "{memory: base, layout: snapshot}"]
    assert main([*command, "--sampling", "temperature=0.5", "--max-steps", "2"]) == 0
    [trajectory] = read_trajectories(out)
    assert trajectory.spec["memory"] == "base" and trajectory.spec["sampling"] == {"temperature": 0.5}
    assert len(trajectory.transitions) == 2 and trajectory.metrics["ended"] == "max_steps"


def test_a_failed_episode_is_exit_code_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--env", TOY, *SELL, "--option", "fault=crash", "--json"]) == 1
    out, err = capsys.readouterr()
    assert "the toy broke" in err and json.loads(out)["net_earnings"] is None


def test_gif(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for gif in ([], ["--gif", str(tmp_path / "e.gif")]):
        assert main(["run", "--env", DRAWN, *SELL, "--out", str(tmp_path / f"{len(gif)}.jsonl"), *gif]) == 0
    assert (tmp_path / "0.jsonl").read_bytes() == (tmp_path / "2.jsonl").read_bytes()  # filming changes nothing
    with Image.open(tmp_path / "e.gif") as image:
        assert image.size == (20, 20) and 2 <= image.n_frames <= 6  # equal neighbours may be merged
    capsys.readouterr()
    assert "draws no frames" in refused(capsys, "run", "--env", TOY, *SELL, "--gif", str(tmp_path / "no.gif"))


# --- bad input -------------------------------------------------------------------------------------------------------


def test_bad_input_is_one_line_with_a_remedy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = tmp_path / "broken.yaml"
    broken.write_text("reasoning: direct\nmemory: {name: base\n")
    odd, binary = tmp_path / "odd.yaml", tmp_path / "binary.yaml"
    odd.write_text("gpt: {inputs: 1}\n")
    binary.write_bytes(b"\xff\xfe")
    (tmp_path / "adapter_config.json").write_text("[]")
    toy = ("run", "--env", TOY)
    for argv, parts in (
        (("run", "--env", "deliverybnch"), ("deliverybnch", "did you mean deliverybench")),
        ((*toy, "--spec", "reasoning: raect"), ("unknown reasoning 'raect'", "did you mean react")),
        ((*toy, "--spec", "memry: base"), ("did you mean memory",)),
        ((*toy, "--spec", "memory: {name: base, windw: 2}"), ("did you mean window",)),
        ((*toy, "--spec", str(broken)), ("malformed YAML", "broken.yaml", "line 3", "check indentation")),
        ((*toy, "--spec", "[1"), ("no such YAML file",)),
        (toy, ("calls a model and none was named", "--policy")),
        ((*toy, "--policy", "rule-based", "--adapter", "x"), ("--adapter", "leave it out")),
        ((*toy, *SELL, "--option", "menu"), ("expected KEY=VALUE",)),
        ((*toy, *SELL, "--option", "nonsense=1"), ("takes no option 'nonsense'", "known: fault")),
        (("run", "--policy", "random", "--option", "imagess=1"), ("did you mean images",)),
        (("run", "--policy", "random", "--option", "shift_hours=long"), ("shift_hours must be a number",)),
        (("run", "--policy", "random", "--shift-hours", "-1"), ("--shift-hours", "above 0")),
        (("run", "--policy", "random", "--option", "shift_hours=-1"), ("shift_hours is -1", "above 0")),
        ((*toy, *SELL, "--max-steps", "0"), ("--max-steps", "at least 1, got 0")),
        ((*toy, *SELL, "--seed", "-1"), ("--seed", "at least 0, got -1")),
        ((*toy, *SELL, "--timeout", "nan"), ("--timeout", "above 0")),
        ((*toy, *SELL, "--concurrency", "0"), ("--concurrency", "at least 1")),
        ((*toy, *SELL, "--prices", str(odd)), ("input, output and cached",)),
        ((*toy, *SELL, "--spec", str(binary)), ("no UTF-8 text",)),
        ((*toy, "--policy", str(tmp_path)), ("adapter_config.json is malformed",)),
        ((*toy, "--spec", "memory: my_very_own"), ("known: ", "--import")),
        ((*toy, *SELL, "--sampling", "temperature=-1"), ("temperature >= 0",)),
        ((*toy, *SELL, "--llm", "colour=1"), ("unknown key 'colour'",)),
        ((*toy, *SELL, "--episodes", "0"), ("at least 1",)),
        ((*toy, *SELL, "--prices", str(tmp_path / "none.yaml")), ("No such file",)),
        (("run", "--seed", "x"), ("expected a whole number, got 'x'", "agentspec run --help")),
        (("lsit",), ("invalid choice",)),
        ((), ("required: COMMAND",)),
        (("view", str(tmp_path / "none.jsonl")), ("No such file", "check the path")),
        (("view", str(broken)), ("broken.yaml holds no trajectories", "`agentspec run --out`", "--memory")),
        (("view", "--memory", str(broken)), ("broken.yaml: not a memory file", "memory.json")),
        (("train", "grpo_delivery", "--config", "quickstart"), ("did you mean quickstart_cpu",)),
        (("train", "grpo_delivery", "--learning_rat", "1"), ("unknown option", "did you mean --learning_rate")),
        (("train", "grpo"), ("invalid choice: 'grpo'", "grpo_delivery")),
        (("export", str(tmp_path / "none"), "--to", str(tmp_path / "x")), ("no run folder", "output_dir")),
        (("eval", "--policies", "random", "--out", str(tmp_path / "o"), "--seeds", "3-1"), ("name no seed",)),
    ):
        message = refused(capsys, *argv)
        for part in parts:
            assert part in message, (argv, message)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("budget: {calls: many}", "many"),
        ("max_turns: x", "max_turns"),
        ("embedder: nonsense", "nonsense"),
        ("reasoning: {name: tot, preset: wrong}", "wrong"),
        ("memory: {name: base, window: many}", "window"),
    ],
)
@pytest.mark.parametrize("command", ["run", "eval"])
def test_a_spec_is_validated_whole_whoever_plays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str, spec: str, message: str
) -> None:
    """Also where a scripted policy takes the place of the reasoning that is wrong."""
    out = str(tmp_path / "out")
    rest = ["--policy", "random", "--spec", spec] if command == "run" else ["--policies", "random", "--specs", spec]
    assert message in refused(capsys, command, "--env", TOY, *rest, "--out", out)
    assert not Path(out).exists()


def test_a_missing_model_names_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("huggingface_hub")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    assert "smollm2-135m" in refused(capsys, "run", "--env", TOY, "--policy", "./no/such/model")
    assert "smollm2-135m" in refused(
        capsys, "eval", "--env", TOY, "--policies", "./no/such/model", "--out", str(tmp_path / "out")
    )
    assert not (tmp_path / "out").exists()


def test_a_config_whose_patterns_match_no_call(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    pytest.importorskip("trl")
    from trainers.config import ScaffoldConfig

    config = ScaffoldConfig(output_dir=str(tmp_path), train_calls=["memory.summry"], report_to=[], bf16=False)
    with pytest.raises(SystemExit) as caught, expected_errors():
        config.check()
    assert caught.value.code == 2
    assert "train_calls ['memory.summry'] match no call" in capsys.readouterr().err


def test_unexpected_errors_keep_their_traceback() -> None:
    with pytest.raises(ZeroDivisionError), expected_errors():
        _ = 1 / 0
    with pytest.raises(ValueError, match="shape"), expected_errors():
        np.zeros(3).reshape(2, 2)
    with pytest.raises(SystemExit), expected_errors(ZeroDivisionError):
        _ = 1 / 0


def test_a_value_error_is_expected_when_our_code_raised_it() -> None:
    from eval.statistics import bootstrap

    with pytest.raises(ValueError, match="level") as caught:
        bootstrap([1.0], level=2.0)
    assert is_expected(caught.value)


def test_one_line() -> None:
    assert one_line(SpecError("a\n  b")) == "a b"
    assert one_line(ModuleNotFoundError("No module named 'peft'", name="peft.x")).endswith("'agentspec-rl[train]'")
    assert one_line(FileNotFoundError(2, "No such file or directory", "x.yaml")).startswith("x.yaml: No such file")
    with pytest.raises(SystemExit):
        fail("plain text")


def test_arguments(tmp_path: Path) -> None:
    assert key_values(["a-b=1", "c=[x, 2]", "d="], "--option") == {"a_b": 1, "c": ["x", 2], "d": None}
    assert parse_seeds(["0-2", "7,1"]) == [0, 1, 2, 7]
    file = tmp_path / "mine.yaml"
    file.write_text("reasoning: cot\n")
    assert labelled_spec(str(file))[0] == "mine"
    assert labelled_spec(f"x={file}")[0] == "x"
    assert labelled_spec("y=reasoning: cot")[1].reasoning.name == "cot"
    assert labelled_spec("reasoning: cot")[0] == "cot+none"


# --- list, view, eval, export ----------------------------------------------------------------------------------------


def test_list_json_has_every_name_with_profile_and_needs(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found) == ["env", "perception", "memory", "reasoning", "reflection", "reward"]
    for kind, entries in found.items():
        assert set(entries) == set(REWARDS if kind == "reward" else REGISTRY.entries[kind])
        for entry in entries.values():
            assert set(entry["calls"]) == {"retrieve", "store", "step", "episode"}
            assert isinstance(entry["needs"], list) and entry["summary"]
    assert found["reasoning"]["cot"]["calls"]["step"] == [1, 4]
    assert main(["list", "reasoning"]) == 0
    assert "1-4 calls per step" in capsys.readouterr().out
    assert main(["list", "rewards"]) == 0
    assert capsys.readouterr().out.startswith("reward\n")


def test_the_list_is_a_table_of_two_columns(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "memories"]) == 0
    heading, *lines = capsys.readouterr().out.splitlines()
    wide = max(map(len, REGISTRY.entries["memory"]))
    assert heading == "memory" and max(map(len, lines)) <= 116
    # A name stands in the first column, or the line goes on with the text above; the text begins in one column.
    assert [line[2 : wide + 2].rstrip() for line in lines if line[2] != " "] == sorted(REGISTRY.entries["memory"])
    assert {line[wide + 2 : wide + 4] for line in lines} == {"  "} and all(line[wide + 4] != " " for line in lines)


def test_a_memory_file_given_as_trajectories_is_recognised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "x.memory.json"
    path.write_bytes(MemoryBank(("base", "none")).dump())
    assert f"agentspec view --memory {path}" in refused(capsys, "view", str(path))


LATE = {
    "a setting nobody takes": (["--llm", "dtyp=float32"], "did you mean dtype"),
    "a value of the wrong type": (["--llm", "max_batch=many"], "max_batch must be a whole number"),
    "no batch": (["--llm", "max_batch=0"], "max_batch is 0; expected at least 1"),
    "a value out of its list": (["--llm", "dtype=float17"], "dtype must be 'auto' or"),
    "no embedder": (["--spec", "memory: generative"], "needs an embedder"),
    "no such adapter of a helper": (
        ["--spec", "{memory: summary, roles: {'memory.*': {adapter: none}}}"],
        "none is no",
    ),
    "no snapshots": (["--spec", "reasoning: lats", "--env", FORGETFUL], "snapshots"),
}


@pytest.mark.parametrize(
    ("command", "case"),
    [("run", case) for case in LATE] + [("eval", case) for case, (options, _) in LATE.items() if "--llm" in options],
)
def test_what_cannot_work_is_told_before_the_model_loads(
    case: str, command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("transformers")

    def load(self: Policy) -> Any:
        raise AssertionError("the model was loaded")

    monkeypatch.setattr(Policy, "build", load)
    (tmp_path / "config.json").write_text("{}")  # a model's folder, as far as can be told without loading it
    options, message = LATE[case]
    options = [o.replace("--spec", "--specs") if command == "eval" else o for o in options]
    who = ["--policies" if command == "eval" else "--policy", str(tmp_path)]
    out = ["--out", str(tmp_path / "out")]
    assert message in refused(capsys, command, *([] if FORGETFUL in options else ["--env", TOY]), *who, *out, *options)


def test_view_prints_an_episode(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "t.jsonl"
    main(["run", "--env", TOY, *SELL, "--out", str(out), "--episodes", "2"])
    capsys.readouterr()
    assert main(["view", str(out), "--episode", "1"]) == 0
    text = capsys.readouterr().out
    assert "seed 1" in text and "You trade." in text and text.count("action: SELL()") == 5
    assert f"reward: +{prices(1)[0]}.00" in text and "completed" in text
    assert main(["view", str(out), "--steps", "2-3", "--full"]) == 0
    text = capsys.readouterr().out
    assert text.count("--- step") == 2 and "[reasoning.direct/act" in text and "The price is" in text
    assert "there is no episode 2" in refused(capsys, "view", str(out), "--episode", "2")
    assert "expected A-B" in refused(capsys, "view", str(out), "--steps", "x")


def test_eval_prints_and_writes_the_matrix(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["eval", "--env", TOY, "--policies", *SELL[1:2], *SELL[2:], "--seeds", "0-2", "--out", str(tmp_path)]
    command += ["--specs", "plain=reasoning: direct", "remembering=memory: base"]
    assert main([*command, "--plot"]) == 0
    out, err = capsys.readouterr()
    mean = sum(sum(prices(s)) for s in range(3)) / 3
    assert f"{mean:.2f} [" in out and "| policy | plain | remembering |" in out and "6/6 episodes" in err
    assert {p.name for p in tmp_path.iterdir()} == {
        ".lock",
        "episodes.jsonl",
        "configurations",
        "results.jsonl",
        "results.md",
        "summary.json",
        "matrix.png",
    }
    assert main([*command, "--json"]) == 0
    out, err = capsys.readouterr()
    assert [c["episodes"] for c in json.loads(out)] == [3, 3] and err == ""  # nothing was played again
    assert "labelled 'a'" in refused(capsys, *command, "--specs", "a=memory: base", "a=memory: none")


def test_eval_without_its_packages_plays_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    out = tmp_path / "out"
    told = refused(capsys, "eval", "--env", TOY, "--policies", "random", "--out", str(out))
    assert "scipy" in told and "agentspec-rl[eval]" in told and not out.exists()


def test_export_says_what_it_wrote(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("peft")
    from tests.tiny import tiny_model, tiny_tokenizer

    tokenizer = tiny_tokenizer()
    tiny_model(tokenizer).save_pretrained(tmp_path / "run")
    tokenizer.save_pretrained(tmp_path / "run")
    assert main(["export", str(tmp_path / "run"), "--to", str(tmp_path / "out"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["kind"] == "model"
    assert (tmp_path / "out" / "agentspec.json").is_file()


def test_the_installed_program_exits_with_two() -> None:
    command = [sys.executable, "-m", "agentspec.cli", "run", "--env", "deliverybnch"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert result.returncode == 2 and result.stderr.startswith("agentspec: error: unknown env")
