"""The matrix on the toy environment: pairing, resuming, failures, one model at a time."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from agentspec.episode import make_env
from agentspec.llm.pricing import Price, Prices
from agentspec.llm.scripted import ScriptedLLM
from agentspec.policies import Policy
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.tasks import task_sets
from agentspec.trajectory import read_trajectories
from agentspec.types import Task
from eval.cells import Settings, plan_cell
from eval.limits import Limits
from eval.matrix import evaluate
from eval.repricing import repriced, unpriced_note
from eval.store import Store
from eval.tables import differences, markdown, summarise
from tests.toy_env import TOY

PLAIN = AgentSpec()
SCAFFOLDS = {"plain": PLAIN, "memory": AgentSpec.from_data({"memory": "base", "layout": "snapshot"})}
TASKS = [Task(TOY, seed) for seed in range(3)]
SELLER, WAITER = Policy("seller", "s"), Policy("waiter", "w")
SCRIPTS = {"seller": ["SELL()"], "waiter": ["WAIT()"]}


class Maker:
    """Makes scripted models and remembers whose."""

    def __init__(self) -> None:
        self.made: list[str] = []

    def __call__(self, policy: Policy) -> ScriptedLLM:
        self.made.append(policy.name)
        return ScriptedLLM(SCRIPTS[policy.name])


def play(out: Path, policies: Any = (SELLER, WAITER), specs: Any = None, tasks: Any = TASKS, **settings: Any) -> Any:
    maker = Maker()
    rows = evaluate(policies, specs or SCAFFOLDS, tasks, out=out, make_llm=maker, **settings)
    return rows, maker.made


def earned(rows: list[dict[str, Any]], **where: Any) -> list[float]:
    return [r["net_earnings"] for r in rows if all(r[k] == v for k, v in where.items())]


def timeless(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows without what the clock decides."""
    plain = [{k: v for k, v in row.items() if k not in ("thinking_s", "thinking_s_per_step", "wall_s")} for row in rows]
    return [{**r, "modules": {m: t | {"latency_s": 0} for m, t in r.get("modules", {}).items()}} for r in plain]


def test_every_policy_plays_every_scaffold_on_the_same_tasks(tmp_path: Path) -> None:
    rows, made = play(tmp_path)
    assert len(rows) == 2 * 2 * 3
    assert made == ["seller", "waiter"]  # one model each, shared by both scaffolds
    # The seller sells at all five prices of a task: what that pays depends on the task alone.
    expected = []
    for task in TASKS:
        env = make_env(task)
        env.reset(seed=task.seed)
        expected.append(float(sum(env.unwrapped.prices[:5])))
    assert earned(rows, policy="seller", scaffold="plain") == expected
    assert earned(rows, policy="seller", scaffold="memory") == expected
    assert earned(rows, policy="waiter") == [0.0] * 6
    assert [r["seed"] for r in rows] == [0, 1, 2] * 4
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == 12


def test_a_finished_evaluation_loads_no_model(tmp_path: Path) -> None:
    rows, _ = play(tmp_path)
    again, made = play(tmp_path)
    assert again == rows and made == []


def test_a_stopped_evaluation_goes_on_where_it_was(tmp_path: Path) -> None:
    rows, _ = play(tmp_path)
    path = tmp_path / "episodes.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:7]) + lines[7][:40])  # seven whole lines and a torn one
    again, made = play(tmp_path)
    assert made == ["waiter"]  # the seller's six were done
    assert timeless(again) == timeless(rows)
    assert path.read_text().startswith("".join(lines[:7])) and len(path.read_text().splitlines()) == 12


def test_more_tasks_and_rollouts_are_added_to_what_is_there(tmp_path: Path) -> None:
    play(tmp_path, policies=[SELLER])
    rows, _ = play(tmp_path, policies=[SELLER, WAITER], tasks=[*TASKS, Task(TOY, 9)], rollouts=2)
    assert len(rows) == 2 * 2 * 4 * 2


def test_a_changed_scaffold_under_an_old_name_is_played_and_the_old_episodes_stay(tmp_path: Path) -> None:
    rows, _ = play(tmp_path, policies=[SELLER], specs={"plain": PLAIN})
    for changes in ({"specs": {"plain": SCAFFOLDS["memory"]}}, {"sampling": {"temperature": 0.5}}, {"seed": 1}):
        assert play(tmp_path, **{"policies": [SELLER], "specs": {"plain": PLAIN}} | changes)[1] == ["seller"]
    assert play(tmp_path, policies=[SELLER], specs={"plain": PLAIN}) == (rows, [])  # as if nothing had been between
    assert len((tmp_path / "episodes.jsonl").read_text().splitlines()) == 4 * 3


