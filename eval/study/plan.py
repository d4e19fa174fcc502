"""A learning study as data: arms that are trained, scaffolds that every policy is evaluated in, and how.

```yaml
out: runs/transfer
seeds: [0, 1, 2]                    # training runs of each arm
tasks: 32                           # held-out tasks
scaffolds:                          # the columns of the matrix, agents as in any configuration
  base: {reasoning: direct, memory: base, layout: snapshot}
  react+base: {reasoning: react, memory: base, layout: snapshot}
train: {extends: cpu, max_steps: 8} # fields that all training runs share
arms:                               # the rows: a scaffold to train in, and fields of its own
  base: {scaffold: base}
  supo: {scaffold: summary, trainer: supo}
warmup: {extends: warmup_cpu, scaffolds: [...]}    # optional: one supervised start for all arms
evaluation: {concurrency: 8, backend: {dtype: bfloat16}}
table: {Non-RL: start, GRPO: base, SUPO: supo}     # the paper's form: heading -> policy
compare: {curation: [sheet, sheet trained]}        # the second less the first, in every scaffold
references: [rule_based, random]
rates: {read: 350, write: 40, update: 250, evaluation: 2, source: how they were measured}
deviation: 0.1                      # of a run's contrast, for the smallest difference that would be found
```
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from agentspec.actions import suggest
from agentspec.parameters import check_types
from agentspec.policies import Policy
from agentspec.records.folder import MANIFEST, SEAL
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from eval.cells import Settings
from eval.naming import slug

START = "start"
"""The policy that all arms begin with."""
TRAINERS = ("grpo", "supo", "memory")
"""What `trainer` of an arm may be; who runs a study knows how each trains."""


@dataclass(frozen=True)
class Arm:
    """What is trained several times.

    Args:
        scaffold: label of the scaffold it is trained in.
        trainer: see `TRAINERS`.
        fields: of the training configuration, over those that all arms share.
    """

    scaffold: str
    trainer: str = "grpo"
    fields: Mapping[str, Any] = field(default_factory=dict)

    @property
    def home(self) -> str:
        """The scaffold it is trained in; empty if its groups are dealt out over several (`scaffolds`)."""
        return "" if "scaffolds" in self.fields else self.scaffold


@dataclass(frozen=True)
class Study:
    """See the module's text."""

    out: str
    scaffolds: Mapping[str, AgentSpec]
    arms: Mapping[str, Arm]
    train: Mapping[str, Any] = field(default_factory=dict)
    warmup: Mapping[str, Any] = field(default_factory=dict)
    seeds: Sequence[int] = (0, 1, 2)
    tasks: int = 32
    evaluation: Mapping[str, Any] = field(default_factory=dict)
    table: Mapping[str, str] = field(default_factory=dict)
    compare: Mapping[str, Sequence[str]] = field(default_factory=dict)
    references: Sequence[str] = ("rule_based", "random")
    rates: Mapping[str, Any] = field(default_factory=dict)
    deviation: float = 0.0

    @property
    def settings(self) -> Settings:
        """How episodes are played."""
        return Settings(**{name: value for name, value in self.evaluation.items() if name != "backend"})

    @property
    def runs(self) -> list[tuple[str, int]]:
        """(arm, seed) of all training runs, seed by seed: whoever stops early has whole replicates."""
        return [(arm, seed) for seed in self.seeds for arm in self.arms]

    def folder(self, arm: str, seed: int) -> Path:
        """Where a training run lies."""
        return Path(self.out) / "runs" / f"{slug(arm)}-s{seed}"

    @property
    def begun(self) -> list[tuple[str, int]]:
        """(arm, seed) of the training runs that have left anything."""
        return [run for run in self.runs if (self.folder(*run) / MANIFEST).is_file()]

    @property
    def ended(self) -> list[tuple[str, int]]:
        """(arm, seed) of the training runs that have come to their ends."""
        return [run for run in self.runs if (self.folder(*run) / SEAL).is_file()]

    @property
    def start(self) -> Path | None:
        """Folder of the adapter that the warm start leaves, if there is one."""
        return Path(self.out) / "warmup" if self.warmup else None

    def policies(self, model: str, adapter: str = "", *, lora: bool = True) -> list[Policy]:
        """The start, every training run that has ended, and the scripted references.

        Args:
            model, adapter: base model, and the adapter that training begins with (or empty).
            lora: whether a run's folder holds an adapter, or whole weights.
        """
        backend = dict(self.evaluation.get("backend", {}))
        found = [Policy(START, model, adapter, backend)]
        for arm, seed in sorted(self.ended, key=lambda run: list(self.arms).index(run[0])):
            folder = str(self.folder(arm, seed))
            weights = (model, folder) if lora else (folder, "")
            found.append(Policy(arm, *weights, backend, run=str(seed)))
        return [*found, *map(Policy.parse, self.references)]

    def record(self, rollouts: Mapping[str, int], audits: Mapping[tuple[str, int], Any]) -> str:
        """`study.json`: what a report must know beside the results.

        Args:
            rollouts: of an update, by arm.
            audits: what the audit of each run that has ended found.
        """
        arms = {}
        for name, arm in self.arms.items():
            runs = {str(s): f"runs/{self.folder(a, s).name}" for a, s in self.ended if a == name}
            of = {"scaffold": arm.home, "trainer": arm.trainer, "rollouts": rollouts[name]}
            arms[name] = {**of, "runs": runs}
        found = {self.folder(*run).name: told for run, told in audits.items()}
        data = {"arms": arms, "audits": found, "table": dict(self.table), "compare": dict(self.compare)}
        return json.dumps(data, indent=1) + "\n"


