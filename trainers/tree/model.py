"""A model that knows the packed forward: `model(..., tree=Tree, wanted=Wanted)` gives log-probabilities.

Logits are computed for trained tokens only, in chunks that are recomputed in the backward pass. The model is called as
usual: DDP, FSDP, PEFT and gradient checkpointing see nothing special.
"""

from __future__ import annotations

import functools
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import nn
from torch.utils.checkpoint import checkpoint

from agentspec.registry import SpecError
from trainers.frozen import language_model, replaced
from trainers.logprobs import sampled_logprobs
from trainers.tree.attention import register
from trainers.tree.trie import Tree, build_tree

HEAD_CHUNK = 1024
"""Trained tokens projected on the vocabulary at once."""


@dataclass(frozen=True)
class Wanted:
    """Trained tokens whose log-probability is wanted, one entry per (row, position).

    `before` is the place, in a forward's inputs flattened, of the token before it (whose logits decide it).
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
    """Teach `model` (or the base of a PEFT model) the packed forward: `model(..., tree=Tree, wanted=Wanted)`.

    Without these arguments its forward is the one it had. Idempotent.

    Raises:
        SpecError: an architecture the packed forward does not compute exactly (checked on a few tokens).
    """
    base = language_model(model)
    if getattr(base, "_agentspec_tree", False):
        return
    register(base)
    _enable_head(base)
    original = base.forward

    @functools.wraps(type(base).forward)
    def forward(self: Any, *args: Any, tree: Tree | None = None, wanted: Wanted | None = None, **kwargs: Any) -> Any:
        if tree is None or wanted is None:
            return original(*args, **kwargs)
        for name in ("labels", "inputs_embeds", "use_cache"):
            kwargs.pop(name, None)  # wrappers (PEFT) pass these along as None
        with last_layer_at(self.base_model, wanted.before):
            hidden = self.base_model(*args, use_cache=False, tree=tree, **kwargs)
        output: TreeOutput = self.get_output_embeddings()(hidden.last_hidden_state[0][wanted.before], wanted=wanted)
        return output

    base.forward = types.MethodType(forward, base)
    base._agentspec_tree = True
    _check(model, base)


@contextmanager
def last_layer_at(decoder: Any, places: torch.Tensor) -> Iterator[None]:
    """Inside, the last layer computes queries and everything from attention on at `places` of the packed row only.

    Nothing is read elsewhere, where zeros stand. Where the layer is recomputed backward, all of it is computed.
    """
    last = (getattr(decoder, "layers", None) or [None])[-1]
    if last is None or getattr(last, "gradient_checkpointing", False):
        yield
        return
    index = places.unique()
    attention, mlp = getattr(last, "self_attn", None), getattr(last, "mlp", None)
    modules = [getattr(attention, "q_proj", None), getattr(attention, "o_proj", None)]
    modules += [mlp] if hasattr(mlp, "down_proj") else []  # of a mixture of experts, all is computed
    forwards: dict[nn.Module, Callable[..., Any]] = {
        m: functools.partial(_at, m.forward, index) for m in modules if m is not None
    }
    if attention is not None:
        forwards[attention] = functools.partial(attention.forward, asked=index)  # reaches `tree_attention`
    with replaced(forwards):
        yield


def _at(forward: Callable[..., torch.Tensor], index: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """`forward` of x (1, N, in) at the places of `index`, zeros elsewhere: (1, N, out)."""
    out = forward(x.index_select(1, index))
    return out.new_zeros(1, x.shape[1], out.shape[-1]).index_copy(1, index, out)


def _enable_head(model: Any) -> None:
    """Teach the output projection to give log-probabilities: `head(states, wanted=Wanted)`, states (K, hidden).

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
    before, tokens = zip(*((tree.places[r][p - 1], pair[r][p]) for r, p in trained), strict=True)
    ones = torch.ones(len(trained), device=device)
    wanted = Wanted(torch.tensor(before).to(device), torch.tensor(tokens).to(device), ones, (None,) * len(trained))
    training = model.training
    model.eval()
    try:
        with torch.no_grad():
            plain = [base(input_ids=torch.tensor([s], device=device), use_cache=False).logits[0].float() for s in pair]
            got = model(**packed_inputs(tree, device), wanted=wanted).log_probs
    except Exception as raised:  # whatever an architecture raises that lays out its forward in another way
        raise SpecError(
            f"packing 'tree' cannot run {type(base).__name__} ({type(raised).__name__}: {raised}); "
            "set `packing: padded`"
        ) from raised
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
    """The inputs for a tree, of a model or of its decoder: ids and positions, both (1, N), and the tree itself."""
    return {
        "input_ids": torch.tensor([tree.tokens], device=device),
        "position_ids": torch.tensor([tree.positions], device=device),
        # A four-dimensional mask is passed on untouched: no (N, N) mask is built, and ours does not read it.
        "attention_mask": torch.empty(1, 1, 1, 1, device=device),
        "tree": tree,
    }
