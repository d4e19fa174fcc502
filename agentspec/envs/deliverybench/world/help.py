"""Other couriers: speech and the board for help, as they answer somebody who works alone.

A request can be posted and changed, but nobody takes it, so it stays open; it costs nothing before somebody does. The
actions that need a second courier are refused. None of these is advertised to a lone courier (`grammar.advertised`).
"""

from __future__ import annotations

from agentspec.envs.deliverybench.world.clock import look
from agentspec.envs.deliverybench.world.grammar import Refused, argument, number, short, unread, whole
from agentspec.envs.deliverybench.world.shift import Shift
from agentspec.envs.deliverybench.world.state import HelpRequest
from agentspec.types import Action

KINDS = ("HELP_PICKUP", "HELP_DELIVERY", "HELP_BUY", "HELP_CHARGE")


def say(world: Shift, action: Action) -> str:
    """SAY(text=, to=): with one courier in the city nobody but everybody can be addressed."""
    text = argument(action, 0, "text")
    if not isinstance(text, str) or not text.strip():
        raise unread(action, "say something", "SAY_EMPTY")
    to = action.kwargs.get("to")
    if to is not None and str(to).strip().lower() not in ("", "all", "*", "everyone", "broadcast"):
        raise Refused("SAY_UNKNOWN_AGENT", f"there is no courier {short(to)} in this city")
    world.recorder.social["say"] += 1
    return "said something to everybody"


def view_help_board(world: Shift, action: Action) -> str:
    """VIEW_HELP_BOARD(): empty, because requests of one's own are not shown."""
    look(world, "help", "there are no requests for help")
    return "viewed the help board"


def post_help(world: Shift, action: Action) -> str:
    """POST_HELP(kind=, bounty=, ttl_s=, ...): accepted, but with one courier in the city nobody can answer it."""
    kind = argument(action, 0, "kind", "help_type")
    if not isinstance(kind, str) or kind.strip().upper() not in KINDS:
        raise unread(action, f"kind must be one of {', '.join(KINDS)}", "HELP_KIND")
    bounty = _amount(action, "bounty")
    seconds = _amount(action, "ttl_s")
    request = HelpRequest(len(world.state.requests) + 1, kind.strip().upper(), bounty or 0.0, seconds)
    world.state.requests.append(request)
    world.recorder.social["help_posted"] += 1
    return f"posted request {request.id} {request.kind}"


def edit_help(world: Shift, action: Action) -> str:
    """EDIT_HELP(req_id=, new_bounty=, new_ttl=): change the bounty or the lifetime of an own request."""
    value = argument(action, 0, "req_id")
    if value is None:
        raise unread(action, "say which request", "HELP_NO_ID")
    wanted = whole(value, action, "req_id")
    request = next((known for known in world.state.requests if known.id == wanted), None)
    if request is None:
        mine = ", ".join(str(known.id) for known in world.state.requests) or "none"
        raise Refused("HELP_UNKNOWN", f"request {wanted} is not one of yours ({mine})")
    bounty, seconds = _amount(action, "new_bounty"), _amount(action, "new_ttl")
    if bounty is None and seconds is None:
        raise unread(action, "say what to change: new_bounty or new_ttl", "HELP_NO_CHANGE")
    request.bounty = request.bounty if bounty is None else bounty
    request.seconds = request.seconds if seconds is None else seconds
    return f"changed request {request.id}"


def no_helper(world: Shift, action: Action) -> str:
    """The other help actions need a second courier."""
    raise Refused("HELP_ALONE", f"{action.name} needs another courier; you are the only one in this city")


def _amount(action: Action, name: str) -> float | None:
    """A number of at least 0, None where it is not given."""
    if action.kwargs.get(name) is None:
        return None
    amount = number(action.kwargs[name], action, name)
    if amount < 0.0:
        raise unread(action, f"{name} must be 0 or more, not {short(action.kwargs[name])}")
    return amount
