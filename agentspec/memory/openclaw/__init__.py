"""OpenClaw's memory: a workspace of Markdown files that the agent keeps itself (github.com/openclaw/openclaw).

`MEMORY.md` holds curated rules and is always shown. `memory/episode-0001.md` is a log, append-only; what was noted in
this episode and the one before is shown, all logs are searched. A skill is a folder with a `SKILL.md`: names and
descriptions are listed, the body is read when it is chosen. Before the conversation is cut, one silent turn writes down
what must not be lost. Between episodes, *dreaming* moves into `MEMORY.md` what was recalled often.

AgentSpec's form: procedural memory of lessons, refined along the trajectory. Every `every` steps one call edits rules
and skills by name (edits are applied by code; what they do not name stays as it is). Skill and log entries are chosen
by similarity to the observation, without a call; of the log at most a third of what there is to choose from, so that a
short episode is not shown whole. The workspace is virtual, a mapping of paths to text, and can be written to disk
(`files().export(folder)`). A *day* of OpenClaw is an episode; its reserve of 20,000 and soft margin of 4,000 tokens of
a window of 200,000 are shares of the model's window.

Cost per step: none to retrieve; 1 call per `every` steps; 1 per cut of the conversation; at most 2 at an episode's end,
and only where a later episode starts from this one's memory. `preset: paper` stands for ReAct + OpenClaw in its tables.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from agentspec.declaration import CallProfile, Declaration, Purpose
from agentspec.memory.openclaw.files import FileTree, Skill, one_line, rule_name, rules_text, skills_in, slug
from agentspec.memory.openclaw.log import Log
from agentspec.memory.openclaw.prompts import DREAM, FLUSH, HEAD, LEARN, NOTHING
from agentspec.memory.openclaw.search import Chunk, decay, dream_score, kept_share
from agentspec.memory.openclaw.workspace import Edit, Edits, Rule, Workspace
from agentspec.memory.parts.steps import (
    brief,
    distinct,
    first_held,
    goal_of,
    newest_within,
    step_name,
    step_text,
    written,
)
from agentspec.memory.parts.telling import outcome
from agentspec.parameters import at_least, settings
from agentspec.protocols import Services
from agentspec.registry import SpecError
from agentspec.state import dump_state, load_state
from agentspec.structured import json_of
from agentspec.tokens import clip_text
from agentspec.trajectory import Trajectory
from agentspec.types import AgentInput, Recall, RecallItem, Task, Transition

PRESETS: dict[str, dict[str, Any]] = {
    "paper": {"every": 2, "search": 6, "answer_tokens": 320, "steps_tokens": 768},
    "rl": {"every": 8, "search": 3, "answer_tokens": 192, "steps_tokens": 640},
}
TURN_TOKENS = 96
NOTES = 6
EDITS = 3
BEFORE = 4  # older steps that a prompt shows before the new ones


class OpenClaw:
    """Rules, skills and logs as files.

    Args:
        preset: `paper` (edits after every 2 steps, 6 log entries searched) or `rl` (every 8 steps, 3 entries).
        every: steps between edits.
        search: log entries that search shows in a step, at most a third of those that it chooses from.
        least: smallest score of a log entry that search shows (upstream's `minScore`).
        recent: newest steps that are always shown where no conversation shows them.
        skills: folder with skills of your own (`NAME/SKILL.md`); one that is learnt replaces one of the same name.
        skills_shown: skills whose body is shown in a step.
        skill_least: least similarity of a skill's name and description to the observation.
        diverse: choose log entries by maximal marginal relevance.
        half_life: episodes after which the score of a log entry is halved (0: never). `MEMORY.md` never fades.
        memory_tokens: most tokens of `MEMORY.md`; the rule written longest ago goes first.
        skill_tokens: most tokens of a skill's body.
        max_skills: most skills that are kept; the one written longest ago goes first.
        max_log: most log entries; the oldest go first.
        reserve: share of the window that is kept free: beyond it the conversation is cut to `keep` steps.
        soft: share before that at which what must not be lost is written down, once per cut.
        keep: steps that stay when the conversation is cut.
        window: tokens of the window (0: the model's own; nothing is cut where that is unknown).
        least_score: dreaming promotes log entries from this score on (see `dream_score`) ...
        least_recalls: ... that were recalled this often ...
        least_queries: ... by this many different observations.
        promoted: most log entries that are promoted at once.
        max_loss: share of `MEMORY.md`'s rules that a rewrite may lose; one that loses more is refused.
        state_tokens: most tokens of the state kept with a step.
        answer_tokens: most tokens of each answer (a rewrite of `MEMORY.md` has twice `memory_tokens`).
        steps_tokens: most tokens of steps in a prompt.
    """

    declaration = Declaration(
        "named rules, skills and logs in Markdown files that the model edits",
        calls=CallProfile(store=(0, 3), episode=(0, 4)),
        rl=CallProfile(store=(0, 3), episode=(0, 4)),
        purposes={
            "learn": Purpose(
                "store",
                '{"edits": [{"op": "add", "name": "seen", "text": "DOUBLE while below half."}, '
                '{"op": "skill", "name": "way", "text": "1. ADD()\\n2. DOUBLE()", "description": "when far below"}]}',
            ),
            "flush": Purpose("store", "- The target is 1000.\n- ADD gives 3."),
            "dream": Purpose("episode", '{"rules": [{"name": "seen", "text": "DOUBLE below 500 of 1000."}]}'),
        },
        needs=("embedder",),
        small=(
            {"every": 3, "window": 900, "keep": 2, "least_score": 0.1, "least_recalls": 1, "least_queries": 1},
            {"every": 2, "max_log": 5, "max_skills": 1, "memory_tokens": 40, "diverse": True, "half_life": 2.0},
        ),
        aliases=("open_claw", "claw"),
    )

    def __init__(
        self,
        services: Services,
        preset: str = "paper",
        every: int | None = None,
        search: int | None = None,
        least: float = 0.35,
        recent: int = 3,
        skills: str = "",
        skills_shown: int = 1,
        skill_least: float = 0.15,
        diverse: bool = False,
        half_life: float = 0.0,
        memory_tokens: int = 320,
        skill_tokens: int = 160,
        max_skills: int = 16,
        max_log: int = 500,
        reserve: float = 0.1,
        soft: float = 0.02,
        keep: int = 4,
        window: int = 0,
        least_score: float = 0.5,
        least_recalls: int = 3,
        least_queries: int = 2,
        promoted: int = 5,
        max_loss: float = 0.25,
        state_tokens: int = 80,
        answer_tokens: int | None = None,
        steps_tokens: int | None = None,
    ) -> None:
        given = {"every": every, "search": search, "answer_tokens": answer_tokens, "steps_tokens": steps_tokens}
        chosen = settings("openclaw", PRESETS, preset, given)
        self.every, self.search = chosen["every"], chosen["search"]
        self.answer_tokens, self.steps_tokens = chosen["answer_tokens"], chosen["steps_tokens"]
        at_least("openclaw", 1, every=self.every, max_log=max_log, max_skills=max_skills, keep=keep)
        at_least("openclaw", 16, memory_tokens=memory_tokens, skill_tokens=skill_tokens)
        at_least("openclaw", 0, search=self.search, recent=recent, skills_shown=skills_shown, window=window)
        if not (0 <= reserve < 1 and 0 <= soft < 1 - reserve and 0 <= max_loss <= 1):
            raise SpecError(
                f"openclaw: reserve={reserve}, soft={soft}, max_loss={max_loss}; expected shares in [0, 1], reserve "
                "and soft below 1 together"
            )
        self.services = services
        self.least, self.recent, self.skills_shown, self.skill_least = least, recent, skills_shown, skill_least
        self.diverse, self.half_life = diverse, half_life
        self.workspace = Workspace(self._count, memory_tokens, skill_tokens, max_skills)
        self.reserve, self.soft, self.keep = reserve, soft, keep
        self.window = window or services.context.window
        self.gate = (least_score, least_recalls, least_queries)
        self.promoted, self.max_loss, self.state_tokens = promoted, max_loss, state_tokens
        self.given = {slug(s.name): s for s in skills_in(skills)} if skills else {}
        self.log = Log(services.embedder, max_log)
        self._since, self._held_from = 0, 0  # steps of this episode
        self._flushed = False
        self._task = ""
        self._counts = {"edits": 0, "cuts": 0, "promoted": 0, "rewrites_refused": 0}

    def begin_episode(self, task: Task) -> None:
        self._since, self._held_from, self._flushed = 0, 0, False

    async def retrieve(self, input: AgentInput, k: int | None = None) -> Recall:
        """Rules, the skill that fits and the names of the others, log entries that fit, the newest steps."""
        now = self.services.time()
        items = [
            RecallItem(f"- **{name}**: {text}", kind="procedural", source="MEMORY.md", priority=4.0)
            for name, text in self.workspace.rules.items()
        ]
        items += self._skill_items(input.text)
        notes = self.log.notes(now.episode - 1, NOTES)
        items += [RecallItem(self._named(c), source=self._log_path(c.episode), priority=3.5) for c in notes]
        for key, score in self._searched(input.text, self.search if k is None else k):
            chunk = self.log.recalled(key, score, input.text, now.episode)
            items.append(RecallItem(self._named(chunk), score, source=self._log_path(chunk.episode), priority=score))
        if self.services.context.layout == "snapshot":
            newest = [c for c in self._today() if not c.note and c.step >= now.step - self.recent]
            count = self.services.llm.count_tokens
            items += [RecallItem(brief(self._named(c), count), 1.0, "step", priority=5.0 + c.step) for c in newest]
        return Recall(tuple(items))

    async def store(self, transition: Transition) -> None:
        count = self.services.llm.count_tokens
        self._append(step_text(transition, self.state_tokens, count), transition.step)
        self._held_from = first_held(self.services, transition.step)
        self._task = goal_of(transition.input.instruction, count)
        if transition.terminated or transition.truncated:
            return
        if transition.step + 1 - self._since >= self.every:
            await self._learn(transition.step + 1)
        await self._make_room(transition.step)

    async def end_episode(self, trajectory: Trajectory) -> None:
        if not self.services.carried:
            return
        steps = len(trajectory.transitions)
        if steps > self._since:
            await self._learn(steps, outcome(trajectory))
        elif steps:  # nothing is left to ask about
            self._append(outcome(trajectory), steps - 1, note=True)
        await self._dream()

    async def _learn(self, step: int, ending: str = "") -> None:
        """Let the model edit rules and skills in the light of the steps since it last did."""
        count = self.services.llm.count_tokens
        steps = [self._named(c) for c in self._today() if not c.note and c.step >= self._since - BEFORE]
        head = HEAD.format(
            task=self._task,
            rules=self.workspace.rules_shown(),
            skills="\n".join(f"- {s.name}: {s.description}" for s in self._all_skills().values()) or "(none)",
            steps="\n".join(newest_within(steps, self.steps_tokens, count) + ([ending] if ending else [])),
        )
        self._since = step
        prompt = head + LEARN.format(most=EDITS, words=self.answer_tokens // 2)
        answer = await self.services.ask("learn", prompt, self.answer_tokens, json_of(Edits, whole=False))
        for edit in answer.value.edits[:EDITS] if answer.value else ():
            self._counts["edits"] += self.workspace.apply(edit)

    async def _make_room(self, step: int) -> None:
        """Before the conversation is cut, and once per cut, write down what must not be lost; then cut it."""
        context = self.services.context
        if not self.window or context.layout != "conversation" or context.steps <= self.keep:
            return
        used = context.tokens()
        if used > self.window * (1 - self.reserve - self.soft) and not self._flushed:
            self._flushed = True
            await self._flush(step)
        if used > self.window * (1 - self.reserve):
            context.evict(self.keep, context.carry)
            self._held_from = first_held(self.services, step)
            self._flushed = False
            self._counts["cuts"] += 1

    async def _flush(self, step: int) -> None:
        count = self.services.llm.count_tokens
        turns = [
            f"{m.role}: {clip_text(one_line(m.text), TURN_TOKENS, count)}"
            for m in self.services.context.older(self.keep)
        ]
        prompt = FLUSH.format(
            task=self._task,
            rules=self.workspace.rules_shown(),
            turns="\n".join(newest_within(turns, 2 * self.steps_tokens, count)),
            most=NOTES,
        )
        answer = await self.services.ask("flush", prompt, self.answer_tokens)
        lines = [line.strip().lstrip("-* ").strip() for line in written(answer, self.answer_tokens, count).splitlines()]
        for line in [line for line in lines if line and NOTHING not in line][:NOTES]:
            self._append(line, step, note=True)

    async def _dream(self) -> None:
        """Promote what was recalled often into `MEMORY.md`; a rewrite that loses too much of it is refused."""
        episode = self.services.time().episode
        least_score, least_recalls, least_queries = self.gate
        scored = [
            (dream_score(c, episode, self.half_life or 30.0), key)
            for key, c in zip(self.log, self.log.values(), strict=True)
            if not c.promoted and c.recalls >= least_recalls and len(c.queries) >= least_queries
        ]
        best = sorted((s, key) for s, key in scored if s >= least_score)[::-1][: self.promoted]
        if not best:
            return
        entries = "\n".join(f"- {self.log[key].text}" for _, key in sorted(best, key=lambda hit: hit[1]))
        most = self.workspace.rule_tokens
        prompt = DREAM.format(rules=self.workspace.rules_shown(), entries=entries, words=most * 2 // 3)
        room = max(self.answer_tokens, 2 * most)  # all rules, and the JSON around them
        answer = await self.services.ask("dream", prompt, room, json_of({"rules": list[Rule]}))
        if answer.value is None:
            return
        rules = {
            rule_name(r.name): one_line(r.text) for r in answer.value["rules"] if rule_name(r.name) and r.text.strip()
        }
        if not rules or kept_share(self.workspace.rules, rules) < 1 - self.max_loss:
            self._counts["rewrites_refused"] += 1
            return
        self.workspace.write(rules)
        for _, key in best:
            self.log.promote(key)
        self._counts["promoted"] += len(best)

    def _append(self, text: str, step: int, *, note: bool = False) -> None:
        self.log.append(self.services.new_id(), Chunk(text, self.services.time().episode, step, note))

    def _searched(self, query: str, k: int) -> list[tuple[int, float]]:
        """Log entries that fit, and that the prompt does not show anyway, oldest first.

        At most a third of them: a search that gives nearly all there is has chosen nothing.
        """
        now = self.services.time()
        snapshot = self.services.context.layout == "snapshot"
        first = max(0, now.step - self.recent) if snapshot else self._held_from
        notes = self.log.notes(now.episode - 1, NOTES)
        hidden = max(0, now.step - first) + len(notes)
        k = min(k, (len(self.log) - hidden + 2) // 3)
        hits = self.log.search(query, k + hidden, diverse=self.diverse) if k > 0 else []
        hits = [(key, s * decay(now.episode - self.log[key].episode, self.half_life)) for key, s in hits]
        hits = [hit for hit in hits if hit[1] >= self.least]

        def is_shown(chunk: Chunk) -> bool:
            here = chunk.episode == now.episode and chunk.step >= first and not chunk.note
            return here or any(chunk is note for note in notes)

        fresh = sorted((h for h in hits if not is_shown(self.log[h[0]])), key=lambda h: -h[1])
        return sorted(distinct(fresh, lambda key: self.log[key].text)[:k])

    def _skill_items(self, query: str) -> list[RecallItem]:
        skills = list(self._all_skills().values())
        if not skills:
            return []
        chosen: list[tuple[float, Skill]] = []
        if self.services.embedder is not None:
            vectors = self.services.embedder.embed([query, *(f"{s.name}. {s.description}" for s in skills)])
            scores = (vectors[1:] @ vectors[0]).tolist()
            ranked = sorted(zip(scores, skills, strict=True), key=lambda pair: -pair[0])
            chosen = [pair for pair in ranked[: self.skills_shown] if pair[0] >= self.skill_least]
        others = [s for s in skills if all(s is not c for _, c in chosen)]
        items = [
            RecallItem(f"Skill {s.name} ({s.description}):\n{self._clip(s.body)}", score, "procedural", s.path, 3.0)
            for score, s in chosen
        ]
        listed = "; ".join(f"{s.name} ({s.description})" for s in others)
        return items + ([RecallItem(f"Other skills: {listed}", kind="procedural", priority=2.0)] if listed else [])

    def _all_skills(self) -> dict[str, Skill]:
        """Skills by path; one that was learnt stands for one that was given under the same name."""
        return {**self.given, **self.workspace.skills}

    def _today(self) -> list[Chunk]:
        """The log of this episode."""
        return self.log.of(self.services.time().episode)

    def _named(self, chunk: Chunk) -> str:
        name = step_name(chunk.episode, chunk.step, self.services.time())
        return f"{'Note of ' + name[0].lower() + name[1:] if chunk.note else name}: {chunk.text}"

    def _count(self, text: str) -> int:
        return self.services.llm.count_tokens(text)

    def _clip(self, text: str) -> str:
        return clip_text(text, self.workspace.skill_tokens, self.services.llm.count_tokens)

    @staticmethod
    def _log_path(episode: int) -> str:
        return f"memory/episode-{episode + 1:04d}.md"

    def files(self) -> FileTree:
        """The workspace as files: `MEMORY.md`, logs, and the skills that were learnt."""
        tree = FileTree({"MEMORY.md": rules_text(self.workspace.rules)})
        for skill in self.workspace.skills.values():
            tree.write(skill.path, skill.text())
        for chunk in self.log.values():
            path = self._log_path(chunk.episode)
            line = f"- note: {chunk.text}" if chunk.note else f"- step {chunk.step + 1}: {chunk.text}"
            before = tree.read(path) or f"# Episode {chunk.episode + 1}\n\n"
            tree.write(path, f"{before}{line}\n")
        return tree

    def describe(self) -> str:
        """The workspace as one text."""
        tree = self.files()
        return "\n".join(f"== {path}\n{tree.read(path)}" for path in tree)

    def metrics(self) -> Mapping[str, Any]:
        """Rules, skills and log entries there are; edits, cuts, promotions and refused rewrites so far."""
        sizes = {"rules": len(self.workspace.rules), "skills": len(self.workspace.skills), "log": len(self.log)}
        return {**sizes, **self._counts}

    def snapshot(self) -> bytes:
        here = [self._since, self._held_from, self._flushed, self._task]
        return dump_state([*self.workspace.state(), self.log.state(), here, self._counts])

    def restore(self, blob: bytes) -> None:
        rules, skills, log, here, self._counts = load_state(blob)
        self.workspace.load(rules, skills)
        self.log.load(log)
        self._since, self._held_from, self._flushed, self._task = here


__all__: Sequence[str] = ["Edit", "OpenClaw", "Rule"]
