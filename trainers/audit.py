"""The audit of a run: every update checked against the episodes it claims to come from.

First that the records are those that were written (`agentspec.records.chain`): no record of any file was edited,
deleted, added or moved. Then that they say the truth: the receipt of every update is made anew from its episodes and
its manifest and compared field by field (rows, advantages, distributions, denominator, padding, settings). Beside what
the trainer does, every trained token was sampled by the policy, there, after exactly that prompt
(`trainers.provenance`), advantages of a group sum to zero where the estimator says so, and what a write to memory
earned is what the episodes played for it say (`trainers.counterfactuals`).
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agentspec.records.chain import check_end, files_of, linked_receipts, manifest_of, read_manifests, read_round
from agentspec.records.completions import check_completions
from agentspec.records.folder import MANIFEST, TRAJECTORIES, UPDATES, holds_run
from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory
from trainers.counterfactuals import FOLDER as COUNTERFACTUALS
from trainers.counterfactuals import attach
from trainers.credit import CreditRule
from trainers.estimators import estimator
from trainers.losses import UpdateSize, loss
from trainers.provenance import check_tokens
from trainers.receipts import receipt_record, receipt_rows, settings
from trainers.sequences import Row

TOLERANCE, SMALLEST = 1e-9, 1e-12
"""Relative and absolute: numbers that differ by less are the rounding of another machine (they repeat on one)."""
SHOWN = 5
"""Differences of one kind that are listed one by one."""


@dataclass
class UpdateAudit:
    """What the audit found of one update, or (`round` is `None`) of the run as a whole.

    `notes` say what it could not look at.
    """

    round: int | None
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
        head = "the run as a whole:" if self.round is None else head
        return [head, *(f"  VIOLATION {v}" for v in self.violations), *(f"  note: {n}" for n in self.notes)]


def audit(run: str | Path, step: int | None = None, *, head: str = "") -> Iterator[UpdateAudit]:
    """Audit every update of a run folder, or one; last, if there is anything to say of it, the run as a whole.

    Args:
        run: the run's `output_dir`.
        step: only the update of this generation round; the end of the run is then not looked at.
        head: the head of the chain that the run printed at its end, kept outside the folder.

    Raises:
        SpecError: the folder holds no run, or no such update.
    """
    folder = Path(run)
    if not (folder / MANIFEST).is_file() or not ((folder / UPDATES).is_file() or (folder / TRAJECTORIES).is_dir()):
        removed = " (its manifest.json was removed)" if holds_run(folder) and not (folder / MANIFEST).is_file() else ""
        raise SpecError(
            f"{folder} holds no training run: expected manifest.json and updates.jsonl{removed}; give the run's "
            "output_dir"
        )
    manifests, problems = read_manifests(folder)
    rounds = []
    for record, broken in linked_receipts(folder):
        rounds.append(record["round"] if isinstance(record.get("round"), int) else -1)
        if step in (None, rounds[-1]):
            yield _audit_update(folder, rounds[-1], record, manifests, broken)
    if step is not None and step not in rounds:
        raise SpecError(f"{folder} has no update {step}; it has {rounds}")
    whole = UpdateAudit(None, violations=problems)
    if step is None:
        wrong, whole.notes = check_end(folder, manifests[next(reversed(manifests))]["config"], head)
        whole.violations += wrong
    if whole.violations or whole.notes:
        yield whole


def _audit_update(
    folder: Path, number: int, record: Mapping[str, Any], manifests: Mapping[str, dict[str, Any]], problems: list[str]
) -> UpdateAudit:
    finding = UpdateAudit(number, violations=problems)
    try:
        finding.denominator, finding.padding_rows = int(record["denominator"]), int(record["padding_rows"])
        config = manifest_of(record, manifests, problems)["config"]
        read = read_round(folder, record, problems)
        episodes, beside = read[TRAJECTORIES], read[COUNTERFACTUALS]
        finding.episodes = len(episodes)
        finding.unscorable = sum(not t.scorable for t in episodes)
        if not episodes:
            problems.append(f"the episodes of this update are missing ({folder / TRAJECTORIES})")
        else:
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
    rule, told = CreditRule.from_manifest(config), finding.violations
    if len(episodes) % rule.group:
        told.append(f"{len(episodes)} episodes are no whole groups of {rule.group}")
        return
    scored = attach(rule.score(episodes), beside, rule, told)
    rows = rule.credit(scored).rows
    finding.rows = len(rows)
    finding.zero_gradient_rows = sum(r.zero_gradient for r in rows)
    finding.tokens = sum(len(r.sequence) for r in rows)
    finding.trained = sum(r.sequence.trained for r in rows)
    ranks = max(1, sum(name.startswith(f"{TRAJECTORIES}/") for name in files_of(record)))  # each has its own file
    again = receipt_record(
        round=finding.round or 0,
        played=[(e.trajectory.episode, e.total) for e in scored],
        rows=receipt_rows(rows),
        padding_rows=padding_rows(rows, len(episodes), ranks, config["steps_per_generation"]),
        denominator=loss(config["loss_type"]).denominator(
            UpdateSize(finding.trained, len(episodes), config["max_completion_length"])
        ),
        settings=settings(config),
    )
    differences = list(_differences(again, {name: value for name, value in record.items() if name != "chain"}))
    told += [f"{UPDATES}, update {finding.round}: {what}" for what in differences[:SHOWN]]
    if len(differences) > SHOWN:
        told.append(f"{UPDATES}, update {finding.round}: {len(differences) - SHOWN} more fields differ")
    if strangers := [t.episode for t in episodes if t.policy != f"step-{finding.round}"]:
        told.append(f"episodes {strangers} were not played by policy step-{finding.round}")
    told += check_sums(rows, [e.total for e in scored], rule)
    finding.by_tag = dict(check_samples(rows, episodes, told))


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
    """The same type of value, numbers up to the rounding of another machine."""
    if isinstance(a, float) and isinstance(b, (int, float)) and not isinstance(b, bool):
        return math.isclose(a, b, rel_tol=TOLERANCE, abs_tol=SMALLEST)
    return type(a) is type(b) and bool(a == b)


def check_sums(rows: Sequence[Row], returns: Sequence[float | None], rule: CreditRule) -> Iterator[str]:
    """Advantages of a group sum to zero, where the estimator says so and every member that counts has rows.

    Up to rounding: returns that are large beside their spread lose digits when their mean is taken off.
    """
    spec = estimator(rule.estimator)
    if spec.per_step or not spec.zero_sum or rule.normalize == "rollout":
        return
    given = {row.episode: value for row in rows for value in _of_actions(row, rule)}
    for start in range(0, len(returns), rule.group):
        earned = {i: r for i, r in enumerate(returns[start : start + rule.group], start) if r is not None}
        if not all(i in given for i in earned):  # masked or skipped members have no rows to sum over
            continue
        total, size = math.fsum(given[i] for i in earned), math.fsum(abs(given[i]) for i in earned)
        spread = max(earned.values(), default=0.0) - min(earned.values(), default=0.0)
        lost = sys.float_info.epsilon * len(earned) * max(map(abs, earned.values()), default=0.0) / (spread or 1.0)
        if abs(total) > size * (TOLERANCE + lost):
            yield f"advantages of group {start // rule.group} sum to {total:.2g}, not 0"


def _of_actions(row: Row, rule: CreditRule) -> set[float]:
    """The advantages of a row's trained tokens, but for those of writes that are credited by themselves."""
    if isinstance(row.advantage, float):
        return {row.advantage}
    s = row.sequence
    wrote = {c for c, path in s.paths.items() if rule.writes.spec.function and rule.writes.is_write(path)}
    return {a for a, m, c in zip(row.advantage, s.mask, s.calls, strict=True) if m and c not in wrote}


def check_samples(rows: Sequence[Row], episodes: Sequence[Trajectory], problems: list[str]) -> Counter[str]:
    """Trained tokens by call; every token of a row has an origin, and every recorded completion is possible."""
    by_tag: Counter[str] = Counter()
    for row in rows:
        found, counted = check_tokens(row.sequence, episodes[row.episode])
        problems += found
        by_tag += counted
    for t in episodes:
        problems += check_completions(t)
    return by_tag
