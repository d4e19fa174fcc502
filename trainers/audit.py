"""The audit of a run: every update checked against the episodes it claims to come from.

The log holds the episodes of each generation round (with every sampled token) and a receipt written when the update was
made (with a digest of every row the loss read). The audit rebuilds the rows from the episodes alone and checks that

- every trained token was sampled by the policy, in that episode, at that place, after exactly that prompt;
- masks cover model tokens only, and none that a constraint forced;
- the advantage of every row is what the declared estimator gives for the returns (constant over a rollout unless the
  estimator is one per step), and advantages of a group sum to zero;
- the loss denominator is the number of trained tokens; rows that were padded in train nothing; rollouts that could not
  be scored have no rows.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agentspec.registry import SpecError
from agentspec.trajectory import Trajectory, read_trajectories
from agentspec.types import LLMCall
from trainers.credit import CreditRule, ScoredEpisode
from trainers.estimators import estimator
from trainers.runlog import RunLog
from trainers.sequences import Row, TokenSequence

TOLERANCE = 1e-6


@dataclass
class Receipt:
    """What the audit found of one update."""

    round: int
    episodes: int = 0
    unscorable: int = 0
    rows: int = 0
    tokens: int = 0
    trained: int = 0
    denominator: int = 0
    blank_rows: int = 0
    silent_rows: int = 0
    by_tag: dict[str, int] = field(default_factory=dict)
    violations: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """The receipt as text."""
        tags = ", ".join(f"{tag} {count}" for tag, count in sorted(self.by_tag.items())) or "none"
        head = (
            f"update {self.round}: {self.episodes} episodes ({self.unscorable} unscorable) -> {self.rows} rows "
            f"({self.silent_rows} without gradient, {self.blank_rows} blank), {self.tokens} tokens, "
            f"{self.trained} trained = denominator {self.denominator}; trained by call: {tags}"
        )
        return [head, *(f"  VIOLATION {v}" for v in self.violations)]


def row_digest(tokens: Sequence[int], mask: Sequence[int], advantage: float | Sequence[float]) -> str:
    """16 hex digits over what the loss reads of one row; advantages to seven digits."""
    values = [advantage] if isinstance(advantage, (int, float)) else list(advantage)
    data = [list(tokens), list(mask), [f"{v:.6e}" for v in values]]
    return hashlib.sha256(json.dumps(data).encode()).hexdigest()[:16]


def receipt_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """What the trainer writes of each row into its receipt."""
    return [
        {
            "episode": r.episode,
            "tokens": len(r.sequence),
            "trained": r.sequence.trained,
            "advantage": r.advantage,
            "digest": row_digest(r.sequence.tokens, r.sequence.mask, r.advantage),
        }
        for r in rows
    ]


def audit(run: str | Path, step: int | None = None) -> Iterator[Receipt]:
    """Audit every update of a run folder, or one.

    Raises:
        SpecError: the folder holds no run, or no such update.
    """
    folder = Path(run)
    if not (folder / "manifest.json").is_file() or not (folder / "updates.jsonl").is_file():
        raise SpecError(
            f"{folder} holds no training run: expected manifest.json and updates.jsonl; give the run's output_dir"
        )
    manifest = _manifest(folder / "manifest.json")
    records = RunLog(folder).read("updates.jsonl")
    if step is not None:
        records = [r for r in records if r["round"] == step]
        if not records:
            raise SpecError(
                f"{folder} has no update {step}; it has {[r['round'] for r in RunLog(folder).read('updates.jsonl')]}"
            )
    rule = CreditRule.from_manifest(manifest["config"])
    for record in records:
        yield _audit_update(folder, record, rule)


def _manifest(path: Path) -> dict[str, Any]:
    """The run's manifest.

    Raises:
        SpecError: not the manifest of a training run.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise SpecError(f"{path} is not JSON ({error}); the run's record is damaged") from error
    if not isinstance(data, dict) or not isinstance(data.get("config"), dict):
        raise SpecError(f"{path} names no configuration: it is not the manifest of a training run")
    return data


def _audit_update(folder: Path, record: dict[str, Any], rule: CreditRule) -> Receipt:
    receipt = Receipt(record["round"], denominator=record["denominator"], blank_rows=record["blank_rows"])
    files = sorted((folder / "trajectories").glob(f"{record['round']:06d}*.jsonl"))
    if not files:
        receipt.violations.append(f"the episodes of this update are missing ({folder}/trajectories)")
        return receipt
    episodes = [t for f in sorted(files, key=_rank) for t in read_trajectories(f)]
    receipt.episodes = len(episodes)
    receipt.unscorable = sum(not t.scorable for t in episodes)
    scored = rule.score(episodes)
    _check_identity(scored, record, receipt)
    if len(episodes) % rule.group:
        receipt.violations.append(f"{len(episodes)} episodes are no whole groups of {rule.group}")
        return receipt
    credited = rule.credit(scored)
    _check_rows(credited.rows, episodes, record, receipt)
    _check_advantages(credited.rows, episodes, rule, receipt)
    for row in credited.rows:
        _check_tokens(row.sequence, episodes[row.episode], receipt)
    receipt.rows = len(credited.rows)
    receipt.silent_rows = sum(r.zero_gradient for r in credited.rows)
    receipt.tokens = sum(len(r.sequence) for r in credited.rows)
    receipt.trained = sum(r.sequence.trained for r in credited.rows)
    if receipt.trained != receipt.denominator:
        receipt.violations.append(f"denominator {receipt.denominator}, but {receipt.trained} tokens are trained")
    return receipt


