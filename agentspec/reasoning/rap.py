"""RAP, reasoning via planning (Hao et al., 2023): Monte-Carlo tree search with the model as its world model.

The model plays two parts: policy and judge propose actions and say how good they are, and the world model predicts
what each would lead to. An action's fast reward, known before it is tried, is
`alpha * (log p(action | prompt) + log p("good" | its judgement))`; once the world model has predicted its result, the
reward adds `(1 - alpha) * goal_reward` if the goal is reached there. The search is `.search.mcts`: UCT over mean
returns, lazy states, simulation by fast reward, back-propagation; the answer is the path with the greatest sum.

The paper's problems are puzzles whose paths are equally long and pay only at the goal. For agents three things differ.
Ending earns nothing by itself: a sum of negative log-probabilities would reward the path that dies first, so an end
without the goal is charged, at its own rate, for the steps that were left and one more. What the world model says a
step earns (in the environment's unit, divided by the environment's `typical_return`) enters as a share of the goal's
reward. And with `reward="normalised"` (preset `rl`) log p(action) is taken per token, so that long calls are not the
worse ones for their length. With `reward="paper"` and a model that predicts neither earnings nor an end
without the goal the numbers are the paper's.

The first action of the best path is executed. Log-probabilities need a backend that scores; `evaluation="samples"`
counts samples instead. Nothing is executed while it searches: all states but the root's are imagined. Cost per step: at
most one proposal and one prediction per new node, and a scoring per proposed action.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from typing import Any

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import Message
from agentspec.metrics import typical_return
from agentspec.parameters import at_least, one_of, settings, without_effect
from agentspec.prompting import MAX_RETRIES, ON_REQUEST, require_variety, static_prompt, user_turn, with_request
from agentspec.protocols import Services
from agentspec.reasoning.common import Stateless
from agentspec.reasoning.search import mcts
from agentspec.reasoning.search.judge import last_word
from agentspec.reasoning.search.meter import Ask, Meter, OutOfBudgetError, last_resort
from agentspec.reasoning.search.propose import Proposal, legal, sample_steps
from agentspec.reasoning.search.tree import Node, best_leaf
from agentspec.reasoning.search.world import ModelWorld, render_steps, root_outcome
from agentspec.types import ActionSchema, AgentInput, Decision, Recall, Task

PRESETS = {
    "paper": {"num_iterations": 10, "depth": 5, "num_actions": 4, "prediction_tokens": 128, "reward": "paper"},
    "rl": {"num_iterations": 3, "depth": 3, "num_actions": 3, "prediction_tokens": 64, "reward": "normalised"},
}
NEXT = "{steps}Write the one action that should come next."
JUDGE = "{steps}The next action would be: {action}\nIs that a good step towards the task's goal? Answer good or bad."
VERDICTS = {"good": 1.0, "bad": 0.0}


class ImaginedProblem:
    """The search problem: children from the policy, states from the world model, rewards from the judge."""

    def __init__(
        self, method: ReasoningViaPlanning, meter: Meter, base: Sequence[Message], schema: ActionSchema
    ) -> None:
        self._method = method
        self._meter = meter
        self._base = base
        self._schema = schema
        self._world = ModelWorld(
            meter,
            method.services,
            base,
            tokens=method.prediction_tokens,
            path_tokens=method.path_tokens,
            temperature=method.temperature,
        )

    async def visit(self, node: Node) -> None:
        """Predict what the action leads to; the reward adds the goal's to the fast reward."""
        method = self._method
        outcome = await self._world.step(node)
        node.state, node.terminal = outcome, outcome.ended
        steps = 1
        if outcome.ended and not outcome.reward:
            # Ending earns nothing by itself: the steps that were left, and one more, cost what this one does.
            steps += max(0, method.depth - node.depth) + 1
        earned = outcome.reward or outcome.earned / method.scale
        node.reward = steps * min(0.0, node.prior) + max(0.0, node.prior)
        node.reward += (1 - method.alpha) * method.goal_reward * earned

    async def actions(self, node: Node) -> list[Node]:
        """Sampled actions with their fast rewards."""
        method = self._method
        steps = render_steps(node, method.services, method.path_tokens)
        prefix = f"{steps}\n\n" if steps else ""
        request = NEXT.format(steps=prefix)
        proposals = await sample_steps(
            self._meter,
            self._base,
            self._schema,
            request,
            n=method.actions,
            imagined=node.depth > 0,
            temperature=method.temperature,
            **method.limit,
        )
        # Kept before they are rewarded: should the budget end here, there is something to choose from.
        node.children = [Node(p.text, node, prior=math.log(p.count), source=p.source) for p in proposals]
        if proposals:
            for child, fast in zip(node.children, await self._fast_rewards(prefix, request, proposals), strict=True):
                child.prior = fast
        return node.children

    async def _fast_rewards(self, prefix: str, request: str, proposals: Sequence[Proposal]) -> list[float]:
        method = self._method
        judged = [with_request(self._base, JUDGE.format(steps=prefix, action=p.text)) for p in proposals]
        if method.evaluation == "score":
            texts = [p.text for p in proposals]
            asked = [(with_request(self._base, request), texts), *((messages, ["good"]) for messages in judged)]
            likely, *good = await self._meter.score_all(asked)
            if method.normalised:
                likely = tuple(
                    a / max(1, method.services.llm.count_tokens(t)) for a, t in zip(likely, texts, strict=True)
                )
            return [method.alpha * (a + g[0]) for a, g in zip(likely, good, strict=True)]
        sampling: dict[str, Any] = {"n": method.eval_samples, "temperature": 1.0}
        if self._schema.choices and self._meter.constrains:
            sampling["choices"] = tuple(VERDICTS)
        calls = await self._meter.ask_all([Ask("judge", messages, sampling) for messages in judged])
        self._meter.stop()
        total = sum(p.count for p in proposals)
        rewards = []
        for proposal, call in zip(proposals, calls, strict=True):
            good_ones = sum(last_word(c.text, VERDICTS) or 0.0 for c in call.completions)
            # Add-one smoothing: no sample saying "good" is not proof of "bad".
            share = (good_ones + 1) / (len(call.completions) + 2)
            rewards.append(method.alpha * (math.log(proposal.count / total) + math.log(share)))
        return rewards


