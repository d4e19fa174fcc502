"""The audit: an honest run passes; whatever is edited afterwards is noticed, and named by file, record and field."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("trl")

from datasets import Dataset

from agentspec.cli import main
from agentspec.files import digest, file_digest
from agentspec.records.completions import check_completion
from agentspec.records.digests import differing, field_digests
from agentspec.records.log import RunLog
from agentspec.registry import SpecError
from benchmarks.edits import FILE_KINDS, KINDS, apply, edit
from benchmarks.tamper import RUN, train
from tests.toy_env import ToyEnv
from tests.trainers.builders import call, episode
from tests.trainers.played import toy_tasks, toy_trainer
from trainers.audit import _equal, audit, check_samples, check_sums, padding_rows
from trainers.credit import CreditRule
from trainers.estimators import ESTIMATORS
from trainers.provenance import check_tokens
from trainers.receipts import row_digest
from trainers.rollouts import task_rows
from trainers.sequences import Row, build_sequences

SUPO = {
    "agent": {
        "reasoning": "direct",
        "memory": {"name": "summary", "every": 1, "summary_tokens": 6},
        "sampling": {"max_tokens": 8},
    },
    "train_calls": ["reasoning.*", "memory.summary"],
    "mask_truncated": ["memory.summary"],
}
REACT = {"agent": {"reasoning": "react", "sampling": {"max_tokens": 8}}}


def _crashing(task: Any) -> Any:
    """The first task's environment works; the second one's crashes always."""
    return ToyEnv(**task.options, fault="crash" if task.seed == 1 else "")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three updates: menus, a memory that asks the model, evaluation while training."""
    folder = tmp_path_factory.mktemp("audit") / "run"
    train(folder, **RUN)
    return folder


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(run, tmp_path / "copy"))


def violations(folder: Path, **options: Any) -> list[str]:
    return [v for r in audit(folder, **options) for v in r.violations]


# --- honest runs -----------------------------------------------------------------------------------------------------


def test_an_honest_run_passes(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    head = file_digest(run / "seal.json")
    assert main(["audit", str(run), "--head", head]) == 0
    out = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in out[:3]] == ["update 0", "update 1", "update 2"]
    assert "4 episodes (0 unscorable)" in out[0] and "reasoning.react/act" in out[0]
    assert out[-1] == "3 updates audited: no violation"
    assert main(["audit", str(run), "--step", "1", "--json"]) == 0
    (finding,) = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    # Every trained token is in the denominator, and nothing else.
    assert finding["round"] == 1 and finding["trained"] == finding["denominator"] > 0
    assert sum(finding["by_tag"].values()) == finding["trained"]


def test_the_head_is_printed_at_the_end_of_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    toy_trainer(tmp_path, max_steps=1).train()
    assert f"head of the chain: {file_digest(tmp_path / 'seal.json')}" in capsys.readouterr().err


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_no_honest_estimator_is_a_violation(tmp_path: Path, estimator: str) -> None:
    discount = {"gamma": 0.9} if "gamma" in ESTIMATORS[estimator].needs else {}
    toy_trainer(tmp_path, estimator=estimator, max_steps=1, **discount).train()
    (finding,) = audit(tmp_path)
    assert (finding.violations, finding.notes) == ([], []) and finding.trained == finding.denominator > 0


@pytest.mark.parametrize(
    "changes",
    [
        SUPO,
        REACT,
        {"estimator": "rloo", "packing": "padded"},
        {"estimator": "reward_to_go", **SUPO},
        {"normalize": "rollout", **SUPO},
        {"skip_zero_variance": True, "max_steps": 1},
        {"steps_per_generation": 4, "max_steps": 3},
        {"num_iterations": 2, "max_steps": 3},
    ],
    ids=["supo", "react-menu", "rloo", "supo-reward_to_go", "supo-rollout", "skip", "long-round", "iterations"],
)
def test_honest_runs_of_every_kind_pass(tmp_path: Path, changes: dict[str, Any]) -> None:
    settings = {"max_steps": 1, **changes}
    toy_trainer(tmp_path, **settings).train()
    receipts = list(audit(tmp_path))
    assert receipts and not [(v, r.notes) for r in receipts for v in r.violations]
    assert all(r.trained == r.denominator for r in receipts)
    if changes.get("agent") == SUPO["agent"]:
        assert receipts[0].rows > receipts[0].episodes  # one row per segment


