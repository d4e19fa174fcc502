"""File names made of labels."""

from __future__ import annotations

import re

from agentspec.files import digest


def slug(name: str) -> str:
    """A file name that no two labels share.

    >>> slug("react+base"), slug("a/b")
    ('react+base', 'a_b-c14cdd')
    """
    plain = re.sub(r"[^\w.+-]+", "_", name).strip("._") or "x"
    return plain if plain == name else f"{plain}-{digest(name)[:6]}"
