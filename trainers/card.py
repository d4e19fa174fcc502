"""The README beside saved weights: what they belong to, how they were trained, how they act again.

transformers, TRL and PEFT each write one of their own, which name the base model by a path of this machine; here it is
named as the configuration names it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from agentspec.files import write_atomic
from agentspec.llm.models import hub_id
from trainers.mixin import Base

FILE = "README.md"


def model_card(title: str, config: Mapping[str, Any], spec: Any, *, adapter: bool, note: str = "") -> str:
    """Markdown with the hub's metadata at the top.

    Args:
        config: fields of the training configuration, as far as they are known; `model` is the base model.
        spec: the agent as plain data; nothing if unknown.
        adapter: whether the weights are a PEFT adapter on the base model, or a whole model.
        note: which weights of the run these are.
    """
    name = base_name(str(config.get("model") or ""))
    hub = hub_id(name)
    head = {
        **({"base_model": hub} if hub else {}),
        "library_name": "peft" if adapter else "transformers",
        "pipeline_tag": "text-generation",
        "tags": ["agentspec"],
    }
    what = f"A PEFT adapter for {name or 'a model that its run did not name'}" if adapter else f"Weights from {name}"
    facts = {
        "base model": name,
        "weights": note,
        "environment": _inline(config.get("environment")),
        "rewards": _inline(config.get("rewards")),
        "estimator and loss": ", ".join(str(config[k]) for k in ("estimator", "loss_type") if config.get(k)),
        "learning rate": config.get("learning_rate"),
        "rollouts per task": config.get("num_generations"),
    }
    lines = ["---", yaml.safe_dump(head, sort_keys=False).rstrip(), "---", "", f"# {title}", ""]
    lines += [f"{what}, trained inside an agent's scaffold with AgentSpec.", "", "| | |", "|---|---|"]
    lines += [f"| {key} | {value} |" for key, value in facts.items() if value not in (None, "")]
    if spec:
        policy = f"--policy {name or 'BASE'} --adapter FOLDER" if adapter else "--policy FOLDER"
        agent = yaml.safe_dump(spec, sort_keys=False).rstrip()
        lines += ["", "The agent, as `agent.yaml`:", "", "```yaml", agent, "```"]
        lines += ["", "It acts again with", "", f"    agentspec run {policy} --spec agent.yaml"]
    return "\n".join(lines) + "\n"


def base_name(model: str) -> str:
    """How people call a model: its hub id or bundled name; of a folder the last part."""
    return Path(model).name if Path(model).is_dir() or re.match(r"[~./]", model) else model


def _inline(value: Any) -> Any:
    """A mapping on one line; any other value as it is."""
    return yaml.safe_dump(value, default_flow_style=True, width=1 << 20).strip() if isinstance(value, dict) else value


class OwnCards(Base):
    """Writes our card wherever a trainer saves weights; mixed into the trainer."""

    def create_model_card(self, *_: Any, **__: Any) -> None:
        """Nothing yet: the card is written with the weights."""

    def _save(self, output_dir: str | None = None, state_dict: Any = None) -> None:
        super()._save(output_dir, state_dict)
        folder = Path(output_dir or self.args.output_dir)
        beside = [p.parent for p in folder.glob("*/adapter_config.json") if not p.parent.name.startswith("checkpoint-")]
        for place in (folder, *beside):
            adapter = (place / "adapter_config.json").is_file()
            note = f"update {self.state.global_step}" + ("" if place == folder else f", the frozen {place.name}")
            title = Path(self.args.output_dir).name
            text = model_card(title, vars(self.args), self.args.spec.to_data(), adapter=adapter, note=note)
            write_atomic(place / FILE, text)
