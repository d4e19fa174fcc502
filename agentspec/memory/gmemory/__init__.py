"""G-Memory (Zhang et al., 2025, arXiv 2506.07398): three graphs of experience, over the episodes of a run.

- *Interaction*: an episode is a chain of steps. Of a success the steps that cost something are left out, and one call
  extracts those that mattered; of a failure, all of whose steps it sees, the mistake.
- *Query*: a node per episode (its task and how it began), joined to those of the ten nearest with cosine at least
  `edge`. For a new episode the nearest ones and their neighbours (`hops`) are the related tasks; of `2 * successes`
  candidates with cosine at least `least` the ones that the model finds most relevant (1 to 10) are shown, with the
  nearest failures.
- *Insight*: rules with a score and the tasks that support them (see `insights`). Every `every` tasks,
  `comparisons` times, a task is drawn and the model compares its nearest successes with a failure, and adds, edits,
  confirms or removes rules, at most four at once. Every `merge_every` tasks the tasks are clustered by their first
  neighbours and each cluster's rules are merged into a third as many.

AgentSpec's form: one agent, so rules are not projected on roles. Retrieval happens once, before the first decision,
and so does the learning from the episode before: what no later episode reads is not asked. Numbers are kept (upstream
strips digits, and merges into a ninth as many rules, by a slip). Success is what the environment says, or a return of
at least `threshold`; where neither is given, a return above the mean so far (in the first episode above 0). Where
there are only successes or only failures, these are compared among themselves. Within the first episode of a run the
memory holds nothing but the newest steps. Of the paper's tables this is the row *ReAct +
G-Memory* (preset `paper`).

Bounded by `capacity` episodes (the oldest goes first) and `max_insights` rules. An answer that cannot be read: no key
steps (the chain's actions stand for them), no change of rules, no relevance (similarity decides).

Cost, per episode: 1 call for the episode before, `2 * successes` for relevance, `comparisons` every `every` episodes
and at most `most_merges` every `merge_every`. Preset `rl`: 1, none, 1 every 4 episodes, 1 every 16.
"""

from __future__ import annotations

import asyncio

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.llm.base import system, user
from agentspec.memory.gmemory.insights import Insights
from agentspec.memory.gmemory.learning import Learner
from agentspec.memory.gmemory.prompts import PAIR, RELEVANCE, Score, told
from agentspec.memory.gmemory.query import NEAREST, QueryGraph
from agentspec.memory.parts import telling
from agentspec.memory.parts.entries import Entries, Entry, embedder_of, one_line
from agentspec.memory.parts.waiting import shown_lines, task_of
from agentspec.parameters import at_least, settings
from agentspec.reflection.trials import episode_return
from agentspec.services import Answer, Services
from agentspec.state import dump_state, load_state
from agentspec.structured import json_of
from agentspec.tokens import clip_text
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Experience, Recall, RecallItem, Task, Transition

PRESETS = {
    "paper": {
        "successes": 2,
        "failures": 1,
        "rank": True,
        "every": 5,
        "comparisons": 5,
        "merge_every": 20,
        "most_merges": 4,
        "top_insights": 5,
        "trial_tokens": 3072,
        "key_tokens": 160,
        "answer_tokens": 512,
        "task_tokens": 512,
        "repairs": 1,
    },
    "rl": {
        "successes": 1,
        "failures": 1,
        "rank": False,
        "every": 4,
        "comparisons": 1,
        "merge_every": 16,
        "most_merges": 1,
        "top_insights": 4,
        "trial_tokens": 1024,
        "key_tokens": 96,
        "answer_tokens": 256,
        "task_tokens": 128,
        "repairs": 0,
    },
}


