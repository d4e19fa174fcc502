"""Prefix-tree updates: what rows share is computed once, forward and backward.

The rows of an update share long prefixes (the static prompt, a history that several rollouts have in common, the task
text before every summary). They are packed into a trie: its tokens stand side by side in one row of shape (1, N), each
with its position in its own sequence, and in every layer a node's queries look at the keys along their own path only.
Everything else in a decoder works token by token and does not notice. The log-probabilities of trained tokens are then
read off per row, so a shared token collects the gradients of all rows it belongs to: loss and gradients equal those of
separate padded rows.

Attention is registered with transformers as one more attention function (an ordinary forward falls through to SDPA), so
the model is called as usual: DDP, FSDP, PEFT and gradient checkpointing see nothing special. Logits are computed for
trained tokens only, in chunks that are recomputed in the backward pass.
"""

from __future__ import annotations

import functools
import types
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import nn
from torch.utils.checkpoint import checkpoint

from agentspec.registry import SpecError
from agentspec.tokens import shared_prefix
from trainers.logprobs import sampled_logprobs
from trainers.tree_flex import block_mask, flex_tree, subtree_ends, usable

ATTENTION = "agentspec_tree"
NODE_TOKENS = 512
"""Longest node: a longer run of tokens becomes a chain of nodes, so that few queries see keys of their future."""

HEAD_CHUNK = 1024
"""Trained tokens projected on the vocabulary at once."""


@dataclass(frozen=True)
class Node:
    """Tokens ``start .. end`` of the packed row; ``path`` holds the indices of its ancestors, root first."""

    start: int
    end: int
    path: tuple[int, ...]


@dataclass
class Tree:
    """Sequences packed into a trie.

    ``tokens`` and ``positions`` have one entry per unique token; ``places[r][p]`` is where token p of sequence r is.
    """

    tokens: list[int] = field(default_factory=list)
    positions: list[int] = field(default_factory=list)
    nodes: list[Node] = field(default_factory=list)
    places: list[list[int]] = field(default_factory=list)
    masks: dict[tuple[Any, ...], Any] = field(default_factory=dict, repr=False)

    @property
    def packing_ratio(self) -> float:
        """Tokens of all sequences per token computed."""
        return sum(map(len, self.places)) / max(1, len(self.tokens))

    @functools.cached_property
    def lengths(self) -> list[int]:
        """Tokens per node."""
        return [n.end - n.start for n in self.nodes]

    def block_mask(self, window: int, device: torch.device) -> Any:
        """FlexAttention's mask, built once per window and update."""
        key = (window, device)
        if key not in self.masks:
            paths = [n.path for n in self.nodes]
            ends = subtree_ends([n.start for n in self.nodes], [n.end for n in self.nodes], paths)
            self.masks[key] = block_mask(ends, self.positions, window, device)
        return self.masks[key]


def build_tree(sequences: Sequence[Sequence[int]], node_tokens: int = NODE_TOKENS) -> Tree:
    """Pack token sequences; equal prefixes are stored once, parents before children.

    Sequences may repeat and may be prefixes of each other.
    """
    tree = Tree(places=[[] for _ in sequences])
    order = sorted(range(len(sequences)), key=lambda i: list(sequences[i]))
    # Each entry: sequences (sorted) that agree on their first `depth` tokens, and the path that holds these.
    stack: list[tuple[list[int], int, tuple[int, ...]]] = [(order, 0, ())]
    while stack:
        group, depth, path = stack.pop()
        group = [i for i in group if len(sequences[i]) > depth]
        if not group:
            continue
        branches = _split(group, sequences, depth)
        if len(branches) > 1:
            stack += [(branch, depth, path) for branch in reversed(branches)]
            continue
        first, last = sequences[group[0]], sequences[group[-1]]
        # The group is sorted: what its first and last have in common, all have. One may end before the others.
        end = shared_prefix(first, last, depth, min(depth + node_tokens, *(len(sequences[i]) for i in group)))
        start = len(tree.tokens)
        tree.tokens += first[depth:end]
        tree.positions += range(depth, end)
        tree.nodes.append(Node(start, len(tree.tokens), path))
        for i in group:
            tree.places[i] += range(start, len(tree.tokens))
        stack.append((group, end, (*path, len(tree.nodes) - 1)))
    return tree


def _split(group: list[int], sequences: Sequence[Sequence[int]], depth: int) -> list[list[int]]:
    """Runs of ``group`` with the same token at ``depth``."""
    runs: list[list[int]] = []
    for i in group:
        if runs and sequences[runs[-1][0]][depth] == sequences[i][depth]:
            runs[-1].append(i)
        else:
            runs.append([i])
    return runs


@dataclass(frozen=True)
class Wanted:
    """Trained tokens whose log-probability is wanted, one entry per (row, position).

    ``before`` is the packed place of the token before it (whose logits decide it).
    """

    before: torch.Tensor
    tokens: torch.Tensor
    temperatures: torch.Tensor
    allowed: tuple[tuple[int, ...] | None, ...]


