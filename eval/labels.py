"""How far to believe the failure rules: a sample of episodes that two readers labelled without seeing them.

    python -m eval.labels [DIR] [--answers FILE]
    python -m eval.labels [DIR] --judge MODEL [--llm KEY=VALUE ...] --to FILE

prints, per kind of failure, how the two readers agree (Cohen's kappa), and precision and recall of the rules of
`agentspec.failures` against what both readers say. The unit is *episode x kind*: present or absent. Where one reader
marked a kind and the other did not, the pair is disputed and counts for neither precision nor recall; it does count in
the kappas of the rules against each reader.

`--answers` judges a file of labels (of a model, of a reader) in the place of the rules. `--judge` asks a model
(`eval.judge`), keeps what it answers in such a file, and sets it beside the rules, and beside the rules with the model
where they are silent, which is how a judge is used.

A sample ships (`eval/data/failures`, the default): the trajectories without model calls, who played them
(`sources.json`), both readers' labels, and what they were told (`LABELS.md`).
"""

from __future__ import annotations

import argparse
import gzip
import json
import math
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from agentspec.cli.arguments import key_values
from agentspec.failures import LEAVES, is_failure, leading, signs
from agentspec.llm import build_llm
from agentspec.policies import Policy
from agentspec.trajectory import Trajectory
from eval.judge import Judge, judged

Labels = Mapping[str, frozenset[str]]
"""Episode -> the kinds of failure that it shows."""

SAMPLE = Path(__file__).parent / "data" / "failures"
UNSEEN = SAMPLE.with_name("unseen_failures")
"""A second sample, played and labelled after the rules had been mended by the first; no rule was mended by it."""


@dataclass(frozen=True)
class Agreement:
    """Of one kind: in how many episodes it was labelled, in how many it was said, and in how many both."""

    labelled: int
    said: int
    both: int

    @property
    def precision(self) -> float | None:
        """Of those said, the share that is labelled so."""
        return self.both / self.said if self.said else None

    @property
    def recall(self) -> float | None:
        """Of those labelled, the share that is said."""
        return self.both / self.labelled if self.labelled else None

    def __add__(self, other: Agreement) -> Agreement:
        return Agreement(self.labelled + other.labelled, self.said + other.said, self.both + other.both)


def kappa(a: Sequence[object], b: Sequence[object]) -> float:
    """Cohen's kappa of two raters: agreement beyond what their own frequencies would give by chance.

    NaN where both always gave one and the same rating: there is no chance to beat.

    >>> kappa(["x", "x", "y", "y"], ["x", "x", "y", "x"])
    0.5

    Raises:
        ValueError: nothing rated, or lists of different lengths.
    """
    if not a or len(a) != len(b):
        raise ValueError(f"expected two ratings of the same items, got {len(a)} and {len(b)}")
    observed = sum(x == y for x, y in zip(a, b, strict=True)) / len(a)
    expected = sum(a.count(kind) * b.count(kind) for kind in {*a, *b}) / len(a) ** 2
    return math.nan if expected == 1 else (observed - expected) / (1 - expected)


def kappa_of(a: Labels, b: Labels, leaves: Iterable[str] = LEAVES) -> float:
    """Kappa of two label sets over all pairs of episode and kind; of one kind with `leaves=[kind]`."""
    pairs = [(episode, leaf) for leaf in leaves for episode in a]
    return kappa([leaf in a[episode] for episode, leaf in pairs], [leaf in b[episode] for episode, leaf in pairs])


def agreed(a: Labels, b: Labels) -> tuple[Labels, Labels]:
    """What both readers marked, and what only one of them did (disputed)."""
    return {e: a[e] & b[e] for e in a}, {e: a[e] ^ b[e] for e in a}


def agreement(labels: Labels, said: Labels, disputed: Labels | None = None) -> dict[str, Agreement]:
    """Per kind of `LEAVES` how an answer meets the labels; pairs that are disputed are left out."""
    open_ = disputed or {}
    found = {}
    for leaf in LEAVES:
        episodes = [e for e in labels if leaf not in open_.get(e, ())]
        there, told = ({e for e in episodes if leaf in side[e]} for side in (labels, said))
        found[leaf] = Agreement(len(there), len(told), len(there & told))
    return found


