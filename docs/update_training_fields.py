"""Write docs/training_fields.md: `python docs/update_training_fields.py`. A test holds that it is current."""

from __future__ import annotations

from dataclasses import fields
from importlib.metadata import version
from pathlib import Path

from trl import GRPOConfig

from agentspec.files import write_atomic
from trainers.fields import FieldRule, field_rules

PAGE = Path(__file__).with_name("training_fields.md")


def page(config: type) -> str:
    """The table as Markdown, in the order in which the dataclass declares its fields."""
    rules = field_rules(config)
    names = [f.name for f in fields(config)]
    count = {status: sum(rules[n].status == status for n in names) for status in ("used", "fixed", "refused")}
    return "\n".join(
        [
            "# Fields of a training configuration",
            "",
            "`ScaffoldConfig` is `trl.GRPOConfig` plus our own fields (described in `trainers/config.py`). Every",
            "inherited field is used, fixed to the one value that is exact here, or refused with what to set instead.",
            f"TRL {version('trl')}: {', '.join(f'{n} {status}' for status, n in count.items())}.",
            "Generated from `trainers/fields.py` by `python docs/update_training_fields.py`.",
            "",
            "| field | | |",
            "|---|---|---|",
            *(f"| `{n}` | {rules[n].status} | {_note(rules[n])} |" for n in names),
            "",
        ]
    )


def _note(rule: FieldRule) -> str:
    return f"{rule.allowed[0]!r}: {rule.why}" if rule.status == "fixed" else rule.why


if __name__ == "__main__":
    write_atomic(PAGE, page(GRPOConfig))
