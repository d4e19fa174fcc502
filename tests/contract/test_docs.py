"""The documentation's table of calls is the registry's, and every module has its paragraph."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from agentspec.registry import REGISTRY

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_the_table_of_calls_is_current() -> None:
    location = importlib.util.spec_from_file_location("update_modules", DOCS / "update_modules.py")
    assert location and location.loader
    script = importlib.util.module_from_spec(location)
    location.loader.exec_module(script)
    page = (DOCS / "modules.md").read_text(encoding="utf-8")
    assert script.updated(page) == page, "run `python docs/update_modules.py`"


@pytest.mark.parametrize("kind", ["memory", "reasoning", "reflection"])
def test_every_method_has_a_paragraph(kind: str) -> None:
    page = (DOCS / "modules.md").read_text(encoding="utf-8")
    for name, entry in REGISTRY.all(kind).items():
        assert f"**`{name}`**" in page or entry.envs or name == "none", f"docs/modules.md says nothing about {name}"
