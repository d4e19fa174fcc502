"""Dollars per token. Prices change: a run records the table it used, and a YAML file can replace it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from agentspec.types import Usage


@dataclass(frozen=True)
class Price:
    """Dollars per million input, cached-input and output tokens."""

    input: float = 0.0
    output: float = 0.0
    cached: float | None = None


@dataclass(frozen=True)
class Prices:
    """Price by model name; the longest name that is a prefix of the model's counts. Unknown (local) models cost 0."""

    table: Mapping[str, Price] = field(default_factory=dict)

    @classmethod
    def from_yaml(cls, path: str | Path) -> Prices:
        """Read ``{model: {input: $/M, output: $/M, cached: $/M}}``.

        Raises:
            ValueError: the file is not such a mapping.
        """
        return cls.from_data(yaml.safe_load(Path(path).read_text(encoding="utf-8")), str(path))

    @classmethod
    def from_data(cls, data: Any, where: str) -> Prices:
        """From parsed YAML; `where` it stands begins the messages.

        Raises:
            ValueError: not such a mapping.
        """
        if not isinstance(data, dict) or not all(isinstance(v, dict) for v in data.values()):
            raise ValueError(f"{where}: expected a mapping of model name to {{input, output, cached}} in $ per million")
        for name, value in data.items():
            unknown = [key for key in value if key not in Price.__dataclass_fields__]
            given = [v for key, v in value.items() if (key, v) != ("cached", None)]
            if unknown or not all(isinstance(v, int | float) and v >= 0 for v in given):
                raise ValueError(
                    f"{where}: {name} is {value}; expected input, output and cached in $ per million tokens"
                )
        return cls({str(name): Price(**value) for name, value in data.items()})

    def price(self, model: str) -> Price | None:
        """The price of ``model``; ``None`` for one that has none."""
        names = [n for n in self.table if model.startswith(n)]
        return self.table[max(names, key=len)] if names else None

    def cost(self, model: str, usage: Usage) -> float:
        """Dollars of ``usage`` by ``model``."""
        price = self.price(model)
        if price is None:
            return 0.0
        cached = price.input if price.cached is None else price.cached
        fresh = usage.input_tokens - usage.cached_tokens
        return (fresh * price.input + usage.cached_tokens * cached + usage.output_tokens * price.output) / 1e6