class ReasoningViaPlanning(Stateless):
    """Monte-Carlo tree search in the model's imagination.

    Args:
        preset: `paper` (10 iterations, depth 5, 4 actions) or `rl` (3, 3, 3, short predictions).
        num_iterations: paths sampled per decision.
        depth: most steps of a path.
        num_actions: actions sampled per state.
        exploration: weight w of UCT.
        alpha: share of the model's own judgement in the reward; the rest is the goal's.
        goal_reward: what reaching the goal counts, on the scale of log-probabilities.
        reward: `paper` (log p of the whole action) or `normalised` (per token).
        evaluation: `score` (log-probabilities) or `samples` (Monte-Carlo, for backends that cannot score).
        eval_samples: samples of a judgement under `samples`.
        output: the path that decides: `max_reward` (greatest sum), `max_visits` (most visited child at each level)
            or `max_iter` (the best single iteration).
        temperature: of proposals and predictions.
        max_calls: most requests and scorings per decision (`None`: no limit).
        max_search_tokens: tokens after which a decision makes no further request (`None`: no limit).
        path_tokens: budgets of prompt sections.
        prediction_tokens: most tokens of a predicted observation.
        thought_tokens: most tokens of a proposed action (`None`: the spec's `max_tokens`).
        max_retries: further calls for proposals of which none is an action, all of a decision together.
    """

    declaration = Declaration(
        "Monte-Carlo tree search with the model as world model and judge",
        calls=CallProfile(step=(1, 93)),
        rl=CallProfile(step=(1, 18)),
        purposes=Purpose.each("step", "propose", "world", "judge"),
        needs=("n", "score"),
        waived={"score": ("evaluation", "samples")},
        small=(
            {"preset": "rl", "evaluation": "samples", "output": "max_visits"},
            {"preset": "rl", "output": "max_iter"},
        ),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        num_iterations: int | None = None,
        depth: int | None = None,
        num_actions: int | None = None,
        exploration: float = 1.0,
        alpha: float = 0.5,
        goal_reward: float = 100.0,
        reward: str | None = None,
        evaluation: str = "score",
        eval_samples: int = 3,
        output: str = "max_reward",
        temperature: float = 0.8,
        max_calls: int | None = None,
        max_search_tokens: int | None = None,
        path_tokens: int = 512,
        prediction_tokens: int | None = None,
        thought_tokens: int | None = None,
        max_retries: int = MAX_RETRIES,
    ) -> None:
        given = {
            "num_iterations": num_iterations,
            "depth": depth,
            "num_actions": num_actions,
            "prediction_tokens": prediction_tokens,
            "reward": reward,
        }
        chosen: dict[str, Any] = settings("rap", PRESETS, preset, given)
        one_of("rap", reward=(chosen["reward"], ("paper", "normalised")))
        self.normalised = chosen.pop("reward") == "normalised"
        at_least("rap", 0, max_retries=max_retries)
        self.max_retries = max_retries
        self.scale = 1.0
        at_least("rap", 1, max_calls=max_calls, eval_samples=eval_samples, **chosen)
        one_of(
            "rap",
            evaluation=(evaluation, ("score", "samples")),
            output=(output, ("max_reward", "max_visits", "max_iter")),
        )
        if evaluation == "score":
            without_effect("rap", "evaluation: samples", eval_samples=eval_samples != 3)
        elif reward == "normalised":
            without_effect("rap", "evaluation: score", reward=True)
        if chosen["num_actions"] > 1:
            require_variety("rap", services, temperature)
        self.services = services
        self.iterations, self.depth, self.actions = chosen["num_iterations"], chosen["depth"], chosen["num_actions"]
        self.exploration = exploration
        self.alpha, self.goal_reward = alpha, goal_reward
        self.evaluation, self.eval_samples = evaluation, eval_samples
        self.output = output
        self.temperature = temperature
        self.limits = {"calls": max_calls, "tokens": max_search_tokens}
        self.path_tokens = path_tokens
        self.prediction_tokens = chosen["prediction_tokens"]
        self.limit: dict[str, Any] = {} if thought_tokens is None else {"max_tokens": thought_tokens}

    def begin_episode(self, task: Task) -> None:
        """Take the environment's scale of returns."""
        self.scale = typical_return(task.env)

    async def decide(self, input: AgentInput, recall: Recall) -> Decision:
        dynamic = user_turn(input, recall, self.services)
        base = self.services.context.prompt(static_prompt(input, ON_REQUEST), dynamic)
        meter = Meter(self.services.llm, **self.limits, retries=self.max_retries)
        problem = ImaginedProblem(self, meter, base, input.action_schema)
        root = Node(state=root_outcome(input, None))
        record: list[tuple[float, list[Node]]] = []
        # Out of budget: what was found until then decides, and the trace says so.
        with contextlib.suppress(OutOfBudgetError):
            await mcts.search(
                root,
                problem,
                iterations=self.iterations,
                depth=self.depth,
                weight=self.exploration,
                record=record,
            )
        trace: dict[str, Any] = {"method": "rap", "world": "model", "iterations": len(record)}
        leaf = self._output(root, record)
        action = legal(leaf.first.action, input.action_schema) if leaf else None
        if leaf is None or action is None:
            return await last_resort(meter, base, input.action_schema, trace)
        children = root.children or []
        return Decision(
            action,
            rationale=render_steps(leaf, self.services, self.path_tokens),
            candidates=tuple((c.action, c.value) for c in children),
            calls=(leaf.first.source,) if leaf.first.source else (),
            turn=(action.text,),
            trace={**trace, "visits": [c.visits for c in children], **meter.trace()},
        )

    def _output(self, root: Node, record: Sequence[tuple[float, list[Node]]]) -> Node | None:
        """The last node of the path that decides; the best child by value where no path came to an end."""
        if not root.children:
            return None
        if self.output == "max_iter" and record:
            path = max(record, key=lambda r: r[0])[1]
            if len(path) > 1:
                return path[-1]
        if self.output == "max_visits":
            node = root
            while node.children and any(c.visits for c in node.children):
                node = max(node.children, key=lambda c: c.visits)
            return node if node.depth else max(root.children, key=lambda c: c.value)
        best = best_leaf(root, self.depth)
        return best[1] if best else max(root.children, key=lambda c: c.value)