def read_study(data: Mapping[str, Any]) -> Study:
    """A study from plain data.

    Raises:
        SpecError: what is wrong in it, by name.
    """
    names = [item.name for item in fields(Study)]
    for key in data:
        if key not in names:
            raise SpecError(f"unknown key {key!r} in a study{suggest(str(key), names)}")
    for name in ("out", "scaffolds", "arms"):
        if not data.get(name):
            raise SpecError(f"a study: `{name}` is missing")
    for name in ("scaffolds", "arms"):
        if not isinstance(data[name], Mapping):
            raise SpecError(f"a study: `{name}` is {data[name]!r}; expected a mapping of labels")
    scaffolds = {str(label): AgentSpec.from_data(item or {}) for label, item in data["scaffolds"].items()}
    arms = {str(name): _arm(str(name), item, scaffolds) for name, item in data["arms"].items()}
    given = {**data, "scaffolds": scaffolds, "arms": arms}
    check_types("a study", Study, {k: v for k, v in given.items() if k not in ("scaffolds", "arms")})
    study = Study(**given)
    _check_evaluation(study.evaluation)
    known = [START, *arms, *study.references]
    listed = [("table", name) for name in study.table.values()]
    for name, pair in study.compare.items():
        if not isinstance(pair, Sequence) or isinstance(pair, str) or len(pair) != 2:
            raise SpecError(f"compare: {name} is {pair!r}; expected two policies")
        listed += [("compare", policy) for policy in pair]
    for where, policy in listed:
        if policy not in known:
            raise SpecError(f"{where} names the policy {policy!r}{suggest(str(policy), known)}")
    if len(set(study.seeds)) < len(study.seeds) or not study.seeds or study.tasks < 1:
        raise SpecError(f"a study needs different seeds and a task, got seeds {study.seeds}, tasks {study.tasks}")
    return study


def _check_evaluation(given: Mapping[str, Any]) -> None:
    allowed = ["backend", *(item.name for item in fields(Settings) if item.name not in ("prices", "limits"))]
    for key in given:
        if key not in allowed:
            raise SpecError(f"unknown key {key!r} in evaluation{suggest(str(key), allowed)}")
    check_types("evaluation", Settings, {k: v for k, v in given.items() if k != "backend"})


def _arm(name: str, item: Any, scaffolds: Mapping[str, AgentSpec]) -> Arm:
    if name == START or not isinstance(item, Mapping):
        raise SpecError(f"arm {name!r}: expected a mapping with `scaffold`, under another name than {START!r}")
    given = dict(item)
    scaffold, trainer = given.pop("scaffold", None), given.pop("trainer", "grpo")
    if scaffold not in scaffolds:
        raise SpecError(f"arm {name!r}: unknown scaffold {scaffold!r}{suggest(str(scaffold), scaffolds)}")
    if trainer not in TRAINERS:
        raise SpecError(f"arm {name!r}: unknown trainer {trainer!r}{suggest(str(trainer), TRAINERS)}")
    if "agent" in given:
        raise SpecError(f"arm {name!r}: its agent is the scaffold {scaffold!r}; change it there")
    return Arm(scaffold, trainer, given)
