"""The action at the beginning of a text: a call, a menu entry, data, or a bare name, and what may stand around it.

This is what follows an `Action:` label, and what `agentspec.reading` looks for on every line where there is none.
"""

from __future__ import annotations

import json
import re

from agentspec import remarks, shapes
from agentspec.literals import Call, known_name, parse_call, scan_call
from agentspec.types import Action, ActionError, ActionSchema

MOST_CALLS = 64
"""Opening brackets that are followed in one answer."""

INPUT = re.compile(r"^[ \t*_`]*(?:action[ \t_]*input|arguments|args|parameters|input)[ \t*_`]*:[ \t*_`]*", re.I | re.M)
DRESS = re.compile(r"^(?:(?:```|~~~)[\w+\-]*\s|[\s>#*_`~\"'•\-]|\(?\d{1,2}[.):](?=\s)|(?:\[\d{1,2}\]|#\d{1,2})(?=\s))+")
CALL = re.compile(r"([A-Za-z_][\w.]{0,60})[ \t]{0,8}\(")
SPACED_CALL = re.compile(r"([A-Za-z_][\w .\-]{0,40}?)[ \t]{0,8}\(")
NEXT_CALL = re.compile(r"[\s`*_\"']*(?:,|;|&&|\+|->|→|and|then|and then)[\s`*_\"']*([A-Za-z_][\w.]{0,60})[ \t]{0,8}\(")
SQUARE = re.compile(r"([A-Za-z_][\w.\-]*)[ \t]*\[")
WORD = re.compile(r"[A-Za-z_][\w\-]*")
REMARK = re.compile(
    r"[\s`*_\"'.,;:!\])}]*(?:$|\n|;|[(\[{#–—\-/|>=\u2190-\u2bff\U0001f000-\U0001faff]|"
    r"(?:because|since|as|to|so|in order|and|then|or|if|for|instead|rather)\b|"
    r"(?<=[.!]\s)(?-i:[A-Z])(?![^\n]*(?:\w\(|\b(?:no|not|but|instead|actually|wait|then)\b)))",
    re.IGNORECASE,
)
FIELD = re.compile(r"[ \t\"'*\-]*([A-Za-z_]\w*)[\"'*]*[ \t]*[:=][ \t*]*(\S.*?)[ \t,]*")
WORDS = re.compile(r"[A-Za-z][\w\-]*(?: [\w\-]+)+")
_PROSE = re.compile(r"(?<![\"'\w])[A-Za-z]{3,}(?![\w\"']|\s*[=:])")
_PAIR = re.compile(r"^[ \t]+([A-Za-z_]\w*)[ \t]*:[ \t]*(\S.*?)[ \t]*$", re.MULTILINE)
_BLOCK = re.compile(r"\s*\n(?:[ \t]+[A-Za-z_]\w*[ \t]*:[ \t]*\S.*(?:\n|\Z))+")


def takes_lines(text: str) -> bool:
    """Whether one action is spread over several lines: a tool call in tags, or arguments on a line of their own."""
    return "<function=" in text or "<invoke " in text or INPUT.search(text) is not None