def test_matrices_share_a_store_whatever_they_call_things(tmp_path: Path) -> None:
    rows, _ = play(tmp_path / "a", policies=[SELLER], specs={"plain": PLAIN}, store=tmp_path / "store")
    renamed = Policy("trader", "s")
    again, made = play(tmp_path / "b", policies=[renamed], specs={"bare": PLAIN}, store=tmp_path / "store")
    assert made == [] and [r["net_earnings"] for r in again] == [r["net_earnings"] for r in rows]
    assert {(r["policy"], r["scaffold"]) for r in again} == {("trader", "bare")}


def test_weights_count_by_their_bytes_wherever_they_lie(tmp_path: Path) -> None:
    for name, weights in (("a", b"w" * 5_000_000), ("b", b"w" * 5_000_000), ("c", b"w" * 2_000_000 + b"x" * 3_000_000)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "adapter_model.safetensors").write_bytes(weights)
    # The third has the same size and the same first and last bytes up to the middle: only reading all of it tells.
    a, b, c = (Policy("p", "m", str(tmp_path / name)).identity() for name in "abc")
    assert a == b != c


def test_one_evaluation_at_a_time_writes_into_a_store(tmp_path: Path) -> None:
    with Store(tmp_path).writing(), pytest.raises(SpecError, match="another evaluation is writing"):
        play(tmp_path)


def test_training_runs_of_a_recipe_are_one_row_of_the_table(tmp_path: Path) -> None:
    runs = [Policy("trained", f"model{i}", run=str(i)) for i in range(3)]
    answers = {"": "WAIT()", "0": "SELL()", "1": "SELL()", "2": "WAIT()"}
    rows = evaluate(
        [Policy("start", "s"), *runs],
        {"plain": PLAIN},
        TASKS,
        out=tmp_path,
        make_llm=lambda policy: ScriptedLLM([answers[policy.run]]),
    )
    _, trained = summarise(rows)
    assert (trained.runs, trained.episodes, trained.estimates["net_earnings"].unit) == (3, 9, "run")
    # Two runs earn m on these tasks, one earns 0: the mean over runs is 2m/3, against a start that earns nothing.
    m = sum(earned(rows, policy="trained")[:3]) / 3
    [gain] = differences(rows, "net_earnings")
    assert gain["mean"] == pytest.approx(2 * m / 3) and (gain["n"], gain["unit"]) == (3, "run")
    assert "| start | plain | 1 | 3 |" in markdown(rows) and "| trained | plain | 3 | 9 |" in markdown(rows)


def test_a_cell_stops_at_its_limit_and_the_table_says_so(tmp_path: Path) -> None:
    first, _ = play(tmp_path / "free", policies=[SELLER], specs={"plain": PLAIN}, concurrency=1)
    one = first[0]["input_tokens"] + first[0]["output_tokens"]
    limits = Limits(cell_tokens=one + 1)  # spent once two episodes are played
    plain = {"plain": PLAIN}
    rows, _ = play(tmp_path / "limited", policies=[SELLER], specs=plain, concurrency=1, limits=limits)
    assert [r["status"] for r in rows] == ["completed", "completed", "unplayed"]
    assert rows[2]["error"].startswith("cell_tokens: ")
    assert "| seller | plain | 1 | 2 (1 not played) | 0 |" in markdown(rows)
    # It stays spent when the evaluation is started again, and goes on where the limit is lifted.
    assert play(tmp_path / "limited", policies=[SELLER], specs=plain, concurrency=1, limits=limits)[0] == rows
    assert [r["status"] for r in play(tmp_path / "limited", policies=[SELLER], specs=plain)[0]] == ["completed"] * 3


def test_an_episode_over_its_time_limit_fails_alone(tmp_path: Path) -> None:
    tasks = [TASKS[0], Task(TOY, 5, {"fault": "hang"})]
    rows, _ = play(
        tmp_path, policies=[SELLER], specs={"plain": PLAIN}, tasks=tasks, limits=Limits(episode_s=1.0), timeout_s=None
    )
    assert [r["status"] for r in rows] == ["completed", "failed"] and "longer than 1 s" in rows[1]["error"]


