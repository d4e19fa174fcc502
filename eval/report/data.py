"""The rows of an evaluation as flat tables: CSV and Parquet."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

Row = Mapping[str, Any]


def _flat(rows: Sequence[Row]) -> list[dict[str, Any]]:
    flat = []
    for row in rows:
        plain = {k: v for k, v in row.items() if not isinstance(v, Mapping | list)}
        plain |= {f"agent_{k}": v for k, v in row.get("agent", {}).items()}
        flat.append(plain | {"options": json.dumps(row.get("options", {}), sort_keys=True)})
    return flat


def as_csv(rows: Sequence[Row]) -> str:
    """The rows as CSV."""
    flat = _flat(rows)
    names = list(dict.fromkeys(name for row in flat for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return text.getvalue()


def as_parquet(rows: Sequence[Row]) -> bytes:
    """The rows as Parquet.

    Raises:
        ImportError: pyarrow is not installed.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    flat = _flat(rows)
    names: Iterable[str] = dict.fromkeys(name for row in flat for name in row)
    table = pa.table({name: _column([row.get(name) for row in flat]) for name in names})
    buffer = io.BytesIO()
    pq.write_table(table, buffer)
    return buffer.getvalue()


def _column(values: list[Any]) -> Any:
    """One type per column: text where kinds are mixed."""
    import pyarrow as pa

    try:
        return pa.array(values)
    except (pa.ArrowInvalid, pa.ArrowTypeError):
        return pa.array([None if value is None else str(value) for value in values])
