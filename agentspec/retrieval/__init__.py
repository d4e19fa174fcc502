"""What memories are built on: find by meaning, by words, by both, and along a small graph.

- `VectorIndex`: cosine similarity over a NumPy matrix, exact, ties in order of insertion.
- `Lexical`: BM25 with FTS5's words and scores, over postings in memory.
- `reciprocal_rank_fusion`, `weighted_fusion`: one ranking out of several.
- `Graph`: adjacency, components, label propagation, ego-splitting, neighbourhoods.

All are deterministic, hold nothing outside the process and belong to one memory instance.
"""

from agentspec.retrieval.fusion import min_max, mmr, reciprocal_rank_fusion, weighted_fusion
from agentspec.retrieval.graph import Graph, ego_split, label_propagation, replica_graph
from agentspec.retrieval.lexical import Lexical
from agentspec.retrieval.vector import VectorIndex, top_rows

__all__ = [
    "Graph",
    "Lexical",
    "VectorIndex",
    "ego_split",
    "label_propagation",
    "min_max",
    "mmr",
    "reciprocal_rank_fusion",
    "replica_graph",
    "top_rows",
    "weighted_fusion",
]
