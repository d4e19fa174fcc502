"""YAML of a user's: safe, and no key of a mapping stands twice."""

from __future__ import annotations

from typing import Any

import yaml

from agentspec.importing import SpecError


class UniqueLoader(yaml.SafeLoader):
    """Safe YAML in which no key stands twice: the first would be dropped without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """As its base class.

        Raises:
            SpecError: a key that the mapping has already.
        """
        keys = [key.value for key, _ in node.value if key.tag != "tag:yaml.org,2002:merge"]
        if twice := sorted({str(key) for key in keys if keys.count(key) > 1}):
            raise SpecError(f"{', '.join(twice)} stands twice, in the mapping at line {node.start_mark.line + 1}")
        return super().construct_mapping(node, deep=deep)