# -- the sample ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sample:
    """Episodes by number, who played them, and what two readers said."""

    episodes: Mapping[str, Trajectory]
    sources: Mapping[str, str]
    a: Labels
    b: Labels

    @classmethod
    def read(cls, folder: str | Path = SAMPLE) -> Sample:
        """From `episodes.jsonl.gz`, `sources.json`, `labels_a.jsonl` and `labels_b.jsonl`.

        Raises:
            ValueError: labels of other episodes than those of the sample, or as `read_labels`.
        """
        at, episodes = Path(folder), cls.episodes_of(folder)
        sources = json.loads((at / "sources.json").read_text(encoding="utf-8"))
        return cls(episodes, sources, *(read_labels(at / f"labels_{r}.jsonl", episodes) for r in "ab"))

    @staticmethod
    def episodes_of(folder: str | Path) -> dict[str, Trajectory]:
        """The episodes of a sample, by number from 001, also where nobody has labelled them yet."""
        with gzip.open(Path(folder) / "episodes.jsonl.gz", "rt", encoding="utf-8") as lines:
            return {f"{i:03}": Trajectory.from_json(line) for i, line in enumerate(lines, 1)}

    def rules(self) -> Labels:
        """What the rules say of each episode."""
        return {e: frozenset(sign.leaf for sign in signs(t)) for e, t in self.episodes.items()}


def read_labels(path: str | Path, episodes: Collection[str] = ()) -> Labels:
    """A reader's file: `{"episode": "001", "labels": [kind, ...]}` per line.

    Raises:
        ValueError: naming file and line of what is no such object, or a kind or episode that does not exist; episodes
            without a line.
    """
    found: dict[str, frozenset[str]] = {}
    lines = Path(path).read_text(encoding="utf-8").splitlines()  # by hand: the last one may lack its end
    for number, record in enumerate(map(json.loads, filter(str.strip, lines)), 1):
        episode, labels = record.get("episode"), record.get("labels")
        named = isinstance(episode, str) and (not episodes or episode in episodes)
        if not named or not isinstance(labels, list) or not all(isinstance(label, str) for label in labels):
            raise ValueError(f'{path}, line {number}: expected {{"episode": ID, "labels": [...]}}, got {record}')
        if wrong := [label for label in labels if label not in LEAVES]:
            raise ValueError(f"{path}, line {number}: {wrong[0]!r} is none of {', '.join(LEAVES)}")
        if episode in found:
            raise ValueError(f"{path}, line {number}: episode {episode} has been labelled above; give it once")
        found[episode] = frozenset(labels)
    if missing := [e for e in episodes if e not in found]:
        raise ValueError(f"{path}: no labels for the episodes {', '.join(missing)}")
    return found


# -- what is printed -------------------------------------------------------------------------------


def table(sample: Sample, said: Labels) -> str:
    """Markdown: per kind and in all, readers against each other and `said` against what both readers say."""
    labels, disputed = agreed(sample.a, sample.b)
    found = agreement(labels, said, disputed)
    lines = [
        "| kind | readers: both, one | kappa | said | right | precision | recall |",
        "|---|---|---|---|---|---|---|",
    ]
    for leaf, row in [*found.items(), ("all", sum(found.values(), Agreement(0, 0, 0)))]:
        leaves = list(LEAVES) if leaf == "all" else [leaf]
        one = sum(kind in disputed[e] for kind in leaves for e in disputed)
        cells = (_share(kappa_of(sample.a, sample.b, leaves)), row.said, row.both)
        shares = (_share(row.precision), _share(row.recall))
        lines.append(f"| {leaf} | {row.labelled}, {one} | {' | '.join(map(str, (*cells, *shares)))} |")
    return "\n".join(lines)


def summary(sample: Sample, said: Labels) -> str:
    """Markdown: the table, kappas against each reader, and how often the leading kind is one that both readers say."""
    labels, _ = agreed(sample.a, sample.b)
    failed = {e: t for e, t in sample.episodes.items() if is_failure(t)}
    led = {e: leading(signs(t)) for e, t in failed.items()}
    led = {e: leaf for e, leaf in led.items() if leaf}
    right = sum(leaf in labels[e] for e, leaf in led.items())
    either = sum(leaf in sample.a[e] | sample.b[e] for e, leaf in led.items())
    return "\n".join(
        [
            f"{len(sample.episodes)} episodes, {len(failed)} of them failed.",
            "",
            table(sample, said),
            "",
            f"Kappa over all pairs of episode and kind: reader a with reader b {_share(kappa_of(sample.a, sample.b))}, "
            f"answers with a {_share(kappa_of(said, sample.a))}, with b {_share(kappa_of(said, sample.b))}.",
            f"Leading kind by the rules: in {len(led)} of {len(failed)} failures there is one; both readers say it in "
            f"{right} of them, at least one in {either}.",
        ]
    )


