"""From a native call to the choice of the menu that stands for it, or comes nearest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from agentspec.envs.deliverybench.view.calls import numbers_in
from agentspec.envs.deliverybench.view.choices import GOODS, Option

_WAIT = "wait 1 minute"


def match(call: str, menu: Sequence[Option], taken: Sequence[int]) -> str:
    """The text of the choice for `call`.

    Ways are matched by their goal, whatever the pace; several offers (`taken`) one or two at a time; several goods one
    by one; charging by the lowest level that suffices. What has no choice of its own becomes a short wait.

    Args:
        call: a native call.
        menu: all choices, best first, whichever page they are on.
        taken: the offers that `call` accepts, if it accepts offers.
    """
    return next((option.text for option in _candidates(call, menu, taken)), _WAIT)


def _candidates(call: str, menu: Sequence[Option], taken: Sequence[int]) -> Iterator[Option]:
    yield from (option for option in menu if option.call == call)
    name = call.partition("(")[0]
    if name == "ACCEPT_ORDER":
        wanted = set(taken)
        fitting = [o for o in menu if o.kind == "accept" and set(numbers_in(o.call)) <= wanted]
        yield from sorted(fitting, key=lambda option: -len(numbers_in(option.call)))
    elif name == "MOVE":
        yield from (o for o in menu if o.call.startswith("MOVE(") and numbers_in(o.call)[:2] == numbers_in(call)[:2])
    elif name == "BUY":
        yield from (o for o in menu for item, good in GOODS.items() if item in call and o.text == f"buy {good}")
    elif name in ("CHARGE", "REST"):
        enough = [o for o in menu if o.call.startswith(name) and numbers_in(o.call)[0] >= numbers_in(call)[0]]
        yield from sorted(enough, key=lambda option: numbers_in(option.call)[0])
    elif name == "WAIT" and numbers_in(call):
        shorter = [o for o in menu if o.call.startswith("WAIT(") and numbers_in(o.call)]
        yield from sorted(shorter, key=lambda option: abs(numbers_in(option.call)[0] - numbers_in(call)[0]))