class GMemory:
    """Episodes as a graph, and rules learnt from them.

    Args:
        preset: `paper` or `rl`; see the module's docstring. The parameters that it sets are `None` here.
        successes: successful episodes shown.
        failures: failed ones shown.
        rank: whether the model judges the relevance of successes.
        edge: least cosine of tasks that are joined.
        least: least cosine of an episode that is shown.
        hops: how far related tasks are looked for.
        every: episodes between two rounds of comparison.
        comparisons: comparisons in a round.
        merge_every: episodes between two mergers of rules.
        most_merges: most clusters whose rules are merged at once.
        top_insights: rules shown.
        max_insights: most rules.
        threshold: least return of a success, where the environment does not say (`None`: above the mean so far).
        trial_tokens: budget of an episode's steps in a prompt.
        key_tokens: most tokens of what is kept of an episode.
        answer_tokens: most tokens of other answers.
        task_tokens: most tokens of the task's instruction.
        repairs: 1 to ask again for an answer that cannot be read, else 0.
        capacity: most episodes.
        recent: newest steps shown, where the prompt does not tell them anyway.
    """

    declaration = Declaration(
        "a graph of episodes and scored rules learnt by comparing them; for runs of several episodes",
        calls=CallProfile(retrieve=(0, 27)),
        rl=CallProfile(retrieve=(0, 3)),
        purposes={
            "steps": Purpose("retrieve", "1. DOUBLE() from 3. 2. SUB() at the end."),
            "mistake": Purpose("retrieve", "DOUBLE() came too late; it grows the number fastest."),
            "relevance": Purpose("retrieve", '{"score": 8}'),
            "compare": Purpose(
                "retrieve",
                '{"operations": [{"op": "ADD", "rule": null, "text": "DOUBLE() while the target is far."}, '
                '{"op": "ADD", "rule": null, "text": "SUB() just before the target."}]}',
            ),
            "merge": Purpose("retrieve", '{"rules": ["DOUBLE() while the target is far, then SUB()."]}'),
        },
        needs=("embedder",),
        small=(
            {"every": 1, "comparisons": 1, "merge_every": 1, "threshold": 0.0},
            {"preset": "rl", "every": 1, "merge_every": 1, "capacity": 1, "recent": 0},
        ),
        aliases=("g_memory",),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        successes: int | None = None,
        failures: int | None = None,
        rank: bool | None = None,
        edge: float = 0.7,
        least: float = 0.3,
        hops: int = 1,
        every: int | None = None,
        comparisons: int | None = None,
        merge_every: int | None = None,
        most_merges: int | None = None,
        top_insights: int | None = None,
        max_insights: int = 50,
        threshold: float | None = None,
        trial_tokens: int | None = None,
        key_tokens: int | None = None,
        answer_tokens: int | None = None,
        task_tokens: int | None = None,
        repairs: int | None = None,
        capacity: int = 500,
        recent: int = 5,
    ) -> None:
        counts = {"successes": successes, "every": every, "merge_every": merge_every, "top_insights": top_insights}
        counts |= {"trial_tokens": trial_tokens, "key_tokens": key_tokens, "answer_tokens": answer_tokens}
        others = {"failures": failures, "comparisons": comparisons, "most_merges": most_merges}
        others |= {"task_tokens": task_tokens, "repairs": repairs}
        chosen = settings("gmemory", PRESETS, preset, counts | others | {"rank": rank})
        at_least("gmemory", 1, max_insights=max_insights, capacity=capacity, **{n: chosen[n] for n in counts})
        at_least("gmemory", 0, hops=hops, recent=recent, **{n: chosen[n] for n in others})
        self.services = services
        self.successes, self.failures, self.rank, self.top_insights, self.repairs = (
            chosen[name] for name in ("successes", "failures", "rank", "top_insights", "repairs")
        )
        self.trial_tokens, self.key_tokens, self.task_tokens = (
            chosen[name] for name in ("trial_tokens", "key_tokens", "task_tokens")
        )
        self.least, self.threshold, self.recent = least, threshold, recent
        self._name = services.llm.module
        self.episodes = Entries(embedder_of(services), capacity)
        self._query = QueryGraph(self.episodes, edge, hops)
        self.graph = self._query.graph
        self.insights = Insights(max_insights)
        sizes = ("every", "comparisons", "merge_every", "most_merges", "key_tokens", "answer_tokens", "repairs")
        self._learner = Learner(services, self.episodes, self.insights, **{name: chosen[name] for name in sizes})
        self._count = 0  # episodes so far
        self._total = 0.0  # sum of their returns
        self._chain = ""  # the episode that has not been learnt from
        self._unlearnt: int | None = None
        self._recalled: list[RecallItem] | None = None  # for this episode
        self._used: list[int] = []  # rules shown in it
        self._began = ""  # its task, and how it began
        self._lines: list[str] = []

    def begin_episode(self, task: Task) -> None:
        self._recalled, self._used, self._began, self._lines = None, [], "", []

    # -- recall ----------------------------------------------------------------------------------------------------

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        """Rules and episodes, the same for the whole episode; the episode before is learnt from first."""
        if self._recalled is None:
            self._recalled = []
            self._began = f"{task_of(input.instruction, self.task_tokens, self.services)}\n{self._start_of(input.text)}"
            await self._learn()
            self._recalled = await self._related(k)
        lines = shown_lines(self._lines, self.recent)
        newest = [RecallItem(line, kind="step", source=self._name, priority=1 + i) for i, line in enumerate(lines)]
        return Recall((*self._recalled, *newest))

    async def _related(self, k: int | None) -> list[RecallItem]:
        """Rules of related tasks, then the most relevant successes and the nearest failures."""
        near = self.episodes.near(self._began, NEAREST)
        rules = self.insights.for_tasks(self._query.related(near), self.top_insights)
        self._used = [rule.id for rule in rules]
        good = [(e, s) for e, s in near if e.data["success"] and s >= self.least][: 2 * self.successes]
        bad = [e for e, s in near if not e.data["success"] and s >= self.least][: self.failures]
        if self.rank and len(good) > 0:
            answers = await asyncio.gather(*(self._relevance(e) for e, _ in good))
            judged = [a.value.score if a.value else 0.0 for a in answers]
            good = [pair for _, pair in sorted(zip(judged, good, strict=True), key=lambda p: -p[0])]
        texts = [f"- {rule.text}" for rule in rules]
        texts += [told(e) for e in [*(e for e, _ in good[: self.successes]), *bad]]
        texts = texts[:k] if k else texts
        return [RecallItem(text, kind="insight", source=self._name, priority=-i) for i, text in enumerate(texts)]

    async def _relevance(self, episode: Entry) -> Answer[Score]:
        prompt = PAIR.format(task=self._began, episode=f"{told(episode)}\nIt began: {episode.text}")
        parse = json_of(Score, repairs=self.repairs)
        return await self.services.ask("relevance", (system(RELEVANCE), user(prompt)), 64, parse)

    # -- learning --------------------------------------------------------------------------------------------------

    async def store(self, transition: Transition) -> None:
        self._lines = [*self._lines, Experience.of(transition).line()][-max(1, self.recent) :]

    async def end_episode(self, trajectory: Trajectory) -> None:
        """Keep the episode; what is to be learnt from it is asked when the next episode of the run begins."""
        if not trajectory.transitions:
            return
        total = episode_return(trajectory)
        success = self._succeeded(trajectory, total)
        self._total += total
        self.insights.judge(self._used, success)
        self._used = []
        first = trajectory.transitions[0].input
        began = self._began or f"{task_of(first.instruction, self.task_tokens, self.services)}\n{first.text}"
        paid = [t for t in trajectory.transitions if t.reward >= 0] if success else []
        steps = [(t.input.text, Experience.of(t).line()) for t in paid or trajectory.transitions]
        count = self.services.llm.count_tokens
        self._chain = telling.course(steps, self.trial_tokens, count)
        actions = telling.course([("", line) for _, line in steps], self.key_tokens, count)
        data = {"success": success, "return": total, "key": actions, "length": len(trajectory.transitions)}
        data["graded"] = trajectory.metrics.get("success") is None and self.threshold is None
        self._unlearnt = self.services.new_id()
        self._query.keep(Entry(self._unlearnt, began, self.services.time(), data))
        self._count += 1

    def _succeeded(self, trajectory: Trajectory, total: float) -> bool:
        """What the environment says, or the threshold; else whether the return is above the mean so far."""
        said = trajectory.metrics.get("success")
        if said is not None:
            return bool(said)
        if self.threshold is not None:
            return total >= self.threshold
        return total > self._total / max(1, self._count)

    async def _learn(self) -> None:
        """Learn from the episode before, once."""
        if self._unlearnt is not None:
            id, chain, self._unlearnt, self._chain = self._unlearnt, self._chain, None, ""
            await self._learner.learn(id, chain, self._count)

    def _start_of(self, text: str) -> str:
        return clip_text(one_line(text), max(64, self.task_tokens // 2), self.services.llm.count_tokens)

    # -- state -----------------------------------------------------------------------------------------------------

    def metrics(self) -> dict[str, int]:
        """Episodes, successes among them, edges, rules, evictions."""
        return {
            "entries": len(self.episodes),
            "successes": sum(e.data["success"] for e in self.episodes),
            "edges": sum(1 for _ in self.graph.edges()),
            "insights": len(self.insights),
            "evicted": self.episodes.evicted,
        }

    def snapshot(self) -> bytes:
        recalled = None if self._recalled is None else [[i.text, i.kind, i.source, i.priority] for i in self._recalled]
        graphs = [self.episodes.state(), self.graph.state(), self.insights.state()]
        learning = [self._count, self._total, self._chain, self._unlearnt]
        return dump_state([*graphs, learning, [recalled, self._used, self._began, self._lines]])

    def restore(self, blob: bytes) -> None:
        episodes, graph, insights, learning, episode = load_state(blob)
        self.episodes.load(episodes)
        self.graph.load(graph)
        self.insights.load(insights)
        self._count, self._total, self._chain, self._unlearnt = learning
        recalled, self._used, self._began, self._lines = episode
        items = [RecallItem(t, kind=kind, source=s, priority=p) for t, kind, s, p in recalled or []]
        self._recalled = None if recalled is None else items
