"""The documentation's table of calls is the registry's, and every module has its paragraph."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from agentspec.registry import REGISTRY

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.mark.parametrize("name", ["modules", "training"])
def test_generated_tables_are_current(name: str) -> None:
    pytest.importorskip("torch")
    location = importlib.util.spec_from_file_location(f"update_{name}", DOCS / f"update_{name}.py")
    assert location and location.loader
    script = importlib.util.module_from_spec(location)
    location.loader.exec_module(script)
    page = (DOCS / f"{name}.md").read_text(encoding="utf-8")
    assert script.updated(page) == page, f"run `python docs/update_{name}.py`"


@pytest.mark.parametrize("kind", ["memory", "reasoning", "reflection"])
def test_every_method_has_a_paragraph(kind: str) -> None:
    page = (DOCS / "modules.md").read_text(encoding="utf-8")
    for name, entry in REGISTRY.all(kind).items():
        assert f"**`{name}`**" in page or entry.scripted or name == "none", f"docs/modules.md says nothing about {name}"
