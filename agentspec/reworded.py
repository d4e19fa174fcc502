"""A well-formed answer with other content: the shape of a declared example, its free texts replaced by given sentences.

Texts of several words are free; single words (operations, names, ids) and numbers are what the asker's reader expects
and stay. See `agentspec.declaration.Purpose`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Any

NOTHING = "Nothing yet."
_LABEL = re.compile(r"^([A-Z][\w ]*: )")


def reworded(example: str, sentences: Sequence[str], request: str = "") -> str:
    """The example with `sentences` in the place of its free texts, all of them, in their order.

    - JSON keeps its form: each free text gets a share of the sentences, a list of free texts holds its share; items of
      a list that get none are left out, but for the first.
    - A list ("- ...") has a line per sentence; lines around it (`<tags>`) stay where `request` asks for them.
    - Labelled lines ("Goal: ...") keep their labels, those that get none are left out. Any other text is the sentences.

    >>> reworded('{"edits": [{"op": "add", "text": "It is so."}]}', ["The door is open."])
    '{"edits": [{"op": "add", "text": "The door is open."}]}'
    >>> reworded("- One thing.", ["The door is open.", "Next: go."])
    '- The door is open.\\n- Next: go.'
    """
    try:
        data = json.loads(example)
    except ValueError:
        return _text(example.splitlines(), sentences, request)
    return json.dumps(_filled(data, _shares(sentences, _places(data))), ensure_ascii=False)


def without(example: str, field: str) -> str:
    """The example without the items of its lists that have a value in `field`.

    >>> without('{"edits": [{"id": 0, "text": "a b"}, {"id": null, "text": "c d"}]}', "id")
    '{"edits": [{"id": null, "text": "c d"}]}'
    """
    return json.dumps(_kept(json.loads(example), field), ensure_ascii=False) if field else example


def _kept(value: Any, field: str) -> Any:
    if isinstance(value, dict):
        return {name: _kept(one, field) for name, one in value.items()}
    if isinstance(value, list):
        return [_kept(v, field) for v in value if not (isinstance(v, dict) and v.get(field) is not None)]
    return value


def _text(lines: list[str], sentences: Sequence[str], request: str) -> str:
    listed = [i for i, line in enumerate(lines) if line.startswith("- ")]
    if listed:
        around = [[line for line in part if line in request] for part in (lines[: listed[0]], lines[listed[-1] + 1 :])]
        return "\n".join([*around[0], *(f"- {one}" for one in sentences or [NOTHING]), *around[1]])
    labels = [found[1] for line in lines if (found := _LABEL.match(line))]
    if len(labels) == len(lines) > 1:
        pairs = [*zip(labels, _shares(sentences, len(lines)), strict=True)]
        return "\n".join(f"{label}{_joined(share)}" for i, (label, share) in enumerate(pairs) if share or not i)
    return _joined(sentences)


def _free(value: Any) -> bool:
    return isinstance(value, str) and " " in value.strip()


def _list(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(map(_free, value))


def _places(data: Any) -> int:
    """How many free texts and lists of free texts there are."""
    if _free(data) or _list(data):
        return 1
    inner = data.values() if isinstance(data, dict) else data if isinstance(data, list) else ()
    return sum(map(_places, inner))


def _shares(sentences: Sequence[str], places: int) -> list[Sequence[str]]:
    """The sentences in as many parts, as even as can be; where they do not suffice, the later ones are empty."""
    number = len(sentences)
    if number <= places:
        return [sentences[i : i + 1] for i in range(places)]
    return [sentences[i * number // places : (i + 1) * number // places] for i in range(places)]


def _filled(data: Any, shares: list[Sequence[str]]) -> Any:
    """The value with its places filled from the front of `shares`, which are taken away."""
    if _list(data):
        return list(shares.pop(0))
    if _free(data):
        return _joined(shares.pop(0))
    if isinstance(data, dict):
        return {key: _filled(value, shares) for key, value in data.items()}
    if not isinstance(data, list):
        return data
    found: list[Any] = []
    for value in data:
        places = _places(value)
        if places and found and not any(shares[:places]):
            del shares[:places]
        else:
            found.append(_filled(value, shares))
    return found


def _joined(sentences: Sequence[str]) -> str:
    return " ".join(sentences) or NOTHING
