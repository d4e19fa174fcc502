"""The players of ALFRED that the environment names: a scripted expert that knows the house, and chance.

The expert keeps a twin of the environment, brings it to where the episode is by the history that `info["state"]`
tells, and asks `subgoal` what comes next. It knows where everything is, so it is the upper reference and the
demonstrator of warm starts, not a fair opponent.
"""

from __future__ import annotations

import inspect
import random
from collections.abc import Mapping, Sequence
from typing import Any

from agentspec.envs.alfred.env import AlfredEnv
from agentspec.envs.alfred.menu import ON_OBJECT, PHRASES, PLAIN
from agentspec.envs.experts import Chance
from agentspec.envs.thor.kinds import KNIVES, piece
from agentspec.envs.thor.state import Body
from agentspec.envs.thor.ways import way_to_see

Subgoal = tuple[str, str]
"""A native call and the id of its object."""

_CALL = {player: ours for ours, (player, _, _) in PLAIN.items()}


class Expert:
    """Does the next thing that the task needs, the shortest way."""

    def __init__(self, options: Mapping[str, Any]) -> None:
        taken = inspect.signature(AlfredEnv.__init__).parameters
        own = {"images": False, "render_mode": None, "player": "offline", "executable": ""}
        self._options = {k: v for k, v in options.items() if k in taken} | own
        self._twin: AlfredEnv | None = None

    def act(self, info: Mapping[str, Any]) -> str:
        """The next action as text; stop when nothing is left to do, or nothing can be done."""
        env = self._follow(info["state"])
        menu = bool(info["action_schema"].choices)
        goal = subgoal(env)
        if goal is None:
            return "stop" if menu else "STOP()"
        call, object_id = goal
        name = env.names.name(object_id)
        way = way_to_see(env.world.boxes(), env.world.boxes().state.bodies[object_id])
        if way is None:
            return "stop" if menu else "STOP()"
        if menu:
            verb = next(phrase for phrase, native in PHRASES.items() if native == call)
            text = f"go to {name}" if way else f"{verb} {name}"
            return text if text in info["action_schema"].choices else self._towards(env, object_id)
        return f"{_CALL[way[0]]}()" if way else f'{call}("{name}")'

    def _towards(self, env: AlfredEnv, object_id: str) -> str:
        """On the menu: the way to what an object is in or on, which makes the object known."""
        parents = env.world.boxes().state.bodies[object_id].parents
        ways = [f"go to {env.names.name(p)}" for p in parents]
        return next((way for way in ways if way in env.offered), "stop")

    def _follow(self, state: Mapping[str, Any]) -> AlfredEnv:
        """The twin, brought to where the episode is."""
        if self._twin is None:
            self._twin = AlfredEnv(**self._options)
        env, history = self._twin, list(state["history"])
        if env.episode_seed != state["seed"] or env.history != history[: len(env.history)]:
            env.reset(seed=state["seed"])
        for text in history[len(env.history) :]:
            env.step(text)
        return env

    def snapshot(self) -> bytes:
        """Nothing: the twin follows from the history."""
        return b"{}"

    def restore(self, blob: bytes) -> None:
        """Go back to a `snapshot`."""


def subgoal(env: AlfredEnv) -> Subgoal | None:
    """The next interaction of a task as it stands, None when all is done."""
    if env.progress.success:
        return None
    return _Mind(env).next()


