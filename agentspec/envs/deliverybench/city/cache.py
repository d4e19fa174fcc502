"""Compiled cities on disk and in memory.

Compiling a city takes up to a second, most of it all-pairs shortest paths, and a training run opens the same few
cities in many processes. The result is kept in one `.npz` file per city, named by a hash of the two map files and of
the format version: a changed map or a newer compiler never meets an old file. Files are written beside their final name
and moved there in one step, so concurrent processes see a whole file or none; a file that cannot be read is compiled
anew.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import sys
import zipfile
import zlib
from collections.abc import Iterable
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from agentspec.envs.deliverybench.city.compile import STREET_KINDS, Poi
from agentspec.envs.deliverybench.city.graph import Edge, Graph, all_pairs
from agentspec.envs.deliverybench.city.routing import Network, Table
from agentspec.files import write_atomic

CACHE_VARIABLE = "AGENTSPEC_CACHE"
FORMAT = 1

_UNREADABLE = (OSError, EOFError, ValueError, KeyError, IndexError, TypeError, zipfile.BadZipFile, zlib.error)

Compiled = tuple[tuple[Poi, ...], Network, Network]


def cache_dir() -> Path:
    """The folder compiled cities are kept in: `$AGENTSPEC_CACHE`, else `agentspec` in the user's cache folder."""
    chosen = os.environ.get(CACHE_VARIABLE)
    if chosen:
        return Path(chosen).expanduser()
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA")
        return Path(base) / "agentspec" / "cache" if base else Path.home() / ".agentspec" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "agentspec"
    base = os.environ.get("XDG_CACHE_HOME")
    return Path(base) / "agentspec" if base else Path.home() / ".cache" / "agentspec"


def content_key(documents: Iterable[bytes]) -> str:
    """A name for what the map files say: 32 hex digits over the format version and all documents."""
    digest = hashlib.sha256(f"agentspec-city-{FORMAT}".encode())
    for document in documents:
        digest.update(len(document).to_bytes(8, "little"))
        digest.update(document)
    return digest.hexdigest()[:32]


def read_compiled(key: str) -> Compiled | None:
    """The compiled city of that key, None if it is not in the cache or its file is damaged."""
    path = _path(key)
    try:
        with np.load(path, allow_pickle=False) as archive:
            meta = json.loads(archive["meta"].tobytes().decode("utf-8"))
            pois = tuple(_poi(row) for row in meta["pois"])
            walk = _network(meta["walk"], (archive["walk_dist"], archive["walk_before"]), STREET_KINDS)
            drive = _network(meta["drive"], (archive["drive_dist"], archive["drive_before"]), None)
    except _UNREADABLE:
        return None
    return pois, walk, drive


def write_compiled(key: str, compiled: Compiled) -> bool:
    """Keep a compiled city; False where the cache folder cannot be written (the city then is compiled each time)."""
    pois, walk, drive = compiled
    meta = {"pois": [astuple(poi) for poi in pois], "walk": _document(walk.graph), "drive": _document(drive.graph)}
    arrays: dict[str, npt.NDArray[Any]] = {
        "meta": np.frombuffer(json.dumps(meta).encode("utf-8"), dtype=np.uint8),
    }
    for name, network in (("walk", walk), ("drive", drive)):
        arrays[f"{name}_dist"], arrays[f"{name}_before"] = network.table or all_pairs(network.graph)
    try:
        write_atomic(_path(key), _archive(arrays))
    except OSError:
        return False
    return True


def _path(key: str) -> Path:
    return cache_dir() / "deliverybench" / f"city-{key}.npz"


def _archive(arrays: dict[str, npt.NDArray[Any]]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def _document(graph: Graph) -> dict[str, Any]:
    return {
        "points": graph.points,
        "kinds": graph.kinds,
        "names": graph.names,
        "edges": [astuple(edge) for edge in graph.edges],
    }


def _network(document: dict[str, Any], table: Table, kinds: frozenset[str] | None) -> Network:
    dist, before = table
    points = tuple((float(x), float(y)) for x, y in document["points"])
    edges = tuple(Edge(*row) for row in document["edges"])
    if dist.shape != (len(points), len(points)) or before.shape != dist.shape:
        raise ValueError(f"got tables {dist.shape} and {before.shape} for {len(points)} nodes")
    graph = Graph.build(points, tuple(document["kinds"]), tuple(document["names"]), edges)
    return Network(graph, kinds, table)


def _poi(row: list[Any]) -> Poi:
    values: list[Any] = [tuple(value) if isinstance(value, list) else value for value in row]
    return Poi(*values)