def beside_rules(sample: Sample, judged: Labels, judge: str) -> str:
    """Markdown: a judge of one kind per episode beside the rules, the rules with it, and a guess that looks at nothing.

    With the rules, a judge says something only of failures that no rule explains. The guess is the kind that both
    readers mark in the most episodes, said of every one: what a judge has to beat.
    """
    labels, disputed = agreed(sample.a, sample.b)
    rules = sample.rules()
    unexplained = {e for e, t in sample.episodes.items() if is_failure(t) and not rules[e]}
    often = max(LEAVES, key=lambda leaf: sum(leaf in labels[e] for e in labels))
    rows = {
        "rules": rules,
        judge: judged,
        f"rules, and {judge} where they are silent": {
            e: rules[e] or (judged[e] & _all(e in unexplained)) for e in rules
        },
        f"`{often}` every time": dict.fromkeys(rules, frozenset({often})),
    }
    lines = ["| answers | said | right | precision | recall | kappa with a | with b |", "|---|---|---|---|---|---|---|"]
    for name, said in rows.items():
        row = sum(agreement(labels, said, disputed).values(), Agreement(0, 0, 0))
        shares = row.precision, row.recall, kappa_of(said, sample.a), kappa_of(said, sample.b)
        lines.append(f"| {name} | {row.said} | {row.both} | {' | '.join(map(_share, shares))} |")
    most = sum(bool(labels[e]) for e in labels) / sum(map(len, labels.values()))
    told = [e for e in unexplained if judged[e]]
    right = sum(judged[e] <= labels[e] for e in told)
    return "\n".join(
        [
            *lines,
            "",
            f"One kind an episode bounds recall by {most:.2f}. The rules are silent on {len(unexplained)} failures; "
            f"{judge} names a kind in {len(told)} of them, in {right} one that both readers say.",
        ]
    )


def _all(there: bool) -> frozenset[str]:
    return frozenset(LEAVES) if there else frozenset()


def _share(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.2f}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the summary of a sample, or what a judge makes of it."""
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sample", nargs="?", default=SAMPLE, metavar="DIR", help="a labelled sample (default: ours)")
    parser.add_argument("--answers", help="labels to judge in the place of the rules, in the readers' format")
    judge = parser.add_argument_group("a model as judge")
    judge.add_argument(
        "--judge", metavar="MODEL", help="a model's name, folder or hub id: what it says of every episode"
    )
    judge.add_argument("--llm", action="append", default=[], metavar="KEY=VALUE", help="setting of its backend")
    judge.add_argument("--max-prompt", type=int, default=16_000, help="most tokens of a prompt (default: %(default)s)")
    judge.add_argument(
        "--to", metavar="FILE", help="where its answers are kept; those that are there are not asked for"
    )
    options = parser.parse_args(arguments)
    if bool(options.judge) != bool(options.to) or (options.judge and options.answers):
        parser.error("--judge MODEL and --to FILE belong together, and go without --answers")
    sample = Sample.read(options.sample)
    if options.judge:
        print(_ask(options, sample))
        return
    said = read_labels(options.answers, sample.episodes) if options.answers else sample.rules()
    print(summary(sample, said))


def _ask(options: argparse.Namespace, sample: Sample) -> str:
    """Ask the judge for what is not in its file yet."""
    policy = Policy.parse(options.judge, backend=key_values(options.llm, "--llm"))
    policy.check()
    judge = Judge(build_llm(policy.settings()), most_prompt=options.max_prompt)
    judged(judge, policy.identity(), sample.episodes, options.to, lambda text: print(text, file=sys.stderr, flush=True))
    return beside_rules(sample, read_labels(options.to, sample.episodes), policy.name)


if __name__ == "__main__":
    main()