def test_a_run_with_failed_rollouts_passes_and_counts_them(tmp_path: Path) -> None:
    toy_trainer(tmp_path, toy_tasks(2), make_env=_crashing, max_steps=1).train()
    (finding,) = audit(tmp_path)
    assert (finding.episodes, finding.unscorable, finding.violations) == (4, 2, [])


# --- edits -----------------------------------------------------------------------------------------------------------

NAMED = {
    "log-probabilities of all sampled tokens": r"000001.jsonl, record 1 .*: edited: calls.completions.logprobs",
    "log-probability of a forced token": "record 1 .*: edited: calls.completions.logprobs",
    "temperature of a trained call": r"record 1 .*: edited: calls.sampling",
    "top_p of a trained call": r"record 1 .*: edited: calls.sampling",
    "top_k of a trained call": r"record 1 .*: edited: calls.sampling",
    "constraint widened": "record 1 .*: edited: calls.completions.allowed",
    "constraint without the sampled token": "its constraint does not hold token",
    "constraint lifted": "record 1 .*: edited: calls.completions.allowed",
    "sampled token": "record 1 .*: edited: calls.completions.token_ids",
    "action text": "record 1 .*: edited: steps.action",
    "observation text": "record 1 .*: edited: steps.text",
    "completion text": "record 1 .*: edited: calls.completions.text",
    "finish reason": "record 1 .*: edited: calls.completions.finish_reason",
    "credit of a completion": "record 1 .*: edited: calls.completions.credit",
    "spec of an episode": "record 1 .*: edited: spec.",
    "versions of an episode": "record 1 .*: edited: versions.",
    "policy of an episode": "not played by policy step-1",
    "status of an episode": "record 1 .*: edited: status",
    "reward of a step": "record 1 .*: edited: steps.reward",
    "the same added to all returns of a group": "record 2 .*: edited: metrics.return, steps.info, steps.reward",
    "an episode deleted": "has 3 records, the receipt names 4",
    "episodes reordered": r"episodes\[0\] is .* but the receipt says",
    "the first update deleted": r"updates.jsonl, record 1: what it followed was edited, deleted",
    "an update deleted": r"updates.jsonl, record 2: what it followed was edited, deleted",
    "the last update deleted": r"updates.jsonl has 2 records, seal.json says 3",
    "an update doubled": r"updates.jsonl, record 3: what it followed was edited, deleted, doubled or moved",
    "updates reordered": r"updates.jsonl, record 1: what it followed was edited, deleted, doubled or moved",
    "advantage in the receipt": r"updates.jsonl, update 1: rows\[0\].advantage is .* but the receipt says 9.0",
    "denominator in the receipt": "updates.jsonl, update 1: denominator is .* but the receipt says 1",
    "padding rows in the receipt": "updates.jsonl, update 1: padding_rows is .* but the receipt says 50",
    "a row deleted from the receipt": "updates.jsonl, update 1: rows: ",
    "a row added to the receipt": "updates.jsonl, update 1: rows: ",
    "estimator in the receipt": "settings.estimator is 'grpo' by the .* manifest, but the receipt says 'rloo'",
    "loss_type in the receipt": "settings.loss_type is 'dapo'",
    "epsilon in the receipt": "settings.epsilon is",
    "beta in the receipt": "settings.beta is",
    "learning_rate in the receipt": "settings.learning_rate is",
    "estimator in the manifest": "manifest.json: config.estimator was edited",
    "loss_type in the manifest": "manifest.json: config.loss_type was edited",
    "epsilon in the manifest": "manifest.json: config.epsilon was edited",
    "beta in the manifest": "manifest.json: config.beta was edited",
    "learning_rate in the manifest": "manifest.json: config.learning_rate was edited",
    "spec in the manifest": "manifest.json: spec.reasoning was edited",
    "versions in the manifest": "manifest.json: versions.numpy was edited",
    "logged metrics": "metrics.jsonl, record 2: edited",
    "an evaluation": "evaluations.jsonl, record 1: edited",
    "a memory that is carried": r"memory.json is not what the last receipt says \(`chain.memory`\)",
    "the memories deleted": r"memory.json is not what the last receipt says \(`chain.memory`\)",
    "a line added to metrics.jsonl": "metrics.jsonl has 4 records, seal.json says 3",
    "the seal deleted": "seal.json is missing, and all 3 steps were made: it was deleted",
    "a trajectory file deleted": "trajectories/000000.jsonl is missing",
    "a trajectory file added": "trajectories/000900.jsonl: no receipt names it",
    "bytes that read the same": "trajectories/000001.jsonl or its digest .*; its records read as before",
    "a trajectory file of another name added": "trajectories/more.jsonl: no receipt names it",
    **{
        f"a {what} line in {name}": rf"{name} or its digest in seal.json was edited; its records read as before"
        for what in ("torn", "blank")
        for name in ("updates.jsonl", "metrics.jsonl", "evaluations.jsonl")
    },
}