def _rank(path: Path) -> int:
    return int(path.stem.partition(".rank")[2] or 0)


def _check_identity(scored: Sequence[ScoredEpisode], record: dict[str, Any], receipt: Receipt) -> None:
    """The episodes are those of the receipt, with its returns, played by the policy of this update."""
    episodes = [e.trajectory for e in scored]
    if [t.episode for t in episodes] != record["episodes"]:
        receipt.violations.append("the logged episodes are not those of the receipt")
    else:
        for episode, logged in zip(scored, record["returns"], strict=True):
            value = episode.total
            if not _equal(value, logged):
                receipt.violations.append(
                    f"{episode.trajectory.episode} returned {value}, but the receipt says {logged}"
                )
    expected = f"step-{record['round']}"
    strangers = [t.episode for t in episodes if t.policy != expected]
    if strangers:
        receipt.violations.append(f"episodes {strangers} were not played by policy {expected}")


def _check_rows(rows: Sequence[Row], episodes: Sequence[Trajectory], record: dict[str, Any], receipt: Receipt) -> None:
    """The rows rebuilt from the episodes are those the loss read, and the receipt describes them truly."""
    rebuilt = {(r["episode"], r["digest"]): r for r in receipt_rows(rows)}
    mine = Counter((r["episode"], r["digest"]) for r in receipt_rows(rows))
    theirs = Counter((r["episode"], r["digest"]) for r in record["rows"])
    if mine != theirs:
        differing = sum(((mine - theirs) + (theirs - mine)).values())
        receipt.violations.append(f"{differing} rows of the update are not what its episodes give")
    for row in record["rows"]:
        known = 0 <= row["episode"] < len(episodes)
        if not known or not episodes[row["episode"]].scorable:
            what = "could not be scored" if known else "does not exist"
            receipt.violations.append(f"episode {row['episode']} {what}, yet has a row")
        given = rebuilt.get((row["episode"], row["digest"]), row)
        for name in ("tokens", "trained", "advantage"):
            if not _equal(given[name], row[name]):
                receipt.violations.append(
                    f"a row of episode {row['episode']} has {name} {given[name]}, but the receipt says {row[name]}"
                )


def _equal(a: Any, b: Any) -> bool:
    """Numbers, or lists of numbers, equal up to the tolerance; ``None`` equals itself only."""
    if a is None or b is None:
        return a is b
    left, right = ([x] if isinstance(x, (int, float)) else list(x) for x in (a, b))
    return len(left) == len(right) and all(
        math.isclose(x, y, rel_tol=TOLERANCE, abs_tol=TOLERANCE) for x, y in zip(left, right, strict=True)
    )


def _check_advantages(rows: Sequence[Row], episodes: Sequence[Trajectory], rule: CreditRule, receipt: Receipt) -> None:
    """Constant over a rollout, and zero in sum over a group (estimators per episode)."""
    spec = estimator(rule.estimator)
    if spec.per_step:
        return
    values: dict[int, float] = {}
    for row in rows:
        assert isinstance(row.advantage, float)
        if values.setdefault(row.episode, row.advantage) != row.advantage:
            receipt.violations.append(f"episode {row.episode} has rows with different advantages")
    if rule.normalize == "rollout" or not spec.zero_sum:
        return  # each rollout's value is scaled by its own length; the digests have compared the values already
    size = rule.group
    for start in range(0, len(episodes), size):
        members = [i for i in range(start, start + size) if episodes[i].scorable]
        if all(i in values for i in members):  # masked or silent members have no rows to sum over
            total = math.fsum(values[i] for i in members)
            if abs(total) > TOLERANCE * max(1, size):
                receipt.violations.append(f"advantages of group {start // size} sum to {total:.2g}, not 0")


def _check_tokens(sequence: TokenSequence, trajectory: Trajectory, receipt: Receipt) -> None:
    """Each trained token is a token of a completion, after exactly the prompt it was sampled from."""
    calls = {c.id: c for c in trajectory.calls}
    position = 0
    while position < len(sequence):
        owner = sequence.calls[position]
        end = position + 1
        while end < len(sequence) and sequence.calls[end] == owner:
            end += 1
        trained = sum(sequence.mask[position:end])
        if owner < 0:
            if trained:
                receipt.violations.append(f"{trained} tokens that no call sampled are trained in {trajectory.episode}")
        else:
            _check_run(sequence, position, end, calls[owner], trajectory, receipt)
            path = calls[owner].tag.path
            receipt.by_tag[path] = receipt.by_tag.get(path, 0) + trained
        position = end


def _check_run(
    sequence: TokenSequence, start: int, end: int, call: LLMCall, trajectory: Trajectory, receipt: Receipt
) -> None:
    tokens = tuple(sequence.tokens[start:end])
    matching = [c for c in call.completions if c.token_ids == tokens]
    where = f"call {call.id} of {trajectory.episode}"
    if not matching:
        receipt.violations.append(f"tokens {start}..{end} are no completion of {where}")
        return
    if tuple(sequence.tokens[:start]) != call.prompt_ids:
        receipt.violations.append(f"the tokens before position {start} are not the prompt of {where}")
    forced = [i for i, a in enumerate(matching[0].allowed) if a is not None and len(a) == 1]
    if any(sequence.mask[start + i] for i in forced):
        receipt.violations.append(f"{where} trains tokens that its constraint forced")
