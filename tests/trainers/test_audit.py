"""The audit: an honest run passes; whatever is tampered with afterwards is a violation."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("trl")

from agentspec.cli import main
from agentspec.registry import SpecError
from tests.toy_env import ToyEnv
from tests.trainers.builders import call, episode
from tests.trainers.played import toy_tasks, toy_trainer
from trainers.audit import Receipt, _check_tokens, audit, row_digest
from trainers.runlog import RunLog
from trainers.sequences import build_sequences

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
    folder = tmp_path_factory.mktemp("audit") / "run"
    toy_trainer(folder, num_generations=4, per_device_train_batch_size=4).train()
    return folder


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(run, tmp_path / "copy"))


def violations(folder: Path) -> list[str]:
    return [v for r in audit(folder) for v in r.violations]


def test_an_honest_run_passes(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["audit", str(run)]) == 0
    out = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in out[:2]] == ["update 0", "update 1"]
    assert "8 episodes (0 unscorable)" in out[0] and "reasoning.direct/act" in out[0]
    assert out[-1] == "2 updates audited: no violation"
    assert main(["audit", str(run), "--step", "1", "--json"]) == 0
    (receipt,) = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    # Every trained token is in the denominator, and nothing else.
    assert receipt["round"] == 1 and receipt["trained"] == receipt["denominator"] > 0
    assert sum(receipt["by_tag"].values()) == receipt["trained"]


@pytest.mark.parametrize(
    "changes",
    [
        SUPO,
        REACT,
        {"estimator": "rloo", "packing": "padded"},
        {"estimator": "gigpo", "gamma": 0.9},
        {"estimator": "reward_to_go", **SUPO},
        {"skip_zero_variance": True, "max_steps": 1},
        {"steps_per_generation": 4, "max_steps": 3},
    ],
    ids=["supo", "react-menu", "rloo", "gigpo", "supo-reward_to_go", "skip", "long-round"],
)
def test_honest_runs_of_every_kind_pass(tmp_path: Path, changes: dict[str, Any]) -> None:
    settings = {"max_steps": 1, **changes}
    toy_trainer(tmp_path, **settings).train()
    receipts = list(audit(tmp_path))
    assert receipts and not [v for r in receipts for v in r.violations]
    assert all(r.trained == r.denominator for r in receipts)
    if changes.get("agent") == SUPO["agent"]:
        assert receipts[0].rows > receipts[0].episodes  # one row per segment
    if changes is SUPO:
        # Random summaries run into their limit and are then context only.
        assert receipts[0].by_tag.get("memory.summary/summary", 0) >= 0


def test_a_run_with_failed_rollouts_passes_and_counts_them(tmp_path: Path) -> None:
    toy_trainer(tmp_path, toy_tasks(2), make_env=_crashing, max_steps=1).train()
    (receipt,) = audit(tmp_path)
    assert (receipt.episodes, receipt.unscorable, receipt.violations) == (4, 2, [])


# --- tampering -------------------------------------------------------------------------------------------------------

Edit = Callable[[list[dict[str, Any]]], None]


def edit(path: Path, change: Edit) -> None:
    records = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    change(records)
    path.write_text("".join(json.dumps(r) + "\n" for r in records), encoding="utf-8")


def _set(record: dict[str, Any], *keys: Any, value: Any) -> None:
    for key in keys[:-1]:
        record = record[key]
    assert record[keys[-1]] != value
    record[keys[-1]] = value


UPDATES = "updates.jsonl"
EPISODES = "trajectories/000000.jsonl"


@pytest.mark.parametrize(
    ("file", "change", "finding"),
    [
        (UPDATES, lambda r: _set(r[0], "rows", 0, "advantage", value=9.0), "advantage"),
        (UPDATES, lambda r: _set(r[0], "rows", 0, "digest", value="0" * 16), "not what its episodes give"),
        (UPDATES, lambda r: _set(r[0], "rows", 0, "trained", value=10_000), "has trained"),
        (UPDATES, lambda r: r[0]["rows"].pop(), "not what its episodes give"),
        (UPDATES, lambda r: r[0]["rows"].append(r[0]["rows"][0]), "not what its episodes give"),
        (UPDATES, lambda r: _set(r[0], "rows", 0, "episode", value=99), "does not exist"),
        (UPDATES, lambda r: _set(r[0], "denominator", value=1), "denominator 1, but"),
        (UPDATES, lambda r: _set(r[0], "returns", 0, value=1e3), "receipt says 1000"),
        (EPISODES, lambda r: r.pop(), "no whole groups"),
        (EPISODES, lambda r: r.reverse(), "not those of the receipt"),
        (EPISODES, lambda r: _set(r[0], "policy", value="step-7"), "not played by policy step-0"),
        (EPISODES, lambda r: _set(r[0], "status", value="failed"), "could not be scored"),
    ],
)
def test_tampering_is_a_violation(
    copy: Path, file: str, change: Edit, finding: str, capsys: pytest.CaptureFixture[str]
) -> None:
    edit(copy / file, change)
    found = violations(copy)
    assert any(finding in v for v in found), found
    assert main(["audit", str(copy)]) == 1
    out = capsys.readouterr().out
    assert "VIOLATION" in out and "violation" in out.splitlines()[-1]
    assert main(["audit", str(copy), "--step", "1"]) == 0  # the other update is untouched


def test_a_resampled_token_is_a_violation(copy: Path) -> None:
    def change(records: list[dict[str, Any]]) -> None:
        tokens = records[0]["calls"][0]["completions"][0]["token_ids"]
        tokens[0] += 1

    edit(copy / EPISODES, change)
    assert any("not what its episodes give" in v for v in violations(copy))


def test_a_lifted_constraint_is_a_violation(copy: Path) -> None:
    """Forced tokens that are declared free would be trained: the mask changes."""

    def change(records: list[dict[str, Any]]) -> None:
        completion = records[0]["calls"][0]["completions"][0]
        assert any(a is not None and len(a) == 1 for a in completion["allowed"])
        completion["allowed"] = []

    edit(copy / EPISODES, change)
    assert any("not what its episodes give" in v for v in violations(copy))


def test_a_changed_balance_is_a_violation(copy: Path) -> None:
    """The returns, and with them the advantages, are computed again from what the environment reported."""

    def change(records: list[dict[str, Any]]) -> None:
        records[2]["steps"][-1]["info"]["balance"] += 5

    edit(copy / EPISODES, change)
    found = violations(copy)
    assert any("but the receipt says" in v for v in found) and any("not what its episodes give" in v for v in found)


def test_missing_episodes_are_a_violation(copy: Path) -> None:
    (copy / EPISODES).unlink()
    assert any("missing" in v for v in violations(copy))


def test_a_trained_token_must_be_a_choice_of_the_call_that_claims_it() -> None:
    trajectory = episode([call(0, [1, 2], [5, 7, 9], allowed=((5, 6), (7,), None))])
    (sequence,) = build_sequences(trajectory)
    assert sequence.mask == [0, 0, 1, 0, 1]
    honest = Receipt(0)
    _check_tokens(sequence, trajectory, honest)
    assert honest.violations == [] and honest.by_tag == {"reasoning.direct/act": 2}

    def findings(**changes: Any) -> str:
        (changed,) = build_sequences(trajectory)
        for name, (position, value) in changes.items():
            getattr(changed, name)[position] = value
        receipt = Receipt(0)
        _check_tokens(changed, trajectory, receipt)
        return "; ".join(receipt.violations)

    assert "no completion of call 0" in findings(tokens=(4, 8))
    assert "not the prompt" in findings(tokens=(0, 3))
    assert "no call sampled" in findings(mask=(1, 1))
    assert "constraint forced" in findings(mask=(3, 1))


def test_the_digest_reads_tokens_mask_and_advantage() -> None:
    digest = row_digest([1, 2], [0, 1], 0.5)
    assert len(digest) == 16
    others = [row_digest([1, 3], [0, 1], 0.5), row_digest([1, 2], [1, 1], 0.5), row_digest([1, 2], [0, 1], -0.5)]
    assert digest not in others and len(set(others)) == 3
    # Seven digits: what differs in float noise only is equal.
    assert digest == row_digest([1, 2], [0, 1], 0.5 + 1e-12)


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
    assert "has no update 9; it has [0, 1]" in refused(str(copy), "--step", "9")
    with open(copy / UPDATES, "r+", encoding="utf-8") as file:
        file.write("{broken")
    assert "updates.jsonl, line 1: not JSON" in refused(str(copy))
    (copy / "manifest.json").write_text("[]")
    assert "manifest" in refused(str(copy))


def test_a_line_that_is_being_written_is_left_alone(copy: Path) -> None:
    """The audit of a live run reads whole lines only and changes nothing."""
    with open(copy / UPDATES, "a", encoding="utf-8") as file:
        file.write('{"round": 2, "epi')
    before = (copy / UPDATES).read_bytes()
    assert [r.round for r in audit(copy)] == [0, 1]
    assert (copy / UPDATES).read_bytes() == before
    RunLog(copy).append(UPDATES, {"round": 2})
    assert [r["round"] for r in RunLog(copy).read(UPDATES)] == [0, 1, 2]


def test_a_run_without_updates_is_refused(tmp_path: Path) -> None:
    RunLog(tmp_path).manifest(config={})
    with pytest.raises(SpecError, match="holds no training run"):
        list(audit(tmp_path))
