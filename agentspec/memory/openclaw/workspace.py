"""What a model edits in OpenClaw's workspace: named rules and skills, each within its budget."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from agentspec.memory.openclaw.files import Skill, one_line, rule_name, rules_of, rules_text, slug
from agentspec.tokens import clip_text


@dataclass(frozen=True)
class Edit:
    """One change of the workspace, by the name of a rule or a skill."""

    op: Literal["add", "update", "remove", "skill"]
    name: str
    text: str = ""
    description: str = ""


@dataclass(frozen=True)
class Edits:
    """The answer of a model that learns."""

    edits: list[Edit]


@dataclass(frozen=True)
class Rule:
    """A rule of a rewritten `MEMORY.md`."""

    name: str
    text: str


@dataclass
class Workspace:
    """Rules and skills, both in the order in which they were written last.

    Args:
        count: text -> tokens.
        rule_tokens: most tokens of all rules; the one written longest ago goes first.
        skill_tokens: most tokens of a skill's body.
        max_skills: most skills; the one written longest ago goes first.
    """

    count: Callable[[str], int]
    rule_tokens: int
    skill_tokens: int
    max_skills: int
    rules: dict[str, str] = field(default_factory=dict)
    skills: dict[str, Skill] = field(default_factory=dict)

    def apply(self, edit: Edit) -> bool:
        """One edit; one that says nothing, or removes what is not there, changes nothing. Whether it said something."""
        name = rule_name(edit.name)
        text = clip_text(edit.text.strip(), self.skill_tokens, self.count)
        if not name or (edit.op != "remove" and not text):
            return False
        if edit.op == "remove":
            self.rules.pop(name, None)
            self.skills.pop(slug(name), None)
        elif edit.op == "skill":
            described = clip_text(one_line(edit.description or text), self.skill_tokens // 4, self.count)
            self.skills.pop(slug(name), None)
            self.skills[slug(name)] = Skill(name, described, text)
            while len(self.skills) > self.max_skills:
                self.skills.pop(next(iter(self.skills)))
        else:
            self.write({**{n: t for n, t in self.rules.items() if n != name}, name: one_line(text)})
        return True

    def write(self, rules: Mapping[str, str]) -> None:
        """`MEMORY.md` anew, within its budget; the last rule is clipped rather than lost."""
        self.rules = dict(rules)
        while len(self.rules) > 1 and self.count(rules_text(self.rules)) > self.rule_tokens:
            self.rules.pop(next(iter(self.rules)))
        if len(self.rules) == 1:
            self.rules = {name: clip_text(text, self.rule_tokens, self.count) for name, text in self.rules.items()}

    def rules_shown(self) -> str:
        """The rules in a prompt."""
        return "\n".join(f"- {name}: {text}" for name, text in self.rules.items()) or "(none)"

    def state(self) -> tuple[str, list[dict[str, Any]]]:
        """Rules and skills as plain data."""
        return rules_text(self.rules), [asdict(skill) for skill in self.skills.values()]

    def load(self, rules: str, skills: list[dict[str, Any]]) -> None:
        """Go back to a `state`."""
        self.rules = rules_of(rules)
        self.skills = {slug(s["name"]): Skill(**s) for s in skills}