class TreeOutput(NamedTuple):
    """Log-probabilities (with gradient) and entropies of the wanted tokens, both (K,), float32."""

    log_probs: torch.Tensor
    entropies: torch.Tensor


def enable_tree(model: nn.Module) -> None:
    """Teach ``model`` (or the base of a PEFT model) the packed forward: ``model(..., tree=Tree, wanted=Wanted)``.

    Without these arguments its forward is the one it had. Idempotent.

    Raises:
        SpecError: an architecture the packed forward does not compute exactly (checked on a few tokens).
    """
    wrapper: Any = model
    base: Any = wrapper.get_base_model() if hasattr(model, "get_base_model") else model
    if getattr(base, "_agentspec_tree", False):
        return
    _register(base)
    _enable_head(base)
    original = base.forward

    @functools.wraps(type(base).forward)
    def forward(self: Any, *args: Any, tree: Tree | None = None, wanted: Wanted | None = None, **kwargs: Any) -> Any:
        if tree is None or wanted is None:
            return original(*args, **kwargs)
        for name in ("attention_mask", "labels", "inputs_embeds", "use_cache"):
            kwargs.pop(name, None)  # wrappers (PEFT) pass these along as None
        # A four-dimensional mask is passed on untouched: no (N, N) mask is built, and ours does not read it.
        nothing = torch.empty(1, 1, 1, 1, device=wanted.before.device)
        hidden = self.base_model(*args, attention_mask=nothing, use_cache=False, tree=tree, **kwargs)
        output: TreeOutput = self.get_output_embeddings()(hidden.last_hidden_state[0][wanted.before], wanted=wanted)
        return output

    base.forward = types.MethodType(forward, base)
    base._agentspec_tree = True
    _check(model, base)


def _enable_head(model: Any) -> None:
    """Teach the output projection to give log-probabilities: ``head(states, wanted=Wanted)``, states (K, hidden).

    The vocabulary is projected on chunk by chunk, chunks being recomputed backward, but within one call of the module:
    where weights are sharded, each call is an event that all ranks must have the same number of.
    """
    head, text = model.get_output_embeddings(), model.config.get_text_config()
    scale = float(getattr(text, "logit_scale", None) or 1.0) / float(getattr(text, "logits_scaling", None) or 1.0)
    cap = getattr(text, "final_logit_softcapping", None)
    original = head.forward

    def project(states: torch.Tensor, wanted: Wanted, start: int, stop: int) -> tuple[torch.Tensor, torch.Tensor]:
        logits = original(states) * scale if scale != 1.0 else original(states)
        if cap:
            logits = torch.tanh(logits / cap) * cap
        part = slice(start, stop)
        return sampled_logprobs(logits, wanted.tokens[part], wanted.temperatures[part], wanted.allowed[part])

    @functools.wraps(type(head).forward)
    def forward(self: Any, states: torch.Tensor, *args: Any, wanted: Wanted | None = None, **kwargs: Any) -> Any:
        if wanted is None:
            return original(states, *args, **kwargs)
        count = states.shape[0]
        results = []
        for start in range(0, count, HEAD_CHUNK):
            chunk = (states[start : start + HEAD_CHUNK], wanted, start, min(start + HEAD_CHUNK, count))
            if count > HEAD_CHUNK and torch.is_grad_enabled():
                results.append(checkpoint(project, *chunk, use_reentrant=False))
            else:
                results.append(project(*chunk))
        return TreeOutput(torch.cat([r[0] for r in results]), torch.cat([r[1].detach() for r in results]))

    head.forward = types.MethodType(forward, head)


def _register(base: Any) -> None:
    """Make the tree attention known to transformers and to every config of ``base``."""
    from transformers.masking_utils import ALL_MASK_ATTENTION_FUNCTIONS, sdpa_mask
    from transformers.modeling_utils import ALL_ATTENTION_FUNCTIONS

    if ATTENTION not in ALL_ATTENTION_FUNCTIONS:
        ALL_ATTENTION_FUNCTIONS.register(ATTENTION, tree_attention)
        ALL_MASK_ATTENTION_FUNCTIONS.register(ATTENTION, sdpa_mask)
    for module in base.modules():
        config: Any = getattr(module, "config", None)
        if hasattr(config, "_attn_implementation_internal"):
            config._attn_implementation_internal = ATTENTION


