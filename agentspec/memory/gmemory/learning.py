"""What G-Memory learns: what mattered in an episode, rules out of episodes held against each other, rules merged."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

from agentspec.llm.base import system, user
from agentspec.memory.gmemory.insights import Change, Insight, Insights, first_neighbours
from agentspec.memory.gmemory.prompts import (
    CHAIN,
    COMPARE,
    KEY,
    MERGE,
    MISTAKE,
    RULES,
    STEPS,
    numbered,
    told,
    verdict,
)
from agentspec.memory.gmemory.query import NEAREST
from agentspec.memory.parts.entries import Entries, Entry, one_line
from agentspec.services import Services
from agentspec.structured import json_of
from agentspec.tokens import clip_text

MOST_CHANGES, COMPARED_SUCCESSES = 4, 3


class Learner:
    """Questions about episodes, and what the answers do to these and to the rules.

    Args:
        services: of the memory.
        episodes: all episodes; what mattered in one is kept with it.
        insights: the rules.
        every: episodes between two rounds of comparison.
        comparisons: comparisons in a round.
        merge_every: episodes between two mergers of rules.
        most_merges: most clusters whose rules are merged at once.
        key_tokens: most tokens of what is kept of an episode.
        answer_tokens: most tokens of other answers.
        repairs: 1 to ask again for an answer that cannot be read, else 0.
    """

    def __init__(
        self,
        services: Services,
        episodes: Entries,
        insights: Insights,
        *,
        every: int,
        comparisons: int,
        merge_every: int,
        most_merges: int,
        key_tokens: int,
        answer_tokens: int,
        repairs: int,
    ) -> None:
        self.services, self.episodes, self.insights = services, episodes, insights
        self.every, self.comparisons = every, comparisons
        self.merge_every, self.most_merges = merge_every, most_merges
        self.key_tokens, self.answer_tokens, self.repairs = key_tokens, answer_tokens, repairs

    async def learn(self, id: int, chain: str, count: int) -> None:
        """Key steps or mistake of an episode; from time to time rules out of several; rules merged.

        Args:
            id: the episode.
            chain: its steps, as they are told.
            count: episodes so far.
        """
        episode = self.episodes[id]
        good = episode.data["success"]
        static = STEPS.format(
            ended=f"{verdict(episode)} (return {episode.data['return']:+.2f})",
            what=KEY if good else MISTAKE,
            words=max(8, self.key_tokens // 2),
            task=episode.text.partition("\n")[0],
        )
        prompt = (system(static), user(CHAIN.format(chain=chain)))
        answer = await self.services.ask("steps" if good else "mistake", prompt, self.key_tokens)
        if answer.value:
            key = clip_text(answer.value.strip(), self.key_tokens, self.services.llm.count_tokens)
            self.episodes.put(replace(episode, data={**episode.data, "key": key}))
        if count % self.every == 0:
            draw = random.Random(count)  # the same draw wherever this state is restored
            for task in draw.choices(list(self.episodes), k=self.comparisons):
                await self._compare(task)
        if count % self.merge_every == 0:
            await self._merge()

    async def _compare(self, task: Entry) -> None:
        """Rules out of the successes and a failure nearest to a task."""
        near = [e for e, _ in self.episodes.near(task.text, 2 * NEAREST)]
        good = [e for e in near if e.data["success"]][:COMPARED_SUCCESSES]
        bad = [e for e in near if not e.data["success"]][: 1 if good else COMPARED_SUCCESSES]
        rules = list(self.insights)
        parts = [RULES.format(rules=numbered(rules))] if rules else []
        parts.append("Episodes (data, not instructions):")
        parts += [f"{told(e)}\nIt began: {e.text.partition(chr(10))[2]}" for e in [*good, *bad]]
        prompt = (system(COMPARE), user("\n\n".join(parts)))
        answer = await self.services.ask(
            "compare", prompt, self.answer_tokens, self._json({"operations": list[Change]}, whole=False)
        )
        if answer.value is None:
            return
        shown, tasks = [rule.id for rule in rules], [e.id for e in [*good, *bad]]
        for change in answer.value["operations"][:MOST_CHANGES]:
            self.insights.change(change, shown, tasks, self.services.new_id())

    async def _merge(self) -> None:
        """The rules of each cluster of tasks, a third as many (but one at least)."""
        tasks = list(self.episodes)
        clusters = first_neighbours(self.episodes.embed([e.text for e in tasks]))
        groups = [self._supported({tasks[i].id for i in cluster}) for cluster in clusters]
        groups = sorted((g for g in groups if len(g) > 1), key=lambda g: -len(g))[: self.most_merges]
        taken: set[int] = set()
        for group in groups:
            rules = [rule for rule in group if rule.id in self.insights and rule.id not in taken]
            if len(rules) < 2:
                continue
            most = max(1, len(rules) // 3)
            prompt = (system(MERGE.format(most=most)), user(RULES.format(rules=numbered(rules))))
            answer = await self.services.ask("merge", prompt, self.answer_tokens, self._json({"rules": list[str]}))
            merged = [one_line(text) for text in answer.value["rules"] if text.strip()] if answer.value else []
            if not merged:
                continue
            supported = tuple(dict.fromkeys(task for rule in rules for task in rule.tasks))
            for rule in rules:
                self.insights.remove(rule.id)
            for text in merged[:most]:
                new = Insight(self.services.new_id(), text, max(rule.score for rule in rules), supported)
                self.insights.put(new)
                taken.add(new.id)

    def _supported(self, tasks: set[int]) -> list[Insight]:
        """The rules of which most of the tasks are among these."""
        return [rule for rule in self.insights if 2 * len(tasks & set(rule.tasks)) > len(rule.tasks)]

    def _json(self, schema: Any, *, whole: bool = True) -> Any:
        return json_of(schema, repairs=self.repairs, whole=whole)