def test_a_backend_that_breaks_down_stops_its_own_cells_only(tmp_path: Path) -> None:
    def make(policy: Policy) -> ScriptedLLM:
        if policy.name == "seller":
            raise RuntimeError("out of memory")
        return ScriptedLLM(SCRIPTS[policy.name])

    rows = evaluate([SELLER, WAITER], SCAFFOLDS, TASKS, out=tmp_path, make_llm=make)
    assert [r["status"] for r in rows] == ["unplayed"] * 6 + ["completed"] * 6
    assert rows[0]["error"] == "RuntimeError: out of memory"
    assert [r["status"] for r in play(tmp_path)[0]] == ["completed"] * 12  # started again, it plays what was missing


def test_costs_are_known_by_module(tmp_path: Path) -> None:
    rows, _ = play(tmp_path, policies=[SELLER], specs={"plain": PLAIN})
    [(module, taken)] = rows[0]["modules"].items()
    assert module.startswith("reasoning") and taken["calls"] == rows[0]["steps"]
    assert taken["input_tokens"] + taken["output_tokens"] == rows[0]["input_tokens"] + rows[0]["output_tokens"]


def test_failed_episodes_are_rows_and_can_be_retried(tmp_path: Path) -> None:
    tasks = {"fair": TASKS[:1], "broken": [Task(TOY, 5, {"fault": "crash"})]}
    rows, _ = play(tmp_path, policies=[SELLER], specs={"plain": PLAIN}, tasks=tasks)
    assert [r["status"] for r in rows] == ["completed", "failed"] and "the toy broke" in rows[1]["error"]
    assert [r["tasks"] for r in rows] == ["fair", "broken"]
    assert play(tmp_path, policies=[SELLER], specs={"plain": PLAIN}, tasks=tasks)[1] == []
    again, made = play(tmp_path, policies=[SELLER], specs={"plain": PLAIN}, tasks=tasks, retry_failed=True)
    assert made == ["seller"] and len(again) == 2
    # One row per cell; of the store's lines about the same episode nothing was taken away.
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == 2
    assert len((tmp_path / "episodes.jsonl").read_text().splitlines()) == 3


def test_evaluation_is_greedy_unless_told_otherwise(tmp_path: Path) -> None:
    play(tmp_path / "a", policies=[SELLER], specs={"plain": PLAIN}, trajectories=True)
    play(tmp_path / "b", policies=[SELLER], specs={"plain": PLAIN}, trajectories=True, sampling={"temperature": 0.7})
    for folder, temperature in (("a", 0.0), ("b", 0.7)):
        paths = sorted((tmp_path / folder / "trajectories/seller/plain").iterdir())
        rows = [json.loads(line) for line in (tmp_path / folder / "results.jsonl").read_text().splitlines()]
        assert paths == sorted(tmp_path / folder / row["trajectory"] for row in rows) and len(paths) == 3
        [trajectory] = read_trajectories(paths[0])
        assert {c.sampling.temperature for c in trajectory.calls} == {temperature}


def test_memory_of_a_run_is_carried_from_episode_to_episode(tmp_path: Path) -> None:
    spec = {"m": replace(SCAFFOLDS["memory"], scope="run")}
    rows, _ = play(tmp_path, policies=[SELLER], specs=spec, trajectories=True)
    assert [r["status"] for r in rows] == ["completed"] * 3
    path = tmp_path / "episodes.jsonl"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:2]))
    events: list[int] = []
    again, _ = play(
        tmp_path, policies=[SELLER], specs=spec, trajectories=True, on_row=lambda row: events.append(row["seed"])
    )
    # The third was missing: memory is taken up as the second left it.
    assert events == [2] and timeless(again) == timeless(rows)


def test_what_cannot_work_is_refused_before_anything_is_played(tmp_path: Path) -> None:
    cases: list[tuple[Callable[[], Any], str]] = [
        (lambda: play(tmp_path, policies=[SELLER, SELLER]), "two policies are called seller"),
        (lambda: play(tmp_path, policies=[]), "nothing to evaluate"),
        (lambda: play(tmp_path, tasks=[]), "no tasks"),
        (lambda: play(tmp_path, tasks=[TASKS[0], TASKS[0]]), "given twice"),
        (lambda: play(tmp_path, tasks=[Task("deliverybnch", 0)]), "did you mean deliverybench"),
        (lambda: play(tmp_path, sampling={"temprature": 1}), "did you mean temperature"),
        (lambda: play(tmp_path, tasks=[Task(TOY, 0, {"nonsense": 1})]), "takes no option 'nonsense'"),
    ]
    for attempt, message in cases:
        with pytest.raises(SpecError, match=message):
            attempt()
    assert not list(tmp_path.iterdir())


