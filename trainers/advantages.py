"""Advantages: one value per rollout from the returns of its group.

Pure functions on tensors. Returns have shape (groups, rollouts); NaN marks a rollout that could not be scored: it
counts in no mean, no deviation, and gets advantage 0. How many sequences an episode became never enters here, so it
cannot change a baseline (:func:`per_sequence` broadcasts afterwards).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

EPSILON = 1e-4
"""Added to the deviation, as TRL's synchronous trainer does."""


def grpo(returns: torch.Tensor, *, tolerance: float = 1e-6) -> torch.Tensor:
    """Centred by the group mean, divided by the group's sample deviation (Shao et al., 2024; TRL's convention).

    A group whose deviation is at most ``tolerance`` (equal returns up to float noise) gets exactly 0.

    >>> grpo(torch.tensor([[15.0, 10.0, 5.0, 15.0]])).round(decimals=3).tolist()
    [[0.7829999923706055, -0.2610000073909759, -1.3059999942779541, 0.7829999923706055]]
    """
    centred = _centred(returns)
    deviation = _deviation(returns)
    scaled = centred / (deviation + EPSILON)
    return torch.where(deviation <= tolerance, torch.zeros_like(scaled), scaled)


def centred(returns: torch.Tensor) -> torch.Tensor:
    """Centred by the group mean only (Dr. GRPO, Liu et al., 2025): no division by the deviation."""
    return _centred(returns)


def rloo(returns: torch.Tensor) -> torch.Tensor:
    """Leave-one-out: each return minus the mean of the *others* in its group (Ahmadian et al., 2024).

    With n scorable rollouts this is the centred return times n / (n - 1); a lone rollout gets 0.

    >>> rloo(torch.tensor([[1.0, 0.0]])).tolist()
    [[1.0, -1.0]]
    """
    n = (~returns.isnan()).sum(dim=1, keepdim=True).to(returns.dtype)
    factor = torch.where(n > 1, n / (n - 1).clamp(min=1), torch.zeros_like(n))
    return _centred(returns) * factor


ESTIMATORS: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {"grpo": grpo, "centred": centred, "rloo": rloo}


def zero_variance(returns: torch.Tensor, tolerance: float = 1e-6) -> torch.Tensor:
    """Groups (bool, shape (groups,)) that carry no signal: deviation at most ``tolerance`` or fewer than two scored."""
    scored = (~returns.isnan()).sum(dim=1)
    return (_deviation(returns).squeeze(1) <= tolerance) | (scored < 2)


def per_sequence(advantages: torch.Tensor, episodes: Sequence[int]) -> torch.Tensor:
    """Advantage of each row: that of its episode.

    Args:
        advantages: shape (episodes,).
        episodes: for each row the index of its episode.
    """
    return advantages[torch.as_tensor(list(episodes), dtype=torch.long, device=advantages.device)]


def _centred(returns: torch.Tensor) -> torch.Tensor:
    mean = returns.nanmean(dim=1, keepdim=True)
    return torch.nan_to_num(returns - mean, nan=0.0)


def _deviation(returns: torch.Tensor) -> torch.Tensor:
    """Sample standard deviation per group over scorable rollouts, shape (groups, 1); 0 for fewer than two."""
    n = (~returns.isnan()).sum(dim=1, keepdim=True)
    squares = _centred(returns).square().sum(dim=1, keepdim=True)
    return torch.where(n > 1, (squares / (n - 1).clamp(min=1)).sqrt(), torch.zeros_like(squares))