def tree_attention(
    module: nn.Module,
    query: torch.Tensor,
    key: torch.Tensor,
    value: torch.Tensor,
    attention_mask: torch.Tensor | None = None,
    scaling: float | None = None,
    sliding_window: int | None = None,
    tree: Tree | None = None,
    **kwargs: Any,
) -> tuple[torch.Tensor, None]:
    """Attention along each node's path.

    ``query`` (1, heads, N, size), ``key`` and ``value`` (1, kv heads, N, size); returns (1, N, heads, size). Without a
    tree this is transformers' SDPA. With one: node by node on a CPU, one kernel (:mod:`trainers.tree_flex`) elsewhere.
    """
    if tree is None:
        from transformers.integrations.sdpa_attention import sdpa_attention_forward

        output, _ = sdpa_attention_forward(
            module, query, key, value, attention_mask, scaling=scaling, sliding_window=sliding_window, **kwargs
        )
        return output, None
    if kwargs.get("softcap") is not None or kwargs.get("s_aux") is not None:
        raise SpecError("tree packing does not know soft-capped attention or sinks; set `packing: padded`")
    if usable(query.device, query.dtype):
        mask = tree.block_mask(sliding_window or 0, query.device)
        return flex_tree(query, key, value, mask, scaling).transpose(1, 2), None
    # One split per tensor: its backward is one concatenation, where slices would each allocate a full gradient.
    queries = query.split(tree.lengths, dim=2)
    keys, values = key.split(tree.lengths, dim=2), value.split(tree.lengths, dim=2)
    outputs = []
    for i, node in enumerate(tree.nodes):
        k = torch.cat([keys[a] for a in node.path] + [keys[i]], dim=2) if node.path else keys[i]
        v = torch.cat([values[a] for a in node.path] + [values[i]], dim=2) if node.path else values[i]
        outputs.append(_path_attention(queries[i], k, v, tree, scaling, sliding_window or 0))
    return torch.cat(outputs, dim=2).transpose(1, 2), None


def _path_attention(
    q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, tree: Tree, scaling: float | None, window: int
) -> torch.Tensor:
    """Causal attention of the last n of L positions: q (1, heads, n, size), k and v (1, kv heads, L, size)."""
    n, length = q.shape[2], k.shape[2]
    grouped = q.shape[1] != k.shape[1]
    if n == length and not 0 < window < length:
        return F.scaled_dot_product_attention(q, k, v, is_causal=True, scale=scaling, enable_gqa=grouped)
    mask = None if n == 1 and not 0 < window < length else _mask(tree, n, length, window, q)
    return F.scaled_dot_product_attention(q, k, v, attn_mask=mask, scale=scaling, enable_gqa=grouped)


def _mask(tree: Tree, n: int, length: int, window: int, like: torch.Tensor) -> torch.Tensor:
    """Additive (n, L) mask of the last n positions, built once per shape and update."""
    key = (n, length, window, like.dtype, like.device)
    if key not in tree.masks:
        here = torch.arange(length - n, length, device=like.device)[:, None]
        there = torch.arange(length, device=like.device)[None]
        hidden = there > here
        if window:
            hidden |= there <= here - window
        tree.masks[key] = torch.zeros(n, length, dtype=like.dtype, device=like.device).masked_fill_(hidden, -torch.inf)
    mask: torch.Tensor = tree.masks[key]
    return mask


def _check(model: nn.Module, base: Any) -> None:
    """Compare the packed forward with the plain one on a forked pair of sequences."""
    vocabulary = int(base.get_input_embeddings().weight.shape[0])
    pair = [
        [(7 * i * i + 3 * i + 1) % vocabulary for i in range(9)],
        [(5 * i * i + i + 2) % vocabulary for i in range(7)],
    ]
    pair[1][:4] = pair[0][:4]
    device = next(base.parameters()).device
    tree = build_tree(pair)
    trained = [(r, p) for r, s in enumerate(pair) for p in range(1, len(s))]
    training = model.training
    model.eval()
    try:
        with torch.no_grad():
            got = model(**packed_inputs(tree, device), **wanted_tokens(tree, pair, trained, device)).log_probs
            plain = [base(input_ids=torch.tensor([s], device=device), use_cache=False).logits[0].float() for s in pair]
    finally:
        model.train(training)
    expected = torch.stack([plain[r][p - 1].log_softmax(-1)[pair[r][p]] for r, p in trained])
    error = float((got - expected).abs().max())
    limit = 1e-3 if next(base.parameters()).dtype == torch.float32 else 0.3
    if not error <= limit:
        raise SpecError(
            f"packing 'tree' does not compute {type(base).__name__} exactly: log-probabilities differ by {error:.2g} "
            f"from its own forward (at most {limit:g} is rounding); set `packing: padded`"
        )


def packed_inputs(tree: Tree, device: torch.device) -> dict[str, Any]:
    """The model's token inputs for a tree: ids and positions, both (1, N)."""
    return {
        "input_ids": torch.tensor([tree.tokens], device=device),
        "position_ids": torch.tensor([tree.positions], device=device),
    }


def wanted_tokens(
    tree: Tree,
    sequences: Sequence[Sequence[int]],
    trained: Sequence[tuple[int, int]],
    device: torch.device,
    temperatures: Sequence[float] | None = None,
    allowed: Sequence[tuple[int, ...] | None] | None = None,
) -> dict[str, Any]:
    """The packed forward's own arguments for (row, position) pairs; defaults: temperature 1, no constraint."""
    wanted = Wanted(
        before=torch.tensor([tree.places[r][p - 1] for r, p in trained], dtype=torch.long, device=device),
        tokens=torch.tensor([sequences[r][p] for r, p in trained], dtype=torch.long, device=device),
        temperatures=torch.tensor(list(temperatures or [1.0] * len(trained)), device=device),
        allowed=tuple(allowed or [None] * len(trained)),
    )
    return {"tree": tree, "wanted": wanted}
