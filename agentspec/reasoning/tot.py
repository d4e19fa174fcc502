"""Tree of Thoughts (Yao et al., 2023): grow, judge and prune a tree of partial solutions before acting.

A thought is one more step of a short course of action. From each kept partial course the policy generates
`num_thoughts` continuations (`propose`: one answer lists them; `sample`: independent samples); a separate call
judges every candidate (`value`: sure, likely or impossible, several times; `estimate`: also how much would come of
it, in the environment's unit; `vote`: which of them is best); breadth-
first search keeps the `breadth` best of a layer, depth-first search follows the best child first, prunes what is
judged too low, and backtracks. The first action of the best course is executed; the next step searches anew.

In menu mode the first step is decoded under the menu's constraint (always as samples); later steps are imagined, their
menu is unknown, and they are short free lines that are never executed. Proposals are read by the one reader of answers,
in whatever dress. A course under judgement stands whole in the judge's prompt.

Cost per step with the paper's sizes: 5 proposals and 15 judgements of 3 samples each.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any

from agentspec.actions import canonical
from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message
from agentspec.parameters import at_least, one_of, settings, without_effect
from agentspec.prompting import MAX_RETRIES, ON_REQUEST, require_variety, static_prompt, user_turn, with_request
from agentspec.protocols import Services
from agentspec.reasoning.common import Stateless
from agentspec.reasoning.search.judge import last_amount, last_number, last_word
from agentspec.reasoning.search.meter import Ask, Meter, OutOfBudgetError, last_resort
from agentspec.reasoning.search.propose import legal, merge, read_steps, readable
from agentspec.reasoning.search.tree import Node
from agentspec.types import ActionSchema, AgentInput, Decision, LLMCall, Recall

PRESETS = {
    "paper": {"num_thoughts": 3, "breadth": 2, "depth": 3, "evaluations": 3},
    "rl": {"num_thoughts": 3, "breadth": 1, "depth": 2, "evaluations": 1},
}
VALUES = {"sure": 20.0, "likely": 1.0, "impossible": 0.001}
"""What a judgement counts: one "sure" outweighs any number of "likely"."""

SHARES = {"sure": 1.0, "likely": 0.5, "impossible": 0.0}
"""How much of an estimate a judgement leaves."""

COURSE = "A course of action under consideration:\n{steps}\n\n"
PROPOSE = "List {k} different actions that could come next, one a line, the most promising first. {form}"
SAMPLE = "Write the one action that should come next. {form}"
AS_CALLS = "Write action calls only."
AS_WORDS = "Write each as a short phrase."
VALUE = (
    "{course}Can this course of action lead to a good result of the task? Weigh it in a sentence or two, then end with "
    "one word: sure, likely or impossible."
)
VALUE_WORD = "{course}Can this course of action lead to a good result of the task? Answer sure, likely or impossible."
ESTIMATE = (
    "{course}What would come of this course of action in the end? Weigh it in a sentence or two. Then write a line "
    "'Estimate: ' and how much it would bring, as a number in the task's own unit, and a last line with one word for "
    "how certain that is: sure, likely or impossible."
)
VOTE = "These courses of action are under consideration:\n{listed}\n\nWhich one is best? {form}"
VOTE_FREE = "Compare them briefly, then end with the number of the best one."
VOTE_NUMBER = "Answer with its number alone."


@dataclass
class Search:
    """What one decision's search works on: prompt, budget, and the layers of the tree as they grow."""

    base: Sequence[Message]
    schema: ActionSchema
    meter: Meter
    layers: list[list[Node]] = field(default_factory=list)
    leaves: list[Node] = field(default_factory=list)
    judged: dict[tuple[Hashable, ...], float] = field(default_factory=dict)
    unread: int = 0

    def grow(self, nodes: list[Node]) -> None:
        """Add candidates to their layer."""
        while len(self.layers) < nodes[0].depth:
            self.layers.append([])
        self.layers[nodes[0].depth - 1] += nodes

    def best(self) -> Node | None:
        """The best candidate so far: of the leaves, else the deepest layer with a judgement, else the first one."""
        for layer in (self.leaves, *reversed(self.layers)):
            judged = [node for node in layer if node.note is not None]
            if judged:
                return max(judged, key=lambda n: n.prior)
        return self.layers[0][0] if self.layers else None


