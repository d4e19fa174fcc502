"""The workspace: a tree of Markdown files in memory, and what its files hold.

Nothing here touches the disk but `export`, which writes below the folder it is given and nowhere else: a path that is
absolute, climbs, or leads through a link out of the folder is refused. Names that a model chose become path parts only
through `slug`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import yaml

RULE = re.compile(r"^- \*\*(?P<name>[^*\n]+)\*\*: (?P<text>.+)$", re.MULTILINE)
FRONT = re.compile(r"\A---\n(?P<head>.*?)\n---\n?(?P<body>.*)\Z", re.DOTALL)
NAME_LENGTH = 60
PATH_LENGTH = 200


def one_line(text: str) -> str:
    """The text without line breaks and runs of spaces."""
    return " ".join(text.split())


def rule_name(name: str) -> str:
    """A name as it may stand in `**name**`: one line, no asterisks, at most 60 characters."""
    return one_line(name.replace("*", " "))[:NAME_LENGTH].strip()


def slug(name: str) -> str:
    """A name as one part of a path: lower-case ASCII letters, digits and hyphens.

    >>> slug("../Hot food FIRST!")
    'hot-food-first'
    """
    return re.sub(r"[^a-z0-9]+", "-", name.casefold()).strip("-")[:NAME_LENGTH].strip("-") or "unnamed"


def checked_path(path: str) -> str:
    """The path, if it stays below the workspace.

    Raises:
        ValueError: it is empty, too long, absolute, or climbs.
    """
    parts = PurePosixPath(path).parts
    bad = (
        not parts
        or len(path) > PATH_LENGTH
        or path.startswith("/")
        or ".." in parts
        or re.search(r"[\\:\x00-\x1f]", path)
    )
    if bad:
        raise ValueError(f"{path!r} is no path of a workspace; expected a relative one without '..', '\\' and ':'")
    return str(PurePosixPath(path))


class FileTree:
    """Path -> text, sorted by path."""

    def __init__(self, files: Mapping[str, str] | None = None) -> None:
        self._files: dict[str, str] = {}
        for path, text in (files or {}).items():
            self.write(path, text)

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self._files))

    def __len__(self) -> int:
        return len(self._files)

    def read(self, path: str) -> str:
        """The text of a file; of one that is not there `""`."""
        return self._files.get(path, "")

    def write(self, path: str, text: str) -> None:
        """Write a file.

        Raises:
            ValueError: see `checked_path`.
        """
        self._files[checked_path(path)] = text

    def export(self, folder: str | Path) -> list[Path]:
        """Write every file below `folder`, which is made if need be; files that it has besides stay.

        Raises:
            ValueError: a file would land outside of `folder`, through a link in it.
        """
        root = Path(folder)
        root.mkdir(parents=True, exist_ok=True)
        inside = root.resolve()
        targets = [(root / path, self._files[path]) for path in self]
        for target, _ in targets:
            if not target.resolve().is_relative_to(inside):
                raise ValueError(f"{target} leads out of {root}; remove the link, or choose another folder")
        for target, text in targets:
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(text, encoding="utf-8")
        return [target for target, _ in targets]


def rules_text(rules: Mapping[str, str]) -> str:
    """`MEMORY.md` of named rules, in order."""
    lines = [f"- **{name}**: {text}" for name, text in rules.items()]
    return "\n".join(["# Memory", "", *lines]) + "\n"


def rules_of(text: str) -> dict[str, str]:
    """The named rules of a `MEMORY.md`, in order."""
    return {match["name"].strip(): match["text"].strip() for match in RULE.finditer(text)}


@dataclass(frozen=True)
class Skill:
    """One `SKILL.md`: its name and description are always listed, its body is read when it is chosen."""

    name: str
    description: str
    body: str

    @property
    def path(self) -> str:
        """Where it stands in the workspace."""
        return f"skills/{slug(self.name)}/SKILL.md"

    def text(self) -> str:
        """The file: front matter and body."""
        head = yaml.safe_dump({"name": self.name, "description": self.description}, sort_keys=False, allow_unicode=True)
        return f"---\n{head}---\n{self.body}\n"

    @classmethod
    def parse(cls, text: str) -> Skill:
        """Read a `SKILL.md`.

        Raises:
            ValueError: no front matter, or one without name and description.
        """
        found = FRONT.match(text.replace("\r\n", "\n"))
        try:
            head = yaml.safe_load(found["head"]) if found else None
        except yaml.YAMLError as error:
            raise ValueError(f"the front matter of a skill cannot be read: {error}") from error
        if not found or not isinstance(head, dict) or not head.get("name") or not head.get("description"):
            raise ValueError("a skill begins with front matter, '---', that has a name and a description")
        return cls(rule_name(str(head["name"])), one_line(str(head["description"])), found["body"].strip())


def skills_in(folder: str | Path) -> list[Skill]:
    """The skills of a folder: its `*/SKILL.md`, sorted by path.

    Raises:
        ValueError: no such folder, or a file that is no skill, with its path.
    """
    root = Path(folder)
    if not root.is_dir():
        raise ValueError(f"skills: {root} is no folder")
    found = []
    for path in sorted(root.glob("*/SKILL.md")):
        try:
            found.append(Skill.parse(path.read_text(encoding="utf-8")))
        except ValueError as error:
            raise ValueError(f"skills: {path}: {error}") from error
    return found
