"""Judges: reading a verdict (one of a few words, or a number), and rating states."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from agentspec.llm.base import Message
from agentspec.prompting import with_request
from agentspec.reasoning.search.meter import Ask, Meter
from agentspec.visible import visible

RATINGS = tuple(range(1, 11))
UNREAD = 0.5
"""Rating (of 0 to 1) to assume where the judge's answer holds none."""

RATE = "Rate how promising this course is for the task, from 1 (hopeless) to 10 (as good as done)."
IN_WORDS = "Say why in a sentence, then end with the number."

_NEGATED = re.compile(r"(?:\b(?:not|never|hardly|cannot be)|n't|n’t)\s+(?:\w+\s+)?$")
_SAID = re.compile(
    r"\b(?:rating|score|answer|choice|best(?: (?:one|course|option))?)\b\W{0,4}(?:is|of|=|:)\W{0,6}(\d+)(?![\d.]*\d)",
    re.I,
)
_THOUSANDS = re.compile(r"(?<=\d),(?=\d{3}(?!\d))")
_INTEGER = re.compile(r"(?<![\d.])\d+(?![\d.]*\d)")


def last_word(text: str, values: Mapping[str, float]) -> float | None:
    """The value of the known word that stands last in `text`, whatever its case; `None` if none does.

    A word that is denied ("I am not sure") is none.
    """
    pattern = r"\b(" + "|".join(re.escape(w) for w in values) + r")\b"
    shown = visible(text)[0].casefold()[-10_000:]
    found = [
        m[1] for m in re.finditer(pattern, shown) if not _NEGATED.search(shown[max(0, m.start() - 40) : m.start()])
    ]
    return values[found[-1]] if found else None


def last_number(text: str, allowed: Sequence[int]) -> int | None:
    """The last whole number of `text` that is among `allowed`, one that is called the rating or the choice first
    ("Rating: 8 (of 1-10)" means 8); `None` if there is none.
    """
    text = re.sub(r"(\d+)\s*(?:/|out of)\s*\d+", r"\1", visible(text)[0][-10_000:])  # "7/10" means 7
    for pattern in (_SAID, _INTEGER):
        fitting = [int(m) for m in pattern.findall(text) if len(m) < 10 and int(m) in allowed]
        if fitting:
            return fitting[-1]
    return None


def last_amount(text: str, label: str) -> float | None:
    """The last number after `label` (`Estimate: about $12.50`); `None` if there is none."""
    shown = _THOUSANDS.sub("", visible(text)[0][-10_000:])
    found = re.findall(
        rf"\b{label}\b\W{{0,4}}[^\d\n+-]{{0,20}}([-+]?\$?\s?\d{{1,9}}(?:[.,]\d+)?)", shown, re.IGNORECASE
    )
    return float(re.sub(r"[$\s]", "", found[-1]).replace(",", ".")) if found else None


async def rate(
    meter: Meter, prompts: Sequence[Sequence[Message]], *, constrained: bool, **sampling: Any
) -> list[float | None]:
    """Mean rating (0 to 1) of each prompt that ends with `RATE`; `None` where no answer holds a number.

    Fewer come back when the budget ends among them: the first ones.
    """
    if constrained:
        sampling["choices"] = tuple(str(r) for r in RATINGS)
    else:
        prompts = [with_request(messages, IN_WORDS) for messages in prompts]
    ratings: list[float | None] = []
    for call in await meter.ask_all([Ask("value", messages, sampling) for messages in prompts]):
        # Of an answer that was cut off the last number is any number.
        whole = [c for c in call.completions if constrained or c.finish_reason != "length"]
        found = [n for n in (last_number(c.text, RATINGS) for c in whole) if n is not None]
        ratings.append(sum(found) / len(found) / RATINGS[-1] if found else None)
    return ratings