class TreeOfThoughts(Stateless):
    """A tree search over courses of action.

    Args:
        preset: `paper` (3 thoughts, breadth 2, depth 3, 3 evaluations) or `rl` (breadth 1, depth 2, 1).
        search_strategy: `BFS` or `DFS`.
        generation: `propose` or `sample`.
        evaluation_strategy: `value`, `estimate` (for tasks that pay amounts: the estimate times 1, 0.5 or 0) or
            `vote`.
        selection: BFS keeps the best (`greedy`) or draws in proportion to the judgements (`sample`).
        num_thoughts: continuations k per partial course.
        breadth: BFS: courses b kept per layer; DFS: complete courses after which it stops.
        depth: steps T of a course, at least 2 (one level would be best-of-n).
        evaluations: judgements per candidate, or votes.
        threshold: DFS: candidates whose mean judgement lies below are pruned.
        temperature: of all calls.
        max_calls: most requests per decision (`None`: no limit).
        max_search_tokens: tokens after which a decision makes no further request (`None`: no limit).
        thought_tokens: most tokens of a proposal or a judgement (`None`: the spec's `max_tokens`).
        max_retries: further calls for proposals of which none is an action, all of a decision together.
    """

    declaration = Declaration(
        "a tree of short action sequences: propose, judge, prune, breadth or depth first",
        calls=CallProfile(step=(1, 22)),
        rl=CallProfile(step=(1, 10)),
        purposes=Purpose.each("step", "propose", "value", "vote"),
        small=(
            {"preset": "rl", "search_strategy": "DFS"},
            {"preset": "rl", "evaluation_strategy": "vote", "selection": "sample"},
        ),
        needs=("n",),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        search_strategy: str = "BFS",
        generation: str = "propose",
        evaluation_strategy: str = "value",
        selection: str = "greedy",
        num_thoughts: int | None = None,
        breadth: int | None = None,
        depth: int | None = None,
        evaluations: int | None = None,
        threshold: float = 0.5,
        temperature: float = 0.7,
        max_calls: int | None = None,
        max_search_tokens: int | None = None,
        thought_tokens: int | None = None,
        max_retries: int = MAX_RETRIES,
    ) -> None:
        given = {"num_thoughts": num_thoughts, "breadth": breadth, "depth": depth, "evaluations": evaluations}
        chosen: dict[str, int] = settings("tot", PRESETS, preset, given)
        at_least("tot", 1, max_calls=max_calls, **{k: chosen[k] for k in ("num_thoughts", "breadth", "evaluations")})
        at_least("tot", 2, depth=chosen["depth"])
        one_of(
            "tot",
            search_strategy=(search_strategy, ("BFS", "DFS")),
            generation=(generation, ("propose", "sample")),
            evaluation_strategy=(evaluation_strategy, ("value", "estimate", "vote")),
            selection=(selection, ("greedy", "sample")),
        )
        if search_strategy == "BFS":
            without_effect("tot", "search_strategy: DFS", threshold=threshold != 0.5)
        else:
            without_effect("tot", "search_strategy: BFS", selection=selection != "greedy")
        at_least("tot", 0, max_retries=max_retries)
        if generation == "sample" or chosen["evaluations"] > 1:
            require_variety("tot", services, temperature)
        self.services = services
        self.strategy = search_strategy
        self.propose = generation == "propose"
        self.evaluate = self._vote if evaluation_strategy == "vote" else self._value
        self.estimates = evaluation_strategy == "estimate"
        self.max_retries = max_retries
        self.greedy = selection == "greedy"
        self.thoughts, self.breadth = chosen["num_thoughts"], chosen["breadth"]
        self.depth, self.evaluations = chosen["depth"], chosen["evaluations"]
        self.threshold = threshold
        self.sampling: dict[str, Any] = {"temperature": temperature}
        if thought_tokens is not None:
            self.sampling["max_tokens"] = thought_tokens
        self.limits = {"calls": max_calls, "tokens": max_search_tokens}

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        dynamic = user_turn(input, recall, self.services)
        base = self.services.context.prompt(static_prompt(input, ON_REQUEST), dynamic)
        meter = Meter(self.services.llm, **self.limits, retries=self.max_retries)
        search = Search(base, input.action_schema, meter)
        root = Node()
        # Out of budget: what was found until then decides, and the trace says so.
        with contextlib.suppress(OutOfBudgetError):
            await (self._breadth_first(search, root) if self.strategy == "BFS" else self._depth_first(search, root))
        trace: dict[str, Any] = {"method": "tot", "layers": [len(layer) for layer in search.layers]}
        if search.unread:
            trace["unread_judgements"] = search.unread
        best = search.best()
        action = legal(best.first.action, input.action_schema) if best else None
        if best is None or action is None:
            return await last_resort(search.meter, base, input.action_schema, trace)
        source = best.first.source
        return Decision(
            action,
            rationale="\n".join(f"{i}. {step}" for i, step in enumerate(best.actions, 1)),
            candidates=tuple((node.action, node.prior) for node in search.layers[0]),
            calls=(source,) if source else (),
            turn=(action.text,),
            trace={**trace, **search.meter.trace()},
        )

    async def _breadth_first(self, search: Search, root: Node) -> None:
        frontier = [root]
        for _ in range(self.depth):
            candidates = await self._generate(search, frontier)
            if not candidates:
                return
            await self.evaluate(search, candidates)
            frontier = self._select(candidates)

    def _select(self, candidates: list[Node]) -> list[Node]:
        """The nodes kept: the `breadth` best, or as many drawn in proportion to their values without repetition."""
        if self.greedy:
            return sorted(candidates, key=lambda n: -n.prior)[: self.breadth]
        left, kept = list(candidates), list[Node]()
        while left and len(kept) < self.breadth:
            weights = [node.prior + 1e-9 for node in left]
            kept.append(left.pop(self.services.rng.choices(range(len(left)), weights)[0]))
        return kept

    async def _depth_first(self, search: Search, node: Node) -> None:
        """Best child first; what is judged below the threshold is pruned with everything after it."""
        children = await self._generate(search, [node])
        if not children:
            return
        await self.evaluate(search, children)
        for child in sorted(children, key=lambda n: -n.prior):
            if child.prior / self.evaluations < self.threshold or len(search.leaves) >= self.breadth:
                return
            if child.depth >= self.depth:
                search.leaves.append(child)
            else:
                await self._depth_first(search, child)

    async def _generate(self, search: Search, frontier: Sequence[Node]) -> list[Node]:
        """Continuations of all nodes of the frontier, asked together."""
        asks = [self._generation(search, node) for node in frontier]
        calls = await search.meter.ask_all(asks)
        candidates: list[Node] = []
        for node, ask, call in zip(frontier, asks, calls, strict=False):  # fewer where the budget ended among them
            children = functools.partial(self._children, search, node)
            node.children = children(await readable(search.meter, ask, call, search.schema, children))
            if node.children:
                search.grow(node.children)
                candidates += node.children
        search.meter.stop()
        return candidates

    def _generation(self, search: Search, node: Node) -> Ask:
        menu = search.schema.choices
        form = AS_WORDS if menu and node.depth else AS_CALLS
        if menu and not node.depth:
            sampling = {"n": self.thoughts, "choices": menu, **self.sampling}
            return Ask("propose", with_request(search.base, SAMPLE.format(form="").strip()), sampling, "explored")
        if self.propose:
            request = self._course(node) + PROPOSE.format(k=self.thoughts, form=form)
            return Ask("propose", with_request(search.base, request), self.sampling, "explored")
        request = self._course(node) + SAMPLE.format(form=form)
        return Ask("propose", with_request(search.base, request), {"n": self.thoughts, **self.sampling}, "explored")

    def _children(self, search: Search, node: Node, call: LLMCall) -> list[Node]:
        imagined = node.depth > 0
        if len(call.completions) > 1 or call.sampling.choices or not self.propose:
            proposals = merge(call, search.schema, imagined=imagined)
            return [Node(p.text, node, source=p.source) for p in proposals]
        steps = read_steps(call.text, search.schema, imagined=imagined)[: self.thoughts]
        return [Node(step, node, source=(call.id, 0)) for step in steps]

    def _course(self, node: Node) -> str:
        if not node.depth:
            return ""
        steps = "\n".join(f"{i}. {step}" for i, step in enumerate(node.actions, 1))
        return COURSE.format(steps=steps)

    async def _value(self, search: Search, candidates: Sequence[Node]) -> None:
        """Judge each candidate by itself; a course that was judged before counts 0, so that it is kept once."""
        fresh: dict[tuple[Hashable, ...], Node] = {}
        for node in candidates:
            key = tuple(self._name(action, search.schema) for action in node.actions)
            node.prior, node.note = 0.0, "repeated"
            if key not in search.judged and key not in fresh:
                node.note = None
                fresh[key] = node
        word = bool(search.schema.choices) and search.meter.constrains and not self.estimates
        sampling = {"n": self.evaluations, **self.sampling, **({"choices": tuple(VALUES)} if word else {})}
        template = ESTIMATE if self.estimates else VALUE_WORD if word else VALUE
        asks = [
            Ask("value", with_request(search.base, template.format(course=self._course(node))), sampling)
            for node in fresh.values()
        ]
        calls = await search.meter.ask_all(asks)
        for (key, node), call in zip(fresh.items(), calls, strict=False):
            found = [self._judgement(c.text) for c in call.completions]
            search.unread += found.count(None)
            node.prior = search.judged[key] = sum(v for v in found if v is not None)
            node.note = "judged"
        search.meter.stop()

    def _judgement(self, text: str) -> float | None:
        """What a judgement counts; `None` if it holds none."""
        if not self.estimates:
            return last_word(text, VALUES)
        amount, share = last_amount(text, "estimate"), last_word(text, SHARES)
        return None if amount is None else amount * (SHARES["likely"] if share is None else share)

    @staticmethod
    def _name(text: str, schema: ActionSchema) -> Hashable:
        """The same for steps that do the same."""
        action = legal(text, schema)
        return text.casefold() if action is None else canonical(action, schema)

    async def _vote(self, search: Search, candidates: Sequence[Node]) -> None:
        """Let votes over all candidates decide; a candidate's value is its number of votes."""
        listed = "\n".join(f"{i}. {'; then '.join(node.actions)}" for i, node in enumerate(candidates, 1))
        numbers = range(1, len(candidates) + 1)
        constrained = bool(search.schema.choices) and search.meter.constrains
        request = VOTE.format(listed=listed, form=VOTE_NUMBER if constrained else VOTE_FREE)
        sampling = {"n": self.evaluations, **self.sampling}
        if constrained:
            sampling["choices"] = tuple(str(n) for n in numbers)
        call = await search.meter.ask("vote", with_request(search.base, request), **sampling)
        votes = [last_number(c.text, numbers) for c in call.completions]
        search.unread += votes.count(None)
        for number, node in zip(numbers, candidates, strict=True):
            node.prior, node.note = float(votes.count(number)), "judged"
