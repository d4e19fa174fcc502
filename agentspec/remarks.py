"""What may stand beside an action without taking it back.

A call is told from prose by its brackets; a menu entry ("wait", "rent car") is made of common words. Where one stands
at the beginning of a line it is the answer only if what follows is a remark about it: a bracket, a reason, a next step,
a closing sentence. It is none where the line goes on with more numbers ("accept order 2 and 5"), leaves a choice
("or", "if", another entry of the menu), or takes it back ("No, ..."). In the middle of a sentence an entry is the
answer only where the sentence says so ("I will choose ...").

A call needs less: it is none where its line names another one as well and leaves the choice between them ("or", "if",
"otherwise"), where its line calls it bad, and where the next line takes it back ("Wait, ..."). In the middle of a
sentence it is one where it is marked as code or closes the answer, and the sentence neither denies it nor merely speaks
of it ("my previous action", "for example", "... would waste time").
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
    r"let me (?:think|see|look|check|reconsider)|wait(?=\s*[,.!;:–—-]|$))(?![\w'])|[❌✗✘🚫👎]",
    re.IGNORECASE,
)
_CHOICE = re.compile(
    r"\b(?:or|if|unless|else|otherwise|but|actually|instead(?! of)|rather(?! than)|better(?! than)|worse|bad|vs)\b",
    re.IGNORECASE,
)
_BAD = re.compile(
    r"[\s`*_\"')\]]*(?:[-–—:(,]\s*|\bis\s+|\bwould be\s+)+(?:a\s+)?(?:bad|wrong|silly|terrible|poor|no\b(?![ \t]*\w)|"
    r"not (?:worth|now|yet|good|a good))|[^\n]*[❌✗✘🚫👎]",
    re.IGNORECASE,
)
_CORRECTED = re.compile(
    r"\W*(?:(?:no|nope|no,? wait|wait|hmm|sorry|oops)\s*[,.!;:–—-]|(?-i:only if|if|unless|or|but)\b|"
    r"(?:actually|on second thought|scratch that|correction)\b|"
    r"instead\b(?! of)|(?:that|this|it) (?:just |already )?(?:failed|did not work|didn't work|is wrong|was wrong)\b)",
    re.IGNORECASE,
)
_DENIED = re.compile(
    r"(?:\b(?:not|never|no|avoid(?:ing)?|instead of|rather than|without|cannot|nicht|kein\w*|nie|pas|jamais|niet|nunca|"
    r"não|sin|sans|ohne|не|без|нельзя|after|before|until|once|when|if|unless|error|invalid)|n't|n’t|不要|不应|不会|别|勿|避免)\W*(?:\w+\W+)?$",
    re.IGNORECASE,
)
_CITED = re.compile(
    r"\b(?:(?:previous|last|earlier|failed|past|wrong) (?:action|step|attempt|call|answer|time|turn|move)s?|"
    r"for example|for instance|example|e\.g|such as|format|before,? i|already)\b",
    re.IGNORECASE,
)
_LATER = re.compile(
    r"\b(?:(?:second|third|fourth|latter|2nd|3rd)(?: (?:one|option|action|call|choice))?|"
    r"last (?:one|option|action|call))"
    r"\W{0,3}(?:$|\n|is\b|wins\b|it is|looks|seems)",
    re.IGNORECASE,
)
_SPOKEN_OF = re.compile(
    r"[^.!?\n]*\?|[`*_\"'\s]*(?:\([^)\n]*\)\s*)?(?:(?:would|could|might|may|should not|failed|fails|wastes?|costs?|"
    r"did|does|has|had|was|takes|needs|will not|won't|cannot|can't)\b|"
    r"(?:is|seems|looks)\b(?! (?:(?:the|my|clearly|now|also|still|a) )*"
    r"(?:best|right|optimal|next|action|choice|only|good|better|correct|most|obvious|safest|what)))",
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


def stands(rest: str, following: str, another: bool) -> bool:
    """Whether a call is left as it is by the `rest` of its line and the lines `following`.

    Args:
        rest: of the line, from the end of the call.
        following: the lines after it.
        another: whether `rest` names another action.
    """
    rest = rest[:LONGEST]
    if _BAD.match(rest) or (another and _CHOICE.search(rest)):
        return False
    return not corrected(following)


def chooses_later(text: str) -> bool:
    """Whether what is said after an action chooses another one of several by its place: "the second one is best"."""
    return _LATER.search(text) is not None


def corrected(following: str) -> bool:
    """Whether the line after an action takes it back."""
    return _CORRECTED.match(following.lstrip()[:LONGEST]) is not None


def only_spoken_of(before: str, after: str) -> bool:
    """Whether the sentence around a call denies it, or says something about it rather than doing it."""
    sentence = re.split(r"(?<!e\.g)[.!?]\s|\n", before[-LONGEST:])[-1].rstrip("`*_\"' ") + " "
    said = _DENIED.search(sentence) or _CITED.search(sentence) or _SPOKEN_OF.match(after[:LONGEST])
    return said is not None


def is_meant(before: str) -> bool:
    """Whether the sentence that an entry closes says that it is the answer; `before` is the text up to the entry."""
    sentence = re.split(r"[.!?\n]", before[-LONGEST:])[-1]
    return _MEANT.search(sentence) is not None and not _HEDGED.search(sentence)


def mentions(text: str, entries: Iterable[str]) -> bool:
    """Whether one of `entries` stands in `text`."""
    folded = text.casefold()
    return any(re.search(rf"(?<!\w){re.escape(entry.casefold())}(?!\w)", folded) for entry in entries)
