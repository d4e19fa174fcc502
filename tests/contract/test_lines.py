"""How much of each method the contract reaches: the lines of its files that run while it is played in every way."""

from __future__ import annotations

import inspect
import itertools
from pathlib import Path

import pytest

from tests.contract.harness import LENGTH, SCRIPTS, affordable, cases, example, play, scripts
from tests.contract.lines import files_of, function_lines, traced

LEAST = 0.85
"""Share of a method's lines that must run; the rest is for parameters that the played variants do not set."""


def test_lines_are_counted_exactly(tmp_path: Path) -> None:
    source = '"""Doc."""\n\nX = 1\n\n\ndef _f(a):\n    """Doc."""\n    if a:\n        return 1\n    return 2\n'
    source += "\n\ndef public():\n    return 3\n"
    path = tmp_path / "counted.py"
    path.write_text(source, encoding="utf-8")
    scope: dict = {}
    code = compile(source, str(path), "exec")
    assert function_lines(path) == {8, 9, 10} and function_lines(path, public=True) == {8, 9, 10, 14}
    with traced(path) as seen:
        import types

        module = types.FunctionType(code, scope)
        module()
        scope["_f"](1)
    assert function_lines(path) & seen[path] == {8, 9}


@pytest.mark.parametrize("module", sorted({c.path for c in cases()}))
def test_the_contract_reaches_the_method(module: str) -> None:
    mine = [c for c in affordable() if c.path == module]
    files = files_of(Path(inspect.getsourcefile(mine[0].entry.load()) or ""))
    with traced(*files) as seen:
        for case, menu in itertools.product(mine, (False, True)):
            for i, model in enumerate(SCRIPTS):
                layout = ("conversation", "snapshot")[(i + menu) % 2]
                played = play(case, scripts(case)[model], menu=menu, layout=layout, length=LENGTH)
                tested = played.module(case)
                tested.restore(tested.snapshot())
                getattr(tested, "describe", str)()
                if model == "example":
                    carried = played.agent.carry()
                    played = play(case, example(case), menu=menu, layout=layout, length=LENGTH, carried=carried)
                    played.agent.metrics()
    lines = {path: function_lines(path, public=path.name != "__init__.py" and len(files) > 1) for path in files}
    missed = {path: sorted(lines[path] - seen[path]) for path in files}
    share = 1 - sum(map(len, missed.values())) / max(1, sum(map(len, lines.values())))
    told = "; ".join(f"{path.name} {_ranges(some)}" for path, some in missed.items() if some) or "none"
    print(f"{module}: {share:.0%} of {sum(map(len, lines.values()))} lines; missed {told}")
    assert share >= LEAST, f"{module}: {share:.0%} of its lines run, not {told}; declare `small` sets"


def _ranges(lines: list[int]) -> str:
    """Line numbers as ranges: `3-5, 9`."""
    parts: list[list[int]] = []
    for line in lines:
        if parts and line == parts[-1][1] + 1:
            parts[-1][1] = line
        else:
            parts.append([line, line])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in parts)
