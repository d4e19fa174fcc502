"""Patterns over the tags of calls."""

from __future__ import annotations

import pytest

from agentspec.tags import matches
from trainers.sequences import TrainFilter


@pytest.mark.parametrize(
    ("pattern", "fits"),
    [
        ("reasoning.*", True),  # without a slash: any purpose
        ("reasoning.react", True),
        ("reasoning.react/act", True),
        ("*/act", True),
        ("reasoning.react/plan", False),
        ("memory.*", False),
        ("Reasoning.*", False),
        ("reasoning", False),  # the whole module name
    ],
)
def test_patterns(pattern: str, fits: bool) -> None:
    assert matches("reasoning.react/act", pattern) is fits
    assert matches("reasoning.react/act", ["memory.summary", pattern]) is fits
    assert TrainFilter((pattern,)).matches("reasoning.react/act") is fits
