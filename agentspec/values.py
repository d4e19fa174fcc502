"""The action at the beginning of a text: a call, a menu entry, data, or a bare name, and what may stand around it.

This is what follows an `Action:` label, and what `agentspec.reading` looks for on every line where there is none.
"""

from __future__ import annotations

import re

from agentspec import remarks, shapes
from agentspec.literals import Call, known_name, parse_call, scan_call
from agentspec.types import Action, ActionError, ActionSchema

MOST_CALLS = 64
"""Opening brackets that are followed in one answer."""

INPUT = re.compile(r"^[ \t*_`]*(?:action[ \t_]*input|arguments|args|parameters|input)[ \t*_`]*:[ \t*_`]*", re.I | re.M)
DRESS = re.compile(r"^(?:(?:```|~~~)[\w+\-]*\s|[\s>#*_`~\"'•\-]|\(?\d{1,2}[.):](?=\s))+")
CALL = re.compile(r"([A-Za-z_][\w.]{0,60})[ \t]{0,8}\(")
SPACED_CALL = re.compile(r"([A-Za-z_][\w .\-]{0,40}?)[ \t]{0,8}\(")
SQUARE = re.compile(r"([A-Za-z_][\w.\-]*)[ \t]*\[")
WORD = re.compile(r"[A-Za-z_][\w\-]*")
REMARK = re.compile(
    r"[\s`*_\"'.,;:!\])}]*(?:$|\n|;|[(\[{#–—\-/|>=\u2190-\u2bff\U0001f000-\U0001faff]|"
    r"(?:because|since|as|to|so|in order|and|then|or|if|for)\b|"
    r"(?<=[.!]\s)(?-i:[A-Z])(?![^\n]*(?:\w\(|\b(?:no|not|but|instead|actually|wait|then)\b)))",
    re.IGNORECASE,
)
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
        return parse_call(call, self.schema)

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

    def bare(self, text: str) -> Action | ActionError | None:
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
        spec = self.schema.actions[name]
        missing = [p for p, parameter in spec.parameters.items() if parameter.required]
        if missing:
            problem = f"{name} needs {', '.join(missing)}; write {spec.example or name}"
            return ActionError("PARSE_ARGS", problem, name)
        return Action(name, text=f"{name}()")

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


def squeeze(text: str) -> str:
    """`text` for comparison with a menu entry: without dress, case, and closing signs."""
    return " ".join(DRESS.sub("", text).split()).strip(" \t`*_\"'.,;:!?").casefold()


def first_line(text: str) -> str:
    """The first line that is not empty."""
    sign = re.search(r"\S", text)
    if sign is None:
        return ""
    start = text.rfind("\n", 0, sign.start()) + 1
    end = text.find("\n", sign.end())
    return (text[start:] if end < 0 else text[start:end]).rstrip("\r")
