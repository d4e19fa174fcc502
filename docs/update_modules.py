"""Write the generated table of docs/modules.md: `python docs/update_modules.py`. A test holds that it is current.

The table is read off the declarations on the classes of this package; modules from elsewhere are not in it.
"""

from __future__ import annotations

from pathlib import Path

from agentspec.files import write_atomic
from agentspec.registry import REGISTRY, Entry

PAGE = Path(__file__).with_name("modules.md")
BEGIN, END = "<!-- generated: call profiles -->", "<!-- end -->"
KINDS = ("memory", "reasoning", "reflection")
OCCASIONS = ("retrieve", "store", "step", "episode")


def updated(page: str) -> str:
    """The page with its table as the modules declare it."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n{call_table()}{END}{after}"


def call_table() -> str:
    """The declared call profiles as a Markdown table, one row per module and preset."""
    lines = [
        "| kind | module | preset | " + " | ".join(f"calls per {o}" for o in OCCASIONS) + " | purposes | needs |",
        "|---|---|---|" + "---|" * len(OCCASIONS) + "---|---|",
    ]
    for kind in KINDS:
        for name, entry in REGISTRY.all(kind).items():
            if entry.target.startswith("agentspec."):
                lines += _rows(kind, name, entry)
    return "\n".join(lines) + "\n"


def _rows(kind: str, name: str, entry: Entry) -> list[str]:
    extra = [f"extra `{entry.declaration.extra}`"] if entry.declaration.extra else []
    needs = ", ".join([need + _waiver(entry, need) for need in entry.needs] + extra)
    rows = []
    for preset, profile in (entry.presets or {"": entry.calls}).items():
        counts = [_count(getattr(profile, occasion)) for occasion in OCCASIONS]
        cells = [kind, f"`{name}`", f"`{preset}`" if preset else "", *counts, ", ".join(entry.purposes), needs]
        rows.append("| " + " | ".join(cells) + " |")
    return rows


def _count(span: tuple[int, int]) -> str:
    fewest, most = span
    return str(most) if fewest == most else f"{fewest}–{most}"


def _waiver(entry: Entry, need: str) -> str:
    if need not in entry.waived:
        return ""
    name, value = entry.waived[need]
    return f" (not with `{name}: {value}`)"


if __name__ == "__main__":
    write_atomic(PAGE, updated(PAGE.read_text(encoding="utf-8")))