class _Mind:
    """One decision: the state read once, and the rules of the task types."""

    def __init__(self, env: AlfredEnv) -> None:
        self.env, self.boxes, self.targets = env, env.world.boxes(), env.trial.targets
        self.state = self.boxes.state
        self.held = self.state.held()
        self.goal = piece(self.targets.object) if self.targets.sliced else self.targets.object

    def next(self) -> Subgoal | None:
        if self.targets.sliced and not self._all(self.goal):
            return self._slice()
        if self.held is not None and self.held.type in KNIVES and self.targets.object not in KNIVES:
            return self._put_away()
        kind = self.env.trial.type
        if kind == "look_at_obj_in_light":
            return self._light()
        if kind == "pick_and_place_with_movable_recep":
            return self._movable()
        treated = {"heat": "hot", "cool": "cold", "clean": "clean"}.get(kind.split("_")[1])
        if treated:
            return self._treat(treated)
        return self._place(2 if kind.startswith("pick_two") else 1)

    # -- pieces of behaviour -----------------------------------------------------------------------------------

    def _all(self, type_name: str) -> list[Body]:
        return [b for b in self.state.bodies.values() if type_name in b.id and b.type.startswith(type_name)]

    def _nearest(self, bodies: list[Body]) -> Body | None:
        """The one that the fewest primitives bring into view, if it had nothing shut around it."""
        best: tuple[int, str] | None = None
        for one in bodies:
            shut = self._shut(one)
            way = way_to_see(self.boxes, shut or one)
            if way is not None:
                cost = (len(way) + (1 if shut else 0), one.id)
                best = cost if best is None or cost < best else best
        return None if best is None else self.state.bodies[best[1]]

    def _shut(self, one: Body) -> Body | None:
        return next((self.state.bodies[p] for p in one.parents if self.state.bodies[p].closed), None)

    def _fetch(self, bodies: list[Body]) -> Subgoal | None:
        one = self._nearest(bodies)
        if one is None:
            return None
        shut = self._shut(one)
        if shut is not None:
            return ("TOGGLE_OFF", shut.id) if shut.on and shut.type == "Microwave" else ("OPEN", shut.id)
        return "PICKUP", one.id

    def _drop_into(self, receptacle: Body | None) -> Subgoal | None:
        if receptacle is None:
            return None
        return ("OPEN", receptacle.id) if receptacle.closed else ("PUT", receptacle.id)

    def _put_away(self) -> Subgoal | None:
        avoid = {self.targets.parent, self.targets.movable}
        tops = [b for b in self.state.bodies.values() if "receptacle" in b.abilities and "openable" not in b.abilities]
        wide = [b for b in tops if b.size[0] * b.size[2] > 0.15 and b.type not in avoid and not b.held]
        return self._drop_into(self._nearest(wide or [b for b in tops if not b.held and b.type != "Floor"]))

    def _slice(self) -> Subgoal | None:
        if self.held is None:
            return self._fetch([b for b in self.state.bodies.values() if b.type in KNIVES])
        if self.held.type not in KNIVES:
            return self._put_away()
        one = self._nearest(self._all(self.targets.object))
        if one is None:
            return None
        shut = self._shut(one)
        return ("OPEN", shut.id) if shut is not None else ("SLICE", one.id)

    def _is_goal(self, one: Body | None) -> bool:
        return one is not None and one.type == self.goal

    def _receptacle(self) -> Body | None:
        name = {"Sink": "SinkBasin", "Bathtub": "BathtubBasin"}.get(self.targets.parent, self.targets.parent)
        found = [b for b in self._all_in(name) if b is not self.held]
        filled = [b for b in found if any(self._is_goal(c) for c in self.state.contents(b.id))]
        return self._nearest(filled) or self._nearest(found)

    def _all_in(self, name: str) -> list[Body]:
        return [b for b in self.state.bodies.values() if name in b.id and "receptacle" in b.abilities]

    def _place(self, count: int) -> Subgoal | None:
        if self.held is not None:
            return self._drop_into(self._receptacle()) if self._is_goal(self.held) else self._put_away()
        home = self._receptacle() if count > 1 else None
        return self._fetch([b for b in self._all(self.goal) if home is None or home.id not in b.parents])

    def _light(self) -> Subgoal | None:
        if not self._is_goal(self.held):
            return self._put_away() if self.held is not None else self._fetch(self._all(self.goal))
        lamps = [b for b in self._all(self.targets.toggle) if "toggleable" in b.abilities]
        lamp = self._nearest(lamps)
        if lamp is None:
            return None
        return ("TOGGLE_OFF", lamp.id) if lamp.on else ("TOGGLE_ON", lamp.id)

    def _movable(self) -> Subgoal | None:
        boxes = [b for b in self._all(self.targets.movable) if "pickupable" in b.abilities]
        filled = [b for b in boxes if any(self._is_goal(c) for c in self.state.contents(b.id))]
        if self.held is not None:
            if self.held in filled:
                return self._drop_into(self._receptacle())
            return self._drop_into(self._nearest(boxes)) if self._is_goal(self.held) else self._put_away()
        return self._fetch(filled) if filled else self._fetch(self._all(self.goal))

    def _treat(self, treated: str) -> Subgoal | None:
        done: set[str] = getattr(self.env.changes, treated)
        ready = [b for b in self._all(self.goal) if b.id in done]
        if ready:
            if self.held is not None:
                return self._drop_into(self._receptacle()) if self.held.id in done else self._put_away()
            tap = [b for b in self._all("Faucet") if b.on]
            return ("TOGGLE_OFF", tap[0].id) if tap else self._fetch(ready)
        place = {"hot": "Microwave", "cold": "Fridge", "clean": "SinkBasin"}[treated]
        where = self._nearest(self._all_in(place))
        if where is None:
            return None
        inside = any(self._is_goal(c) for c in self.state.contents(where.id))
        if self.held is not None:
            return self._drop_into(where) if self._is_goal(self.held) else self._put_away()
        if not inside:
            return self._fetch(self._all(self.goal))
        return self._finish(treated, where)

    def _finish(self, treated: str, where: Body) -> Subgoal | None:
        """With the thing in place: what heats, cools or cleans it."""
        if treated == "clean":
            tap = self._nearest(self._all("Faucet"))
            return None if tap is None else (("TOGGLE_OFF", tap.id) if tap.on else ("TOGGLE_ON", tap.id))
        if treated == "cold" or where.open:
            return ("OPEN", where.id) if where.closed else ("CLOSE", where.id)
        return ("TOGGLE_OFF", where.id) if where.on else ("TOGGLE_ON", where.id)


def expert_steps(seed: int) -> int:
    """The primitive steps of the expert on one of our tasks: their L*."""
    env = AlfredEnv(max_steps=1000, end_on_success=False)
    _, info = env.reset(seed=seed)
    player = Expert({"max_steps": 1000, "end_on_success": False})
    player._twin = env  # plays on the environment itself: nothing to follow
    while not env.progress.success and env.left > 0:
        text = player.act(info)
        if text == "STOP()":
            break
        _, _, _, _, info = env.step(text)
    return env.steps


def expert(options: Mapping[str, Any], rng: random.Random) -> Expert:
    """The player `rule_based`."""
    return Expert(options)


def luck(options: Mapping[str, Any], rng: random.Random) -> Chance:
    """The player `random`."""
    return Chance(rng, _offered)


def _offered(info: Mapping[str, Any]) -> Sequence[str]:
    """The menu without its end, or native actions, also on things in view."""
    if choices := [c for c in info["action_schema"].choices if c != "stop"]:
        return choices
    texts = [f"{name}()" for name in PLAIN]
    texts += [f'{call}("{o["name"]}")' for o in info["state"]["visible"] for call in ON_OBJECT]
    return texts


__all__ = ["Expert", "expert", "expert_steps", "luck", "subgoal"]
