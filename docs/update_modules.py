"""Write the generated table of docs/modules.md: ``python docs/update_modules.py``. A test holds that it is current."""

from __future__ import annotations

from pathlib import Path

from agentspec.files import write_atomic
from agentspec.registry import call_table

PAGE = Path(__file__).with_name("modules.md")
BEGIN, END = "<!-- generated: call profiles -->", "<!-- end -->"


def updated(page: str) -> str:
    """The page with its table as the registry declares it."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n{call_table()}{END}{after}"


if __name__ == "__main__":
    write_atomic(PAGE, updated(PAGE.read_text(encoding="utf-8")))
