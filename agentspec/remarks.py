"""What may stand beside a menu entry without taking it back.

A call is told from prose by its brackets; a menu entry ("wait", "rent car") is made of common words. Where one stands
at the beginning of a line it is the answer only if what follows is a remark about it: a bracket, a reason, a next step,
a closing sentence. It is none where the line goes on with more numbers ("accept order 2 and 5"), leaves a choice
("or", "if", another entry of the menu), or takes it back ("No, ..."). In the middle of a sentence an entry is the
answer only where the sentence says so ("I will choose ...").
"""

from __future__ import annotations

import re
from collections.abc import Iterable

LONGEST = 400
"""Signs of a line that are read behind an entry."""

_MORE_NUMBERS = re.compile(
    r"\s*(?:,|&|\+|\band\b|\bor\b)\s*(?:and\b|or\b)?\s*(?:orders?\b|#|no\.?)?\s*#?\d", re.IGNORECASE
)
_OPEN = re.compile(r"[\s,;(]*(?:/|\bor\b|\bif\b|\bunless\b|\beither\b)", re.IGNORECASE)
_NEXT = re.compile(r"[\s,;.(]*(?:(?:and|then|to|before|so)\b|->)", re.IGNORECASE)
_REASON = re.compile(r"\s*,\s*(?:it|its|this|that|which|they|these|both|now|first|please)\b", re.IGNORECASE)
_TAKEN_BACK = re.compile(
    r"(?:^|[\s(,.;:\-–—?!])(?:no|nope|never|instead|actually|otherwise|rather|however|wrong|silly|bad|worse|prefer|hmm|"
    r"would|could|might|too (?!\W|$)|not (?:worth|now|yet|good|the)|but (?:no|not|i|that|it)|"
    r"let me (?:think|see|look|check|reconsider)|wait(?=\s*[,.!;:–—-]|$))(?![\w'])",
    re.IGNORECASE,
)
_SENTENCE = re.compile(r"[\s`*_\"')\]]*[.!]\s+\S")
_ABOUT_IT = re.compile(
    r"[\s`*_\"')\]]*[.!]\s+(?:This|That|It|Its|They|These|Both|The|Because|Since|So|Happy|Glad|Hope|Hopefully|Good|Great|"
    r"Enjoy|Thanks?|Thank you|Let me know|Feel free|Please|Reason(?:ing)?|I hope|I chose|I choose|I picked|My reason)\b"
)
_NEXT_LINE_BACK = re.compile(
    r"\W*(?:no|nope|not|instead|actually|rather|or|but|hmm|on second thought|scratch that|wait(?=\s*[,.!;:–—-]))\b",
    re.IGNORECASE,
)
_MEANT = re.compile(
    r"\b(?:choos(?:e|ing)|chose|pick(?:ing)?|select(?:ing)?|go(?:ing)? (?:with|for)|opt(?:ing)? for|"
    r"decided? (?:on|to)|will|shall|let me|let us|let's|should|must|going to|recommend|suggest|propose|answer|"
    r"(?:action|choice|step|move|option|thing)(?: \w+){0,3} (?:is|:)|best)\b|'ll\b|’ll\b",
    re.IGNORECASE,
)
_HEDGED = re.compile(
    r"\b(?:could|might|may|had|have to|considered|wrong|need|if|or|unless|nothing|cannot|without|whether|would be|not|"
    r"never|no)\b|n't\b|\?",
    re.IGNORECASE,
)


def is_remark(rest: str, following: str, others: Iterable[str], *, labelled: bool = False) -> bool:
    """Whether `rest` of a line and what is `following` it leave the entry before them as it is.

    Args:
        rest: of the line, from the end of the entry.
        following: the lines after it.
        others: the other entries of the menu.
        labelled: whether the entry stands behind `Action:`, which needs no further sign that it is meant.
    """
    rest = rest[:LONGEST]
    if not rest.strip(" \t\r`*_\"'.!)]"):
        return labelled or not _NEXT_LINE_BACK.match(following.lstrip()[:LONGEST])
    if _MORE_NUMBERS.match(rest) or _OPEN.match(rest) or _TAKEN_BACK.search(rest):
        return False
    if _SENTENCE.match(rest) and not labelled:
        return _ABOUT_IT.match(rest) is not None and not following.strip()
    return bool(_NEXT.match(rest)) or not mentions(rest, others)


def gives_reason(rest: str) -> bool:
    """Whether `rest` of a line goes on about the entry after a comma: ", it is ready"."""
    return _REASON.match(rest) is not None


def is_meant(before: str) -> bool:
    """Whether the sentence that an entry closes says that it is the answer; `before` is the text up to the entry."""
    sentence = re.split(r"[.!?\n]", before[-LONGEST:])[-1]
    return _MEANT.search(sentence) is not None and not _HEDGED.search(sentence)


def mentions(text: str, entries: Iterable[str]) -> bool:
    """Whether one of `entries` stands in `text`."""
    folded = text.casefold()
    return any(re.search(rf"(?<!\w){re.escape(entry.casefold())}(?!\w)", folded) for entry in entries)
