"""The memory of the tutorial is run as it is printed."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from agentspec.episode import Job, Runner
from agentspec.llm.base import Request
from agentspec.llm.scripted import ScriptedLLM
from agentspec.registry import REGISTRY, import_modules
from agentspec.spec import AgentSpec
from agentspec.types import Task
from tests.contract.harness import LENGTH, SCRIPTS, example, play, scripts, variants
from tests.toy_env import TOY

PAGE = Path(__file__).resolve().parents[1] / "docs" / "tutorials" / "own_memory.md"


@pytest.fixture
def sheet(tmp_path: Path) -> Iterator[None]:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "cheat_sheet.py").write_text(code, encoding="utf-8")
    import_modules([str(tmp_path / "cheat_sheet.py")])
    yield
    REGISTRY.unregister("memory", "cheat_sheet")
    sys.modules.pop("cheat_sheet")


def test_the_memory_of_the_tutorial_keeps_the_contract(sheet: None) -> None:
    for case in variants("memory", "cheat_sheet", REGISTRY.get("memory", "cheat_sheet")):
        for model in SCRIPTS:
            played = play(case, scripts(case)[model], length=LENGTH)
            assert all(count <= 2 for count in played.counts["store"])
        assert play(case, example(case), length=LENGTH).module(case).sheet == "Hot food first."


def test_the_memory_of_the_tutorial_goes_on_over_episodes(sheet: None) -> None:
    def script(request: Request) -> str:
        return '{"sheet": "Sell when it is high."}' if request.tag.purpose == "curate" else "WAIT()"

    spec = AgentSpec.from_data({"memory": {"name": "cheat_sheet", "every": 4}, "scope": "run", "perception": "generic"})
    runner = Runner(spec, ScriptedLLM(script))
    (first,) = runner.run([Job(Task(TOY, 0))])
    (second,) = runner.run([Job(Task(TOY, 1), memory_state=first.memory_state)])
    asked = [bytes(i for i in c.prompt_ids if i < 256) for c in second.calls]
    assert b"Memory:\nSell when it is high." in asked[0]
