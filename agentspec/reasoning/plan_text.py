"""Reading what a planner wrote: the sub-goals of a plan, and whether a step reports its own as done."""

from __future__ import annotations

import re
from collections.abc import Iterable

from agentspec.visible import visible

_NUMBERED = re.compile(
    r"^([ \t]*)[*_#> ]{0,4}(?:(?:step|sub-?goal|goal)[ \t]+)?\(?(\d{1,2})[.):][*_]*[ \t]*(\S.*)$", re.I | re.MULTILINE
)
_BULLET = re.compile(r"^([ \t]*)([-*•])[ \t]+(\S.*)$", re.MULTILINE)
_HEADING = re.compile(
    r"^\W*(?:(?:the|my|numbered|step-by-step)[ \t]+)*(?:plan|sub-?goals|goals)\b[^\n\d]{0,30}$", re.I | re.MULTILINE
)
_DONE = re.compile(
    r"(?P<asked>\?\s*)?\bsub-?goal(?:\s+\d+)?(?:\s+(?:is|has been|was))?(?P<not>\s+(?:not|n't|never)\b)?(?:\s+\w+)?\s+"
    r"(?:done|achieved|complete[d]?|finished)\b(?P<after>[^.\n]{0,40})",
    re.IGNORECASE,
)
_DENIED = re.compile(r"\b(?:not|no|n't|never|until|once|when|if|yet|almost|nearly)\b|\?", re.IGNORECASE)


def goals_of(plan: str) -> list[str]:
    """The sub-goals that a plan lists: its numbered lines, however they are dressed, or else its bullets.

    What stands indented below one is none of its own. Where a heading says "plan" the list below it counts, and not one
    of quantities, say; else the first.
    """
    heading = max((match.end() for match in _HEADING.finditer(plan)), default=0)
    for start in (heading, 0):
        for pattern in (_NUMBERED, _BULLET):
            goals = [match[3].strip(" \t*_") for match in _first_list(pattern.finditer(plan, start))]
            if any(goals):
                return [goal for goal in goals if goal]
    return []


def _first_list(lines: Iterable[re.Match[str]]) -> list[re.Match[str]]:
    """The lines of the first list, without those that are indented more than its first or count from 1 again."""
    found: list[re.Match[str]] = []
    for line in lines:
        if found and len(line[1]) > len(found[0][1]):
            continue
        if found and line[2] == "1":
            break
        found.append(line)
    return found


def says_done(words: str) -> bool:
    """Whether a step reports its sub-goal as done; "done? No, not yet" does not."""
    words = visible(words)[0]
    for match in _DONE.finditer(words):
        start = words.rfind("\n", 0, match.start()) + 1
        sentence = re.split(r"[.!;]\s", words[start : match.start()])[-1]
        if not match["not"] and not _DENIED.search(match["after"]) and not _DENIED.search(sentence):
            return True
    return False
