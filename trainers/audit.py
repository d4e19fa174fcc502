"""The audit of a run: every update checked against the episodes it claims to come from.

First that the records are those that were written (`trainers.chain`): no record of any file was edited, deleted, added
or moved. Then that they say the truth: the receipt of every update is made anew from its episodes and its manifest and
compared field by field, so that

- every trained token was sampled by the policy, in that episode, at that place, after exactly that prompt, among what
  its constraint left, with the recorded log-probability and temperature (`trainers.provenance`);
- masks cover model tokens only, and none that a constraint forced;
- the advantage of every row is what the declared estimator gives for the returns, and those of a group sum to zero
  where the estimator says so; what a write to memory earned is what the episodes played for it say, and these are
  what they claim to be (`trainers.counterfactuals`);
- the loss denominator is what the loss divides by (`trainers.losses`); padding rows train nothing; rollouts that could
  not be scored have no rows; the settings of the loss are those of the manifest.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory
from trainers.chain import Manifests, check_end, files_of, linked_receipts, read_round
from trainers.counterfactuals import FOLDER as COUNTERFACTUALS
from trainers.counterfactuals import attach
from trainers.credit import CreditRule
from trainers.estimators import estimator
from trainers.losses import UpdateSize, loss
from trainers.provenance import check_completion, check_tokens
from trainers.receipts import receipt_record, receipt_rows, settings
from trainers.run_folder import MANIFEST, TRAJECTORIES, UPDATES, holds_run
from trainers.sequences import Row

TOLERANCE = 1e-6
SHOWN = 5
"""Differences of one kind that are listed one by one."""


@dataclass
class UpdateAudit:
    """What the audit found of one update; `notes` say what it could not look at."""

    round: int
    episodes: int = 0
    unscorable: int = 0
    rows: int = 0
    tokens: int = 0
    trained: int = 0
    denominator: int = 0
    padding_rows: int = 0
    zero_gradient_rows: int = 0
    by_tag: dict[str, int] = field(default_factory=dict)
    violations: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """The finding as text."""
        tags = ", ".join(f"{tag} {count}" for tag, count in sorted(self.by_tag.items())) or "none"
        head = (
            f"update {self.round}: {self.episodes} episodes ({self.unscorable} unscorable) -> {self.rows} rows "
            f"({self.zero_gradient_rows} without gradient, {self.padding_rows} padding), {self.tokens} tokens, "
            f"{self.trained} trained, denominator {self.denominator}; trained by call: {tags}"
        )
        return [head, *(f"  VIOLATION {v}" for v in self.violations), *(f"  note: {n}" for n in self.notes)]


def audit(run: str | Path, step: int | None = None, *, head: str = "") -> Iterator[UpdateAudit]:
    """Audit every update of a run folder, or one.

    What is wrong with the run as a whole is told of its first (the manifest) or last update (whatever has no receipt,
    the seal); with `step`, the end of the run is not looked at.

    Args:
        run: the run's `output_dir`.
        step: only the update of this generation round.
        head: the head of the chain that the run printed at its end, kept outside the folder.

    Raises:
        SpecError: the folder holds no run, or no such update.
    """
    folder = Path(run)
    if not (folder / MANIFEST).is_file() or not ((folder / UPDATES).is_file() or (folder / TRAJECTORIES).is_dir()):
        missing = "its manifest.json was removed" if holds_run(folder) and not (folder / MANIFEST).is_file() else ""
        raise SpecError(
            f"{folder} holds no training run: expected manifest.json and updates.jsonl"
            f"{f' ({missing})' if missing else ''}; give the run's output_dir"
        )
    manifests = Manifests.read(folder)
    seen: list[tuple[int, set[str], int]] = []
    waiting: UpdateAudit | None = None
    problems = list(manifests.problems)
    for record, broken in linked_receipts(folder):
        number = record["round"] if isinstance(record.get("round"), int) else -1
        seen.append((number, set(files_of(record)), _steps_per_round(record)))
        if step is not None and number != step:
            continue
        if waiting is not None:
            yield waiting
        waiting = _audit_update(folder, number, record, manifests, [*problems, *broken])
        problems = []
    if step is not None and waiting is None:
        raise SpecError(f"{folder} has no update {step}; it has {[number for number, _, _ in seen]}")
    last = waiting or UpdateAudit(-1, violations=problems)
    if step is None:
        wrong, notes = check_end(folder, seen, head)
        last.violations += wrong
        last.notes += notes
    if waiting is not None or last.violations:
        yield last


def _steps_per_round(record: Mapping[str, Any]) -> int:
    """Optimiser steps that are made of one generation round."""
    given = record.get("settings")
    names = ("steps_per_generation", "num_iterations", "gradient_accumulation_steps")
    values = [given.get(name) for name in names] if isinstance(given, Mapping) else []
    counts = [v for v in values if isinstance(v, int) and v > 0]
    return max(1, counts[0] * counts[1] // counts[2]) if len(counts) == 3 else 1


def _audit_update(
    folder: Path, number: int, record: Mapping[str, Any], manifests: Manifests, problems: list[str]
) -> UpdateAudit:
    finding = UpdateAudit(number, violations=problems)
    config = manifests.of(record, problems)["config"]
    try:
        finding.denominator, finding.padding_rows = int(record["denominator"]), int(record["padding_rows"])
        read = read_round(folder, record, problems)
        episodes, beside = read[TRAJECTORIES], read[COUNTERFACTUALS]
        finding.episodes = len(episodes)
        finding.unscorable = sum(not t.scorable for t in episodes)
        if not episodes:
            problems.append(f"the episodes of this update are missing ({folder / TRAJECTORIES})")
            return finding
        _check_update(finding, record, episodes, beside, config)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as error:
        problems.append(f"the record cannot be followed ({type(error).__name__}: {error})")
    return finding


def _check_update(
    finding: UpdateAudit,
    record: Mapping[str, Any],
    episodes: Sequence[Trajectory],
    beside: Sequence[Trajectory],
    config: Mapping[str, Any],
) -> None:
    """The receipt, made anew from its episodes and the manifest, and what it may not contain."""
    rule = CreditRule.from_manifest(config)
    if len(episodes) % rule.group:
        finding.violations.append(f"{len(episodes)} episodes are no whole groups of {rule.group}")
        return
    scored = attach(rule.score(episodes), beside, rule, finding.violations)
    rows = rule.credit(scored).rows
    finding.rows = len(rows)
    finding.zero_gradient_rows = sum(r.zero_gradient for r in rows)
    finding.tokens = sum(len(r.sequence) for r in rows)
    finding.trained = sum(r.sequence.trained for r in rows)
    size = UpdateSize(finding.trained, len(episodes), config["max_completion_length"])
    again = receipt_record(
        round=finding.round,
        played=[(e.trajectory.episode, e.total) for e in scored],
        rows=receipt_rows(rows),
        padding_rows=padding_rows(rows, len(episodes), _ranks(record), config["steps_per_generation"]),
        denominator=loss(config["loss_type"]).denominator(size),
        settings=settings(config),
    )
    given = {name: value for name, value in record.items() if name != "chain"}
    differences = list(_differences(again, given))
    finding.violations += [f"{UPDATES}, update {finding.round}: {what}" for what in differences[:SHOWN]]
    if len(differences) > SHOWN:
        finding.violations.append(f"{UPDATES}, update {finding.round}: {len(differences) - SHOWN} more fields differ")
    _check_policy(finding, episodes)
    _check_advantages(finding, rows, episodes, rule)
    _check_samples(finding, rows, episodes)


def _ranks(record: Mapping[str, Any]) -> int:
    """Processes that played the round: each has a file of its own."""
    return max(1, sum(name.startswith(f"{TRAJECTORIES}/") for name in files_of(record)))


def padding_rows(rows: Sequence[Row], episodes: int, ranks: int, micro_batches: int) -> int:
    """Rows that fill up the micro-batches of all ranks: each has as many as the fullest one of any rank."""
    held = Counter(row.episode * ranks // episodes for row in rows)
    size = max(-(-max(1, held[rank]) // micro_batches) for rank in range(ranks))
    return ranks * micro_batches * size - len(rows)


def _differences(again: Any, given: Any, where: str = "") -> Iterator[str]:
    """Every leaf at which a receipt is not what its episodes and its manifest give."""
    if isinstance(again, Mapping) and isinstance(given, Mapping):
        for name in sorted({*again, *given}):
            path = f"{where}.{name}" if where else str(name)
            if name not in again or name not in given:
                yield f"{path} {'stands in the receipt only' if name in given else 'is missing'}"
            else:
                yield from _differences(again[name], given[name], path)
    elif isinstance(again, (list, tuple)) and isinstance(given, (list, tuple)):
        if len(again) != len(given):
            yield f"{where}: {len(given)} in the receipt, {len(again)} by its episodes"
        for i, (a, b) in enumerate(zip(again, given, strict=False)):
            yield from _differences(a, b, f"{where}[{i}]")
    elif not _equal(again, given):
        yield f"{where} is {again!r} by the episodes and the manifest, but the receipt says {given!r}"


def _equal(a: Any, b: Any) -> bool:
    """The same type of value, numbers up to the tolerance."""
    if isinstance(a, float) and isinstance(b, (int, float)) and not isinstance(b, bool):
        return math.isclose(a, b, rel_tol=TOLERANCE, abs_tol=TOLERANCE)
    return type(a) is type(b) and bool(a == b)


def _check_policy(finding: UpdateAudit, episodes: Sequence[Trajectory]) -> None:
    """Every episode was played by the policy of this update."""
    expected = f"step-{finding.round}"
    strangers = [t.episode for t in episodes if t.policy != expected]
    if strangers:
        finding.violations.append(f"episodes {strangers} were not played by policy {expected}")


def _check_advantages(
    finding: UpdateAudit, rows: Sequence[Row], episodes: Sequence[Trajectory], rule: CreditRule
) -> None:
    """Constant over a rollout (estimators per episode), and zero in sum over a group where the estimator says so."""
    spec = estimator(rule.estimator)
    if spec.per_step:
        return
    values: dict[int, float] = {}
    for row in rows:
        of_actions = _of_actions(row, rule)
        if len(of_actions) > 1 or any(values.setdefault(row.episode, a) != a for a in of_actions):
            finding.violations.append(f"episode {row.episode} has rows with different advantages")
    if rule.normalize == "rollout" or not spec.zero_sum:
        return  # each rollout's value is scaled by its own length; they were compared one by one already
    for start in range(0, len(episodes), rule.group):
        members = [i for i in range(start, start + rule.group) if episodes[i].scorable]
        if all(i in values for i in members):  # masked or skipped members have no rows to sum over
            given = [values[i] for i in members]
            if abs(math.fsum(given)) > TOLERANCE * max(1.0, math.fsum(map(abs, given))):
                finding.violations.append(
                    f"advantages of group {start // rule.group} sum to {math.fsum(given):.2g}, not 0"
                )


def _of_actions(row: Row, rule: CreditRule) -> set[float]:
    """The advantages of a row's trained tokens, but for those of writes that are credited by themselves."""
    if isinstance(row.advantage, float):
        return {row.advantage}
    s = row.sequence
    wrote = {c for c, path in s.paths.items() if rule.writes.spec.function and rule.writes.is_write(path)}
    return {a for a, m, c in zip(row.advantage, s.mask, s.calls, strict=True) if m and c not in wrote}


def _check_samples(finding: UpdateAudit, rows: Sequence[Row], episodes: Sequence[Trajectory]) -> None:
    """Every token of a row has an origin, and every recorded completion is possible."""
    by_tag: Counter[str] = Counter()
    for row in rows:
        problems, counted = check_tokens(row.sequence, episodes[row.episode])
        finding.violations += problems
        by_tag += counted
    finding.by_tag = dict(by_tag)
    for trajectory in episodes:
        for call in trajectory.calls:
            for completion in call.completions:
                finding.violations += check_completion(completion, f"call {call.id} of {trajectory.episode}")
