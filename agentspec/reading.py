"""One tolerant reader of answers: what a chat model wrote -> the one action it means, never raising.

In this order:

1. Reasoning blocks (`<think>`, `[THINK]`, harmony channels, ...), closed or cut off, are removed
   (`agentspec.visible`); nothing in them counts.
2. An action given as data (JSON, a tool call; `agentspec.shapes`) counts where it comes before any `Action:` line.
3. The *first* `Action:` line counts, in any case and dress, its call on the same or a later line (`agentspec.values`).
   Whatever follows it, an invented observation or a second turn, is dropped.
4. Without a label: what "Decision:" or the like introduces; a line that is a call (or a menu entry), numbered, quoted
   or with a remark after it; of a list of several, the one that stands by itself below it.
5. A single call in a sentence, marked as code or closing the answer, and neither denied nor only spoken of.

Where the answer leaves open which of several actions is meant, or takes it back (`agentspec.remarks`), it holds none.

Everything else is an `ActionError` whose message tells the model what to write; an answer that was cut off before its
action is told apart (`TRUNCATED`). The text of an error never reads as an action itself, so that whoever passes it on
to an environment executes nothing.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from agentspec import literals, shapes
from agentspec.literals import known_name, parse_call, scan_call
from agentspec.remarks import chooses_later, corrected, is_meant, only_spoken_of, stands
from agentspec.types import Action, ActionError, ActionSchema
from agentspec.values import CALL, DRESS, REMARK, SPACED_CALL, SQUARE, WORD, Values, first_line, same_call, squeeze
from agentspec.visible import bounded, undressed, visible

_LABEL = re.compile(
    r"^[ \t>#*_\-•\"'`{]{0,40}(?:\(?\d{1,4}[.):][ \t]*)?[\"'*_` \t]{0,40}"
    r"(?:(?:final|next|chosen|my|the|best|selected|recommended|proposed)[ \t]+)*"
    r"(?:action|answer|command)(?:[ \t]+(?:call|taken|to take|is))?(?:[ \t]*\d+)?[ \t\"'*_`]*"
    r"(?:[:=][ \t*_]*|(?<=[*_#])[ \t]*$|(?<=action)[ \t]*$)",
    re.IGNORECASE | re.MULTILINE,
)
_HEADING = re.compile(r"^[ \t]*#+[ \t]*(?:final |next )?action[ \t:]*$", re.IGNORECASE | re.MULTILINE)
_MID_LABEL = re.compile(r"\b(?:final |next )?action[ \t*_`]*:", re.IGNORECASE)
_FINAL = re.compile(r"^[ \t>#*_\-•]{0,40}final[ \t]+(?:action|answer)[ \t*_`]*:[ \t*_]*", re.IGNORECASE | re.MULTILINE)
_TURN = re.compile(
    r"^\W{0,4}(?:observation|user|human|environment|system|result)[ \t]*\d*[ \t*_]*:", re.I | re.MULTILINE
)
_THOUGHT = re.compile(r"^[ \t>#*_\-]*(?:thoughts?|reasoning|plan|analysis|rationale)[ \t]*\d*[ \t*_]*:", re.IGNORECASE)
_FENCE = re.compile(r"^[ \t]*(?:```|~~~)[\w+\-]*[ \t]*", re.MULTILINE)
_BULLET = re.compile(r"^[ \t>]*(?:[*•\-]|\(?\d{1,2}[.):])[ \t]+")
_BRANCH = re.compile(r"^[ \t]*(?:if|elif|else|while|for)\b[^\n]*:[ \t]*$", re.MULTILINE)
_WEAK_LABEL = re.compile(
    r"^[ \t>#*_\-•]{0,40}(?:(?:final|next|chosen|my|the|best|selected|recommended|first)[ \t]+)*"
    r"(?:decision|choice|pick|move|step(?: now)?|conclusion|verdict|aktion|acción|ação|действие|动作|行动|操作|行動)"
    r"[ \t*_`]*:[ \t*_]*",
    re.IGNORECASE | re.MULTILINE,
)
"""What may introduce an action, if one follows."""


@dataclass(frozen=True)
class Reading:
    """What an answer says: its action (or why there is none), and the thought before it.

    `explicit` tells an answer that names an action (by a label or as data) from one that merely thinks.
    """

    action: Action | ActionError
    thought: str = ""
    explicit: bool = False


def labelled(line: str) -> bool:
    """Whether a line says `Action:` and what."""
    label = _LABEL.match(line)
    return label is not None and bool(line[label.end() :].strip(" `*"))


def read(text: str, schema: ActionSchema, *, cut: bool = False) -> Reading:
    """Read an answer; `cut` says that it ended because its room was used up."""
    plain_action = _bare(text, schema)
    if plain_action is not None:
        return Reading(plain_action, explicit=text in schema.choices)
    shown, open_block = visible(text)
    plain = undressed(bounded(shown))
    reading = _Reader(plain, schema).read() if plain else Reading(_no_action("", schema))
    if isinstance(reading.action, Action):
        plan = shapes.plan_of(bounded(shown))
        return replace(reading, action=replace(reading.action, plan=plan)) if plan else reading
    error = reading.action
    if (cut or open_block) and error.code not in ("PARSE_UNKNOWN", "PARSE_ARGS"):
        message = "the answer was cut off before its action; write less, and the action first"
        error = ActionError("TRUNCATED", message, error.text)
    return Reading(
        ActionError(error.code, error.message, _inert(error.text, schema)), reading.thought, reading.explicit
    )


def _bare(text: str, schema: ActionSchema) -> Action | None:
    """The action of an answer that is one and nothing else, which needs no further reading."""
    if text in schema.choices:
        return Action(text, text=text)
    match = CALL.match(text)
    if match is None or match.group(1) not in schema.actions or not text.isascii() or re.search(r"[<\\\n]|THINK", text):
        return None
    call = scan_call(text, match)
    action = parse_call(call, schema) if call is not None and call.end == len(text) else None
    return action if isinstance(action, Action) else None


def _inert(text: str, schema: ActionSchema) -> str:
    """The beginning of `text`, unless that would read as an action."""
    text = text[:200]
    plain = undressed(visible(text)[0])
    return "" if plain and isinstance(_Reader(plain, schema).read().action, Action) else text


def _no_action(text: str, schema: ActionSchema) -> ActionError:
    """The error of an answer that holds no action."""
    if len(text) > literals.MAX_LENGTH:
        return ActionError(
            "PARSE_TOO_LONG", f"the answer has {len(text)} characters and no action; write one action only", text
        )
    first = (text.splitlines() or [""])[0][:60]
    if schema.choices:
        shown = "; ".join(schema.choices[:6])
        problem = f"{first!r} is not one of the listed actions; answer with one of them, word for word: {shown}"
    else:
        names = ", ".join(schema.actions)
        problem = f"{first!r} is not an action; answer with one call NAME(arguments), NAME one of: {names}"
    return ActionError("PARSE_NOT_CALL", problem, text)


class _Reader:
    """Reads one plain text; the methods are the rules of the module's docstring, in order."""

    def __init__(self, text: str, schema: ActionSchema) -> None:
        spoken = _first_spoken(text)
        turn = next((m.start() for m in _TURN.finditer(text) if m.start() > spoken), len(text))
        self.text = text[:turn]
        self.schema = schema
        self.values = Values(schema)

    def read(self) -> Reading:
        choice = self.values.choices.get(squeeze(self.text))
        if choice is not None:
            return Reading(Action(choice, text=choice), explicit=True)
        label = _HEADING.search(self.text) or _LABEL.search(self.text)
        shape = shapes.find_shape(self.text, self.schema, loose=label is None)
        if shape is not None and (label is None or shape.start <= label.end()):
            thought = shape.thought or _thought(self.text[: min(shape.start, label.start() if label else shape.start)])
            later = chooses_later(self.text[shape.start :].rpartition("]")[2])
            said = self._several() if later else self.values.read(shape.text)
            return Reading(said or self._nothing(shape.text), thought, explicit=True)
        if label is not None:
            thought = _thought(self.text[: label.start()])
            value = self.text[label.end() :]
            said = self.values.read(value)
            if isinstance(said, Action) and not (self._stands(value, said) and self._is_final(value, said)):
                said = self._several()
            return Reading(said or self._nothing(first_line(value)), thought, explicit=True)
        self.text = shapes.without_data(self.text)
        found = self._decided() or self._line()
        if found is None:
            found = self._inline()
        action: Action | ActionError | None
        action, at = found or (self._mention(), len(self.text))
        if isinstance(action, Action) and chooses_later(self.text[at + len(action.text) :]):
            action = self._several()
        if action is None:
            return Reading(self._nothing(self.text), _thought(self.text))
        return Reading(action, _thought(self.text[:at]))

    def _stands(self, text: str, action: Action) -> bool:
        """Whether what follows `action` in `text` leaves it as it is."""
        at = text.casefold().find(action.text.casefold())
        rest, _, following = text[at + len(action.text) :].partition("\n") if at >= 0 else ("", "", "")
        if action.text in self.schema.choices:
            return not corrected(following)
        return stands(rest, following, self.values.other(rest, action))

    def _is_final(self, text: str, action: Action) -> bool:
        """Whether no "Final action:" after `action` names another one."""
        final = _FINAL.search(text)
        said = self.values.read(text[final.end() :]) if final else None
        return not isinstance(said, Action) or same_call(said, action)

    def _inline(self) -> tuple[Action | ActionError, int] | None:
        """What stands behind "action:" in the middle of a line, unless it is the last, a wrong or another such one."""
        labels = [m for m in _MID_LABEL.finditer(self.text) if not only_spoken_of(self.text[: m.end() - 1], "")]
        meant = self.values.read(self.text[labels[0].end() :]) if labels else None
        return (meant, labels[0].start()) if meant else None

    def _several(self, what: str = "leaves open which action is meant") -> ActionError:
        return ActionError("PARSE_AMBIGUOUS", f"the answer {what}; answer with one of them", self.text)

    def _decided(self) -> tuple[Action | ActionError, int] | None:
        """The action of the last line that says "Decision:" or the like and gives one."""
        for label in reversed(list(_WEAK_LABEL.finditer(self.text))[-8:]):
            value = self.text[label.end() :]
            action = self.values.read(value) if value[:1] not in ("", "\n") else None
            if isinstance(action, Action) and self._stands(value, action):
                return action, label.start()
        return None

    def _nothing(self, text: str) -> ActionError:
        return _no_action(text.strip(), self.schema)

    def _line(self) -> tuple[Action | ActionError, int] | None:
        """The first line that is an action, and where it begins; an error where a list leaves open which is meant."""
        found: list[tuple[Action | ActionError, int, bool]] = []
        at, prose_after = 0, False
        branches = _BRANCH.search(self.text) is not None
        for line in self.text.splitlines(keepends=True):
            start, at = at, at + len(line)
            if found and _TURN.match(line):
                break
            window = self.text[start : at + literals.MAX_LENGTH]
            action = None if not line.strip() or _THOUGHT.match(line) else self._action_line(window, line)
            if action is not None:
                found.append((action, start, branches or bool(_BULLET.match(line))))
                prose_after = prose_after and not found[-1][2]
            else:
                prose_after = prose_after or bool(DRESS.sub("", line).strip())
            if found and not found[-1][2]:
                break  # not a list: the first counts
        return self._listed(found, prose_after=prose_after or branches) if found else None

    def _listed(
        self, found: list[tuple[Action | ActionError, int, bool]], *, prose_after: bool
    ) -> tuple[Action | ActionError, int]:
        """The first of (action, where, whether in a list); or what stands by itself below a list of several."""
        actions, listed = ({a.text for a, _, i in found if (i or any_) and isinstance(a, Action)} for any_ in (1, 0))
        alone = [(a, start) for a, start, in_list in found if not in_list]
        if alone and len(listed) > 1:
            return alone[0]
        if len(actions) > 1 and (prose_after or (alone and listed)):
            return self._several(f"lists several actions ({'; '.join(sorted(actions)[:3])})"), found[0][1]
        return found[0][0], found[0][1]

    def _action_line(self, text: str, line: str) -> Action | ActionError | None:
        """The action that `text` begins with if its first line, `line`, is nothing but an action and a remark."""
        dressed = DRESS.match(line)
        bare = text[dressed.end() :] if dressed and dressed.end() < len(line) else text
        choice = self.values.choice(bare)
        if choice is not None:
            return choice
        bare = bare[1:] if bare[:1] == "[" and CALL.match(bare, 1) else bare
        match = CALL.match(bare) or SPACED_CALL.match(bare)
        if match is not None:
            action = self.values.call(bare, match)
            whole = scan_call(bare, match) if action is not None else None
            known = known_name(match.group(1), self.schema) is not None
            rest, _, following = bare[whole.end :].partition("\n") if whole is not None else ("", "", "")
            if isinstance(action, Action) and not stands(rest, following, self.values.other(rest, action)):
                return None
            remark = whole is not None and (REMARK.match(bare, whole.end) or self.values.only_calls(rest))
            if action is None or whole is None or not remark:
                # `MOVE(1)(2)` is an action gone wrong, "I think (perhaps) so" is none.
                return action if known and isinstance(action, ActionError) else None
            alone = CALL.match(bare) is not None and not bare[whole.end :].strip(" \t\n`*.;\"'")
            return action if known or alone else None
        word = WORD.match(bare)
        if (
            word is not None
            and known_name(word.group(), self.schema)
            and not first_line(bare[word.end() :]).strip(" `*.;\"'")
        ):
            return self.values.bare(bare) if word.group().isupper() or "_" in word.group() else None
        square = SQUARE.match(bare)
        known = square is not None and known_name(square.group(1), self.schema) is not None
        return self.values.square(bare, square) if known and square is not None else None

    def _mention(self) -> Action | None:
        """A single action in prose, marked as code or closing the answer, not negated and not merely thought of."""
        turn = _TURN.search(self.text)
        text = self.text[: turn.start()] if turn and turn.start() else self.text
        text = "".join("" if _THOUGHT.match(line) else line for line in text.splitlines(keepends=True))
        found = self.values.calls_in(text)
        spoken = not found
        found = found or self.values.entries_in(text)
        if len({repr((a.name, a.args, a.kwargs)) for a, _, _ in found}) != 1:
            return None
        action, start, end = found[-1]
        marked = text[start - 1 : start] in ("`", "*", '"', "'") and text[end : end + 1] in ("`", "*", '"', "'")
        closing = not text[end:].strip(" \t\n.!;:*`\"')]}") and (not spoken or is_meant(text[:start]))
        return action if (marked or closing) and not only_spoken_of(text[:start], text[end:]) else None


def _first_spoken(text: str) -> int:
    """Where the first thought or `Action:` line begins; the end of the text if none does."""
    at = 0
    for line in text.splitlines(keepends=True):
        if _THOUGHT.match(line) or _LABEL.match(line.rstrip("\n")):
            return at
        at += len(line)
    return len(text)


def _thought(text: str) -> str:
    """What was said before the action, without labels and fences."""
    text = _FENCE.sub("", text)
    lines = [_THOUGHT.sub("", line).strip() if _THOUGHT.match(line) else line.rstrip() for line in text.splitlines()]
    return "\n".join(line for line in lines if line.strip(" `*#-{")).strip()
