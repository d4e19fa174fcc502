"""Property tests have no deadline, here or in a test of its own."""

from __future__ import annotations

import ast
from pathlib import Path

from hypothesis import settings


def test_no_property_test_has_a_deadline() -> None:
    assert settings.get_current_profile_name() == "agentspec" and settings().deadline is None
    assert settings(max_examples=3).deadline is None  # what a test that sets something else gets
    for path in Path(__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.keyword) and node.arg == "deadline":
                assert ast.unparse(node.value) == "None", f"{path}:{node.value.lineno}"
