"""Where each token of a row comes from: proof that what is trained was sampled, there, after exactly that prompt."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from itertools import groupby

from agentspec.trajectory import Trajectory
from agentspec.types import LLMCall
from trainers.sequences import TokenSequence


def check_tokens(sequence: TokenSequence, trajectory: Trajectory) -> tuple[list[str], Counter[str]]:
    """What is wrong with a row, and its trained tokens by `module/purpose`.

    Every trained token must be a token of a completion of the call that claims it, after exactly the prompt that the
    call had, chosen among what its constraint left, and not forced.
    """
    calls = {c.id: c for c in trajectory.calls}
    problems: list[str] = []
    by_tag: Counter[str] = Counter()
    start = 0
    for owner, run in groupby(sequence.calls):
        end = start + len(list(run))
        trained = sum(sequence.mask[start:end])
        if owner in calls:
            problems += _check_run(sequence, start, end, calls[owner], trajectory.episode)
            by_tag[calls[owner].tag.path] += trained
        elif owner >= 0:
            problems.append(f"{trajectory.episode} has no call {owner}, which is said to have sampled tokens")
        elif trained:
            problems.append(f"{trained} tokens that no call sampled are trained in {trajectory.episode}")
        start = end
    return problems, by_tag


def _check_run(sequence: TokenSequence, start: int, end: int, call: LLMCall, episode: str) -> Iterator[str]:
    where = f"call {call.id} of {episode}"
    tokens = tuple(sequence.tokens[start:end])
    matching = [c for c in call.completions if c.token_ids == tokens]
    if not matching:
        yield f"tokens {start}..{end} are no completion of {where}"
        return
    if tuple(sequence.tokens[:start]) != call.prompt_ids:
        yield f"the tokens before position {start} are not the prompt of {where}"
    if any(a is not None and len(a) == 1 and sequence.mask[start + i] for i, a in enumerate(matching[0].allowed)):
        yield f"{where} trains tokens that its constraint forced"
