"""What cannot be true of a recorded completion, whoever wrote it."""

from __future__ import annotations

import math
from collections.abc import Iterator

from agentspec.trajectory import Trajectory
from agentspec.types import Completion


def check_completions(trajectory: Trajectory) -> Iterator[str]:
    """What is wrong with the completions of an episode."""
    for call in trajectory.calls:
        for completion in call.completions:
            yield from check_completion(completion, f"call {call.id} of {trajectory.episode}")


def check_completion(completion: Completion, where: str) -> Iterator[str]:
    """What cannot be true of a recorded completion, whoever wrote it.

    Constraints must have left the token that was sampled; a log-probability is a number of at most 0, and that of a
    forced token is 0.
    """
    ids, logprobs, allowed = completion.token_ids, completion.logprobs, completion.allowed
    if (logprobs and len(logprobs) != len(ids)) or (allowed and len(allowed) != len(ids)):
        yield f"{where} has {len(ids)} tokens, {len(logprobs)} log-probabilities and {len(allowed)} constraints"
        return
    if any(not math.isfinite(p) or p > 1e-5 for p in logprobs):
        yield f"{where} has log-probabilities that are none (above 0, or not finite)"
    for position, choice in enumerate(allowed):
        if choice is not None and ids[position] not in choice:
            yield f"{where}: its constraint does not hold token {position}, which was sampled"
        if choice is not None and len(choice) == 1 and logprobs and abs(logprobs[position]) > 1e-5:
            yield f"{where}: token {position} was forced, and its log-probability is not 0"