def test_any_environment_of_gymnasium_is_evaluated(tmp_path: Path) -> None:
    tasks = [Task("CartPole-v1", seed) for seed in range(2)]
    rows = evaluate([Policy("random")], {"plain": PLAIN}, tasks, out=tmp_path)
    assert [row["return"] for row in rows] == [row["steps"] for row in rows]  # a point for every step
    text = markdown(rows)
    assert "## CartPole-v1: return" in text and "| random |" in text and "profit" not in text


def test_tasks_are_split_by_environment_and_options() -> None:
    assert list(task_sets(TASKS)) == [TOY]
    menu = [Task(TOY, seed, {"menu": True}) for seed in range(2)]
    assert {k: len(v) for k, v in task_sets([*TASKS, *menu]).items()} == {TOY: 3, f"{TOY} menu=True": 2}


def test_a_broken_results_file_is_named_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "episodes.jsonl").write_text('{"policy": "x"}\n')
    with pytest.raises(ValueError, match=r"episodes\.jsonl, line 1"):
        play(tmp_path)


def test_cells_that_ask_for_the_same_episodes_play_them_once(tmp_path: Path) -> None:
    told: list[str] = []
    rows, _ = play(
        tmp_path, policies=[SELLER], specs={"a": PLAIN, "b": PLAIN}, on_row=lambda row: told.append(row["scaffold"])
    )
    assert [r["scaffold"] for r in rows] == ["a"] * 3 + ["b"] * 3 and sorted(told) == ["a"] * 3 + ["b"] * 3
    assert earned(rows, scaffold="a") == earned(rows, scaffold="b")
    assert len((tmp_path / "episodes.jsonl").read_text().splitlines()) == 3


def test_failed_episodes_count_towards_the_limit_of_their_cell(tmp_path: Path) -> None:
    broken = [Task(TOY, seed, {"fault": "crash"}) for seed in range(3)]
    rows, _ = play(
        tmp_path,
        policies=[SELLER],
        specs={"plain": PLAIN},
        tasks=broken,
        concurrency=1,
        limits=Limits(cell_tokens=1),
    )
    assert [r["status"] for r in rows] == ["failed", "unplayed", "unplayed"]


def test_prices_are_part_of_an_episode_that_they_can_end(tmp_path: Path) -> None:
    prices = Prices({"scripted": Price(1e6, 1e6)})
    bounded = AgentSpec.from_data({"budget": {"cost": 0.5}})
    for spec, played, ended in ((PLAIN, [], "environment"), (bounded, ["seller"], "budget")):
        out = tmp_path / ended
        assert play(out, policies=[SELLER], specs={"s": spec})[0][0]["ended"] == "environment"
        rows, made = play(out, policies=[SELLER], specs={"s": spec}, prices=prices)
        assert made == played and rows[0]["ended"] == ended


def test_changed_prices_change_the_costs_and_play_nothing(tmp_path: Path) -> None:
    cheap, dear = (Prices({"scripted": Price(p, 2 * p)}) for p in (1.0, 3.0))
    first, _ = play(tmp_path, policies=[SELLER], specs={"s": PLAIN}, prices=cheap)
    again, made = play(tmp_path, policies=[SELLER], specs={"s": PLAIN}, prices=dear)
    assert made == []
    for before, after in zip(first, again, strict=True):
        dollars = (before["input_tokens"] + 2 * before["output_tokens"]) / 1e6
        assert before["cost"] == pytest.approx(dollars) and after["cost"] == pytest.approx(3 * dollars)
        assert sum(sums["cost"] for sums in after["modules"].values()) == pytest.approx(3 * dollars)


