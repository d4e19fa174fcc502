"""LATS, language agent tree search (Zhou et al., 2024): Monte-Carlo tree search in the environment itself.

A node is a thought, an action and what the *real* environment answered to it: steps are tried, the environment is put
back by a snapshot, and after the decision it is exactly as it was. One iteration selects a leaf by UCT, expands it with
samples of the policy, lets a judge value the new states, goes on from the best one (to the end, or not at all with
`rollout="value"`), and back-propagates the rewards on the way plus the last state's value. A path that ends without
success is reflected on in words, and later proposals and judgements are shown these lessons. A success ends the search.

Rewards are brought to the unit interval of the judge's values by the environment's declared `typical_return` (and cut
off at -1 and 1 per step), and a path counts as a success where the environment says so or its return reaches that
scale: one dollar is neither worth ten good judgements nor the end of the search.

A menu's entry is decoded under its constraint and holds no thought: there one is asked for first, in a call of its own,
and the choice is made after it (`think`; preset `rl` leaves it out).

Cost per step at the paper's size: up to a thousand calls, two thousand with a menu; preset `rl`: at most 22.

Without snapshots the method is not LATS: it is refused, or, with `world="model"`, the model predicts what would be
observed, as in RAP, and the trace says `world: model`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message
from agentspec.metrics import typical_return
from agentspec.parameters import at_least, one_of, settings
from agentspec.prompting import (
    MAX_RETRIES,
    ON_REQUEST,
    clip,
    require_variety,
    static_prompt,
    user_turn,
    with_request,
)
from agentspec.protocols import Services
from agentspec.reasoning.search.judge import RATE, UNREAD, rate
from agentspec.reasoning.search.meter import Meter, OutOfBudgetError, last_resort
from agentspec.reasoning.search.propose import Proposal, legal, sample_steps, think_and_choose
from agentspec.reasoning.search.tree import Node, backpropagate, close, nodes_where, select
from agentspec.reasoning.search.world import ModelWorld, RealWorld, World, render_steps, root_outcome
from agentspec.registry import SpecError
from agentspec.state import dump_state, load_state
from agentspec.types import AgentInput, Decision, Recall, Task, Transition
from agentspec.visible import visible

PRESETS: dict[str, dict[str, Any]] = {
    "paper": {
        "num_iterations": 30,
        "max_depth": 7,
        "n_generate_sample": 5,
        "root_samples": 10,
        "rollout": "simulate",
        "prediction_tokens": 128,
        "think": True,
    },
    "rl": {
        "num_iterations": 4,
        "max_depth": 3,
        "n_generate_sample": 3,
        "root_samples": 3,
        "rollout": "value",
        "prediction_tokens": 48,
        "think": False,
    },
}
NEXT_FREE = "Write one sentence after 'Thought:' about what matters now, then one line 'Action: NAME(arguments)'."
NEXT_MENU = "Answer with the one action that should come next, word for word."
THINK_MENU = (
    "Write one sentence about what matters now and what should come next; the choice itself is asked for after it."
)
REFLECT = (
    "This attempt is over and was not a success (return {total:g}). In one or two sentences: which step was the "
    "mistake, and what should be tried instead?"
)
LESSONS = "Lessons from attempts that failed:\n{lessons}"


@dataclass
class Search:
    """What one decision's search works on."""

    meter: Meter
    world: World
    base: Sequence[Message]
    iterations: int = 0
    unread: int = 0


