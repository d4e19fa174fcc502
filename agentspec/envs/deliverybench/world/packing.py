"""The little language of the bag: ``order 3: 1,2 -> A; B.1 -> C``.

A command is a sequence of blocks, one per order; a block is a list of clauses separated by ``;``; a clause sends items
to a compartment. ``2`` is the second item of that order still in the hand, ``B.1`` the first item already in B. The
order prefix may be left out when the food of only one order is in the hand.

In the original two readers look at one command: a number *anywhere* in a block takes the item out of the hand, but only
well-formed clauses put it into the bag (``Rules.vanishing_food``). Without that quirk each number must stand in a
clause, once, and anything unreadable is an error.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field

from agentspec.envs.deliverybench.world.bag import LABELS, Bag, Item
from agentspec.envs.deliverybench.world.food import COLD, FROZEN, HOT
from agentspec.envs.deliverybench.world.grammar import Refused, short
from agentspec.envs.deliverybench.world.state import OrderState

_BLOCK = re.compile(r"order\s+(\d{1,12})\s*:", re.IGNORECASE)
_NUMBER = re.compile(r"(?<![\w.])(?<![A-Za-z]\.)([1-9]\d{0,11})(?![\w.])")
_REF = re.compile(r"\s*([^\s.]*)\s*\.\s*(\S*)\s*")
_EXAMPLE = 'write for example "order 3: 1,2 -> A; 3 -> B"'


HOME = {HOT: "A", COLD: "B", FROZEN: "C"}
"""A compartment for each kind of food; the rest goes to D."""


def suggestion(orders: Iterable[OrderState]) -> str:
    """A command that puts all food in the hand of ``orders`` into the bag, hot, cold and frozen food apart."""
    blocks = []
    for order in orders:
        by_label: dict[str, list[str]] = {}
        for number, item in enumerate(order.pending, start=1):
            label = "D" if item.food is None else HOME.get(item.food.category, "D")
            by_label.setdefault(label, []).append(str(number))
        clauses = "; ".join(f"{','.join(numbers)} -> {label}" for label, numbers in sorted(by_label.items()))
        blocks.append(f"order {order.offer.id}: {clauses}")
    return " ".join(blocks)


@dataclass
class Clause:
    """Where ``items`` (numbers in the hand) and ``moves`` ((compartment, number) pairs) go: compartment ``to``."""

    to: str
    items: list[int] = field(default_factory=list)
    moves: list[tuple[str, int]] = field(default_factory=list)
    odd: str = ""


def place(bag: Bag, orders: dict[int, OrderState], command: str, loose: bool) -> int:
    """Carry out a bag command on ``bag`` and on the ``pending`` items of ``orders``; returns the items placed.

    ``loose`` keeps the original's mismatch between its two readers. On an error nothing has changed.

    Raises:
        Refused: BAG_NEED_PREFIX, BAG_NO_MATCH, BAG_BAD_COMP, BAG_NO_SLOT, BAG_NO_ITEM, BAG_TWICE, BAG_SYNTAX.
    """
    pending = {number: order for number, order in orders.items() if order.pending}
    blocks = _blocks(command, pending, loose)
    contents = {label: list(compartment.items) for label, compartment in bag.compartments.items()}
    hands: dict[int, list[Item]] = {number: list(order.pending) for number, order in pending.items()}
    emptied: set[str] = set()
    placed = 0
    for number, text in blocks:
        hand = hands.get(number, [])
        clauses = _clauses(text)
        if not loose:
            _check_strict(clauses, text)
        named = {int(n) for n in _NUMBER.findall(text) if int(n) <= len(hand)}
        for clause in clauses:
            _move(contents, clause, emptied)
        for clause in clauses:
            for n in clause.items:
                if n > len(hand):
                    if named or not loose:
                        raise Refused("BAG_NO_ITEM", f"order {number} has no item {n} in your hand{_hand(hand)}")
                    continue
                contents[clause.to].append(hand[n - 1])
                placed += 1
        gone = named if loose else {n for clause in clauses for n in clause.items}
        hands[number] = [item for i, item in enumerate(hand, start=1) if i not in gone]
    for label, items in contents.items():
        bag.compartments[label].items = items
    for label in emptied:
        bag.compartments[label].air = bag.rules.ambient
    for number, order in pending.items():
        order.pending = hands[number]
    return placed


def _blocks(command: str, pending: dict[int, OrderState], loose: bool) -> list[tuple[int, str]]:
    heads = list(_BLOCK.finditer(command))
    if not heads:
        if len(pending) > 1:
            numbers = ", ".join(str(number) for number in pending)
            raise Refused("BAG_NEED_PREFIX", f"you hold food of orders {numbers}: say which one, {_EXAMPLE}")
        return [(next(iter(pending), -1), command)]
    ends = [head.start() for head in heads[1:]] + [len(command)]
    blocks = [(int(head.group(1)), command[head.end() : end]) for head, end in zip(heads, ends, strict=True)]
    known = [block for block in blocks if block[0] in pending]
    if not known or (not loose and len(known) < len(blocks)):
        numbers = ", ".join(str(number) for number in pending) or "none"
        raise Refused("BAG_NO_MATCH", f"you hold no food of that order (in your hand: {numbers}); {_EXAMPLE}")
    return known


def _clauses(text: str) -> list[Clause]:
    clauses = []
    for part in text.split(";"):
        refs, arrow, goal = part.partition("->")
        if not arrow:
            continue
        label = goal.strip()[:1].upper()
        if label not in LABELS or not label:
            raise Refused("BAG_BAD_COMP", f"there is no compartment {short(goal.strip())}; use A, B, C or D")
        clause = Clause(label)
        for ref in refs.split(","):
            token = ref.strip()
            if token.isascii() and token.isdigit() and 0 < len(token) <= 12:
                if int(token) > 0:
                    clause.items.append(int(token))
            elif "." in token:
                clause.moves.append(_slot(token))
            elif token:
                clause.odd = token
        clauses.append(clause)
    return clauses


def _slot(token: str) -> tuple[str, int]:
    match = _REF.fullmatch(token)
    label = match.group(1).upper() if match else ""
    if not match or len(label) != 1 or label not in LABELS:
        raise Refused("BAG_BAD_COMP", f"there is no compartment {short(label or token)}; use A, B, C or D")
    digits = match.group(2)
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 12):
        raise Refused("BAG_NO_SLOT", f"{short(token)} names no item; {label}.1 is the first item in {label}")
    return label, int(digits)


def _move(contents: dict[str, list[Item]], clause: Clause, emptied: set[str]) -> None:
    """Move bagged items: per clause grouped by source, highest number first, so that numbers stay valid."""
    for label in dict.fromkeys(source for source, _ in clause.moves):
        for slot in sorted((k for source, k in clause.moves if source == label), reverse=True):
            if not 1 <= slot <= len(contents[label]):
                raise Refused("BAG_NO_SLOT", f"there is no item {label}.{slot}: {label} holds {len(contents[label])}")
            item = contents[label].pop(slot - 1)
            if not contents[label]:
                emptied.add(label)
            contents[clause.to].append(item)


def _check_strict(clauses: list[Clause], text: str) -> None:
    """Without the loose reading every number stands in a clause, once, and every token is understood."""
    odd = next((clause.odd for clause in clauses if clause.odd), "")
    if odd or not clauses:
        raise Refused("BAG_SYNTAX", f"cannot read {short(odd or text.strip())} in the bag command; {_EXAMPLE}")
    stray = next((part for part in text.split(";") if "->" not in part and _NUMBER.search(part)), "")
    if stray:
        raise Refused("BAG_SYNTAX", f"{short(stray.strip())} has no compartment; {_EXAMPLE}")
    for refs in ([n for clause in clauses for n in clause.items], [m for clause in clauses for m in clause.moves]):
        if len(set(refs)) < len(refs):
            raise Refused("BAG_TWICE", "the same item is named twice; each goes into one compartment")


def _hand(items: list[Item]) -> str:
    shown = ", ".join(f"{i} {item.name}" for i, item in enumerate(items, start=1))
    return f" (in your hand: {shown})" if shown else ""
