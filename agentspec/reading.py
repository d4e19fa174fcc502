"""One tolerant reader of answers: what a chat model wrote -> the one action it means, never raising.

In this order:

1. Reasoning blocks (`<think>`, `[THINK]`, harmony channels, ...), closed or cut off, are removed; nothing in them
counts.
2. An action given as data (JSON, a tool call) counts where it comes before any `Action:` line.
3. The *first* `Action:` line counts, in any case and dress, its call on the same or a later line. Whatever follows it,
an
   invented observation or a second turn, is dropped.
4. Without a label: a line that is a call (or a menu entry), numbered, quoted or with a remark after it.
5. A single call in a sentence, where it is marked as code or closes the answer, and is not negated.

Everything else is an `ActionError` whose message tells the model what to write; an answer that was cut off before its
action is told apart (`TRUNCATED`). The text of an error never reads as an action itself, so that whoever passes it on
to an environment executes nothing.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from agentspec import literals, shapes
from agentspec.literals import Call, known_name, parse_call, scan_call
from agentspec.types import Action, ActionError, ActionSchema

MOST_CALLS = 64
"""Opening brackets that are followed in one answer."""

_BLOCKS = "think|thinking|thoughts?|reasoning|reason|reflection|analysis|scratchpad|inner_monologue"
_BLOCK = re.compile(rf"<(/?)(?:{_BLOCKS})\b[^<>]*>|\[(/?)THINK\]|◁(/?)think▷", re.IGNORECASE)
_FINAL = re.compile(r"<\|channel\|>\s*final\s*<\|message\|>")
_TOOL = re.compile(r"<\|channel\|>\s*commentary\s+(?=to=)")
_TOKEN = re.compile(r"<\|[^<>|]{1,40}\|>|</s>|<end_of_turn>|<eos>")
_AS_LABEL = re.compile(r"<(action|answer|final_answer|command)>(.*?)(?:</\1>|$)", re.IGNORECASE | re.DOTALL)
_BOXED = re.compile(r"\\boxed\{([^{}]*)\}")
_SIGNS = str.maketrans(
    {"“": '"', "”": '"', "‘": "'", "’": "'", "（": "(", "）": ")", "：": ":", "−": "-", "\u00a0": " ", "\u200b": ""}
)

_LABEL = re.compile(
    r"^[ \t>#*_\-•\"'`{]*(?:\(?\d+[.):][ \t]*)?[\"'*_` \t]*"
    r"(?:(?:final|next|chosen|my|the|best|selected|recommended|proposed)[ \t]+)*"
    r"(?:action|answer|command)(?:[ \t]+(?:call|taken|to take|is))?(?:[ \t]*\d+)?[ \t\"'*_`]*"
    r"(?:[:=][ \t*_]*|(?<=[*_#])[ \t]*$|(?<=action)[ \t]*$)",
    re.IGNORECASE | re.MULTILINE,
)
_HEADING = re.compile(r"^[ \t]*#+[ \t]*(?:final |next )?action[ \t:]*$", re.IGNORECASE | re.MULTILINE)
_MID_LABEL = re.compile(r"\b(?:final |next )?action[ \t*_`]*:", re.IGNORECASE)
_INPUT = re.compile(r"^[ \t*_`]*(?:action[ \t_]*input|arguments|args|parameters|input)[ \t*_`]*:[ \t*_`]*", re.I | re.M)
_TURN = re.compile(
    r"^\W{0,4}(?:observation|user|human|environment|system|result)[ \t]*\d*[ \t*_]*:", re.I | re.MULTILINE
)
_THOUGHT = re.compile(r"^[ \t>#*_\-]*(?:thoughts?|reasoning|plan|analysis|rationale)[ \t]*\d*[ \t*_]*:", re.IGNORECASE)
_FENCE = re.compile(r"^[ \t]*(?:```|~~~)[\w+\-]*[ \t]*", re.MULTILINE)
_DRESS = re.compile(r"^(?:(?:```|~~~)[\w+\-]*\s|[\s>#*_`~\"'•\-]|\(?\d{1,2}[.):](?=\s))+")
_BULLET = re.compile(r"^[ \t>]*(?:[*•\-]|\(?\d{1,2}[.):])[ \t]+")
_CALL = re.compile(r"([A-Za-z_][\w.]*)[ \t]*\(")
_SPACED_CALL = re.compile(r"([A-Za-z_][\w .\-]{0,40}?)[ \t]*\(")
_SQUARE = re.compile(r"([A-Za-z_][\w.\-]*)[ \t]*\[")
_WORD = re.compile(r"[A-Za-z_][\w\-]*")
_REMARK = re.compile(
    r"[\s`*_\"'.,;:!\])}]*(?:$|\n|;|[(\[{#–—\-/|>=]|"
    r"(?:because|since|as|to|so|in order|and|then|or|if|for)\b)",
    re.IGNORECASE,
)
_NEGATED = re.compile(
    r"(?:\bnot|n't|\bnever|\bavoid(?:ing)?|\binstead of|\brather than|\bwithout|\bcannot)\W+(?:\w+\W+)?$", re.I
)


@dataclass(frozen=True)
class Reading:
    """What an answer says: its action (or why there is none), and the thought before it.

    `explicit` tells an answer that names an action (by a label or as data) from one that merely thinks.
    """

    action: Action | ActionError
    thought: str = ""
    explicit: bool = False


def visible(text: str) -> tuple[str, bool]:
    """`text` without reasoning blocks, and whether one of them was never closed."""
    if "<|channel|>" in text:
        parts = _FINAL.split(text)
        tool = _TOOL.search(text)
        if len(parts) == 1 and tool is None:
            return "", True
        text = parts[-1] if len(parts) > 1 else text[tool.end() :] if tool else ""
    kept: list[str] = []
    depth = at = 0
    for match in _BLOCK.finditer(text):
        closes = "/" in (match.group(1) or "", match.group(2) or "", match.group(3) or "")
        if not closes:
            if not depth:
                kept.append(text[at : match.start()])
            depth += 1
        elif depth:
            depth -= 1
        else:
            kept = []  # opened by the chat template: all before it was reasoning
        at = match.end()
    if not depth:
        kept.append(text[at:])
    return _TOKEN.sub("", "".join(kept)).strip(), depth > 0


def labelled(line: str) -> bool:
    """Whether a line says `Action:` and what."""
    label = _LABEL.match(line)
    return label is not None and bool(line[label.end() :].strip(" `*"))


def takes_lines(text: str) -> bool:
    """Whether one action is spread over several lines: a tool call in tags, or arguments on a line of their own."""
    return "<function=" in text or "<invoke " in text or _INPUT.search(text) is not None


def _plain(text: str) -> str:
    """Signs and marks of prose made plain: curly quotes, escaped underscores, tags and boxes around an answer."""
    text = text.translate(_SIGNS).replace("\\_", "_")
    text = _AS_LABEL.sub(lambda m: f"\nAction: {m.group(2).strip()}\n", text)
    return _BOXED.sub(lambda m: f"\nAction: {m.group(1)}\n", text).strip()


def read(text: str, schema: ActionSchema, *, cut: bool = False) -> Reading:
    """Read an answer; `cut` says that it ended because its room was used up."""
    shown, open_block = visible(text)
    plain = _plain(shown)
    reading = _Reader(plain, schema).read() if plain else Reading(_no_action("", schema))
    if isinstance(reading.action, Action):
        return reading
    error = reading.action
    if (cut or open_block) and error.code not in ("PARSE_UNKNOWN", "PARSE_ARGS"):
        message = "the answer was cut off before its action; write less, and the action first"
        error = ActionError("TRUNCATED", message, error.text)
    return Reading(
        ActionError(error.code, error.message, _inert(error.text, schema)), reading.thought, reading.explicit
    )


def _inert(text: str, schema: ActionSchema) -> str:
    """The beginning of `text`, unless that would read as an action."""
    text = text[:200]
    plain = _plain(visible(text)[0])
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
        turn = next((m.start() for m in _TURN.finditer(text) if _after_thought(text[: m.start()])), len(text))
        self.text = text[:turn]
        self.schema = schema
        self.choices = {_squeeze(c): c for c in schema.choices}
        self.scans = 0

    def read(self) -> Reading:
        choice = self.choices.get(_squeeze(self.text))
        if choice is not None:
            return Reading(Action(choice, text=choice), explicit=True)
        label = _HEADING.search(self.text) or _LABEL.search(self.text)
        shape = shapes.find_shape(self.text, self.schema)
        if shape is not None and (label is None or shape.start <= label.end()):
            thought = shape.thought or _thought(self.text[: min(shape.start, label.start() if label else shape.start)])
            return Reading(self._value(shape.text) or self._nothing(shape.text), thought, explicit=True)
        if label is not None:
            thought = _thought(self.text[: label.start()])
            value = self.text[label.end() :]
            return Reading(self._value(value) or self._nothing(_first_line(value)), thought, explicit=True)
        found = self._line()
        if found is None:
            inline = _MID_LABEL.search(self.text)
            meant = self._value(self.text[inline.end() :]) if inline else None
            found = (meant, inline.start()) if inline and meant else None
        action, at = found or (self._mention(), len(self.text))
        if action is None:
            return Reading(self._nothing(self.text), _thought(self.text))
        return Reading(action, _thought(self.text[:at]))

    def _nothing(self, text: str) -> ActionError:
        return _no_action(text.strip(), self.schema)

    def _value(self, text: str) -> Action | ActionError | None:
        """The action at the beginning of what follows a label."""
        text = _DRESS.sub("", text, count=1) if text.lstrip()[:1] not in ("{", "[") else text.lstrip()
        choice = self._choice_at(text)
        if choice is not None:
            return choice
        if text[:1] in ("{", "[", "<"):
            shape = shapes.find_shape(text, self.schema)
            if shape is not None and not text[: shape.start].strip("[< \n\t"):
                return self._value(shape.text)
        for pattern in (_CALL, _SPACED_CALL):
            match = pattern.match(text)
            if match is not None and (pattern is _CALL or known_name(match.group(1), self.schema)):
                return self._call(text, match)
        square = _SQUARE.match(text)
        if square is not None and known_name(square.group(1), self.schema):
            return self._square(text, square)
        return self._bare(text)

    def _call(self, text: str, match: re.Match[str]) -> Action | ActionError | None:
        self.scans += 1
        call = scan_call(text, match) if self.scans <= MOST_CALLS else None
        if call is None:
            return None
        if text[call.end : call.end + 1] in ("(", "["):
            name = known_name(call.name, self.schema) or call.name
            return ActionError("PARSE_ARGS", f"{name} has more than one list of arguments; write one call", call.text)
        return parse_call(call, self.schema)

    def _square(self, text: str, match: re.Match[str]) -> Action | ActionError | None:
        """`NAME[args]`, as in ReAct's own prompts; one list for an action that takes one parameter."""
        call = scan_call(text, match)
        if call is None:
            return None
        name = known_name(call.name, self.schema) or call.name
        inner = call.arguments
        if "," in inner and len(self.schema.actions[name].parameters) == 1:
            inner = f"[{inner}]"
        return parse_call(Call(name, inner, f"{name}({inner})", call.end), self.schema)

    def _bare(self, text: str) -> Action | ActionError | None:
        """A name without brackets, its arguments perhaps on a line of their own."""
        match = _WORD.match(text)
        name = known_name(match.group(), self.schema) if match else None
        if match is None or name is None:
            return None
        given = _INPUT.search(text, match.end())
        if given is not None and not text[match.end() : given.start()].strip(" \t\n*_`\"'.,"):
            value = (
                _DRESS.sub("", text[given.end() :], count=1)
                if text[given.end() :][:1] not in "{["
                else text[given.end() :]
            )
            data = shapes.find_shape(f'{{"action": "{name}", "args": ' + value.rstrip("`\n ") + "}", self.schema)
            line = _first_line(value).strip("`\"'* ")
            inner = data.text if data is not None else f"{name}({line})"
            return self._value(inner)
        if not _REMARK.match(text, match.end()):
            return None
        spec = self.schema.actions[name]
        missing = [p for p, parameter in spec.parameters.items() if parameter.required]
        if missing:
            problem = f"{name} needs {', '.join(missing)}; write {spec.example or name}"
            return ActionError("PARSE_ARGS", problem, name)
        return Action(name, text=f"{name}()")

    def _choice_at(self, text: str) -> Action | None:
        """The longest menu entry that `text` begins with, a remark at most after it."""
        line = _first_line(text)
        squeezed = _squeeze(line)
        if squeezed in self.choices:
            return Action(self.choices[squeezed], text=self.choices[squeezed])
        folded = line.casefold()
        for choice in sorted(self.schema.choices, key=len, reverse=True):
            if folded.startswith(choice.casefold()) and _REMARK.match(line, len(choice)):
                return Action(choice, text=choice)
        return None

    def _line(self) -> tuple[Action | ActionError, int] | None:
        """The first line that is an action, and where it begins; an error where a list leaves open which is meant."""
        found: list[tuple[Action | ActionError, int, bool]] = []
        at, prose_after = 0, False
        for line in self.text.splitlines(keepends=True):
            start, at = at, at + len(line)
            if found and _TURN.match(line):
                break
            action = None if _THOUGHT.match(line) else self._action_line(self.text[start:], line)
            if action is not None:
                found.append((action, start, bool(_BULLET.match(line))))
                prose_after = False
            else:
                prose_after = prose_after or bool(_DRESS.sub("", line).strip())
            if found and not found[0][2]:
                break  # not a list: the first counts
        actions = {a.text for a, _, _ in found if isinstance(a, Action)}
        if len(actions) > 1 and prose_after and all(bullet for _, _, bullet in found):
            problem = f"the answer lists several actions ({'; '.join(sorted(actions)[:3])}); answer with one of them"
            return ActionError("PARSE_AMBIGUOUS", problem, self.text), found[0][1]
        return (found[0][0], found[0][1]) if found else None

    def _action_line(self, text: str, line: str) -> Action | ActionError | None:
        """The action that `text` begins with if its first line, `line`, is nothing but an action and a remark."""
        dressed = _DRESS.match(text)
        bare = text[dressed.end() :] if dressed and dressed.end() < len(line) else text
        choice = self._choice_at(bare)
        if choice is not None:
            return choice
        match = _CALL.match(bare) or _SPACED_CALL.match(bare)
        if match is not None:
            action = self._call(bare, match)
            whole = scan_call(bare, match)
            known = known_name(match.group(1), self.schema) is not None
            if action is None or whole is None or not _REMARK.match(bare, whole.end):
                # `MOVE(1)(2)` is an action gone wrong, "I think (perhaps) so" is none.
                return action if known and isinstance(action, ActionError) else None
            alone = _CALL.match(bare) is not None and not bare[whole.end :].strip(" \t\n`*.;\"'")
            return action if known or alone else None
        word = _WORD.match(bare)
        if (
            word is not None
            and known_name(word.group(), self.schema)
            and not _first_line(bare[word.end() :]).strip(" `*.;\"'")
        ):
            return self._bare(bare) if word.group().isupper() or "_" in word.group() else None
        square = _SQUARE.match(bare)
        known = square is not None and known_name(square.group(1), self.schema) is not None
        return self._square(bare, square) if known and square is not None else None

    def _mention(self) -> Action | None:
        """A single action in prose, marked as code or closing the answer, not negated and not merely thought of."""
        turn = _TURN.search(self.text)
        text = self.text[: turn.start()] if turn and turn.start() else self.text
        text = "".join("" if _THOUGHT.match(line) else line for line in text.splitlines(keepends=True))
        found: list[tuple[Action, int, int]] = []
        for match in _CALL.finditer(text):
            if known_name(match.group(1), self.schema) and self.scans < MOST_CALLS:
                action = self._call(text, match)
                whole = scan_call(text, match)
                if isinstance(action, Action) and whole is not None:
                    found.append((action, match.start(), whole.end))
        if not found:
            found = self._mentioned_choices(text)
        if len({repr((a.name, a.args, a.kwargs)) for a, _, _ in found}) != 1:
            return None
        action, start, end = found[-1]
        marked = text[start - 1 : start] in ("`", "*", '"', "'") and text[end : end + 1] in ("`", "*", '"', "'")
        closing = not text[end:].strip(" \t\n.!;:*`\"')]}")
        return action if (marked or closing) and not _NEGATED.search(text[:start].rstrip("`*\"' ") + " ") else None

    def _mentioned_choices(self, text: str) -> list[tuple[Action, int, int]]:
        """Menu entries in prose, the longest at each place."""
        found: list[tuple[Action, int, int]] = []
        for choice in sorted(self.schema.choices, key=len, reverse=True):
            for match in re.finditer(rf"(?<!\w){re.escape(choice)}(?!\w)", text, re.IGNORECASE):
                if not any(s < match.end() and match.start() < e for _, s, e in found):
                    found.append((Action(choice, text=choice), match.start(), match.end()))
        return sorted(found, key=lambda f: f[1])


def _squeeze(text: str) -> str:
    """`text` for comparison with a menu entry: without dress, case, and closing signs."""
    return " ".join(_DRESS.sub("", text).split()).strip(" \t`*_\"'.,;:!?").casefold()


def _first_line(text: str) -> str:
    return next((line for line in text.splitlines() if line.strip()), "")


def _after_thought(text: str) -> bool:
    return any(_THOUGHT.match(line) or _LABEL.match(line) for line in text.splitlines())


def _thought(text: str) -> str:
    """What was said before the action, without labels and fences."""
    text = _FENCE.sub("", text)
    lines = [_THOUGHT.sub("", line).strip() if _THOUGHT.match(line) else line.rstrip() for line in text.splitlines()]
    return "\n".join(line for line in lines if line.strip(" `*#-{")).strip()