def test_a_store_without_usage_keeps_its_costs(tmp_path: Path) -> None:
    first, _ = play(tmp_path, policies=[SELLER], specs={"s": PLAIN}, prices=Prices({"scripted": Price(1.0, 2.0)}))
    path = tmp_path / "episodes.jsonl"
    old = [{k: v for k, v in json.loads(line).items() if k != "usage"} for line in path.read_text().splitlines()]
    path.write_text("".join(json.dumps(record) + "\n" for record in old))
    again, made = play(tmp_path, policies=[SELLER], specs={"s": PLAIN})
    costs = [row["cost"] for row in first]
    assert made == [] and min(costs) > 0 and [row["cost"] for row in again] == pytest.approx(costs)


def test_models_without_a_price_are_named_in_the_table(tmp_path: Path) -> None:
    prices = Prices({"another": Price(1.0, 2.0)})
    rows, _ = play(tmp_path, policies=[SELLER], specs={"s": PLAIN}, prices=prices)
    assert {row["cost"] for row in rows} == {0.0} and {tuple(row["unpriced"]) for row in rows} == {("scripted",)}
    assert "No price is given for scripted: calls of these models count as $0." in markdown(rows)
    free, _ = play(tmp_path, policies=[SELLER], specs={"s": PLAIN})  # nobody asked for dollars
    assert "No price" not in markdown(free)


def test_a_record_that_lacks_parts_is_priced_all_the_same() -> None:
    used = {"module": "memory.x", "model": "m", "input_tokens": 1_000_000}
    record = {"usage": [used, {"model": "n"}], "episode": {"cost": 0.0, "modules": {}}}
    episode = repriced(record, Prices({"m": Price(2.0, 3.0)}))["episode"]
    assert episode["cost"] == episode["modules"]["memory.x"]["cost"] == 2.0 and episode["unpriced"] == ["n"]
    assert unpriced_note([episode, {}]) and not unpriced_note([{}])


def test_a_sentence_encoder_counts_by_its_bytes(tmp_path: Path) -> None:
    store, digests = Store(tmp_path / "store"), []
    for weights in (b"a", b"b"):
        encoder = tmp_path / "encoder"
        encoder.mkdir(exist_ok=True)
        (encoder / "model.safetensors").write_bytes(weights * 10)
        (encoder / "config.json").write_text("{}")
        spec = replace(PLAIN, embedder={"name": "minilm", "model": str(encoder)})
        digests.append(plan_cell(SELLER, "s", spec, {"toy": TASKS}, Settings(), store).configuration)
    assert digests[0] != digests[1]


def test_a_record_may_hold_half_a_surrogate_pair(tmp_path: Path) -> None:
    with Store(tmp_path).writing() as store:
        store.add("k", {"episode": {"status": "failed", "error": "odd: \ud83d"}})
    record = Store(tmp_path).get("k")
    assert record is not None and record["episode"]["error"] == "odd: \ud83d"


def test_rows_name_their_trajectories_as_found_from_their_own_folder(tmp_path: Path) -> None:
    rows, _ = play(tmp_path / "out", policies=[SELLER], trajectories=True, store=tmp_path / "store")
    assert all((tmp_path / "out" / row["trajectory"]).is_file() for row in rows)
    assert json.loads((tmp_path / "store/episodes.jsonl").read_text().splitlines()[0])["trajectory"].startswith("traj")


def test_a_lost_memory_stops_its_own_cell_and_says_so(tmp_path: Path) -> None:
    specs = {"run": replace(SCAFFOLDS["memory"], scope="run"), "plain": PLAIN}
    play(tmp_path, policies=[SELLER], specs=specs)
    for state in (tmp_path / "states").iterdir():
        state.unlink()
    rows, _ = play(tmp_path, policies=[SELLER], specs=specs)
    assert [r["status"] for r in rows] == ["completed", "unplayed", "unplayed"] + ["completed"] * 3
    assert "is missing" in rows[1]["error"]


def test_one_checkpoint_given_twice_is_not_two_training_runs(tmp_path: Path) -> None:
    runs = [Policy("seller", model, run=str(i)) for i, model in enumerate(("m", "n", "m"))]
    with pytest.raises(SpecError, match=r"'seller': two of its training runs \(0, 1, 2\) have the same weights"):
        play(tmp_path, policies=runs)
    # Who knows that they are several runs, which have learnt nothing, counts each: the episodes are kept once.
    rows, _ = play(tmp_path, policies=runs, specs={"plain": PLAIN}, twins=True)
    keys = {run: [row["key"] for row in rows if row["run"] == run] for run in "012"}
    assert keys["0"] == keys["2"] != keys["1"] and all(row["status"] == "completed" for row in rows)
