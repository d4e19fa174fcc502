"""The benchmark of chat models in the seat, and the prompt gallery: both small, both must hold."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest

from benchmarks.play import agents, played

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.mark.parametrize("menu", [False, True], ids=["native", "menu"])
@pytest.mark.parametrize("name", ["direct", "react", "plan_and_solve, persistent", "react+self_refine"])
def test_a_chat_model_delivers(name: str, menu: bool) -> None:
    spec, _ = agents()[name]
    row = played(spec, menu=menu, max_steps=50)
    assert row["invalid_share"] == 0 and row["deliveries"] >= 1
    if name in ("direct", "react") and not menu:
        assert row["calls_per_step"] == 1.0


@pytest.mark.parametrize("name", sorted(agents()))
def test_every_method_takes_the_forms_it_is_given(name: str) -> None:
    spec, _ = agents()[name]
    for menu in (False, True):
        assert played(spec, menu=menu, max_steps=6)["invalid_share"] == 0


def script() -> Any:
    location = importlib.util.spec_from_file_location("update_prompts", DOCS / "update_prompts.py")
    assert location and location.loader
    module = importlib.util.module_from_spec(location)
    location.loader.exec_module(module)
    return module


def test_no_prompt_changes_unseen() -> None:
    pages = script().gallery()
    assert {p.name for p in (DOCS / "prompts").glob("*.md")} == set(pages), "run `python docs/update_prompts.py`"
    for name, page in pages.items():
        current = (DOCS / "prompts" / name).read_text(encoding="utf-8")
        assert current == page, f"the prompts of {name} have changed; look at them: `python docs/update_prompts.py`"


def test_the_order_of_a_prompt_is_the_declared_one() -> None:
    page = (DOCS / "prompts" / "reflexion.md").read_text(encoding="utf-8")
    prompt = page.split("layout `snapshot`")[1].split("````text")[1].split("````")[0]
    marks = [
        "--- system ---",
        "You are a delivery courier",
        "Actions:",
        "Answer with",
        "Lessons",
        "Memory:",
        "on the clock",
    ]
    places = [
        prompt.rindex(mark) if mark in ("Memory:", "Lessons", "on the clock") else prompt.index(mark) for mark in marks
    ]
    assert places == sorted(places)
