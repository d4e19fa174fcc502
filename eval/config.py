"""A matrix as a YAML file: which policies, in which scaffolds, on which tasks, how.

```yaml
policies:
  start: {model: smollm2, adapter: courier}
  grpo: {model: smollm2, adapters: [runs/s0, runs/s1, runs/s2]}   # training runs of one recipe: one row of the table
  gpt: {model: some-model, backend: openai, base_url: https://...}
  rule_based:
scaffolds:
  plain: {}
  react: {reasoning: react, memory: base}
  sheet: scaffolds/sheet.yaml
tasks:
  courier: {env: deliverybench, options: {size: tiny, action_mode: menu}, seeds: 20000-20007}
  grid: {env: minigrid, seeds: 20000-20007}
rollouts: 1
sampling: {temperature: 0}
limits: {episode_s: 600, cell_tokens: 2000000}
out: results/matrix
```
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from agentspec.actions import suggest
from agentspec.extends import read_extended
from agentspec.llm.pricing import Prices
from agentspec.parameters import check_types
from agentspec.policies import Policy
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec
from agentspec.tasks import SPLITS, episode_key, parse_seeds
from agentspec.types import Task
from eval.cells import Settings
from eval.limits import Limits
from eval.matrix import evaluate

TOP = ("policies", "scaffolds", "tasks", "out", "store", "executor", "workers", "address", "prices", "limits")
OF_SETTINGS = tuple(f.name for f in fields(Settings) if f.name not in ("prices", "limits"))


@dataclass(frozen=True)
class Matrix:
    """What `eval.evaluate` is called with.

    Args:
        arguments: of the call, besides policies, scaffolds and tasks.
    """

    policies: tuple[Policy, ...]
    scaffolds: Mapping[str, AgentSpec]
    tasks: Mapping[str, Sequence[Task]]
    settings: Settings
    arguments: Mapping[str, Any] = field(default_factory=dict)

    @property
    def episodes(self) -> int:
        """How many episodes there are in all."""
        tasks = sum(map(len, self.tasks.values()))
        return len(self.policies) * len(self.scaffolds) * tasks * self.settings.rollouts


def read_matrix(path: str | Path) -> Matrix:
    """The matrix of a file; it may say `extends: other.yaml` (`agentspec.extends`).

    Relative paths of adapters, scaffolds and memories are looked up beside it first.

    Raises:
        SpecError: no such file, or what is wrong in it, by name.
    """
    path = Path(path)
    data = read_extended(path)
    try:
        return _matrix(data, path.parent)
    except SpecError as error:
        raise SpecError(f"{path}: {error}") from error


def _matrix(data: Mapping[str, Any], beside: Path) -> Matrix:
    for name in data:
        if name not in (*TOP, *OF_SETTINGS):
            raise SpecError(f"unknown key {name!r}{suggest(str(name), (*TOP, *OF_SETTINGS))}")
    for name in ("policies", "scaffolds", "tasks"):
        if not data.get(name):
            raise SpecError(f"`{name}` is missing: expected a mapping of labels")
    policies = [
        p for name, item in _mapping(data["policies"], "policies").items() for p in policy_runs(str(name), item, beside)
    ]
    scaffolds = {str(k): _scaffold(v, beside) for k, v in _mapping(data["scaffolds"], "scaffolds").items()}
    tasks = {str(label): _tasks(str(label), item) for label, item in _mapping(data["tasks"], "tasks").items()}
    given: dict[str, Any] = {name: data[name] for name in OF_SETTINGS if name in data}
    given["limits"] = Limits.from_data(_mapping(data.get("limits") or {}, "limits"))
    given["prices"] = _prices(data.get("prices"), beside)
    if isinstance(start := given.get("start_memory"), str):
        given["start_memory"] = _beside(start, beside)
    elif isinstance(start, Mapping):
        given["start_memory"] = {k: _beside(str(v), beside) for k, v in start.items()}
    check_types("a matrix", Settings, given)
    names = ("out", "store", "executor", "workers", "address")
    arguments = {name: data[name] for name in names if data.get(name) is not None}
    check_types("a matrix", evaluate, arguments)
    for name in ("out", "store"):
        if not isinstance(arguments.get(name, ""), str):
            raise SpecError(f"a matrix: {name} must be a folder, got {arguments[name]!r}")
    return Matrix(tuple(policies), scaffolds, tasks, Settings(**given), arguments)


def policy_runs(name: str, item: Any, beside: Path) -> list[Policy]:
    """One policy, or one for each of its training runs (`adapters`, a list or a mapping of run names).

    Raises:
        SpecError: neither a scripted policy nor one with a model.
    """
    if item is None or item == {}:
        return [Policy.parse(name)]
    if isinstance(item, str):
        item = {"model": item}
    settings = dict(_mapping(item, f"policy {name!r}"))
    runs, adapter = settings.pop("adapters", None), settings.pop("adapter", "")
    model = settings.pop("model", "")
    if not model and "script" not in settings:
        raise SpecError(f"policy {name!r}: `model` is missing (a folder, a bundled name or a hub id)")
    model = _beside(str(model), beside)
    if runs is None:
        return [Policy(name, model, _adapter(str(adapter), beside), settings)]
    if adapter or not runs or not isinstance(runs, list | dict):
        raise SpecError(f"policy {name!r}: `adapters` is a list of folders, one per training run, without `adapter`")
    named = runs if isinstance(runs, dict) else {str(i): folder for i, folder in enumerate(runs)}
    return [Policy(name, model, _adapter(str(f), beside), settings, run=str(run)) for run, f in named.items()]


def _adapter(text: str, beside: Path) -> str:
    """A folder, or the name of an adapter that comes with the package."""
    if not text:
        return ""
    from agentspec.llm.models import resolve_adapter

    return str(resolve_adapter(_beside(text, beside)))


def _scaffold(item: Any, beside: Path) -> AgentSpec:
    if isinstance(item, str):
        return AgentSpec.from_yaml(_beside(item, beside))
    return AgentSpec.from_data(item or {})


def _tasks(label: str, item: Any) -> list[Task]:
    data = _mapping(item, f"tasks {label!r}")
    for name in data:
        if name not in ("env", "options", "seeds", "split"):
            raise SpecError(f"tasks {label!r}: unknown key {name!r}{suggest(str(name), ('env', 'options', 'seeds'))}")
    if not isinstance(data.get("env"), str):
        raise SpecError(f"tasks {label!r}: `env` is missing (a registered name or gymnasium id)")
    seeds = data.get("seeds", "20000-20007")
    texts = [str(seed) for seed in seeds] if isinstance(seeds, list) else [str(seeds)]
    options = dict(_mapping(data.get("options") or {}, f"options of tasks {label!r}"))
    split = data.get("split", "test")
    if split not in SPLITS:
        raise SpecError(f"tasks {label!r}: unknown split {split!r}; expected one of {', '.join(SPLITS)}")
    tasks = [Task(data["env"], seed, options, split) for seed in parse_seeds(texts)]
    episodes = len({episode_key(task) for task in tasks})
    if episodes < len(tasks):
        raise SpecError(
            f"tasks {label!r}: {len(tasks)} seeds start {episodes} different episodes (this suite has no more), and "
            f"one episode played twice is not two tasks: give {episodes} seeds in a row; `rollouts` plays them again"
        )
    return tasks


def _prices(item: Any, beside: Path) -> Prices:
    if item is None:
        return Prices()
    if isinstance(item, str):
        return Prices.from_yaml(_beside(item, beside))
    return Prices.from_data(item, "prices")


def _beside(text: str, folder: Path) -> str:
    return str(folder / text) if text and (folder / text).exists() else text


def _mapping(value: Any, what: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise SpecError(f"expected {what} as a mapping, got {type(value).__name__}")
    return value