class LanguageAgentTreeSearch:
    """Monte-Carlo tree search in the real environment.

    Args:
        preset: `paper` (30 iterations, depth 7, 5 samples and 10 at the root, simulation to the end; for evaluation:
            up to 10**3 calls per decision) or `rl` (4 iterations, depth 3, 3 samples, value instead of simulation).
        num_iterations, max_depth: size of the search.
        n_generate_sample, root_samples: samples per expansion, and of the root.
        rollout: `simulate` (follow the best value to an end or the depth limit) or `value` (trust the judge).
        exploration: weight w of UCT.
        mix: share of the judge's rating in a state's value (the paper's lambda); the rest is the share of samples.
        evaluations: ratings per state, averaged.
        success_return: an ended path is a success from this return on, where the environment reports no `success`
            (`None`: its `typical_return`).
        reward_scale: factor on rewards, to bring them to the scale of values (`None`: 1 / `typical_return`).
        max_reflections: lessons kept in an episode (0: none are made).
        think: menu mode: a thought before every choice in the environment, in a call of its own.
        world: `environment` or `model`, see the module's docstring.
        temperature: of proposals.
        max_calls: most requests per decision (`None`: no limit).
        max_search_tokens: tokens after which a decision makes no further request (`None`: no limit).
        path_tokens, lesson_tokens: budgets of prompt sections; of a path only observations are clipped.
        prediction_tokens: most tokens of a predicted observation, of a rating in words, and of a reflection.
        thought_tokens: most tokens of a proposal (`None`: the spec's `max_tokens`).
        max_retries: further calls for proposals of which none is an action, all of a decision together.
    """

    declaration = Declaration(
        "Monte-Carlo tree search in the environment itself, with judged values and reflections on failures",
        calls=CallProfile(step=(1, 2033)),
        rl=CallProfile(step=(1, 22)),
        purposes=Purpose.each("step", "propose", "think", "value", "reflect", "world"),
        needs=("n", "snapshots"),
        waived={"snapshots": ("world", "model")},
        small=({"preset": "rl", "think": True},),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        num_iterations: int | None = None,
        max_depth: int | None = None,
        n_generate_sample: int | None = None,
        root_samples: int | None = None,
        rollout: str | None = None,
        exploration: float = 1.0,
        mix: float = 0.5,
        evaluations: int = 1,
        success_return: float | None = None,
        reward_scale: float | None = None,
        max_reflections: int = 3,
        think: bool | None = None,
        world: str = "environment",
        temperature: float = 1.0,
        max_calls: int | None = None,
        max_search_tokens: int | None = None,
        path_tokens: int = 512,
        lesson_tokens: int = 192,
        prediction_tokens: int | None = None,
        thought_tokens: int | None = None,
        max_retries: int = MAX_RETRIES,
    ) -> None:
        given: dict[str, Any] = {
            "num_iterations": num_iterations,
            "max_depth": max_depth,
            "n_generate_sample": n_generate_sample,
            "root_samples": root_samples,
            "rollout": rollout,
            "prediction_tokens": prediction_tokens,
            "think": think,
        }
        chosen: dict[str, Any] = settings("lats", PRESETS, preset, given)
        self.rollout: str = chosen.pop("rollout")
        self.think: bool = chosen.pop("think")
        at_least("lats", 1, max_calls=max_calls, evaluations=evaluations, **chosen)
        at_least("lats", 0, max_reflections=max_reflections)
        one_of("lats", rollout=(self.rollout, ("simulate", "value")), world=(world, ("environment", "model")))
        if not 0 <= mix <= 1:
            raise SpecError(f"lats: mix must lie between 0 and 1, got {mix}")
        self.services = services
        self.iterations, self.depth = chosen["num_iterations"], chosen["max_depth"]
        self.samples, self.root_samples = chosen["n_generate_sample"], chosen["root_samples"]
        self.exploration, self.mix, self.evaluations = exploration, mix, evaluations
        at_least("lats", 0, max_retries=max_retries)
        require_variety("lats", services, temperature)
        self.max_retries = max_retries
        self._given_success, self._given_scale = success_return, reward_scale
        self.success_return, self.reward_scale = success_return or 1.0, reward_scale or 1.0
        self.max_reflections = max_reflections
        self.world = world
        self.temperature = temperature
        self.limits = {"calls": max_calls, "tokens": max_search_tokens}
        self.path_tokens, self.lesson_tokens = path_tokens, lesson_tokens
        self.prediction_tokens: int = chosen["prediction_tokens"]
        self.limit: dict[str, Any] = {} if thought_tokens is None else {"max_tokens": thought_tokens}
        self._lessons: list[str] = []

    def begin_episode(self, task: Task) -> None:
        """Forget the lessons of the last episode.

        Raises:
            SpecError: the environment cannot be put back and `world` is not `model`.
        """
        if self.world == "environment" and self.services.simulator is None:
            raise SpecError(
                f"reasoning 'lats' searches in the environment itself, but {task.env!r} has no snapshot() and "
                "restore(); set `world: model` to search in predictions, or choose another reasoning module"
            )
        self._lessons = []
        scale = typical_return(task.env)
        self.success_return = scale if self._given_success is None else self._given_success
        self.reward_scale = 1 / scale if self._given_scale is None else self._given_scale

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        dynamic = user_turn(input, recall, self.services)
        base = self.services.context.prompt(static_prompt(input, ON_REQUEST), dynamic)
        meter = Meter(self.services.llm, **self.limits, retries=self.max_retries)
        simulator = self.services.simulator if self.world == "environment" else None
        if simulator is None:
            root, world = Node(state=root_outcome(input, None)), self._imagined(meter, base)
            search = Search(meter, world, base)
            await self._search(search, root)
        else:
            blob = await simulator.snapshot()
            root = Node(state=root_outcome(input, blob))
            search = Search(meter, RealWorld(simulator), base)
            try:
                await self._search(search, root)
            finally:
                await simulator.restore(blob)
        trace = self._trace(search, root)
        decision = self._decision(search, root, input, trace)
        return decision or await last_resort(meter, base, input.action_schema, trace)

    def _imagined(self, meter: Meter, base: Sequence[Message]) -> World:
        return ModelWorld(
            meter, self.services, base, tokens=self.prediction_tokens, path_tokens=self.path_tokens, temperature=0.7
        )

    async def _search(self, search: Search, root: Node) -> None:
        """Iterate; what was found when the budget runs out decides, and the trace says so."""
        with contextlib.suppress(OutOfBudgetError):
            for _ in range(self.iterations):
                if root.closed or await self._iterate(search, root):
                    return

    async def _iterate(self, search: Search, root: Node) -> bool:
        """Select, expand, evaluate, simulate, back-propagate, reflect; whether a success was found."""
        path = select(root, self.exploration, self.depth, open_only=True)
        await self._descend(search, path)
        while self.rollout == "simulate" and not self._over(path[-1]):
            if not await self._descend(search, path):
                break
        leaf = path[-1]
        if leaf is root:
            close(root)
            return False
        search.iterations += 1
        backpropagate(path, 0.0 if leaf.terminal else leaf.prior - leaf.reward)
        if self._over(leaf) or leaf.children == []:
            close(leaf)
        if not leaf.terminal:
            return False
        if self._success(leaf):
            return True
        await self._reflect(search, leaf)
        return False

    def _over(self, node: Node) -> bool:
        return node.terminal or node.depth >= self.depth

    async def _descend(self, search: Search, path: list[Node]) -> bool:
        """Expand the last node of `path` and go on to its best child; `False` if there is none."""
        node = path[-1]
        if self._over(node):
            return False
        if node.children is None:
            await self._expand(search, node)
        if not node.children:
            return False
        path.append(max(node.children, key=lambda c: (self._success(c), c.prior)))
        return True

    def _success(self, node: Node) -> bool:
        if not node.terminal:
            return False
        if node.state.success is not None:
            return bool(node.state.success)
        return self._return(node) >= self.success_return

    def _return(self, node: Node) -> float:
        """Rewards from the root to `node`, in the environment's own scale."""
        return sum(n.state.reward for n in node.path[1:])

    async def _expand(self, search: Search, node: Node) -> None:
        """Sample actions, take each of them in the world, and let the judge value the states."""
        schema = node.state.schema
        imagined = node.depth > 0 and not search.world.real
        menu = bool(schema.choices) and not imagined
        wanted = self.samples if node.depth else self.root_samples
        proposals = await self._propose(search, node, wanted, menu=menu, imagined=imagined)
        children = [Node(p.text, node, source=p.source, note=p) for p in proposals]
        # Kept before they are judged: should the budget end here, there is something to choose from.
        node.children = children
        for child in children:
            child.prior = child.note.count / wanted
        for child in children:
            child.state = await search.world.step(child)
            child.reward = max(-1.0, min(1.0, child.state.reward * self.reward_scale))
            child.terminal = child.state.ended
        await self._judge(search, children, wanted)
        for child in children:
            if child.terminal and not self._success(child):
                close(child)

    async def _propose(self, search: Search, node: Node, wanted: int, *, menu: bool, imagined: bool) -> list[Proposal]:
        """Thoughts and actions for what comes after `node`: in one completion, or in menu mode one after the other."""
        shared = {"n": wanted, "temperature": self.temperature, **self.limit}
        if menu and self.think:
            request = self._request(node, THINK_MENU)
            return await think_and_choose(search.meter, search.base, node.state.schema, request, **shared)
        request = self._request(node, NEXT_MENU if menu else NEXT_FREE)
        return await sample_steps(search.meter, search.base, node.state.schema, request, imagined=imagined, **shared)

    async def _judge(self, search: Search, children: Sequence[Node], wanted: int) -> None:
        """Value of each state that is no end: `mix` of the judge's rating (0 to 1) and the share of samples."""
        alive = [child for child in children if not child.terminal]
        for child in children:
            child.prior = child.reward
        prompts = [with_request(search.base, self._request(child, RATE)) for child in alive]
        sampling: dict[str, Any] = {"n": self.evaluations, "max_tokens": self.prediction_tokens}
        if self.evaluations > 1:
            sampling["temperature"] = self.temperature  # greedy ratings would all be the same
        menu = bool(children) and bool(children[0].state.schema.choices)
        ratings = await rate(search.meter, prompts, constrained=menu and search.meter.constrains, **sampling)
        for child, rating in zip(alive, ratings, strict=False):  # fewer ratings when the budget ended among them
            search.unread += rating is None
            share = child.note.count / wanted
            child.prior += self.mix * (UNREAD if rating is None else rating) + (1 - self.mix) * share
        search.meter.stop()

    def _request(self, node: Node, form: str) -> str:
        """Lessons, the steps up to `node` with what came of them, and what is asked."""
        parts = []
        if self._lessons:
            lessons = "\n".join(f"- {lesson}" for lesson in self._lessons)
            parts.append(LESSONS.format(lessons=clip(lessons, self.lesson_tokens, self.services, keep="tail")))
        steps = render_steps(node, self.services, self.path_tokens)
        return "\n\n".join([*parts, *([steps] if steps else []), form])

    async def _reflect(self, search: Search, leaf: Node) -> None:
        """A lesson from a path that ended without success."""
        if not self.max_reflections:
            return
        request = f"{render_steps(leaf, self.services, self.path_tokens)}\n\n{REFLECT.format(total=self._return(leaf))}"
        call = await search.meter.ask("reflect", with_request(search.base, request), max_tokens=self.prediction_tokens)
        lesson = " ".join(visible(call.text)[0].split())
        if lesson:
            self._lessons = [*self._lessons, lesson][-self.max_reflections :]

    def _trace(self, search: Search, root: Node) -> dict[str, Any]:
        children = root.children or []
        trace: dict[str, Any] = {
            "method": "lats",
            "world": "environment" if search.world.real else "model",
            "iterations": search.iterations,
            "visits": [c.visits for c in children],
            "lessons": len(self._lessons),
        }
        if search.unread:
            trace["unread_ratings"] = search.unread
        return trace

    def _decision(self, search: Search, root: Node, input: AgentInput, trace: dict[str, Any]) -> Decision | None:
        children = root.children or []
        # A success first, then what the search came to; untried ones only if nothing was tried.
        solved = nodes_where(root, self._success)
        tried = [c for c in children if c.visits] or children
        best = solved[0].first if solved else max(tried, key=lambda c: (c.value, c.visits), default=None)
        action = legal(best.action, input.action_schema) if best else None
        if best is None or action is None:
            return None
        return Decision(
            action,
            rationale=best.note.thought,
            candidates=tuple((c.action, c.value) for c in children),
            calls=(*best.note.before, *((best.source,) if best.source else ())),
            turn=(action.text,),
            trace={**trace, "solved": bool(solved), **search.meter.trace()},
        )

    async def observe(self, transition: Transition) -> None:
        return None

    def snapshot(self) -> bytes:
        return dump_state(self._lessons)

    def restore(self, blob: bytes) -> None:
        self._lessons = load_state(blob)
