"""Write the generated tables of docs/training.md: `python docs/update_training.py`. A test holds that it is current."""

from __future__ import annotations

from pathlib import Path

from agentspec.files import write_atomic
from trainers.estimators import ESTIMATORS
from trainers.losses import LOSSES, REFUSED
from trainers.writes import WRITE_CREDITS

PAGE = Path(__file__).with_name("training.md")


def estimator_table() -> str:
    """Every estimator, what it gives and what it reads."""
    rows = ["| `estimator` | advantage | one per | sums to 0 | reads |", "|---|---|---|---|---|"]
    for name, spec in ESTIMATORS.items():
        reads = ", ".join(f"`{n}`" for n in spec.needs if n != "anchors")
        per, zero = ("step" if spec.per_step else "episode"), ("yes" if spec.zero_sum else "no")
        rows.append(f"| `{name}` | {spec.summary} | {per} | {zero} | {reads} |")
    return "\n".join(rows) + "\n"


def write_table() -> str:
    """Every estimator of a write to memory, and what it reads."""
    rows = ["| `write_credit` | what a write earns | reads |", "|---|---|---|"]
    for name, spec in WRITE_CREDITS.items():
        rows.append(f"| `{name}` | {spec.summary} | {', '.join(f'`{n}`' for n in spec.reads)} |")
    return "\n".join(rows) + "\n"


def loss_table() -> str:
    """Every loss, what divides it, and how it depends on rows; then those that are refused."""
    rows = [
        "| `loss_type` | loss of an update | code | reads | if episodes have several rows |",
        "|---|---|---|---|---|",
    ]
    for name, spec in LOSSES.items():
        reads = ", ".join(f"`{n}`" for n in spec.uses)
        same = spec.depends_on_rows or "the same objective"
        rows.append(f"| `{name}` | {spec.summary} | {'TRL' if spec.trl else 'ours'} | {reads} | {same} |")
    rows += [f"| `{name}` | refused: {why} | | | |" for name, why in REFUSED.items()]
    return "\n".join(rows) + "\n"


def updated(page: str) -> str:
    """The page with its tables as the code declares them."""
    for name, table in (("estimators", estimator_table()), ("writes", write_table()), ("losses", loss_table())):
        before, begin, rest = page.partition(f"<!-- generated: {name} -->")
        _, end, after = rest.partition("<!-- end -->")
        page = f"{before}{begin}\n{table}{end}{after}"
    return page


if __name__ == "__main__":
    write_atomic(PAGE, updated(PAGE.read_text(encoding="utf-8")))