@pytest.mark.parametrize("kind", [*KINDS, *FILE_KINDS])
def test_every_kind_of_edit_is_noticed_and_named(copy: Path, kind: str) -> None:
    apply(copy, kind)
    found = violations(copy)
    assert any(re.search(NAMED[kind], v) for v in found), found


def test_an_edit_is_told_of_its_update_alone(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    apply(copy, "sampled token")
    assert main(["audit", str(copy)]) == 1
    out = capsys.readouterr().out
    assert "VIOLATION" in out and "violation" in out.splitlines()[-1]
    assert main(["audit", str(copy), "--step", "0"]) == 0
    assert main(["audit", str(copy), "--step", "1"]) == 1
    assert main(["audit", str(copy), "--step", "2"]) == 0


def test_an_editor_who_computes_every_digest_anew_is_told_by_the_head_alone(copy: Path) -> None:
    """What the docs say cannot be noticed without the head, and is with it."""
    head = file_digest(copy / "seal.json")
    path = copy / "trajectories" / "000001.jsonl"

    def colder(records: list[dict[str, Any]]) -> None:
        records[0]["steps"][0]["text"] = "The price was different."

    edit(path, colder)

    def rechain(records: list[dict[str, Any]]) -> None:
        stated = records[1]["chain"]["files"]["trajectories/000001.jsonl"]
        stated["digest"] = file_digest(path)
        stated["episodes"] = [field_digests(json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]
        line = json.dumps(records[1], sort_keys=True, ensure_ascii=False) + "\n"
        records[2]["chain"]["previous"] = digest(line)

    edit(copy / "updates.jsonl", rechain)
    assert violations(copy) != []  # the seal is still that of the honest run
    forged = RunLog(copy).seal()
    assert violations(copy) == [] and violations(copy, head=forged) == []
    assert any(f"not {head}" in v for v in violations(copy, head=head))


def test_a_run_that_was_interrupted_is_no_violation_and_has_an_exit_code_of_its_own(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Killed in its third update: two steps are logged, of three that the manifest wants."""
    head = file_digest(copy / "seal.json")
    (copy / "seal.json").unlink()
    for name in ("metrics.jsonl", "evaluations.jsonl"):
        edit(copy / name, lambda records: records.pop() and None)
    *updates, whole = audit(copy)
    assert [r.round for r in updates] == [0, 1, 2] and not any(r.violations or r.notes for r in updates)
    assert (whole.round, whole.violations) == (None, []) and "interrupted or under way after update 2" in whole.notes[0]
    assert main(["audit", str(copy)]) == 3
    out = capsys.readouterr().out.splitlines()
    assert out[-1].startswith("3 updates audited: no violation; no seal.json: interrupted or under way after update 2")
    assert main(["audit", str(copy), "--step", "1"]) == 0  # the end is not looked at
    assert main(["audit", str(copy), "--head", head]) == 1  # that of a run that had ended
    assert "VIOLATION seal.json is missing, and the head" in capsys.readouterr().out


def test_memories_of_a_run_under_way_are_those_of_its_last_or_last_but_one_receipt(copy: Path) -> None:
    """They are written after the receipt: whoever is killed in between leaves those of the round before."""
    (copy / "seal.json").unlink()
    for name in ("metrics.jsonl", "evaluations.jsonl"):
        edit(copy / name, lambda records: records.pop() and None)
    first, *_, last = (json.loads(line)["chain"]["memory"] for line in (copy / "updates.jsonl").open())
    assert digest((copy / "memory.json").read_bytes()) == last != first
    assert violations(copy) == []
    RunLog(copy).receipt({"round": 3}, {}, b"later")
    (copy / "memory.json").write_bytes(b"another")
    assert any("memory.json is not what the last receipt says" in v for v in violations(copy))


def test_nothing_is_added_to_the_records_of_a_run_that_has_ended(copy: Path) -> None:
    """It would change the head that was printed, and seal whatever had been edited before."""
    before = {p: p.read_bytes() for p in copy.rglob("*.json*")}
    with pytest.raises(SpecError, match="its run has ended"):
        RunLog(copy).append("metrics.jsonl", {"step": 4})
    with pytest.raises(SpecError, match="its run has ended"):
        RunLog(copy).receipt({"round": 3}, {})
    assert {p: p.read_bytes() for p in copy.rglob("*.json*")} == before


def test_an_evaluation_after_the_end_leaves_the_records_alone(tmp_path: Path) -> None:
    run = toy_trainer(tmp_path, max_steps=1)
    run.train()
    head = file_digest(tmp_path / "seal.json")
    assert "eval_reward" in run.evaluate(Dataset.from_list(task_rows(toy_tasks(1))))
    assert file_digest(tmp_path / "seal.json") == head and violations(tmp_path, head=head) == []


def test_updates_deleted_together_with_the_seal_leave_traces(copy: Path) -> None:
    (copy / "seal.json").unlink()
    edit(copy / "updates.jsonl", lambda r: r.__delitem__(slice(1, None)))
    found = violations(copy)
    assert any("metrics.jsonl is of step 3, but the receipts end at step 1" in v for v in found), found
    edit(copy / "updates.jsonl", lambda r: r.clear())
    assert any("metrics.jsonl is of step 3, but the receipts end at step 0" in v for v in violations(copy))


# --- what tokens and advantages must be ------------------------------------------------------------------------------


def test_a_trained_token_must_be_a_choice_of_the_call_that_claims_it() -> None:
    trajectory = episode([call(0, [1, 2], [5, 7, 9], allowed=((5, 6), (7,), None))])
    (sequence,) = build_sequences(trajectory)
    assert sequence.mask == [0, 0, 1, 0, 1]
    assert check_tokens(sequence, trajectory) == ([], {"reasoning.direct/act": 2})

    def findings(**changes: Any) -> str:
        (changed,) = build_sequences(trajectory)
        for name, (position, value) in changes.items():
            getattr(changed, name)[position] = value
        return "; ".join(check_tokens(changed, trajectory)[0])

    assert "no completion of call 0" in findings(tokens=(4, 8))
    assert "not the prompt" in findings(tokens=(0, 3))
    assert "no call sampled" in findings(mask=(1, 1))
    assert "constraint forced" in findings(mask=(3, 1))
    assert "has no call 9" in findings(calls=(4, 9))


def test_what_no_completion_can_be() -> None:
    def problems(**changes: Any) -> str:
        given: dict[str, Any] = {"logprobs": [-0.5, 0.0, -1.0], "allowed": ((5, 6), (7,), None), **changes}
        (completion,) = call(0, [1], [5, 7, 9], **given).completions
        return "; ".join(check_completion(completion, "here"))

    assert problems() == ""
    assert problems(allowed=()) == ""
    assert "does not hold token 0" in problems(allowed=((6, 8), (7,), None))
    assert "token 1 was forced" in problems(logprobs=[-0.5, -3.0, -1.0])
    assert "above 0" in problems(logprobs=[0.5, 0.0, -1.0])
    assert "not finite" in problems(logprobs=[float("nan"), 0.0, -1.0])
    assert "3 tokens, 2 log-probabilities" in problems(logprobs=[-0.5, 0.0])


def _rows(advantages: Sequence[float]) -> list[Row]:
    return [Row(build_sequences(episode([call(0, [1], [5])]))[0], a, i) for i, a in enumerate(advantages)]


@pytest.mark.parametrize(("estimator", "told"), [("grpo", True), ("gigpo", False)])
def test_advantages_sum_to_zero_where_the_estimator_says_so(estimator: str, told: bool) -> None:
    """Two rollouts with advantages 1 and -0.5: the sum is 0.5."""
    found = list(check_sums(_rows([1.0, -0.5]), [2.0, 0.0], CreditRule(2, estimator=estimator)))
    assert found == (["advantages of group 0 sum to 0.5, not 0"] if told else [])


@pytest.mark.parametrize("estimator", [name for name, spec in ESTIMATORS.items() if not spec.per_step])
@pytest.mark.parametrize("size", [1.0, 1e6, 1e9, 1e12])
def test_large_returns_are_not_called_a_violation_for_their_rounding(estimator: str, size: float) -> None:
    """A mean of 1e9 is known to 1e-7; where returns differ by 0.001, advantages sum to as much as 1e-4."""
    returns = [size, size + 0.001, size + 0.0025, size + 0.25]
    advantages = ESTIMATORS[estimator].function(returns)
    assert list(check_sums(_rows(advantages), returns, CreditRule(4, estimator=estimator))) == []
    if size < 1e9 and any(advantages):  # one of the four, a hundredth off
        advantages[0] *= 1.01
        assert len(list(check_sums(_rows(advantages), returns, CreditRule(4, estimator=estimator)))) == 1


def test_a_small_number_that_was_edited_is_noticed() -> None:
    """Returns of 1e-6: half of one is no rounding."""
    assert _equal(1e-6, 1e-6 * (1 + 1e-12)) and _equal(0.0, 1e-15) and _equal(1e9, 1e9 + 1e-7)
    assert not _equal(1e-6, 1.5e-6) and not _equal(1e9, 1e9 + 100.0) and not _equal(0.0, 1e-9)


def test_samples_are_counted_by_their_call() -> None:
    problems: list[str] = []
    assert check_samples(_rows([1.0]), [episode([call(0, [1], [5])])], problems) == {"reasoning.direct/act": 1}
    assert problems == []


def test_padding_rows_are_those_of_equal_micro_batches() -> None:
    sequence = build_sequences(episode([call(0, [1], [5])]))[0]

    def padding(episodes: list[int], of: int, ranks: int, micro_batches: int) -> int:
        return padding_rows([Row(sequence, 1.0, e) for e in episodes], of, ranks, micro_batches)

    assert padding([0, 1, 2, 3], 4, 1, 2) == 0  # 2 + 2
    assert padding([0, 0, 1, 2, 3], 4, 1, 2) == 1  # 3 + 2
    assert padding([], 4, 1, 2) == 2  # one row each, none of them real
    # Two ranks with two episodes each: 3 rows and 1 row into 2 micro-batches of 2 on both.
    assert padding([0, 0, 1, 3], 4, 2, 2) == 4


def test_the_digest_reads_tokens_mask_and_advantage() -> None:
    known = row_digest([1, 2], [0, 1], 0.5)
    others = [row_digest([1, 3], [0, 1], 0.5), row_digest([1, 2], [1, 1], 0.5), row_digest([1, 2], [0, 1], -0.5)]
    assert known not in others and len(set(others)) == 3
    # Seven digits: what differs in float noise only is equal.
    assert known == row_digest([1, 2], [0, 1], 0.5 + 1e-12)


def test_every_field_of_an_episode_has_a_digest() -> None:
    record = json.loads(episode([call(0, [1], [5]), call(1, [1], [6])], rewards=(1.0,)).to_json())
    before = field_digests(record)
    assert differing(before, field_digests({**record, "new": 1})) == ["new"]
    assert differing(before, field_digests({**record, "task": {**record["task"], "x": 1}})) == ["task.x"]
    assert differing(before, field_digests({**record, "calls": record["calls"][:1]}))[0] == "calls"
    # A value that moves from one call to another is an edit too.
    first, second = (c["completions"][0] for c in record["calls"])
    first["later"] = 1
    known = field_digests(record)
    assert differing(before, known) == ["calls.completions.later"]
    second["later"] = first.pop("later")
    assert differing(known, field_digests(record)) == ["calls.completions.later"]
    assert differing(None, before) == sorted(before)


# --- bad input -------------------------------------------------------------------------------------------------------


def test_what_is_no_run_is_refused(tmp_path: Path, copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(*argv: str) -> str:
        with pytest.raises(SystemExit) as caught:
            main(["audit", *argv])
        assert caught.value.code == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1 and err.startswith("agentspec: error: ")
        return err

    assert "holds no training run" in refused(str(tmp_path / "nowhere"))
    assert "has no update 9; it has [0, 1, 2]" in refused(str(copy), "--step", "9")
    with open(copy / "updates.jsonl", "r+", encoding="utf-8") as file:
        file.write("{broken")
    assert "updates.jsonl, line 1: not JSON" in refused(str(copy))
    (copy / "manifest.json").write_text("[]")
    assert "manifest" in refused(str(copy))
    (copy / "manifest.json").unlink()
    assert "its manifest.json was removed" in refused(str(copy))


def test_records_of_another_version_are_told(copy: Path) -> None:
    edit(copy / "updates.jsonl", lambda records: [record.pop("format") for record in records] and None)
    assert any("updates.jsonl, update 1: format is missing" in v for v in violations(copy))
    edit(copy / "manifest.json", lambda records: records[0].update(format=3))
    with pytest.raises(SpecError, match="format 3, expected 4; audit it with the version that wrote it"):
        list(audit(copy))


def test_a_line_that_is_being_written_is_left_alone(copy: Path) -> None:
    """The audit of a live run reads whole lines only and changes nothing."""
    with open(copy / "updates.jsonl", "a", encoding="utf-8") as file:
        file.write('{"round": 3, "epi')
    before = (copy / "updates.jsonl").read_bytes()
    assert [r.round for r in audit(copy) if r.round is not None] == [0, 1, 2]
    assert (copy / "updates.jsonl").read_bytes() == before
    (copy / "seal.json").unlink()
    RunLog(copy).receipt({"round": 3}, {})
    assert [r["round"] for r in RunLog(copy).read("updates.jsonl")] == [0, 1, 2, 3]


def test_a_run_without_updates_is_refused(tmp_path: Path) -> None:
    RunLog(tmp_path).manifest(config={})
    with pytest.raises(SpecError, match="holds no training run"):
        list(audit(tmp_path))


def test_the_audit_needs_no_torch() -> None:
    script = "import sys; sys.modules['torch'] = None; import trainers.audit, agentspec.cli.audit"
    subprocess.run([sys.executable, "-c", script], check=True)
