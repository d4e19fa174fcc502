"""What of a configuration can be refused before torch, transformers and TRL are imported, which takes half a minute.

Names of fields, the agents, the world, rewards, the model's name. `trainers.checks` judges the whole configuration.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from agentspec.actions import suggest
from agentspec.envs.making import check_options, environment_id
from agentspec.llm.models import check_name
from agentspec.registry import SpecError
from agentspec.spec import AgentSpec, load_yaml
from rewards import RewardSet
from trainers.estimators import estimator
from trainers.fields import FIXED, REFUSED, USED
from trainers.losses import loss

OURS = {
    "model": "model adapter actor_adapter actor_temperature lora_r lora_alpha lora_targets lora_layers",
    "agent and world": "agent environment train_tasks memory_carry start_memory retries env_timeout_s "
    "rollout_concurrency batching",
    "credit and loss": "train_calls train_credits rewards estimator reference gamma gigpo_weight skip_zero_variance "
    "write_credit write_calls write_rerolls write_points "
    "normalize overlong overlong_ends mask_truncated packing tokens_per_forward",
    "evaluation": "eval_tasks eval_specs eval_sampling validation_tasks validation_specs",
    "this run": "resume plots vllm_batch_invariant",
}
"""Headings of `--help` and the fields under them; TRL's own (`trainers.fields.USED`) follow."""

KNOWN = frozenset(" ".join((*OURS.values(), *USED.values(), *FIXED, *REFUSED.values())).split())
"""Every field there is, ours and TRL's (a test compares it with the installed TRL)."""

SPECS = ("agent", "eval_specs", "validation_specs")
STRUCTURES = (*SPECS, "environment", "rewards")
"""Fields that hold a mapping or a list: on the command line as JSON or YAML."""


def check_names(names: Iterable[Any], where: str, *, dashes: str = "") -> None:
    """Refuse fields that do not exist, and those that nobody reads, whatever their value.

    Args:
        where: what they were read from, for the message.
        dashes: before the name of an option.
    """
    why = {name: reason for reason, listed in REFUSED.items() for name in listed.split()}
    for name in map(str, names):
        if name in why:
            raise SpecError(f"{where}: `{name}` is not read: {why[name]}")
        if name not in KNOWN:
            kind, hint = "option" if dashes else "key", suggest(dashes + name, [dashes + known for known in KNOWN])
            raise SpecError(f"{where}: unknown {kind} {dashes + name!r}{hint}")


def check_ahead(data: Mapping[str, Any], options: Sequence[str]) -> None:
    """Refuse a model, an agent, a world or a reward that there is not.

    Args:
        data: fields of the configuration.
        options: the command line, whose fields win.

    Raises:
        SpecError: what was given and what there is.
        ModelNotFoundError: no such model, as far as can be told without asking a hub.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in ("model", "estimator", "loss_type", *STRUCTURES):
        parser.add_argument(f"--{name}", f"--{name.replace('_', '-')}", dest=name, nargs="*")
    given = {k: v[0] for k, v in vars(parser.parse_known_args(list(options))[0]).items() if v}
    fields = {**data, **{k: structure(v) if k in STRUCTURES else v for k, v in given.items()}}
    for name in SPECS:
        value = fields.get(name)
        for spec in value if isinstance(value, list) else [value] if value else []:
            AgentSpec.from_yaml(spec) if isinstance(spec, str) else AgentSpec.from_data(_with_scope(spec))
    check_world(fields.get("environment") or "deliverybench")
    RewardSet(fields.get("rewards"))
    for name, known in (("estimator", estimator), ("loss_type", loss)):
        if isinstance(fields.get(name), str):
            known(fields[name])
    if isinstance(fields.get("model"), str):
        check_name(fields["model"])


def _with_scope(spec: Any) -> Any:
    """A spec with the scope that a trained reflector gets from its recipe, where it gives none."""
    reflection = spec.get("reflection") if isinstance(spec, Mapping) else None
    name = reflection.get("name") if isinstance(reflection, Mapping) else reflection
    return {"scope": "run", **spec} if name == "retroformer" else spec


def structure(value: Any) -> Any:
    """A field's value from the command line: JSON and YAML are read, names and paths stay."""
    return load_yaml(value) if isinstance(value, str) and value.lstrip()[:1] in ("{", "[") else value


def check_world(value: Any) -> tuple[str, dict[str, Any]]:
    """Name and options of an environment that exists and takes them; else a `SpecError`."""
    given: Any = {"name": value} if isinstance(value, str) else value
    if not isinstance(given, Mapping) or not isinstance(given.get("name"), str) or set(given) - {"name", "options"}:
        raise SpecError(f"environment: expected {{name: ..., options: {{...}}}}, got {given!r}")
    options = given.get("options") or {}
    if not isinstance(options, Mapping):
        raise SpecError(f"environment: options is {options!r}; expected a mapping")
    check_options(environment_id(given["name"]), options)
    return given["name"], dict(options)