class Values:
    """Reads actions of one schema, each at the beginning of a text; every method gives `None` where there is none."""

    def __init__(self, schema: ActionSchema) -> None:
        self.schema = schema
        self.choices = {squeeze(c): c for c in schema.choices}
        self._longest_first = sorted(schema.choices, key=len, reverse=True)
        self.scans = 0

    def read(self, text: str) -> Action | ActionError | None:
        """The action at the beginning of what follows a label."""
        text = DRESS.sub("", text, count=1) if text.lstrip()[:1] not in ("{", "[") else text.lstrip()
        choice = self.choice(text, labelled=True)
        if choice is not None:
            return choice
        if text[:1] in ("{", "[", "<"):
            shape = shapes.find_shape(text, self.schema)
            if shape is not None and not text[: shape.start].strip("[< \n\t"):
                return self.read(shape.text)
        if text[:1] in ("[", "{", "<"):
            text = text[1:].lstrip()  # Action: [WAIT(60)]
            choice = self.choice(text, labelled=True)
            if choice is not None:
                return choice
        for pattern in (CALL, SPACED_CALL):
            match = pattern.match(text)
            if match is not None and (pattern is CALL or known_name(match.group(1), self.schema)):
                return self.call(text, match)
        square = SQUARE.match(text)
        if square is not None and known_name(square.group(1), self.schema):
            return self.square(text, square)
        return self.bare(text)

    def call(self, text: str, match: re.Match[str]) -> Action | ActionError | None:
        """`NAME(arguments)`, its name found by `match`."""
        self.scans += 1
        call = scan_call(text, match) if self.scans <= MOST_CALLS else None
        if call is None:
            return None
        if text[call.end : call.end + 1] in ("(", "["):
            name = known_name(call.name, self.schema) or call.name
            return ActionError("PARSE_ARGS", f"{name} has more than one list of arguments; write one call", call.text)
        action = parse_call(call, self.schema)
        known = known_name(call.name, self.schema)
        if known is None or call.text[len(call.name) :].startswith("("):
            return action
        named = call.name.isupper() or "_" in call.name
        if named and call.arguments.strip() and not self.schema.actions[known].parameters:
            return Action(known, text=f"{known}()")  # FORWARD (two cells): an action and a remark about it
        prose = isinstance(action, ActionError) or _PROSE.search(call.arguments)
        return action if named or not prose else None  # Left (a wall): none

    def calls_in(self, text: str) -> list[tuple[Action, int, int]]:
        """The calls anywhere in a text: action, beginning and end of each."""
        found: list[tuple[Action, int, int]] = []
        for match in CALL.finditer(text):
            if known_name(match.group(1), self.schema) and self.scans < MOST_CALLS:
                action = self.call(text, match)
                whole = scan_call(text, match)
                if isinstance(action, Action) and whole is not None:
                    found.append((action, match.start(), whole.end))
        return found

    def entries_in(self, text: str) -> list[tuple[Action, int, int]]:
        """The menu entries in a text, the longest at each place: action, beginning and end of each."""
        found: list[tuple[Action, int, int]] = []
        for choice in self._longest_first:
            for match in re.finditer(rf"(?<!\w){re.escape(choice)}(?!\w)", text, re.IGNORECASE):
                if len(found) >= MOST_CALLS:
                    break
                if not any(s < match.end() and match.start() < e for _, s, e in found):
                    found.append((Action(choice, text=choice), match.start(), match.end()))
        return sorted(found, key=lambda f: f[1])

    def other(self, text: str, action: Action) -> bool:
        """Whether `text` holds a call of another action, or of the same one with other arguments."""
        return any(not same_call(found, action) for found, _, _ in self.calls_in(text))

    def only_calls(self, rest: str) -> bool:
        """Whether `rest` of a line is nothing but further calls, as in `TURN_LEFT(), FORWARD(), FORWARD()`."""
        found = False
        while self.scans < MOST_CALLS:
            match = NEXT_CALL.match(rest)
            if match is None or known_name(match.group(1), self.schema) is None:
                break
            self.scans += 1
            call = scan_call(rest, match)
            if call is None:
                return False
            rest, found = rest[call.end :], True
        return found and not rest.strip(" \t`*_\"'.;])}")

    def square(self, text: str, match: re.Match[str]) -> Action | ActionError | None:
        """`NAME[args]`, as in ReAct's own prompts; one list for an action that takes one parameter."""
        call = scan_call(text, match)
        if call is None:
            return None
        name = known_name(call.name, self.schema) or call.name
        inner = call.arguments
        if "," in inner and len(self.schema.actions[name].parameters) == 1:
            inner = f"[{inner}]"
        return parse_call(Call(name, inner, f"{name}({inner})", call.end), self.schema)

    def bare(self, text: str) -> Action | ActionError | None:  # noqa: PLR0911  # one line per form
        """A name without brackets, its arguments perhaps on a line of their own."""
        match = WORD.match(text)
        word = match.group() if match else ""
        # Beside a menu "wait" is an entry, or a word, and no name.
        named = not self.schema.choices or word.isupper() or "_" in word
        name = known_name(word, self.schema) if named else None
        if match is None or name is None:
            return None
        given = INPUT.search(text, match.end())
        if given is not None and not text[match.end() : given.start()].strip(" \t\n*_`\"'.,"):
            value = (
                DRESS.sub("", text[given.end() :], count=1)
                if text[given.end() :][:1] not in "{["
                else text[given.end() :]
            )
            block = _BLOCK.match(text, given.end())
            if block is not None:
                return self.read(f"{name}({', '.join(f'{k}={v}' for k, v in _PAIR.findall(block[0]))})")
            data = shapes.find_shape(f'{{"action": "{name}", "args": ' + value.rstrip("`\n ") + "}", self.schema)
            line = first_line(value).strip("`\"'* ")
            inner = data.text if data is not None else f"{name}({line})"
            return self.read(inner)
        if not REMARK.match(text, match.end()):
            return None
        fields = self._fields(text[match.end() :], name)
        if fields:
            return self.read(f"{name}({', '.join(fields)})")
        spec = self.schema.actions[name]
        missing = [p for p, parameter in spec.parameters.items() if parameter.required]
        if missing:
            problem = f"{name} needs {', '.join(missing)}; write {spec.example or name}"
            return ActionError("PARSE_ARGS", problem, name)
        return Action(name, text=f"{name}()")

    def _fields(self, rest: str, name: str) -> list[str]:
        """Arguments given as lines `name: value` below an action's name, up to the first line that is none."""
        known = {p.casefold(): p for p in self.schema.actions[name].parameters}
        first, *lines = rest.splitlines() or [""]
        fields = []
        for line in lines if not first.strip("`*_\"' ,") else []:
            match = FIELD.fullmatch(line)
            if match is None or match.group(1).casefold() not in known:
                break
            value = json.dumps(match.group(2)) if WORDS.fullmatch(match.group(2)) else match.group(2)
            fields.append(f"{known[match.group(1).casefold()]}={value}")
        return fields

    def choice(self, text: str, *, labelled: bool = False) -> Action | None:
        """The longest menu entry that `text` begins with, a remark at most after it (`agentspec.remarks`)."""
        line = first_line(text)
        folded = line.casefold()
        whole = self.choices.get(squeeze(line))
        found = whole or next((c for c in self._longest_first if folded.startswith(c.casefold())), None)
        if found is None:
            return None
        rest = "" if whole else line[len(found) :]
        if rest and not REMARK.match(line, len(found)) and not remarks.gives_reason(rest):
            return None
        following = text[text.find(line) + len(line) :] if line else ""
        others = [c for c in self.schema.choices if c != found]
        meant = remarks.is_remark(rest, following, others, labelled=labelled)
        return Action(found, text=found) if meant else None


def same_call(one: Action, other: Action) -> bool:
    """Whether two actions are the same as they were written, apart from spelling."""
    return (one.name, one.args, one.kwargs) == (other.name, other.args, other.kwargs)


def squeeze(text: str) -> str:
    """`text` for comparison with a menu entry: without dress, case, and closing signs."""
    return " ".join(DRESS.sub("", text).split()).strip(" \t`*_\"'.,;:!?").casefold().replace(" %", "%")


def first_line(text: str) -> str:
    """The first line that is not empty."""
    sign = re.search(r"\S", text)
    if sign is None:
        return ""
    start = text.rfind("\n", 0, sign.start()) + 1
    end = text.find("\n", sign.end())
    return (text[start:] if end < 0 else text[start:end]).rstrip("\r")
