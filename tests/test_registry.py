"""How a name finds a class: files of the package, paths, imports; and what a name that finds none says."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from agentspec.declaration import Declaration
from agentspec.importing import import_name
from agentspec.registry import REGISTRY, Entry, Registry, SpecError, import_modules, kind_of, snake_case
from agentspec.spec import AgentSpec, ModuleSpec

SHEET = """
from agentspec.declaration import Declaration
from agentspec.memory.base import BaseMemory

class {name}(BaseMemory):
    declaration = Declaration("from elsewhere", aliases=("scrap",))
"""


def test_a_name_is_found_without_importing_the_other_methods() -> None:
    code = (
        "import sys; from agentspec.registry import REGISTRY; REGISTRY.get('reasoning', 'direct').load();"
        "print(sorted(m for m in sys.modules if m.startswith('agentspec.reasoning.')))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "agentspec.reasoning.direct" in out and "lats" not in out and "mad" not in out


@pytest.mark.parametrize(
    ("kind", "name", "message"),
    [
        ("reasoning", "reakt", "did you mean react"),
        ("memory", "simpel", "did you mean simple"),
        ("reasoning", "common", "unknown reasoning 'common'"),
        ("memory", "../base", "unknown memory"),
        ("memory", "nowhere.module:Thing", "no module 'nowhere.module'"),
        ("memory", "agentspec.memory.base:BaesMemory", "agentspec.memory.base'; did you mean BaseMemory"),
        ("reasoning", "agentspec.memory.base:BaseMemory", "is a memory module; the spec names it as reasoning"),
        ("memory", "agentspec.types:Recall", "is no module; a module has the methods of one kind"),
        ("mood", "x", "unknown kind of module 'mood'"),
    ],
)
def test_names_that_find_nothing_say_what_there_is(kind: str, name: str, message: str) -> None:
    with pytest.raises(SpecError, match=message.replace(".", r"\.")):
        REGISTRY.get(kind, name)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("agentspec.trajectory", "expected package.module:name"),
        (":Trajectory", "expected package.module:name"),
        ("agentspec.nowhere:thing", "no module 'agentspec.nowhere' to import"),
        ("agentspec.trajectory:Trajectorie", "there is no 'Trajectorie' in the module 'agentspec.trajectory'; did you"),
    ],
)
def test_a_name_of_something_in_a_module(target: str, message: str) -> None:
    assert import_name("agentspec.importing:import_name") is import_name
    with pytest.raises(SpecError, match=f"^reward {target!r}: {message}"):
        import_name(target, "reward")


def test_a_method_with_parts_is_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "made_up" / "memory" / "parted"
    folder.mkdir(parents=True)
    for place in (folder.parent.parent, folder.parent):
        (place / "__init__.py").write_text("")
    (folder / "prompts.py").write_text("ASK = 'What is worth keeping?'")
    (folder / "module.py").write_text(
        "from agentspec.memory.none import NoMemory\nfrom agentspec.declaration import Declaration\n"
        "class Parted(NoMemory):\n    declaration = Declaration('has parts')\n"
    )
    (folder / "__init__.py").write_text("from made_up.memory.parted.module import NoMemory, Parted\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    entry = Registry("made_up").get("memory", "parted")
    assert entry.load().__name__ == "Parted" and entry.summary == "has parts"
    assert list(Registry("made_up").all("memory")) == ["parted"]  # what it only imports is not its own


def test_an_alias_is_the_module_it_stands_for() -> None:
    assert REGISTRY.get("memory", "simple").target == "agentspec.memory.base:BaseMemory"
    assert AgentSpec.from_data({"memory": "simple"}).memory == ModuleSpec("base")
    assert REGISTRY.get("reasoning", "random").load().__name__ == "RandomLegal"  # two methods in one file


def test_a_class_by_its_path() -> None:
    spec = AgentSpec.from_data({"memory": {"name": "agentspec.memory.base:BaseMemory", "window": 2}})
    assert spec.memory.short == "base_memory" and spec.label == "direct+base_memory"
    assert AgentSpec.from_data(spec.to_data()) == spec


def test_modules_are_brought_in_by_file_and_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for stem, name in (("sheet_by_file", "FileSheet"), ("sheet_by_name", "NameSheet")):
        (tmp_path / f"{stem}.py").write_text(SHEET.format(name=name), encoding="utf-8")
    try:
        import_modules(["./sheet_by_file.py", "sheet_by_name"])
        import_modules(["./sheet_by_file.py"])  # twice is once
        assert REGISTRY.get("memory", "file_sheet").summary == "from elsewhere"
        assert {"file_sheet", "name_sheet"} <= set(REGISTRY.all("memory"))
        spec = AgentSpec.from_data({"imports": "sheet_by_name", "memory": {"name": "name_sheet", "window": 1}})
        assert spec.imports == ("sheet_by_name",) and AgentSpec.from_data(spec.to_data()) == spec
    finally:
        for name in ("file_sheet", "name_sheet"):
            REGISTRY.unregister("memory", name)
        for stem in ("sheet_by_file", "sheet_by_name"):
            sys.modules.pop(stem, None)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (None, "no module 'brought_in' to import"),
        ("1 / 0", "ZeroDivisionError"),
        ("import nope_nope", "nope_nope"),
        ("import brought", "failed: ModuleNotFoundError: No module named 'brought'"),  # how its own name begins
    ],
)
def test_what_cannot_be_imported_says_why(tmp_path: Path, monkeypatch, source: str | None, message: str) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    if source is not None:
        (tmp_path / "brought_in.py").write_text(source, encoding="utf-8")
    for name in ("brought_in", "./brought_in.py"):
        with pytest.raises(SpecError, match=message if source or name[0] != "." else "no file brought_in.py"):
            import_modules([name])
    sys.modules.pop("brought_in", None)


def test_a_file_does_not_hide_a_module_that_exists(tmp_path: Path) -> None:
    (tmp_path / "json.py").write_text("", encoding="utf-8")
    with pytest.raises(SpecError, match="would hide the module 'json'"):
        import_modules([str(tmp_path / "json.py")])


def test_names_cannot_be_taken_over() -> None:
    registry = Registry()
    registry.register("memory", "a", Entry("m:A"))
    registry.register("memory", "a", Entry("m:A", Declaration("again")))
    with pytest.raises(SpecError, match="already registered"):
        registry.register("memory", "a", Entry("m:B"))


@pytest.mark.parametrize(
    ("name", "expected"), [("CheatSheet", "cheat_sheet"), ("AMem", "a_mem"), ("MIRIX", "mirix"), ("Mem0", "mem0")]
)
def test_snake_case(name: str, expected: str) -> None:
    assert snake_case(name) == expected


def test_every_class_is_of_the_kind_it_is_listed_under() -> None:
    for kind in ("perception", "memory", "reasoning", "reflection"):
        for entry in REGISTRY.all(kind).values():
            assert kind_of(entry.load()) == kind and entry.summary


def test_a_file_that_is_no_python_is_not_imported(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("pass\n", encoding="utf-8")
    with pytest.raises(SpecError, match=r"no file .*notes\.txt to import; give the path of a Python file"):
        import_modules([str(tmp_path / "notes.txt")])
